"""Recursive Newton-Euler in the plane and in space: forces and elastic residual of a motion.

One pass out along the tree for the motion of every frame, one back for forces and moments. Source:
Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 5; Schwertassek & Wallrapp (1999).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.body_motion import BodyMotion, Load
from dolfinopt.multibody.closures import Loops
from dolfinopt.multibody.dimension import compose, product
from dolfinopt.multibody.frames import Interface, MovingJoint, MovingRotor
from dolfinopt.multibody.mechanism import GROUND, Mechanism, Site
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals

NOTHING: Mapping[Site, Load] = {}


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

    load: Load
    in_world: Load


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
    found = [links[i] for i in range(len(links))]
    if tree.forces:
        _apply_forces(tree, found, motion)
    return found


def _motor_rates(tree: Mechanism, motion: RigidMotion, i: int) -> np.ndarray:
    """Return speed and acceleration (2, n) of the motor of body i's joint."""
    motor = tree.rotors[i] - tree.num_rigid
    if motor >= 0 and motion.motors is not None:
        return motion.motors[:, :, motor]
    k = tree.joints[i].coordinate
    return np.stack([motion.qd[:, k], motion.qdd[:, k]])


def _apply_forces(tree: Mechanism, links: list[Link], motion: RigidMotion) -> None:
    """Add the motion's given forces to the interfaces on which they act."""
    assert motion.applied is not None, "a motion without the values of the mechanism's forces"
    d = tree.dim.d
    turned = rotations(tree, links)
    for force in tree.forces:
        i, s = force.site
        values = -motion.applied[:, force.column].T
        load, in_world = (values[:d], values[d:]), (0.0 * values[:d], 0.0 * values[d:])
        if force.in_world:
            back = turned[i].swapaxes(0, 1)
            load = in_world = (product(back, load[0]), tree.dim.rotated(back, load[1]))
        if (before := links[i].applied.get(s)) is not None:
            load, in_world = _sum([before.load, load]), _sum([before.in_world, in_world])
        links[i].applied[s] = Applied(load, in_world)


def rotations(tree: Mechanism, links: list[Link]) -> dict[int, np.ndarray]:
    """Return every body's rotation from its frame to the world's, (d, d, n) or (d, d)."""
    found: dict[int, np.ndarray] = {}
    for i in tree.order:
        joint, R = tree.joints[i], links[i].joint.R
        if joint.parent != GROUND:
            interface = links[joint.parent].interfaces[joint.interface]
            if interface.body.is_flexible:
                R = compose(interface.turning.R, R)
            R = compose(found[joint.parent], R)
        found[i] = R
    return found


def instants_last(rates: Rates) -> np.ndarray:
    """Return coordinates and their rates, (n, N) each, as (N, 3, n), in memory, too."""
    count, size = rates[0].shape
    out = np.empty((size, 3, count), dtype=np.result_type(*rates))
    for i, x in enumerate(rates):
        out[:, i] = x.T
    return out


@dataclass(frozen=True, eq=False)
class Loads:
    """What loads the bodies of a tree; (force, moment).

    Attributes:
        outboard: on every body's interfaces by number, in the body's components.
        joints: on the frames of bodies by all that hangs on them, themselves included.
    """

    outboard: list[dict[int, Load]]
    joints: dict[int, Load]


def inward_pass(
    tree: Mechanism, links: list[Link], driven: bool = True, pull: Mapping[Site, Load] = NOTHING
) -> Loads:
    """Return the loads of all bodies; on frames, unless `driven`, those that deform a body.

    Args:
        tree, links: as they move.
        driven: whether all frames' are asked for.
        pull: more loads on interfaces, in their components.
    """
    outboard: list[dict[int, Load]] = [{} for _ in links]
    joints: dict[int, Load] = {}
    for i in reversed(tree.order):
        link, felt = links[i], driven or tree.is_felt(i)
        if not (felt or link.body.is_flexible):
            continue
        for s, interface in link.interfaces.items():
            hanging = tree.hanging.get((i, s), ())
            on_it = [links[k] for k in hanging]
            parts = [links[k].joint.at_interface(joints[k]) for k in hanging]
            parts += [one.rotor.load for one in on_it if one.rotor is not None]
            if s in link.carried:
                parts.append(link.carried[s].load)
            if (i, s) in pull:
                parts.append(pull[i, s])
            loads = [interface.in_body(_sum(parts))] if parts else []
            if s in link.applied:
                loads.append(link.applied[s].load)
            outboard[i][s] = _sum(loads)
        if felt:
            parts = [link.interfaces[s].at_origin(load) for s, load in outboard[i].items()]
            joints[i] = _sum([link.body.load, *parts])
    return Loads(outboard, joints)


def carried_load(link: Link, loads: dict[int, Load], s: int) -> Load:
    """Return the part of `Loads.outboard` that turns with an interface: without given forces."""
    force, moment = loads[s]
    if s not in link.applied:
        return force, moment
    applied = link.applied[s].load
    return force - applied[0], moment - applied[1]


def _sum(loads: list[Load]) -> Load:
    force, moment = loads[0]
    for more in loads[1:]:
        force, moment = force + more[0], moment + more[1]
    return force, moment


def elastic_rows(links: list[Link], loads: Loads) -> np.ndarray:
    """Return the elastic residual (n, N)."""
    rows = [np.zeros((0, links[0].body.a.shape[1]))]
    for link, outboard in zip(links, loads.outboard, strict=True):
        if link.body.is_flexible:
            rows.append(link.body.rows(interface_pushes(link, outboard)))
    return np.concatenate(rows).T


def interface_pushes(link: Link, outboard: dict[int, Load]) -> dict[int, np.ndarray]:
    """Return what works on the displacements of a flexible body's interfaces, by number."""
    return {s: link.interfaces[s].pushes(load) for s, load in outboard.items()}


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
    tree: Mechanism = mechanism
    links = outward_pass(tree, motion, (q, qd, qdd))
    loads = inward_pass(tree, links)
    forces = np.zeros((len(q), tree.num_rigid + len(tree.motor_joints)))
    for i in tree.movable:
        forces[:, tree.joints[i].coordinate] = links[i].joint.drive(loads.joints[i])
    for i, k in tree.rotors.items():
        if (rotor := links[i].rotor) is not None:
            forces[:, k] += rotor.force
    if tree.cart is not None:
        forces[:, 0] = tree.cart * motion.qdd[:, 0]
        for i in tree.hanging[GROUND, 0]:
            forces[:, 0] += links[i].joint.at_interface(loads.joints[i])[0][0]
    if tree.friction is not None:
        forces[:, : tree.num_rigid] += tree.friction.force(motion.qd)
    return elastic_rows(links, loads), forces


def elastic_residual(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Return the elastic residual (n, N) of `inverse_dynamics` alone."""
    links = outward_pass(mechanism, motion, (q, qd, qdd))
    return elastic_rows(links, inward_pass(mechanism, links, driven=False))


# -- what loads every body: its frame's acceleration, and from outboard ------------------------


def body_loads(
    mechanism: Mechanism, motion: RigidMotion, rates: Rates, pull: Mapping[Site, Load] = NOTHING
) -> list[np.ndarray]:
    """Return what loads every body in the order of its K0 and K0_outboard (n, P).

    In the plane (a_x, a_y, wd, -w^2, F_x, F_y, T), in space (a, A_ab, force, moment). The moment is
    what works on the rotation vector of the interface. Of several interfaces force and moment of
    one stand behind those of the other.

    Args:
        mechanism, motion, rates: as for `inverse_dynamics`.
        pull: see `inward_pass`.
    """
    links = outward_pass(mechanism, motion, rates, pull)
    return _body_loads(links, inward_pass(mechanism, links, pull=pull).outboard)


def _body_loads(links: list[Link], outboard: list[dict[int, Load]]) -> list[np.ndarray]:
    found = []
    for link, loads in zip(links, outboard, strict=True):
        pulls = {s: np.concatenate(load) for s, load in loads.items()}
        if link.body.is_flexible:
            pulls = interface_pushes(link, loads)
        p, order = link.body.pushes(pulls), link.body.dim.loads
        found.append(np.concatenate([p[order], p[len(order) :]]).T)
    return found


def is_loaded_at_rest(mechanism: Mechanism, motion: RigidMotion) -> bool:
    """Return whether anything loads the bodies while they are not deformed."""
    rest = np.zeros((len(motion.q), mechanism.num_coordinates))
    return any(p.any() for p in body_loads(mechanism, motion, (rest, rest, rest)))


def load_coefficients(mechanism: Mechanism, motion: RigidMotion, rates: Rates) -> list[np.ndarray]:
    """Return c (n, P + g q) of every body: what loads its nodes, as inertia acts.

    c = -(p, alpha_c z + beta_c z' + trace_c z''), p of `body_loads`, c before the modes, z being
    the displacement along them, see `body_motion`. See `dynamics.simulation`.
    """
    links = outward_pass(mechanism, motion, rates)
    loads = _body_loads(links, inward_pass(mechanism, links).outboard)
    found = []
    for link, p in zip(links, loads, strict=True):
        elastic = link.body.accelerations(link.body.z)
        found.append(-np.hstack([p, elastic.reshape(-1, len(p)).T]))
    return found


# -- how much the loads of a motion stiffen or soften the arms, before anything is simulated -----


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
    mechanism: Mechanism,
    motion: RigidMotion,
    loops: Loops | None = None,
    dependent: np.ndarray | None = None,
) -> float:
    """Return the largest |eigenvalue| of K^-1 sum_p p K0_p over arms and instants.

    The loads p are those of the machine with rigid arms on the desired motion.

    Args:
        mechanism: bodies with geometric stiffness.
        motion: at n instants.
        loops: closures; or None.
        dependent: rigid coordinates that follow from them.
    """
    largest = 0.0
    loads = _loads(mechanism.rigid, motion, loops, dependent)
    for body, p in zip(mechanism.bodies, loads, strict=True):
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


def _loads(
    rigid: Mechanism, motion: RigidMotion, loops: Loops | None, dependent: np.ndarray | None
) -> list[np.ndarray]:
    """Return what loads every body (n, loads); in the plane a_x, a_y, wd, -w^2, F_x, F_y, T."""
    none = np.zeros((len(motion.q), 0))
    pull: Mapping[Site, Load] = {}
    if loops is not None and dependent is not None:
        forces = inverse_dynamics(rigid, motion, none, none, none)[1]
        here = loops.at(rigid, motion.q, none)
        pull = here.pulls(here.closing(forces, dependent))
    return body_loads(rigid, motion, (none, none, none), pull)
