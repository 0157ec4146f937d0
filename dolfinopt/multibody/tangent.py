"""Tangent of inverse dynamics: its derivative by coordinates and their rates.

The derivatives of frames' motions by all coordinates inboard of them go outwards along the tree as
motions do, those of loads by all coordinates inwards; every body adds what its own coordinates do.
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

    def step_mean(self, steps: int, keep: np.ndarray) -> Tangent:
        """Return its mean over the instants of each step, by some of the coordinates, ascending."""
        kept = self.matrix.take(self.order[keep], axis=2)
        mean = kept.reshape(steps, -1, *kept.shape[1:]).mean(axis=1)
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
        result = change @ self._flat.swapaxes(1, 2)
        return result.reshape(len(q), -1)[:, wanted]

    def transposed(self, rows: np.ndarray) -> Rates:
        """Return the gradient of sum_m rows_m . residual_m by q, qd, qdd, each (m, S)."""
        result = rows.reshape(len(self.matrix), -1, rows.shape[1]) @ self._flat
        result = result.reshape(len(rows), -1, 3)[:, self.order]
        return result[:, :, 0], result[:, :, 1], result[:, :, 2]


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
    result = _Passes(tree, links, asked, keep)
    if tree.friction is not None:
        slope = tree.friction.slope(motion.qd)
        for row, k in enumerate(asked[asked < tree.num_rigid]):
            result.matrix[:, row, 3 * result.places[k] + 1] += slope[:, k]
    own = np.concatenate([np.arange(len(asked)), len(asked) + keep])
    return Tangent(result.matrix.reshape(*result.matrix.shape[:2], len(own), 3), own, result.order)


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
    """Both passes; derivatives have a column for each coordinate, its rate and acceleration.

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
        # Derivatives of motions by the columns up to the last one that moves them.
        self.frames: dict[int, np.ndarray] = {}
        self.ends: dict[Site, np.ndarray] = {}
        self.own: dict[int, slice] = {}  # columns of a body's coordinates
        self._outwards()
        self.on_carriers: dict[int, np.ndarray] = {}  # derivatives of loads (n, d + r, 3 S)
        self._inwards()

    def _outwards(self) -> None:
        tree = self.tree
        stop = 3 * (tree.cart is not None and 0 in self.rows)
        ground = np.zeros((self.count, self.dim.b + self.dim.r, stop))
        ground[:, 0, 2::3] = 1.0
        self.ends[GROUND, 0] = ground
        for i in tree.order:
            link, joint, kept = self.links[i], tree.joints[i], self.kept[i]
            stop += 3 * sum(k in self.rows for k in {joint.coordinate, tree.rotors.get(i)})
            frame = self.frames[i] = np.zeros((*ground.shape[:2], stop))
            carrier = self.ends[joint.parent, joint.interface]
            np.matmul(link.joint.transform, carrier, out=frame[:, :, : carrier.shape[2]])
            if (columns := self._of(joint.coordinate)) is not None:
                frame[:, :, columns] += by_instant(link.joint.by_coordinates[:, :, 0])
            self.own[i] = slice(stop, stop + 3 * len(kept))
            stop = self.own[i].stop
            for s, interface in link.interfaces.items():
                end = self.ends[i, s] = np.zeros((*ground.shape[:2], stop))
                np.matmul(interface.transform, frame, out=end[:, :, : frame.shape[2]])
                if link.body.is_flexible:
                    by_own = link.body.by_rates(interface.by_coordinates, interface.places, kept)
                    end[:, :, self.own[i]] = by_own.reshape(*end.shape[:2], -1)

    def _of(self, coordinate: int | None) -> slice | None:
        """Return the columns of a rigid coordinate, if it is asked for."""
        place = self.places.get(coordinate)
        return None if place is None else slice(3 * place, 3 * place + 3)

    def _inwards(self) -> None:
        for i in reversed(self.tree.order):
            felt = len(self.rows) > 0 or self.tree.is_felt(i)
            if not (felt or self.links[i].body.is_flexible):
                continue
            outboard = {s: self._on_interface((i, s)) for s in self.links[i].interfaces}
            if self.links[i].body.is_flexible:
                self._add_rows(i, outboard)
            if felt:
                self.on_carriers[i] = self._on_carrier(i, self._on_frame(i, outboard))
        if not self.rows:
            return
        on_ground = self._on_interface((GROUND, 0))
        if self.tree.cart is not None and 0 in self.rows:
            self.matrix[:, 0] += on_ground[:, 0]
            self.matrix[:, 0, 2] += self.tree.cart

    def _on_interface(self, site: Site) -> np.ndarray:
        """Return the derivative of the load on an interface, in its components."""
        (i, s), tree, end = site, self.tree, self.ends[site]
        out = np.zeros((self.count, self.dim.b, self.matrix.shape[2]))
        moved = out[:, :, : end.shape[2]]
        for k in tree.hanging[site]:
            out += self.on_carriers[k]
            if (rotor := self.links[k].rotor) is None:
                continue
            moved += by_instant(rotor.load_by_motion) @ end
            if (columns := self._of(tree.rotors[k])) is not None:
                out[:, :, columns] += by_instant(rotor.load_by_motor)
                row = self.matrix[:, self.rows[tree.rotors[k]]]
                row[:, : end.shape[2]] += rotor.force_by_motion @ end
                row[:, columns.stop - 1] += rotor.force_by_motor
        if i != GROUND and s in self.links[i].carried:
            moved += by_instant(self.links[i].carried[s].load_by_motion) @ end
        return out

    def _add_rows(self, i: int, outboard: dict[int, np.ndarray]) -> None:
        """Add the derivative of a body's elastic rows."""
        link, kept = self.links[i], self.kept[i]
        body, loads = link.body, self.loads.outboard[i]
        first, part = len(self.rows), self.tree.slices[i]
        rows = self.matrix[:, first + part.start : first + part.stop]
        frame = self.frames[i]
        moved = rows[:, :, : frame.shape[2]]
        by_motion = body.rows_by_motion.swapaxes(0, 1)
        moved += by_instant(by_motion) @ frame
        pulls = interface_coefficients(link, loads)
        own = body.rows_by_rates(kept, pulls)
        for s, interface in link.interfaces.items():
            V = by_instant(interface.V)
            Vt = V.swapaxes(1, 2)
            rows += (Vt @ interface.of_coefficients) @ outboard[s]
            turning = carried_load(link, loads, s)
            by_x = interface.coefficients_by_coordinates(loads[s], turning)
            own[..., 0] += Vt @ (by_instant(by_x) @ V[:, :, kept])
            if s in link.applied:
                given = interface.coefficients(_given(link, s))
                moved[:, :, ::3] += Vt @ by_instant(given) @ self._turned(i)
        rows[:, :, self.own[i]] += own.reshape(*rows.shape[:2], -1)

    def _on_frame(self, i: int, outboard: dict[int, np.ndarray]) -> np.ndarray:
        """Return the derivative of what a body and all behind it ask of its frame."""
        link, kept, frame = self.links[i], self.kept[i], self.frames[i]
        body, loads = link.body, self.loads.outboard[i]
        out = np.zeros((self.count, self.dim.b, self.matrix.shape[2]))
        moved = out[:, :, : frame.shape[2]]
        moved += by_instant(body.load_by_motion) @ frame
        own = out[:, :, self.own[i]]
        if body.is_flexible:
            own += body.load_by_rates(kept).reshape(own.shape)
        for s, interface in link.interfaces.items():
            out += interface.of_loads @ outboard[s]
            if body.is_flexible:
                turning = carried_load(link, loads, s)
                by_x = interface.load_by_coordinates(loads[s], turning)
                V = by_instant(interface.V[:, kept])
                own[:, :, ::3] += by_instant(by_x) @ V
            if s in link.applied:
                given = self.dim.shifted(interface.place, _given(link, s))
                moved[:, :, ::3] += by_instant(given) @ self._turned(i)
        return out

    def _on_carrier(self, i: int, on_frame: np.ndarray) -> np.ndarray:
        """Return the same of what carries it, in its components; add the row of the drive."""
        joint = self.links[i].joint
        out: np.ndarray = joint.of_loads @ on_frame
        if (columns := self._of(joint.joint.coordinate)) is not None:
            self.matrix[:, self.rows[joint.joint.coordinate]] += joint.drive_axis @ on_frame
            load = joint.in_carrier(self.loads.joints[i])
            out[:, :, columns.start] += joint.load_by_coordinates(load, load)[:, 0].T
        return out

    def _turned(self, i: int) -> np.ndarray:
        """Return the derivative of a body's rotation: that of its spin by their rates."""
        return self.frames[i][:, self.dim.d : self.dim.b, 1::3]


def _given(link: Link, s: int) -> np.ndarray:
    """Return the derivative (d + r, r, n) of the forces of the world by the body's rotation."""
    dim = link.body.dim
    force, moment = np.split(link.applied[s].in_world, [dim.d])
    of_moment = dim.by_spin(moment) if dim.r > 1 else np.zeros((1, 1, moment.shape[1]))
    return -np.concatenate([dim.by_spin(force), of_moment])
