"""Pictures of the plane and of curves: the arrays that are drawn, and that something is seen."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from bodies import plane_body, plane_chain
from machines import GAINS, controlled, loop
from mpi4py import MPI
from PIL import Image

import dolfinopt as do
from dolfinopt.multibody.closures import Loops
from dolfinopt.multibody.kinematics import end_effector
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.output.design import ArmView
from dolfinopt.plots import curves, design, machine
from dolfinopt.responses.constraints import Limit
from dolfinopt.scene.load import scene_from_dict

pytestmark = pytest.mark.serial  # one rank shows all there is

LENGTHS = (1.0, 0.7, 0.4)  # m


def beam(name, length, height, nx, ny):
    """Return rectangles, solid above the axis, with modes u = (x, 0) and u = (-2 x y, x^2)."""
    x = np.linspace(0.0, length, nx + 1)
    y = np.linspace(-0.5 * height, 0.5 * height, ny + 1)
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    around = [nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]]
    corners = np.stack(around, axis=2).reshape(-1, 4, 2)
    x, y = corners[..., 0], corners[..., 1]
    stretch, bend = np.stack([x, 0 * x], axis=-1), np.stack([-2 * x * y, x**2], axis=-1)
    centroid = corners.mean(axis=1)
    density = (centroid[:, 1] > 0.0).astype(float)
    return ArmView(name, corners, centroid, density, np.stack([stretch, bend], axis=-1))


def body(outboard, length):
    """Return a body of which only what places it in the plane has a meaning."""
    q = outboard.shape[1]
    none = np.zeros((q, q))
    return plane_body(
        mass=1.0, moment=np.zeros(2), inertia=1.0, C=np.zeros((2, q)), j=np.zeros(q),
        r=np.zeros(q), M=np.eye(q), G=none, K=np.eye(q), D=none, outboard=outboard,
        outboard_point=np.array([length, 0.0]),
    )  # fmt: skip


def beam_body(length):
    return body(np.array([[length, 0.0], [0.0, length**2], [0.0, 2.0 * length]]), length)


def manipulator(arms):
    lengths = LENGTHS[:arms]
    views = [beam(f"arm{k}", length, 0.06, 20, 4) for k, length in enumerate(lengths)]
    bodies = tuple(beam_body(length) for length in lengths)
    return views, plane_chain(bodies, 6.0, 0.0, (0.0, 0.0), joint_height=-0.5)


def motion(mechanism, t, q_r, q_e, desired=None, closure=None):
    """Return what pictures ask of a trajectory."""
    end = end_effector(mechanism, still(q_r), q_e)
    return SimpleNamespace(
        scene=SimpleNamespace(dimension=2), mechanism=mechanism, t=t, q_r=q_r, q_e=q_e,
        desired=still(q_r if desired is None else desired), is_machine=desired is not None,
        loops=None if closure is None else Loops((closure,)), end=end,
    )  # fmt: skip


def swinging(mechanism):
    """Return a motion; the deviation is some centimetres."""
    arms = len(mechanism.bodies)
    t = np.linspace(0.0, 2.0, 41)
    q_r = np.column_stack([0.3 * t] + [0.9 * np.cos(t + k) for k in range(arms)])
    return motion(mechanism, t, q_r, 0.01 * np.sin(np.outer(t, 2.0 + np.arange(2 * arms))))


def still(q):
    return RigidMotion(q, np.zeros_like(q), np.zeros_like(q))


def shown(figure):
    """Return a figure's pixels (height, width, 3); nothing may be beyond its edges, nor blank."""
    figure.canvas.draw()
    box, (width, height) = figure.get_tightbbox(), figure.get_size_inches()
    assert min(box.x0, box.y0) >= 0.0 and box.x1 <= width and box.y1 <= height
    image = np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)
    assert np.ptp(image) > 200
    return image


def test_magnification_is_round_from_1_to_100_and_turns_ends_no_further_than_arms_do():
    for largest, expected in ((0.0556, 5.0), (0.00775, 20.0), (1.0, 1.0), (1e-6, 100.0), (0, 1.0)):
        assert machine.round_magnification(largest, 2.0) == expected
    for turn, expected in ((0.01, 20.0), (0.04, 10.0), (1.0, 1.0)):
        assert machine.round_magnification(0.00775, 2.0, turn) == expected
    for share in np.geomspace(1.2e-3, 0.05, 40):  # the deviation is about a tenth of the size
        magnified = machine.round_magnification(share * 0.7, 0.7) * share
        assert 0.1 / np.sqrt(2.6) < magnified < 0.1 * np.sqrt(2.6)


def test_design_shows_each_density_in_its_place():
    """Regions and joint axes too: that of the outboard joint is not the mesh's end."""
    views = [beam("upper", 1.1, 0.2, 20, 4), beam("lower", 0.6, 0.1, 10, 2)]
    square = np.array([[0.2, -0.3], [0.3, -0.3], [0.3, 0.05], [0.2, 0.05]])
    views[0] = replace(views[0], length=1.0, regions=(("solid", square),))
    figure = design.design_figure(views, "half and half")
    image = shown(figure)
    *rows, scale = figure.axes
    for axes, view in zip(rows, views, strict=True):
        places = axes.transData.transform(view.centroid).astype(int)
        pixels = image[image.shape[0] - 1 - places[:, 1], places[:, 0]]
        expected = np.where(view.density[:, None] == 1.0, [8, 29, 88], [255, 255, 217])
        away = np.abs(view.centroid - [0.25, 0.0]).max(axis=1) > 0.12  # from the region's border
        assert np.abs(pixels - expected)[away & (view.centroid[:, 0] > 0.05)].max() <= 3
    np.testing.assert_array_equal(rows[0].lines[0].get_xydata(), [[0.0, 0.0], [1.0, 0.0]])
    (region,) = rows[0].patches
    assert region.get_xy()[:, 1].min() == -0.1  # not beyond the arm
    (words,) = [text.get_text() for text in figure.legends[0].texts]
    assert "solid" in words
    assert "axis distance 1 m, 0.2 m high" in rows[0].get_title(loc="left")
    assert "[m]" in rows[1].get_xlabel() and "[m]" in rows[0].get_ylabel()
    assert scale.get_xlim() == (0.0, 1.0) and "density" in scale.get_xlabel()


def optimised(rows, label, unit, limits=()):
    """Return what the picture of a history asks of a result."""
    response = SimpleNamespace(label=label, unit=unit)
    scene = SimpleNamespace(objective=SimpleNamespace(response=response))
    return SimpleNamespace(rows=rows, scene=scene, limits=limits)


@pytest.mark.parametrize("count", [1, 400])
def test_history_shows_the_rows(count):
    rows = [HistoryRow(k, 28.0 * 0.9**k, 0.055 * 0.95**k, 1.0 / (k + 1), 0.5, 0.2, 0.1 * k)
            for k in range(count)]  # fmt: skip
    figure = curves.history_figure(optimised(rows, "compliance of the load cases", "N m"))
    panels = {axes.get_title(loc="left"): axes for axes in figure.axes}
    columns = {
        "compliance of the load cases [N m]": [r.objective for r in rows],
        "maximal deviation [mm]": [1e3 * r.max_deviation for r in rows],
        "grayness [-]": [r.grayness for r in rows],
        "volume fraction [-]": [r.volume_fraction for r in rows],
        "largest change of the design [-]": [r.change for r in rows],
    }
    assert set(panels) >= set(columns)
    for title, values in columns.items():
        np.testing.assert_allclose(panels[title].lines[0].get_ydata(), values)
        np.testing.assert_array_equal(panels[title].lines[0].get_xdata(), np.arange(count))
        linear = title in ("grayness [-]", "volume fraction [-]")
        assert panels[title].get_yscale() == ("linear" if linear else "log")
    assert len({axes.get_xlim() for axes in panels.values()}) == 1
    assert {axes.get_xlabel() for axes in panels.values()} == {"iteration"}
    shown(figure)


def test_history_has_a_panel_for_every_column_there_is():
    """Constraints by name, a residual: as the rows have them; limits in mm and MPa."""
    some = 2.0, 0.01, 0.5, 0.5, 0.1, 1.0
    limits = [
        Limit("first_frequency", "arm1", 60.0, 80.0, "Hz", True),
        Limit("deviation", "", 0.02, 0.008, "m"),
        Limit("stress", "", 90e6, 60e6, "Pa"),
    ]
    values = {limit.name: limit.value for limit in limits}
    rows = [HistoryRow(k, *some, 10.0**-k, constraints=values) for k in range(3)]
    figure = curves.history_figure(optimised(rows, "objective", "N m", limits))
    panels = {axes.get_title(loc="left"): axes for axes in figure.axes}
    residual = panels["Karush-Kuhn-Tucker residual [-]"].lines[0].get_ydata()
    np.testing.assert_allclose(residual, [1.0, 0.1, 0.01])
    assert "maximal deviation [mm]" not in panels
    for label, value, limit in (
        ("first frequency of arm1 [Hz]", 60.0, 80.0),
        ("deviation [mm]", 20.0, 8.0),
        ("stress [MPa]", 90.0, 60.0),
    ):
        np.testing.assert_allclose(panels[label].lines[0].get_ydata(), value)
        np.testing.assert_allclose(panels[label].collections[0].get_segments()[0][:, 1], limit)


def test_deviation_shows_millimetres_and_names_the_largest():
    t = np.linspace(0.0, 3.0, 301)
    limits = SimpleNamespace(limit={"deviation": 0.01}.get)
    scene = SimpleNamespace(constraints=limits, lead=1.9, horizon=3.0)

    def figure_of(deviation, factor):
        distance = np.linalg.norm(deviation, axis=1)
        moving = SimpleNamespace(
            t=t, distance=distance, scene=scene, closure=None, is_machine=False
        )
        return curves.deviation_figure(moving, factor * deviation)

    figure = figure_of(0.007 * np.sin(t)[:, None] * [0.6, 0.8], 8.0)
    (axes,) = figure.axes
    notes = axes.get_legend().texts
    for line, note, largest in zip(axes.lines, notes, (56.0, 7.0), strict=True):
        np.testing.assert_allclose(line.get_ydata(), largest * np.sin(t))
        assert line.get_markevery() == [157]
        assert f"largest {largest:g} mm at 1.570 s" in note.get_text()
    (limit,) = axes.collections[0].get_segments()
    np.testing.assert_allclose(limit, [[1.9, 10.0], [3.0, 10.0]])
    assert "[s]" in axes.get_xlabel() and "[mm]" in axes.get_ylabel()
    for size in (1e-7, 0.3, 50.0):  # m
        deviation = size * np.stack([np.sin(7.0 * t), np.cos(7.0 * t) - 1.0], axis=1)
        shown(figure_of(deviation, 1.3))


def test_motion_shows_the_payload_where_it_is(tmp_path):
    views, mechanism = manipulator(2)
    moving = swinging(mechanism)
    film = machine.make_film(moving, frames=4)
    path = machine.draw_motion(tmp_path / "motion.gif", views, film)
    assert [p.name for p in tmp_path.iterdir()] == ["motion.gif"]
    axes = machine.film_stage(views, film, 1.0).axes
    with Image.open(path) as gif:
        assert (gif.n_frames, gif.info["duration"], gif.info["loop"]) == (4, 1500, 0)
        pictures = []
        for frame in range(4):
            gif.seek(frame)
            picture = np.asarray(gif.convert("RGB")).astype(int)
            pictures.append(picture)
            assert (picture[0, 0] == 255).all()
            x, y = axes.transData.transform(film.bent.end[frame])
            pixel = picture[round(len(picture) - y), round(x)]
            assert np.abs(pixel - [217, 95, 2]).max() <= 16
    assert (pictures[3] != pictures[0]).any(axis=2).sum() > 1000


@pytest.mark.slow
def test_drives_have_a_row_each_and_the_ground_one():
    titles = {}
    tree = {key: value for key, value in controlled().to_tree().items() if key != "control"}
    cases = {
        "control": controlled(),
        "loop": loop(control={"stiffness": [2e3], "damping": [20.0]}),
        "pin": loop("pin"),
        "soft": scene_from_dict(tree, overrides=["arms.joint_stiffness=2e4"]),
    }
    for name, scene in cases.items():
        trajectory = do.Model(scene, comm=MPI.COMM_SELF).simulate().trajectory
        figure = curves.drives_figure(trajectory)
        titles[name] = [axes.get_title(loc="left") for axes in figure.axes]
        shown(figure)
        if name == "control":
            error = 1e3 * (trajectory.q_r - trajectory.desired.q)[:, 0]
            np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), error, atol=1e-9)
            force = trajectory.joint_forces[:, 0]
            np.testing.assert_allclose(figure.axes[1].lines[0].get_ydata(), force)
            assert figure.axes[1].get_title(loc="right") == f"largest {np.abs(force).max():.3g}"
    assert titles["control"][:2] == ["cart: error [mm]", "cart: force [N]"]
    assert len(titles["control"]) == 2 * len(GAINS["stiffness"])
    assert titles["loop"][1:] == ["crank: moment [N m]", "closure: force [N]"]
    assert titles["pin"] == ["crank: moment [N m]", "closure: force [N]"]
    # A cart that follows the desired motion exactly has no error to be shown.
    assert titles["soft"][0] == "cart: force [N]" and len(titles["soft"]) == 5
