"""How much the loads of a motion stiffen or soften the arms, before anything is simulated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.multibody.drives import Closure
from dolfinopt.multibody.interface_jacobian import interface_place
from dolfinopt.multibody.inverse_dynamics import (
    Frame,
    body_force,
    body_moment,
    inverse_dynamics,
    outward_pass,
)
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, rigid_part

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
