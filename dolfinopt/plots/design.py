"""Pictures of arms below each other, to one scale: densities, stress, parts; plane and solid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from dolfinopt.mesh.checks import cell_sizes
from dolfinopt.mesh.solid_cells import TENSOR
from dolfinopt.output.design import ArmView
from dolfinopt.plots.style import (
    BLUE,
    COLOURS,
    DENSITY,
    GREY,
    MILLI,
    ORANGE,
    Box,
    colour_scale,
    round_marks,
    stacked_axes,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.part.part import Part
    from dolfinopt.part.plane.part import PlanePart

REGION = {"solid": ORANGE, "void": BLUE}  # borders of what stays solid and void
STRESS_COLOURS = "YlOrRd"  # nothing is light, the largest dark
WALL_COLOURS = "viridis_r"
STRESS, WALL = "largest von Mises stress along the motion [MPa]", "thickness of the wall [mm]"
MEGA = 1e-6
QUARTERS = 0.0, 0.25, 0.5, 0.75, 1.0
LOW = 0.45  # inches, least height of an arm's axes
SCALE_FOOT = 0.75  # inches, for the scale of colours
LABEL_FOOT = 0.6  # inches, for the label of x
MARGIN = 0.012  # of the arms' length, around them
FACE = "#b8c4cc"
CHORD = 0.02  # of drawn curves, cells
SHADES = 256  # of a scale of colours


@styled
def design_figure(
    views: Sequence[ArmView], title: str, masses: Mapping[str, float] | None = None
) -> Figure:
    """Return the picture of the densities of all arms; of solids, of what is denser than 0.5.

    Args:
        views: from the cart outwards, all plane or all solid.
        title: above the picture.
        masses: of solid arms by name, kg, if they are known.
    """
    if not is_solid(views):
        return _densities_figure(views, title)
    from dolfinopt.plots.solid import caption

    thickest = max((MILLI * v.wall.max() for v in views if v.wall is not None), default=0.0)
    marks = round_marks(thickest)
    figure, rows = _panels(views, title, thickest > 0.0)
    for axes, view in zip(rows, views, strict=True):
        wall = None if view.wall is None else MILLI * view.wall
        _draw_arm(axes, view, wall, WALL_COLOURS, marks[-1])
        axes.set_title(caption(view, (masses or {}).get(view.name)))
    if thickest:
        colour_scale(figure, WALL, WALL_COLOURS, marks)
    return figure


def _densities_figure(views: Sequence[ArmView], title: str) -> Figure:
    """Return the picture of plane arms: densities, regions, joint axes."""
    figure, rows = _panels(views, title, True)
    for axes, view in zip(rows, views, strict=True):
        _draw_arm(axes, view, view.density, COLOURS, 1.0)
        low, high = bounds(view)
        for kind, border in view.regions:
            axes.fill(*np.clip(border, low, high).T, fc="none", ec=REGION[kind], lw=1.2,
                      label=f"stays {kind}")  # fmt: skip
        if view.length is not None:
            axes.plot([0.0, view.length], [0.0, 0.0], "o", mfc="white", mec="black", clip_on=False)
        axes.set_title(_caption(view))
    keys = {key: item for axes in rows for item, key in zip(*axes.get_legend_handles_labels())}
    if keys:
        figure.legend(list(keys.values()), list(keys), loc="lower left")
    colour_scale(figure, DENSITY, COLOURS, QUARTERS)
    return figure


@styled
def stress_figure(views: Sequence[ArmView], title: str) -> Figure:
    """Return the picture of the largest stress of every cell, the place of the largest ringed.

    On solids what is denser than one half is drawn; the ring may be on the side that is not seen.

    Args:
        views: of arms whose stress is known, from the cart outwards, all plane or all solid.
        title: above the picture.
    """
    figure, rows = _panels(views, title, True)
    stresses = [MEGA * view.stress for view in views if view.stress is not None]
    largest = max(stress.max() for stress in stresses)
    marks = round_marks(largest)
    for axes, view, stress in zip(rows, views, stresses, strict=True):
        _draw_arm(axes, view, stress, STRESS_COLOURS, marks[-1])
        worst, when = np.argmax(stress), view.stress_instant
        assert when is not None
        if stress[worst] == largest > 0.0:
            place = view.centroid[worst]
            if is_solid(views):
                from dolfinopt.plots.solid import LINKS

                place = LINKS.plane(place)
            axes.plot(*place, "o", mfc="none", mec=BLUE, mew=1.8, ms=13.0, clip_on=False)
        places = zip("xyz", MILLI * view.centroid[worst])
        where = ", ".join(f"{name} = {value:.4g}" for name, value in places)
        words = f"largest {stress[worst]:.4g} MPa at {where} mm, t = {when[worst]:.4g} s"
        axes.set_title(f"{view.name}:  {words}")
    colour_scale(figure, STRESS, STRESS_COLOURS, marks)
    return figure


@styled
def parts_figure(
    parts: Sequence[Part], title: str, masses: Sequence[float], own: bool = False
) -> Figure:
    """Return the picture of parts below each other, mm: plates over the densities of their arms.

    Args:
        parts: from the cart outwards, all plane or all solid.
        title: above the picture.
        masses: of the parts, kg.
        own: whether plates have a layout of their own: the densities are left out then.
    """
    from dolfinopt.part.hollow import HollowPart
    from dolfinopt.part.plane.part import PlanePart
    from dolfinopt.part.solid.part import SolidPart

    plates = [part for part in parts if isinstance(part, PlanePart)]
    if not plates:
        from dolfinopt.plots.solid import surfaces_figure

        solids = [part for part in parts if isinstance(part, (SolidPart, HollowPart))]
        noted = []
        for part, mass in zip(solids, masses, strict=True):
            notes = [f"volume {1e6 * part.volume:.4g} cm3", f"mass {mass:.4g} kg"]
            noted.append((part.name, part.surface, [*notes, *part.width_words]))
        return surfaces_figure(noted, title)
    corners = [MILLI * part.domain.corners for part in plates]
    words = "part" if own else "part over density"
    foot = LABEL_FOOT if own else LABEL_FOOT + SCALE_FOOT
    figure, rows = _arm_rows([box_of(cells) for cells in corners], f"{title}: {words}", "mm", foot)
    for axes, part, cells, mass in zip(rows, plates, corners, masses, strict=True):
        loops, shape = _loops(part), part.shape
        if own:
            closed = [Path(loop, closed=True) for loop in loops]
            axes.add_patch(PathPatch(Path.make_compound_path(*closed), fc=FACE, ec="none"))
        else:
            fill_cells(axes, cells, part.domain.x_phys)
        for loop in loops:
            axes.plot(*loop.T, color=ORANGE, clip_on=False)
        axes.set_title(
            f"{part.name}:  {1e6 * shape.area:.5g} mm\N{SUPERSCRIPT TWO}, {mass:.4g} kg, "
            f"{len(shape.loops) - 1} holes, {len(shape.curves)} curves"
        )
    if not own:
        colour_scale(figure, DENSITY, COLOURS, QUARTERS)
    return figure


@styled
def figure_of_plates(parts: Sequence[PlanePart]) -> Figure:
    """Return a picture of parts as plates below each other, seen from the right and above."""
    from dolfinopt.plots.solid import Surface, surfaces_figure

    noted = []
    for part in parts:
        corners = part.facets.reshape(-1, 3)
        surface = Surface(corners, np.arange(len(corners)).reshape(-1, 3))
        notes = [f"{len(part.shape.loops) - 1} holes", f"{len(part.shape.curves)} curves"]
        noted.append((part.name, surface, notes))
    return surfaces_figure(noted, "")


def is_solid(views: Sequence[ArmView]) -> bool:
    """Return whether arms have three dimensions."""
    return bool(views[0].corners.shape[2] == 3)


def box_of(corners: np.ndarray) -> Box:
    """Return the lowest and highest corner of cells (n, k, d)."""
    return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))


def bounds(view: ArmView) -> Box:
    """Return the box of an arm, m."""
    return box_of(view.corners)


# -- one arm in its axes ---------------------------------------------------------------------


def _panels(views: Sequence[ArmView], title: str, scaled: bool) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes for each arm, m, and room for a scale of colours if wanted."""
    foot, boxes = SCALE_FOOT if scaled else 0.0, [bounds(view) for view in views]
    if not is_solid(views):
        return _arm_rows(boxes, title, "m", LABEL_FOOT + foot)
    from dolfinopt.plots.solid import box_rows

    return box_rows(boxes, title, foot)


def _draw_arm(
    axes: Axes, view: ArmView, values: np.ndarray | None, colours: str, largest: float
) -> None:
    """Draw an arm in the colours of its cells' values from 0 to `largest`; None: of material."""
    if is_solid([view]):
        from dolfinopt.plots.solid import draw_link

        draw_link(axes, view, values, colours, largest)
        return
    assert values is not None
    fill_cells(axes, view.corners, values, colours, largest)
    rim: Any = sides(view.corners)[boundary(view.corners)]
    axes.add_collection(LineCollection(rim, colors=GREY, linewidths=1.0), autolim=False)


def _arm_rows(
    boxes: Sequence[Box], title: str, unit: str, foot: float
) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes for each plane arm, inboard joints in one column."""
    margin = MARGIN * max((high - low)[0] for low, high in boxes)
    wider = [(low - margin, high + margin) for low, high in boxes]
    figure, rows = stacked_axes(wider, title, below=0.12, foot=foot, least=LOW)
    for axes in rows:
        axes.set_ylabel(f"y [{unit}]")
        axes.locator_params(axis="x", nbins=max(2, int(axes.bbox.width / 90.0)))
        axes.locator_params(axis="y", nbins=max(2, int(axes.bbox.height / 40.0)))
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelbottom=axes is rows[-1])
    rows[-1].set_xlabel(f"x [{unit}]")
    return figure, rows


def fill_cells(
    axes: Axes,
    corners: np.ndarray,
    values: np.ndarray,
    colours: str = COLOURS,
    largest: float = 1.0,
    strength: float = 1.0,
) -> None:
    """Fill cells (n, k, 2) in the colours of their values from 0 to `largest`.

    Cells of one colour are one path: they have no seams, and a path is made for a colour, not for a
    cell. `strength` is the share of the colours, the rest white: where neighbours overlap by a
    pixel transparent ones would darken.
    """
    levels = np.round(values / largest * (SHADES - 1)).astype(int)
    shown, paths = np.unique(levels), []
    codes = np.full(corners.shape[1] + 1, Path.LINETO)
    codes[[0, -1]] = Path.MOVETO, Path.CLOSEPOLY
    for level in shown:
        cells = corners[levels == level]
        closed = np.concatenate([cells, cells[:, :1]], axis=1)
        paths.append(Path(closed.reshape(-1, 2), np.tile(codes, len(cells))))
    fill = 1.0 - strength * (1.0 - colormaps[colours](shown / (SHADES - 1))[:, :3])
    cells = PathCollection(paths, facecolors=fill, antialiaseds=False, lw=0.0, rasterized=True)
    axes.add_collection(cells, autolim=False)


def _caption(view: ArmView) -> str:
    """Return what stands above a plane arm: from joint axis to joint axis, height, material."""
    size = np.ptp(view.corners, axis=(0, 1))
    long = f"{size[0]:.4g} m long"
    if view.length is not None:
        long = f"axis distance {view.length:.4g} m"
    share = f"volume fraction {np.average(view.density, weights=cell_volumes(view)):.3f}"
    return f"{view.name}:  {long}, {size[1]:.4g} m high, {share}"


def _loops(part: PlanePart) -> list[np.ndarray]:
    """Return the closed curves of a part as points (n, 2), mm, the last one the first again.

    The outline comes first.
    """
    loops = part.shape.polygons(CHORD * part.domain.cell)
    return [MILLI * np.vstack([loop, loop[:1]]) for loop in loops]


# -- polygons: areas and outlines -------------------------------------------------------------


def cell_volumes(view: ArmView) -> np.ndarray:
    """Return the areas (n,), m2, or volumes, m3, of an arm's cells."""
    return cell_sizes(view.corners[:, TENSOR[view.corners.shape[1:]]])


def sides(corners: np.ndarray) -> np.ndarray:
    """Return all edges (m * k, 2, ...) of polygons (m, k, ...)."""
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    return edges.reshape(corners.shape[0] * corners.shape[1], 2, *corners.shape[2:])


def boundary(corners: np.ndarray) -> np.ndarray:
    """Return which of `sides` only one of the polygons (m, k, 2) has; corners may differ by 1e-7.

    It stays the same in every deformation and place of the polygons.
    """
    flat = corners.reshape(-1, 2)
    size = np.ptp(flat, axis=0).max() or 1.0
    places = np.round(flat / (1e-7 * size)) @ [1.0, 1j]
    node = np.unique(places, return_inverse=True)[1].reshape(corners.shape[:2])
    edge = np.sort(sides(node), axis=1) @ [node.max() + 1, 1]
    _, first, count = np.unique(edge, return_index=True, return_counts=True)
    return first[count == 1]
