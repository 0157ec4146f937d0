"""Vector-Jacobian product of inverse dynamics in space with the integrals of every body.

The multipliers are a virtual displacement, which runs out along the tree like velocities do; its
products with inertia and elastic forces are linear in every integral. The outboard interface
enters through the kinematics, too: a pass back carries the derivatives by the frames' motion.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.body_motion import Weights, with_outboard
from dolfinopt.multibody.spatial.inverse_dynamics import Link, inward_pass, outward_pass
from dolfinopt.multibody.spatial.kinematics import Interface, Load
from dolfinopt.multibody.spatial.mechanism import GROUND, Site, SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.rotations import cross, times, transposed_times


def body_gradient(
    mechanism: SpatialMechanism,
    motion: JointMotion,
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
        of_forces: (n, joints) of the joints' forces; none by default.

    Returns:
        The derivative by every body's integrals.
    """
    if of_forces is None:
        of_forces = np.zeros((len(q), mechanism.num_joints))
    links = outward_pass(mechanism, motion, (q, qd, qdd))
    loads = inward_pass(mechanism, links)
    moves, ends = _virtual_motion(mechanism, links, multipliers, of_forces)
    by_motion: dict[int, np.ndarray] = {}  # of every body (n, 9)
    gradient: dict[int, ShapeIntegrals] = {}
    for i in reversed(mechanism.order):
        link, virtual, own = links[i], moves[i], multipliers[:, mechanism.slices[i]]
        by = np.einsum("nij,ni->nj", link.body.load_by_motion, virtual)
        stiffened, size = link.body.constants.K0 is not None, len(link.body.constants.B)
        outboard = np.zeros_like(link.body.constants.B)
        K0 = np.zeros((size if stiffened else 0, *own.shape[1:] * 2))
        if link.body.is_flexible:
            by += (own[:, None] @ link.body.rows_by_motion)[:, 0]
        for s, interface in link.interfaces.items():
            outer = np.zeros((len(own), 9))
            for k in mechanism.hanging(i, s):
                outer += np.einsum("nij,ni->nj", links[k].joint.motion_by_interface, by_motion[k])
            if s in link.carried:
                outer += np.einsum("nij,ni->nj", link.carried[s].load_by_motion, ends[i, s])
            if link.body.is_flexible:
                load = loads.outboard[i][s]
                weights = _interface_weights(interface, load, virtual, own, outer)
                outboard[interface.rows_of] = weights.linear(link.body.rates, own)
                if stiffened:
                    K0[interface.rows_of] = weights.quadratic(link.body.rates, own)
            by += np.einsum("nij,ni->nj", interface.motion_by_body, outer)
        by_motion[i] = by
        gradient[i] = with_outboard(link.body.integral_gradient(virtual, own), outboard, K0)
    return [gradient[i] for i in range(len(links))]


def _virtual_motion(
    mechanism: SpatialMechanism,
    links: list[Link],
    multipliers: np.ndarray,
    of_forces: np.ndarray,
) -> tuple[dict[int, np.ndarray], dict[Site, np.ndarray]]:
    """Return displacement and rotation (n, 6) of every frame, and of every outboard interface.

    In the components of the frame, and of the interface: what multiplies their loads.
    """
    moves: dict[int, np.ndarray] = {}
    ends: dict[Site, np.ndarray] = {}
    for i in mechanism.order:
        link, joint = links[i], mechanism.joints[i]
        inner = np.zeros((len(multipliers), 6))
        if joint.parent != GROUND:
            inner = ends[joint.parent, joint.interface]
        moved = np.einsum("nij,ni->nj", link.joint.load_by_body, inner)
        if joint.coordinate is not None:
            moved = moved + of_forces[:, joint.coordinate, None] * link.joint.driven
        moves[i] = moved
        for s, interface in link.interfaces.items():
            p, phi = _moved_interface(interface, moved, multipliers[:, mechanism.slices[i]])
            if link.body.is_flexible:
                R = interface.turning.R
                p, phi = transposed_times(R, p), transposed_times(R, phi)
            ends[i, s] = np.hstack([p, phi])
    return moves, ends


def _moved_interface(
    interface: Interface, virtual: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return virtual displacement and rotation of an interface (n, 3), the body's components."""
    p, phi = virtual[:, :3], virtual[:, 3:]
    p = p + cross(phi, np.broadcast_to(interface.place, p.shape))
    if interface.body.is_flexible:
        B = interface.B
        moved = own @ B.T if B.ndim == 2 else np.einsum("nik,nk->ni", B, own)
        p = p + moved[:, :3]
        phi = phi + times(interface.turning.J, moved[:, 3:])
    return p, phi


def _interface_weights(
    interface: Interface,
    load: Load,
    virtual: np.ndarray,
    own: np.ndarray,
    outer: np.ndarray,
) -> Weights:
    """Return the derivatives (n, 6) by (u, theta), their rates and variation.

    Args:
        interface: of a flexible body.
        load: on it.
        virtual: (n, 6) of the body's frame.
        own: (n, q) the body's multipliers.
        outer: (n, 9) derivatives by the interface's motion.
    """
    value, rate, second = (
        np.einsum("nij,ni->nj", x, outer) for x in interface.motion_by_displacement
    )
    p, phi = _moved_interface(interface, virtual, own)
    B = interface.B
    moved = own @ B.T if B.ndim == 2 else np.einsum("nik,nk->ni", B, own)
    turning = interface.turning
    # The load's lever, its components, and J' of the row.
    value[:, :3] += cross(load[0], virtual[:, 3:])
    turned = cross(load[0], p) + cross(load[1], phi)
    value[:, 3:] += transposed_times(turning.J, turned)
    value[:, 3:] += transposed_times(turning.by_theta(load[1], -1.0), moved[:, 3:])
    return Weights(value, rate, second, interface.conjugate(load))
