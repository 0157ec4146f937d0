"""Tangent of inverse dynamics, and its vector-Jacobian product with the integrals of every body.

Both passes of `inverse_dynamics` are differentiated by the coordinates that are asked for. A body
feels those inboard of it through the motion (a, w, wd) of its frame, those outboard of it
through the load on each of its interfaces: its rows are a block of its own coordinates and a low
rank. Derivatives of motions and loads are (n, ., 3 S): what carries them on is one product with
the matrices of `kinematics.Passage`, which BLAS multiplies four to ten times as fast as `einsum`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dolfinopt.multibody.body_motion import BodyMotion, Load, Motion, Weights
from dolfinopt.multibody.inverse_dynamics import (
    Link,
    Loads,
    carried_load,
    interface_pushes,
    inward_pass,
    outward_pass,
)
from dolfinopt.multibody.kinematics import Interface
from dolfinopt.multibody.measured import DERIVATIVES_BYTES, LEAST_INSTANTS
from dolfinopt.multibody.mechanism import GROUND, Mechanism, Site
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals


@dataclass(frozen=True, eq=False)
class BodyTangent:
    """Derivative of one body's q elastic rows by S coordinates; arrays over n instants.

    r' = K e' + D ed' + M edd' + sum_f left_f (right_f y') with y = [q, qd, qdd] of all S
    coordinates and those k coordinates e of its own that have a column.

    Attributes:
        rows, columns: its place among all rows and among the S columns.
        kept: (k,) those of its coordinates that have a column.
        K, D: (n, q, k).
        M: (n, q, k), or (q, k) of a body whose mass is the same in every shape.
        factors: pairs left_f (n, q, r) and right_f (n, r, 3 S), a load or a motion each; of fewer
            rows than those of all right_f one, their sum, with no left_f.
    """

    rows: slice
    columns: slice
    kept: np.ndarray
    K: np.ndarray
    D: np.ndarray
    M: np.ndarray
    factors: tuple[tuple[np.ndarray | None, np.ndarray], ...]

    def at(self, part: slice) -> BodyTangent:
        """Return it at some of the instants."""
        M = self.M if self.M.ndim == 2 else self.M[part]
        pairs = (
            (None if left is None else left[part], right[part]) for left, right in self.factors
        )
        return replace(self, K=self.K[part], D=self.D[part], M=M, factors=tuple(pairs))


@dataclass(frozen=True, eq=False)
class Tangent:
    """Derivative of the rows [joint forces asked for (R), elastic residual (N)] by S coordinates.

    The S coordinates are the R joints, then those elastic ones that are kept; n instants.

    Attributes:
        bodies: the flexible ones, in the order of their rows.
        size: S.
        drives: (n, R, 3 S) of the forces of the joints, columns ordered q, qd, qdd.
    """

    bodies: tuple[BodyTangent, ...]
    size: int
    drives: np.ndarray

    def window(self, first: int, last: int) -> Tangent:
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
            rows, kept = jacobian[:, part.columns], part.kept
            if not part.factors:
                rows[:] = 0.0
            for k, (left, right) in enumerate(part.factors):
                own = right[:, kept] if left is None else left[:, kept] @ right
                if k == 0:
                    rows[:] = own
                else:
                    rows += own
            blocks = (part.K[:, kept], part.D[:, kept], part.M[..., kept, :])
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
            rows = part.K[:, own] @ e
            for left, right in part.factors:
                rows += right[:, own] @ change if left is None else left[:, own] @ (right @ change)
            rows += part.D[:, own] @ ed
            rows += part.M[..., own, :] @ edd
            out.append(rows)
        found: np.ndarray = np.concatenate(out, axis=1).swapaxes(1, 2)
        return found.reshape(len(q), len(wanted))

    def transposed(self, rows: np.ndarray) -> Rates:
        """Return the gradient of sum_m rows_m . [forces, residual]_m by q, qd, qdd, each (m, S).

        With m a multiple of the n instants, each of them stands for as many rows in turn.
        """
        size, (count, rigid) = self.size, self.drives.shape[:2]
        every = rows.reshape(count, -1, rows.shape[1])
        gradient = every[:, :, :rigid] @ self.drives
        for part in self.bodies:
            y = every[:, :, part.rows]
            for left, right in part.factors:
                gradient += (y if left is None else y @ left) @ right
            blocks = (part.K, part.D, part.M)
            for columns, block in zip(_columns(part.columns, size), blocks, strict=True):
                gradient[:, :, columns] += y @ block
        by_q, by_v, by_a = np.split(gradient.reshape(len(rows), -1), 3, axis=1)
        return by_q, by_v, by_a


def _columns(part: slice, size: int) -> tuple[slice, slice, slice]:
    a, b = part.start, part.stop
    return slice(a, b), slice(size + a, size + b), slice(2 * size + a, 2 * size + b)


@dataclass(frozen=True, eq=False)
class _Places:
    """Where the coordinates asked for stand among the S columns."""

    size: int  # S
    rigid: np.ndarray  # (R,) joint coordinates asked for, ascending
    kept: list[np.ndarray]  # of every body, those of its coordinates that have a column
    bodies: list[slice]  # of every body, their place among the S

    def add(self, to: np.ndarray, i: int, derivatives: np.ndarray) -> None:
        """Add derivatives by body i's coordinates and rates (., 3, k, n) to all, (n, ., 3 S)."""
        every = to.reshape(*to.shape[:2], 3, self.size)
        every[..., self.bodies[i]] += derivatives.transpose(3, 0, 1, 2)

    def of_joint(self, coordinate: int | None) -> tuple[int, int, int] | None:
        """Return the columns of a joint's coordinate, if any."""
        place = np.flatnonzero(self.rigid == coordinate)
        if coordinate is None or len(place) == 0:
            return None
        return int(place[0]), self.size + int(place[0]), 2 * self.size + int(place[0])


def _places(tree: Mechanism, keep: np.ndarray | None, rigid: np.ndarray | None) -> _Places:
    rigid = np.zeros(0, dtype=int) if rigid is None else rigid
    keep = np.arange(tree.num_coordinates) if keep is None else keep
    ends = np.searchsorted(keep, [0, *(part.stop for part in tree.slices)])
    parts = zip(pairwise(ends), tree.slices, strict=True)
    kept = [keep[a:b] - part.start for (a, b), part in parts]
    bodies = [slice(a, b) for a, b in pairwise(ends + len(rigid))]
    return _Places(len(rigid) + len(keep), rigid, kept, bodies)


def linearise(
    mechanism: Mechanism,
    motion: RigidMotion,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    keep: np.ndarray | None = None,
    rigid: np.ndarray | None = None,
) -> Tangent:
    """Return the derivative of `inverse_dynamics` by the coordinates asked for and their rates.

    Args:
        mechanism, motion, q, qd, qdd: as for `inverse_dynamics`; n instants.
        keep: ascending elastic coordinates by which to differentiate; all by default.
        rigid: ascending joint coordinates (R,) that have columns and whose forces have rows; none
            by default.
    """
    places, count, dim = _places(mechanism, keep, rigid), len(q), mechanism.dim
    # Of motion and load of a frame and of an interface of every body.
    size = 8 * 3 * places.size * (4 * dim.d + 6 * dim.r) * len(mechanism.order)
    chunks = max(1, round(count * size / DERIVATIVES_BYTES))
    ends = np.linspace(0, count, min(chunks, max(count // LEAST_INSTANTS, 1)) + 1).astype(int)
    if len(ends) == 2:
        return _linearise(mechanism, motion, (q, qd, qdd), places)
    return _joined(
        [
            _linearise(mechanism[part], motion[part], (q[part], qd[part], qdd[part]), places)
            for part in (slice(a, b) for a, b in pairwise(ends))
        ]
    )


def _joined(parts: list[Tangent]) -> Tangent:
    """Return the tangents of instants that follow each other as one."""
    bodies = []
    for same in zip(*(one.bodies for one in parts), strict=True):
        M = same[0].M if same[0].M.ndim == 2 else np.concatenate([one.M for one in same])
        pairs = zip(*(one.factors for one in same), strict=True)
        factors = tuple(
            (
                None if every[0][0] is None else np.concatenate([x for x, _ in every]),
                np.concatenate([x for _, x in every]),
            )
            for every in pairs
        )
        K, D = (np.concatenate(x) for x in zip(*((one.K, one.D) for one in same), strict=True))
        bodies.append(replace(same[0], K=K, D=D, M=M, factors=factors))
    drives = np.concatenate([one.drives for one in parts])
    return Tangent(tuple(bodies), parts[0].size, drives)


def _linearise(tree: Mechanism, motion: RigidMotion, rates: Rates, places: _Places) -> Tangent:
    """Return the derivative at some of the instants."""
    links = outward_pass(tree, motion, rates)
    loads = inward_pass(tree, links, driven=len(places.rigid) > 0)
    motions, ends = _outward_derivatives(tree, links, places)
    found = _inward_derivatives(tree, links, loads, places, motions, ends)
    if tree.friction is not None and len(places.rigid):
        own = np.arange(len(places.rigid))
        slopes = tree.friction.slope(motion.qd)[:, places.rigid]
        found.drives[:, own, places.size + own] += slopes
    return found


_Derivatives = dict[int, np.ndarray]  # of what moves
_Ends = dict[Site, np.ndarray]


def _outward_derivatives(
    tree: Mechanism, links: list[Link], places: _Places
) -> tuple[_Derivatives, _Ends]:
    """Return the derivatives of the motion of every body and interface (n, d + 2 r, 3 S)."""
    dim, count = links[0].body.dim, links[0].body.a.shape[1]
    shape = (count, dim.d + 2 * dim.r, 3 * places.size)
    motions: _Derivatives = {}
    ends: _Ends = {}
    if (columns := places.of_joint(tree.cart_coordinate)) is not None:
        ends[GROUND, 0] = np.zeros(shape)
        ends[GROUND, 0][:, 0, columns[2]] = 1.0
    for i in tree.order:
        link, joint = links[i], tree.joints[i]
        inner = ends.get((joint.parent, joint.interface))
        moved = None if inner is None else link.joint.passage.matrix @ inner
        if (columns := places.of_joint(joint.coordinate)) is not None:
            moved = np.zeros(shape) if moved is None else moved
            for column, one in zip(columns, link.joint.moved_by_joint, strict=True):
                moved[:, :, column] += one.T
        if moved is not None:
            motions[i] = moved
        for s, interface in link.interfaces.items():
            end = None if moved is None else interface.passage.matrix @ moved
            if len(kept := places.kept[i]):
                end = np.zeros(shape) if end is None else end
                places.add(end, i, interface.moved_by_rates(kept))
            if end is not None:
                ends[i, s] = end
    return motions, ends


def _inward_derivatives(
    tree: Mechanism,
    links: list[Link],
    loads: Loads,
    places: _Places,
    motions: _Derivatives,
    ends: _Ends,
) -> Tangent:
    """Return the tangent from the derivatives of all motions."""
    dim, count = links[0].body.dim, links[0].body.a.shape[1]
    size, rigid, d = places.size, places.rigid, links[0].body.dim.d
    drives = np.zeros((count, len(rigid), 3 * size))
    on_joints: _Derivatives = {}  # of every joint's load (n, d + r, 3 S)
    tangents: list[BodyTangent] = []
    for i in reversed(tree.order):
        link, felt = links[i], rigid.size > 0 or tree.is_felt(i)
        if not (felt or link.body.is_flexible):
            continue
        outboard = {
            s: _on_interface(tree, links, loads, places, (i, s), on_joints, ends.get((i, s)))
            for s in link.interfaces
        }
        given = _given(link, places, motions.get(i))
        if link.body.is_flexible:
            every = outboard, given
            tangents.append(_body_tangent(tree, link, loads, places, i, *every, motions.get(i)))
        if not felt:
            continue
        load = np.zeros((count, d + dim.r, 3 * size))
        if i in motions:
            np.matmul(_by_instant(link.body.load_by_motion), motions[i], out=load)
        if len(kept := places.kept[i]):
            places.add(load, i, _load_by_rates(link, loads.outboard[i], kept))
        for s, interface in link.interfaces.items():
            load += interface.passage.of_loads @ outboard[s]
            if s in given:
                load[:, :, :size] += given[s]
                lever = _by_instant(dim.by_spin(interface.place)).swapaxes(1, 2)
                load[:, d:, :size] += lever @ given[s][:, :d]
        on_joints[i] = load
        if (columns := places.of_joint(link.joint.joint.coordinate)) is not None:
            joint = link.joint
            drives[:, columns[0]] = joint.joint.axis @ (
                load[:, :d] if joint.slides else load[:, d:]
            )
            drives[:, columns[0], columns[2]] += tree.rotors[joint.joint.coordinate]
    if (columns := places.of_joint(tree.cart_coordinate)) is not None:
        drives[:, columns[0], columns[2]] = tree.rotors[0]
        for k in tree.hanging[GROUND, 0]:
            passed = _passed_on(links[k], loads.joints[k], places, on_joints[k])
            drives[:, columns[0]] += passed[:, 0]
    tangents.sort(key=lambda part: part.rows.start)
    return Tangent(tuple(tangents), size, drives)


def _load_by_rates(link: Link, outboard: dict[int, Load], kept: np.ndarray) -> np.ndarray:
    """Return the derivative of what a joint feels by those e, e', e'' of its body kept."""
    # (d + r, 3, k, n): of the body's inertia, and of where and how its interfaces are turned.
    body, dim, d = link.body, link.body.dim, link.body.dim.d
    found = body.load_by_rates(kept)
    for s, interface in link.interfaces.items():
        turned = interface.load_by_rates(carried_load(link, outboard, s), kept)
        found[:, 0] += turned
        found[d:, 0] += dim.moment(interface.place, turned[:d])
        displaced = body.V[interface.places][:d, kept]
        found[d:, 0] += dim.moment(displaced, outboard[s][0])
    return found


def _given(link: Link, places: _Places, moved: np.ndarray | None) -> dict[int, np.ndarray]:
    """Return the derivatives (n, d + r, S) by q of the forces of the world on the interfaces."""
    found: dict[int, np.ndarray] = {}
    if moved is None:
        return found
    dim, d, size = link.body.dim, link.body.dim.d, places.size
    turned = moved[:, d : d + dim.r, size : 2 * size]  # by q, as the spin by q'
    for s, applied in link.applied.items():
        force, moment = applied.in_world
        parts = [-_by_instant(dim.by_spin(force)) @ turned, np.zeros_like(turned)]
        if dim.r > 1:
            parts[1] = -_by_instant(dim.by_spin(moment)) @ turned
        found[s] = np.concatenate(parts, axis=1)
    return found


def _on_interface(
    tree: Mechanism,
    links: list[Link],
    loads: Loads,
    places: _Places,
    site: Site,
    on_joints: dict[int, np.ndarray],
    end: np.ndarray | None,
) -> np.ndarray:
    """Return the derivative of what hangs on a body's interface, in the interface's components."""
    i, s = site
    dim, count = links[i].body.dim, links[0].body.a.shape[1]
    parts = [
        _passed_on(links[k], loads.joints[k], places, on_joints[k]) for k in tree.hanging[site]
    ]
    if s in links[i].carried and end is not None:
        parts.append(_by_instant(links[i].carried[s].load_by_motion) @ end)
    if not parts:
        return np.zeros((count, dim.d + dim.r, 3 * places.size))
    for more in parts[1:]:
        parts[0] += more
    return parts[0]


def _passed_on(link: Link, load: Load, places: _Places, moved: np.ndarray) -> np.ndarray:
    """Return the derivative of what an interface feels of a body on it, from that on its joint."""
    out: np.ndarray = link.joint.passage.of_loads @ moved
    if (columns := places.of_joint(link.joint.joint.coordinate)) is not None:
        out[:, :, columns[0]] += link.joint.load_by_joint(load).T
    return out


def _body_tangent(
    tree: Mechanism,
    link: Link,
    loads: Loads,
    places: _Places,
    i: int,
    outboard: dict[int, np.ndarray],
    given: dict[int, np.ndarray],
    moved: np.ndarray | None,
) -> BodyTangent:
    """Return the derivative of body i's rows."""
    part, body, kept = tree.slices[i], link.body, places.kept[i]
    K, D, M = body.rows_by_rates(kept, interface_pushes(link, loads.outboard[i]))
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    for s, interface in link.interfaces.items():
        turning = interface.pushes_by_e(loads.outboard[i][s], kept)
        if turning is not None:
            theta = body.V[interface.places][body.dim.d :]
            K = K + _by_instant(theta.swapaxes(0, 1)) @ _by_instant(turning)
        by_load = _by_instant(interface.rows_by_load.swapaxes(0, 1))
        turned = interface.load_by_rates(carried_load(link, loads.outboard[i], s), kept)
        K = K + by_load @ _by_instant(turned)
        pairs.append((_by_instant(interface.rows_by_own_load.swapaxes(0, 1)), outboard[s]))
        if s in given:
            pairs.append((by_load, np.pad(given[s], ((0, 0), (0, 0), (0, 2 * places.size)))))
    if moved is not None:
        pairs.append((_by_instant(body.rows_by_motion.swapaxes(0, 1)), moved))
    factors: tuple[tuple[np.ndarray | None, np.ndarray], ...] = tuple(pairs)
    if pairs and body.constants.num_modes <= sum(right.shape[1] for _, right in pairs):
        whole = pairs[0][0] @ pairs[0][1]
        for left, right in pairs[1:]:
            whole += left @ right
        factors = ((None, whole),)
    first = len(places.rigid)
    rows = slice(first + part.start, first + part.stop)
    return BodyTangent(rows, places.bodies[i], kept, K, D, M, factors)


def _by_instant(x: np.ndarray) -> np.ndarray:
    """Return matrices (n, i, j) of (i, j, n)."""
    return np.ascontiguousarray(x.transpose(2, 0, 1))


# -- vector-Jacobian product of inverse dynamics with the integrals of every body ----------------
#
# The multipliers are a virtual displacement, which runs out along the tree like velocities do; its
# products with inertia and elastic forces are linear in every integral. The outboard interface
# enters through the kinematics, too: a pass back carries the derivatives by the frames' motion.


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
        of_forces: (n, joints) of the joints' forces; none by default.

    Returns:
        The derivative by every body's integrals.
    """
    if of_forces is None:
        of_forces = np.zeros_like(motion.q)
    tree: Mechanism = mechanism
    links = outward_pass(tree, motion, (q, qd, qdd))
    loads = inward_pass(tree, links)
    zeta = np.ascontiguousarray(multipliers.T)
    moves, ends = _virtual_motion(tree, links, zeta, of_forces)
    by_motion: dict[int, Motion] = {}
    by_rotation = _by_rotation(tree, links, moves, zeta)
    gradient: dict[int, ShapeIntegrals] = {}
    for i in reversed(tree.order):
        link, own = links[i], zeta[tree.slices[i]]
        by = [_motion_gradient(link.body, moves[i])]
        outboard: dict[int, Weights] = {}
        if link.body.is_flexible:
            of_rows = np.einsum("mqn,qn->mn", link.body.rows_by_motion, own)
            by.append(_split(link.body, of_rows))
        for s, interface in link.interfaces.items():
            parts = [links[k].joint.pulled_back(by_motion[k]) for k in tree.hanging[i, s]]
            if s in link.carried:
                parts.append(_motion_gradient(link.carried[s], ends[i, s]))
            if parts:
                inner, displaced = interface.pulled_back(_sum_motions(parts))
                by.append(inner)
            else:
                displaced = (np.zeros((link.body.dim.b, zeta.shape[1])),) * 3
            if link.body.is_flexible:
                both = loads.outboard[i][s], carried_load(link, loads.outboard[i], s)
                outboard[s] = _interface_weights(interface, both, moves[i], own, displaced)
                if (i, s) in by_rotation:
                    outboard[s].value[link.body.dim.d :] += by_rotation[i, s]
        by_motion[i] = _sum_motions(by)
        gradient[i] = link.body.integral_gradient(moves[i], own, outboard)
    return [gradient[i] for i in range(len(links))]


def _by_rotation(
    tree: Mechanism, links: list[Link], moves: dict[int, Load], zeta: np.ndarray
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
                found[i, s] = interface.turning.pulled(turned)
            total += turned
            if s in link.applied:
                p, phi = interface.virtual(moves[i], own)
                force, moment = link.applied[s].in_world
                total -= dim.moment(force, p) + dim.commutator(moment, phi)
        of_bodies[i] = total
    return found


def _motion_gradient(body: BodyMotion, virtual: Load) -> Motion:
    """Return the derivatives of virtual . (F, T) by a body's motion."""
    return _split(body, np.einsum("ijn,in->jn", body.load_by_motion, np.concatenate(virtual)))


def _split(body: BodyMotion, x: np.ndarray) -> Motion:
    d, r = body.dim.d, body.dim.r
    return x[:d], x[d : d + r], x[d + r :]


def _sum_motions(parts: list[Motion]) -> Motion:
    a, w, wd = parts[0]
    for one in parts[1:]:
        a, w, wd = a + one[0], w + one[1], wd + one[2]
    return a, w, wd


def _virtual_motion(
    tree: Mechanism, links: list[Link], zeta: np.ndarray, of_forces: np.ndarray
) -> tuple[dict[int, Load], dict[Site, Load]]:
    """Return displacement and rotation of every frame and outboard interface, in its components."""
    moves: dict[int, Load] = {}
    ends: dict[Site, Load] = {}
    ground = tree.virtual_ground(of_forces)
    for i in tree.order:
        link, joint = links[i], tree.joints[i]
        inner = ground if joint.parent == GROUND else ends[joint.parent, joint.interface]
        drive = None if joint.coordinate is None else of_forces[:, joint.coordinate]
        moves[i] = link.joint.virtual(inner, drive)
        for s, interface in link.interfaces.items():
            p, phi = interface.virtual(moves[i], zeta[tree.slices[i]])
            ends[i, s] = interface.in_interface((p, phi))
    return moves, ends


def _interface_weights(
    interface: Interface,
    loads: tuple[Load, Load],
    virtual: Load,
    zeta: np.ndarray,
    displaced: Motion,
) -> Weights:
    """Return the derivatives (b, n) by (u, theta), their rates and variation."""
    # Of a load on a flexible body's interface and its part that turns with it, `virtual` of its
    # frame, zeta (q, n) its multipliers; `displaced` are those by (u, theta) and their rates
    # through the interface's motion.
    load, (own_force, own_moment) = loads
    (force, moment), dim, turning = load, interface.dim, interface.turning
    p, phi = interface.virtual(virtual, zeta)
    # The load's lever, its components, and J' of the row.
    turned = turning.pulled(dim.moment(own_force, p) + dim.commutator(own_moment, phi))
    by_theta = turning.by_theta(moment, -1.0)
    if by_theta is not None:
        theta = np.einsum("rkn,kn->rn", interface.body.V[interface.places][dim.d :], zeta)
        turned = turned + np.einsum("ijn,in->jn", by_theta, theta)
    value, rate, second = displaced
    value = value + np.concatenate([-dim.velocity(virtual[1], force), turned])
    return Weights(value, rate, second, interface.pushes(load))
