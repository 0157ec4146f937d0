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

from dolfinopt.multibody.inverse_dynamics import (
    Frame,
    along,
    as_complex,
    body_force,
    body_moment,
    inertia,
    load_columns,
    modal_inertia,
    outward_pass,
)
from dolfinopt.multibody.mechanism import (
    FEW,
    Mechanism,
    ModalConstants,
    PerInstant,
    Scale,
    as_column,
    several,
)
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals

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


# -- vector-Jacobian product of inverse dynamics with the shape integrals of every body ----------
#
# The multipliers are a virtual displacement: their sum of products with forces and residual is the
# virtual work of all inertia and elastic forces, linear in every shape integral. Only the outboard
# interface enters through the kinematics, too; its gradient comes from a pass back along the chain
# that carries the derivatives with respect to the frames' motion beside the forces.


def body_gradient(
    mechanism: Mechanism,
    motion: RigidMotion,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    multipliers: np.ndarray,
    of_forces: np.ndarray | None = None,
) -> list[ShapeIntegrals]:
    """Return the derivative of sum_n multipliers_n . residual_n + of_forces_n . forces_n.

    Args:
        mechanism, motion, q, qd, qdd: as for `inverse_dynamics`, n instants; held.
        multipliers: (n, N) of the elastic residual.
        of_forces: (n, 1 + arms) of the forces of cart and joints; none by default.

    Returns:
        The derivative by every body's shape integrals.
    """
    if of_forces is None:
        of_forces = np.zeros((len(q), 1 + len(mechanism.bodies)))
    if 0 < len(q) < FEW:
        few = several(mechanism, motion, q, qd, qdd, multipliers, of_forces)
        few[-2][len(q) :] = few[-1][len(q) :] = 0.0
        return body_gradient(*few)
    frames, tip = outward_pass(mechanism, motion, q, qd, qdd)
    first = np.conj(motion.joint_rotations[0]) * of_forces[:, 0]
    moves, ends = _virtual_motion(mechanism, frames, multipliers, first, of_forces[:, 1:])
    none, zero = np.zeros_like(tip[0]), np.zeros_like(tip[2])
    outer = _Outer(none, zero, none, zero, zero, next_a=tip[0], next_p=ends[-1][0])
    gradient: list[ShapeIntegrals] = []
    for k in reversed(range(len(frames))):
        part = mechanism.slices[k]
        rates = (q[:, part], qd[:, part], qdd[:, part])
        virtual = (*moves[k], multipliers[:, part])
        if carried := mechanism.carried(k):
            outer = _with_carried(frames[k], ends[k], carried, outer)
        outboard, outer = _outboard_gradient(frames[k], rates, virtual, outer)
        gradient.insert(0, _integral_gradient(frames[k], rates, virtual, *outboard))
        outer = _with_body(frames[k], virtual, outer)
    return gradient


@dataclass(frozen=True, eq=False)
class _Outer:
    """Everything from one frame outwards, as seen in it: forces and gradient of the virtual work.

    Attributes:
        force, moment: of the bodies outboard; also the gradient by the frame's virtual motion.
        a, w, wd: gradient by the frame's acceleration (complex), angular velocity, acceleration.
        next_a, next_p: the frame's own acceleration and virtual displacement.
    """

    force: np.ndarray
    moment: np.ndarray
    a: np.ndarray
    w: np.ndarray
    wd: np.ndarray
    next_a: np.ndarray
    next_p: np.ndarray


def _virtual_motion(
    mechanism: Mechanism,
    frames: list[Frame],
    multipliers: np.ndarray,
    first: np.ndarray,
    joints: np.ndarray,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], list[tuple[np.ndarray, np.ndarray]]]:
    """Return every frame's virtual displacement (complex, its components) and rotation.

    And the same of every outboard interface, in the components of the next frame.

    Args:
        mechanism, frames: as they move.
        multipliers: (n, N) virtual elastic coordinates.
        first: (n,) virtual displacement of the first joint, complex, in the first frame.
        joints: (n, arms) virtual rotations of the joints.
    """
    p, rotation = first, np.zeros(len(multipliers))
    moves, ends = [], []
    for k, (part, frame) in enumerate(zip(mechanism.slices, frames, strict=True)):
        rotation = rotation + joints[:, k]
        moves.append((p, rotation))
        p = np.conj(frame.joint_rotation) * (
            p + 1j * rotation * frame.d + along(multipliers[:, part], frame.B)
        )
        rotation = rotation + along(multipliers[:, part], frame.rotation)
        ends.append((p, rotation))
    return moves, ends


def _with_carried(
    frame: Frame,
    end: tuple[np.ndarray, np.ndarray],
    carried: tuple[PerInstant, PerInstant],
    outer: _Outer,
) -> _Outer:
    """Add force and gradient of mass and inertia at a body's outboard interface."""
    (p, rotation), (mass, rotary) = end, carried
    return replace(
        outer,
        force=outer.force + mass * frame.next_a,
        moment=outer.moment + rotary * frame.next_wd,
        a=outer.a + mass * p,
        wd=outer.wd + rotary * rotation,
    )


def _outboard_gradient(
    frame: Frame, rates: Rates, virtual: Rates, outer: _Outer
) -> tuple[tuple[np.ndarray, np.ndarray], _Outer]:
    """Return the gradient of the outboard modes and K0, and `outer` brought into this frame."""
    _, rotation, multipliers = virtual
    w = frame.w
    kappa = 1j * frame.wd - w * w
    force, a = frame.joint_rotation * outer.force, frame.joint_rotation * outer.a
    d = a * np.conj(kappa) - 1j * rotation * force
    phi = (np.conj(outer.a) * -1j * outer.next_a).real
    phi += (np.conj(outer.force) * -1j * outer.next_p).real
    weights = (
        _Weights(d.real, (-2j * w * a).real, a.real, force.real),
        _Weights(d.imag, (-2j * w * a).imag, a.imag, force.imag),
        _Weights(phi, outer.w, outer.wd, outer.moment),
    )
    modes = np.stack([one.linear(rates, multipliers) for one in weights])
    K0 = _by_K0(frame, weights, multipliers)
    inner = _Outer(
        force=force,
        moment=outer.moment + (np.conj(frame.d) * force).imag,
        a=a,
        w=outer.w + (np.conj(a) * (2j * frame.dd - 2.0 * w * frame.d)).real,
        wd=outer.wd + (np.conj(a) * 1j * frame.d).real,
        next_a=frame.a,
        next_p=virtual[0],
    )
    # The virtual work of the outboard force on a turned lever is part of d above.
    return (modes, K0), inner


@dataclass(frozen=True, eq=False)
class _Weights:
    """Derivatives (n,) of the virtual work by a quantity of the modes, its rates and variation.

    The quantity is C . q - 1/2 q'K0 q.
    """

    value: np.ndarray
    rate: np.ndarray
    second: np.ndarray
    virtual: np.ndarray

    def linear(self, rates: Rates, multipliers: np.ndarray) -> np.ndarray:
        """Return the derivative (q,) by C."""
        q, qd, qdd = rates
        return self.value @ q + self.rate @ qd + self.second @ qdd + self.virtual @ multipliers


def _by_K0(frame: Frame, weights: tuple[_Weights, ...], multipliers: np.ndarray) -> np.ndarray:
    """Return the derivatives by K0 (k, q, q); (0, q, q) of a linear body.

    Of -1/2 q'K0 q, its rates and its variation; their symmetric part counts.
    """
    size = multipliers.shape[1]
    if frame.bent is None:
        return np.zeros((0, size, size))
    x = np.concatenate([frame.bent.rates, multipliers.T[None]])
    y = np.array([[one.value, one.rate, one.second, one.virtual] for one in weights])
    y[:, 0] *= 0.5
    other = np.einsum("pdn,dkn->pkn", y, x)
    squares = y[:, 2, None] * x[1]
    by_K0 = x[0] @ other.swapaxes(1, 2) + x[1] @ squares.swapaxes(1, 2)
    return np.negative(by_K0, out=by_K0)


def _integral_gradient(
    frame: Frame, rates: Rates, virtual: Rates, outboard: np.ndarray, K0_outboard: np.ndarray
) -> ShapeIntegrals:
    """Return the gradient of one body's virtual work by its shape integrals."""
    q, qd, _ = rates
    p, rotation, multipliers = virtual
    modal = frame.modal
    etas = _augmented(rates, multipliers)
    eta, eta_d, eta_dd, virtual_eta = etas
    kappa = 1j * frame.wd - frame.w * frame.w
    moment = p * np.conj(kappa) - 1j * rotation * frame.a
    by_w = moment @ eta + (p * -2j * frame.w) @ eta_d + p @ eta_dd + frame.a @ virtual_eta
    W = _by_second_moments(frame, rotation, etas)
    along_modes = np.zeros_like(frame.constants.body.along_modes)
    if modal.L is not None:
        along = _augmented((modal.z, modal.zd, modal.zdd), modal.pushed(multipliers))
        W[:, 1:, 1:] = _by_second_moments(frame, rotation, along)[:, 1:, 1:]
        by, forces = _by_modal_displacement(frame, virtual), modal_inertia(frame)
        along_modes = modal.gradient(by, forces, multipliers)
    return ShapeIntegrals(
        mass=float((np.conj(p) * frame.a).real.sum()),
        w=np.stack([by_w.real, by_w.imag]),
        W=W,
        K=multipliers.T @ q,
        D=multipliers.T @ qd,
        outboard=outboard,
        outboard_point=np.zeros(2),
        further_points=np.zeros((0, 2)),
        K0=_by_geometric_stiffness(frame, virtual),
        K0_outboard=K0_outboard,
        along_modes=along_modes,
    )


_Etas = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _augmented(rates: Rates, multipliers: np.ndarray) -> _Etas:
    """Return (1, q), its rates and its variation, (n, 1 + q) each."""
    pairs = zip((*rates, multipliers), (1.0, 0.0, 0.0, 0.0), strict=True)
    q, qd, qdd, virtual = (np.insert(x, 0, first, axis=1) for x, first in pairs)
    return q, qd, qdd, virtual


def _by_second_moments(frame: Frame, rotation: np.ndarray, etas: _Etas) -> np.ndarray:
    """Return the gradient of the virtual work by W (2, 1 + q, 1 + q)."""
    eta, eta_d, eta_dd, virtual_eta = etas
    w, wd = frame.w[:, None], frame.wd[:, None]
    radial = eta_dd - w * w * eta  # of a point's acceleration, in N
    around = wd * eta + 2.0 * w * eta_d  # in S N
    rotated_eta = rotation[:, None] * eta
    return np.stack(
        [
            virtual_eta.T @ radial + rotated_eta.T @ around,
            virtual_eta.T @ around + (rotation[:, None] * radial).T @ eta,
        ]
    )


def _by_modal_displacement(frame: Frame, virtual: Rates) -> Rates:
    """Return the gradient of the virtual work by z, zd and zdd (n, q)."""
    modal, body = frame.modal, frame.constants.body
    _, rotation, multipliers = virtual
    w, wd, phi = frame.w[:, None], frame.wd[:, None], rotation[:, None]
    zeta, M, G = modal.pushed(multipliers), body.M, body.G
    by_z = phi * (2.0 * (wd * modal.z + w * modal.zd) @ M + modal.zdd @ G)
    by_z += wd * (zeta @ G) - w * w * (zeta @ M)
    by_zd = 2.0 * w * (phi * (modal.z @ M) + zeta @ G)
    return by_z, by_zd, zeta @ M - phi * (modal.z @ G)


def _by_geometric_stiffness(frame: Frame, virtual: Rates) -> np.ndarray:
    """Return the gradient (4, q, q) by the geometric stiffness of a_x, a_y, wd and -w^2."""
    p, rotation, multipliers = virtual
    w, wd, a = frame.w, frame.wd, frame.a
    by_s = p * np.conj(1j * wd - w * w) - 1j * rotation * a
    by_sd = -2j * w * p
    zero = np.zeros_like(w)
    weights = (
        _Weights(by_s.real, by_sd.real, p.real, a.real),
        _Weights(by_s.imag, by_sd.imag, p.imag, a.imag),
        _Weights(zero, zero, rotation, wd),  # the angular momentum of the relative motion
        _Weights(2.0 * rotation * wd, 2.0 * rotation * w, zero, -w * w),  # half the inertia
    )
    return _by_K0(frame, weights, multipliers)


def _with_body(frame: Frame, virtual: Rates, outer: _Outer) -> _Outer:
    """Add one body's own force and gradient to what lies outboard of it."""
    body, modal = frame.constants.body, frame.modal
    p, rotation, multipliers = virtual
    w = frame.w
    spin = np.einsum("nk,nk->n", frame.jM, modal.qd)
    gyro = -2.0 * w[:, None] * frame.jM - 2.0 * modal.pulled(modal.zd @ body.G)
    return _Outer(
        force=outer.force + body_force(frame),
        moment=outer.moment + body_moment(frame),
        a=outer.a + body.mass * p + 1j * frame.s * rotation + along(multipliers, frame.C),
        w=outer.w
        + (np.conj(p) * (2j * frame.sd - 2.0 * w * frame.s)).real
        + 2.0 * spin * rotation
        + np.einsum("nk,nk->n", gyro, multipliers),
        wd=outer.wd
        + (np.conj(p) * 1j * frame.s).real
        + inertia(frame) * rotation
        + np.einsum("nk,nk->n", frame.rG, multipliers),
        next_a=outer.next_a,
        next_p=outer.next_p,
    )
