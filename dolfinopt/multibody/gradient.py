"""Vector-Jacobian product of inverse dynamics with the integrals of every body.

The multipliers are a virtual displacement, which runs out along the tree like velocities do; its
products with inertia and elastic forces are linear in every integral. The outboard interface
enters through the kinematics, too: a pass back carries the derivatives by the frames' motion.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.body import BodyMotion
from dolfinopt.multibody.frames import Interface, MovingRotor
from dolfinopt.multibody.newton_euler import Link, carried_load, inward_pass, outward_pass
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.tree import GROUND, Mechanism, Site


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
        of_forces: (n, R) of the rigid coordinates' forces, or (n, R + M) of the motors' behind
            springs as well; none by default.

    Returns:
        The derivative by every body's integrals.
    """
    tree = mechanism
    drives = np.zeros((len(q), tree.num_rigid + len(tree.motor_joints)))
    if of_forces is not None:
        drives[:, : of_forces.shape[1]] = of_forces
    links = outward_pass(tree, motion, (q, qd, qdd))
    loads = inward_pass(tree, links)
    zeta = np.ascontiguousarray(multipliers.T)
    moves, ends = _virtual_motion(tree, links, zeta, drives)
    by_motion: dict[int, np.ndarray] = {}
    by_rotation = _by_rotation(tree, links, moves, zeta)
    gradient: dict[int, ShapeIntegrals] = {}
    for i in reversed(tree.order):
        link, own = links[i], zeta[tree.slices[i]]
        by = [_motion_gradient(link.body, moves[i])]
        outboard: dict[int, np.ndarray] = {}
        if link.body.is_flexible:
            by.append(np.einsum("mqn,qn->mn", link.body.rows_by_motion, own))
        for s, interface in link.interfaces.items():
            parts = [links[k].joint.passage.transposed(by_motion[k]) for k in tree.hanging[i, s]]
            parts += [
                _rotor_gradient(links[k], ends[i, s], drives[:, tree.rotors[k]])
                for k in tree.hanging[i, s]
                if k in tree.rotors
            ]
            if s in link.carried:
                parts.append(_motion_gradient(link.carried[s], ends[i, s]))
            displaced = np.zeros((link.body.dim.b, 3, zeta.shape[1]))
            if parts:
                on_interface = np.sum(parts, axis=0)
                by.append(interface.passage.transposed(on_interface))
                if link.body.is_flexible:
                    displaced = interface.by_displacement(on_interface)
            if link.body.is_flexible:
                both = loads.outboard[i][s], carried_load(link, loads.outboard[i], s)
                outboard[s] = _interface_weights(interface, both, moves[i], own, displaced)
                if (i, s) in by_rotation:
                    outboard[s][link.body.dim.d :, 0] += by_rotation[i, s]
        by_motion[i] = np.sum(by, axis=0)
        gradient[i] = link.body.integral_gradient(moves[i], own, outboard)
    return [gradient[i] for i in range(len(links))]


def _by_rotation(
    tree: Mechanism, links: list[Link], moves: dict[int, np.ndarray], zeta: np.ndarray
) -> dict[Site, np.ndarray]:
    """Return the derivatives by every interface's theta (r, n) through forces of the world."""
    # What turns a body turns such a force the other way in the body's components.
    found: dict[Site, np.ndarray] = {}
    if not tree.forces:
        return found
    dim, of_bodies = tree.dim, dict.fromkeys(range(len(links)), np.zeros((tree.dim.r, 1)))
    for i in reversed(tree.order):
        link, own = links[i], zeta[tree.slices[i]]
        total = np.zeros((dim.r, zeta.shape[1]))
        for s, interface in link.interfaces.items():
            turned = sum(
                (dim.rotated(links[k].joint.R, of_bodies[k]) for k in tree.hanging[i, s]),
                np.zeros_like(total),
            )
            if link.body.is_flexible:
                turned = dim.rotated(interface.turning.R, turned)
                found[i, s] = interface.turning.jacobian_transposed(turned)
            total += turned
            if s in link.applied:
                given, moved = link.applied[s].in_world, interface.virtual(moves[i], own)
                total -= dim.moment(given[: dim.d], moved[: dim.d])
                total -= dim.commutator(given[dim.d :], moved[dim.d :])
        of_bodies[i] = total
    return found


def _motion_gradient(body: BodyMotion | MovingRotor, virtual: np.ndarray) -> np.ndarray:
    """Return the derivatives of virtual . (F, T) by a motion (d + 2 r, n)."""
    return np.asarray(np.einsum("ijn,in->jn", body.load_by_motion, virtual))


def _rotor_gradient(link: Link, virtual: np.ndarray, drive: np.ndarray) -> np.ndarray:
    """Return the derivatives by the motion of what carries a rotor; `drive` (n,) is its motor's."""
    assert link.rotor is not None
    return _motion_gradient(link.rotor, virtual) + link.rotor.force_by_motion[:, None] * drive


def _virtual_motion(
    tree: Mechanism, links: list[Link], zeta: np.ndarray, of_forces: np.ndarray
) -> tuple[dict[int, np.ndarray], dict[Site, np.ndarray]]:
    """Return displacement and rotation of every frame and outboard interface, in its components."""
    moves: dict[int, np.ndarray] = {}
    ends: dict[Site, np.ndarray] = {}
    ground = tree.virtual_ground(of_forces)
    for i in tree.order:
        link, joint = links[i], tree.joints[i]
        inner = ground if joint.parent == GROUND else ends[joint.parent, joint.interface]
        drive = None if joint.coordinate is None else of_forces[:, joint.coordinate]
        moves[i] = link.joint.virtual(inner, drive)
        for s, interface in link.interfaces.items():
            moved = interface.virtual(moves[i], zeta[tree.slices[i]])
            ends[i, s] = interface.in_interface(moved)
    return moves, ends


def _interface_weights(
    interface: Interface,
    loads: tuple[np.ndarray, np.ndarray],
    virtual: np.ndarray,
    zeta: np.ndarray,
    displaced: np.ndarray,
) -> np.ndarray:
    """Return the derivatives (b, 4, n) by (u, theta), their rates and variation."""
    # Of a load on a flexible body's interface and its part that turns with it, `virtual` of its
    # frame, zeta (q, n) its multipliers; `displaced` are those by (u, theta) and their rates
    # through the interface's motion.
    (load, own), dim, turning, d = loads, interface.dim, interface.turning, interface.dim.d
    moved = interface.virtual(virtual, zeta)
    # The load's lever, its components, and J' of the row.
    turned = turning.jacobian_transposed(
        dim.moment(own[:d], moved[:d]) + dim.commutator(own[d:], moved[d:])
    )
    by_theta = turning.by_theta(load[d:], -1.0)
    if by_theta is not None:
        theta = np.einsum("rkn,kn->rn", interface.body.V[interface.places][d:], zeta)
        turned = turned + np.einsum("ijn,in->jn", by_theta, theta)
    weights = np.concatenate([displaced, interface.load_coefficients(load)[:, None]], axis=1)
    weights[:d, 0] -= dim.velocity(virtual[d:], load[:d])
    weights[d:, 0] += turned
    return weights
