"""Tangent of inverse dynamics, and its vector-Jacobian product with the integrals of every body.

Both passes of `inverse_dynamics` are differentiated by the coordinates that are asked for. A body
feels those inboard of it through the motion (a, w, wd) of its frame, those outboard of it
through the load on each of its interfaces: its rows are a block of its own coordinates and a low
rank. Derivatives of motions go outwards by what is inboard alone, those of loads inwards by what is
outboard: what carries them on is one product with the matrices of `kinematics.Passage`, which BLAS
multiplies four to ten times as fast as `einsum`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
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
from dolfinopt.multibody.kinematics import Interface, Passage
from dolfinopt.multibody.measured import DERIVATIVES_BYTES, LEAST_INSTANTS
from dolfinopt.multibody.mechanism import GROUND, Mechanism, Site
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals


@dataclass(frozen=True, eq=False)
class Part:
    """Derivative left (right y) of a body's q rows by some coordinates, arrays over n instants.

    Attributes:
        columns: their places (3 c,) among all 3 S, see `Tangent`.
        left: (n, q, r); None where there is `right` alone.
        right: (n, r, 3 c), a motion or a load; (n, q, 3 c) without `left`.
    """

    columns: np.ndarray | slice
    left: np.ndarray | None
    right: np.ndarray

    def at(self, part: slice) -> Part:
        """Return it at some of the instants."""
        left = None if self.left is None else self.left[part]
        return replace(self, left=left, right=self.right[part])

    def write(self, wanted: np.ndarray | slice, rows: np.ndarray) -> None:
        """Write some of the q rows where they stand among rows (n, W, 3 S)."""
        if self.left is None:
            rows[:, :, self.columns] = self.right[:, wanted]
        elif isinstance(self.columns, slice):
            np.matmul(self.left[:, wanted], self.right, out=rows[:, :, self.columns])
        else:
            rows[:, :, self.columns] = self.left[:, wanted] @ self.right


@dataclass(frozen=True, eq=False)
class BodyTangent:
    """Derivative of one body's q elastic rows by S coordinates.

    Attributes:
        rows, columns: its place among all rows and among the S coordinates.
        kept: (k,) those of its coordinates that have a column.
        parts: by its own coordinates; by those inboard, which move it; by those outboard, which
            load it. No two have a column in common. Where q is small they are one.
    """

    rows: slice
    columns: slice
    kept: np.ndarray
    parts: tuple[Part, ...]


@dataclass(frozen=True, eq=False)
class Tangent:
    """Derivative of the rows [joint forces asked for (R), elastic residual (N)] by S coordinates.

    The S coordinates are the R joints, then those elastic ones that are kept; n instants. Columns
    are q, qd, qdd of one coordinate after the other.

    Attributes:
        bodies: the flexible ones, in the order of their rows.
        drives: (n, R, 3 S) of the forces of the joints.
    """

    bodies: tuple[BodyTangent, ...]
    drives: np.ndarray

    def window(self, first: int, last: int) -> Tangent:
        """Return the instants first..last - 1."""
        part = slice(first, last)
        bodies = tuple(
            replace(body, parts=tuple(one.at(part) for one in body.parts)) for body in self.bodies
        )
        return Tangent(bodies, self.drives[part])

    def dense(self) -> np.ndarray:
        """Return the S coordinates' own rows (n, S, 3 S), columns ordered q, qd, qdd."""
        count, rigid, every = self.drives.shape
        jacobian = np.zeros((count, every // 3, every))
        jacobian[:, :rigid] = self.drives
        for body in self.bodies:
            rows = jacobian[:, body.columns]
            for part in body.parts:
                part.write(body.kept, rows)
        found = jacobian.reshape(count, every // 3, every // 3, 3).swapaxes(2, 3)
        return found.reshape(jacobian.shape)

    def times(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, wanted: np.ndarray
    ) -> np.ndarray:
        """Return the change of W wanted rows (m, W) by one of the S coordinates, each (m, S).

        With m a multiple of the n instants, each of them stands for as many rows in turn.
        """
        count, rigid, every = self.drives.shape
        change = np.stack([q, qd, qdd], axis=2).reshape(count, -1, every)
        change = change.swapaxes(1, 2)  # (n, 3 S, times)
        out = [self.drives[:, wanted[wanted < rigid]] @ change] if rigid else []
        for body in self.bodies:
            own = wanted[(wanted >= body.rows.start) & (wanted < body.rows.stop)] - body.rows.start
            rows = np.zeros((count, len(own), change.shape[2]))
            for part in body.parts:
                moved = change[:, part.columns]
                if part.left is None:
                    rows += part.right[:, own] @ moved
                else:
                    rows += part.left[:, own] @ (part.right @ moved)
            out.append(rows)
        found: np.ndarray = np.concatenate(out, axis=1).swapaxes(1, 2)
        return found.reshape(len(q), len(wanted))

    def transposed(self, rows: np.ndarray) -> Rates:
        """Return the gradient of sum_m rows_m . [forces, residual]_m by q, qd, qdd, each (m, S).

        With m a multiple of the n instants, each of them stands for as many rows in turn.
        """
        count, rigid, every = self.drives.shape
        weights = rows.reshape(count, -1, rows.shape[1])
        gradient = weights[:, :, :rigid] @ self.drives
        for body in self.bodies:
            y = weights[:, :, body.rows]
            for part in body.parts:
                gradient[:, :, part.columns] += (
                    y if part.left is None else y @ part.left
                ) @ part.right
        by_q, by_v, by_a = np.moveaxis(gradient.reshape(len(rows), every // 3, 3), 2, 0)
        return by_q, by_v, by_a


@dataclass(frozen=True, eq=False)
class _Places:
    """Where the coordinates asked for stand among the S."""

    size: int  # S
    rigid: np.ndarray  # (R,) joint coordinates asked for, ascending
    kept: list[np.ndarray]  # of every body, those of its coordinates that have a column
    bodies: list[slice]  # of every body, their place among the S

    def of_body(self, i: int) -> np.ndarray:
        """Return the places of a body's coordinates."""
        return np.arange(self.bodies[i].start, self.bodies[i].stop)

    def of_joint(self, coordinate: int | None) -> np.ndarray:
        """Return the place of a joint's coordinate (1,), or none (0,)."""
        return np.flatnonzero(self.rigid == (-1 if coordinate is None else coordinate))


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
    # Motion and load of a frame and of an interface of every body, each by half of the coordinates.
    size = 8 * 3 * places.size * (2 * dim.d + 3 * dim.r) * len(mechanism.order)
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


def _joined(pieces: list[Tangent]) -> Tangent:
    """Return the tangents of instants that follow each other as one."""
    bodies = []
    for same in zip(*(one.bodies for one in pieces), strict=True):
        parts = []
        for every in zip(*(one.parts for one in same), strict=True):
            lefts = [one.left for one in every if one.left is not None]
            left = np.concatenate(lefts) if lefts else None
            parts.append(
                replace(every[0], left=left, right=np.concatenate([x.right for x in every]))
            )
        bodies.append(replace(same[0], parts=tuple(parts)))
    return Tangent(tuple(bodies), np.concatenate([one.drives for one in pieces]))


def _linearise(tree: Mechanism, motion: RigidMotion, rates: Rates, places: _Places) -> Tangent:
    """Return the derivative at some of the instants."""
    links = outward_pass(tree, motion, rates)
    loads = inward_pass(tree, links, driven=len(places.rigid) > 0)
    moved = _outward_derivatives(tree, links, places)
    found = _inward_derivatives(tree, links, loads, places, moved)
    if tree.friction is not None and len(places.rigid):
        own = np.arange(len(places.rigid))
        found.drives[:, own, 3 * own + 1] += tree.friction.slope(motion.qd)[:, places.rigid]
    return found


# -- both passes: outwards by what is inboard of a body, inwards by what is outboard -------------
#
# What meets are the derivatives of loads by the motion of their own frame, all that hangs on it
# moving along, as of composite rigid bodies (Featherstone 2008, ch. 6). A motion is (a, w, wd), and
# with it the rotation where forces keep their direction in the world: m = d + 2 r or d + 3 r.


@dataclass(frozen=True, eq=False)
class _Derivative:
    """Derivatives (n, ., 3 c) by c coordinates and their rates, one coordinate after the other.

    `columns` (c,) are the coordinates' places among the S.
    """

    columns: np.ndarray
    values: np.ndarray

    def passed_on(self, matrix: np.ndarray, more: _Derivative) -> _Derivative:
        """Return matrix times the derivatives, and behind them those by further coordinates."""
        if len(self.columns) == 0:
            return more
        old = self.values.shape[2]
        out = np.empty((*more.values.shape[:2], old + more.values.shape[2]))
        np.matmul(matrix, self.values, out=out[:, :, :old])
        out[:, :, old:] = more.values
        return _Derivative(np.concatenate([self.columns, more.columns]), out)

    @cached_property
    def places(self) -> np.ndarray | slice:
        """Places (3 c,) among the 3 S, as a slice where they lie side by side."""
        columns = self.columns
        if len(columns) and (np.diff(columns) == 1).all():
            return slice(3 * columns[0], 3 * (columns[-1] + 1))
        out: np.ndarray = (3 * columns[:, None] + np.arange(3)).ravel()
        return out


def _side_by_side(changes: list[_Derivative]) -> _Derivative:
    some = [one for one in changes if len(one.columns)] or changes[:1]
    if len(some) == 1:
        return some[0]
    columns = np.concatenate([one.columns for one in some])
    return _Derivative(columns, np.concatenate([one.values for one in some], axis=2))


@dataclass(frozen=True, eq=False)
class _MotionDerivatives:
    """Derivatives of motions (n, m, .), each in its own components.

    Attributes:
        ground: of what the first joints sit on.
        frames: of every body.
        joints: of every body by its joint's coordinate, the interface held.
        interfaces: by the coordinates of their own body.
    """

    ground: _Derivative
    frames: dict[int, _Derivative]
    joints: dict[int, _Derivative]
    interfaces: dict[Site, _Derivative]


@dataclass(frozen=True, eq=False)
class _LoadDerivative:
    """Derivatives of the load (n, d + r, .) on a frame or an interface, in its components.

    Attributes:
        by_motion: by a frame's motion (n, d + r, m).
        by_own: by the coordinates of the body itself; of an interface by its own motion, none.
        by_outboard: by those outboard.
    """

    by_motion: np.ndarray
    by_own: np.ndarray
    by_outboard: _Derivative


def _motion_size(tree: Mechanism) -> int:
    """Return m."""
    return tree.dim.d + (3 if tree.forces else 2) * tree.dim.r


def _by_coordinate(x: np.ndarray) -> np.ndarray:
    """Return derivatives (n, ., 3 k) of (., 3, k, n)."""
    return np.ascontiguousarray(x.transpose(3, 0, 2, 1)).reshape(x.shape[3], len(x), -1)


def _moved_by(tree: Mechanism, columns: np.ndarray, x: np.ndarray) -> _Derivative:
    """Return the derivatives of a motion from those of (a, w, wd) (d + 2 r, 3, k, n)."""
    if tree.forces:
        spin = x[tree.dim.d : tree.dim.d + tree.dim.r]
        turned = np.zeros_like(spin)
        turned[:, 0] = spin[:, 1]  # by q, as the spin by q'
        x = np.concatenate([x, turned])
    return _Derivative(columns, _by_coordinate(x))


def _carrier(tree: Mechanism, passage: Passage) -> np.ndarray:
    """Return the matrix (n, m, m), or one, that carries a motion on."""
    dim, inner = tree.dim, passage.matrix
    if not tree.forces:
        return inner
    spin, size = slice(dim.d, dim.d + dim.r), inner.shape[1]
    out = np.zeros((len(inner), size + dim.r, size + dim.r))
    out[:, :size, :size], out[:, size:, size:] = inner, inner[:, spin, spin]
    return out


def _outward_derivatives(tree: Mechanism, links: list[Link], places: _Places) -> _MotionDerivatives:
    dim, count = tree.dim, links[0].body.a.shape[1]
    none = np.zeros((dim.d + 2 * dim.r, 3, 0, count))
    on_ground = places.of_joint(tree.cart_coordinate)
    by_cart = np.zeros((dim.d + 2 * dim.r, 3, len(on_ground), count))
    by_cart[0, 2] = 1.0
    ground = _moved_by(tree, on_ground, by_cart)
    nothing = _moved_by(tree, on_ground[:0], none)
    moved, ends = _MotionDerivatives(ground, {}, {}, {}), {(GROUND, 0): ground}
    for i in tree.order:
        link, joint, kept = links[i], tree.joints[i], places.kept[i]
        by_joint, by_own = nothing, nothing
        if len(own := places.of_joint(joint.coordinate)):
            by_joint = _moved_by(tree, own, np.stack(link.joint.moved_by_joint, axis=1)[:, :, None])
        moved.joints[i] = by_joint
        inner = ends[joint.parent, joint.interface]
        moved.frames[i] = inner.passed_on(_carrier(tree, link.joint.passage), by_joint)
        for s, interface in link.interfaces.items():
            if len(kept):
                by_own = _moved_by(tree, places.of_body(i), interface.moved_by_rates(kept))
            moved.interfaces[i, s] = by_own
            if tree.hanging[i, s]:
                carrier = _carrier(tree, interface.passage)
                ends[i, s] = moved.frames[i].passed_on(carrier, by_own)
    return moved


def _inward_derivatives(
    tree: Mechanism, links: list[Link], loads: Loads, places: _Places, moved: _MotionDerivatives
) -> Tangent:
    """Return the tangent from the derivatives of all motions."""
    dim, count, rigid = tree.dim, links[0].body.a.shape[1], places.rigid
    drives = np.zeros((count, len(rigid), 3 * places.size))
    frames: dict[int, _LoadDerivative] = {}
    bodies: list[BodyTangent] = []

    def drive(
        coordinate: int | None, axis: np.ndarray, load: _LoadDerivative, motion: _Derivative
    ) -> None:
        for row in places.of_joint(coordinate):
            by_inboard = (axis @ load.by_motion)[:, None] @ motion.values
            drives[:, row, motion.places] = by_inboard[:, 0]
            drives[:, row, load.by_outboard.places] = axis @ load.by_outboard.values
            drives[:, row, 3 * row + 2] += tree.rotors[coordinate]

    for i in reversed(tree.order):
        link, felt = links[i], rigid.size > 0 or tree.is_felt(i)
        if not (felt or link.body.is_flexible):
            continue
        outboard = {}
        for s, interface in link.interfaces.items():
            on = _on_interface(tree, links, loads, places, (i, s), frames, moved)
            by_frame = on.by_motion @ _carrier(tree, interface.passage)
            by_own = on.by_motion @ moved.interfaces[i, s].values
            outboard[s] = _LoadDerivative(by_frame, by_own, on.by_outboard)
        if link.body.is_flexible:
            inboard = moved.frames[i]
            bodies.append(_body_tangent(tree, link, loads, places, i, outboard, inboard))
        if felt:
            frames[i] = _on_frame(tree, link, loads, places, i, outboard)
            axis, joint = np.zeros(dim.d + dim.r), link.joint.joint
            axis[slice(dim.d) if link.joint.slides else slice(dim.d, None)] = joint.axis
            drive(joint.coordinate, axis, frames[i], moved.frames[i])
    if len(moved.ground.columns):
        on = _on_interface(tree, links, loads, places, (GROUND, 0), frames, moved)
        drive(tree.cart_coordinate, np.eye(dim.d + dim.r)[0], on, moved.ground)
    bodies.sort(key=lambda part: part.rows.start)
    return Tangent(tuple(bodies), drives)


def _on_interface(
    tree: Mechanism,
    links: list[Link],
    loads: Loads,
    places: _Places,
    site: Site,
    frames: dict[int, _LoadDerivative],
    moved: _MotionDerivatives,
) -> _LoadDerivative:
    """Return the derivative of what hangs on an interface, by its own motion."""
    (i, s), dim, count = site, tree.dim, links[0].body.a.shape[1]
    by_motion = np.zeros((count, dim.d + dim.r, _motion_size(tree)))
    behind = [_Derivative(np.zeros(0, dtype=int), by_motion[:, :, :0])]
    for k in tree.hanging[site]:
        joint, load, by_joint = links[k].joint, frames[k], moved.joints[k]
        of_loads = joint.passage.of_loads
        by_motion += of_loads @ (load.by_motion @ _carrier(tree, joint.passage))
        if len(by_joint.columns):
            own = of_loads @ (load.by_motion @ by_joint.values)
            own[:, :, 0] += joint.load_by_joint(loads.joints[k]).T
            behind.append(_Derivative(by_joint.columns, own))
        behind.append(_Derivative(load.by_outboard.columns, of_loads @ load.by_outboard.values))
    if i != GROUND and s in links[i].carried:
        carried = links[i].carried[s].load_by_motion
        by_motion[:, :, : carried.shape[1]] += _by_instant(carried)
    return _LoadDerivative(by_motion, by_motion[:, :, :0], _side_by_side(behind))


def _on_frame(
    tree: Mechanism,
    link: Link,
    loads: Loads,
    places: _Places,
    i: int,
    outboard: dict[int, _LoadDerivative],
) -> _LoadDerivative:
    """Return the derivative of what a joint feels of the body and all behind it."""
    dim, kept, body = tree.dim, places.kept[i], link.body
    by_motion = _widened(tree, body.load_by_motion)
    own = np.zeros((len(by_motion), dim.d + dim.r, 0))
    if len(kept):
        own = _by_coordinate(_load_by_rates(link, loads.outboard[i], kept))
    behind = [_Derivative(places.of_body(i), own)]
    for s, interface in link.interfaces.items():
        of_loads, load = interface.passage.of_loads, outboard[s]
        by_motion += of_loads @ load.by_motion
        own += of_loads @ load.by_own
        behind.append(_Derivative(load.by_outboard.columns, of_loads @ load.by_outboard.values))
        if s in link.applied:
            given = _given(link, s)
            lever = _by_instant(dim.by_spin(interface.place)).swapaxes(1, 2)
            by_motion[:, :, -dim.r :] += given
            by_motion[:, dim.d :, -dim.r :] += lever @ given[:, : dim.d]
    return _LoadDerivative(by_motion, own, _side_by_side(behind))


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


def _given(link: Link, s: int) -> np.ndarray:
    """Return the derivative (n, d + r, r) of the forces of the world by the body's rotation."""
    dim, (force, moment) = link.body.dim, link.applied[s].in_world
    of_moment = dim.by_spin(moment) if dim.r > 1 else np.zeros((1, 1, moment.shape[1]))
    return -_by_instant(np.concatenate([dim.by_spin(force), of_moment]))


def _widened(tree: Mechanism, by_motion: np.ndarray) -> np.ndarray:
    """Return derivatives (n, ., m) by a motion of those by (a, w, wd), (., d + 2 r, n)."""
    out = np.zeros((by_motion.shape[2], len(by_motion), _motion_size(tree)))
    out[:, :, : by_motion.shape[1]] = by_motion.transpose(2, 0, 1)
    return out


def _body_tangent(
    tree: Mechanism,
    link: Link,
    loads: Loads,
    places: _Places,
    i: int,
    outboard: dict[int, _LoadDerivative],
    inboard: _Derivative,
) -> BodyTangent:
    """Return the derivative of body i's rows."""
    body, dim, kept = link.body, tree.dim, places.kept[i]
    count, q = body.a.shape[1], body.constants.num_modes
    own = np.empty((count, q, len(kept), 3))
    rates = body.rows_by_rates(kept, interface_pushes(link, loads.outboard[i]))
    own[..., 0], own[..., 1], own[..., 2] = rates
    parts = [Part(_Derivative(places.of_body(i), own).places, None, own.reshape(count, q, -1))]
    for s, interface in link.interfaces.items():
        turning = interface.pushes_by_e(loads.outboard[i][s], kept)
        if turning is not None:
            theta = body.V[interface.places][dim.d :]
            own[..., 0] += _by_instant(theta.swapaxes(0, 1)) @ _by_instant(turning)
        by_load = _by_instant(interface.rows_by_load.swapaxes(0, 1))
        turned = interface.load_by_rates(carried_load(link, loads.outboard[i], s), kept)
        own[..., 0] += by_load @ _by_instant(turned)
        by_own_load = _by_instant(interface.rows_by_own_load.swapaxes(0, 1))
        load = outboard[s]
        parts[0].right[:] += by_own_load @ load.by_own
        parts.append(Part(load.by_outboard.places, by_own_load, load.by_outboard.values))
    if len(inboard.columns):
        left = _widened(tree, body.rows_by_motion.swapaxes(0, 1))
        for s, interface in link.interfaces.items():
            left += _by_instant(interface.rows_by_own_load.swapaxes(0, 1)) @ outboard[s].by_motion
            if s in link.applied:
                by_load = _by_instant(interface.rows_by_load.swapaxes(0, 1))
                left[:, :, -dim.r :] += by_load @ _given(link, s)
        parts.append(Part(inboard.places, left, inboard.values))
    parts = [part for part in parts if part.right.shape[2]]
    if q <= sum(part.right.shape[1] for part in parts if part.left is not None):
        whole = np.zeros((count, q, 3 * places.size))
        for part in parts:
            part.write(slice(None), whole)
        parts = [Part(slice(None), None, whole)]
    first, own_rows = len(places.rigid), tree.slices[i]
    rows = slice(first + own_rows.start, first + own_rows.stop)
    return BodyTangent(rows, places.bodies[i], kept, tuple(parts))


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
