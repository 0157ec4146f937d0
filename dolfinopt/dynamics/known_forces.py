"""What a control knows ahead: forces that move the machine with rigid arms as desired.

They are inverse dynamics of bodies of the same mass and inertia that do not deform. In a closed
loop the joints that follow from others have no drive: what they would need, the closures give, by
multipliers of least norm.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.multibody.gradient import body_gradient
from dolfinopt.multibody.newton_euler import inverse_dynamics
from dolfinopt.multibody.ranks import least_norm
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals

if TYPE_CHECKING:
    from dolfinopt.dynamics.machine_system import MachineSystem


def feed_forward(machine: MachineSystem, desired: RigidMotion) -> tuple[np.ndarray, np.ndarray]:
    """Return the forces of the free coordinates and of motors behind springs, (n, R) and (n, M).

    Motors behind springs move their rotors.
    """
    rigid, drives = machine.rigid, machine.drives
    none = np.zeros((len(desired.q), 0))
    every = inverse_dynamics(rigid, desired, none, none, none)[1]
    forces, motors = np.split(every, [rigid.num_rigid], axis=1)
    if machine.loops is not None:
        here = machine.loops.at(rigid, desired.q, none)
        forces = forces - here.generalised_force(here.closing(forces, drives.dependent))
    return forces[:, drives.free] * drives.driven, motors[:, : len(drives.springs.joints)]


def known_forces(
    machine: MachineSystem, desired: RigidMotion
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the drives' feed-forward (n, R), and how far ahead of their joints motors are asked.

    Drives before springs give what joint and rotor need, and the friction of the motor. By
    `Drives.winding` the motor is asked to be ahead (n, R) by what its spring gives, rad.
    """
    drives, springs = machine.drives, machine.drives.springs
    if not drives.rigid_feed_forward:
        return np.zeros((len(desired.q), len(drives.free))), None
    ahead, motors = feed_forward(machine, desired)
    winding = None
    if drives.winding:
        winding = np.zeros_like(ahead)
        winding[:, springs.joints] = ahead[:, springs.joints] / springs.stiffness
    speeds = desired.qd[:, machine.motor_joints]
    ahead[:, springs.joints] += motors + springs.friction.force(speeds)
    return ahead, winding


def feed_forward_gradient(
    machine: MachineSystem, desired: RigidMotion, weights: np.ndarray
) -> list[ShapeIntegrals]:
    """Return the derivative of sum_n weights_n . u_n by every body through `known_forces`.

    Args:
        machine: with feed-forward.
        desired: at n instants.
        weights: (n, R) of the drives' forces u.
    """
    rigid, drives, springs = machine.rigid, machine.drives, machine.drives.springs
    none = np.zeros((len(weights), 0))
    of_forces = np.zeros_like(desired.q)
    of_forces[:, drives.free] = weights * drives.driven
    if drives.winding:
        share = drives.stiffness[springs.joints] / springs.stiffness
        of_forces[:, machine.motor_joints] *= 1.0 + share
    if machine.loops is not None:
        J = machine.loops.at(rigid, desired.q, none).jacobian
        moved = np.einsum("nkr,nr->nk", J, of_forces)
        of_forces[:, drives.dependent] -= least_norm(J[:, :, drives.dependent], moved)
    of_forces = np.hstack([of_forces, weights[:, springs.joints]])
    return body_gradient(rigid, desired, none, none, none, none, of_forces)
