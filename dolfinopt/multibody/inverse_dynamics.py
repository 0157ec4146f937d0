"""Recursive Newton-Euler: the forces of cart and joints, and the elastic residual, of a motion.

One pass out along the chain for positions, velocities and accelerations of every frame, one back
for forces and moments; all arrays run over n instants. With frame acceleration a (less gravity),
angular velocity w and acceleration wd of a body,
    F = m a + wd S(c + C q) - w^2 (c + C q) + 2 w S C qd + C qdd
    T = (S(c + C q)) . a + (J + 2 j.q + q'M q) wd + 2 w (j + M q).qd + (r + G q).qdd
    f = C'a + (r + G q) wd - w^2 (j + M q) + 2 w G qd + M qdd + K q + D qd
plus what is attached outboard. Source: Featherstone, Rigid Body Dynamics Algorithms (2008);
Schwertassek & Wallrapp (1999).

A body with geometric stiffness K0_p by the loads p = (a_x, a_y, wd, -w^2, F_x, F_y, T) deforms in
the second order, too: whatever these loads do work on loses 1/2 q'K0_p q, and its derivative by q
loses K0_p q. That is c + C q for a, the outboard displacement and rotation for F and T; and
j + M q loses K0 q of -w^2, r + G q that of wd. The residual gains -p . K0 q by the same rule. In
the terms with M and G the place of q is taken by z, see `modal_displacement`, and their forces come
to the rows through dz/dq.
Source: Wallrapp & Schwertassek (1991), doi:10.1002/nme.1620320818.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dolfinopt.multibody.end_effector import interface_place
from dolfinopt.multibody.mechanism import (
    FEW,
    INTERFACE,
    Closure,
    Mechanism,
    ModalConstants,
    Scale,
    as_column,
    product,
    several,
)
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ModalDisplacement, Rates, ShapeIntegrals, rigid_part

# Up to so many modes their products two by two are cheaper than a sum for each load.
FEW_MODES = 8


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """Deformation of the second order by each of the seven loads; arrays over n instants.

    Attributes:
        K0: (7, q, q).
        rates: (3, q, n) the coordinates, qd, qdd.
        changes: (3, n, 6) -1/2 q'K0_p q and its time derivatives in the columns of
            `ModalConstants.kinematics`: p = a_x, a_y, F_x, F_y, T; 0.
    """

    K0: np.ndarray
    rates: np.ndarray
    changes: np.ndarray

    @cached_property
    def q(self) -> np.ndarray:
        """K0_p times the coordinates (n, 7, q), in memory with the instants last."""
        loads, q, _ = self.K0.shape
        found = self.K0.reshape(loads * q, q) @ self.rates[0]
        return found.reshape(loads, q, -1).transpose(2, 0, 1)

    @cached_property
    def qd(self) -> np.ndarray:
        """K0_p qd (n, 7, q)."""
        return self._by_instant(self.rates[1])

    @cached_property
    def qdd(self) -> np.ndarray:
        """K0_p qdd (n, 7, q)."""
        return self._by_instant(self.rates[2])

    def _by_instant(self, x: np.ndarray) -> np.ndarray:
        loads, q, _ = self.K0.shape
        return (x.T @ self.K0.transpose(1, 0, 2).reshape(q, -1)).reshape(-1, loads, q)

    @property
    def spin(self) -> np.ndarray:
        """qd'K0_p qd of the angular acceleration wd (n,)."""
        qd = self.rates[1]
        return np.einsum("kn,kn->n", self.K0[2] @ qd, qd)

    def of_loads(self, loads: np.ndarray) -> np.ndarray:
        """Return sum_p loads_p K0_p q (n, q) for loads (n, 7)."""
        by_load = np.ascontiguousarray(loads.T)
        return np.einsum("pn,pkn->kn", by_load, self.q.transpose(1, 2, 0)).T


def _second_order(constants: ModalConstants, rates: Rates) -> SecondOrder:
    """Return it, with the instants last: NumPy then runs along them, not along few coordinates."""
    K0 = constants.K0
    assert K0 is not None
    x = np.stack([np.ascontiguousarray(one.T) for one in rates])
    _, q, count = x.shape
    if q > FEW_MODES:
        forces = (K0[INTERFACE].reshape(-1, q) @ x[:2]).reshape(2, -1, q, count)
        changes = np.zeros((3, count, 6))
        changes[:, :, :5] = -np.einsum("pkn,dkn->dnp", forces[0], x)
        changes[2, :, :5] -= np.einsum("pkn,kn->np", forces[1], x[1])
        changes[0] *= 0.5
        return SecondOrder(K0, x, changes)
    products = np.empty((3, q, q, count))
    np.multiply(x[0][:, None], x[:, None], out=products)
    products[2] += x[1][:, None] * x[1]
    changes = products.reshape(3, q * q, count).swapaxes(1, 2) @ constants.second_order
    return SecondOrder(K0, x, changes)


@dataclass(frozen=True, eq=False)
class Frame:
    """Motion of one tangent frame and what one body makes of it; arrays over n instants.

    Attributes:
        a: acceleration of the origin less gravity, body components, complex.
        w, wd: angular velocity and acceleration.
        d, dd, ddd: outboard point from the origin and its relative velocity and acceleration.
        s, sd, sdd: first mass moment c + C q and its relative rates.
        joint_rotation: (n,) complex exp(i (theta + joint angle)) from the next frame to this one.
        constants: of the body.
        e: (n, q) its coordinates.
        modal: its displacement along the modes.
        next_a, next_wd: acceleration of the outboard interface less gravity, in the next frame's
            components, and its angular acceleration.
        bent: its deformation of the second order, None of a linear body.
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
    modal: ModalDisplacement
    next_a: np.ndarray
    next_wd: np.ndarray
    bent: SecondOrder | None = None

    @cached_property
    def jM(self) -> np.ndarray:
        """Return j + M q (n, q), half the derivative of the inertia."""
        modal = self.modal
        linear = self.constants.body.j + modal.pulled(modal.z @ self.constants.body.M)
        return linear if self.bent is None else linear - self.bent.q[:, 3]

    @cached_property
    def rG(self) -> np.ndarray:
        """Return r + G q (n, q); G is skew: (G q)' = -q' G."""
        linear = self.constants.body.r - self.modal.pulled(self.modal.z @ self.constants.body.G)
        return linear if self.bent is None else linear - self.bent.q[:, 2]

    @cached_property
    def C(self) -> np.ndarray:
        """Return the derivative of s by the coordinates, (q,), or (n, q) if bent; complex."""
        C, bent = self.constants.C, self.bent
        return C if bent is None else C - as_complex(bent.q[:, 0], bent.q[:, 1])

    @cached_property
    def B(self) -> np.ndarray:
        """Return that of the outboard point."""
        B, bent = self.constants.B, self.bent
        return B if bent is None else B - as_complex(bent.q[:, 4], bent.q[:, 5])

    @cached_property
    def rotation(self) -> np.ndarray:
        """Return that of the outboard rotation."""
        rotation, bent = self.constants.rotation, self.bent
        return rotation if bent is None else rotation - bent.q[:, 6]


def as_complex(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return x + i y of real arrays of one shape."""
    out = np.empty(x.shape, dtype=complex)
    out.real, out.imag = x, y
    return out


def along(x: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Return x . modes (n,) for x (n, q) and modes (q,), or (n, q) that differ by instant."""
    return x @ modes if modes.ndim == 1 else np.einsum("nk,nk->n", x, modes)


def outward_pass(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> tuple[list[Frame], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return the motion of all frames, and (a, w, wd) of the payload's."""
    gravity = mechanism.gravity[0] + 1j * mechanism.gravity[1]
    joints_d, joints_dd = motion.qd[:, 1:], motion.qdd[:, 1:]
    a = np.conj(motion.joint_rotations[0]) * (motion.qdd[:, 0] - gravity)
    w, wd = joints_d[:, 0], joints_dd[:, 0]
    frames: list[Frame] = []
    last = len(mechanism.bodies) - 1
    for k, (part, constants) in enumerate(
        zip(mechanism.slices, mechanism.modal_constants, strict=True)
    ):
        e = q[:, part]
        # One real product for C q, B q and the rotation: of complex matrices all q would be copied.
        moved = [x @ constants.kinematics for x in (e, qd[:, part], qdd[:, part])]
        bent = None
        if constants.K0 is not None:
            bent = _second_order(constants, (e, qd[:, part], qdd[:, part]))
            for linear, more in zip(moved, bent.changes, strict=True):
                linear += more
        (s, d, rotation), (sd, dd, rotation_d), (sdd, ddd, rotation_dd) = (
            one.view(complex).T for one in moved
        )
        joint_rotation = np.exp(1j * rotation.real)
        if k < last:  # behind the last arm the payload's frame has no joint of its own
            joint_rotation *= motion.joint_rotations[k + 1]
        d = constants.outboard_position + d
        next_a = np.conj(joint_rotation) * (a + (1j * wd - w * w) * d + 2j * w * dd + ddd)
        next_wd = wd + rotation_dd.real
        frames.append(
            Frame(
                a,
                w,
                wd,
                d,
                dd,
                ddd,
                constants.c + s,
                sd,
                sdd,
                joint_rotation,
                constants,
                e,
                ModalDisplacement(constants.L, (e, qd[:, part], qdd[:, part])),
                next_a,
                next_wd,
                bent,
            )
        )
        a, w, wd = next_a, w + rotation_d.real, next_wd
        if k < last:
            w, wd = w + joints_d[:, k + 1], wd + joints_dd[:, k + 1]
    return frames, (a, w, wd)


def inverse_dynamics(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the generalised force of every coordinate.

    Args:
        mechanism: N elastic coordinates.
        motion: rigid coordinates at n instants.
        q, qd, qdd: (n, N) elastic coordinates and derivatives.

    Returns:
        Elastic residual (n, N), zero when the equations of motion hold, and the forces of cart and
        joints (n, 1 + arms), N and N m, that drive the rigid coordinates.
    """
    if 0 < len(q) < FEW:
        rows, forces = inverse_dynamics(*several(mechanism, motion, q, qd, qdd))
        return rows[: len(q)], forces[: len(q)]
    rows, (force, drives) = inward_pass(mechanism, motion, (q, qd, qdd), driven=True)
    cart = (motion.joint_rotations[0] * force).real
    forces = np.stack([cart, *drives], axis=1)
    if mechanism.rotors.any():
        forces += mechanism.rotors * motion.qdd
    return rows, forces


def elastic_residual(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Return the elastic residual (n, N) of `inverse_dynamics` alone."""
    if 0 < len(q) < FEW:
        return elastic_residual(*several(mechanism, motion, q, qd, qdd))[: len(q)]
    return inward_pass(mechanism, motion, (q, qd, qdd), driven=False)[0]


def body_loads(
    mechanism: Mechanism, motion: RigidMotion, rates: Rates
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return p = (a_x, a_y, wd, -w^2, F_x, F_y, T) (n, 7) and w (n,) of every body."""
    if 0 < len(rates[0]) < FEW:
        count = len(rates[0])
        few, at, *others = several(mechanism, motion, *rates)
        found = body_loads(few, at, (others[0], others[1], others[2]))
        return [(p[:count], w[:count]) for p, w in found]
    loads: list[tuple[np.ndarray, np.ndarray]] = []
    inward_pass(mechanism, motion, rates, driven=False, loads=loads)
    return loads


def load_coefficients(mechanism: Mechanism, motion: RigidMotion, rates: Rates) -> list[np.ndarray]:
    """Return c (n, 7 + 2 q) of every body, what loads it: see `dynamics.simulation`.

    Of a machine whose last interface is free. m/s2, 1/s2, N, N m and modes per s2.
    """
    found = []
    loads, (q, qd, qdd) = body_loads(mechanism, motion, rates), rates
    constants = mechanism.modal_constants
    for (p, w), part, own in zip(loads, mechanism.slices, constants, strict=True):
        modal = ModalDisplacement(own.L, (q[:, part], qd[:, part], qdd[:, part]))
        w, wd = w[:, None], p[:, 2, None]
        radial, around = modal.zdd - w * w * modal.z, wd * modal.z + 2.0 * w * modal.zd
        found.append(-np.hstack([p, radial, around]))
    return found


def inward_pass(
    mechanism: Mechanism,
    motion: RigidMotion,
    rates: Rates,
    driven: bool,
    loads: list[tuple[np.ndarray, np.ndarray]] | None = None,
) -> tuple[np.ndarray, tuple[np.ndarray, list[np.ndarray]]]:
    """Return the elastic residual and, if `driven`, the first joint's force and all moments.

    What loads every body is put into `loads`, if given, see `body_loads`.
    """
    frames, tip = outward_pass(mechanism, motion, *rates)
    force, moment = np.zeros_like(tip[0]), np.zeros_like(tip[2])
    rows = np.empty_like(rates[0])
    drives: list[np.ndarray] = []
    for k in reversed(range(len(frames))):
        part, frame, scale = mechanism.slices[k], frames[k], mechanism.scale(k)
        own = (rates[0][:, part], rates[1][:, part], rates[2][:, part])
        if carried := mechanism.carried(k):
            force = force + carried[0] * frame.next_a
            moment = moment + carried[1] * frame.next_wd
        force = frame.joint_rotation * force  # of everything outboard, in this frame
        if loads is not None:
            loads.insert(0, (load_columns(frame, (force, moment)), frame.w))
        rows[:, part] = _body_residual(frame, own, (force, moment), scale)
        if k > 0 or driven:
            moment = moment + (np.conj(frame.d) * force).imag + scale.mass * body_moment(frame)
            force = force + scale.mass * body_force(frame)
            drives.insert(0, moment)
    return rows, (force, drives)


def _body_residual(
    frame: Frame, rates: Rates, load: tuple[np.ndarray, np.ndarray], scale: Scale
) -> np.ndarray:
    """Return one body's elastic rows (n, q) under the load (force, moment) on its outboard end."""
    e, ed, _ = rates
    constants = frame.constants
    load_coefficients = load_columns(frame, load)
    load_coefficients[:, :4] *= as_column(scale.mass)
    inertial = frame.modal.pulled(modal_inertia(frame))
    if isinstance(scale.mass, np.ndarray) or scale.mass != 1.0:
        inertial *= as_column(scale.mass)
    inertial += load_coefficients @ constants.loads
    if frame.bent is not None:
        inertial -= frame.bent.of_loads(load_coefficients)
    inertial += as_column(scale.stiffness) * product(e, constants.K)
    if constants.D is not None:
        inertial += as_column(scale.damping) * product(ed, constants.D)
    return inertial


def modal_inertia(frame: Frame) -> np.ndarray:
    """Return the inertia forces M zdd - w^2 M z + wd G z + 2 w G zd (n, q) of the modes."""
    body, modal = frame.constants.body, frame.modal
    w, wd = frame.w[:, None], frame.wd[:, None]
    forces = (modal.zdd - (w * w) * modal.z) @ body.M
    forces -= (wd * modal.z + (2.0 * w) * modal.zd) @ body.G
    return forces


def load_columns(frame: Frame, load: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return (a_x, a_y, wd, -w^2, F_x, F_y, T) (n, 7)."""
    columns = np.empty((len(frame.w), 7))
    parts = (frame.a.real, frame.a.imag, frame.wd, -frame.w * frame.w)
    for i, column in enumerate((*parts, load[0].real, load[0].imag, load[1])):
        columns[:, i] = column
    return columns


def body_moment(frame: Frame) -> np.ndarray:
    """Return the moment T (n,) of one body's own inertia about its frame's origin, N m."""
    modal = frame.modal
    moment = (
        (np.conj(frame.s) * frame.a).imag
        + inertia(frame) * frame.wd
        + 2.0 * frame.w * np.einsum("nk,nk->n", frame.jM, modal.qd)
        + np.einsum("nk,nk->n", frame.rG, modal.qdd)
    )
    if frame.bent is not None:
        moment -= frame.bent.spin
    if modal.L is not None:
        moment -= np.einsum("nk,nk->n", modal.z @ frame.constants.body.G, modal.convective)
    return moment


def inertia(frame: Frame) -> np.ndarray:
    """Return the deformed body's inertia about its frame's origin (n,), kg m2."""
    body, bent, z = frame.constants.body, frame.bent, frame.modal.z
    if bent is None:
        return body.inertia + np.einsum("nk,nk->n", body.j + frame.jM, frame.e)
    first = np.einsum("nk,nk->n", 2.0 * body.j - bent.q[:, 3], frame.e)
    return body.inertia + first + np.einsum("nk,nk->n", z @ body.M, z)


def body_force(frame: Frame) -> np.ndarray:
    """Return the inertia force F (n,) complex, body components, N."""
    w, body = frame.w, frame.constants.body
    return body.mass * frame.a + (1j * frame.wd - w * w) * frame.s + 2j * w * frame.sd + frame.sdd


# -- how much the loads of a motion stiffen or soften the arms, before anything is simulated -----

WARN = 0.05  # change of an arm's stiffness from which a motion without it is not to be trusted


@dataclass(frozen=True)
class Stiffening:
    """Whether bodies have geometric stiffness, and why.

    Attributes:
        estimate: largest relative change of an arm's stiffness along the motion; None in space
            where the scene itself says whether it counts.
        on: whether it is taken into account.
        neglected: what the deviation would miss without it, over its largest; None if not compared.
    """

    estimate: float | None
    on: bool
    neglected: float | None = None


def largest_change(
    mechanism: Mechanism, motion: RigidMotion, closure: Closure | None = None
) -> float:
    """Return the largest |eigenvalue| of K^-1 sum_p p K0_p over arms and instants.

    The loads p are those of the machine with rigid arms on the desired motion.

    Args:
        mechanism: bodies with geometric stiffness.
        motion: at n instants.
        closure: of the last interface, or None.
    """
    rigid = replace(mechanism, bodies=tuple(map(rigid_part, mechanism.bodies)))
    largest = 0.0
    for body, p in zip(mechanism.bodies, _loads(rigid, motion, closure), strict=True):
        largest = max(largest, stiffness_change(body, p))
    return largest


def stiffness_change(body: ShapeIntegrals, p: np.ndarray) -> float:
    """Return the largest |eigenvalue| of K^-1 sum_p p K0_p of a body under loads p (n, loads)."""
    if body.num_modes == 0 or not body.is_stiffened:
        return 0.0
    inverse = np.linalg.inv(np.linalg.cholesky(body.K))
    K0 = inverse @ np.concatenate([body.K0, body.K0_outboard]) @ inverse.T
    values = np.linalg.eigvalsh(np.tensordot(p, K0, 1))
    return float(np.abs(values).max(initial=0.0))


def _loads(rigid: Mechanism, motion: RigidMotion, closure: Closure | None) -> list[np.ndarray]:
    """Return (a_x, a_y, wd, -w^2, F_x, F_y, T) of every body, each (n, 7)."""
    none = np.zeros((len(motion.q), 0))
    frames, tip = outward_pass(rigid, motion, none, none, none)
    force, moment = np.zeros_like(tip[0]), np.zeros_like(tip[2])
    if closure is not None:
        force = _ground_force(rigid, motion, closure, frames)
    loads: list[np.ndarray] = []
    for k in reversed(range(len(frames))):
        frame = frames[k]
        if carried := rigid.carried(k):
            force = force + carried[0] * frame.next_a
            moment = moment + carried[1] * frame.next_wd
        force = frame.joint_rotation * force
        inertial = (frame.a.real, frame.a.imag, frame.wd, -frame.w * frame.w)
        loads.insert(0, np.stack([*inertial, force.real, force.imag, moment], axis=1))
        moment = moment + (np.conj(frame.d) * force).imag
        moment = moment + body_moment(frame)
        force = force + body_force(frame)
    return loads


def _ground_force(
    rigid: Mechanism, motion: RigidMotion, closure: Closure, frames: list[Frame]
) -> np.ndarray:
    """Return what the last arm must give to the ground (n,), complex, in its end's components.

    The joints that close the loop have no drive: there are as many of them as constraints.
    """
    none = np.zeros((len(motion.q), 0))
    forces = inverse_dynamics(rigid, motion, none, none, none)[1][:, -closure.count :]
    place = interface_place(rigid, motion, none)
    J = place.jacobian[:, -closure.count :]
    left = forces - (np.conj(closure.force) * J).real
    ground = np.linalg.solve(closure.project(J).swapaxes(1, 2), left[:, :, None])[:, :, 0]
    pull = ground @ closure.normals + closure.force
    angle = motion.q[:, 1:].sum(axis=1)
    return -np.exp(-1j * angle) * pull
