"""Equations g(q) = c(t) of rigid links: closures (c = 0), then the end-effector's path.

Equations are in m, an orientation's times the reach; their Jacobian G has columns by 1 rad or by
the reach and is divided by the reach: it has no unit, and its singular values are of order 1 far
from singular positions. Joints move at G qd = c' and G qdd = c'' - G' qd.
Source: Siciliano, Sciavicco, Villani & Oriolo, Robotics (2009), ch. 3,
doi:10.1007/978-1-84628-642-1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from dolfinopt.multibody.closures import ClosedLoops, Loops, SiteMotion
from dolfinopt.multibody.kinematics import Posed
from dolfinopt.multibody.tree import Mechanism
from dolfinopt.scene.laws import Values


@dataclass(frozen=True, eq=False)
class Target:
    """What is prescribed at n instants.

    Attributes:
        joints: (n, R) coordinates and two derivatives, of which the given ones count; rad, m.
        place: of the end-effector (n, d), velocity, acceleration; m. (n, 0) where it is free.
        turning: its orientation (n, 3, 3), angular velocity and acceleration (n, 3) in the
            ground's frame; None where it is free.
    """

    joints: Sequence[np.ndarray]
    place: Sequence[np.ndarray]
    turning: Values | None = None


@dataclass(frozen=True, eq=False)
class Constraints:
    """Closures of a mechanism of rigid bodies, and the path of its end-effector.

    Attributes:
        mechanism: without elastic coordinates; R rigid ones.
        loops: its closures.
        slides: (R,) which coordinates are lengths.
        has_path: whether the end-effector's place is prescribed.
        turned: whether its orientation is, too.
    """

    mechanism: Mechanism
    loops: Loops
    slides: np.ndarray
    has_path: bool
    turned: bool

    @property
    def reach(self) -> float:
        """Length of its links together, m."""
        return self.mechanism.reach

    @cached_property
    def units(self) -> np.ndarray:
        """Unit (R,) of every coordinate: 1 rad, or the reach."""
        return np.where(self.slides, self.reach, 1.0)

    def at(self, q: np.ndarray) -> Pose:
        """Return them at poses q (n, R)."""
        return Pose(self, q)

    def right(self, target: Target, order: int) -> np.ndarray:
        """Return c' or c'' (n, k), of order 1 or 2; m/s, m/s2."""
        place = target.place[order]
        parts = [np.zeros((len(place), self.loops.count)), place]
        if target.turning is not None:
            parts.append(self.reach * target.turning[order])
        return np.hstack(parts)


class Pose:
    """Closures and path at poses q (n, R)."""

    def __init__(self, constraints: Constraints, q: np.ndarray) -> None:
        """Take the poses."""
        mechanism, self.constraints = constraints.mechanism, constraints
        posed, dim = Posed(mechanism, q, np.zeros((len(q), 0))), mechanism.dim
        self.closed = ClosedLoops(constraints.loops, posed)
        self.end = None
        if constraints.has_path:
            self.end = SiteMotion(posed, mechanism.end, np.zeros(dim.d), np.eye(dim.d))

    def error(self, target: Target) -> np.ndarray:
        """Return c - g (n, k), m."""
        parts = [-self.closed.gap]
        if self.end is not None:
            parts.append(target.place[0] - self.end.place.T)
            if target.turning is not None:
                apart = target.turning[0] @ self.end.R.transpose(2, 1, 0)
                parts.append(self.constraints.reach * Rotation.from_matrix(apart).as_rotvec())
        return np.hstack(parts)

    def rows(self) -> np.ndarray:
        """Return G (n, k, R) without units."""
        parts, reach = [self.closed.jacobian], self.constraints.reach
        if self.end is not None:
            parts.append(self.end.by_place.transpose(2, 0, 1))
            if self.constraints.turned:
                parts.append(reach * self.end.by_spin.transpose(2, 0, 1))
        return np.concatenate(parts, axis=1) * (self.constraints.units / reach)

    def acceleration(self, qd: np.ndarray) -> np.ndarray:
        """Return G' qd (n, k), m/s2, at rates qd (n, R)."""
        parts = [self.closed.acceleration(qd)]
        if self.end is not None:
            a, wd = self.end.acceleration(qd)
            parts += [a.T, self.constraints.reach * wd.T][: 1 + self.constraints.turned]
        return np.hstack(parts)
