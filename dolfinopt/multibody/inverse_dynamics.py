"""Recursive Newton-Euler: the forces of cart and joints, and the elastic residual, of a motion.

One pass out along the chain for positions, velocities and accelerations of every frame, one back
for forces and moments; all arrays run over n instants. With frame acceleration a (less gravity),
angular velocity w and acceleration wd of a body,
    F = m a + wd S(c + C q) - w^2 (c + C q) + 2 w S C qd + C qdd
    T = (S(c + C q)) . a + (J + 2 j.q + q'M q) wd + 2 w (j + M q).qd + (r + G q).qdd
    f = C'a + (r + G q) wd - w^2 (j + M q) + 2 w G qd + M qdd + K q + D qd
plus what is attached outboard. Source: Featherstone, Rigid Body Dynamics Algorithms (2008);
Schwertassek & Wallrapp (1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.multibody.instants import FEW, Scale, as_column, several
from dolfinopt.multibody.mechanism import Mechanism, ModalConstants, product
from dolfinopt.multibody.motion import RigidMotion

Rates = tuple[np.ndarray, np.ndarray, np.ndarray]  # q, qd, qdd


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
        s, d, rotation = (e @ constants.kinematics).view(complex).T
        sd, dd, rotation_d = (qd[:, part] @ constants.kinematics).view(complex).T
        sdd, ddd, rotation_dd = (qdd[:, part] @ constants.kinematics).view(complex).T
        joint_rotation = np.exp(1j * rotation.real)
        if k < last:  # behind the last arm the payload's frame has no joint of its own
            joint_rotation *= motion.joint_rotations[k + 1]
        d = constants.outboard_position + d
        frames.append(
            Frame(a, w, wd, d, dd, ddd, constants.c + s, sd, sdd, joint_rotation, constants, e)
        )
        a = np.conj(joint_rotation) * (a + (1j * wd - w * w) * d + 2j * w * dd + ddd)
        w, wd = w + rotation_d.real, wd + rotation_dd.real
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
    return rows, np.stack([cart, *drives], axis=1)


def elastic_residual(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Return the elastic residual (n, N) of `inverse_dynamics` alone."""
    if 0 < len(q) < FEW:
        return elastic_residual(*several(mechanism, motion, q, qd, qdd))[: len(q)]
    return inward_pass(mechanism, motion, (q, qd, qdd), driven=False)[0]


def inward_pass(
    mechanism: Mechanism, motion: RigidMotion, rates: Rates, driven: bool
) -> tuple[np.ndarray, tuple[np.ndarray, list[np.ndarray]]]:
    """Return the elastic residual and, if `driven`, the first joint's force and all moments."""
    frames, tip = outward_pass(mechanism, motion, *rates)
    force, moment = mechanism.payload_mass * tip[0], mechanism.payload_inertia * tip[2]
    rows = np.empty_like(rates[0])
    drives: list[np.ndarray] = []
    for k in reversed(range(len(frames))):
        part, frame, scale = mechanism.slices[k], frames[k], mechanism.scale(k)
        own = (rates[0][:, part], rates[1][:, part], rates[2][:, part])
        force = frame.joint_rotation * force  # of everything outboard, in this frame
        rows[:, part] = _body_residual(frame, own, (force, moment), scale)
        if k > 0 or driven:
            moment = moment + (np.conj(frame.d) * force).imag + scale.mass * body_moment(frame, own)
            force = force + scale.mass * body_force(frame)
            drives.insert(0, moment)
    return rows, (force, drives)


def _body_residual(
    frame: Frame, rates: Rates, load: tuple[np.ndarray, np.ndarray], scale: Scale
) -> np.ndarray:
    """Return one body's elastic rows (n, q) under the load (force, moment) on its outboard end."""
    e, ed, edd = rates
    body, constants = frame.constants.body, frame.constants
    w, wd = frame.w, frame.wd
    load_coefficients = np.empty((len(e), 7))
    columns = (frame.a.real, frame.a.imag, wd, -w * w, load[0].real, load[0].imag, load[1])
    for i, column in enumerate(columns):
        load_coefficients[:, i] = column
    load_coefficients[:, :4] *= as_column(scale.mass)
    w, wd = w[:, None], wd[:, None]
    inertial = (edd - (w * w) * e) @ body.M
    inertial -= (wd * e + (2.0 * w) * ed) @ body.G
    if isinstance(scale.mass, np.ndarray) or scale.mass != 1.0:
        inertial *= as_column(scale.mass)
    inertial += load_coefficients @ constants.loads
    inertial += as_column(scale.stiffness) * product(e, constants.K)
    if constants.D is not None:
        inertial += as_column(scale.damping) * product(ed, constants.D)
    return inertial


def body_moment(frame: Frame, rates: Rates) -> np.ndarray:
    """Return the moment T (n,) of one body's own inertia about its frame's origin, N m."""
    _, ed, edd = rates
    return (
        (np.conj(frame.s) * frame.a).imag
        + inertia(frame) * frame.wd
        + 2.0 * frame.w * np.einsum("nk,nk->n", frame.jM, ed)
        + np.einsum("nk,nk->n", frame.rG, edd)
    )


def inertia(frame: Frame) -> np.ndarray:
    """Return the deformed body's inertia about its frame's origin (n,), kg m2."""
    body = frame.constants.body
    return body.inertia + np.einsum("nk,nk->n", body.j + frame.jM, frame.e)


def body_force(frame: Frame) -> np.ndarray:
    """Return the inertia force F (n,) complex, body components, N."""
    w, body = frame.w, frame.constants.body
    return body.mass * frame.a + (1j * frame.wd - w * w) * frame.s + 2j * w * frame.sd + frame.sdd
