"""From a folder of results to the parts of its arms, and their figures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolfinopt.errors import InputError
from dolfinopt.part.plane.curves import Shape
from dolfinopt.part.plane.domain import Domain, read_domains
from dolfinopt.part.plane.outline import Outline, default_tool, draw_outline, thinnest_member
from dolfinopt.part.plane.trace import make_shape
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from mpi4py import MPI


TOLERANCE, CELLS = 1e-4, 0.1  # default: the smaller of 0.1 mm and a tenth of a cell
LEAST = 1e-7  # m, the finest tolerance: that of CAD programs
TRIES, ENOUGH = 3, 0.98  # of the radius of concave corners; share of the tool's that will do
GRAY = 0.02  # grayness from which on a design is no longer close to any part


@dataclass(frozen=True, eq=False)
class Part:
    """The part of one arm.

    Attributes:
        domain: the arm and its design.
        outline: its polygon.
        shape: its curves.
        tolerance: of the curves, m.
        thinnest: width of its thinnest member, m; None where nothing is thin.
    """

    domain: Domain
    outline: Outline
    shape: Shape
    tolerance: float
    thinnest: float | None

    @property
    def warnings(self) -> list[str]:
        """What the workshop or the designer should know, a sentence each."""
        one, outline = self.domain, self.outline
        found = []
        if one.grayness > GRAY:
            found.append(
                f"arm {one.name!r}: grayness {one.grayness:.2g}: {100.0 * one.gray_share:.0f} % of "
                "the material is in cells that are neither solid nor void; the part is another "
                'design than the optimised one; optimise with design.projection = "robust"'
            )
        if one.crisp:
            found.append(
                f"arm {one.name!r}: design.npz does not tell what its densities were projected "
                "from, as that of an optimisation does; the outline is that of the cells, blurred"
            )
        if outline.islands:
            share = 100.0 * outline.islands_area / one.volume
            number = _count(outline.islands, "piece")
            found.append(
                f"arm {one.name!r}: {number} without a joint to both interfaces "
                f"({1e6 * outline.islands_area:.3g} mm2, {share:.2g} % of the volume) left out"
            )
        if self.thinnest is not None and self.thinnest < 0.9 * one.minimum_member:
            found.append(
                f"arm {one.name!r}: its thinnest neck is {1e3 * self.thinnest:.3g} mm wide, below "
                f"design.minimum_member = {1e3 * one.minimum_member:.3g} mm"
            )
        return found

    def figures(self, density: float) -> dict[str, Any]:
        """Return the entry of part.json.

        Args:
            density: of the material, kg/m3.
        """
        one, shape = self.domain, self.shape
        volume = shape.area * one.thickness
        radius = shape.concave_radius
        return {
            "area": shape.area,
            "volume": volume,
            "mass": density * volume,
            "design_volume": one.volume * one.thickness,
            "level": self.outline.level,
            "distance": shape.distance,
            "tolerance": self.tolerance,
            "curves": len(shape.curves),
            "control_points": shape.control_points,
            "loops": len(shape.loops),
            "tool_radius": self.outline.tool_radius,
            "smallest_concave_radius": radius if math.isfinite(radius) else None,
            "thinnest_member": self.thinnest,
            "islands_left_out": self.outline.islands,
            "holes_filled": self.outline.filled,
            "grayness": one.grayness,
            "warnings": self.warnings,
        }


def make_parts(
    scene: Scene,
    folder: Path,
    tool_radius: float | None = None,
    tolerance: float | None = None,
    arcs: bool = False,
    world: MPI.Comm | None = None,
) -> dict[int, Part]:
    """Make the parts of the arms that have a design of their own (collective on `world`).

    Args:
        scene: of the run.
        folder: with its design.npz.
        tool_radius: of concave corners, m; default a fifth of a cell.
        tolerance: of the curves, m; default 0.1 mm or a tenth of a cell, the smaller.
        arcs: lines and arcs in place of splines.
        world: the ranks that share the arms; by default this one alone.

    Returns:
        Parts by their place in the chain, the same on any number of ranks; on the root, none
        elsewhere.

    Raises:
        InputError: no design in the folder, or no part can be made of it with these values; on all
            ranks.
    """
    from mpi4py import MPI

    from dolfinopt.parallel import on_root, together

    world = MPI.COMM_SELF if world is None else world
    on_root(world, check_options, folder, tool_radius, tolerance)
    domains = read_domains(scene, folder, world)
    with together(world):
        mine = {k: make_part(one, tool_radius, tolerance, arcs) for k, one in domains.items()}
    found: dict[int, Part] = {}
    for pieces in world.gather(mine, root=0) or ():
        found.update(pieces)
    return {k: found[k] for k in sorted(found)}


def check_options(folder: Path, tool_radius: float | None, tolerance: float | None) -> None:
    """Raise InputError unless the folder has a design and the options are in range."""
    for name, value, least in (
        ("--tool-radius", tool_radius, 0.0),
        ("--tolerance", tolerance, LEAST),
    ):
        if value is not None and not (math.isfinite(value) and value >= least):
            raise InputError(f"{name} = {value:g} m: expected a length of at least {least:g} m")
    if not (folder / "design.npz").is_file():
        raise InputError(
            f"{folder / 'design.npz'}: no design there; name the folder of a finished optimize or "
            "simulate run"
        )


def make_part(
    domain: Domain, tool_radius: float | None, tolerance: float | None, arcs: bool = False
) -> Part:
    """Return the part of one arm, see `make_parts`."""
    if tolerance is None:
        tolerance = min(TOLERANCE, CELLS * domain.cell)
    elif tolerance > domain.cell:
        raise InputError(
            f"--tolerance = {tolerance:g} m: expected at most a cell of arm {domain.name!r}, "
            f"{domain.cell:.3g} m"
        )
    tool = default_tool(domain) if tool_radius is None else tool_radius
    # Where nobody has asked for a tool, curves within the tolerance of its path will do.
    least = max(tool - tolerance, 0.0) if tool_radius is None else ENOUGH * tool
    rounding = None
    for _ in range(TRIES):
        outline = draw_outline(domain, tool, tolerance, rounding)
        shape = make_shape(outline, tolerance, arcs)
        radius = shape.concave_radius
        if radius >= least:
            break
        rounding = outline.rounding * min(1.1 * tool / radius, 2.0)
    return Part(domain, outline, shape, tolerance, thinnest_member(outline))


def _count(number: int, name: str) -> str:
    return f"{number} {name}" if number == 1 else f"{number} {name}s"
