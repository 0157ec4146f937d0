"""The part of a plate: its outline in curves."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.part.domain import Domain
from dolfinopt.part.mesh import SAME_VOLUME, BodyMesh, body_mesh
from dolfinopt.part.part import DEFAULTS, Curves
from dolfinopt.part.plane.curves import MM, Concave, Shape, cross
from dolfinopt.part.plane.fit import distance, fitted_sides
from dolfinopt.part.plane.limits import (
    KEPT,
    NARROW,
    THIN,
    limits_of_part,
    rounded_radii,
    thinnest_member,
)
from dolfinopt.part.plane.outline import SLIM, TOOL, Outline, draw_outline
from dolfinopt.part.plane.sides import Sides
from dolfinopt.part.stress import corner_stress, is_regular_in_plane
from dolfinopt.part.workshop_files import (
    dxf_text,
    extruded_facets,
    face_text,
    r12_text,
    solid_text,
    svg_text,
    triangle_bytes,
)

if TYPE_CHECKING:
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.part.stress import CornerStress


TOLERANCE, CELLS = 1e-4, 0.1  # of the outline's polygon: 0.1 mm, or a tenth of a cell if less


@dataclass(frozen=True, eq=False)
class PlanePart:
    """The part of one arm in the plane.

    Attributes:
        domain: the arm and its design.
        outline: its polygon.
        sides: its own outline.
        tolerance: of the outline's polygon and of chords, m.
        rounds: whether radii shall be whole half millimetres.
    """

    domain: Domain
    outline: Outline
    sides: Sides
    tolerance: float
    rounds: bool = False

    COARSER: ClassVar[float] = 2.0  # sides of the mesh with which the one of the scene is compared
    REFINEMENTS: ClassVar[int] = 2  # of the mesh where stress is largest, at most

    @property
    def name(self) -> str:
        """The arm's name."""
        return self.domain.name

    @property
    def shape(self) -> Shape:
        """Its curves."""
        return self.sides.shape

    @cached_property
    def distance(self) -> float:
        """Largest distance of its curves from the outline of the densities, m."""
        return distance(self.sides, self.outline)

    @cached_property
    def thinnest(self) -> float | None:
        """Width of its thinnest member, m; None where nothing is thin."""
        return thinnest_member(self.sides, self.domain.cell)

    @cached_property
    def tight(self) -> list[Concave]:
        """Concave corners and curves that the tool does not reach."""
        least = self.outline.tool_radius - KEPT
        result = [item for item in self.shape.concave if item.radius < least]
        return sorted(result, key=attrgetter("radius"))

    @property
    def volume(self) -> float:
        """Within its curves, m3."""
        return self.shape.area * self.domain.thickness

    @property
    def facets(self) -> np.ndarray:
        """Corners (n, 3, 3) of the triangles of the plate's surface, m; chords in the tolerance."""
        return shape_facets(self.shape, self.domain.thickness, 0.5 * self.tolerance)

    @property
    def sentence(self) -> str:
        """Its size in words."""
        shape = self.shape
        return (
            f"{1e6 * shape.area:.6g} mm2, {len(shape.loops) - 1} holes, {shape.entities}, at most "
            f"{MM * self.distance:.2g} mm from the outline, tool radius "
            f"{MM * self.outline.tool_radius:.3g} mm"
        )

    @property
    def warnings(self) -> list[str]:
        """What the workshop or the designer should know, a sentence each."""
        domain, outline = self.domain, self.outline
        result = domain.gray_words
        if domain.crisp:
            result.append(
                f"arm {domain.name!r}: design.npz does not tell what its densities were projected "
                "from, as that of an optimisation does; the outline is that of the cells, blurred"
            )
        result += domain.left_out_words(outline.islands, outline.islands_area, 2)
        if self.tight:
            listed = "; ".join(map(str, self.tight))
            tool = MM * outline.tool_radius
            result.append(
                f"arm {domain.name!r}: a tool of radius {tool:.3g} mm does not reach {listed}"
            )
        least = domain.minimum_member or THIN
        if self.thinnest is not None and self.thinnest < NARROW * least:
            result.append(
                f"arm {domain.name!r}: its thinnest neck is {MM * self.thinnest:.3g} mm wide, "
                f"below the smallest that is asked for, {MM * least:.3g} mm"
            )
        return result

    def figures(self, density: float) -> dict[str, Any]:
        """Return the entry of part.json.

        Args:
            density: of the material, kg/m3.
        """
        domain, shape = self.domain, self.shape
        radius = shape.concave_radius
        return {
            "area": shape.area,
            "volume": self.volume,
            "mass": density * self.volume,
            "design_volume": domain.volume * domain.thickness,
            "level": self.outline.level,
            "distance": self.distance,
            "tolerance": self.tolerance,
            "curves": len(shape.curves),
            "loops": len(shape.loops),
            "tool_radius": self.outline.tool_radius,
            "smallest_concave_radius": radius if math.isfinite(radius) else None,
            "tight_places": [[*item.place, item.radius] for item in self.tight],
            "thinnest_member": self.thinnest,
            "islands_left_out": self.outline.islands,
            "holes_filled": self.outline.filled,
            "grayness": domain.grayness,
            "warnings": self.warnings,
        }

    def keys(self) -> dict[str, Any]:
        """Return the keys of its arm in part.toml, but for the mesh."""
        corners = np.vstack(self.shape.polygons(self.tolerance))
        return {"height": float(np.ptp(corners[:, 1]))}

    def files(self, name: str, title: str) -> Iterator[tuple[str, str | bytes]]:
        """Yield how the names of its files end, and what they hold; `name` and title of it."""
        shape, thickness, chord = self.shape, self.domain.thickness, 0.5 * self.tolerance
        yield ".step", solid_text(shape, thickness, name)
        yield "_face.step", face_text(shape, name)
        yield ".dxf", dxf_text(shape)
        yield "_r12.dxf", r12_text(shape, chord)
        yield ".svg", svg_text(shape, title)
        yield ".stl", triangle_bytes(MM * self.facets, f"{title}, mm")

    def mesh(self, coarser: float = 1.0, finer: Sequence[np.ndarray] | None = None) -> BodyMesh:
        """Return triangles along its curves, on this process alone.

        Args:
            coarser: factor of the sides of all cells.
            finer: places (n, d), m, near which arcs of a coarse mesh are divided finely, twice as
                finely for every further array; None: finely everywhere.

        Raises:
            InputError: Gmsh cannot mesh it.
        """
        try:
            return body_mesh(self.shape, self.domain.cell, coarser, finer)
        except InputError as error:
            raise InputError(f"arm {self.name!r}: {error}") from None

    def regular(self, places: np.ndarray, margin: float) -> np.ndarray:
        """Return which places (n, 2) are away from where stress has no limit (n,).

        Args:
            places: m.
            margin: least distance from the interfaces, m.
        """
        return is_regular_in_plane(self.shape, self.domain, places, margin)

    def stress(self, state: DesignState) -> CornerStress:
        """Return the stress at the corners of the triangles of its arm."""
        return corner_stress(state)


def shape_facets(shape: Shape, thickness: float, chord: float) -> np.ndarray:
    """Return corners (n, 3, 3) of the triangles of an extruded shape, of its volume to 1e-4, m.

    Args:
        shape: in z = 0.
        thickness: upwards, m.
        chord: largest distance of the triangles from the curves, m; less where the volume asks.
    """
    while True:
        loops = shape.polygons(chord)
        area = sum(0.5 * cross(loop, np.roll(loop, -1, axis=0)).sum() for loop in loops)
        if abs(area - shape.area) <= SAME_VOLUME * shape.area:
            return extruded_facets(loops, thickness)
        chord *= 0.25  # sides half as long


def make_part(domain: Domain, curves: Curves = DEFAULTS) -> PlanePart:
    """Return the part of one arm that encloses the volume of its densities."""
    away = domain.cell if curves.tolerance is None else curves.tolerance
    if away > domain.cell:
        raise InputError(
            f"--tolerance = {away:g} m: expected at most a cell of arm {domain.name!r}, "
            f"{domain.cell:.3g} m"
        )
    tool = min(TOOL, SLIM * domain.height) if curves.tool_radius is None else curves.tool_radius
    fine = min(away, TOLERANCE, CELLS * domain.cell)
    limits = limits_of_part(domain, tool)
    outline = draw_outline(domain, limits)
    sides = fitted_sides(outline, limits, away, domain.volume)
    if curves.rounds:
        sides = rounded_radii(sides, limits)
    return PlanePart(domain, outline, sides, fine, curves.rounds)
