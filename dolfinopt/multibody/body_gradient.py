"""Vector-Jacobian product of inverse dynamics with the shape integrals of every body.

The multipliers are a virtual displacement: their sum of products with forces and residual is the
virtual work of all inertia and elastic forces, linear in every shape integral. Only the outboard
interface enters through the kinematics, too; its gradient comes from a pass back along the chain
that carries the derivatives with respect to the frames' motion beside the forces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.multibody.instants import FEW, PerInstant, several
from dolfinopt.multibody.inverse_dynamics import (
    Frame,
    along,
    body_force,
    body_moment,
    inertia,
    modal_inertia,
    outward_pass,
)
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.modal_displacement import Rates
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals


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
