"""The design variables of all arms, and of the motion's law, as one vector."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate

import numpy as np

from dolfinopt.arms.arm import Arm
from dolfinopt.parallel import Partition, gather_cells, on_all_ranks
from dolfinopt.scene.law_variables import LAW, law_bounds, law_values
from dolfinopt.scene.load import Scene


class Variables:
    """The design variables as one vector, the same on all ranks, arms one behind the other.

    Arms that repeat another's design have none. Those of the motion's law are the last ones, from 0
    to 1 between their bounds.

    Attributes:
        size: n, the number of cells.
        xmin, xmax: (n,) bounds; equal where a cell stays solid or void.
        initial: (n,) of the design to begin with, whatever the bounds.
        arms: this rank's arms that have variables.
        law_bounds: least and largest values (n,) of the law's variables.
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
        low, high = self.law_bounds = law_bounds(scene)
        start = (law_values(scene) - low) / (high - low)
        columns = {LAW: np.column_stack([0.0 * low, np.ones_like(low), start])}
        for k, arm in self.arms.items():
            bounds = [arm.mesh.keep(np.full(sizes[k], x)) for x in (scene.design.minimum, 1.0)]
            columns[k] = np.column_stack([*bounds, np.full(sizes[k], scene.initial(k))])
        self.xmin, self.xmax, self.initial = np.ascontiguousarray(self.join(columns).T)

    def split(self, x: np.ndarray) -> dict[int, np.ndarray]:
        """Return the parts of this rank's arms, and under `LAW` the law's."""
        return {k: x[part] for k, part in self._parts.items()} | {LAW: x[self.size :]}

    def join(self, parts: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return the parts of all ranks as one array (n, ...) (collective).

        The law's, which all ranks have, may be missing where it has no variables.
        """
        cells = {k: part for k, part in parts.items() if k != LAW}
        every = self.partition.world.bcast(gather_cells(self.partition, cells), root=0)
        law = [parts[LAW]] if LAW in parts else []
        return np.concatenate([*every.values(), *law])

    def law_of(self, x: np.ndarray) -> np.ndarray:
        """Return the values of the law's variables: shares of the way, s."""
        low, high = self.law_bounds
        return np.asarray(low + (high - low) * x[self.size :])
