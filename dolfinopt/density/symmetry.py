"""Designs that are symmetric about an arm's axis."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.mesh.arm_mesh import ArmMesh

# Largest distance of a cell from the mirror image of its partner, in square roots of its area.
# Meshes of symmetric geometries that were made without a thought of symmetry: 0.7 to 1.0.
TOLERANCE = 1.25


class AxisSymmetry:
    """Make a cell field symmetric about y = 0: y = (x + x[mirror]) / 2.

    The mirror of a cell is the cell with the centroid nearest to the mirror image of its own. On
    a mesh that is its own mirror image these are pairs, and y is symmetric to the last bit; on
    others y is as symmetric as the mesh. Works on arms shared by several ranks.
    """

    def __init__(self, mesh: ArmMesh):
        """Pair the cells (collective on the arm).

        Raises:
            InputError: the mesh is not symmetric enough; on all ranks of the arm.
        """
        self.comm = mesh.comm
        counts = self.comm.allgather(mesh.num_cells)
        first = sum(counts[: self.comm.rank])
        self._own = slice(first, first + mesh.num_cells)
        everywhere = np.concatenate(self.comm.allgather(mesh.centroid))
        area = np.concatenate(self.comm.allgather(mesh.area))
        distance, mirror = cKDTree(everywhere).query(everywhere * [1.0, -1.0])
        off = distance / np.sqrt(area)
        worst = int(np.argmax(off))
        if off[worst] > TOLERANCE:
            x, y = everywhere[worst]
            raise InputError(
                f"arm {mesh.name!r}: symmetric = true, but the mesh is not symmetric about y = 0: "
                f"the cell at ({x:.4g}, {y:.4g}) m has no mirror image within {TOLERANCE:g} cell "
                "sizes; correct the geometry, or mesh one half and mirror it"
            )
        self.mirror = mirror

    def forward(self, x: np.ndarray) -> np.ndarray:
        """Return the symmetric field of owned cells (n_cells,)."""
        return 0.5 * (x + self._all(x)[self.mirror[self._own]])

    def backward(self, slope: np.ndarray) -> np.ndarray:
        """Return the derivative with respect to x, given that with respect to the symmetric x."""
        everywhere = self._all(slope)
        mirrored = np.bincount(self.mirror, everywhere, len(everywhere))
        return 0.5 * (slope + mirrored[self._own])

    def _all(self, values: np.ndarray) -> np.ndarray:
        """Return the field of all ranks' cells, ranks in order."""
        return values if self.comm.size == 1 else np.concatenate(self.comm.allgather(values))
