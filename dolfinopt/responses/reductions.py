"""The arms of one design with any number of coordinates.

Craig-Bampton bases of fewer coordinates are the leading part of one of more: it is made once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from sys import maxsize
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.multibody.shape_integrals import ShapeIntegrals, shape_integrals
from dolfinopt.parallel import Partition, gather_arms, together
from dolfinopt.profiling import Profile
from dolfinopt.reduction import METHODS, Basis
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

RICHER_METHOD = "craig-bampton"  # of what motions and poles are compared with


class Reductions:
    """Bases of the arms' present designs.

    Attributes:
        limit: of coordinates that all arms can have.
    """

    def __init__(
        self, scene: Scene, partition: Partition, arms: Mapping[int, Arm], profile: Profile
    ) -> None:
        """Take this rank's arms, with a design (collective)."""
        self.partition, self.arms, self.profile = partition, arms, profile
        self._damping = scene.damping.stiffness_proportional
        own = min((arm.elastic.num_dofs for arm in arms.values()), default=maxsize)
        self.limit: int = partition.world.allreduce(own, min)
        self._richest: dict[int, Basis] = {}
        self._count = 0  # of its coordinates

    def reduced(self, method: str, count: int) -> dict[int, Basis]:
        """Return this rank's bases of so many coordinates (collective)."""
        if method != RICHER_METHOD:
            return self._reduce(method, count)
        if count > self._count:
            self._richest, self._count = self._reduce(method, count), count
        with together(self.partition.world):
            return {k: _leading(basis, count) for k, basis in self._richest.items()}

    def _reduce(self, method: str, count: int) -> dict[int, Basis]:
        reduce = METHODS[method].reduce
        with self.profile.phase("choice of coordinates"), together(self.partition.world):
            return {
                k: reduce(arm.elastic, arm.options(count), None) for k, arm in self.arms.items()
            }

    def bodies(self, bases: Mapping[int, Basis]) -> dict[int, ShapeIntegrals]:
        """Return the bodies of all arms with these bases, on the root (collective)."""
        found = {}
        with together(self.partition.world):
            for k, basis in bases.items():
                arm, loads = self.arms[k], None
                if arm.stiffened:
                    loads = arm.current.unit_loads.with_modes(basis.V, basis.MV)
                found[k] = shape_integrals(arm.elastic, basis, self._damping, loads)
        return gather_arms(self.partition, found)

    def energies(
        self, bases: Mapping[int, Basis], others: Mapping[int, Basis]
    ) -> dict[int, np.ndarray]:
        """Return V' K V of the modes V of two bases, one behind the other (collective)."""
        with together(self.partition.world):
            return {
                k: self.arms[k].elastic.energy_matrix(np.concatenate([a.V, others[k].V], axis=2))
                for k, a in bases.items()
            }


def _leading(basis: Basis, count: int) -> Basis:
    """Return the first Craig-Bampton coordinates: constraint modes, then fixed-interface modes."""
    part = slice(count)
    return Basis(
        basis.V[:, :, part],
        basis.MV[:, :, part],
        basis.stiffness[part, part],
        basis.outboard[:, part],
        basis.start[:, : count - len(basis.outboard)],
    )


def fewest(first: int, most: int, holds: Callable[[int], bool]) -> int | None:
    """Return the fewest coordinates from `first` to `most` that hold, None if none do.

    In growing steps upwards, then by bisection.
    """
    low, high = first - 1, first
    while not holds(high):
        if high >= most:
            return None
        low, high = high, min(high + max(1, high - first), most)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
