"""Vector-Jacobian product of inverse dynamics with the shape integrals of every body.

The multipliers are a virtual displacement: their sum of products with forces and residual is the
virtual work of all inertia and elastic forces, linear in every shape integral. Only the outboard
interface enters through the kinematics, too; its gradient comes from a pass back along the chain
that carries the derivatives with respect to the frames' motion beside the forces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.instants import FEW, several
from dolfinopt.multibody.inverse_dynamics import Frame, Rates, body_force, inertia, outward_pass
from dolfinopt.multibody.mechanism import Mechanism
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
    moves, (tip_p, tip_rotation) = _virtual_motion(
        mechanism, frames, multipliers, first, of_forces[:, 1:]
    )
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
    mechanism: Mechanism,
    frames: list[Frame],
    multipliers: np.ndarray,
    first: np.ndarray,
    joints: np.ndarray,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], tuple[np.ndarray, np.ndarray]]:
    """Return every frame's virtual displacement (complex, its components) and rotation.

    Args:
        mechanism, frames: as they move.
        multipliers: (n, N) virtual elastic coordinates.
        first: (n,) virtual displacement of the first joint, complex, in the first frame.
        joints: (n, arms) virtual rotations of the joints.
    """
    p, rotation = first, np.zeros(len(multipliers))
    moves = []
    for k, (part, frame) in enumerate(zip(mechanism.slices, frames, strict=True)):
        constants = frame.constants
        rotation = rotation + joints[:, k]
        moves.append((p, rotation))
        p = np.conj(frame.joint_rotation) * (
            p + 1j * rotation * frame.d + multipliers[:, part] @ constants.B
        )
        rotation = rotation + multipliers[:, part] @ constants.rotation
    return moves, (p, rotation)


def _outboard_gradient(
    frame: Frame, rates: Rates, virtual: Rates, outer: _Outer
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
    frame: Frame, rates: Rates, virtual: Rates, outboard: np.ndarray
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


def _with_body(frame: Frame, rates: Rates, virtual: Rates, outer: _Outer) -> _Outer:
    """Add one body's own force and gradient to what lies outboard of it."""
    body, constants = frame.constants.body, frame.constants
    _, qd, qdd = rates
    p, rotation, multipliers = virtual
    w = frame.w
    spin = np.einsum("nk,nk->n", frame.jM, qd)
    gyro = -2.0 * w[:, None] * frame.jM - 2.0 * (qd @ body.G)
    return _Outer(
        force=outer.force + body_force(frame),
        moment=outer.moment
        + (np.conj(frame.s) * frame.a).imag
        + inertia(frame) * frame.wd
        + 2.0 * w * spin
        + np.einsum("nk,nk->n", frame.rG, qdd),
        a=outer.a + body.mass * p + 1j * frame.s * rotation + multipliers @ constants.C,
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
