"""Tangent of inverse dynamics: its derivative by coordinates and their rates.

The derivatives of frames' motions by all coordinates inboard of them go outwards along the tree as
motions do, those of loads inwards; every body adds what its own coordinates do to both.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dolfinopt.multibody.body import by_instant
from dolfinopt.multibody.newton_euler import (
    Link,
    carried_load,
    interface_coefficients,
    inward_pass,
    outward_pass,
)
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates
from dolfinopt.multibody.tree import GROUND, Mechanism, Site


@dataclass(frozen=True, eq=False)
class Tangent:
    """Derivative of W rows by S coordinates, their rates and accelerations, at n instants.

    Of m rows or changes, a multiple of n, each instant stands for as many in turn.

    Attributes:
        matrix: (n, W, S, 3).
        own: (S,) ascending, the coordinates' own rows.
        order: (S,) places of the coordinates among the columns.
    """

    matrix: np.ndarray
    own: np.ndarray
    order: np.ndarray

    @property
    def _flat(self) -> np.ndarray:
        """It as matrices (n, W, 3 S)."""
        count, rows, size, _ = self.matrix.shape
        return self.matrix.reshape(count, rows, 3 * size)

    def step_mean(self, stages: int, keep: np.ndarray) -> Tangent:
        """Return its mean over every `stages` instants, by some of the coordinates, ascending."""
        kept = self.matrix.take(self.order[keep], axis=2)
        mean = kept.reshape(-1, stages, *kept.shape[1:]).mean(axis=1)
        return Tangent(mean, self.own[keep], np.arange(len(keep)))

    def dense(self) -> np.ndarray:
        """Return the S coordinates' own rows (n, S, 3 S), columns ordered q, qd, qdd."""
        own = self.matrix[:, self.own[:, None], self.order].swapaxes(2, 3)
        return own.reshape(*own.shape[:2], 3 * len(self.own))

    def times(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, wanted: np.ndarray
    ) -> np.ndarray:
        """Return the change of the wanted rows (m, .) by a change (m, S) each."""
        change = np.empty((*q.shape, 3))
        change[:, self.order] = np.stack([q, qd, qdd], axis=2)
        change = change.reshape(len(self.matrix), -1, 3 * q.shape[1])
        found = change @ self._flat.swapaxes(1, 2)
        return found.reshape(len(q), -1)[:, wanted]

    def transposed(self, rows: np.ndarray) -> Rates:
        """Return the gradient of sum_m rows_m . residual_m by q, qd, qdd, each (m, S)."""
        found = rows.reshape(len(self.matrix), -1, rows.shape[1]) @ self._flat
        found = found.reshape(len(rows), -1, 3)[:, self.order]
        return found[:, :, 0], found[:, :, 1], found[:, :, 2]


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
    tree = mechanism
    asked = np.zeros(0, dtype=int) if rigid is None else rigid
    keep = np.arange(tree.num_coordinates) if keep is None else keep
    links = outward_pass(tree, motion, (q, qd, qdd))
    found = _Passes(tree, links, asked, keep)
    if tree.friction is not None:
        slope = tree.friction.slope(motion.qd)
        for row, k in enumerate(asked[asked < tree.num_rigid]):
            found.matrix[:, row, 3 * found.places[k] + 1] += slope[:, k]
    own = np.concatenate([np.arange(len(asked)), len(asked) + keep])
    return Tangent(found.matrix.reshape(*found.matrix.shape[:2], len(own), 3), own, found.order)


def _columns(
    tree: Mechanism, asked: np.ndarray, keep: np.ndarray
) -> tuple[dict[int | None, int], np.ndarray]:
    """Return places of coordinates in the order in which the way outwards meets them.

    What moves a frame then stands before what it carries. Also their places (S,) as asked for.
    """
    first = tree.num_rigid + len(tree.motor_joints)
    wanted = [*asked, *(first + keep)]
    met: list[int | None] = [tree.cart_coordinate]
    for i in tree.order:
        part = tree.slices[i]
        met += [tree.joints[i].coordinate, tree.rotors.get(i)]
        met += range(first + part.start, first + part.stop)
    some = set(wanted)
    met = [k for k in dict.fromkeys([*met, *wanted]) if k in some]  # lengths of rods are not met
    places = {k: place for place, k in enumerate(met)}
    return places, np.array([places[k] for k in wanted], dtype=int)


@dataclass(frozen=True, eq=False)
class _LoadDerivative:
    """Derivatives of the load on a frame or an interface, in its components.

    Attributes:
        by_motion: by its own motion, all that hangs on it moving along (n, d + r, d + 2 r).
        by_columns: by the columns from `first` on (n, d + r, .).
        first: where those that do not move it begin.
    """

    by_motion: np.ndarray
    by_columns: np.ndarray
    first: int


class _Passes:
    """Both passes.

    Attributes:
        matrix: (n, R + N, 3 S), of R rigid coordinates asked for.
    """

    def __init__(
        self, tree: Mechanism, links: list[Link], asked: np.ndarray, keep: np.ndarray
    ) -> None:
        """Go outwards and inwards."""
        self.tree, self.links, self.dim = tree, links, tree.dim
        self.loads = inward_pass(tree, links, driven=len(asked) > 0)
        self.rows: dict[int | None, int] = {int(k): row for row, k in enumerate(asked)}
        self.places, self.order = _columns(tree, asked, keep)
        ends = np.searchsorted(keep, [0, *(part.stop for part in tree.slices)])
        parts = zip(pairwise(ends), tree.slices, strict=True)
        self.kept = [keep[a:b] - part.start for (a, b), part in parts]
        self.count, rows = links[0].body.a.shape[1], len(asked) + tree.num_coordinates
        self.matrix = np.zeros((self.count, rows, 3 * len(self.order)))
        # Of the motions of interfaces by all columns before their body's and by these.
        self.ends: dict[Site, np.ndarray] = {}
        self.own: dict[int, slice] = {}  # columns of a body's coordinates
        self._outwards()
        self.on_carriers: dict[int, _LoadDerivative] = {}
        self._inwards()

    def _outwards(self) -> None:
        tree = self.tree
        cart = tree.cart is not None and 0 in self.rows
        ground = np.zeros((self.count, self.dim.b + self.dim.r, 3 * cart))
        ground[:, 0, 2::3] = 1.0
        self.ends[GROUND, 0] = ground
        stop = ground.shape[2]
        for i in tree.order:
            link, joint, kept = self.links[i], tree.joints[i], self.kept[i]
            stop += 3 * sum(k in self.rows for k in {joint.coordinate, tree.rotors.get(i)})
            self.own[i] = slice(stop, stop + 3 * len(kept))
            stop = self.own[i].stop
            for s, interface in link.interfaces.items():
                end = self.ends[i, s] = self._moved(i, interface.transform, stop)
                if link.body.is_flexible:
                    by_own = link.body.by_rates(interface.by_coordinates, interface.places, kept)
                    end[:, :, self.own[i]] = by_own.reshape(*end.shape[:2], -1)

    def _carrier(self, i: int) -> np.ndarray:
        """Return the derivatives of the motion of what carries body i."""
        joint = self.tree.joints[i]
        return self.ends[joint.parent, joint.interface]

    def _moved(self, i: int, left: np.ndarray, width: int) -> np.ndarray:
        """Return matrices (n, m, .) times the derivatives of a frame's motion."""
        out = np.zeros((self.count, left.shape[1], width))
        self._add_moved(i, left, out, alone=True)
        return out

    def _add_moved(self, i: int, left: np.ndarray, out: np.ndarray, alone: bool) -> None:
        """Add matrices (n, m, .) times the derivatives of the motion of a body's frame."""
        carrier = self._carrier(i)
        by_carrier = left @ self.links[i].joint.transform
        _add_product(by_carrier, carrier, out[:, :, : carrier.shape[2]], alone)
        if (by_joint := self._joint_columns(i)) is not None:
            out[:, :, by_joint] += left @ self._by_joint(i)

    def _joint_columns(self, i: int) -> slice | None:
        """Return the columns of the coordinate of a body's joint, if it is asked for."""
        place = self.places.get(self.tree.joints[i].coordinate)
        return None if place is None else slice(3 * place, 3 * place + 3)

    def _by_joint(self, i: int) -> np.ndarray:
        """Return the derivatives of a frame's motion by its joint's coordinate (n, d + 2 r, 3)."""
        return self.links[i].joint.by_coordinates[:, :, 0].transpose(2, 0, 1)

    def _inwards(self) -> None:
        for i in reversed(self.tree.order):
            felt = len(self.rows) > 0 or self.tree.is_felt(i)
            if not (felt or self.links[i].body.is_flexible):
                continue
            outboard = {s: self._on_interface((i, s)) for s in self.links[i].interfaces}
            if self.links[i].body.is_flexible:
                self._add_rows(i, outboard)
            if felt:
                self.on_carriers[i] = self._on_carrier(i, outboard)
        if self.rows:
            on_ground = self._on_interface((GROUND, 0))
            if self.tree.cart is not None and 0 in self.rows:
                self.matrix[:, 0, on_ground.first :] += on_ground.by_columns[:, 0]
                self.matrix[:, 0, 2] += on_ground.by_motion[:, 0, 0] + self.tree.cart

    def _first(self, width: int) -> int:
        """Return the first column by which loads behind a frame of so many are differentiated."""
        return 0 if self.tree.forces else width  # those of the world turn with what is inboard

    def _on_interface(self, site: Site) -> _LoadDerivative:
        """Return the derivative of the load on an interface by all that is not inboard."""
        (i, s), tree, end = site, self.tree, self.ends[site]
        first = self._first(end.shape[2])
        hanging = [self.on_carriers[k] for k in tree.hanging[site]]
        by_motion = np.zeros((self.count, self.dim.b, end.shape[1]))
        by_motion += sum(one.by_motion for one in hanging)
        if hanging:
            by_columns = sum((one.by_columns for one in hanging[1:]), hanging[0].by_columns)
        else:
            by_columns = np.zeros((self.count, self.dim.b, self.matrix.shape[2] - first))
        for k in tree.hanging[site]:
            if (rotor := self.links[k].rotor) is None:
                continue
            by_motion += by_instant(rotor.load_by_motion)
            if (row := self.rows.get(tree.rotors[k])) is not None:
                place = 3 * self.places[tree.rotors[k]]
                by_motor = rotor.load_by_motor.transpose(2, 0, 1)
                by_columns[:, :, place - first : place - first + 3] += by_motor
                self.matrix[:, row, : end.shape[2]] += rotor.force_by_motion @ end
                self.matrix[:, row, place + 2] += rotor.force_by_motor
        if i != GROUND and s in self.links[i].carried:
            by_motion += by_instant(self.links[i].carried[s].load_by_motion)
        return _LoadDerivative(by_motion, by_columns, first)

    def _add_rows(self, i: int, outboard: dict[int, _LoadDerivative]) -> None:
        """Add the derivative of a body's elastic rows."""
        link, kept, part = self.links[i], self.kept[i], self.tree.slices[i]
        body, loads, columns = link.body, self.loads.outboard[i], self.own[i]
        rows = self.matrix[:, len(self.rows) + part.start : len(self.rows) + part.stop]
        by_motion = by_instant(body.rows_by_motion.swapaxes(0, 1))
        own = body.rows_by_rates(kept, interface_coefficients(link, loads))
        own = own.reshape(*rows.shape[:2], -1)
        for s, interface in link.interfaces.items():
            V, turning, on = by_instant(interface.V), carried_load(link, loads, s), outboard[s]
            Vt, by_end = V.swapaxes(1, 2), interface.of_coefficients @ on.by_motion
            by_load = Vt @ interface.of_coefficients
            by_motion += Vt @ (by_end @ interface.transform)
            _add_product(by_load, on.by_columns, rows[:, :, on.first :], len(outboard) == 1)
            by_own = by_end @ self.ends[i, s][:, :, columns]
            by_displacement = interface.coefficients_by_coordinates(loads[s], turning)
            by_own[:, :, ::3] += by_instant(by_displacement) @ V[:, :, kept]
            own += Vt @ by_own
            if s in link.applied:
                given = by_instant(interface.coefficients(_given(link, s)))
                self._add_turned(i, Vt @ given, rows)
        rows[:, :, columns] += own
        self._add_moved(i, by_motion, rows, alone=not self.tree.forces)

    def _on_carrier(self, i: int, outboard: dict[int, _LoadDerivative]) -> _LoadDerivative:
        """Return the derivative of what a body and all behind it ask of what carries it.

        The row of the joint's drive follows from the same products.
        """
        link, kept, own, b = self.links[i], self.kept[i], self.own[i], self.dim.b
        body, joint, loads = link.body, link.joint, self.loads.outboard[i]
        carrier, row = self._carrier(i), self.rows.get(joint.joint.coordinate)
        left, first = joint.of_loads, self._first(carrier.shape[2])
        if row is not None:
            axis = np.broadcast_to(joint.drive_axis, (self.count, 1, b))
            left = np.concatenate([np.broadcast_to(left, (self.count, b, b)), axis], axis=1)
        by_motion = by_instant(body.load_by_motion)
        by_own = np.zeros((self.count, b, 3 * len(kept)))
        if body.is_flexible:
            by_own = body.load_by_rates(kept).reshape(by_own.shape)
        out = np.zeros((self.count, left.shape[1], self.matrix.shape[2] - first))
        for s, interface in link.interfaces.items():
            of_loads, on = interface.of_loads, outboard[s]
            by_motion += of_loads @ (on.by_motion @ interface.transform)
            by_own += of_loads @ (on.by_motion @ self.ends[i, s][:, :, own])
            behind = out[:, :, on.first - first :]
            _add_product(left @ of_loads, on.by_columns, behind, len(outboard) == 1)
            if body.is_flexible:
                turning = carried_load(link, loads, s)
                by_displacement = by_instant(interface.load_by_coordinates(loads[s], turning))
                by_own[:, :, ::3] += by_displacement @ by_instant(interface.V[:, kept])
            if s in link.applied:
                given = by_instant(self.dim.shifted(interface.place, _given(link, s)))
                self._add_turned(i, left @ given, out)
        out[:, :, own.start - first : own.stop - first] += left @ by_own
        by_motion = left @ by_motion
        by_carrier = by_motion @ joint.transform
        if (columns := self._joint_columns(i)) is not None:
            by_joint = out[:, :, columns.start - first : columns.stop - first]
            by_joint += by_motion @ self._by_joint(i)
            load = joint.in_carrier(self.loads.joints[i])
            if row is not None:
                self.matrix[:, row, : carrier.shape[2]] += (by_carrier[:, b:] @ carrier)[:, 0]
                self.matrix[:, row, first:] += out[:, b]
            by_joint[:, :b, 0] += joint.load_by_coordinates(load, load)[:, 0].T
        return _LoadDerivative(by_carrier[:, :b], out[:, :b], first)

    def _add_turned(self, i: int, left: np.ndarray, out: np.ndarray) -> None:
        """Add matrices (n, m, r) times the derivatives of a body's rotation by coordinates."""
        # They are those of its spin by their rates.
        spin = np.eye(self.dim.b + self.dim.r)[self.dim.d : self.dim.b]
        turned = self._moved(i, left @ spin, self.own[i].start)
        out[:, :, 0 : self.own[i].start : 3] += turned[:, :, 1::3]


def _given(link: Link, s: int) -> np.ndarray:
    """Return the derivative (d + r, r, n) of the forces of the world by the body's rotation."""
    dim = link.body.dim
    force, moment = np.split(link.applied[s].in_world, [dim.d])
    of_moment = dim.by_spin(moment) if dim.r > 1 else np.zeros((1, 1, moment.shape[1]))
    return -np.concatenate([dim.by_spin(force), of_moment])


def _add_product(A: np.ndarray, B: np.ndarray, out: np.ndarray, alone: bool) -> None:
    """Add A B; where it is alone nothing stands there yet."""
    if alone:
        np.matmul(A, B, out=out)
    else:
        out += A @ B
