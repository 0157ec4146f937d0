"""The design variables of all arms as one vector."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.arms.arm import PhysicalDesign
from dolfinopt.parallel import Partition
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm


class Variables:
    """This rank's design variables as one vector, arms one behind the other.

    Arms that repeat another's design have none.

    Attributes:
        size: n, number of this rank's variables.
        xmin, xmax: (n,) bounds; equal where a cell stays solid or void.
        initial: (n,) of the design to begin with, whatever the bounds.
        slices: part of the vector that belongs to each arm.
        pieces: sizes of these parts by a number that is the same order on any number of ranks.
    """

    def __init__(self, scene: Scene, partition: Partition, arms: Mapping[int, Arm]):
        self.partition = partition
        arms = {k: arm for k, arm in arms.items() if k in scene.designed}
        sizes = [arm.mesh.num_cells for arm in arms.values()]
        ends = np.cumsum([0, *sizes])
        # Whole arms add up in the same order on any number of ranks; parts of one are numbered on.
        first = partition.comm.rank * len(scene.arms)
        self.pieces = {first + k: size for k, size in zip(arms, sizes, strict=True)}
        self.slices = {k: slice(a, b) for k, a, b in zip(arms, ends[:-1], ends[1:], strict=True)}
        self.arms = arms
        self.size = int(ends[-1])
        self.xmin = np.full(self.size, scene.design.minimum)
        self.xmax, self.initial = np.ones(self.size), np.empty(self.size)
        for k, part in self.slices.items():
            mesh = arms[k].mesh
            self.xmin[part] = mesh.keep(self.xmin[part])
            self.xmax[part] = mesh.keep(self.xmax[part])
            self.initial[part] = scene.initial(k)

    def split(self, x: np.ndarray) -> dict[int, np.ndarray]:
        """Return each arm's part."""
        return {k: x[part] for k, part in self.slices.items()}

    def join(self, parts: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return the parts as one vector."""
        return np.concatenate([parts[k] for k in self.slices] or [np.empty(0)])

    def by_x(
        self, by_cells: Mapping[int, np.ndarray], designs: Mapping[int, PhysicalDesign]
    ) -> np.ndarray:
        """Return a gradient by x (n,) from that by the physical densities.

        Of arms with variables; what others that repeat their designs add is in it already, see
        `Patterns.collect`.
        """
        found = np.zeros(self.size)
        for k, part in self.slices.items():
            if k in by_cells:
                found[part] = self.arms[k].backward(by_cells[k], designs[k])
        return found
