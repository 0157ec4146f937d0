"""Designs that are symmetric about an arm's axis or planes, or the same over its thickness."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.mesh.arm_mesh import ArmMesh

# Largest distance of a cell from the mirror image of its partner, in square roots of its area, in
# space cubic roots of its volume. Meshes of symmetric geometries that were made without a thought
# of symmetry: 0.7 to 1.0.
TOLERANCE = 1.25
SAME_PLACE = 1e7  # places across a mesh that are told apart


class AxisSymmetry:
    """Make a cell field symmetric about y = 0, or z = 0: y = (x + x[mirror]) / 2.

    The mirror of a cell is the cell with the centroid nearest to the mirror image of its own. On
    a mesh that is its own mirror image these are pairs, and y is symmetric to the last bit; on
    others y is as symmetric as the mesh. Works on arms shared by several ranks.
    """

    def __init__(self, mesh: ArmMesh, axis: int = 1):
        """Pair the cells (collective on the arm).

        Args:
            mesh: the arm.
            axis: 1 for y = 0, 2 for z = 0.

        Raises:
            InputError: the mesh is not symmetric enough; on all ranks of the arm.
        """
        self.comm = mesh.comm
        counts = self.comm.allgather(mesh.num_cells)
        first = sum(counts[: self.comm.rank])
        self._own = slice(first, first + mesh.num_cells)
        everywhere = np.concatenate(self.comm.allgather(mesh.centroid))
        area = np.concatenate(self.comm.allgather(mesh.area))
        sign = np.ones(mesh.dim)
        sign[axis] = -1.0
        distance, mirror = cKDTree(everywhere).query(everywhere * sign)
        off = distance / (np.sqrt(area) if mesh.dim == 2 else np.cbrt(area))
        worst = int(np.argmax(off))
        if off[worst] > TOLERANCE:
            place = ", ".join(f"{x:.4g}" for x in everywhere[worst])
            key, name = ("symmetric", "y") if axis == 1 else ("symmetric_z", "z")
            raise InputError(
                f"arm {mesh.name!r}: {key} = true, but the mesh is not symmetric about {name} = 0: "
                f"the cell at ({place}) m has no mirror image within {TOLERANCE:g} cell "
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


class Extrusion:
    """Make a cell field the same over the thickness: the mean of the cells above one another.

    Its own transpose on a grid, whose cells are equally large. Works on arms shared by several
    ranks.
    """

    def __init__(self, mesh: ArmMesh):
        """Number the columns of cells (collective on the arm)."""
        self.comm = mesh.comm
        counts = self.comm.allgather(mesh.num_cells)
        first = sum(counts[: self.comm.rank])
        places = np.concatenate(self.comm.allgather(mesh.centroid[:, :2]))
        size = np.abs(places).max()
        _, column = np.unique(np.rint(places / size * SAME_PLACE), axis=0, return_inverse=True)
        self._column = column.ravel()[first : first + mesh.num_cells]
        self._count = np.bincount(column.ravel())

    def forward(self, x: np.ndarray) -> np.ndarray:
        """Return the mean field of owned cells (n_cells,)."""
        total = np.bincount(self._column, x, len(self._count))
        if self.comm.size > 1:
            total = self.comm.allreduce(total)
        return np.asarray((total / self._count)[self._column])

    backward = forward
