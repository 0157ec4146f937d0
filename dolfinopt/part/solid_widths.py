"""How wide the thinnest member and the narrowest gap of a solid part are, on a raster of voxels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.density.members import WIDE, narrowest, voxel_size, widest
from dolfinopt.part.isosurface import Surface

if TYPE_CHECKING:
    from dolfinopt.part.solid_domain import SolidDomain

OPEN = 2.0  # cells around the arm that count as void


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
    h = voxel_size(domain.cell, np.ptp(surface.points, axis=0))
    solid = rasterised(surface, h, int(np.ceil(OPEN * domain.cell / h)))
    inner = _cropped(solid)
    member, _ = narrowest(inner, h) or widest(inner, h)
    asked = max(domain.filter_radius, domain.minimum_member, domain.minimum_gap, 2.0 * domain.cell)
    gap = narrowest(~solid, h, WIDE * asked)
    return Widths(member, None if gap is None else gap[0], h)


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


def _cropped(solid: np.ndarray) -> np.ndarray:
    """Return the box of all that is solid with a layer of void around it."""
    found = solid
    for axis in range(3):
        others = tuple(k for k in range(3) if k != axis)
        place = np.flatnonzero(solid.any(axis=others))
        found = np.take(found, np.arange(place[0], place[-1] + 1), axis=axis)
    return np.pad(found, 1)
