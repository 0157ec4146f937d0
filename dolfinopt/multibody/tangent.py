"""Tangent of inverse dynamics: derivative of drive forces and elastic residual by coordinates.

Both passes of `inverse_dynamics` are differentiated. Columns are made of the coordinates that are
asked for alone: with prescribed rigid coordinates no array knows of them. A body feels those
inboard of it through the four numbers (a_x, a_y, w, wd) of its frame, and those outboard of it
through force and moment: its rows are a block of its own coordinates and a rank of seven.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from dolfinopt.multibody.instants import FEW, PerInstant, Scale, as_column, several
from dolfinopt.multibody.inverse_dynamics import (
    Frame,
    as_complex,
    body_force,
    body_moment,
    inertia,
    load_columns,
    modal_inertia,
    outward_pass,
)
from dolfinopt.multibody.mechanism import Mechanism, ModalConstants
from dolfinopt.multibody.modal_displacement import Rates
from dolfinopt.multibody.motion import RigidMotion

_FrameDerivatives = tuple[np.ndarray, np.ndarray, np.ndarray]  # of (a, w, wd), each (n, 3 S)
_Columns = tuple[slice, slice, slice]  # of q, qd, qdd among the 3 S


# K, D, M, G and what they are multiplied by.
Coupling = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, tuple[PerInstant, ...]]


@dataclass(frozen=True, eq=False)
class _BodyTangent:
    """Derivative of one body's elastic residual by S coordinates; arrays over n instants.

    r' = K q' + D qd' + M (qdd' - w^2 q') + G (wd q' + 2 w qd') + left (right y') with
    y = [q, qd, qdd] of all S coordinates, and what geometric stiffness adds.

    Attributes:
        constants: its constants.
        rows, columns: its place among all rows and among the S columns.
        kept: those of its coordinates that have a column.
        w, wd: of its frame.
        scale: of its constants; not of left and right.
        left: (n, q, r).
        right: (n, r, 3 S).
        geometric: (n, q, q) each, what stiffening adds by q, and by qd and qdd where the body's
            own inertia knows it; nothing of a linear body.
    """

    constants: ModalConstants
    rows: slice
    columns: slice
    kept: np.ndarray
    w: np.ndarray
    wd: np.ndarray
    scale: Scale
    left: np.ndarray
    right: np.ndarray
    geometric: tuple[np.ndarray, ...] = ()

    @property
    def matrices(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return K, D, M, G (q, q)."""
        body = self.constants.body
        return body.K, body.D, body.M, body.G

    def at(self, part: slice) -> _BodyTangent:
        """Return it at some of the instants."""
        names = ("w", "wd", "scale", "left", "right")
        geometric = tuple(one[part] for one in self.geometric)
        changed = {name: getattr(self, name)[part] for name in names}
        return replace(self, geometric=geometric, **changed)

    def coupling(self, own: np.ndarray, times: int) -> Coupling:
        """Return K, D, M, G (kept, own) and `factors`; every step of Newton's method asks for them.

        Args:
            own: rows of the body.
            times: see `factors`.
        """
        key = own.tobytes(), times
        if key not in self._known:
            K, D, M, G = (x[np.ix_(own, self.kept)].T for x in self.matrices)
            self._known[key] = K, D, M, G, self.factors(times)
        return self._known[key]

    @cached_property
    def _known(self) -> dict[tuple[bytes, int], Coupling]:
        return {}

    def factors(self, times: int = 1) -> tuple[PerInstant, ...]:
        """Return what K and M, by q; D and G, by qd; M, by qdd, are multiplied by, as columns.

        (k, m_q, g_q, d, g_v, m): of K and M and G by q, of D and G by qd, of M by qdd.

        Args:
            times: how often every instant is repeated.
        """
        w, wd = np.repeat(self.w, times)[:, None], np.repeat(self.wd, times)[:, None]
        m, k, d = (
            as_column(np.repeat(x, times) if isinstance(x, np.ndarray) else x)
            for x in (self.scale.mass, self.scale.stiffness, self.scale.damping)
        )
        return k, -m * w * w, m * wd, d, 2.0 * m * w, m


@dataclass(frozen=True, eq=False)
class Tangent:
    """Derivative of the rows [drive forces asked for (R), elastic residual (N)] by S coordinates.

    The S coordinates are the R rigid ones, then those elastic ones that are kept; n instants.

    Attributes:
        bodies: from the cart outwards.
        size: S.
        drives: (n, R, 3 S) of the forces of the rigid coordinates, columns ordered q, qd, qdd.
    """

    bodies: tuple[_BodyTangent, ...]
    size: int
    drives: np.ndarray

    def window(self, first: int, last: int) -> Tangent:
        """Return the instants first..last - 1."""
        part = slice(first, last)
        return replace(
            self, bodies=tuple(b.at(part) for b in self.bodies), drives=self.drives[part]
        )

    def dense(self) -> np.ndarray:
        """Return the S coordinates' own rows (n, S, 3 S), columns ordered q, qd, qdd."""
        size = self.size
        jacobian = np.empty((len(self.drives), size, 3 * size))
        jacobian[:, : self.drives.shape[1]] = self.drives
        for part in self.bodies:
            rows = jacobian[:, part.columns]
            rows[:] = part.left[:, part.kept] @ part.right
            k, m_q, g_q, d, g_v, m = (
                x[:, None] if isinstance(x, np.ndarray) else x for x in part.factors()
            )
            own = np.ix_(part.kept, part.kept)
            K, D, M, G = (x[own] for x in part.matrices)
            columns = _columns(part.columns, size)
            rows[:, :, columns[0]] += k * K + m_q * M + g_q * G
            rows[:, :, columns[1]] += g_v * G
            if part.constants.D is not None:
                rows[:, :, columns[1]] += d * D
            rows[:, :, columns[2]] += m * M
            for place, one in zip(columns, part.geometric):
                rows[:, :, place] += one[:, part.kept[:, None], part.kept]
        return jacobian

    def times(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, wanted: np.ndarray
    ) -> np.ndarray:
        """Return the change of W wanted rows (m, W) by one of the S coordinates, each (m, S).

        With m a multiple of the n instants, each of them stands for as many rows in turn.

        Args:
            q, qd, qdd: (m, S).
            wanted: (W,) ascending, of the R + N rows.
        """
        count, rigid = self.drives.shape[:2]
        times = len(q) // count
        change = np.concatenate([q, qd, qdd], axis=1).reshape(count, times, -1).swapaxes(1, 2)
        out = []
        if rigid:
            rows = self.drives[:, wanted[wanted < rigid]]
            out.append((rows @ change).swapaxes(1, 2).reshape(len(q), -1))
        for part in self.bodies:
            own = wanted[(wanted >= part.rows.start) & (wanted < part.rows.stop)] - part.rows.start
            K, D, M, G, (k, m_q, g_q, d, g_v, m) = part.coupling(own, times)
            e, ed, edd = q[:, part.columns], qd[:, part.columns], qdd[:, part.columns]
            coupled = (part.left[:, own] @ (part.right @ change)).swapaxes(1, 2).reshape(len(q), -1)
            coupled += (m * edd + m_q * e) @ M + (g_q * e + g_v * ed) @ G
            if K.any():  # not of the rows of other coordinates that vibrate by themselves
                coupled += (k * e) @ K
            if D.any():
                coupled += (d * ed) @ D
            for change_of, one in zip((e, ed, edd), part.geometric):
                rows = one[:, own[:, None], part.kept].swapaxes(1, 2)
                coupled += _by_instant(change_of, rows)
            out.append(coupled)
        return np.concatenate(out, axis=1)

    def transposed(self, rows: np.ndarray) -> Rates:
        """Return the gradient of sum_n rows_n . [drives, residual]_n by q, qd, qdd, each (n, S).

        Args:
            rows: (n, R + N).
        """
        size, rigid = self.size, self.drives.shape[1]
        gradient = np.zeros((len(rows), 3 * size))
        if rigid:
            gradient += (rows[:, None, :rigid] @ self.drives)[:, 0]
        for part in self.bodies:
            y = rows[:, part.rows]
            gradient += ((y[:, None] @ part.left) @ part.right)[:, 0]
        by_q, by_v, by_a = gradient[:, :size], gradient[:, size : 2 * size], gradient[:, 2 * size :]
        for part in self.bodies:
            y = rows[:, part.rows]
            body = part.constants.body
            K, M, G = (y @ x[:, part.kept] for x in (body.K, body.M, body.G))
            k, m_q, g_q, d, g_v, m = part.factors()
            by_q[:, part.columns] += k * K + m_q * M + g_q * G
            by_v[:, part.columns] += g_v * G
            if part.constants.D is not None:
                by_v[:, part.columns] += d * (y @ body.D[:, part.kept])
            by_a[:, part.columns] += m * M
            for by, one in zip((by_q, by_v, by_a), part.geometric):
                by[:, part.columns] += _by_instant(y, one[:, :, part.kept])
        return by_q, by_v, by_a


def _by_instant(x: np.ndarray, A: np.ndarray) -> np.ndarray:
    """Return x A (m, W) for x (m, q) and A (n, q, W), every instant as often as m has it."""
    rows = x.reshape(len(A), len(x) // len(A), x.shape[1]) @ A
    return rows.reshape(len(x), A.shape[2])


@dataclass(frozen=True, eq=False)
class _Places:
    """Where the coordinates asked for stand among the S columns.

    Attributes:
        size: S.
        rigid: (R,) indices of the rigid coordinates asked for, ascending.
        kept: of every body, those of its coordinates that have a column.
        bodies: of every body, their place among the S.
    """

    size: int
    rigid: np.ndarray
    kept: list[np.ndarray]
    bodies: list[slice]

    def of_body(self, k: int) -> _Columns:
        """Return a body's columns in [q, qd, qdd]."""
        return _columns(self.bodies[k], self.size)

    def of_rigid(self, i: int) -> _Columns | None:
        """Return the column of a rigid coordinate (0 the cart, k + 1 the joint of body k), if any.

        As slices of one: they fit wherever a body's do.
        """
        place = np.flatnonzero(self.rigid == i)
        return _columns(slice(place[0], place[0] + 1), self.size) if len(place) else None


def _columns(part: slice, size: int) -> _Columns:
    a, b = part.start, part.stop
    return slice(a, b), slice(size + a, size + b), slice(2 * size + a, 2 * size + b)


def _places(mechanism: Mechanism, keep: np.ndarray | None, rigid: np.ndarray | None) -> _Places:
    rigid = np.zeros(0, dtype=int) if rigid is None else rigid
    keep = np.arange(mechanism.num_coordinates) if keep is None else keep
    ends = np.searchsorted(keep, [0, *(part.stop for part in mechanism.slices)])
    parts = zip(pairwise(ends), mechanism.slices, strict=True)
    kept = [keep[a:b] - part.start for (a, b), part in parts]
    bodies = [slice(a, b) for a, b in pairwise(ends + len(rigid))]
    return _Places(len(rigid) + len(keep), rigid, kept, bodies)


def linearise(
    mechanism: Mechanism,
    motion: RigidMotion,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    keep: np.ndarray | None = None,
    rigid: np.ndarray | None = None,
) -> Tangent:
    """Return the derivative of `inverse_dynamics` by the coordinates asked for and their rates.

    Args:
        mechanism, motion, q, qd, qdd: as for `inverse_dynamics`; n instants.
        keep: ascending elastic coordinates by which to differentiate; all by default.
        rigid: ascending rigid coordinates (R,), 0 the cart, that have columns and whose forces
            have rows; none by default.
    """
    if 0 < len(q) < FEW:
        few, at, *rates = several(mechanism, motion, q, qd, qdd)
        return linearise(few, at, rates[0], rates[1], rates[2], keep, rigid).window(0, len(q))
    frames, tip = outward_pass(mechanism, motion, q, qd, qdd)
    places = _places(mechanism, keep, rigid)
    motions = _outward_derivatives(frames, motion, places)
    force, moment = np.zeros_like(tip[0]), np.zeros_like(tip[2])
    force_v, moment_v = np.zeros_like(motions[-1][0]), np.zeros_like(motions[-1][2])
    bodies: list[_BodyTangent] = []
    drives = np.empty((len(q), len(places.rigid), 3 * places.size))
    for k in reversed(range(len(frames))):
        part, scale = mechanism.slices[k], mechanism.scale(k)
        frame, chosen = frames[k], places.kept[k]
        if carried := mechanism.carried(k):
            force, moment = force + carried[0] * frame.next_a, moment + carried[1] * frame.next_wd
            next_a_v, next_wd_v = _interface_derivatives(motions[k + 1], places.of_rigid(k + 2))
            force_v = force_v + as_column(carried[0]) * next_a_v
            moment_v = moment_v + as_column(carried[1]) * next_wd_v
        force = frame.joint_rotation * force
        force_v = frame.joint_rotation[:, None] * force_v
        for columns, rotation in _rotating(frame, k, places):
            force_v[:, columns[0]] += 1j * force[:, None] * rotation
        moves = k > 0 or len(places.rigid) > 0
        load = (force_v, moment_v)
        left, right = _coupling(frame, motions[k], load, scale.mass, moves)
        geometric = _geometric(frame, (force, moment), scale.mass)
        rows = slice(len(places.rigid) + part.start, len(places.rigid) + part.stop)
        own = (frame.constants, rows, places.bodies[k], chosen, frame.w, frame.wd, scale)
        bodies.insert(0, _BodyTangent(*own, left, right, geometric))
        if not moves:
            break
        columns = places.of_body(k)
        moment_v = moment_v + (np.conj(frame.d)[:, None] * force_v).imag
        moment_v[:, columns[0]] += (np.conj(frame.B[..., chosen]) * force[:, None]).imag
        force_b, moment_b = _body_load(frame, motions[k], columns, chosen)
        mass = as_column(scale.mass)
        force_v, moment_v = force_v + mass * force_b, moment_v + mass * moment_b
        moment = moment + (np.conj(frame.d) * force).imag + scale.mass * body_moment(frame)
        force = force + scale.mass * body_force(frame)
        drives[:, places.rigid == k + 1] = moment_v[:, None]
    if 0 in places.rigid:
        drives[:, 0] = _cart_force(motion, force, force_v, places)
    own = np.arange(len(places.rigid))
    drives[:, own, 2 * places.size + own] += mechanism.rotors[places.rigid]
    return Tangent(tuple(bodies), places.size, drives)


def _interface_derivatives(
    motion: _FrameDerivatives, joint: _Columns | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return those of an interface's acceleration and angular acceleration, the joint's own less.

    Args:
        motion: of the frame behind it.
        joint: columns of the joint between the two, if it is free.
    """
    a_v, _, wd_v = motion
    if joint is not None:
        wd_v = wd_v.copy()
        wd_v[:, joint[2]] -= 1.0
    return a_v, wd_v


def _rotating(frame: Frame, k: int, places: _Places) -> list[tuple[_Columns, np.ndarray | float]]:
    """Return the columns that rotate the next frame against body k's, and by how much each.

    They are the body's own, by its outboard rotation, and the joint behind it.
    """
    found: list[tuple[_Columns, np.ndarray | float]] = [
        (places.of_body(k), frame.rotation[..., places.kept[k]])
    ]
    joint = places.of_rigid(k + 2)
    return found if joint is None else [*found, (joint, 1.0)]


def _cart_force(
    motion: RigidMotion, force: np.ndarray, force_v: np.ndarray, places: _Places
) -> np.ndarray:
    """Return the derivative (n, 3 S) of the cart's force Re(exp(i angle) F)."""
    rotation = motion.joint_rotations[0]
    out = (rotation[:, None] * force_v).real
    joint = places.of_rigid(1)
    if joint is not None:
        out[:, joint[0]] += (1j * rotation * force).real[:, None]
    return out


def _outward_derivatives(
    frames: list[Frame], motion: RigidMotion, places: _Places
) -> list[_FrameDerivatives]:
    """Return the derivatives of every frame's (a, w, wd), and of the payload's."""
    count, width = len(frames[0].w), 3 * places.size
    a_v, w_v, wd_v = np.zeros((count, width), dtype=complex), *np.zeros((2, count, width))
    cart, joint = places.of_rigid(0), places.of_rigid(1)
    if cart is not None:
        a_v[:, cart[2]] = np.conj(motion.joint_rotations[0])[:, None]
    if joint is not None:
        a_v[:, joint[0]] = -1j * frames[0].a[:, None]
        w_v[:, joint[1]], wd_v[:, joint[2]] = 1.0, 1.0
    motions: list[_FrameDerivatives] = [(a_v, w_v, wd_v)]
    for k, frame in enumerate(frames):
        motions.append(_next_motion(frame, k, places, motions[-1]))
    return motions


def _next_motion(
    frame: Frame, k: int, places: _Places, motion: _FrameDerivatives
) -> _FrameDerivatives:
    """Return the derivatives of (a, w, wd) of the frame behind body k."""
    a_v, w_v, wd_v = motion
    cq, cv, ca = places.of_body(k)
    B = frame.B[..., places.kept[k]]
    w, wd = frame.w[:, None], frame.wd[:, None]
    d, dd = frame.d[:, None], frame.dd[:, None]
    inner = a_v + 1j * d * wd_v + (2j * dd - 2.0 * w * d) * w_v
    inner[:, cq] += (1j * wd - w * w) * B
    inner[:, cv] += 2j * w * B
    inner[:, ca] += B
    next_a = frame.a + (1j * frame.wd - frame.w**2) * frame.d + 2j * frame.w * frame.dd + frame.ddd
    w_v, wd_v = w_v.copy(), wd_v.copy()
    if (bent := frame.bent) is not None:
        ed, edd = bent.qd[..., places.kept[k]], bent.qdd[..., places.kept[k]]
        B_d = as_complex(ed[:, 4], ed[:, 5])
        inner[:, cq] -= 2j * w * B_d + as_complex(edd[:, 4], edd[:, 5])
        inner[:, cv] -= 2.0 * B_d
        w_v[:, cq] -= ed[:, 6]
        wd_v[:, cq] -= edd[:, 6]
        wd_v[:, cv] -= 2.0 * ed[:, 6]
    for (rq, rv, ra), rotation in _rotating(frame, k, places):
        inner[:, rq] -= 1j * next_a[:, None] * rotation
        w_v[:, rv] += rotation
        wd_v[:, ra] += rotation
    return np.conj(frame.joint_rotation)[:, None] * inner, w_v, wd_v


def _coupling(
    frame: Frame,
    motion: _FrameDerivatives,
    load: tuple[np.ndarray, np.ndarray],
    mass: PerInstant,
    moves: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a body feels of the others: factors (n, q, r), (n, r, 3 S); r = 3, or 7."""
    force_v, moment_v = load
    modal = frame.modal
    by = [frame.B.real, frame.B.imag, frame.rotation]
    coupled = [force_v.real, force_v.imag, moment_v]
    if moves:
        a_v, w_v, wd_v = motion
        gyroscopic = modal.pulled(modal.zd @ frame.constants.body.G)
        by_w = -2.0 * (frame.w[:, None] * frame.jM + gyroscopic)
        by += [frame.C.real, frame.C.imag, by_w, frame.rG]
        coupled += [as_column(mass) * x for x in (a_v.real, a_v.imag, w_v, wd_v)]
    left = np.empty((*frame.e.shape, len(by)))
    for i, column in enumerate(by):
        left[:, :, i] = column
    return left, np.stack(coupled, axis=1)


def _body_load(
    frame: Frame,
    motion: _FrameDerivatives,
    columns: _Columns,
    chosen: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (n, 3 S) of one body's own force F and moment T."""
    body, C, modal = frame.constants.body, frame.C[..., chosen], frame.modal
    a_v, w_v, wd_v = motion
    cq, cv, ca = columns
    w, wd = frame.w[:, None], frame.wd[:, None]
    s, sd = frame.s[:, None], frame.sd[:, None]
    force = body.mass * a_v + 1j * s * wd_v + (2j * sd - 2.0 * w * s) * w_v
    force[:, cq] += (1j * wd - w * w) * C
    force[:, cv] += 2j * w * C
    force[:, ca] += C
    spin = 2.0 * np.einsum("nk,nk->n", frame.jM, modal.qd)[:, None]
    moment = (np.conj(s) * a_v).imag + inertia(frame)[:, None] * wd_v + spin * w_v
    moment[:, cq] += (
        (np.conj(C) * frame.a[:, None]).imag
        + 2.0 * wd * frame.jM[:, chosen]
        + 2.0 * w * modal.pulled(modal.zd @ body.M)[:, chosen]
        + modal.pulled(modal.zdd @ body.G)[:, chosen]  # (G z) . zdd = zdd' G z
    )
    moment[:, cv] += 2.0 * w * frame.jM[:, chosen]
    moment[:, ca] += frame.rG[:, chosen]
    if modal.L is not None:
        Mz, zG = modal.z @ body.M, modal.z @ body.G
        by_q = 2.0 * w * modal.rate_by_q(Mz) - modal.second_rate_by_q(zG)
        moment[:, cq] += by_q[:, chosen]
        moment[:, cv] -= 2.0 * modal.rate_by_q(zG)[:, chosen]
    if (bent := frame.bent) is not None:
        K0_ed, K0_edd = bent.qd[..., chosen], bent.qdd[..., chosen]
        C_d = as_complex(K0_ed[:, 0], K0_ed[:, 1])
        force[:, cq] -= 2j * w * C_d + as_complex(K0_edd[:, 0], K0_edd[:, 1])
        force[:, cv] -= 2.0 * C_d
        moment[:, cq] -= 2.0 * w * K0_ed[:, 3] + K0_edd[:, 2]
        moment[:, cv] -= 2.0 * K0_ed[:, 2]
    return force, moment


def _geometric(
    frame: Frame, load: tuple[np.ndarray, np.ndarray], mass: PerInstant
) -> tuple[np.ndarray, ...]:
    """Return what stiffening adds to the rows' derivatives, see `_BodyTangent`.

    -sum_p p K0_p (n, q, q) under the load on the outboard end, and what the modes' inertia makes
    of the second order.
    """
    if frame.bent is None:
        return ()
    p, K0 = load_columns(frame, load), frame.bent.K0
    p[:, :4] *= as_column(mass)
    by_q = -(p @ K0.reshape(len(K0), -1)).reshape(-1, *K0.shape[1:])
    if frame.modal.L is None:
        return (by_q,)
    body, w, wd = frame.constants.body, frame.w[:, None, None], frame.wd[:, None, None]
    by_z, by_zd = wd * body.G - w * w * body.M, 2.0 * w * body.G
    found = frame.modal.tangent(modal_inertia(frame), body.M, by_z, by_zd)
    if isinstance(mass, np.ndarray) or mass != 1.0:
        mass = mass[:, None, None] if isinstance(mass, np.ndarray) else mass
        found = (mass * found[0], mass * found[1], mass * found[2])
    return by_q + found[0], found[1], found[2]
