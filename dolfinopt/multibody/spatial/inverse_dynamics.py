"""Recursive Newton-Euler in space: joint forces and elastic residual of a motion, n instants.

One pass out along the tree for the motion of every frame, one back for forces and moments. Source:
Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 5; Schwertassek & Wallrapp (1999).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals
from dolfinopt.multibody.spatial.kinematics import (
    BodyMotion,
    Interface,
    Load,
    Motion,
    MovingJoint,
    Weights,
    with_outboard,
)
from dolfinopt.multibody.spatial.mechanism import (
    GROUND,
    ONE,
    Site,
    SpatialMechanism,
    cross,
    times,
    transposed_times,
)


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


def outward_pass(mechanism: SpatialMechanism, motion: RigidMotion, rates: Rates) -> list[Link]:
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
    motion: RigidMotion,
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
    motion: RigidMotion,
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
    mechanism: SpatialMechanism, motion: RigidMotion, rates: Rates
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


# -- tangent of inverse dynamics in space: derivative of joint forces and elastic residual -------
#
# Both passes of `inverse_dynamics` are differentiated by the coordinates that are asked for. A body
# feels those inboard of it through the nine numbers (a, w, wd) of its frame, those outboard of it
# through the six of the load on each of its interfaces: its rows are a block of its own coordinates
# and a rank of fifteen with one interface.


@dataclass(frozen=True, eq=False)
class BodyTangent:
    """Derivative of one body's q elastic rows by S coordinates; arrays over n instants.

    r' = K e' + D ed' + M edd' + left (right y') with y = [q, qd, qdd] of all S coordinates.

    Attributes:
        rows, columns: its place among all rows and among the S columns.
        kept: those of its coordinates that have a column.
        K, D: (n, q, q).
        M: (n, q, q), or (q, q) of a body whose mass is the same in every shape.
        left: (n, q, r).
        right: (n, r, 3 S).
    """

    rows: slice
    columns: slice
    kept: np.ndarray
    K: np.ndarray
    D: np.ndarray
    M: np.ndarray
    left: np.ndarray
    right: np.ndarray

    def at(self, part: slice) -> BodyTangent:
        """Return it at some of the instants."""
        changed = {name: getattr(self, name)[part] for name in ("K", "D", "left", "right")}
        return replace(self, M=self.M if self.M.ndim == 2 else self.M[part], **changed)


@dataclass(frozen=True, eq=False)
class SpatialTangent:
    """Derivative of the rows [joint forces asked for (R), elastic residual (N)], see `Tangent`.

    The S coordinates are the R joints, then those elastic ones that are kept; n instants.

    Attributes:
        bodies: the flexible ones, in the order of their rows.
        size: S.
        drives: (n, R, 3 S) of the forces of the joints, columns ordered q, qd, qdd.
    """

    bodies: tuple[BodyTangent, ...]
    size: int
    drives: np.ndarray

    def window(self, first: int, last: int) -> SpatialTangent:
        """Return the instants first..last - 1."""
        part = slice(first, last)
        bodies = tuple(body.at(part) for body in self.bodies)
        return replace(self, bodies=bodies, drives=self.drives[part])

    def dense(self) -> np.ndarray:
        """Return the S coordinates' own rows (n, S, 3 S), columns ordered q, qd, qdd."""
        size = self.size
        jacobian = np.empty((len(self.drives), size, 3 * size))
        jacobian[:, : self.drives.shape[1]] = self.drives
        for part in self.bodies:
            rows, own = jacobian[:, part.columns], (..., part.kept[:, None], part.kept)
            np.matmul(part.left[:, part.kept], part.right, out=rows)
            blocks = (part.K[own], part.D[own], part.M[own])
            for columns, block in zip(_columns(part.columns, size), blocks, strict=True):
                rows[:, :, columns] += block
        return jacobian

    def times(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, wanted: np.ndarray
    ) -> np.ndarray:
        """Return the change of W wanted rows (m, W) by one of the S coordinates, each (m, S).

        With m a multiple of the n instants, each of them stands for as many rows in turn.
        """
        count, rigid = self.drives.shape[:2]
        change = np.concatenate([q, qd, qdd], axis=1).reshape(count, -1, 3 * self.size)
        change = change.swapaxes(1, 2)  # (n, 3 S, times)
        out = []
        if rigid:
            out.append(self.drives[:, wanted[wanted < rigid]] @ change)
        for part in self.bodies:
            own = wanted[(wanted >= part.rows.start) & (wanted < part.rows.stop)] - part.rows.start
            e, ed, edd = (change[:, columns] for columns in _columns(part.columns, self.size))
            rows = part.left[:, own] @ (part.right @ change)
            rows += part.K[:, own[:, None], part.kept] @ e
            rows += part.D[:, own[:, None], part.kept] @ ed
            rows += part.M[..., own[:, None], part.kept] @ edd
            out.append(rows)
        found: np.ndarray = np.concatenate(out, axis=1).swapaxes(1, 2)
        return found.reshape(len(q), len(wanted))

    def transposed(self, rows: np.ndarray) -> Rates:
        """Return the gradient of sum_n rows_n . [forces, residual]_n by q, qd, qdd, each (n, S)."""
        size, rigid = self.size, self.drives.shape[1]
        gradient = (rows[:, None, :rigid] @ self.drives)[:, 0]
        for part in self.bodies:
            y = rows[:, None, part.rows]
            gradient += ((y @ part.left) @ part.right)[:, 0]
            blocks = (part.K[:, :, part.kept], part.D[:, :, part.kept], part.M[..., part.kept])
            for columns, block in zip(_columns(part.columns, size), blocks, strict=True):
                gradient[:, columns] += (y @ block)[:, 0]
        by_q, by_v, by_a = np.split(gradient, 3, axis=1)
        return by_q, by_v, by_a


def _columns(part: slice, size: int) -> tuple[slice, slice, slice]:
    a, b = part.start, part.stop
    return slice(a, b), slice(size + a, size + b), slice(2 * size + a, 2 * size + b)


@dataclass(frozen=True, eq=False)
class _Places:
    """Where the coordinates asked for stand among the S columns.

    Attributes:
        size: S.
        rigid: (R,) joint coordinates asked for, ascending.
        kept: of every body, those of its coordinates that have a column.
        bodies: of every body, their place among the S.
    """

    size: int
    rigid: np.ndarray
    kept: list[np.ndarray]
    bodies: list[slice]

    def of_body(self, i: int) -> tuple[slice, slice, slice]:
        """Return a body's columns in [q, qd, qdd]."""
        return _columns(self.bodies[i], self.size)

    def of_joint(self, link: Link) -> tuple[int, int, int] | None:
        """Return the columns of a joint's coordinate, if any."""
        place = np.flatnonzero(self.rigid == link.joint.joint.coordinate)
        if link.joint.joint.coordinate is None or len(place) == 0:
            return None
        return int(place[0]), self.size + int(place[0]), 2 * self.size + int(place[0])


def _places(
    mechanism: SpatialMechanism, keep: np.ndarray | None, rigid: np.ndarray | None
) -> _Places:
    rigid = np.zeros(0, dtype=int) if rigid is None else rigid
    keep = np.arange(mechanism.num_coordinates) if keep is None else keep
    ends = np.searchsorted(keep, [0, *(part.stop for part in mechanism.slices)])
    parts = zip(pairwise(ends), mechanism.slices, strict=True)
    kept = [keep[a:b] - part.start for (a, b), part in parts]
    bodies = [slice(a, b) for a, b in pairwise(ends + len(rigid))]
    return _Places(len(rigid) + len(keep), rigid, kept, bodies)


def linearise(
    mechanism: SpatialMechanism,
    motion: RigidMotion,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    keep: np.ndarray | None = None,
    rigid: np.ndarray | None = None,
) -> SpatialTangent:
    """Return the derivative of `inverse_dynamics` by the coordinates asked for and their rates.

    Args:
        mechanism, motion, q, qd, qdd: as for `inverse_dynamics`; n instants.
        keep: ascending elastic coordinates by which to differentiate; all by default.
        rigid: ascending joint coordinates (R,) that have columns and whose forces have rows; none
            by default.
    """
    links = outward_pass(mechanism, motion, (q, qd, qdd))
    loads = inward_pass(mechanism, links)
    places = _places(mechanism, keep, rigid)
    motions, ends = _outward_derivatives(mechanism, links, places)
    return _inward_derivatives(mechanism, links, loads, places, motions, ends)


_Derivatives = list[np.ndarray | None]  # None: nothing moves
_Ends = dict[Site, np.ndarray | None]


def _outward_derivatives(
    mechanism: SpatialMechanism, links: list[Link], places: _Places
) -> tuple[_Derivatives, _Ends]:
    """Return the derivatives of the motion of every body and interface (n, 9, 3 S)."""
    count, width = len(links[0].body.a), 3 * places.size
    motions: _Derivatives = [None] * len(links)
    ends: _Ends = {}
    for i in mechanism.order:
        link, joint = links[i], mechanism.joints[i]
        inner = None if joint.parent == GROUND else ends[joint.parent, joint.interface]
        moved = None if inner is None else link.joint.motion_by_interface @ inner
        if (columns := places.of_joint(link)) is not None:
            moved = np.zeros((count, 9, width)) if moved is None else moved
            for column, one in zip(columns, link.joint.motion_by_joint, strict=True):
                moved[:, :, column] += one
        motions[i] = moved
        for s, interface in link.interfaces.items():
            end = None if moved is None else interface.motion_by_body @ moved
            if len(places.kept[i]):
                end = np.zeros((count, 9, width)) if end is None else end
                parts = zip(places.of_body(i), interface.motion_by_rates, strict=True)
                for place, derivative in parts:
                    end[:, :, place] += derivative[:, :, places.kept[i]]
            ends[i, s] = end
    return motions, ends


def _inward_derivatives(
    mechanism: SpatialMechanism,
    links: list[Link],
    loads: Loads,
    places: _Places,
    motions: _Derivatives,
    ends: _Ends,
) -> SpatialTangent:
    """Return the tangent from the derivatives of all motions."""
    count, size, rigid = len(links[0].body.a), places.size, places.rigid
    drives = np.zeros((count, len(rigid), 3 * size))
    on_joints: dict[int, np.ndarray] = {}  # derivative of every joint's load (n, 6, 3 S)
    tangents: list[BodyTangent] = []
    for i in reversed(mechanism.order):
        link, moved = links[i], motions[i]
        felt = rigid.size > 0 or _is_felt(mechanism, i)
        if not (felt or link.body.is_flexible):
            continue
        load = np.zeros((count, 6, 3 * size))
        outboard: dict[int, np.ndarray] = {}
        for s, interface in link.interfaces.items():
            end = ends[i, s]
            pull = outboard[s] = _on_interface(
                mechanism, links, loads, places, (i, s), on_joints, end
            )
            load += pull
            lever = np.broadcast_to(interface.place, link.body.a.shape)
            load[:, 3:] += _cross(lever, pull[:, :3])
        if link.body.is_flexible:
            tangents.append(_body_tangent(mechanism, link, loads, places, i, outboard, moved))
        if not felt:
            continue
        if moved is not None:
            load += link.body.load_by_motion @ moved
        if len(kept := places.kept[i]):
            own = link.body.load_by_rates
            for place, derivative in zip(places.of_body(i), own, strict=True):
                load[:, :, place] += derivative[:, :, kept]
            for s, interface in link.interfaces.items():
                displaced = np.broadcast_to(interface.B, (count, *interface.B.shape[-2:]))
                force = loads.outboard[i][s][0]
                load[:, 3:, places.of_body(i)[0]] -= _cross(force, displaced[:, :3, kept])
        on_joints[i] = load
        if (columns := places.of_joint(link)) is not None:
            drives[:, columns[0]] = link.joint.driven @ load
            drives[:, columns[0], columns[2]] += link.joint.joint.rotor
    tangents.sort(key=lambda part: part.rows.start)
    return SpatialTangent(tuple(tangents), size, drives)


def _is_felt(mechanism: SpatialMechanism, i: int) -> bool:
    """Return whether a body inboard of body i deforms under its load."""
    parent = mechanism.joints[i].parent
    if parent == GROUND:
        return False
    return mechanism.constants[parent].num_modes > 0 or _is_felt(mechanism, parent)


def _on_interface(
    mechanism: SpatialMechanism,
    links: list[Link],
    loads: Loads,
    places: _Places,
    site: Site,
    on_joints: dict[int, np.ndarray],
    end: np.ndarray | None,
) -> np.ndarray:
    """Return the derivative of the load on a body's interface, in the body's components."""
    i, s = site
    link, count = links[i], len(links[0].body.a)
    interface, total = link.interfaces[s], np.zeros((count, 6, 3 * places.size))
    for k in mechanism.hanging(i, s):
        joint = links[k].joint
        total += joint.load_by_body @ on_joints[k]
        if (columns := places.of_joint(links[k])) is not None:
            total[:, :, columns[0]] += joint.load_by_joint(loads.joints[k])
    if s in link.carried and end is not None:
        total += link.carried[s].load_by_motion @ end
    if not link.body.is_flexible:
        return total
    shape = total.shape
    turned = interface.turning.R[:, None] @ total.reshape(count, 2, 3, -1)
    total = turned.reshape(shape)
    if len(kept := places.kept[i]):
        by_e = interface.load_by_displacement(loads.outboard[i][s]) @ interface.B
        total[:, :, places.of_body(i)[0]] += by_e[:, :, kept]
    return total


def _body_tangent(
    mechanism: SpatialMechanism,
    link: Link,
    loads: Loads,
    places: _Places,
    i: int,
    outboard: dict[int, np.ndarray],
    moved: np.ndarray | None,
) -> BodyTangent:
    """Return the derivative of body i's rows."""
    part, body = mechanism.slices[i], link.body
    K, D, M = body.rows_by_rates
    count, q = body.rates[0].shape
    left, right = [np.zeros((count, q, 0))], [np.zeros((count, 0, 3 * places.size))]
    for s, interface in link.interfaces.items():
        K = K + interface.rows_by_e(loads.outboard[i][s])
        left.append(interface.rows_by_load)
        right.append(outboard[s])
    if moved is not None:
        left.append(body.rows_by_motion)
        right.append(moved)
    first = len(places.rigid)
    return BodyTangent(
        rows=slice(first + part.start, first + part.stop),
        columns=places.bodies[i],
        kept=places.kept[i],
        K=K,
        D=D,
        M=M,
        left=np.concatenate(left, axis=2),
        right=np.concatenate(right, axis=1),
    )


def _cross(u: np.ndarray, V: np.ndarray) -> np.ndarray:
    """Return u x every column of V, (n, 3) and (n, 3, m)."""
    u = u[:, :, None]
    out = np.empty(V.shape)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = u[:, j] * V[:, k] - u[:, k] * V[:, j]
    return out


# -- vector-Jacobian product of inverse dynamics in space with the integrals of every body -------
#
# The multipliers are a virtual displacement, which runs out along the tree like velocities do; its
# products with inertia and elastic forces are linear in every integral. The outboard interface
# enters through the kinematics, too: a pass back carries the derivatives by the frames' motion.


def body_gradient(
    mechanism: SpatialMechanism,
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
        of_forces: (n, joints) of the joints' forces; none by default.

    Returns:
        The derivative by every body's integrals.
    """
    if of_forces is None:
        of_forces = np.zeros((len(q), mechanism.num_rigid))
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
