"""Tangent of inverse dynamics: its derivative by coordinates and their rates.

A body feels those inboard of it through the motion (a, w, wd) of its frame, those outboard of it
through the load on each of its interfaces: its rows are a block of its own coordinates and a low
rank. Derivatives of motions go outwards by what is inboard alone, those of loads inwards by what is
outboard. Where they meet are the derivatives of loads by the motion of their own frame, all that
hangs on it moving along, as of composite rigid bodies (Featherstone 2008, ch. 6). A motion is
(a, w, wd), and with it the rotation where forces keep their direction in the world: m = d + 2 r or
d + 3 r numbers.

While the tree is walked, depth first, columns stand in the order in which the walk meets their
coordinates, three of each: by the coordinate, its rate and its acceleration. What is inboard of a
body then ends where its own columns begin, and what hangs on it follows them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dolfinopt.multibody.frames import MotionTransform
from dolfinopt.multibody.newton_euler import (
    Link,
    Loads,
    carried_load,
    interface_coefficients,
    inward_pass,
    outward_pass,
)
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates
from dolfinopt.multibody.tree import GROUND, Mechanism, Site

# -- the derivative of a residual by some coordinates --------------------------------------------


@dataclass(frozen=True, eq=False)
class Block:
    """Rows by columns of a tangent, left right, at n instants.

    Attributes:
        rows, columns: places; three columns a coordinate.
        left: (n, rows, rank); None where there is `right` alone.
        right: (n, rank, columns).
    """

    rows: slice
    columns: slice
    left: np.ndarray | None
    right: np.ndarray

    def part(self, rows: np.ndarray) -> np.ndarray:
        """Return some of its rows (n, ., columns)."""
        return self.right[:, rows] if self.left is None else self.left[:, rows] @ self.right


@dataclass(frozen=True, eq=False)
class Tangent:
    """Derivative of W rows by S coordinates, their rates and accelerations, at n instants.

    Of m rows or changes, a multiple of n, each instant stands for as many in turn.

    Attributes:
        blocks: no two have an entry in common.
        own: (S,) ascending, the coordinates' own rows.
        order: (S,) places of the coordinates among the blocks' columns, or all as they stand.
        count: n, also where there is no block, of rigid arms.
    """

    blocks: tuple[Block, ...]
    own: np.ndarray
    order: np.ndarray | slice
    count: int

    @classmethod
    def of_matrix(cls, matrix: np.ndarray, keep: np.ndarray | None = None) -> Tangent:
        """Return that of W rows by W coordinates and their rates (n, W, W, 3), by some or all."""
        count, size = matrix.shape[:2]
        own = np.arange(size) if keep is None else keep
        right = matrix if keep is None else matrix[:, :, keep]
        right = right.reshape(count, size, 3 * len(own))
        block = Block(slice(0, size), slice(0, right.shape[2]), None, right)
        return cls((block,), own, slice(None), count)

    def window(self, first: int, last: int) -> Tangent:
        """Return the instants first..last - 1."""
        part, blocks = slice(first, last), []
        for one in self.blocks:
            left = None if one.left is None else one.left[part]
            blocks.append(replace(one, left=left, right=one.right[part]))
        return replace(self, blocks=tuple(blocks), count=last - first)

    def interpolated(self, weights: np.ndarray, keep: np.ndarray) -> Tangent:
        """Return it by some of the coordinates, at further instants between those of every step.

        Args:
            weights: (m, s) of s instants in turn, for m others.
            keep: ascending places among the S coordinates.
        """
        size = len(self.own)
        places = np.arange(size)[self.order]  # of every coordinate
        kept = np.zeros(size, dtype=bool)
        kept[places[keep]] = True
        before = np.append(0, np.cumsum(kept))
        m, s = weights.shape
        count = self.count // s

        def between(x: np.ndarray) -> np.ndarray:
            found: np.ndarray = weights @ x.reshape(count, s, x[0].size)
            return found.reshape(count * m, *x.shape[1:])

        blocks = []
        for one in self.blocks:
            first, last = one.columns.start // 3, one.columns.stop // 3
            columns = slice(3 * before[first], 3 * before[last])
            right = between(one.right[:, :, np.repeat(kept[first:last], 3)])
            left = None if one.left is None else between(one.left)
            blocks.append(Block(one.rows, columns, left, right))
        order = before[places[keep]]
        return Tangent(tuple(blocks), self.own[keep], order, count * m)

    def dense(self) -> np.ndarray:
        """Return the S coordinates' own rows (n, S, 3 S), columns ordered q, qd, qdd."""
        size = len(self.own)
        found = np.zeros((self.count, size, 3, size))
        coordinates = np.arange(size)
        coordinates[self.order] = np.arange(size)  # of every column
        for one in self.blocks:
            ends = np.searchsorted(self.own, [one.rows.start, one.rows.stop])
            part = one.part(self.own[slice(*ends)] - one.rows.start)
            part = part.reshape(*part.shape[:2], part.shape[2] // 3, 3).swapaxes(2, 3)
            places = coordinates[one.columns.start // 3 : one.columns.stop // 3]
            if len(places) and (np.diff(places) == 1).all():
                places = slice(places[0], places[-1] + 1)
            found[:, slice(*ends), :, places] = part
        return found.reshape(self.count, size, 3 * size)

    def times(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, wanted: np.ndarray
    ) -> np.ndarray:
        """Return the change of the wanted rows (m, .), ascending, by a change (m, S) each."""
        count, size = self.count, len(self.own)
        change = np.empty((len(q), size, 3))
        change[:, self.order] = np.stack([q, qd, qdd], axis=2)
        change = change.reshape(count, -1, 3 * size).swapaxes(1, 2)
        found = np.zeros((count, len(wanted), change.shape[2]))
        for one in self.blocks:
            ends = np.searchsorted(wanted, [one.rows.start, one.rows.stop])
            rows, moved = wanted[slice(*ends)] - one.rows.start, change[:, one.columns]
            if one.left is None:
                found[:, slice(*ends)] += one.right[:, rows] @ moved
            else:
                found[:, slice(*ends)] += one.left[:, rows] @ (one.right @ moved)
        return found.swapaxes(1, 2).reshape(len(q), len(wanted))

    def transposed(self, rows: np.ndarray) -> Rates:
        """Return the gradient of sum_m rows_m . residual_m by q, qd, qdd, each (m, S)."""
        count, size = self.count, len(self.own)
        weights = rows.reshape(count, -1, rows.shape[1])
        gradient = np.zeros((count, weights.shape[1], 3 * size))
        for one in self.blocks:
            own = weights[:, :, one.rows]
            own = own if one.left is None else own @ one.left
            gradient[:, :, one.columns] += own @ one.right
        every = gradient.reshape(len(rows), size, 3)[:, self.order]
        return every[:, :, 0], every[:, :, 1], every[:, :, 2]


# -- where coordinates stand ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Columns:
    """Places of the S coordinates asked for in the order of the walk, and their rows.

    Attributes:
        kept: of every body, those of its elastic coordinates that are asked for.
        rigid: of coordinates of cart, joints and motors asked for, their places.
        drives: and their rows.
        first: of every body, the first column that is its joint's or behind it.
        modes: of every body, those of its elastic coordinates.
        last: of every body, the end of all that hangs on it.
        order: (S,), see `Tangent`.
    """

    kept: list[np.ndarray]
    rigid: dict[int | None, int]
    drives: dict[int | None, int]
    first: dict[int, int]
    modes: dict[int, slice]
    last: dict[int, int]
    order: np.ndarray

    def behind(self, tree: Mechanism, site: Site) -> slice:
        """Return the columns of all that hangs on an interface."""
        hanging = tree.hanging[site]
        return slice(self.first[hanging[0]], self.last[hanging[-1]]) if hanging else slice(0, 0)


def _columns(tree: Mechanism, keep: np.ndarray | None, rigid: np.ndarray | None) -> _Columns:
    asked = [] if rigid is None else list(map(int, rigid))
    keep = np.arange(tree.num_coordinates) if keep is None else keep
    ends = np.searchsorted(keep, [0, *(part.stop for part in tree.slices)])
    kept = [keep[a:b] - s.start for (a, b), s in zip(pairwise(ends), tree.slices, strict=True)]
    drives: dict[int | None, int] = {k: row for row, k in enumerate(asked)}
    found = _Columns(kept, {}, drives, {}, {}, {}, np.empty(len(asked) + len(keep), dtype=int))
    own = {GROUND: dict.fromkeys([tree.cart_coordinate])}
    for i, joint in enumerate(tree.joints):
        own[i] = dict.fromkeys((joint.coordinate, tree.rotors.get(i)))
    place = 0
    for i in (GROUND, *tree.order):
        found.first[i] = place
        for k in own[i]:
            if k in drives:
                found.rigid[k] = found.order[drives[k]] = place
                place += 1
        size = len(kept[i]) if i != GROUND else 0
        found.modes[i] = slice(place, place + size)
        if size:
            found.order[len(asked) + ends[i] : len(asked) + ends[i + 1]] = place + np.arange(size)
        place += size
    for i in reversed(tree.order):
        hanging = [k for s in tree.sites[i] for k in tree.hanging[i, s]]
        found.last[i] = max([found.modes[i].stop, *(found.last[k] for k in hanging)])
    # Rods that close loops weigh nothing, and no row depends on them.
    for k in asked:
        if k not in found.rigid:
            found.rigid[k] = found.order[drives[k]] = place
            place += 1
    return found


def _three(columns: slice, first: int = 0) -> slice:
    """Return the places of coordinates' derivatives behind those of the first columns."""
    return slice(3 * (columns.start - first), 3 * (columns.stop - first))


# -- both passes: outwards by what is inboard of a body, inwards by what is outboard -------------


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

    Its rows are the forces of the rigid coordinates asked for, then the elastic residual (N).

    Args:
        mechanism, motion, q, qd, qdd: as for `inverse_dynamics`; n instants.
        keep: ascending elastic coordinates by which to differentiate; all by default.
        rigid: ascending coordinates of cart, joints and motors that have columns and whose forces
            have rows; none by default.
    """
    tree, columns = mechanism, _columns(mechanism, keep, rigid)
    links = outward_pass(tree, motion, (q, qd, qdd))
    loads = inward_pass(tree, links, driven=len(columns.drives) > 0)
    walk = _Walk(tree, links, loads, columns)
    if tree.friction is not None and rigid is not None:
        slope = tree.friction.slope(motion.qd)
        for row, k in enumerate(map(int, rigid[rigid < tree.num_rigid])):
            walk.drives[:, row, 3 * columns.rigid[k] + 1] += slope[:, k]
    first = len(columns.drives)
    blocks = [Block(slice(0, first), slice(0, walk.drives.shape[2]), None, walk.drives)] * (
        first > 0
    )
    kept = [part.start + own for part, own in zip(tree.slices, columns.kept, strict=True)]
    own = np.concatenate([np.arange(first), *(first + rows for rows in kept)]).astype(int)
    order = columns.order
    as_they_stand = bool((order == np.arange(len(order))).all())
    order = slice(None) if as_they_stand else order
    return Tangent((*blocks, *walk.blocks), own, order, len(motion.q))


@dataclass(frozen=True, eq=False)
class _LoadDerivative:
    """Derivatives of the load on a frame or an interface, in its components.

    Attributes:
        by_motion: by its motion (n, d + r, m).
        outboard: by the coordinates of the body itself, of a frame, and of all behind it
            (n, d + r, .).
    """

    by_motion: np.ndarray
    outboard: np.ndarray


@dataclass(frozen=True, eq=False)
class _OutboardLoad:
    """Derivatives of the load on an interface, in its components.

    Attributes:
        by_frame: by the motion of the body's frame, all that hangs on it moving along.
        by_modes: by the coordinates of the body (n, d + r, 3 k).
        outboard: by those of all behind it.
    """

    by_frame: np.ndarray
    by_modes: np.ndarray
    outboard: np.ndarray


class _Walk:
    """Both passes.

    Attributes:
        blocks: of the bodies' rows.
        drives: (n, R, 3 S) rows of the rigid coordinates asked for.
    """

    def __init__(self, tree: Mechanism, links: list[Link], loads: Loads, columns: _Columns) -> None:
        """Walk out and back."""
        self.tree, self.links, self.loads, self.columns = tree, links, loads, columns
        self.dim, self.count = tree.dim, links[0].body.a.shape[1]
        self.motion_size = self.dim.d + (3 if tree.forces else 2) * self.dim.r
        # Of frames by what is inboard and their joint, of interfaces by their body's modes, and of
        # motors' forces by what carries their rotors.
        self.frames: dict[int, np.ndarray] = {}
        self.by_modes: dict[Site, np.ndarray] = {}
        self.by_joints: dict[int, np.ndarray] = {}
        self.by_carriers: dict[int, np.ndarray] = {}
        self._outwards()
        self.blocks: list[Block] = []
        size = 3 * len(columns.order)
        self.drives = np.zeros((self.count, len(columns.drives), size))
        self.on_frames: dict[int, _LoadDerivative] = {}
        self._inwards()
        self.blocks.sort(key=lambda one: one.rows.start)

    # -- outwards ------------------------------------------------------------------------------

    def _outwards(self) -> None:
        tree, columns = self.tree, self.columns
        ground = np.zeros((self.count, self.motion_size, 3 * columns.modes[GROUND].start))
        ground[:, 0, 2::3] = 1.0  # the cart's acceleration
        ends = {(GROUND, 0): ground}
        for i in tree.order:
            link, joint = self.links[i], tree.joints[i]
            inner = ends[joint.parent, joint.interface]
            if link.rotor is not None and tree.rotors[i] in columns.drives:
                by_motion = link.rotor.force_by_motion
                self.by_carriers[i] = by_motion @ inner[:, : len(by_motion)]
            frame = self._passed_on(link.joint.passage, inner, columns.modes[i].start)
            if (k := columns.rigid.get(joint.coordinate)) is not None:
                moved = np.stack(link.joint.moved_by_joint, axis=1)[:, :, None]
                self.by_joints[i] = self._of_motion(moved)
                frame[:, :, 3 * k : 3 * k + 3] = self.by_joints[i]
            self.frames[i] = frame
            for s, interface in link.interfaces.items():
                by_modes = np.zeros((self.count, self.motion_size, 0))
                if link.body.is_flexible:
                    by_modes = self._of_motion(interface.moved_by_rates(columns.kept[i]))
                self.by_modes[i, s] = by_modes
                if tree.hanging[i, s]:
                    end = self._passed_on(interface.passage, frame, columns.modes[i].stop)
                    end[:, :, _three(columns.modes[i])] = by_modes
                    ends[i, s] = end

    def _passed_on(self, passage: MotionTransform, inner: np.ndarray, width: int) -> np.ndarray:
        """Return the derivatives of a motion by that of the one that carries it."""
        out = np.empty((self.count, self.motion_size, 3 * width))
        np.matmul(self._carrier(passage), inner, out=out[:, :, : inner.shape[2]])
        out[:, :, inner.shape[2] :] = 0.0
        return out

    def _carrier(self, passage: MotionTransform) -> np.ndarray:
        """Return the matrix (n, m, m), or one, that carries a motion on."""
        dim, inner = self.dim, passage.matrix
        if not self.tree.forces:
            return inner
        spin, size = slice(dim.d, dim.d + dim.r), inner.shape[1]
        out = np.zeros((len(inner), size + dim.r, size + dim.r))
        out[:, :size, :size], out[:, size:, size:] = inner, inner[:, spin, spin]
        return out

    def _of_motion(self, x: np.ndarray) -> np.ndarray:
        """Return those (n, m, 3 k) of a motion from those of (a, w, wd) (d + 2 r, 3, k, n)."""
        if self.tree.forces:
            spin = x[self.dim.d : self.dim.d + self.dim.r]
            turned = np.zeros_like(spin)
            turned[:, 0] = spin[:, 1]  # by q, as the spin by q'
            x = np.concatenate([x, turned])
        return _by_coordinate(x)

    def _widened(self, by_motion: np.ndarray) -> np.ndarray:
        """Return derivatives (n, ., m) by a motion of those by (a, w, wd), (., d + 2 r, n)."""
        out = np.zeros((self.count, len(by_motion), self.motion_size))
        _add(out, by_motion)
        return out

    # -- inwards -------------------------------------------------------------------------------

    def _inwards(self) -> None:
        tree, rigid = self.tree, self.columns.rigid
        for i in reversed(tree.order):
            link, felt = self.links[i], len(rigid) > 0 or tree.is_felt(i)
            if not (felt or link.body.is_flexible):
                continue
            outboard = {s: self._outboard(i, s) for s in link.interfaces}
            if link.body.is_flexible:
                self._add_rows(i, outboard)
            if felt:
                self.on_frames[i] = self._on_frame(i, outboard)
                self._add_drive(i)
        if tree.cart is not None and 0 in self.columns.drives:
            row = self.columns.drives[0]
            on, behind = self._on_interface((GROUND, 0)), self.columns.behind(tree, (GROUND, 0))
            self.drives[:, row, 2] = on.by_motion[:, 0, 0] + tree.cart
            self.drives[:, row, _three(behind)] = on.outboard[:, 0]

    def _outboard(self, i: int, s: int) -> _OutboardLoad:
        """Return the derivatives of the load on a body's interface by all that is not inboard."""
        on = self._on_interface((i, s))
        by_frame = on.by_motion @ self._carrier(self.links[i].interfaces[s].passage)
        return _OutboardLoad(by_frame, on.by_motion @ self.by_modes[i, s], on.outboard)

    def _on_interface(self, site: Site) -> _LoadDerivative:
        """Return the derivative of what hangs on an interface, by its own motion."""
        (i, s), tree, columns, rows = site, self.tree, self.columns, self.dim.d + self.dim.r
        by_motion, parts = np.zeros((self.count, rows, self.motion_size)), []
        for k in tree.hanging[site]:
            joint, on_frame, first = self.links[k].joint, self.on_frames[k], columns.first[k]
            of_loads = joint.passage.of_loads
            by_motion += of_loads @ (on_frame.by_motion @ self._carrier(joint.passage))
            by_rigid = np.zeros((self.count, rows, 3 * (columns.modes[k].start - first)))
            if (by_joint := self.by_joints.get(k)) is not None:
                by_rigid[:, :, :3] = of_loads @ (on_frame.by_motion @ by_joint)
                by_rigid[:, :, 0] += joint.load_by_joint(self.loads.joints[k]).T
            if (rotor := self.links[k].rotor) is not None:
                _add(by_motion, rotor.load_by_motion)
                if (place := columns.rigid.get(tree.rotors[k])) is not None:
                    own = _three(slice(place, place + 1), first)
                    by_rigid[:, :, own] += rotor.load_by_motor.transpose(2, 0, 1)
            parts += [by_rigid, of_loads @ on_frame.outboard]
        if i != GROUND and s in self.links[i].carried:
            _add(by_motion, self.links[i].carried[s].load_by_motion)
        return _LoadDerivative(by_motion, _side_by_side([by_motion[:, :, :0], *parts]))

    def _on_frame(self, i: int, outboard: dict[int, _OutboardLoad]) -> _LoadDerivative:
        """Return the derivative of what a joint feels of the body and all behind it."""
        link, kept, dim = self.links[i], self.columns.kept[i], self.dim
        by_motion = self._widened(link.body.load_by_motion)
        own, parts = by_motion[:, :, :0], []
        if link.body.is_flexible:
            own = _by_coordinate(_load_by_rates(link, self.loads.outboard[i], kept))
        for s, interface in link.interfaces.items():
            of_loads, on = interface.passage.of_loads, outboard[s]
            by_motion += of_loads @ on.by_frame
            own = own + of_loads @ on.by_modes
            parts.append(of_loads @ on.outboard)
            if s in link.applied:
                given = _given(link, s)
                lever = _by_instant(dim.by_spin(interface.place)).swapaxes(1, 2)
                by_motion[:, :, -dim.r :] += given
                by_motion[:, dim.d :, -dim.r :] += lever @ given[:, : dim.d]
        return _LoadDerivative(by_motion, _side_by_side([own, *parts]))

    def _add_drive(self, i: int) -> None:
        """Add the rows of a joint's force, and of its motor's."""
        tree, columns, link = self.tree, self.columns, self.links[i]
        joint, on_frame, frame = tree.joints[i], self.on_frames[i], self.frames[i]
        if (row := columns.drives.get(joint.coordinate)) is not None:
            axis = np.zeros(self.dim.b)
            axis[link.joint.along] = joint.axis
            by_inboard = (axis @ on_frame.by_motion)[:, None] @ frame
            self.drives[:, row, : frame.shape[2]] = by_inboard[:, 0]
            own = slice(columns.modes[i].start, columns.last[i])
            self.drives[:, row, _three(own)] = axis @ on_frame.outboard
        if link.rotor is None or (row := columns.drives.get(tree.rotors[i])) is None:
            return
        by_carrier = self.by_carriers[i]
        self.drives[:, row, : by_carrier.shape[1]] += by_carrier
        self.drives[:, row, 3 * columns.rigid[tree.rotors[i]] + 2] += link.rotor.force_by_motor

    def _add_rows(self, i: int, outboard: dict[int, _OutboardLoad]) -> None:
        """Add the derivative of a body's rows: by its own modes, what is inboard, outboard."""
        link, columns, loads = self.links[i], self.columns, self.loads.outboard[i]
        body, kept, dim = link.body, columns.kept[i], self.dim
        own = np.empty((self.count, body.constants.num_modes, len(kept), 3))
        rates = body.rows_by_rates(kept, interface_coefficients(link, loads))
        own[..., 0], own[..., 1], own[..., 2] = rates
        by_frame, parts = self._widened(body.rows_by_motion.swapaxes(0, 1)), []
        flat = own.reshape(self.count, body.constants.num_modes, -1)
        for s, interface in link.interfaces.items():
            turning = interface.coefficients_by_e(loads[s], kept)
            if turning is not None:
                theta = body.V[interface.places][dim.d :]
                own[..., 0] += _by_instant(theta.swapaxes(0, 1)) @ _by_instant(turning)
            by_load = _by_instant(interface.rows_by_load.swapaxes(0, 1))
            turned = interface.load_by_rates(carried_load(link, loads, s), kept)
            own[..., 0] += by_load @ _by_instant(turned)
            by_own_load, on = _by_instant(interface.rows_by_own_load.swapaxes(0, 1)), outboard[s]
            flat += by_own_load @ on.by_modes
            by_frame += by_own_load @ on.by_frame
            if s in link.applied:
                by_frame[:, :, -dim.r :] += by_load @ _given(link, s)
            parts.append((columns.behind(self.tree, (i, s)), by_own_load, on.outboard))
        parts.append((slice(0, columns.modes[i].start), by_frame, self.frames[i]))
        self._add_blocks(i, flat, [one for one in parts if one[2].shape[2]])

    def _add_blocks(
        self, i: int, own: np.ndarray, parts: list[tuple[slice, np.ndarray, np.ndarray]]
    ) -> None:
        """Add a body's blocks, as one where its rows are not more than their rank."""
        first, part, modes = len(self.columns.drives), self.tree.slices[i], self.columns.modes[i]
        rows = slice(first + part.start, first + part.stop)
        if own.shape[1] > sum(right.shape[1] for _, _, right in parts):
            self.blocks.append(Block(rows, _three(modes), None, own))
            self.blocks += [Block(rows, _three(place), *both) for place, *both in parts]
            return
        whole = np.zeros((self.count, own.shape[1], 3 * len(self.columns.order)))
        whole[:, :, _three(modes)] = own
        for place, left, right in parts:
            np.matmul(left, right, out=whole[:, :, _three(place)])
        self.blocks.append(Block(rows, slice(0, whole.shape[2]), None, whole))


def _add(by_motion: np.ndarray, more: np.ndarray) -> None:
    """Add derivatives by (a, w, wd) (., d + 2 r, n) to those by a motion (n, ., m)."""
    by_motion[:, :, : more.shape[1]] += more.transpose(2, 0, 1)


def _side_by_side(parts: list[np.ndarray]) -> np.ndarray:
    """Return derivatives by the columns of all parts (n, ., 3 c)."""
    some = [one for one in parts if one.shape[2]] or parts[:1]
    return some[0] if len(some) == 1 else np.concatenate(some, axis=2)


def _by_coordinate(x: np.ndarray) -> np.ndarray:
    """Return derivatives (n, ., 3 k) of (., 3, k, n)."""
    return np.ascontiguousarray(x.transpose(3, 0, 2, 1)).reshape(x.shape[3], len(x), -1)


def _by_instant(x: np.ndarray) -> np.ndarray:
    """Return matrices (n, i, j) of (i, j, n)."""
    return np.ascontiguousarray(x.transpose(2, 0, 1))


def _load_by_rates(link: Link, outboard: dict[int, np.ndarray], kept: np.ndarray) -> np.ndarray:
    """Return the derivative of what a joint feels by those e, e', e'' of its body kept."""
    # (d + r, 3, k, n): of the body's inertia, and of where and how its interfaces are turned.
    body, dim, d = link.body, link.body.dim, link.body.dim.d
    found = body.load_by_rates(kept)
    for s, interface in link.interfaces.items():
        turned = interface.load_by_rates(carried_load(link, outboard, s), kept)
        found[:, 0] += turned
        found[d:, 0] += dim.moment(interface.place, turned[:d])
        displaced = body.V[interface.places][:d, kept]
        found[d:, 0] += dim.moment(displaced, outboard[s][:d])
    return found


def _given(link: Link, s: int) -> np.ndarray:
    """Return the derivative (n, d + r, r) of the forces of the world by the body's rotation."""
    dim = link.body.dim
    force, moment = np.split(link.applied[s].in_world, [dim.d])
    of_moment = dim.by_spin(moment) if dim.r > 1 else np.zeros((1, 1, moment.shape[1]))
    return -_by_instant(np.concatenate([dim.by_spin(force), of_moment]))
