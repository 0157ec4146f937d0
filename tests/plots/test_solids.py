"""Pictures of solid links and machines in space: what is drawn is what is there."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image
from runs import ROOT

import dolfinopt as do
from dolfinopt.mesh.solid_cells import TENSOR
from dolfinopt.output.design import ArmView, designed
from dolfinopt.plots import machine, solid
from dolfinopt.plots.design import design_figure
from dolfinopt.plots.poses import body_poses
from dolfinopt.plots.style import DPI, new_figure

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
    view = ArmView("link", corners, centroid, density(centroid), modes)
    return replace(view, corners=corners[:, TENSOR[8, 3]], modes=modes[:, TENSOR[8, 3]])


def test_projected_area_of_a_link():
    """A full box covers the sum of its faces' projections, half of it half as much."""

    def drawn(view):
        axes = new_figure(7.0, 6.0).add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set(xlim=(-0.1, 0.6), ylim=(-0.3, 0.3))
        studio, px_per_m = solid.Studio(solid.LINKS, axes), 10.0 * DPI
        studio.solid(solid.material(view), color=solid.STEEL)
        return float((studio.close() < 250).any(axis=-1).sum()) / px_per_m**2

    def expected(x, y, z):
        return float(np.abs(solid.LINKS.back) @ [y * z, x * z, x * y])

    assert drawn(link(lambda x: np.ones(len(x)))) == pytest.approx(expected(*SIZE), rel=0.01)
    half = link(lambda x: (x[:, 0] < 0.25).astype(float))
    # The nodes at the border have density 1/2, half way between those of the cells.
    assert drawn(half) == pytest.approx(expected(*(SIZE * [0.5, 1.0, 1.0])), rel=0.05)
    assert drawn(link(lambda x: np.full(len(x), 0.4))) == 0.0


def test_picture_of_a_link():
    """Its caption has size, volume and mass; a length stands below its lower front edge."""
    view = link(lambda x: np.full(len(x), 0.6))
    figure = design_figure([view], "title", {"link": 1.25})
    (axes,) = figure.axes
    words = axes.get_title(loc="left")
    assert words == "link:  500 x 100 x 50 mm, volume 1500 cm3 (60 %), mass 1.25 kg"
    assert "no density above 0.5" in solid.caption(link(lambda x: 0.0 * x[:, 0]), None)
    (length,) = [text for text in axes.texts if text.get_text()[:1].isdigit()]
    assert length.get_text() == "100 mm"
    corner = solid.LINKS.plane(np.array([0.0, -0.05, 0.025]))
    assert length.get_position()[0] == pytest.approx(corner[0] + 0.05)
    assert length.get_position()[1] < corner[1]
    box = figure.get_tightbbox()
    assert box.x0 >= 0.0 and box.x1 <= figure.get_figwidth()


@pytest.fixture(scope="module")
def result():
    """A simulation of coarse solid links, the second on a bearing that gives way."""
    changes = ("arms.link1.cells=[8,2,2]", "arms.link2.cells=[8,2,2]", "arms.passive=0.06",
               "simulation.sample=0.01",
               "joints.elbow.bearing_stiffness=[1e7,1e7,1e7,1e5,1e5,0]")  # fmt: skip
    model = do.Model(do.load_scene(ROOT / "demos" / "spatial_arm.toml", changes))
    return model.simulate(stress=True)


def test_picture_of_a_machine_in_space(result):
    """The payload of a pose is where its instant says, the links lead there."""
    one = result.trajectory
    poses = body_poses(one.mechanism, one.q_r, np.zeros_like(one.q_e))
    stage = machine.stage(result.views, poses, [], "title")
    try:
        stage.pose(len(one.t) - 1)
        stage.render()
    finally:
        stage.close()
    image = np.asarray(stage.axes.images[0].get_array()).astype(int)
    left, right, low, _ = stage.axes.images[0].get_extent()

    def colour_at(point):
        x, y = stage.flat(point)
        px = image.shape[1] / (right - left)
        return image[image.shape[0] - 1 - round((y - low) * px), round((x - left) * px)]

    red, _, blue = colour_at(poses.end[-1])
    assert red > 2 * blue  # orange
    for k in (1, 2):
        red, _, blue = colour_at(0.5 * (poses.origin[-1, k] + poses.outboard[-1, k]))
        assert blue > red  # steel
    assert (colour_at(poses.end[0]) > 250).all()  # nothing is there


def test_figures_of_a_model_in_space(result):
    assert len(designed(result.views)) == 2
    assert len(result.plot_design().axes) == 2
    axes = result.plot_machine().axes[0]
    words = [text.get_text() for text in axes.texts]
    assert {"0.000 s", "0.600 s", "x", "y", "z"} <= set(words)
    assert any(word.endswith(" mm") for word in words)
    assert np.ptp(np.asarray(axes.images[0].get_array())) > 150
    assert len(result.plot_stress().axes) == 3  # and the colour scale


def test_film_in_space(result, tmp_path):
    """Surfaces end at the interfaces of the magnified machine; every frame is another picture."""
    one = result.trajectory
    film = machine.make_film(one, magnification=2.0, frames=4)
    for i in (1, 2):
        surface = solid.material(result.views[i], modes=True)
        outer = surface.points[:, 0] > surface.points[:, 0].max() - 1e-6
        for n in range(4):
            points = film.bent.material(surface.points, surface.fields["modes"], i, n)[outer]
            middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
            assert middle == pytest.approx(film.bent.outboard[n, i], abs=2e-3)
    bent = film.trace - film.desired
    assert np.abs(bent - 2.0 * one.deviation).max() < 0.1 * np.abs(bent).max()
    path = machine.draw_motion(tmp_path / "motion.gif", result.views, film)
    with Image.open(path) as found:
        assert found.n_frames == 4
        images = []
        for n in range(4):
            found.seek(n)
            images.append(np.asarray(found.convert("RGB")).astype(int))
    dark = images[0].sum(axis=2) < 150
    assert dark.sum(axis=0).max() < 0.2 * len(dark)  # no frame about what has a ruler
    for before, after in pairwise(images):
        assert (np.abs(after - before).sum(axis=2) > 60).mean() > 0.01
