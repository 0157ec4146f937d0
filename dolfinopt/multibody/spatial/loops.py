"""Closed loops of rigid links in space: what the joints that follow have to fulfil."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.closures import ClosedLoops, Distance, Loops
from dolfinopt.multibody.machine import loops_of, skeleton
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.scene.load import Scene


@dataclass(frozen=True, eq=False)
class RigidLoops:
    """Closures of links without mass, all of their k equations; R rigid coordinates."""

    mechanism: Mechanism
    loops: Loops

    def at(self, q: np.ndarray) -> ClosedLoops:
        """Return them at poses q (n, R)."""
        return self.loops.at(self.mechanism, q, np.zeros((len(q), 0)))

    def gap(self, q: np.ndarray) -> np.ndarray:
        """Return the equations (n, k), m."""
        return self.at(q).every_gap

    def rows(self, q: np.ndarray) -> np.ndarray:
        """Return their derivatives (n, k, R)."""
        return self.at(q).every_row

    def acceleration(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Return what rates qd (n, R) add to their second derivatives (n, k), m/s2."""
        return self.at(q).acceleration(qd)

    def with_lengths(self, q: np.ndarray) -> np.ndarray:
        """Return a pose (R,) with the rods as long as its joints have them."""
        gaps, found, k = self.gap(q[None])[0], q.copy(), 0
        for tie in self.loops.ties:
            for one in tie.equations:
                if isinstance(one, Distance) and one.coordinate is not None:
                    found[one.coordinate] += gaps[k]
                k += 1
        return found

    def widest(self, error: np.ndarray) -> tuple[str, float]:
        """Return the closure that is farthest open and by how much, m, of equations (k,)."""
        ends = np.cumsum([len(tie.equations) for tie in self.loops.ties])[:-1]
        sizes = [float(np.linalg.norm(part)) for part in np.split(error, ends)]
        worst = int(np.argmax(sizes))
        return self.loops.ties[worst].name, sizes[worst]


def rigid_loops(scene: Scene) -> RigidLoops:
    """Return the closed loops of a scene with [[closures]]."""
    loops = loops_of(scene)
    assert loops is not None
    return RigidLoops(skeleton(scene), loops)
