"""Tangent of inverse dynamics: its derivative by coordinates and their rates.

The derivatives of frames' motions by all coordinates inboard of them go outwards along the tree as
motions do, those of loads inwards; every body adds what its own coordinates do to both.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dolfinopt.multibody.body import by_instant
from dolfinopt.multibody.frames import CarriedFrame
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

    def interpolated(self, weights: np.ndarray, keep: np.ndarray) -> Tangent:
        """Return it by some of the coordinates, at further instants between those of every step.

        Args:
            weights: (m, s) of s instants in turn, for m others.
            keep: ascending places among the S coordinates.
        """
        kept = self.matrix[:, :, self.order[keep]]
        between = weights @ kept.reshape(-1, weights.shape[1], kept[0].size)
        between = between.reshape(-1, *kept.shape[1:])
        return Tangent(between, self.own[keep], np.arange(len(keep)))

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
        self.count, rows = links[0].body.a.shape[1], len(asked) + tree.num_coordinates
        self.places, self.order = _columns(tree, asked, keep)
        ends = np.searchsorted(keep, [0, *(part.stop for part in tree.slices)])
        parts = zip(pairwise(ends), tree.slices, strict=True)
        self.kept = [keep[a:b] - part.start for (a, b), part in parts]
        places = self.order[len(asked) :]
        self.columns = [slice(3 * p[0], 3 * p[-1] + 3) if len(p:=places[a:b]) else slice(0, 0) for a, b in pairwise(ends)]
        self.matrix = np.zeros((self.count, rows, 3 * len(self.order)))
        # Of the motions of frames and interfaces by all coordinates inboard of them and their own.
        self.frames: dict[int, np.ndarray] = {}
        self.ends: dict[Site, np.ndarray] = {}
        self._outwards()
        self.on_frames: dict[int, np.ndarray] = {}  # derivatives of loads by all coordinates
        self._inwards()

    def _outwards(self) -> None:
        size = self.dim.b + self.dim.r
        cart = self.tree.cart is not None and 0 in self.rows
        ground = np.zeros((self.count, size, 3 * cart))
        ground[:, 0, 2::3] = 1.0
        self.ends[GROUND, 0] = ground
        for i in self.tree.order:
            link, joint, own = self.links[i], self.tree.joints[i], self.columns[i]
            inner = self.ends[joint.parent, joint.interface]
            place, width = self.places.get(joint.coordinate), inner.shape[2]
            stop = width if place is None else max(width, 3 * place + 3)
            frame = np.zeros((self.count, size, stop))
            np.matmul(by_instant(link.joint.transform), inner, out=frame[:, :, :width])
            if place is not None:
                by_joint = link.joint.by_coordinates[:, :, 0].transpose(2, 0, 1)
                frame[:, :, 3 * place : 3 * place + 3] += by_joint
            self.frames[i] = frame
            for s, interface in link.interfaces.items():
                width = frame.shape[2]
                end = np.zeros((self.count, size, max(width, own.stop)))
                np.matmul(by_instant(interface.transform), frame, out=end[:, :, :width])
                if link.body.is_flexible:
                    moved = interface.by_coordinates
                    by_own = link.body.by_rates(moved, interface.places, self.kept[i])
                    end[:, :, own] += by_own.reshape(self.count, size, -1)
                self.ends[i, s] = end

    def _inwards(self) -> None:
        for i in reversed(self.tree.order):
            link = self.links[i]
            felt = len(self.rows) > 0 or self.tree.is_felt(i)
            if felt or link.body.is_flexible:
                self._add_body(i, felt)
        if self.rows:
            on_ground = self._on_interface((GROUND, 0))
            if self.tree.cart is not None and 0 in self.rows:
                self.matrix[:, 0] += on_ground[:, 0]
                self.matrix[:, 0, 2] += self.tree.cart

    def _on_interface(self, site: Site) -> np.ndarray:
        """Return the derivative of the load on an interface (n, d + r, 3 S), in its components."""
        tree, dim, end, by_motion = self.tree, self.dim, self.ends[site], []
        on_it = [self._carrier(self.links[k].joint) @ self.on_frames[k] for k in tree.hanging[site]]
        none = np.zeros((self.count, dim.b, self.matrix.shape[2]))
        out = sum(on_it[1:], on_it[0]) if on_it else none
        for k in tree.hanging[site]:
            joint, rotor = self.links[k].joint, self.links[k].rotor
            if (place := self.places.get(joint.joint.coordinate)) is not None:
                load = joint.in_carrier(self.loads.joints[k])
                out[:, :, 3 * place] += joint.load_by_coordinates(load, load)[:, 0].T
            if rotor is None:
                continue
            by_motion.append(rotor.load_by_motion)
            if (place := self.places.get(tree.rotors[k])) is not None:
                row, columns = self.rows[tree.rotors[k]], slice(3 * place, 3 * place + 3)
                out[:, :, columns] += rotor.load_by_motor.transpose(2, 0, 1)
                self.matrix[:, row, : end.shape[2]] += rotor.force_by_motion @ end
                self.matrix[:, row, 3 * place + 2] += rotor.force_by_motor
        i, s = site
        if i != GROUND and s in self.links[i].carried:
            by_motion.append(self.links[i].carried[s].load_by_motion)
        if by_motion:
            out[:, :, : end.shape[2]] += by_instant(sum(by_motion[1:], by_motion[0])) @ end
        return out

    def _add_body(self, i: int, felt: bool) -> None:
        """Add the rows of a body and of its joint's drive."""
        link, part, first = self.links[i], self.tree.slices[i], len(self.rows)
        outboard = {s: self._on_interface((i, s)) for s in link.interfaces}
        if link.body.is_flexible:
            self._add_rows(i, self.matrix[:, first + part.start : first + part.stop], outboard)
        if felt:
            self.on_frames[i] = self._on_frame(i, outboard)
        if (row := self.rows.get(self.tree.joints[i].coordinate)) is not None:
            self.matrix[:, row] += link.joint.drive_axis @ self.on_frames[i]

    def _add_rows(self, i: int, rows: np.ndarray, outboard: dict[int, np.ndarray]) -> None:
        """Add the derivative of a body's elastic rows."""
        link, kept, frame = self.links[i], self.kept[i], self.frames[i]
        body, loads, width = link.body, self.loads.outboard[i], frame.shape[2]
        by_rates = body.rows_by_rates(kept, interface_coefficients(link, loads))
        np.matmul(by_instant(body.rows_by_motion.swapaxes(0, 1)), frame, out=rows[:, :, :width])
        for s, interface in link.interfaces.items():
            rows += by_instant(interface.rows_by_load.swapaxes(0, 1)) @ outboard[s]
            V = by_instant(interface.V)
            turning = carried_load(link, loads, s)
            by_displacement = interface.coefficients_by_coordinates(loads[s], turning)
            by_e = by_instant(by_displacement) @ V[:, :, kept]
            by_rates[..., 0] += V.swapaxes(1, 2) @ by_e
            if s in link.applied:
                given = by_instant(interface.coefficients(_given(link, s)))
                rows[:, :, 0:width:3] += V.swapaxes(1, 2) @ (given @ self._rotation(i))
        rows[:, :, self.columns[i]] += by_rates.reshape(*rows.shape[:2], -1)

    def _on_frame(self, i: int, outboard: dict[int, np.ndarray]) -> np.ndarray:
        """Return the derivative of what a joint feels of the body and all behind it."""
        link, kept, frame = self.links[i], self.kept[i], self.frames[i]
        body, loads, width = link.body, self.loads.outboard[i], frame.shape[2]
        on_it = [self._carrier(link.interfaces[s]) @ load for s, load in outboard.items()]
        none = np.zeros((self.count, self.dim.b, self.matrix.shape[2]))
        out = sum(on_it[1:], on_it[0]) if on_it else none
        out[:, :, :width] += by_instant(body.load_by_motion) @ frame
        by_rates = body.load_by_rates(kept) if body.is_flexible else None
        for s, interface in link.interfaces.items():
            if by_rates is not None:
                turning = carried_load(link, loads, s)
                by_displacement = by_instant(interface.load_by_coordinates(loads[s], turning))
                by_rates[..., 0] += by_displacement @ by_instant(interface.V[:, kept])
            if s in link.applied:
                given = by_instant(self.dim.shifted(interface.place, _given(link, s)))
                out[:, :, 0:width:3] += given @ self._rotation(i)
        if by_rates is not None:
            out[:, :, self.columns[i]] += by_rates.reshape(*out.shape[:2], -1)
        return out

    def _rotation(self, i: int) -> np.ndarray:
        """Return the derivative of a body's rotation by all coordinates inboard (n, r, .)."""
        return self.frames[i][:, self.dim.d : self.dim.b, 1::3]  # as its spin's by their rates

    def _carrier(self, frame: CarriedFrame) -> np.ndarray:
        """Return what carries a load on a frame to the origin of its carrier (n, d + r, d + r)."""
        # Forces and moments work on displacements and rotations as a and wd go.
        kept = np.r_[0 : self.dim.d, self.dim.b : self.dim.b + self.dim.r]
        return by_instant(frame.transform[kept[:, None], kept].swapaxes(0, 1))


def _given(link: Link, s: int) -> np.ndarray:
    """Return the derivative (d + r, r, n) of the forces of the world by the body's rotation."""
    dim = link.body.dim
    force, moment = np.split(link.applied[s].in_world, [dim.d])
    of_moment = dim.by_spin(moment) if dim.r > 1 else np.zeros((1, 1, moment.shape[1]))
    return -np.concatenate([dim.by_spin(force), of_moment])
