"""Picture of the parts of solid arms, drawn by PyVista off-screen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from dolfinopt.disk import write_atomically
from dolfinopt.plots.style import PathLike

if TYPE_CHECKING:
    from dolfinopt.part.solid_part import SolidPart

WIDTH, LEAST, MOST = 1400, 260, 700  # px, of the page; of an arm's row
SPARE = 1.08  # of the width, over the longest part
WORDS = 60  # px, of a row, for the caption
FACE, CREASE = "#b8c4cc", 35.0  # degrees, between faces that meet at an edge
VIEW = np.array([-0.45, 0.55, 1.0])  # towards the eye: inboard, above, beside


def draw_solid_parts(path: PathLike, parts: Sequence[SolidPart], title: str) -> Path:
    """Draw parts below each other, to one scale (PNG); return the path."""
    import pyvista
    from PIL import Image

    towards = VIEW / np.linalg.norm(VIEW)
    across = np.cross([0.0, 1.0, 0.0], towards)
    across /= np.linalg.norm(across)
    upwards = np.cross(towards, across)
    spans = np.array(
        [np.ptp(one.surface.points @ [*zip(across, upwards)], axis=0) for one in parts]
    )
    pixel = SPARE * spans[:, 0].max() / WIDTH  # m
    row = int(np.clip(SPARE * spans[:, 1].max() / pixel + 2 * WORDS, LEAST, MOST))
    plotter = cast(
        Any,
        pyvista.Plotter(
            off_screen=True,
            shape=(len(parts), 1),
            border=False,
            window_size=[WIDTH, row * len(parts)],
        ),
    )
    try:
        plotter.set_background("white")
        for k, one in enumerate(parts):
            plotter.subplot(k, 0)
            mesh = pyvista.PolyData.from_regular_faces(one.surface.points, one.surface.triangles)
            plotter.add_mesh(
                mesh, color=FACE, smooth_shading=True, split_sharp_edges=True, feature_angle=CREASE
            )
            head = f"{title}: " if k == 0 else ""
            words = f"{head}{one.name}, {1e6 * one.surface.volume:.4g} cm3"
            plotter.add_text(words, position="upper_left", font_size=12, color="black")
            middle = 0.5 * (one.surface.points.min(axis=0) + one.surface.points.max(axis=0))
            plotter.camera_position = [
                middle + 10.0 * spans.max() * towards, middle, [0.0, 1.0, 0.0]
            ]  # fmt: skip
            plotter.camera.parallel_projection = True
            plotter.camera.parallel_scale = 0.5 * row * pixel
            plotter.reset_camera_clipping_range()
        image = Image.fromarray(np.asarray(plotter.screenshot(return_img=True)))
    finally:
        plotter.close()
    path = Path(path)
    write_atomically(path, lambda stream: image.save(stream, format="PNG"))
    return path
