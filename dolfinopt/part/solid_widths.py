"""How wide the thinnest member and the narrowest gap of a solid part are, on a raster of voxels.

A place is narrower than 2 r where no ball of radius r that fits into the material (into the void)
covers it: what opening by that ball takes away. So are sharp edges; of those only balls below
0.7 r would fit, which tells them from members. After Hildebrand & Ruegsegger (1997),
doi:10.1046/j.1365-2818.1997.1340694.x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.part.isosurface import Surface

if TYPE_CHECKING:
    from dolfinopt.part.solid_domain import SolidDomain

FINE = 4.0  # voxels in a cell's length
MOST = 1_500_000  # voxels
FIRST, FACTOR = 1.5, 1.2  # smallest radius, in voxels; from one radius to the next
THIN = 0.7  # radius that fits in what opening takes away, over its own, from which on it is narrow
FEW = 4  # voxels that are no member
OPEN = 2.0  # cells around the arm that count as void
WIDE = 1.5  # of the widths asked for: up to which gaps are looked for


@dataclass(frozen=True)
class Widths:
    """What is narrowest in a part.

    Attributes:
        member: width of its thinnest member, m; None where nothing is thin.
        gap: of its narrowest gap, hole or cavity, m; None without one.
        to: accuracy of both, m.
    """

    member: float | None
    gap: float | None
    to: float


def measured_widths(domain: SolidDomain, surface: Surface) -> Widths:
    """Return the narrowest member and gap of the part of a solid arm."""
    size = np.ptp(surface.points, axis=0)
    h = max(domain.cell / FINE, float(np.prod(size) / MOST) ** (1.0 / 3.0))
    solid = rasterised(surface, h, int(np.ceil(OPEN * domain.cell / h)))
    member = narrowest(_cropped(solid), h)
    if member is None:  # nowhere narrower than where it is widest
        member = float(2.0 * _depth(_cropped(solid), h).max())
    asked = max(domain.filter_radius, domain.minimum_member, domain.minimum_gap, 2.0 * domain.cell)
    return Widths(member, narrowest(~solid, h, WIDE * asked), h)


def rasterised(surface: Surface, h: float, margin: int) -> np.ndarray:
    """Return which voxels (nx, ny, nz) of side h have their centres in a closed surface.

    Args:
        surface: m.
        h: m.
        margin: number of void voxels around it.
    """
    import pyvista
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkImagingStencil import vtkImageStencilToImage, vtkPolyDataToImageStencil

    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    inner = np.maximum(np.ceil((high - low) / h - 1e-9), 1.0)
    first = 0.5 * (low + high) - 0.5 * h * (inner - 1.0) - margin * h
    counts = inner.astype(int) + 2 * margin
    stencil: Any = vtkPolyDataToImageStencil()
    stencil.SetInputData(pyvista.PolyData.from_regular_faces(surface.points, surface.triangles))
    stencil.SetOutputOrigin(*first)
    stencil.SetOutputSpacing(h, h, h)
    stencil.SetOutputWholeExtent(0, counts[0] - 1, 0, counts[1] - 1, 0, counts[2] - 1)
    image: Any = vtkImageStencilToImage()
    image.SetInputConnection(stencil.GetOutputPort())
    image.SetInsideValue(1)
    image.SetOutsideValue(0)
    image.SetOutputScalarTypeToUnsignedChar()
    image.Update()
    flat = vtk_to_numpy(image.GetOutput().GetPointData().GetScalars())
    return np.asarray(flat.reshape(counts[::-1]).transpose(2, 1, 0) > 0)


def narrowest(inside: np.ndarray, h: float, most: float = np.inf) -> float | None:
    """Return the width, m, of what is narrowest in voxels (nx, ny, nz), right to about h.

    Args:
        inside: the voxels; what is beyond them is not inside.
        h: their side, m.
        most: width from which on nothing is looked for, m.

    Returns:
        None where nothing is narrower than `most`, or than the widest place.
    """
    from scipy.ndimage import distance_transform_edt

    depth = _depth(inside, h)
    r, top = FIRST * h, min(float(depth.max()), 0.5 * most)
    while r < top:
        covered = distance_transform_edt(depth < r) * h <= r
        narrow = inside & ~covered & (depth >= THIN * r)
        if np.count_nonzero(narrow) >= FEW:
            return float(2.0 * depth[narrow].max())
        r *= FACTOR
    return None


def _depth(inside: np.ndarray, h: float) -> np.ndarray:
    """Return the distance of the voxels' centres from the boundary, m; 0 outside.

    The boundary runs between two centres; a width of an even number of voxels has its middle
    between two, too: a quarter of a voxel is what is left on average.
    """
    from scipy.ndimage import distance_transform_edt

    return np.maximum(distance_transform_edt(inside) - 0.25, 0.0) * h


def _cropped(solid: np.ndarray) -> np.ndarray:
    """Return the box of all that is solid with a layer of void around it."""
    found = solid
    for axis in range(3):
        others = tuple(k for k in range(3) if k != axis)
        place = np.flatnonzero(solid.any(axis=others))
        found = np.take(found, np.arange(place[0], place[-1] + 1), axis=axis)
    return np.pad(found, 1)
