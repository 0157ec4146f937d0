"""Recursive Newton-Euler in space: joint forces and elastic residual of a motion, n instants.

One pass out along the tree for the motion of every frame, one back for forces and moments. Source:
Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 5; Schwertassek & Wallrapp (1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.modal_displacement import Rates
from dolfinopt.multibody.spatial.body_motion import BodyMotion
from dolfinopt.multibody.spatial.kinematics import Interface, Load, Motion, MovingJoint
from dolfinopt.multibody.spatial.mechanism import GROUND, SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.rotations import ONE


@dataclass(frozen=True, eq=False)
class Link:
    """One body of the tree as it moves.

    Attributes:
        joint: that holds it.
        body: itself.
        interfaces: its outboard ones on which something sits, by number.
        carried: what it carries there without a joint, as it moves, by number.
    """

    joint: MovingJoint
    body: BodyMotion
    interfaces: dict[int, Interface]
    carried: dict[int, BodyMotion]


def outward_pass(mechanism: SpatialMechanism, motion: JointMotion, rates: Rates) -> list[Link]:
    """Return all bodies as they move, in the mechanism's order."""
    count = len(motion.q)
    none = np.zeros((count, 0))
    ground: Motion = (np.tile(-mechanism.gravity, (count, 1)), *np.zeros((2, count, 3)))
    links: dict[int, Link] = {}
    for i in mechanism.order:
        joint, own = mechanism.joints[i], None
        if (k := joint.coordinate) is not None:
            own = (motion.q[:, k], motion.qd[:, k], motion.qdd[:, k])
        inner = ground
        if joint.parent != GROUND:
            inner = links[joint.parent].interfaces[joint.interface].motion
        moving = MovingJoint(joint, inner, own)
        part = mechanism.slices[i]
        e, ed, edd = (x[:, part] for x in rates)
        body = BodyMotion(mechanism.constants[i], moving.motion, (e, ed, edd))
        interfaces = {s: Interface(body, s) for s in mechanism.sites[i]}
        carried = {
            s: BodyMotion(mechanism.loads[i, s], interface.motion, (none, none, none))
            for s, interface in interfaces.items()
            if (i, s) in mechanism.loads
        }
        links[i] = Link(moving, body, interfaces, carried)
    return [links[i] for i in range(len(links))]


@dataclass(frozen=True, eq=False)
class Loads:
    """What loads the bodies of a tree; (force, moment), each (n, 3).

    Attributes:
        outboard: on every body's interfaces by number, in the body's components.
        joints: on every body's frame by all that hangs on it, itself included.
    """

    outboard: list[dict[int, Load]]
    joints: list[Load]


def inward_pass(mechanism: SpatialMechanism, links: list[Link]) -> Loads:
    """Return the loads of all bodies as they move."""
    outboard: list[dict[int, Load]] = [{} for _ in links]
    joints: dict[int, Load] = {}
    for i in reversed(mechanism.order):
        link = links[i]
        force, moment = link.body.load
        for s, interface in link.interfaces.items():
            parts = [links[k].joint.at_interface(joints[k]) for k in mechanism.hanging(i, s)]
            if s in link.carried:
                parts.append(link.carried[s].load)
            total = (sum(part[0] for part in parts), sum(part[1] for part in parts))
            outboard[i][s] = load = interface.in_body(total)  # type: ignore[arg-type]
            more = interface.at_origin(load)
            force, moment = force + more[0], moment + more[1]
        joints[i] = (force, moment)
    return Loads(outboard, [joints[i] for i in range(len(links))])


def elastic_rows(links: list[Link], loads: Loads) -> np.ndarray:
    """Return the elastic residual (n, N)."""
    rows = [np.zeros((len(links[0].body.a), 0))]
    for link, outboard in zip(links, loads.outboard, strict=True):
        if not link.body.is_flexible:
            continue
        own = link.body.rows
        for s, load in outboard.items():
            own = own + link.interfaces[s].rows(load)
        rows.append(own)
    return np.concatenate(rows, axis=1)


def inverse_dynamics(
    mechanism: SpatialMechanism,
    motion: JointMotion,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the generalised force of every coordinate.

    Args:
        mechanism: N elastic coordinates.
        motion: joints at n instants.
        q, qd, qdd: (n, N) elastic coordinates and derivatives.

    Returns:
        Elastic residual (n, N), zero when the equations of motion hold, and what drives the joints
        (n, joints), N m of revolute and N of prismatic ones.
    """
    links = outward_pass(mechanism, motion, (q, qd, qdd))
    loads = inward_pass(mechanism, links)
    drives = [links[i].joint.drive(loads.joints[i]) for i in mechanism.movable]
    forces = np.stack(drives, axis=1) if drives else np.zeros((len(q), 0))
    forces = forces + mechanism.rotors * motion.qdd
    return elastic_rows(links, loads), forces


def elastic_residual(
    mechanism: SpatialMechanism,
    motion: JointMotion,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
) -> np.ndarray:
    """Return the elastic residual (n, N) of `inverse_dynamics` alone."""
    links = outward_pass(mechanism, motion, (q, qd, qdd))
    return elastic_rows(links, inward_pass(mechanism, links))


# -- what loads every body: its frame's acceleration, and from outboard ------------------------


def body_loads(links: list[Link], outboard: list[dict[int, Load]]) -> list[np.ndarray]:
    """Return p = (a, A_ab, force, moment) (n, 18) of every body.

    The moment is what works on the rotation vector of the interface. Of several interfaces force
    and moment of one stand behind those of the other.
    """
    found = []
    for link, loads in zip(links, outboard, strict=True):
        count = len(link.body.a)
        pull = np.zeros((count, len(link.body.constants.B)))
        for s, load in loads.items():
            flexible, interface = link.body.is_flexible, link.interfaces[s]
            own = interface.conjugate(load) if flexible else np.hstack(load)
            pull[:, interface.rows_of] = own
        found.append(np.hstack([link.body.a, link.body.A.reshape(count, 9), pull]))
    return found


def load_coefficients(
    mechanism: SpatialMechanism, motion: JointMotion, rates: Rates
) -> list[np.ndarray]:
    """Return c (n, 18 + 9 q) of every body: what loads its nodes, as inertia acts.

    c = -(a, A_ab, force, moment, A_ab z + 2 Omega_ab zd + delta_ab zdd), ab before the modes,
    z being the displacement along them, see `modal_displacement`.
    """
    links = outward_pass(mechanism, motion, rates)
    found = []
    for link, p in zip(links, body_loads(links, inward_pass(mechanism, links).outboard)):
        modal = link.body.modal
        z, zd, zdd = (x[:, None, None] for x in (modal.z, modal.zd, modal.zdd))
        A, Omega = link.body.A[..., None], link.body.Omega[..., None]
        elastic = A * z + 2.0 * Omega * zd + ONE[:, :, None] * zdd
        found.append(-np.hstack([p, elastic.reshape(len(p), -1)]))
    return found
