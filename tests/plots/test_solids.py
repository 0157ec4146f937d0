"""Pictures of solid links and machines in space: what is drawn is what is there."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from runs import ROOT

import dolfinopt as do
from dolfinopt.mesh.checks import cell_volumes
from dolfinopt.multibody.spatial.end_effector import end_effector
from dolfinopt.multibody.spatial.kinematics import body_frames
from dolfinopt.output.views import AROUND, ArmView, designed
from dolfinopt.part.isosurface import surface_at

pytest.importorskip("pyvista")
from dolfinopt.plots import (
    solid_animation,
    solid_design,
    solid_machine,
    solid_stress,
    solids,
)

pytestmark = pytest.mark.serial
CELLS, SIZE = (20, 4, 2), np.array([0.5, 0.1, 0.05])


def link(density):
    """Return the view of a box 0.5 x 0.1 x 0.05 m, its density a function of centroids (n, 3)."""
    start = np.stack(np.meshgrid(*map(np.arange, CELLS), indexing="ij"), axis=-1).reshape(-1, 3)
    unit = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1)
    corners = (start[:, None] + unit.transpose(2, 1, 0, 3).reshape(8, 3)) / CELLS * SIZE
    corners[..., 1:] -= 0.5 * SIZE[1:]
    centroid = corners.mean(axis=1)
    modes = corners[..., None] * [1.0, 2.0]
    return ArmView(
        "link", corners[:, AROUND[8, 3]], centroid, density(centroid), modes[:, AROUND[8, 3]]
    )


def drawn_area(view):
    """Return the area that a link's material covers in the picture, m2."""
    camera, scale = solid_design.camera_of_links(), 1000.0
    studio = solid_design.link_studio(view, camera, scale)
    studio.solid(solids.material(view), solids.STEEL)
    return float((studio.close() < 250).any(axis=-1).sum()) / scale**2


def box_area(size):
    """Return the projected area of a box, m2."""
    back = solid_design.camera_of_links().back
    return float(np.abs(back) @ [size[1] * size[2], size[0] * size[2], size[0] * size[1]])


def test_projected_area_of_a_link():
    """A full box covers the sum of its faces' projections, half of it half as much."""
    assert drawn_area(link(lambda x: np.ones(len(x)))) == pytest.approx(box_area(SIZE), rel=0.01)
    half = link(lambda x: (x[:, 0] < 0.25).astype(float))
    # The nodes at the border have density 1/2, half way between those of the cells.
    expected = box_area(SIZE * [0.5, 1.0, 1.0])
    assert drawn_area(half) == pytest.approx(expected, rel=0.05)
    assert drawn_area(link(lambda x: np.full(len(x), 0.4))) == 0.0


def test_caption_of_a_link():
    words = solid_design.caption(link(lambda x: np.full(len(x), 0.4)), 1.25)
    assert words == (
        "link   500 x 100 x 50 mm, volume 1000 cm3 (40 %), mass 1.25 kg, no density above 0.5"
    )


def test_surface_carries_fields_and_cells():
    """Fields that are linear in space stay so on the surface; every triangle knows its cell."""
    view = link(lambda x: 1.2 * (1.0 - x[:, 0] / SIZE[0]))
    surface = solids.material(view, modes=True)
    points = surface.points
    assert surface.fields["modes"] == pytest.approx(points[..., None] * [1.0, 2.0], abs=1e-6)
    middle = surface.corners.mean(axis=1)
    away = np.abs(middle - view.centroid[surface.cells]) * CELLS / SIZE
    assert away.max() <= 0.5 + 1e-5


def test_surface_at_a_level():
    view = link(lambda x: 1.2 * (1.0 - x[:, 0] / SIZE[0]))
    corners = view.corners[:, AROUND[8, 3]]
    surface = surface_at(corners, view.density, 0.5)
    total = cell_volumes(corners).sum()
    assert surface.volume == pytest.approx(total * (1.0 - 0.5 / 1.2), rel=1e-3)


@pytest.fixture(scope="module")
def result():
    """A simulation of coarse solid links."""
    changes = ("arms.link1.cells=[8,2,2]", "arms.link2.cells=[8,2,2]", "arms.passive=0.06",
               "simulation.sample=0.01")  # fmt: skip
    model = do.Model(do.load_scene(ROOT / "demos" / "spatial_arm.toml", changes))
    return model.simulate(stress=True)


def test_frames_lead_to_the_end_effector(result):
    one = result.trajectory
    frames = body_frames(one.mechanism, one.q_r, one.q_e)
    end = end_effector(one.mechanism, one.motion, one.q_e)
    assert np.abs(one.q_e).max() > 0.01  # it bends
    assert frames.outboard[:, one.mechanism.end] == pytest.approx(end, abs=1e-14)
    assert frames.axes[:, 0] == pytest.approx(np.tile([0.0, 0.0, 1.0], (len(end), 1)))
    # The shoulder's axis is horizontal and turns with the yaw.
    yaw = one.q_r[:, 0]
    flat = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=1)
    assert frames.axes[:, 1] == pytest.approx(flat, abs=1e-14)


def test_picture_of_a_machine_in_space(result):
    """The payload of every pose is where its instant says, the links lead there."""
    one = result.trajectory
    machine = solid_machine.assemble(result.views, one.mechanism)
    frames = body_frames(one.mechanism, one.q_r, np.zeros_like(one.q_e))
    camera = solid_machine.camera_of(machine, frames)
    low, high = solid_machine.seen_part(machine, frames, camera)
    studio = solids.Studio(camera, low, high, 300.0)
    solid_machine.draw_pose(studio, machine, frames, len(one.t) - 1)
    image = studio.close().astype(int)

    def colour_at(point):
        x, y = (camera.plane(point) - low) * 300.0
        return image[image.shape[0] - 1 - round(y), round(x)]

    red, _, blue = colour_at(frames.outboard[-1, one.mechanism.end])
    assert red > 2 * blue  # orange
    for k in (1, 2):
        red, _, blue = colour_at(0.5 * (frames.origin[-1, k] + frames.outboard[-1, k]))
        assert blue > red  # steel
    assert (colour_at(frames.outboard[0, one.mechanism.end]) > 250).all()  # nothing is left there


def test_figures_of_a_model_in_space(result):
    assert len(designed(result.views)) == 2
    assert len(result.plot_design().axes) == 2
    figure = result.plot_machine()
    words = [text.get_text() for text in figure.axes[0].texts]
    assert len(result.plot_stress().axes) == 3  # and the colour scale
    assert "0.000 s" in words and "0.600 s" in words


def test_colours_of_stress():
    """The half with the larger stress is drawn darker; the caption tells where it is."""
    view = link(lambda x: np.ones(len(x)))
    stress = np.where(view.centroid[:, 0] < 0.25, 1e6, 9e7)
    stress[7] = 1e8
    view = replace(view, stress=stress, stress_instant=np.full(len(stress), 0.25))
    x, y, z = 1e3 * view.centroid[7]
    assert solid_stress.stress_caption(view) == (
        f"link   largest 100 MPa at x = {x:.4g}, y = {y:.4g}, z = {z:.4g} mm, t = 0.25 s"
    )
    (panel, scale) = solid_stress.solid_stress_figure([view], "title").axes
    assert scale.get_xlim() == (0.0, 100.0)
    image = np.asarray(panel.images[0].get_array()).astype(int)
    camera, extent = solid_design.camera_of_links(), panel.images[0].get_extent()

    def colour_at(point):
        x, y = camera.plane(np.array(point)) - [extent[0], extent[2]]
        size = image.shape[1] / (extent[1] - extent[0])
        return image[image.shape[0] - 1 - round(y * size), round(x * size)]

    calm, strained = colour_at([0.2, 0.0, 0.025]), colour_at([0.4, 0.0, 0.025])
    assert calm[1] > 200 > 60 > strained[1]  # light yellow, dark red


def test_film_in_space(result, tmp_path):
    """Surfaces end at the interfaces of the magnified machine; every frame is another picture."""
    from PIL import Image

    one = result.trajectory
    args = (result.views, one.mechanism, one.t, one.q_r, one.q_e)
    film = solid_animation.make_solid_film(*args, magnification=2.0, frames=4)
    stage = solid_animation.SolidStage(film, 0.1)
    try:
        for i in (1, 2):
            points = stage.rest[i][0]
            outer = points[:, 0] > points[:, 0].max() - 1e-6
            for n in range(4):
                end = stage.surface_points(i, n)[outer]
                middle = 0.5 * (end.min(axis=0) + end.max(axis=0))
                assert middle == pytest.approx(film.frames.outboard[n, i], abs=2e-3)
    finally:
        stage.close()
    bent = film.trace - film.desired
    assert np.abs(bent - 2.0 * one.deviation).max() < 0.1 * np.abs(bent).max()
    path = solid_animation.draw_solid_motion(tmp_path / "motion.gif", *args, frames=4)
    with Image.open(path) as found:
        assert found.n_frames == 4
        images = []
        for n in range(4):
            found.seek(n)
            images.append(np.asarray(found.convert("RGB")).astype(int))
    for before, after in pairwise(images):
        assert (np.abs(after - before).sum(axis=2) > 60).mean() > 0.01
