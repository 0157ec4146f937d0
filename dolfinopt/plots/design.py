"""Pictures of arms below each other, to one scale: densities, stress, parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import PathPatch
from matplotlib.path import Path

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
    round_number,
    stacked_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.part.part import Part
    from dolfinopt.part.plane.part import PlanePart

REGION = {"solid": ORANGE, "void": BLUE}  # borders of what stays solid and void
STRESS_COLOURS = "YlOrRd"  # nothing is light, the largest dark
STRESS = "largest von Mises stress along the motion [MPa]"
MEGA = 1e-6
LOW = 0.45  # inches, least height of an arm's axes
PLATE = 1.0  # inches, likewise of a plate
FOOT = 1.35  # inches, for the label of x and the scale of colours
LABEL_FOOT = 0.6  # for the label of x alone
MARGIN = 0.012  # of the arms' length, around them
FACE, BRIGHT, DARK = "#b8c4cc", np.array([0.62, 0.68, 0.72]), np.array([0.20, 0.26, 0.31])
DEPTH = np.array([0.35, 0.35])  # by which a plate's back is moved, of its thickness
CHORD = 0.02  # of drawn curves, cells


def design_figure(
    views: Sequence[ArmView], title: str, masses: Mapping[str, float] | None = None
) -> Figure:
    """Return the picture of the densities of all arms; of solids, of what is denser than 0.5.

    Args:
        views: from the cart outwards, all plane or all solid.
        title: above the picture.
        masses: of solid arms by name, kg, if they are known.
    """
    if is_solid(views):
        from dolfinopt.plots.solid_design import solid_design_figure

        return solid_design_figure(views, title, masses)
    figure, rows = _arm_rows([view.corners for view in views], title, "m", FOOT)
    for axes, view in zip(rows, views, strict=True):
        _fill(axes, view.corners, view.density)
        _draw_rim(axes, view.corners)
        for kind, border in view.regions:
            low, high = view.corners.min(axis=(0, 1)), view.corners.max(axis=(0, 1))
            axes.fill(*np.clip(border, low, high).T, fc="none", ec=REGION[kind], lw=1.2,
                      label=f"stays {kind}")  # fmt: skip
        if view.length is not None:
            axes.plot([0.0, view.length], [0.0, 0.0], "o", mfc="white", mec="black", ms=5.5,
                      clip_on=False)  # fmt: skip
        axes.set_title(_caption(view), loc="left", fontsize=10, parse_math=False)
    keys = {key: one for axes in rows for one, key in zip(*axes.get_legend_handles_labels())}
    if keys:
        figure.legend(list(keys.values()), list(keys), loc="lower left", frameon=False, fontsize=9)
    colour_scale(figure, DENSITY, COLOURS, (0.0, 0.25, 0.5, 0.75, 1.0))
    return figure


def stress_figure(views: Sequence[ArmView], title: str) -> Figure:
    """Return the picture of the largest stress of every cell, the place of the largest ringed.

    Args:
        views: of arms whose stress is known, from the cart outwards, all plane or all solid.
        title: above the picture.
    """
    if is_solid(views):
        from dolfinopt.plots.solid_design import solid_stress_figure

        return solid_stress_figure(views, title)
    figure, rows = _arm_rows([view.corners for view in views], title, "m", FOOT)
    stresses = [MEGA * known_stress(view)[0] for view in views]
    largest = max(float(stress.max()) for stress in stresses)
    marks = scale_marks(largest)
    for axes, view, stress in zip(rows, views, stresses, strict=True):
        _fill(axes, view.corners, stress, STRESS_COLOURS, marks[-1])
        _draw_rim(axes, view.corners)
        worst = int(np.argmax(stress))
        (x, y), when = view.centroid[worst], known_stress(view)[1][worst]
        if stress[worst] == largest > 0.0:
            draw_ring(axes, x, y)
        words = f"largest {stress[worst]:.4g} MPa at x = {x:.4g} m, y = {y:.4g} m, t = {when:.4g} s"
        axes.set_title(f"{view.name}:  {words}", loc="left", fontsize=10, parse_math=False)
    colour_scale(figure, STRESS, STRESS_COLOURS, marks)
    return figure


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
        from dolfinopt.plots.solid_design import solid_parts_figure

        solids = [part for part in parts if isinstance(part, (SolidPart, HollowPart))]
        return solid_parts_figure(solids, title, masses)
    corners = [MILLI * part.domain.corners for part in plates]
    words = "part" if own else "part over density"
    figure, rows = _arm_rows(corners, f"{title}: {words}", "mm", LABEL_FOOT if own else FOOT)
    for axes, part, cells, mass in zip(rows, plates, corners, masses, strict=True):
        loops = _loops(part)
        if own:
            axes.add_patch(PathPatch(_compound(loops), fc=FACE, ec="none"))
        else:
            _fill(axes, cells, part.domain.x_phys)
        for loop in loops:
            axes.plot(*np.vstack([loop, loop[:1]]).T, color=ORANGE, lw=1.3, clip_on=False)
        shape = part.shape
        words = (
            f"{part.name}:  {1e6 * shape.area:.5g} mm\N{SUPERSCRIPT TWO}, {mass:.4g} kg, "
            f"{len(shape.loops) - 1} holes, {len(shape.curves)} curves"
        )
        axes.set_title(words, loc="left", fontsize=10, parse_math=False)
    if not own:
        colour_scale(figure, DENSITY, COLOURS, (0.0, 0.25, 0.5, 0.75, 1.0))
    return figure


def figure_of_plates(parts: Sequence[PlanePart], densities: Sequence[float] = ()) -> Figure:
    """Return a picture of parts as plates seen from the right and above, to one scale.

    Args:
        parts: below each other.
        densities: of their material, kg/m3: captions then tell the masses.
    """
    corners = [MILLI * part.domain.corners for part in parts]
    figure, rows = _arm_rows(corners, "", "mm", 0.2, PLATE)
    for k, (axes, part) in enumerate(zip(rows, parts, strict=True)):
        loops, thickness = _loops(part), part.domain.thickness
        _draw_plate(axes, loops, MILLI * thickness * DEPTH)
        size = [*np.ptp(loops[0], axis=0), MILLI * thickness]
        words = " \N{MULTIPLICATION SIGN} ".join(f"{one:.4g}" for one in size) + " mm"
        if len(densities):
            words += f", {densities[k] * part.shape.area * thickness:.3g} kg"
        words += f", {len(loops) - 1} holes, {len(part.shape.curves)} curves"
        axes.set_title(f"{part.domain.name}:  {words}", loc="left", fontsize=11, parse_math=False)
        axes.set_axis_off()
    return figure


def is_solid(views: Sequence[ArmView]) -> bool:
    """Return whether arms have three dimensions."""
    return bool(views[0].corners.shape[2] == 3)


def draw_ring(axes: Axes, x: float, y: float) -> None:
    """Mark the place of the largest stress."""
    axes.plot(x, y, "o", mfc="none", mec=BLUE, mew=1.8, ms=13.0, clip_on=False)


def scale_marks(largest: float) -> np.ndarray:
    """Return round numbers from 0 to `largest` or a little beyond, four to six of them."""
    if largest <= 0.0:
        return np.array([0.0, 1.0])
    step = round_number(largest / 5.0)
    return step * np.arange(int(np.ceil(largest / step - 1e-9)) + 1)


def known_stress(view: ArmView) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest stress of every cell, Pa, and its instant, s, of a view that has them."""
    assert view.stress is not None and view.stress_instant is not None
    return view.stress, view.stress_instant


def _arm_rows(
    corners: Sequence[np.ndarray], title: str, unit: str, foot: float, least: float = LOW
) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes for each arm, inboard joints in one column."""
    boxes: list[Box] = [(one.min(axis=(0, 1)), one.max(axis=(0, 1))) for one in corners]
    margin = MARGIN * max(float((high - low)[0]) for low, high in boxes)
    boxes = [(low - margin, high + margin) for low, high in boxes]
    figure, rows = stacked_axes(boxes, title, below=0.12, foot=foot, least=least)
    for axes in rows:
        axes.set_ylabel(f"y [{unit}]")
        axes.locator_params(axis="x", nbins=max(2, int(axes.bbox.width / 90.0)))
        axes.locator_params(axis="y", nbins=max(2, int(axes.bbox.height / 40.0)))
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelbottom=axes is rows[-1])
    rows[-1].set_xlabel(f"x [{unit}]")
    return figure, rows


def _fill(
    axes: Axes,
    corners: np.ndarray,
    values: np.ndarray,
    colours: str = COLOURS,
    largest: float = 1.0,
) -> None:
    """Draw cells in the colours of their values from 0 to `largest`."""
    polygons: Any = corners  # as one array: a list would become a path a cell in Python
    # Blended edges would let the ground shine through between neighbours.
    cells = PolyCollection(polygons, cmap=colours, antialiaseds=False, lw=0.0, rasterized=True)
    cells.set_array(values)
    cells.set_clim(0.0, largest)
    axes.add_collection(cells, autolim=False)


def _draw_rim(axes: Axes, corners: np.ndarray) -> None:
    """Draw the outline of cells."""
    rim: Any = sides(corners)[boundary(corners)]
    axes.add_collection(LineCollection(rim, colors=GREY, linewidths=1.0), autolim=False)


def _caption(view: ArmView) -> str:
    """Return what stands above an arm: from joint axis to joint axis, height, material."""
    size = np.ptp(view.corners, axis=(0, 1))
    long = f"{size[0]:.4g} m long"
    if view.length is not None:
        long = f"axis distance {view.length:.4g} m"
    share = f"volume fraction {volume_fraction(view):.3f}"
    return f"{view.name}:  {long}, {size[1]:.4g} m high, {share}"


def _loops(part: PlanePart) -> list[np.ndarray]:
    """Return the closed curves of a part as polygons (n, 2), mm; the outline first."""
    return [MILLI * loop for loop in part.shape.polygons(CHORD * part.domain.cell)]


def _draw_plate(axes: Axes, loops: Sequence[np.ndarray], depth: np.ndarray) -> None:
    """Draw a plate: its sides, those of the holes above those of the outline, then its face."""
    for loop in loops:
        after = np.roll(loop, -1, axis=0)
        quads: Any = np.stack([loop, after, after + depth, loop + depth], axis=1)
        along = after - loop
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
        light = normal @ [0.6, 0.8] / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
        shade: Any = 0.5 * (1.0 + light[:, None]) * (BRIGHT - DARK) + DARK
        axes.add_collection(PolyCollection(quads, fc=shade, ec=shade, lw=0.4, clip_on=False))
    axes.add_patch(PathPatch(_compound(loops), fc=FACE, ec="#20303a", lw=0.7, clip_on=False))


def _compound(loops: Sequence[np.ndarray]) -> Path:
    """Return the face within an outline and without its holes."""
    return Path.make_compound_path(*(Path(np.vstack([one, one[:1]]), closed=True) for one in loops))


# -- polygons: areas and outlines -------------------------------------------------------------


def cell_areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas (n,), m2, of polygons with corners (n, k, 2), m, in order around each."""
    x, y = corners[..., 0], corners[..., 1]
    after_x, after_y = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    return 0.5 * np.abs(np.sum(x * after_y - after_x * y, axis=1))


def volume_fraction(view: ArmView) -> float:
    """Return the mean physical density of an arm, weighted with its cells' areas."""
    area = cell_areas(view.corners)
    return float(area @ view.density / area.sum())


def sides(corners: np.ndarray) -> np.ndarray:
    """Return all edges (m * k, 2, ...) of polygons (m, k, ...)."""
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    return edges.reshape(corners.shape[0] * corners.shape[1], 2, *corners.shape[2:])


def boundary(corners: np.ndarray) -> np.ndarray:
    """Return which of `sides` only one of the polygons (m, k, 2) has; corners may differ by 1e-7.

    It stays the same in every deformation and place of the polygons.
    """
    flat = corners.reshape(-1, 2)
    size = float(np.ptp(flat, axis=0).max()) or 1.0
    column, row = np.round((flat - flat.min(axis=0)) / (1e-7 * size)).astype(np.int64).T
    node = np.unique(column * 2**24 + row, return_inverse=True)[1].reshape(corners.shape[:2])
    edge = np.sort(sides(node), axis=1) @ [node.max() + 1, 1]
    _, first, count = np.unique(edge, return_index=True, return_counts=True)
    return first[count == 1]
