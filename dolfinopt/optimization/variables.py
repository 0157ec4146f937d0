"""The design variables of all arms as one vector."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.parallel import Partition, gather_cells, on_all_ranks
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm


class Variables:
    """The design variables as one vector, the same on all ranks, arms one behind the other.

    Arms that repeat another's design have none.

    Attributes:
        size: n, their number.
        xmin, xmax: (n,) bounds; equal where a cell stays solid or void.
        initial: (n,) of the design to begin with, whatever the bounds.
        arms: this rank's arms that have variables.
    """

    def __init__(self, scene: Scene, partition: Partition, arms: Mapping[int, Arm]):
        """Take this rank's arms (collective)."""
        self.partition, comm = partition, partition.comm
        self.arms = {k: arm for k, arm in arms.items() if k in scene.designed}
        sizes = {k: arm.mesh.num_cells for k, arm in self.arms.items()}
        before = comm.exscan(sum(sizes.values())) or 0  # of an arm that ranks share
        every = on_all_ranks(partition, {k: comm.allreduce(size) for k, size in sizes.items()})
        ends = list(accumulate(every.values(), initial=0))
        first = {k: end + before for k, end in zip(every, ends, strict=False)}
        self.size: int = ends[-1]
        self._parts = {k: slice(first[k], first[k] + size) for k, size in sizes.items()}
        meshes = {k: arm.mesh for k, arm in self.arms.items()}
        least = scene.design.minimum
        self.xmin = self.join({k: m.keep(np.full(sizes[k], least)) for k, m in meshes.items()})
        self.xmax = self.join({k: m.keep(np.ones(sizes[k])) for k, m in meshes.items()})
        self.initial = self.join({k: np.full(sizes[k], scene.initial(k)) for k in meshes})

    def split(self, x: np.ndarray) -> dict[int, np.ndarray]:
        """Return the parts of this rank's arms."""
        return {k: x[part] for k, part in self._parts.items()}

    def join(self, parts: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return the parts of all ranks as one array (n, ...) (collective)."""
        every = self.partition.world.bcast(gather_cells(self.partition, parts), root=0)
        return np.concatenate(list(every.values()))
