"""Pictures of solids: shaded by PyVista in parallel projection, words and scales by Matplotlib.

The axes of a picture are the plane of projection, in m: what is drawn by either lands in place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from dolfinopt.output.views import AROUND, ArmView
from dolfinopt.part.isosurface import Surface, surface_at

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEVEL = 0.5  # density from which material is drawn
STEEL = "#8fb0cc"  # links
BAR = "#a8a8a8"  # rigid bodies
Colour = str | tuple[float, float, float]
# Where lights are, from the camera's point of view, and how strong.
LIGHTS = (((0.35, 0.75, 1.0), 0.75), ((-0.6, 0.1, 0.8), 0.3))
EDGE = 35.0  # degrees between faces from which an edge stays sharp
BOX = ((0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 6), (5, 7),
       (6, 7))  # fmt: skip


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


class Studio:
    """Solids in front of a camera, rendered off-screen.

    Attributes:
        camera: the projection.
        low, high: (2,) what of its plane is seen, m.
        size: of the picture: width, height, px.
        plotter: PyVista's; holds the solids.
    """

    def __init__(self, camera: Camera, low: np.ndarray, high: np.ndarray, px_per_m: float) -> None:
        """See `Studio`; `px_per_m` is the scale."""
        import pyvista

        self.camera, self.low, self.high = camera, low, high
        self.size = tuple(int(np.ceil(n)) for n in (high - low) * px_per_m)
        self.pyvista = pyvista
        theme = pyvista.themes.DocumentTheme()
        theme.multi_samples = 4
        window = list(self.size)
        self.plotter = cast(
            Any, pyvista.Plotter(off_screen=True, window_size=window, theme=theme, lighting="none")
        )
        self.plotter.set_background("white")
        for place, intensity in LIGHTS:
            self.plotter.add_light(
                pyvista.Light(position=place, light_type="camera light", intensity=intensity)
            )
        middle = 0.5 * (low + high)
        focus = middle[0] * camera.right + middle[1] * camera.up
        seen = self.plotter.camera
        seen.focal_point = focus
        seen.position = focus + camera.back
        seen.up = camera.up
        seen.parallel_projection = True
        seen.parallel_scale = 0.5 * self.size[1] / px_per_m

    def solid(self, surface: Surface, colour: Colour) -> None:
        """Draw a surface, if there is any."""
        if len(surface.triangles):
            self.add(poly_data(surface), color=colour)

    def coloured(
        self, surface: Surface, values: np.ndarray, colours: str, span: tuple[float, float]
    ) -> None:
        """Draw a surface in the colours of values (m,) of its triangles, if there is any."""
        if len(surface.triangles):
            mesh = poly_data(surface)
            mesh.cell_data["values"] = values
            look = {"cmap": colours, "clim": span, "ambient": 0.85, "diffuse": 0.2, "specular": 0.0}
            self.add(mesh, scalars="values", **look)

    def add(self, mesh: Any, **look: Any) -> Any:
        """Draw a mesh, shaded; return its actor."""
        style = {
            "smooth_shading": True,
            "split_sharp_edges": True,
            "feature_angle": EDGE,
            "ambient": 0.3,
            "diffuse": 0.85,
            "specular": 0.1,
            "show_scalar_bar": False,
            "reset_camera": False,
            "render": False,
        }
        return self.plotter.add_mesh(mesh, **(style | look))

    def line(self, points: np.ndarray, colour: Colour, width: float = 1.0) -> None:
        """Draw line segments (n, 2, 3), m; `width` px."""
        ends = np.asarray(points, dtype=float)
        lines = np.column_stack([np.full(len(ends), 2), np.arange(2 * len(ends)).reshape(-1, 2)])
        mesh = self.pyvista.PolyData(ends.reshape(-1, 3), lines=lines.ravel())
        self.plotter.add_mesh(
            mesh, color=colour, line_width=width, lighting=False, reset_camera=False, render=False
        )

    def bar(self, ends: np.ndarray, radius: float, colour: Colour = BAR, **look: Any) -> None:
        """Draw a round bar between two points (2, 3), m; nothing where they coincide."""
        along = ends[1] - ends[0]
        length = float(np.linalg.norm(along))
        if length <= 1e-9:
            return
        mesh = self.pyvista.Cylinder(
            center=ends.mean(axis=0), direction=along / length, radius=radius, height=length
        )
        self.add(mesh.triangulate(), color=colour, **look)

    def ball(self, centre: np.ndarray, radius: float, colour: Colour, **look: Any) -> None:
        """Draw a sphere."""
        self.add(self.pyvista.Sphere(radius=radius, center=centre), color=colour, **look)

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


def poly_data(surface: Surface) -> Any:
    """Return a surface as PyVista's."""
    import pyvista

    count = len(surface.triangles)
    faces = np.column_stack([np.full(count, 3), surface.triangles]).ravel()
    return pyvista.PolyData(surface.points, faces) if count else pyvista.PolyData()


def material(view: ArmView, *, modes: bool = False) -> Surface:
    """Return the surface of what of a link is denser than one half, in the link's frame.

    Args:
        view: of a solid.
        modes: whether the reduced basis (n, 3, q) at the surface's points is wanted, as a field.
    """
    order = AROUND[view.corners.shape[1:]]  # there and back
    fields = {"modes": view.modes[:, order]} if modes else {}
    return surface_at(view.corners[:, order], view.density, LEVEL, fields)


def moved(surface: Surface, origin: np.ndarray, rotation: np.ndarray) -> Surface:
    """Return a surface in another frame: from its own by `rotation` (3, 3), then `origin` (3,)."""
    return Surface(surface.points @ rotation.T + origin, surface.triangles)


def box_corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the corners (8, 3) of a box, x fastest."""
    grid = np.meshgrid(*np.stack([low, high], axis=1), indexing="ij")
    return np.stack([axis.ravel(order="F") for axis in grid], axis=1)


def box_lines(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the edges (12, 2, 3) of a box."""
    return np.asarray(box_corners(low, high)[np.array(BOX)])


def show(axes: Axes, image: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Put a picture of the part from `low` to `high` of the plane into axes without a frame."""
    axes.imshow(image, extent=(low[0], high[0], low[1], high[1]), interpolation="antialiased")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_axis_off()


def draw_triad(axes: Axes, camera: Camera, at: np.ndarray, length: float) -> None:
    """Draw the directions of x, y and z at a place (2,) of the plane, m."""
    for name, along in zip("xyz", np.eye(3)):
        arrow = length * camera.plane(along)
        axes.annotate(
            "", xy=tuple(at + arrow), xytext=tuple(at), annotation_clip=False,
            arrowprops={"arrowstyle": "->", "lw": 1.0, "shrinkA": 0.0, "shrinkB": 0.0},
        )  # fmt: skip
        x, y = at + 1.3 * arrow
        axes.text(x, y, name, ha="center", va="center", fontsize=9)
