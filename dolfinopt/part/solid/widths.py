"""How wide the members of a solid part are, and the gaps between them.

From places of the surface rays go along the normal, inwards through a member and outwards through a
gap, to where the surface faces them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dolfinopt.density.members import WIDE
from dolfinopt.part.domain import SolidDomain
from dolfinopt.part.plane.limits import FACING
from dolfinopt.part.solid.surface import Surface, locator_of

SPACINGS, MOST_POINTS = 5.0, 50_000  # points of the surface in a cell's length; in all, about


@dataclass(frozen=True)
class Widths:
    """What is narrowest in a part.

    Attributes:
        member: width of its thinnest member, m; None where nothing is thin.
        gap: of its narrowest gap, hole or cavity, m; None without one.
        to: what is thinner than that is not seen, m.
    """

    member: float | None
    gap: float | None
    to: float


def measured_widths(domain: SolidDomain, surface: Surface) -> Widths:
    """Return the narrowest member and gap of the part of a solid arm; of a tail it is the end.

    What is thinner than the spacing of the places may be missed; a wedge of more than 37 degrees
    is no member.
    """
    import pyvista

    triangles = pyvista.PolyData.from_regular_faces(surface.points, surface.triangles)
    spacing = max(domain.cell / SPACINGS, float(np.sqrt(triangles.area / MOST_POINTS)))
    places = triangles.subdivide_adaptive(max_edge_len=2.0 * spacing)  # of about its square
    points, outward = np.asarray(places.cell_centers().points), np.asarray(places.face_normals)
    asked = max(domain.filter_radius, domain.minimum_member, domain.minimum_gap, 2.0 * domain.cell)
    extent = float(np.ptp(points, axis=0).max())
    member = _narrowest(triangles, points, -outward, (0.5 * spacing, extent), 1.0)
    gap = _narrowest(triangles, points, outward, (0.5 * spacing, WIDE * asked), -1.0)
    return Widths(member, gap, spacing)


def _narrowest(
    triangles: Any,
    points: np.ndarray,
    along: np.ndarray,
    reach: tuple[float, float],
    sense: float,
) -> float | None:
    """Return the least distance from points to what faces them, m; None: nothing does.

    Args:
        triangles: of a closed surface, of VTK.
        points: (n, 3) m.
        along: (n, 3) unit vectors.
        reach: least and largest distance that is looked at, m.
        sense: 1 where rays leave the material there, -1 where they enter it.
    """
    from vtkmodules.vtkCommonCore import mutable

    locator, normal = locator_of(triangles), triangles.face_normals
    t: Any = mutable(0.0)
    cell: Any = mutable(0)
    hit: tuple[Any, ...] = (0.0, t, [0.0] * 3, [0.0] * 3, mutable(0), cell)
    first, last = reach
    result = []
    for start, way in zip(points, along, strict=True):
        if locator.IntersectWithLine(start + first * way, start + last * way, *hit):
            if sense * normal[int(cell)] @ way > FACING:
                result.append(first + float(t) * (last - first))
    return min(result, default=None)
