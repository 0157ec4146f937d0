"""The part of a solid arm: a closed surface, smooth, of its design's volume.

A design that is the same over the thickness is a plate: its part is that of the plane, extruded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.solid_cells import Tetrahedra
from dolfinopt.part.domain import SolidDomain
from dolfinopt.part.mesh import ROUNDS, SAME_VOLUME, mesh_size, solid_mesh
from dolfinopt.part.part import DEFAULTS, Curves
from dolfinopt.part.plane.curves import MM, Shape
from dolfinopt.part.plane.limits import NARROW
from dolfinopt.part.plane.part import PlanePart, make_part, shape_facets
from dolfinopt.part.solid.surface import (
    WHOLE,
    Surface,
    at_volume,
    cavities,
    check_surface,
    crossings,
    outside,
    smooth_surface,
    with_volume,
)
from dolfinopt.part.solid.widths import Widths, measured_widths
from dolfinopt.part.stress import corner_stress, is_regular_in_space
from dolfinopt.part.workshop_files import dxf_text, solid_text, three_mf_bytes, triangle_bytes

if TYPE_CHECKING:
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.part.stress import CornerStress


FURTHEST = 0.5  # cells that a point of the part may be from where the isosurface has it
HELD = 0.9  # of the mark of what stays solid, from which on points belong to its faces


@dataclass(frozen=True, eq=False)
class SolidPart:
    """The part of one solid arm, see `plane.part.PlanePart`.

    Attributes:
        domain: the arm and its design.
        surface: of the part, in the arm's frame, m.
        level: density at which the isosurface, or the outline, lies.
        distance: furthest that a point was moved from the isosurface, or curves from the outline,
            m.
        pieces: number of pieces left out because they do not join both interfaces.
        pieces_volume: their volume, m3.
        flat: the part in the plane that it is extruded from; None of others.
    """

    domain: SolidDomain
    surface: Surface
    level: float
    distance: float
    pieces: int
    pieces_volume: float
    flat: PlanePart | None = None

    COARSER: ClassVar[float] = 1.6  # sides of the mesh with which the one of the scene is compared
    REFINEMENTS: ClassVar[int] = 0  # of the mesh where stress is largest

    @property
    def name(self) -> str:
        """The arm's name."""
        return self.domain.name

    @property
    def facets(self) -> np.ndarray:
        """Corners (n, 3, 3) of the triangles of its surface, m."""
        return self.surface.corners

    @property
    def sentence(self) -> str:
        """Its size in words."""
        rows = f"{len(self.surface.triangles)} triangles"
        where = f"the isosurface at density {self.level:.3g}"
        if self.flat is not None:
            rows, where = f"{len(self.flat.shape.curves)} curves", "the outline"
        return (
            f"{1e9 * self.volume:.6g} mm3, {rows}, at most {MM * self.distance:.2g} mm from "
            f"{where}, {', '.join(self.width_words) or 'nothing thin'}"
        )

    @property
    def width_words(self) -> list[str]:
        """What is narrowest, in words."""
        widths = {"thinnest member": self.widths.member, "narrowest gap": self.widths.gap}
        return [f"{name} {MM * w:.2g} mm" for name, w in widths.items() if w is not None]

    @cached_property
    def widths(self) -> Widths:
        """Of its thinnest member and its narrowest gap; of plates of the member alone."""
        if self.flat is None:
            return measured_widths(self.domain, self.surface)
        return Widths(self.flat.thinnest, None, self.flat.tolerance)

    @property
    def volume(self) -> float:
        """Of the part, m3; of an extruded one that within its curves."""
        if self.flat is None:
            return self.surface.volume
        return self.flat.volume

    @cached_property
    def cavities(self) -> np.ndarray:
        """Middles (k, 3) of its closed cavities, m."""
        return cavities(self.surface) if self.flat is None else np.empty((0, 3))

    @property
    def warnings(self) -> list[str]:
        """What the workshop or the designer should know, a sentence each."""
        if self.flat is not None:
            return self.flat.warnings
        domain = self.domain
        lost = domain.left_out_words(self.pieces, self.pieces_volume, 3)
        result = [*domain.gray_words, *lost]
        if len(self.cavities):
            places = "; ".join("({:.1f}, {:.1f}, {:.1f})".format(*at) for at in MM * self.cavities)
            result.append(
                f"arm {domain.name!r}: closed cavities at {places} mm, which no tool and no powder "
                "leaves; [[arms.regions]] keeps a way out void"
            )
        return result + self._narrow()

    def _narrow(self) -> list[str]:
        """Return what is said of members and gaps narrower than asked for, or than the filter."""
        domain = self.domain
        result: dict[str, list[str]] = {}
        for name, width, asked, key in (
            ("thinnest member", self.widths.member, domain.minimum_member, "minimum_member"),
            ("narrowest gap", self.widths.gap, domain.minimum_gap, "minimum_gap"),
        ):
            limit = f"{key}, {MM * asked:.3g} mm"
            if asked == 0.0:
                asked = domain.filter_radius
                limit = f"the filter's radius, {MM * asked:.3g} mm"
            if width is not None and width < NARROW * asked:
                result.setdefault(limit, []).append(f"its {name} is {MM * width:.2g} mm wide")
        return [
            f"arm {domain.name!r}: {' and '.join(words)}, below {limit}"
            for limit, words in result.items()
        ]

    def figures(self, density: float) -> dict[str, Any]:
        """Return the entry of part.json.

        Args:
            density: of the material, kg/m3.
        """
        return {
            "volume": self.volume,
            "mass": density * self.volume,
            "design_volume": self.domain.volume,
            "level": self.level,
            "distance": self.distance,
            "triangles": len(self.surface.triangles),
            "extruded": self.flat is not None,
            "thinnest_member": self.widths.member,
            "narrowest_gap": self.widths.gap,
            "widths_to": self.widths.to,
            "filter_radius": self.domain.filter_radius,
            "pieces_left_out": self.pieces,
            "cavities": self.cavities.tolist(),
            "grayness": self.domain.grayness,
            "warnings": self.warnings,
        }

    def keys(self) -> dict[str, Any]:
        """Return the keys of its arm in part.toml, but for the mesh."""
        _, height, thickness = map(float, np.ptp(self.surface.points, axis=0))
        return {
            "height": height,
            "thickness": thickness,
            "cell_shape": "tetrahedron",
        }

    def files(self, name: str, title: str) -> Iterator[tuple[str, str | bytes]]:
        """Yield how the names of its files end, and what they hold; `name` and title of it."""
        yield ".stl", triangle_bytes(MM * self.facets, f"{title}, mm")
        yield ".3mf", three_mf_bytes(self.surface, name)
        if self.flat is not None:
            shape, t = self.flat.shape, self.flat.domain.thickness
            yield ".step", solid_text(shape, t, name, -0.5 * t)
            yield ".dxf", dxf_text(shape)

    def mesh(self, coarser: float = 1.0, finer: Sequence[np.ndarray] | None = None) -> Tetrahedra:
        """Return tetrahedra, all about as large, see `PlanePart.mesh`."""
        return solid_mesh(self, coarser * mesh_size(self))

    def regular(self, places: np.ndarray, margin: float) -> np.ndarray:
        """Return which places (n, 3) are away from where stress has no limit (n,)."""
        return is_regular_in_space(self.domain, places, margin)

    def stress(self, state: DesignState) -> CornerStress:
        """Return the stress at the corners of the tetrahedra of its arm."""
        return corner_stress(state)


def make_solid_part(domain: SolidDomain, curves: Curves = DEFAULTS) -> SolidPart:
    """Return the part of one solid arm, see `part.make_parts`.

    Raises:
        InputError: it does not hang together, no level of the density keeps its volume, or curves
            are asked for that it has not.
    """
    if domain.flat is None:
        if curves != DEFAULTS:
            raise InputError(
                f"arm {domain.name!r}: its design varies over the thickness, so that its part has "
                "no curves: leave out --tool-radius, --tolerance and --round, or optimise with "
                'arms.symmetric = "extruded"'
            )
        return _freeform_part(domain)
    return plate_part(domain, make_part(domain.flat, curves))


def plate_part(domain: SolidDomain, flat: PlanePart) -> SolidPart:
    """Return the part of an arm whose design is the same over the thickness."""
    outline, t = flat.outline, flat.domain.thickness
    surface = _prism(flat.shape, t, 0.5 * flat.tolerance)
    lost = outline.islands, t * outline.islands_area
    return SolidPart(domain, surface, outline.level, flat.distance, *lost, flat)


def _prism(shape: Shape, thickness: float, tolerance: float) -> Surface:
    """Return the surface of a shape extruded to both sides of z = 0, chords within a tolerance."""
    corners = shape_facets(shape, thickness, tolerance).reshape(-1, 3)
    points, which = np.unique(corners, axis=0, return_inverse=True)
    return Surface(points - np.array([0.0, 0.0, 0.5 * thickness]), which.reshape(-1, 3))


def _freeform_part(domain: SolidDomain) -> SolidPart:
    level, solid, pieces, lost = at_volume(domain)
    surface, values = outside(solid)
    # Material ends within the arm where all corners of a triangle lie at the level.
    at_level = np.abs(values["density"] - level) < 1e-9
    inner = at_level[surface.triangles].all(axis=1)
    free = at_level & (values["own"] < WHOLE) & (values["stays"] < HELD)
    free[surface.triangles[~inner]] = False
    walls = [domain.own, domain.kept]
    smooth = smooth_surface(surface, inner, free, domain.cell, np.concatenate(walls), domain.crisp)
    result = _uncrossed(surface, smooth, free, domain.volume)
    distance = float(np.linalg.norm(result.points - surface.points, axis=1).max())
    if abs(result.volume - domain.volume) > SAME_VOLUME * domain.volume or (
        distance > FURTHEST * domain.cell
    ):
        raise InputError(
            f"arm {domain.name!r}: no level of its density keeps its volume, "
            f"{1e9 * domain.volume:.6g} mm3, and joins both interfaces: the nearest, {level:.3g}, "
            f"encloses {1e9 * surface.volume:.6g} mm3; the design is too grey for a part; optimise "
            'with design.projection = "robust" until it is crisp'
        )
    check_surface(domain.name, result)
    return SolidPart(domain, result, level, distance, pieces, lost)


def _uncrossed(surface: Surface, smooth: Surface, free: np.ndarray, volume: float) -> Surface:
    """Return the smoothed surface with a volume, less smooth where it would cross itself."""
    # The isosurface does not cross itself. Points of triangles that do go back to it, those beside
    # them with them; the others make up for the volume. `free` (n,) is True of points that move.
    moves = free
    for _ in range(ROUNDS):
        points = np.where(moves[:, None], smooth.points, surface.points)
        result = with_volume(replace(surface, points=points), moves, volume)
        crossed = crossings(result)
        if not len(crossed):
            break
        near = np.zeros(len(points), dtype=bool)
        near[surface.triangles[crossed]] = True
        near[surface.triangles[near[surface.triangles].any(axis=1)]] = True
        moves = moves & ~near
    return result
