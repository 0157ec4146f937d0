"""Cart + chain of floating bodies: inverse dynamics and its tangent, batched over instants.

Plane vectors are complex numbers: v = v_x + i v_y, so S v = i v, a rotation by phi multiplies by
exp(i phi), u . v = Re(conj(u) v) and the moment of a force F about the origin of its lever u is
Im(conj(u) F). Every body works in its own tangent frame at its inboard joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from dolfinopt.multibody.motion import FEW, RigidMotion, repeated
from dolfinopt.multibody.shape_integrals import ShapeIntegrals

# One number, or one at each of the n instants that a function is given.
PerInstant = float | np.ndarray


@dataclass(frozen=True, eq=False)
class Scale:
    """What multiplies a body's integrals, its stiffness and its damping."""

    mass: PerInstant = 1.0
    stiffness: PerInstant = 1.0
    damping: PerInstant = 1.0

    def __getitem__(self, part: slice | np.ndarray) -> Scale:
        """Return it at some of the instants."""
        return Scale(*(_at(x, part) for x in (self.mass, self.stiffness, self.damping)))


UNSCALED = Scale()


@dataclass(frozen=True, eq=False)
class ModalConstants:
    """One body's constants in complex form, and tables that serve all instants in one product.

    Attributes:
        body: real constants.
        c: first mass moment, complex.
        C, B: (q,) complex; B is the outboard deflection.
        rotation: (q,) outboard rotation.
        outboard_position: outboard reference point, complex.
        kinematics: (q, 6) real: x and y of C, of B; rotation, 0.
        loads: (7, q) real: x and y of C; r; j; x and y of B; rotation.
        K, D: (q, q), or their diagonals (q,) where there is nothing else; no D, None.
    """

    body: ShapeIntegrals
    c: complex
    C: np.ndarray
    B: np.ndarray
    rotation: np.ndarray
    outboard_position: complex
    kinematics: np.ndarray
    loads: np.ndarray
    K: np.ndarray
    D: np.ndarray | None


def _modal_constants(body: ShapeIntegrals) -> ModalConstants:
    C, (B_x, B_y, rotation) = body.C, body.outboard
    return ModalConstants(
        body=body,
        c=complex(*body.moment),
        C=C[0] + 1j * C[1],
        B=B_x + 1j * B_y,
        rotation=rotation,
        outboard_position=complex(*body.outboard_point),
        kinematics=np.stack([C[0], C[1], B_x, B_y, rotation, np.zeros_like(rotation)], axis=1),
        loads=np.stack([C[0], C[1], body.r, body.j, B_x, B_y, rotation]),
        K=_diagonal_or_matrix(body.K),
        D=_diagonal_or_matrix(body.D) if body.D.any() else None,
    )


def _diagonal_or_matrix(A: np.ndarray) -> np.ndarray:
    """Return the diagonal of a matrix that has nothing else, or the matrix."""
    diagonal = np.diagonal(A)
    return diagonal if np.count_nonzero(A) == np.count_nonzero(diagonal) else A


def _product(x: np.ndarray, A: np.ndarray) -> np.ndarray:
    """Return x A (n, q) of a matrix, or of its diagonal."""
    return x * A if A.ndim == 1 else x @ A


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A cart on a horizontal rail that carries a chain of arms and a payload.

    Payload, gravity and scales may differ from instant to instant: several mechanisms in one.

    Attributes:
        bodies: from the cart outwards.
        payload_mass: point mass at the last outboard interface, kg.
        payload_inertia: its rotary inertia, kg m2.
        gravity: (g_x, g_y), m/s2.
        joint_height: y of the first joint, m.
        scales: of every body's elastic rows, forces and moments, or none.
    """

    bodies: tuple[ShapeIntegrals, ...]
    payload_mass: PerInstant
    payload_inertia: PerInstant
    gravity: tuple[PerInstant, PerInstant]
    joint_height: float
    scales: tuple[Scale, ...] = ()

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Each body's place in the vector of all elastic coordinates."""
        ends = np.cumsum([0, *(body.num_modes for body in self.bodies)])
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @property
    def coordinates(self) -> int:
        """Number N of elastic coordinates of all bodies."""
        return sum(body.num_modes for body in self.bodies)

    @cached_property
    def modal_constants(self) -> tuple[ModalConstants, ...]:
        """Every body's constants as the equations of motion use them."""
        return tuple(_modal_constants(body) for body in self.bodies)

    def __getitem__(self, part: slice | np.ndarray) -> Mechanism:
        """Return it at some of the instants."""
        if not self.scales and not isinstance(self.payload_mass, np.ndarray):
            return self
        mass, inertia = (_at(x, part) for x in (self.payload_mass, self.payload_inertia))
        return replace(
            self,
            payload_mass=mass,
            payload_inertia=inertia,
            gravity=(_at(self.gravity[0], part), _at(self.gravity[1], part)),
            scales=tuple(scale[part] for scale in self.scales),
        )

    def scale(self, k: int) -> Scale:
        """Return that of a body."""
        return self.scales[k] if self.scales else UNSCALED

    def norm(self, q: np.ndarray) -> np.ndarray:
        """Return every body's largest sqrt(q' K q) over n instants (..., bodies); q (..., n, N)."""
        norms = []
        for part, constants in zip(self.slices, self.modal_constants, strict=True):
            e = q[..., part]
            unit = constants.K.ndim == 1 and (constants.K == 1.0).all()
            loads = e if unit else _product(e, constants.K)
            squares = np.einsum("...nk,...nk->...n", loads, e)
            norms.append(np.sqrt(np.maximum(squares, 0.0).max(axis=-1)))
        return np.stack(norms, axis=-1)

    def stiffness(self) -> np.ndarray:
        """Return the block-diagonal stiffness (N, N)."""
        K = np.zeros((self.coordinates, self.coordinates))
        for part, body in zip(self.slices, self.bodies, strict=True):
            K[part, part] = body.K
        return K


def _several(mechanism: Mechanism, motion: RigidMotion, *fields: np.ndarray) -> tuple[Any, ...]:
    """Return the arguments at `FEW` instants, see there: the last one as often as it takes."""
    every = repeated(len(fields[0]))
    return mechanism[every], motion[every], *(x[every] for x in fields)


def _at(x: PerInstant, part: slice | np.ndarray) -> PerInstant:
    return x[part] if isinstance(x, np.ndarray) else x


def _column(x: PerInstant) -> PerInstant:
    """Return what multiplies (n, m) arrays instant by instant."""
    return x[:, None] if isinstance(x, np.ndarray) else x


@dataclass(frozen=True, eq=False)
class _Frame:
    """Motion of one tangent frame and what one body makes of it; arrays over n instants.

    Attributes:
        a: acceleration of the origin less gravity, body components, complex.
        w, wd: angular velocity and acceleration.
        d, dd, ddd: outboard point from the origin and its relative velocity and acceleration.
        s, sd, sdd: first mass moment c + C q and its relative rates.
        joint_rotation: (n,) complex exp(i (theta + joint angle)) from the next frame to this one.
        constants: of the body.
        e: (n, q) its coordinates.
    """

    a: np.ndarray
    w: np.ndarray
    wd: np.ndarray
    d: np.ndarray
    dd: np.ndarray
    ddd: np.ndarray
    s: np.ndarray
    sd: np.ndarray
    sdd: np.ndarray
    joint_rotation: np.ndarray
    constants: ModalConstants
    e: np.ndarray

    @cached_property
    def jM(self) -> np.ndarray:
        """Return j + M q (n, q)."""
        return self.constants.body.j + self.e @ self.constants.body.M

    @cached_property
    def rG(self) -> np.ndarray:
        """Return r + G q (n, q); G is skew: (G q)' = -q' G."""
        return self.constants.body.r - self.e @ self.constants.body.G


def _outward(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> tuple[list[_Frame], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Pass out along the chain; return frames and (a, w, wd) of the payload's frame."""
    gravity = mechanism.gravity[0] + 1j * mechanism.gravity[1]
    joints_d, joints_dd = motion.qd[:, 1:], motion.qdd[:, 1:]
    a = np.conj(motion.swings[0]) * (motion.qdd[:, 0] - gravity)
    w, wd = joints_d[:, 0], joints_dd[:, 0]
    frames: list[_Frame] = []
    last = len(mechanism.bodies) - 1
    for k, (part, constants) in enumerate(
        zip(mechanism.slices, mechanism.modal_constants, strict=True)
    ):
        e = q[:, part]
        # One real product for C q, B q and the rotation: of complex matrices all q would be copied.
        s, d, rotation = (e @ constants.kinematics).view(complex).T
        sd, dd, rotation_d = (qd[:, part] @ constants.kinematics).view(complex).T
        sdd, ddd, rotation_dd = (qdd[:, part] @ constants.kinematics).view(complex).T
        joint_rotation = np.exp(1j * rotation.real)
        if k < last:  # behind the last arm the payload's frame has no joint of its own
            joint_rotation *= motion.swings[k + 1]
        d = constants.outboard_position + d
        frames.append(
            _Frame(a, w, wd, d, dd, ddd, constants.c + s, sd, sdd, joint_rotation, constants, e)
        )
        a = np.conj(joint_rotation) * (a + (1j * wd - w * w) * d + 2j * w * dd + ddd)
        w, wd = w + rotation_d.real, wd + rotation_dd.real
        if k < last:
            w, wd = w + joints_d[:, k + 1], wd + joints_dd[:, k + 1]
    return frames, (a, w, wd)


def inverse_dynamics(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the generalised force of every coordinate by recursive Newton-Euler passes.

    Out along the chain for the frames' motion, back for the forces. With frame acceleration a
    (less gravity), angular velocity w and acceleration wd of a body,
        F = m a + wd S(c + C q) - w^2 (c + C q) + 2 w S C qd + C qdd
        T = (S(c + C q)) . a + (J + 2 j.q + q'M q) wd + 2 w (j + M q).qd + (r + G q).qdd
        f = C'a + (r + G q) wd - w^2 (j + M q) + 2 w G qd + M qdd + K q + D qd
    plus what is attached outboard. Source: Featherstone, Rigid Body Dynamics Algorithms (2008);
    Schwertassek & Wallrapp (1999).

    Args:
        mechanism: N elastic coordinates.
        motion: rigid coordinates at n instants.
        q, qd, qdd: (n, N) elastic coordinates and derivatives.

    Returns:
        Elastic rows (n, N), zero when the equations of motion hold, and the forces of cart and
        joints (n, 1 + arms), N and N m, that drive the rigid coordinates.
    """
    if 0 < len(q) < FEW:
        rows, forces = inverse_dynamics(*_several(mechanism, motion, q, qd, qdd))
        return rows[: len(q)], forces[: len(q)]
    rows, (force, drives) = _inward(mechanism, motion, (q, qd, qdd), driven=True)
    cart = (motion.swings[0] * force).real
    return rows, np.stack([cart, *drives], axis=1)


def elastic_residual(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Return the elastic rows (n, N) of `inverse_dynamics`, without what only drives need."""
    if 0 < len(q) < FEW:
        return elastic_residual(*_several(mechanism, motion, q, qd, qdd))[: len(q)]
    return _inward(mechanism, motion, (q, qd, qdd), driven=False)[0]


_Rates = tuple[np.ndarray, np.ndarray, np.ndarray]


def _inward(
    mechanism: Mechanism, motion: RigidMotion, rates: _Rates, driven: bool
) -> tuple[np.ndarray, tuple[np.ndarray, list[np.ndarray]]]:
    """Pass back along the chain; return the rows, and force and moments if they are asked for."""
    frames, tip = _outward(mechanism, motion, *rates)
    force, moment = mechanism.payload_mass * tip[0], mechanism.payload_inertia * tip[2]
    rows = np.empty_like(rates[0])
    drives: list[np.ndarray] = []
    for k in reversed(range(len(frames))):
        part, frame, scale = mechanism.slices[k], frames[k], mechanism.scale(k)
        own = (rates[0][:, part], rates[1][:, part], rates[2][:, part])
        force = frame.joint_rotation * force  # of everything outboard, in this frame
        rows[:, part] = _body_residual(frame, own, (force, moment), scale)
        if k > 0 or driven:
            moment = (
                moment + (np.conj(frame.d) * force).imag + scale.mass * _body_moment(frame, own)
            )
            force = force + scale.mass * _body_force(frame)
            drives.insert(0, moment)
    return rows, (force, drives)


def _body_residual(
    frame: _Frame, rates: _Rates, load: tuple[np.ndarray, np.ndarray], scale: Scale
) -> np.ndarray:
    """Return one body's elastic rows (n, q) under the load (force, moment) on its outboard end."""
    e, ed, edd = rates
    body, constants = frame.constants.body, frame.constants
    w, wd = frame.w, frame.wd
    load_coefficients = np.empty((len(e), 7))
    columns = (frame.a.real, frame.a.imag, wd, -w * w, load[0].real, load[0].imag, load[1])
    for i, column in enumerate(columns):
        load_coefficients[:, i] = column
    load_coefficients[:, :4] *= _column(scale.mass)
    w, wd = w[:, None], wd[:, None]
    inertial = (edd - (w * w) * e) @ body.M
    inertial -= (wd * e + (2.0 * w) * ed) @ body.G
    if isinstance(scale.mass, np.ndarray) or scale.mass != 1.0:
        inertial *= _column(scale.mass)
    inertial += load_coefficients @ constants.loads
    inertial += _column(scale.stiffness) * _product(e, constants.K)
    if constants.D is not None:
        inertial += _column(scale.damping) * _product(ed, constants.D)
    return inertial


def _body_moment(frame: _Frame, rates: _Rates) -> np.ndarray:
    """Return the moment T (n,) of one body's own inertia about its frame's origin, N m."""
    _, ed, edd = rates
    return (
        (np.conj(frame.s) * frame.a).imag
        + _inertia(frame) * frame.wd
        + 2.0 * frame.w * np.einsum("nk,nk->n", frame.jM, ed)
        + np.einsum("nk,nk->n", frame.rG, edd)
    )


def _inertia(frame: _Frame) -> np.ndarray:
    """Return the deformed body's inertia about its frame's origin (n,), kg m2."""
    body = frame.constants.body
    return body.inertia + np.einsum("nk,nk->n", body.j + frame.jM, frame.e)


def _body_force(frame: _Frame) -> np.ndarray:
    """Return the inertia force F (n,) complex, body components, N."""
    w, body = frame.w, frame.constants.body
    return body.mass * frame.a + (1j * frame.wd - w * w) * frame.s + 2j * w * frame.sd + frame.sdd


@dataclass(frozen=True, eq=False)
class _BodyTangent:
    """One body's elastic rows, differentiated; arrays over n instants, S columns are kept.

    rows' = K q' + D qd' + M (qdd' - w^2 q') + G (wd q' + 2 w qd') + left (right y') with
    y = [q, qd, qdd] of all bodies.

    Attributes:
        constants: its constants.
        rows, columns: its place among all rows and among the kept columns.
        kept: its coordinates that have a column.
        w, wd: of its frame.
        scale: of its constants; not of left and right.
        left: (n, q, r).
        right: (n, r, 3 S).
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

    @property
    def matrices(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return K, D, M, G (q, q)."""
        body = self.constants.body
        return body.K, body.D, body.M, body.G

    def at(self, part: slice) -> _BodyTangent:
        """Return it at some of the instants."""
        names = ("w", "wd", "scale", "left", "right")
        return replace(self, **{name: getattr(self, name)[part] for name in names})

    def factors(self, times: int = 1) -> tuple[PerInstant, ...]:
        """Return what K and M, by q; D and G, by qd; M, by qdd, are multiplied by, as columns.

        (k, m_q, g_q, d, g_v, m): of K and M and G by q, of D and G by qd, of M by qdd.

        Args:
            times: how often every instant is repeated.
        """
        w, wd = np.repeat(self.w, times)[:, None], np.repeat(self.wd, times)[:, None]
        m, k, d = (
            _column(np.repeat(x, times) if isinstance(x, np.ndarray) else x)
            for x in (self.scale.mass, self.scale.stiffness, self.scale.damping)
        )
        return k, -m * w * w, m * wd, d, 2.0 * m * w, m


@dataclass(frozen=True, eq=False)
class Tangent:
    """Derivative of the elastic rows with respect to S coordinates and their rates, n instants.

    An arm feels those inboard of it through the four numbers (a_x, a_y, w, wd) of its frame, and
    those outboard of it through force and moment: block diagonal plus a rank of seven an arm.

    Attributes:
        bodies: from the cart outwards.
        kept: (S,) coordinates that have columns, ascending.
    """

    bodies: tuple[_BodyTangent, ...]
    kept: np.ndarray

    def window(self, first: int, last: int) -> Tangent:
        """Return the instants first..last - 1."""
        return replace(self, bodies=tuple(b.at(slice(first, last)) for b in self.bodies))

    def dense(self) -> np.ndarray:
        """Return the kept coordinates' rows (n, S, 3 S), columns ordered q, qd, qdd."""
        size = len(self.kept)
        jacobian = np.empty((len(self.bodies[0].w), size, 3 * size))
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
        return jacobian

    def times(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, wanted: np.ndarray
    ) -> np.ndarray:
        """Return the change of W wanted rows (m, W) by one of the kept coordinates, each (m, S).

        With m a multiple of the n instants, each of them stands for as many rows in turn.

        Args:
            q, qd, qdd: (m, S).
            wanted: (W,) ascending.
        """
        count = len(self.bodies[0].w)
        times = len(q) // count
        change = np.concatenate([q, qd, qdd], axis=1).reshape(count, times, -1).swapaxes(1, 2)
        out = []
        for part in self.bodies:
            own = wanted[(wanted >= part.rows.start) & (wanted < part.rows.stop)] - part.rows.start
            K, D, M, G = (x[np.ix_(own, part.kept)].T for x in part.matrices)
            k, m_q, g_q, d, g_v, m = part.factors(times)
            e, ed, edd = q[:, part.columns], qd[:, part.columns], qdd[:, part.columns]
            coupled = (part.left[:, own] @ (part.right @ change)).swapaxes(1, 2).reshape(len(q), -1)
            coupled += (m * edd + m_q * e) @ M + (g_q * e + g_v * ed) @ G
            if K.any():  # not of the rows of other coordinates that vibrate by themselves
                coupled += (k * e) @ K
            if D.any():
                coupled += (d * ed) @ D
            out.append(coupled)
        return np.concatenate(out, axis=1)

    def transposed(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradient of sum_n rows_n . (all rows)_n by kept q, qd, qdd, each (n, S)."""
        size = len(self.kept)
        gradient = np.zeros((len(rows), 3 * size))
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
        return by_q, by_v, by_a


def tangent(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Return the derivative of the elastic rows with respect to [q, qd, qdd], see `linearise`.

    Returns:
        (n, N, 3 N), columns ordered q, qd, qdd.
    """
    return linearise(mechanism, motion, q, qd, qdd).dense()


def linearise(
    mechanism: Mechanism,
    motion: RigidMotion,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    keep: np.ndarray | None = None,
) -> Tangent:
    """Return the derivative of the elastic rows with respect to q, qd, qdd.

    Exact, by differentiating both passes of `inverse_dynamics`.

    Args:
        mechanism, motion, q, qd, qdd: as for `inverse_dynamics`.
        keep: ascending coordinates by which to differentiate; all by default.
    """
    if 0 < len(q) < FEW:
        several, at, *rates = _several(mechanism, motion, q, qd, qdd)
        return linearise(several, at, rates[0], rates[1], rates[2], keep).window(0, len(q))
    keep = np.arange(mechanism.coordinates) if keep is None else keep
    frames, tip = _outward(mechanism, motion, q, qd, qdd)
    ends = np.searchsorted(keep, [0, *(part.stop for part in mechanism.slices)])
    places = [slice(a, b) for a, b in pairwise(ends)]
    kept = [keep[p] - part.start for p, part in zip(places, mechanism.slices, strict=True)]
    motions = [_prescribed(len(q), 3 * len(keep))]
    for frame, place, chosen in zip(frames, places, kept, strict=True):
        columns = _columns(place, len(keep))
        motions.append(_next_motion(frame, columns, chosen, motions[-1]))
    tip_v, _, rotation_v = motions[-1]
    force, force_v = mechanism.payload_mass * tip[0], _column(mechanism.payload_mass) * tip_v
    moment_v = _column(mechanism.payload_inertia) * rotation_v
    bodies: list[_BodyTangent] = []
    for k in reversed(range(len(frames))):
        part, frame, chosen = mechanism.slices[k], frames[k], kept[k]
        constants = frame.constants
        rates = (q[:, part], qd[:, part], qdd[:, part])
        columns = _columns(places[k], len(keep))
        force = frame.joint_rotation * force
        force_v = frame.joint_rotation[:, None] * force_v
        force_v[:, columns[0]] += 1j * force[:, None] * constants.rotation[chosen]
        scale = mechanism.scale(k)
        load = (force_v, moment_v)
        left, right = _coupling(frame, motions[k], rates[1], load, scale.mass, k > 0)
        own = (constants, part, places[k], chosen, frame.w, frame.wd, scale)
        bodies.insert(0, _BodyTangent(*own, left, right))
        if k == 0:
            break
        moment_v = moment_v + (np.conj(frame.d)[:, None] * force_v).imag
        moment_v[:, columns[0]] += (np.conj(constants.B[chosen]) * force[:, None]).imag
        force_b, moment_b = _body_load(frame, motions[k], columns, chosen, rates)
        mass = _column(scale.mass)
        force_v, moment_v = force_v + mass * force_b, moment_v + mass * moment_b
        force = force + scale.mass * _body_force(frame)
    return Tangent(tuple(bodies), keep)


_FrameDerivatives = tuple[np.ndarray, np.ndarray, np.ndarray]  # of (a, w, wd), each (n, 3 S)
_Columns = tuple[slice, slice, slice]


def _prescribed(count: int, width: int) -> _FrameDerivatives:
    """Return the derivatives of a frame's motion that is prescribed."""
    zero = np.zeros((count, width))
    return zero.astype(complex), zero, zero


def _coupling(
    frame: _Frame,
    motion: _FrameDerivatives,
    ed: np.ndarray,
    load: tuple[np.ndarray, np.ndarray],
    mass: PerInstant,
    moves: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a body feels of the others: factors (n, q, r), (n, r, 3 S); r = 3, or 7."""
    force_v, moment_v = load
    constants = frame.constants
    by = [constants.B.real, constants.B.imag, constants.rotation]
    coupled = [force_v.real, force_v.imag, moment_v]
    if moves:
        a_v, w_v, wd_v = motion
        by_w = -2.0 * (frame.w[:, None] * frame.jM + ed @ constants.body.G)
        by += [constants.C.real, constants.C.imag, by_w, frame.rG]
        coupled += [_column(mass) * x for x in (a_v.real, a_v.imag, w_v, wd_v)]
    left = np.empty((*ed.shape, len(by)))
    for i, column in enumerate(by):
        left[:, :, i] = column
    return left, np.stack(coupled, axis=1)


def _columns(part: slice, size: int) -> _Columns:
    """Return a body's columns in [q, qd, qdd]."""
    a, b = part.start, part.stop
    return slice(a, b), slice(size + a, size + b), slice(2 * size + a, 2 * size + b)


def _next_motion(
    frame: _Frame, columns: _Columns, chosen: np.ndarray, motion: _FrameDerivatives
) -> _FrameDerivatives:
    """Return the derivatives of the next frame's (a, w, wd)."""
    a_v, w_v, wd_v = motion
    cq, cv, ca = columns
    B, rotation = frame.constants.B[chosen], frame.constants.rotation[chosen]
    w, wd = frame.w[:, None], frame.wd[:, None]
    d, dd = frame.d[:, None], frame.dd[:, None]
    inner = a_v + 1j * d * wd_v + (2j * dd - 2.0 * w * d) * w_v
    inner[:, cq] += (1j * wd - w * w) * B
    inner[:, cv] += 2j * w * B
    inner[:, ca] += B
    next_a = frame.a + (1j * frame.wd - frame.w**2) * frame.d + 2j * frame.w * frame.dd + frame.ddd
    inner[:, cq] -= 1j * next_a[:, None] * rotation
    out = np.conj(frame.joint_rotation)[:, None] * inner
    w_v, wd_v = w_v.copy(), wd_v.copy()
    w_v[:, cv] += rotation
    wd_v[:, ca] += rotation
    return out, w_v, wd_v


def _body_load(
    frame: _Frame,
    motion: _FrameDerivatives,
    columns: _Columns,
    chosen: np.ndarray,
    rates: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (n, 3 S) of one body's own force F and moment T."""
    body, C = frame.constants.body, frame.constants.C[chosen]
    _, ed, edd = rates
    a_v, w_v, wd_v = motion
    cq, cv, ca = columns
    w, wd = frame.w[:, None], frame.wd[:, None]
    s, sd = frame.s[:, None], frame.sd[:, None]
    force = body.mass * a_v + 1j * s * wd_v + (2j * sd - 2.0 * w * s) * w_v
    force[:, cq] += (1j * wd - w * w) * C
    force[:, cv] += 2j * w * C
    force[:, ca] += C
    spin = 2.0 * np.einsum("nk,nk->n", frame.jM, ed)[:, None]
    moment = (np.conj(s) * a_v).imag + _inertia(frame)[:, None] * wd_v + spin * w_v
    moment[:, cq] += (
        (np.conj(C) * frame.a[:, None]).imag
        + 2.0 * wd * frame.jM[:, chosen]
        + 2.0 * w * (ed @ body.M[:, chosen])
        + edd @ body.G[:, chosen]  # (G q) . qdd = qdd' G q
    )
    moment[:, cv] += 2.0 * w * frame.jM[:, chosen]
    moment[:, ca] += frame.rG[:, chosen]
    return force, moment


def end_effector(mechanism: Mechanism, motion: RigidMotion, q: np.ndarray) -> np.ndarray:
    """Return the end-effector's position (n, 2), m, of the flexible mechanism."""
    if 0 < len(q) < FEW:
        return end_effector(*_several(mechanism, motion, q))[: len(q)]
    place = motion.q[:, 0] + 1j * mechanism.joint_height
    joint_rotation = np.ones(len(q), dtype=complex)
    for k, (part, constants) in enumerate(
        zip(mechanism.slices, mechanism.modal_constants, strict=True)
    ):
        joint_rotation = joint_rotation * np.exp(1j * motion.q[:, k + 1])
        place = place + joint_rotation * (constants.outboard_position + q[:, part] @ constants.B)
        joint_rotation = joint_rotation * np.exp(1j * (q[:, part] @ constants.rotation))
    return np.stack([place.real, place.imag], axis=1)


def deviation(mechanism: Mechanism, motion: RigidMotion, q: np.ndarray) -> np.ndarray:
    """Return the flexible minus the equivalent rigid end-effector (n, 2), m.

    Source: Seifried, Moghadasi & Held (2015), eq. (6), doi:10.1016/j.piutam.2015.01.018.
    """
    rigid = end_effector(mechanism, motion, np.zeros_like(q))
    return end_effector(mechanism, motion, q) - rigid


def end_effector_gradient(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the gradient of sum_n weights_n . end_effector_n.

    Args:
        mechanism, motion, q: as for `end_effector`, n instants.
        weights: (n, 2).

    Returns:
        By q (n, N), and by every body's outboard modes (3, q).
    """
    if 0 < len(q) < FEW:
        several = _several(mechanism, motion, q, weights)
        several[-1][len(q) :] = 0.0
        by_several, by_bodies = end_effector_gradient(*several)
        return by_several[: len(q)], by_bodies
    w = weights[:, 0] + 1j * weights[:, 1]
    rotations, levers = [], []
    joint_rotation = np.ones(len(q), dtype=complex)
    for k, (part, constants) in enumerate(
        zip(mechanism.slices, mechanism.modal_constants, strict=True)
    ):
        joint_rotation = joint_rotation * np.exp(1j * motion.q[:, k + 1])
        rotations.append(joint_rotation)
        levers.append(joint_rotation * (constants.outboard_position + q[:, part] @ constants.B))
        joint_rotation = joint_rotation * np.exp(1j * (q[:, part] @ constants.rotation))
    by_q = np.empty_like(q)
    by_outboard: list[np.ndarray] = []
    beyond = np.zeros(len(q), dtype=complex)  # from this arm's outboard point to the end
    for k in reversed(range(len(rotations))):
        part, constants = mechanism.slices[k], mechanism.modal_constants[k]
        place = np.conj(rotations[k]) * w
        rotation = (np.conj(w) * 1j * beyond).real
        by_q[:, part] = (
            np.outer(place.real, constants.B.real)
            + np.outer(place.imag, constants.B.imag)
            + np.outer(rotation, constants.rotation)
        )
        rows = [weight @ q[:, part] for weight in (place.real, place.imag, rotation)]
        by_outboard.insert(0, np.stack(rows))
        beyond = beyond + levers[k]
    return by_q, by_outboard


def compliance(
    bodies: Sequence[ShapeIntegrals], parts: Sequence[slice], q: np.ndarray
) -> np.ndarray:
    """Return q_e' K_ee q_e of every arm (n, arms), N m; eq. (7) of the paper."""
    return np.stack(
        [
            np.einsum("nk,nk->n", q[:, part] @ body.K, q[:, part])
            for part, body in zip(parts, bodies, strict=True)
        ],
        axis=1,
    )


# -- adjoint ---------------------------------------------------------------------------------


def body_gradient(
    mechanism: Mechanism,
    motion: RigidMotion,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    multipliers: np.ndarray,
) -> list[ShapeIntegrals]:
    """Return d(sum_n multipliers_n . rows_n) / d(constants) of every body, motion held.

    The multipliers are a virtual displacement of the elastic coordinates: the sum is the virtual
    work of all inertia and elastic forces, linear in every shape integral. Only the outboard
    interface enters through the kinematics, too; its gradient comes from a pass back along the
    chain that carries the derivatives with respect to the frames' motion beside the forces.

    Args:
        mechanism, motion, q, qd, qdd: as for `inverse_dynamics`; n instants.
        multipliers: (n, N).
    """
    if 0 < len(q) < FEW:
        several = _several(mechanism, motion, q, qd, qdd, multipliers)
        several[-1][len(q) :] = 0.0
        return body_gradient(*several)
    frames, tip = _outward(mechanism, motion, q, qd, qdd)
    moves, (tip_p, tip_rotation) = _virtual_motion(mechanism, frames, multipliers)
    outer = _Outer(
        force=mechanism.payload_mass * tip[0],
        moment=mechanism.payload_inertia * tip[2],
        a=mechanism.payload_mass * tip_p,
        w=np.zeros_like(tip_rotation),
        wd=mechanism.payload_inertia * tip_rotation,
        next_a=tip[0],
        next_p=tip_p,
    )
    gradient: list[ShapeIntegrals] = []
    for k in reversed(range(len(frames))):
        part = mechanism.slices[k]
        rates = (q[:, part], qd[:, part], qdd[:, part])
        virtual = (*moves[k], multipliers[:, part])
        outboard, outer = _outboard_gradient(frames[k], rates, virtual, outer)
        gradient.insert(0, _integral_gradient(frames[k], rates, virtual, outboard))
        outer = _with_body(frames[k], rates, virtual, outer)
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
    mechanism: Mechanism, frames: list[_Frame], multipliers: np.ndarray
) -> tuple[list[tuple[np.ndarray, np.ndarray]], tuple[np.ndarray, np.ndarray]]:
    """Return every frame's virtual displacement (complex, its components) and rotation."""
    p = np.zeros(len(multipliers), dtype=complex)
    rotation = np.zeros(len(multipliers))
    moves = []
    for part, frame in zip(mechanism.slices, frames, strict=True):
        constants = frame.constants
        moves.append((p, rotation))
        p = np.conj(frame.joint_rotation) * (
            p + 1j * rotation * frame.d + multipliers[:, part] @ constants.B
        )
        rotation = rotation + multipliers[:, part] @ constants.rotation
    return moves, (p, rotation)


def _outboard_gradient(
    frame: _Frame, rates: _Rates, virtual: _Rates, outer: _Outer
) -> tuple[np.ndarray, _Outer]:
    """Return the gradient (3, q) of the outboard modes and `outer` brought into this frame."""
    q, qd, qdd = rates
    _, rotation, multipliers = virtual
    w = frame.w
    kappa = 1j * frame.wd - w * w
    force, a = frame.joint_rotation * outer.force, frame.joint_rotation * outer.a
    d = a * np.conj(kappa) - 1j * rotation * force
    phi = (np.conj(outer.a) * -1j * outer.next_a).real
    phi += (np.conj(outer.force) * -1j * outer.next_p).real
    place = d @ q + (-2j * w * a) @ qd + a @ qdd + force @ multipliers
    rotation = phi @ q + outer.w @ qd + outer.wd @ qdd + outer.moment @ multipliers
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
    return np.stack([place.real, place.imag, rotation]), inner


def _integral_gradient(
    frame: _Frame, rates: _Rates, virtual: _Rates, outboard: np.ndarray
) -> ShapeIntegrals:
    """Return the gradient of one body's virtual work by its shape integrals."""
    q, qd, _ = rates
    p, rotation, multipliers = virtual
    eta, eta_d, eta_dd, virtual_eta = (
        np.insert(x, 0, first, axis=1)
        for x, first in zip((*rates, multipliers), (1.0, 0.0, 0.0, 0.0))
    )
    w, wd = frame.w[:, None], frame.wd[:, None]
    radial = eta_dd - w * w * eta  # of a point's acceleration, in N
    around = wd * eta + 2.0 * w * eta_d  # in S N
    rotated_eta = rotation[:, None] * eta
    kappa = 1j * frame.wd - frame.w * frame.w
    moment = p * np.conj(kappa) - 1j * rotation * frame.a
    by_w = moment @ eta + (p * -2j * frame.w) @ eta_d + p @ eta_dd + frame.a @ virtual_eta
    return ShapeIntegrals(
        mass=float((np.conj(p) * frame.a).real.sum()),
        w=np.stack([by_w.real, by_w.imag]),
        W=np.stack(
            [
                virtual_eta.T @ radial + rotated_eta.T @ around,
                virtual_eta.T @ around + (rotation[:, None] * radial).T @ eta,
            ]
        ),
        K=multipliers.T @ q,
        D=multipliers.T @ qd,
        outboard=outboard,
        outboard_point=np.zeros(2),
    )


def _with_body(frame: _Frame, rates: _Rates, virtual: _Rates, outer: _Outer) -> _Outer:
    """Add one body's own force and gradient to what lies outboard of it."""
    body, constants = frame.constants.body, frame.constants
    _, qd, qdd = rates
    p, rotation, multipliers = virtual
    w = frame.w
    spin = np.einsum("nk,nk->n", frame.jM, qd)
    gyro = -2.0 * w[:, None] * frame.jM - 2.0 * (qd @ body.G)
    return _Outer(
        force=outer.force + _body_force(frame),
        moment=outer.moment
        + (np.conj(frame.s) * frame.a).imag
        + _inertia(frame) * frame.wd
        + 2.0 * w * spin
        + np.einsum("nk,nk->n", frame.rG, qdd),
        a=outer.a + body.mass * p + 1j * frame.s * rotation + multipliers @ constants.C,
        w=outer.w
        + (np.conj(p) * (2j * frame.sd - 2.0 * w * frame.s)).real
        + 2.0 * spin * rotation
        + np.einsum("nk,nk->n", gyro, multipliers),
        wd=outer.wd
        + (np.conj(p) * 1j * frame.s).real
        + _inertia(frame) * rotation
        + np.einsum("nk,nk->n", frame.rG, multipliers),
        next_a=outer.next_a,
        next_p=outer.next_p,
    )
