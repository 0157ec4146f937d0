"""Recursive Newton-Euler in the plane and in space: forces and elastic residual of a motion.

One pass out along the tree for the motion of every frame, one back for forces and moments. Source:
Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 5; Schwertassek & Wallrapp (1999).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.body import BodyMotion
from dolfinopt.multibody.frames import Interface, MovingJoint, MovingRotor
from dolfinopt.multibody.kinematics import Posed
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates
from dolfinopt.multibody.tree import GROUND, Mechanism, Site

NOTHING: Mapping[Site, np.ndarray] = {}


@dataclass(frozen=True, eq=False)
class Link:
    """One body of the tree as it moves.

    Attributes:
        joint: that holds it.
        body: itself.
        interfaces: its outboard ones on which something sits, by number.
        carried: what it carries there without a joint, as it moves, by number.
        applied: what given forces ask of it there, by number.
        rotor: of the joint's motor, on what the joint sits on; or None.
    """

    joint: MovingJoint
    body: BodyMotion
    interfaces: dict[int, Interface]
    carried: dict[int, BodyMotion]
    applied: dict[int, Applied]
    rotor: MovingRotor | None = None


@dataclass(frozen=True, eq=False)
class Applied:
    """What given forces on an interface ask of it: their negatives, in the body's components.

    Attributes:
        load: of all forces.
        in_world: the part that keeps its direction in the world.
    """

    load: np.ndarray
    in_world: np.ndarray


def outward_pass(
    tree: Mechanism, motion: RigidMotion, rates: Rates, held: Iterable[Site] = ()
) -> list[Link]:
    """Return all bodies as they move, in the tree's order.

    Args:
        tree, motion, rates: n instants.
        held: interfaces that something outside the tree pulls.
    """
    count = len(motion.q)
    joints, elastic = instants_last((motion.q, motion.qd, motion.qdd)), instants_last(rates)
    none = np.zeros((0, 3, count))
    ground = tree.ground(motion)
    links: dict[int, Link] = {}
    for i in tree.order:
        joint, own = tree.joints[i], None
        if (k := joint.coordinate) is not None:
            own = joints[k]
        inner = ground
        if joint.parent != GROUND:
            inner = links[joint.parent].interfaces[joint.interface].motion
        moving = MovingJoint(joint, inner, own)
        body = BodyMotion(tree.constants[i], moving.motion, elastic[tree.slices[i]])
        more = {s for k, s in held if k == i}
        interfaces = {s: Interface(body, s) for s in sorted({*tree.sites[i], *more})}
        carried = {
            s: BodyMotion(tree.loads[i, s], interface.motion, none)
            for s, interface in interfaces.items()
            if (i, s) in tree.loads
        }
        rotor = None
        if i in tree.rotors:
            rotor = MovingRotor(joint, inner, _motor_rates(tree, motion, i))
        links[i] = Link(moving, body, interfaces, carried, {}, rotor)
    result = [links[i] for i in range(len(links))]
    if tree.forces:
        _apply_forces(tree, result, motion, rates[0])
    return result


def _motor_rates(tree: Mechanism, motion: RigidMotion, i: int) -> np.ndarray:
    """Return speed and acceleration (2, n) of the motor of body i's joint."""
    motor = tree.rotors[i] - tree.num_rigid
    if motor >= 0 and motion.motors is not None:
        return motion.motors[:, :, motor]
    k = tree.joints[i].coordinate
    return np.stack([motion.qd[:, k], motion.qdd[:, k]])


def _apply_forces(tree: Mechanism, links: list[Link], motion: RigidMotion, q: np.ndarray) -> None:
    """Add the motion's given forces to the interfaces on which they act."""
    assert motion.applied is not None, "a motion without the values of the mechanism's forces"
    posed = Posed(tree, motion.q, q)
    for force in tree.forces:
        i, s = force.site
        values = -motion.applied[:, force.column].T
        load, in_world = values, 0.0 * values
        if force.in_world:
            load = in_world = tree.dim.turn(posed.body(i)[2].swapaxes(0, 1), values)
        if (before := links[i].applied.get(s)) is not None:
            load, in_world = before.load + load, before.in_world + in_world
        links[i].applied[s] = Applied(load, in_world)


def instants_last(rates: Rates) -> np.ndarray:
    """Return coordinates and their rates, (n, N) each, as (N, 3, n), in memory, too."""
    count, size = rates[0].shape
    out = np.empty((size, 3, count), dtype=np.result_type(*rates))
    for i, x in enumerate(rates):
        out[:, i] = x.T
    return out


@dataclass(frozen=True, eq=False)
class Loads:
    """What loads the bodies of a tree; force and moment (d + r, n).

    Attributes:
        outboard: on every body's interfaces by number, in the body's components.
        joints: on the frames of bodies by all that hangs on them, themselves included.
    """

    outboard: list[dict[int, np.ndarray]]
    joints: dict[int, np.ndarray]


def inward_pass(
    tree: Mechanism,
    links: list[Link],
    driven: bool = True,
    pull: Mapping[Site, np.ndarray] = NOTHING,
) -> Loads:
    """Return the loads of all bodies; on frames, unless `driven`, those that deform a body.

    Args:
        tree, links: as they move.
        driven: whether all frames' are asked for.
        pull: more loads on interfaces, in their components.
    """
    outboard: list[dict[int, np.ndarray]] = [{} for _ in links]
    joints: dict[int, np.ndarray] = {}
    for i in reversed(tree.order):
        link, felt = links[i], driven or tree.is_felt(i)
        if not (felt or link.body.is_flexible):
            continue
        for s, interface in link.interfaces.items():
            hanging = tree.hanging.get((i, s), ())
            on_it = [links[k] for k in hanging]
            parts = [links[k].joint.load_on_carrier(joints[k]) for k in hanging]
            parts += [item.rotor.load for item in on_it if item.rotor is not None]
            if s in link.carried:
                parts.append(link.carried[s].load)
            if (i, s) in pull:
                parts.append(pull[i, s])
            loads = [interface.in_carrier(sum(parts[1:], parts[0]))] if parts else []
            if s in link.applied:
                loads.append(link.applied[s].load)
            outboard[i][s] = sum(loads[1:], loads[0])
        if felt:
            places = ((link.interfaces[s].place, load) for s, load in outboard[i].items())
            joints[i] = sum((tree.dim.shifted(*place) for place in places), link.body.load)
    return Loads(outboard, joints)


def carried_load(link: Link, loads: dict[int, np.ndarray], s: int) -> np.ndarray:
    """Return the part of `Loads.outboard` that turns with an interface: without given forces."""
    return loads[s] - link.applied[s].load if s in link.applied else loads[s]


def elastic_rows(links: list[Link], loads: Loads) -> np.ndarray:
    """Return the elastic residual (n, N)."""
    rows = [np.zeros((0, links[0].body.a.shape[1]))]
    for link, outboard in zip(links, loads.outboard, strict=True):
        if link.body.is_flexible:
            rows.append(link.body.rows(interface_coefficients(link, outboard)))
    return np.concatenate(rows).T


def interface_coefficients(link: Link, outboard: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Return what works on the displacements of a flexible body's interfaces, by number."""
    return {s: link.interfaces[s].coefficients(load) for s, load in outboard.items()}


def inverse_dynamics(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the generalised force of every coordinate.

    Args:
        mechanism: N elastic coordinates.
        motion: joints at n instants.
        q, qd, qdd: (n, N) elastic coordinates and derivatives.

    Returns:
        Elastic residual (n, N), zero when the equations of motion hold, and what drives the rigid
        coordinates and the motors behind springs (n, R + M), N m of revolute and N of prismatic
        joints.
    """
    tree = mechanism
    links = outward_pass(tree, motion, (q, qd, qdd))
    loads = inward_pass(tree, links)
    forces = np.zeros((len(q), tree.num_rigid + len(tree.motor_joints)))
    for i in tree.movable:
        forces[:, tree.joints[i].coordinate] = links[i].joint.drive_axis @ loads.joints[i]
    for i, k in tree.rotors.items():
        if (rotor := links[i].rotor) is not None:
            forces[:, k] += rotor.force
    if tree.cart is not None:
        forces[:, 0] = tree.cart * (motion.qdd[:, 0] - tree.gravity[0])
        for i in tree.hanging[GROUND, 0]:
            forces[:, 0] += links[i].joint.load_on_carrier(loads.joints[i])[0]
    if tree.friction is not None:
        forces[:, : tree.num_rigid] += tree.friction.force(motion.qd)
    return elastic_rows(links, loads), forces


def elastic_residual(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Return the elastic residual (n, N) of `inverse_dynamics` alone."""
    links = outward_pass(mechanism, motion, (q, qd, qdd))
    return elastic_rows(links, inward_pass(mechanism, links, driven=False))
