"""Vector-Jacobian product of inverse dynamics with the integrals of every body.

The multipliers are a virtual displacement, which runs out along the tree like velocities do; its
products with inertia and elastic forces are linear in every integral. The outboard interface
enters through the kinematics, too: a pass back carries the derivatives by the frames' motion.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.dimension import product
from dolfinopt.multibody.frames import Interface
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
    by_rotation = _by_rotation(tree, links, moves, zeta)
    by_motion: dict[int, np.ndarray] = {}
    gradient: dict[int, ShapeIntegrals] = {}
    for i in reversed(tree.order):
        link, own = links[i], zeta[tree.slices[i]]
        by_motion[i] = link.body.motion_gradient(moves[i], own)
        by_displacement: dict[int, np.ndarray] = {}
        for s, interface in link.interfaces.items():
            by = _by_interface_motion(tree, links, (i, s), by_motion, ends, drives)
            by_motion[i] += interface.motion_gradient(by)
            if link.body.is_flexible:
                weights = _by_displacement(link, s, by, loads.outboard[i], moves[i], own)
                if (i, s) in by_rotation:
                    weights[tree.dim.d :, 0] += by_rotation[i, s]
                by_displacement[s] = weights
        gradient[i] = link.body.integral_gradient(moves[i], own, by_displacement)
    return [gradient[i] for i in range(len(links))]


def _by_interface_motion(
    tree: Mechanism,
    links: list[Link],
    site: Site,
    by_motion: dict[int, np.ndarray],
    ends: dict[Site, np.ndarray],
    drives: np.ndarray,
) -> np.ndarray:
    """Return the derivative (d + 2 r, n) by an interface's motion, of all that it carries."""
    (i, s), dim = site, tree.dim
    by = np.zeros((dim.b + dim.r, len(drives)))
    for k in tree.hanging[site]:
        by += links[k].joint.motion_gradient(by_motion[k])
        if (rotor := links[k].rotor) is not None:
            by += np.einsum("ijn,in->jn", rotor.load_by_motion, ends[site])
            by += rotor.force_by_motion[:, None] * drives[:, tree.rotors[k]]
    if s in links[i].carried:
        none = np.zeros((0, len(drives)))
        by += links[i].carried[s].motion_gradient(ends[site], none)
    return by


def _by_displacement(
    link: Link,
    s: int,
    by_motion: np.ndarray,
    loads: dict[int, np.ndarray],
    virtual: np.ndarray,
    zeta: np.ndarray,
) -> np.ndarray:
    """Return the derivatives (b, 4, n) by (u, theta), its rates and its variation.

    Args:
        link: a flexible body.
        s: its interface.
        by_motion: derivatives by the interface's motion (d + 2 r, n).
        loads: of the body's interfaces.
        virtual: displacement and rotation of the body (d + r, n).
        zeta: multipliers (q, n) of its rows.
    """
    interface, turning = link.interfaces[s], carried_load(link, loads, s)
    moved = product(interface.V, zeta)
    by_rates = interface.displacement_gradient(by_motion)
    by_rates[:, 0] += interface.load_gradient(loads[s], turning, virtual, moved)
    variation = interface.coefficients(loads[s])
    return np.concatenate([by_rates, variation[:, None]], axis=1)


def _by_rotation(
    tree: Mechanism, links: list[Link], moves: dict[int, np.ndarray], zeta: np.ndarray
) -> dict[Site, np.ndarray]:
    """Return the derivatives by every interface's theta (r, n) through forces of the world."""
    # What turns a body turns such a force the other way in the body's components.
    result: dict[Site, np.ndarray] = {}
    if not tree.forces:
        return result
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
                result[i, s] = interface.turning.jacobian_transposed(turned)
            total += turned
            if s in link.applied:
                given, moved = link.applied[s].in_world, _virtual(interface, moves[i], own)
                total -= dim.moment(given[: dim.d], moved[: dim.d])
                total -= dim.commutator(given[dim.d :], moved[dim.d :])
        of_bodies[i] = total
    return result


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
        drive = None if joint.coordinate is None else of_forces[None, :, joint.coordinate]
        moves[i] = link.joint.in_own(link.joint.virtual(inner, drive))
        for s, interface in link.interfaces.items():
            moved = _virtual(interface, moves[i], zeta[tree.slices[i]])
            ends[i, s] = interface.in_own(moved)
    return moves, ends


def _virtual(interface: Interface, body: np.ndarray, zeta: np.ndarray) -> np.ndarray:
    """Return an interface's virtual displacement and rotation in its body's components."""
    x = product(interface.V, zeta) if interface.body.is_flexible else None
    return interface.virtual(body, x)
