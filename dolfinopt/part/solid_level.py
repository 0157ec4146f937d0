"""The level of a solid's density that keeps its volume, and what above it joins both interfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.part.isosurface import (
    APART,
    BELOW,
    cut,
    eighths,
    forty_eighths,
    halved,
    middles,
    nodal_densities,
    outside,
)
from dolfinopt.part.solid_domain import SolidDomain

HALVINGS, NEAR = 30, 1e-3  # of the interval of levels; relative difference of volumes that will do
WHOLE = 1.0 - 1e-9  # of a mark that points between two marked nodes have, but for rounding
FEW = (
    20_000  # cells up to which they are halved for the isosurface; of finer ones nodes tell enough
)
MARKS = ("own", "inboard", "outboard")


@dataclass(frozen=True, eq=False)
class _Field:
    """The density of a solid arm at nodes.

    Attributes:
        points: (n, 3) m.
        nodes: (m, 4 or 8) of cells.
        values: (n,) with the highest one at interfaces: material along them that the design leaves
            void, since interfaces are rigid.
        marks: (n,) 1.0 of nodes on `SolidDomain`'s faces and in what stays solid, by name.
    """

    points: np.ndarray
    nodes: np.ndarray
    values: np.ndarray
    marks: dict[str, np.ndarray]

    def above(self, level: float) -> Any:
        """Return the grid of what is above a level, see `cut`; what stays solid is."""
        stays = self.marks["stays"] > 0.0
        values = np.where(stays, np.maximum(self.values, level + APART), self.values)
        return cut(self.points, self.nodes, values, level, self.marks)


def _field(domain: SolidDomain) -> _Field:
    corners, density = domain.corners, domain.field
    faces = {name: getattr(domain, name) for name in MARKS}
    is_box = domain.is_box
    if corners.shape[1] == 8 and (len(corners) <= FEW or not is_box):
        points, nodes, values = halved(corners, density)
        cells = eighths(nodes) if is_box else forty_eighths(nodes)
        faces = {name: middles(one) for name, one in faces.items()}
    else:
        points, nodes, values = nodal_densities(corners, density)
        cells = nodes
    marks = {name: _among(points, one) for name, one in faces.items()}
    marks["stays"] = np.zeros(len(points))
    marks["stays"][nodes[domain.passive]] = 1.0
    values[(marks["inboard"] > 0.0) | (marks["outboard"] > 0.0)] = values.max()
    return _Field(points, cells, values, marks)


def at_volume(domain: SolidDomain) -> tuple[float, Any, int, float]:
    """Return the level that keeps the volume, the grid above it that joins both interfaces, the
    number of pieces that do not, and their volume, m3."""
    field, target = _field(domain), domain.volume
    best: tuple[float, float, Any, Any] | None = None
    # Levels that enclose too much and too little, and by how much; halves where it stays the same.
    low, high = 0.0, BELOW * float(field.values.max())
    more, less, last = float(domain.sizes.sum()) - target, -target, 0.0
    for _ in range(HALVINGS):
        level = high - (high - low) * min(max(less / (less - more), 0.1), 0.9)
        whole = field.above(level)
        joined = _joined(whole)
        off = (0.0 if joined is None else outside(joined)[0].volume) - target
        if joined is not None and (best is None or abs(off) < best[0]):
            best = abs(off), level, whole, joined
        if abs(off) <= NEAR * target:
            break
        if off > 0.0:
            low, more = level, off
            less *= 0.5 if last > 0.0 else 1.0
        else:
            high, less = level, off
            more *= 0.5 if last < 0.0 else 1.0
        last = off
    if best is None:
        raise InputError(
            f"arm {domain.name!r}: its design does not hang together: no material joins both "
            "interfaces; optimise longer, or with a larger design.volume_fraction"
        )
    _, level, whole, joined = best
    count = _number_of_pieces(whole) - _number_of_pieces(joined)
    lost = outside(whole)[0].volume - outside(joined)[0].volume if count else 0.0
    return level, joined, count, lost


def _among(points: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Return 1.0 (n,) of points (n, 3) that are corners of some faces to the last bit, else 0.0."""
    kinds = np.unique(np.concatenate([points, some.reshape(-1, 3)]), axis=0, return_inverse=True)[
        1
    ].ravel()
    return np.isin(kinds[: len(points)], kinds[len(points) :]).astype(float)


def _regions(solid: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return which piece of a grid its points and its cells belong to."""
    import scipy.sparse as sp
    from scipy.sparse.csgraph import connected_components
    from vtkmodules.util.numpy_support import vtk_to_numpy

    first = vtk_to_numpy(solid.GetCells().GetOffsetsArray())
    cells = np.repeat(np.arange(solid.n_cells), np.diff(first))
    size = solid.n_cells + solid.n_points
    ends = cells, solid.n_cells + solid.cell_connectivity
    graph = sp.csr_matrix((np.ones(len(cells)), ends), shape=(size, size))
    pieces = connected_components(graph, directed=False)[1]
    return pieces[solid.n_cells :], pieces[: solid.n_cells]


def _number_of_pieces(solid: Any) -> int:
    return len(np.unique(_regions(solid)[1]))


def _joined(solid: Any) -> Any:
    """Return the pieces of a grid that have a part of both interfaces; None: there are none."""
    if solid.n_cells == 0:
        return None
    of_points, of_cells = _regions(solid)
    ends = [of_points[solid.point_data[name] > WHOLE] for name in ("inboard", "outboard")]
    both = np.intersect1d(*ends)
    if not len(both):
        return None
    stays = np.isin(of_cells, both)
    return solid if stays.all() else solid.extract_cells(stays)
