"""Pictures of solid links below each other: material, stress, parts.

PyVista shades solids in parallel projection, without words; Matplotlib puts the images into axes
whose coordinates are the plane of projection, m, and writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyvista
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dolfinopt.mesh.solid_cells import TENSOR
from dolfinopt.output.design import ArmView
from dolfinopt.part.solid.surface import Surface, surface_at
from dolfinopt.plots.design import bounds, cell_volumes
from dolfinopt.plots.poses import box_corners
from dolfinopt.plots.style import (
    GREY,
    MILLI,
    Box,
    round_number,
    stacked_axes,
)

LEVEL = 0.5  # density from which material is drawn
STEEL, BAR = "#8fb0cc", "#a8a8a8"  # links, rigid bodies
SIDES = 60  # of a round bar
LINE = 2.0  # px
EDGE = 35.0  # degrees between faces from which an edge stays sharp
SHADED = {"smooth_shading": True, "split_sharp_edges": True, "feature_angle": EDGE, "ambient": 0.3,
          "diffuse": 0.85, "specular": 0.1}  # fmt: skip
PLAIN = {"show_scalar_bar": False, "reset_camera": False, "render": False}


@dataclass(frozen=True, eq=False)
class Camera:
    """A parallel projection.

    Attributes:
        right, up, back: (3,) unit vectors: to the right, upwards and towards the viewer.
    """

    right: np.ndarray
    up: np.ndarray
    back: np.ndarray

    def plane(self, points: np.ndarray) -> np.ndarray:
        """Return where points (..., 3) land (..., 2), m."""
        return points @ np.stack([self.right, self.up], axis=1)


def camera_from(back: Sequence[float] | np.ndarray, up: Sequence[float] | np.ndarray) -> Camera:
    """Return the projection seen from the direction `back`, with `up` upwards."""
    towards = np.asarray(back, dtype=float) / np.linalg.norm(back)
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return Camera(right, np.cross(towards, right), towards)


# Links are seen from the front, a little from above and from the right.
LINKS = camera_from((0.15, 0.45, 1.0), (0.0, 1.0, 0.0))


class Studio:
    """Solids in front of a camera, rendered off-screen, with no word in the picture.

    Attributes:
        axes: that show the camera's plane, m, to one scale.
        back: (3,) unit vector towards the viewer.
        plotter: PyVista's; holds the solids.
    """

    def __init__(self, camera: Camera, axes: Axes) -> None:
        self.axes, self.back = axes, camera.back
        low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
        px_per_m = axes.bbox.width / (high - low)[0]
        size = [int(np.ceil(n)) for n in (high - low) * px_per_m]
        theme = pyvista.themes.DocumentTheme()
        theme.multi_samples = 4  # eight double the time of the software renderer
        self.plotter: Any = pyvista.Plotter(off_screen=True, window_size=size, theme=theme)
        focus = 0.5 * (low + high) @ np.stack([camera.right, camera.up])
        seen = self.plotter.camera
        seen.focal_point, seen.position, seen.up = focus, focus + camera.back, camera.up
        seen.parallel_projection = True
        seen.parallel_scale = 0.5 * size[1] / px_per_m

    def add(self, mesh: Any, **look: Any) -> None:
        """Draw a mesh, shaded."""
        self.plotter.add_mesh(mesh, **(SHADED | PLAIN | look))

    def solid(self, surface: Surface, **look: Any) -> None:
        """Draw a surface, if there is any; a look with `scalars` has values of its triangles."""
        if len(surface.triangles):
            mesh = pyvista.PolyData.from_regular_faces(surface.points, surface.triangles)
            if "scalars" in look:
                look |= {"ambient": 0.85, "diffuse": 0.2, "specular": 0.0}
            self.add(mesh, **look)

    def line(self, points: np.ndarray, colour: str) -> None:
        """Draw the line through points (n, 3), m; nothing of a single one."""
        if len(points) > 1:
            mesh = pyvista.lines_from_points(points)
            self.plotter.add_mesh(mesh, color=colour, line_width=LINE, lighting=False, **PLAIN)

    def bar(self, start: np.ndarray, end: np.ndarray, radius: float, colour: str) -> None:
        """Draw a round bar between two points (3,), m; nothing where they coincide."""
        if not np.allclose(start, end):
            self.add(pyvista.Line(start, end).tube(radius=radius, n_sides=SIDES), color=colour)

    def ball(self, centre: np.ndarray, radius: float, colour: str) -> None:
        """Draw a sphere."""
        self.add(pyvista.Sphere(radius=radius, center=centre), color=colour)

    def render(self) -> np.ndarray:
        """Return the picture (height, width, 3), uint8."""
        self.plotter.reset_camera_clipping_range()
        self.plotter.render()  # a screenshot alone would show what was rendered last
        return np.asarray(self.plotter.screenshot(return_img=True))

    def close(self) -> np.ndarray:
        """Render, free the window, and return the picture."""
        try:
            return self.render()
        finally:
            self.plotter.close()

    def show(self, image: np.ndarray) -> Any:
        """Put a picture into the axes; return Matplotlib's image."""
        extent = (*self.axes.get_xlim(), *self.axes.get_ylim())
        return self.axes.imshow(image, extent=extent, interpolation="antialiased", aspect="auto")


def material(view: ArmView, *, modes: bool = False) -> Surface:
    """Return the surface of what of a link is denser than one half, in the link's frame.

    Args:
        view: of a solid.
        modes: whether the reduced basis (n, 3, q) at the surface's points is wanted, as a field.
    """
    order = TENSOR[view.corners.shape[1:]]  # there and back
    fields = {"modes": view.modes[:, order]} if modes else {}
    return surface_at(view.corners[:, order], view.solid, LEVEL, fields)


def draw_triad(axes: Axes, camera: Camera, at: np.ndarray, length: float) -> None:
    """Draw the directions of x, y and z at a place (2,) of the plane, m."""
    for name, along in zip("xyz", np.eye(3)):
        arrow = length * camera.plane(along)
        axes.annotate(
            "", xy=tuple(at + arrow), xytext=tuple(at), annotation_clip=False,
            arrowprops={"arrowstyle": "->", "lw": 1.0, "shrinkA": 0.0, "shrinkB": 0.0},
        )  # fmt: skip
        # An axis that points at the viewer is short: its name stands off all the same.
        x, y = at + 1.3 * max(1.0, 0.6 * length / float(np.linalg.norm(arrow))) * arrow
        axes.text(x, y, name, ha="center", va="center", fontsize=9)


def draw_length(axes: Axes, at: np.ndarray, length: float, above: float) -> None:
    """Draw a length from a place (2,) of the plane to the right, and its size `above` it; m."""
    axes.plot([at[0], at[0] + length], [at[1], at[1]], color="black", lw=2.0, clip_on=False)
    axes.text(at[0] + 0.5 * length, at[1] + above, f"{1e3 * length:.6g} mm", ha="center")


def surfaces_figure(parts: Sequence[tuple[str, Surface, Sequence[str]]], title: str) -> Figure:
    """Return the picture of parts below each other, to one scale, each under its size and notes."""
    boxes = [(item.points.min(axis=0), item.points.max(axis=0)) for _, item, _ in parts]
    figure, panels = box_rows(boxes, title)
    for (name, surface, words), box, axes in zip(parts, boxes, panels, strict=True):
        _draw_boxed(axes, box, surface, edges=False, color=STEEL)
        axes.set_title(", ".join([_size_of(name, box), *words]))
    return figure


def caption(view: ArmView, mass: float | None) -> str:
    """Return what stands above a link: its size, volume and mass."""
    volumes = cell_volumes(view)
    volume = volumes @ view.solid
    filled = f" ({100.0 * volume / volumes.sum():.3g} %)"
    if view.wall is not None:
        thin, thick = MILLI * view.wall.min(), MILLI * view.wall.max()
        filled = f", wall {thin:.3g} to {thick:.3g} mm"
    words = [_size_of(view.name, bounds(view)), f"volume {1e6 * volume:.4g} cm3{filled}"]
    if mass is not None:
        words.append(f"mass {mass:.4g} kg")
    if not len(material(view).triangles):
        words.append("no density above 0.5")
    return ", ".join(words)


def _size_of(name: str, box: Box) -> str:
    x, y, z = MILLI * (box[1] - box[0])
    return f"{name}:  {x:.4g} x {y:.4g} x {z:.4g} mm"


def box_rows(boxes: Sequence[Box], title: str, foot: float = 0.0) -> tuple[Figure, list[Axes]]:
    """Return a figure and axes for the boxes (lowest and highest corner (3,), m) of links."""
    seen = [LINKS.plane(box_corners(*box)) for box in boxes]
    flat = [(places.min(axis=0), places.max(axis=0)) for places in seen]
    return stacked_axes(flat, title, above=0.4, below=0.5, foot=foot, least=0.3)


def draw_link(
    axes: Axes, view: ArmView, values: np.ndarray | None, colours: str, largest: float
) -> None:
    """Draw a link's material, in the colours of its cells' values if there are any, in its box."""
    surface, look = material(view), {"color": STEEL}
    if values is not None:
        look = {"scalars": values[surface.cells], "cmap": colours, "clim": (0.0, largest)}
    _draw_boxed(axes, bounds(view), surface, edges=True, **look)


def _draw_boxed(axes: Axes, box: Box, surface: Surface, *, edges: bool, **look: Any) -> None:
    """Draw a surface, the edges of its box if they are wanted, a length and the directions.

    Args:
        axes: the link's, whose scale stays.
        box: lowest and highest corner (3,) of the link, m.
        surface: in the link's frame, m.
        edges: whether the box is drawn.
        look: colours, see `Studio.solid`.
    """
    studio = Studio(LINKS, axes)
    studio.solid(surface, **look)
    if edges:
        lines = pyvista.Box(np.transpose(box).ravel())
        studio.plotter.add_mesh(lines, style="wireframe", color=GREY, lighting=False, **PLAIN)
    studio.show(studio.close())
    axes.set_axis_off()
    (low, high), px = box, np.ptp(axes.get_xlim()) / axes.bbox.width  # m
    corner = LINKS.plane(np.array([low[0], low[1], high[2]]))  # at the front, below
    draw_length(axes, corner - [0.0, 30.0 * px], round_number(0.2 * (high - low)[0]), 8.0 * px)
    draw_triad(axes, LINKS, corner + np.array([-42.0, 24.0]) * px, 26.0 * px)
