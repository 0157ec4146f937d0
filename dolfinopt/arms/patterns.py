"""Arms that repeat another's design: densities travel from cell to cell, gradients back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.parallel import Partition, together
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

Cells = Mapping[int, np.ndarray]


class Patterns:
    """Which arms repeat which, and their cells' partners, on any ranks.

    An arm with `arms.pattern` has as many cells along and across as its pattern; the cell at the
    same place in both rows has the same physical density. Without such arms nothing travels.

    Attributes:
        repeats: of every arm that repeats another's design the index of that arm.
    """

    def __init__(self, scene: Scene, partition: Partition, arms: Mapping[int, Arm]):
        """Number the cells of this rank's arms that take part by their places in the grid."""
        self.repeats = scene.patterns
        self._world = partition.world
        involved = {*self.repeats, *self.repeats.values()}
        self._place = {k: _grid_place(arm, scene) for k, arm in arms.items() if k in involved}
        self._size = {k: scene.arms[k].n_cells for k in involved}

    def spread(self, densities: Cells) -> dict[int, np.ndarray]:
        """Return densities of all arms from those of the arms with a design (collective).

        Args:
            densities: (n_cells,) of this rank's arms with design variables.
        """
        if not self.repeats:
            return dict(densities)
        patterns = set(self.repeats.values())
        whole = self._whole({k: x for k, x in densities.items() if k in patterns})
        repeated = {
            k: whole[pattern][self._place[k]]
            for k, pattern in self.repeats.items()
            if k in self._place
        }
        return {**densities, **repeated}

    def collect(self, gradient: Cells) -> dict[int, np.ndarray]:
        """Return derivatives by the densities that arms have together (collective): the transpose.

        Args:
            gradient: (n_cells,) by the densities of this rank's arms; an arm without an entry has
                no influence.

        Returns:
            Of arms with design variables, with what the arms that repeat theirs add.
        """
        if not self.repeats:
            return dict(gradient)
        whole = self._whole({k: g for k, g in gradient.items() if k in self.repeats})
        total = {k: g for k, g in gradient.items() if k not in self.repeats}
        for k in sorted(whole):  # the same order on any number of ranks
            pattern = self.repeats[k]
            if pattern in self._place:
                part = whole[k][self._place[pattern]]
                total[pattern] = total[pattern] + part if pattern in total else part
        return total

    def _whole(self, parts: Cells) -> dict[int, np.ndarray]:
        """Return arrays of whole arms by the places of their cells, on all ranks (collective)."""
        whole: dict[int, np.ndarray] = {}
        for pieces in self._world.allgather({k: (self._place[k], x) for k, x in parts.items()}):
            for k, (place, x) in pieces.items():
                whole.setdefault(k, np.zeros(self._size[k]))[place] = x
        return whole


def _grid_place(arm: Arm, scene: Scene) -> np.ndarray:
    """Return the place (n_cells,) of a rectangular arm's cells: rows across, from inboard on."""
    one = scene.arms[arm.places[0]]
    assert one.cells is not None
    along, *across = one.cells
    x, *others = arm.mesh.centroid.T
    place = np.floor(x / one.length * along).astype(int)
    for y, size, count in zip(others, (one.height, one.thickness), across, strict=False):
        place = place * count + np.floor((y / size + 0.5) * count).astype(int)
    return np.asarray(place)


def uniform_design(
    scene: Scene, partition: Partition, arms: Mapping[int, Arm], density: float
) -> dict[int, np.ndarray]:
    """Return the physical densities of the same design variable in all cells (collective).

    Args:
        scene, partition, arms: which arms there are, and this rank's.
        density: the design variable, in [0, 1].
    """
    with together(partition.world):
        mine = {k: arm.uniform(density) for k, arm in arms.items() if k not in scene.patterns}
    return Patterns(scene, partition, arms).spread(mine)
