"""The design variables of all arms as one vector, and their volume constraints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.parallel import Partition, sum_over_arms, together
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm, Realised


class Variables:
    """This rank's design variables as one vector, arms one behind the other, and the volumes.

    Attributes:
        size: n, number of this rank's variables.
        xmin, xmax: (n,) bounds; passive cells are solid.
        slices: part of the vector that belongs to each arm.
        pieces: sizes of these parts by a number that is the same order on any number of ranks.
        volume: (n_cells,) of every arm's cells, m3, times the arms that have the design.
        count: m, number of volume constraints.
    """

    def __init__(self, scene: Scene, partition: Partition, arms: Mapping[int, Arm]):
        self.arms = arms
        self.partition = partition
        sizes = [arm.mesh.num_cells for arm in arms.values()]
        ends = np.cumsum([0, *sizes])
        # Whole arms add up in the same order on any number of ranks; parts of one are numbered on.
        first = partition.comm.rank * len(scene.arms)
        self.pieces = {first + k: size for k, size in zip(arms, sizes, strict=True)}
        self.slices = {k: slice(a, b) for k, a, b in zip(arms, ends[:-1], ends[1:], strict=True)}
        self.size = int(ends[-1])
        self.xmin = np.full(self.size, scene.design.minimum)
        self.xmax = np.ones(self.size)
        for k, part in self.slices.items():
            self.xmin[part][arms[k].mesh.passive] = 1.0
        # Volume constraints sum V x_phys / (fraction sum V) - 1 <= 0, one a design or one for all.
        owners = list(scene.cell_counts)
        shared = scene.design.shared_volume
        self.rows = {k: 0 if shared else row for row, k in enumerate(owners)}
        self.count = 1 if shared else len(owners)
        # Arms of one design weigh in as often as they occur, and by their thickness.
        self.volume = {
            k: scene.owners.count(k) * scene.arms[k].thickness * arm.mesh.area
            for k, arm in arms.items()
        }
        self.limit = scene.design.volume_fraction * self._volumes(
            {k: np.ones(arm.mesh.num_cells) for k, arm in arms.items()}
        )

    def split(self, x: np.ndarray) -> dict[int, np.ndarray]:
        """Return each arm's part."""
        return {k: x[part] for k, part in self.slices.items()}

    def join(self, parts: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return the parts as one vector."""
        return np.concatenate([parts[k] for k in self.slices] or [np.empty(0)])

    def volume_constraints(self, x_phys: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return f (m,), below zero where there is volume left (collective)."""
        return self._volumes(x_phys) / self.limit - 1.0

    def volume_gradients(self, realised: Mapping[int, Realised]) -> np.ndarray:
        """Return the gradients of `volume_constraints` by x (m, n)."""
        gradients = np.zeros((self.count, self.size))
        for k, part in self.slices.items():
            row = self.rows[k]
            gradients[row, part] = self.arms[k].chain(self.volume[k], realised[k]) / self.limit[row]
        return gradients

    def by_x(
        self, by_cells: Mapping[int, np.ndarray], realised: Mapping[int, Realised]
    ) -> np.ndarray:
        """Return a gradient by x (n,) from that by the physical densities."""
        return self.join({k: arm.chain(by_cells[k], realised[k]) for k, arm in self.arms.items()})

    def limited_volume(
        self, designs: Sequence[Mapping[int, Realised]], minimum_member: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the volume constraints (m,) and their gradients by x (m, n) (collective).

        Of robust designs with a minimum member the dilated one carries the limit, chosen anew in
        every step so that the nominal one meets its own: V_dilated / (V_dilated / V_nominal limit)
        - 1, the quotient held.
        Source: Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y.
        The nominal one otherwise: a filter of few cells leaves so few grey ones that, once the
        projection is steep, the dilated volume does not see where the nominal one changes.

        Args:
            designs: eroded, dilated and nominal one, or the nominal one alone.
            minimum_member: least width asked for, m; 0: none.
        """
        nominal = self.volume_constraints(_densities(designs[-1]))
        alone = len(designs) == 1 or not minimum_member
        limited = designs[-1] if alone else designs[1]
        ratio = (1.0 + nominal) / (1.0 + self.volume_constraints(_densities(limited)))
        with together(self.partition.world):
            gradients = self.volume_gradients(limited)
        return nominal, gradients if alone else ratio[:, None] * gradients

    def _volumes(self, x_phys: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return sum V x_phys of each constraint's arms (m,), m3."""
        volume = {}
        for k in self.arms:
            volume[k] = np.zeros(self.count)
            volume[k][self.rows[k]] = self.volume[k] @ x_phys[k]
        return sum_over_arms(self.partition, volume)


def _densities(realised: Mapping[int, Realised]) -> dict[int, np.ndarray]:
    return {k: one.x_phys for k, one in realised.items()}
