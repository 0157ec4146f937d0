"""Pictures: the arrays that are drawn, and that something of them arrives in the files."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpi4py import MPI
from PIL import Image
from runs import ROOT, TWO_ARM

import dolfinopt as do
from dolfinopt.multibody.end_effector import end_effector
from dolfinopt.multibody.mechanism import Closure, Mechanism, pin, slider
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, plane_body
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.output.views import ArmView
from dolfinopt.plots import animation, curves, design, loops, machine, page, shapes, stress, style

pytestmark = pytest.mark.serial  # one rank shows all there is

LENGTHS = (1.0, 0.7, 0.4)  # m


def beam(name: str, length: float, height: float, nx: int, ny: int) -> ArmView:
    """Return an arm of nx x ny rectangles, solid above its axis and void below.

    Its modes are u = (x, 0), the stretch, and u = (-2 x y, x^2), the bend.
    """
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


def beam_body(length: float) -> ShapeIntegrals:
    """Return the body of `beam`; only what places it in the plane has a meaning."""
    none = np.zeros((2, 2))
    return plane_body(
        mass=1.0,
        moment=np.zeros(2),
        inertia=1.0,
        C=none,
        j=np.zeros(2),
        r=np.zeros(2),
        M=np.eye(2),
        G=none,
        K=np.eye(2),
        D=none,
        outboard=np.array([[length, 0.0], [0.0, length**2], [0.0, 2.0 * length]]),
        outboard_point=np.array([length, 0.0]),
    )


def manipulator(arms: int, payload: float = 6.0) -> tuple[list[ArmView], Mechanism]:
    lengths = LENGTHS[:arms]
    views = [beam(f"arm{k}", length, 0.06, 20, 4) for k, length in enumerate(lengths)]
    bodies = tuple(beam_body(length) for length in lengths)
    return views, Mechanism(bodies, payload, 0.0, (0.0, 0.0), joint_height=-0.5)


def swinging(arms: int, count: int = 41) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return instants, rigid and elastic coordinates; the deviation is some centimetres."""
    t = np.linspace(0.0, 2.0, count)
    q_r = np.column_stack([0.3 * t] + [0.9 * np.cos(t + k) for k in range(arms)])
    q_e = 0.01 * np.sin(np.outer(t, 2.0 + np.arange(2 * arms)))
    return t, q_r, q_e


def still(q: np.ndarray) -> RigidMotion:
    return RigidMotion(q, np.zeros_like(q), np.zeros_like(q))


# -- numbers ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "expected"),
    [(1.0, 1.0), (1.3, 1.0), (1.5, 2.0), (3.1, 2.0), (3.3, 5.0), (7.0, 5.0), (7.2, 10.0)],
)
@pytest.mark.parametrize("decade", [1e-3, 1.0, 1e4])
def test_round_number(value, expected, decade):
    assert style.round_number(value * decade) == pytest.approx(expected * decade)


@pytest.mark.parametrize(
    ("largest", "size", "expected"),
    [
        (0.0556, 2.0, 5.0),
        (0.00775, 2.0, 20.0),
        (1.0, 2.0, 1.0),
        (1e-6, 2.0, 100.0),
        (0.0, 2.0, 1.0),
    ],
)
def test_magnification_is_round_and_at_least_one(largest, size, expected):
    assert animation.round_magnification(largest, size) == pytest.approx(expected)


def test_magnified_ends_turn_no_further_than_arms_do():
    assert animation.round_magnification(0.00775, 2.0, 0.01) == 20.0
    assert animation.round_magnification(0.00775, 2.0, 0.04) == 10.0
    assert animation.round_magnification(0.00775, 2.0, 1.0) == 1.0


@given(st.floats(1.2e-3, 0.05), st.floats(0.1, 10.0))
def test_magnified_deviation_is_about_a_tenth_of_the_size(share, size):
    magnification = animation.round_magnification(share * size, size)
    assert 0.1 / np.sqrt(2.6) < magnification * share < 0.1 * np.sqrt(2.6)


def test_ticks_are_round_and_inside():
    np.testing.assert_allclose(style.ticks(0.0, 1.0), np.linspace(0.0, 1.0, 11))
    np.testing.assert_allclose(style.ticks(-0.05, 1.07, 5), np.linspace(0.0, 1.0, 6))
    assert "-0" not in [f"{tick:g}" for tick in style.ticks(-1e-17, 1.0)]


def test_areas_of_triangle_and_quadrilateral():
    triangle = np.array([[[0, 0], [2, 0], [0, 3]]], dtype=float)
    square = np.array([[[0, 0], [0, 2], [2, 2], [2, 0]]], dtype=float)  # clockwise
    assert shapes.cell_areas(triangle) == pytest.approx([3.0])
    assert shapes.cell_areas(square) == pytest.approx([4.0])


def test_volume_fraction_weighs_with_area():
    corners = np.array([[[0, 0], [3, 0], [3, 1], [0, 1]], [[3, 0], [4, 0], [4, 1], [3, 1]]], float)
    view = ArmView("a", corners, corners.mean(axis=1), np.array([1.0, 0.2]), np.zeros((2, 4, 2, 0)))
    assert shapes.volume_fraction(view) == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("values", "log"), [((28.0, 2.5), True), ((55.0, 7.0), False), ((1.0, 0.0), False)]
)
def test_log_scale_beyond_a_decade(values, log):
    assert style.spans_decade(np.array(values)) is log


# -- designs ---------------------------------------------------------------------------------

SLENDER, FAT = (1.0, 0.06), (1.0, 1.2)


@pytest.mark.parametrize("arms", [1, 2, 6])
@pytest.mark.parametrize("size", [SLENDER, FAT])
def test_arms_stand_below_each_other_on_the_page(arms, size):
    views = [beam("a", size[0] / (k + 1), size[1] / (k + 1), 4, 2) for k in range(arms)]
    layout = page.stack_arms([view.corners for view in views])
    placed = [layout.place(k, view.corners) for k, view in enumerate(views)]
    lows, highs = (np.array([f(p, axis=(0, 1)) for p in placed]) for f in (np.min, np.max))
    assert np.allclose(lows[:, 0], page.MARGIN)
    assert (highs[:, 0] <= layout.width - page.MARGIN + 1.0).all()
    assert (lows[:-1, 1] - highs[1:, 1] >= page.LABEL - 1.0).all()  # room for each name
    assert lows[-1, 1] >= page.FOOT - 1.0
    assert highs[0, 1] <= layout.height - page.HEAD - page.LABEL + 1.0
    assert np.allclose(
        highs - lows, layout.scale * np.array(size) / np.arange(1, arms + 1)[:, None]
    )
    if size == SLENDER:
        assert highs[0, 0] == pytest.approx(layout.width - page.MARGIN, abs=1.0)


@pytest.mark.serial
def test_design_shows_each_density_in_its_place(tmp_path):
    from matplotlib import colormaps
    from matplotlib.image import imread

    views = [beam("upper", 1.0, 0.2, 20, 4), beam("lower", 0.6, 0.1, 10, 2)]
    path = design.draw_design(tmp_path / "design.png", views, "half and half")
    assert [p.name for p in tmp_path.iterdir()] == ["design.png"]
    image = imread(path)[..., :3]
    layout = page.stack_arms([view.corners for view in views])
    assert image.shape == (layout.height, layout.width, 3)
    for index, view in enumerate(views):
        for density in (0.0, 1.0):
            points = layout.place(index, view.centroid[view.density == density])
            shown = image[(layout.height - points[:, 1]).astype(int), points[:, 0].astype(int)]
            expected = colormaps[style.COLOURS](density)[:3]
            np.testing.assert_allclose(shown, np.tile(expected, (len(shown), 1)), atol=0.02)
    dark = image.max(axis=2) < 0.3
    ruler, scale = layout.height - int(layout.bottom), layout.height - 90
    assert dark[: int(page.HEAD)].sum() > 500  # title
    assert dark[ruler + 30 : ruler + 60].sum() > 500  # lengths in m
    assert dark[scale:, : layout.width // 2 + 200].sum() > 300  # what the colours mean
    frame = np.concatenate([image[:8].ravel(), image[:, :8].ravel(), image[:, -8:].ravel()])
    assert frame.min() == 1.0  # nothing runs over the edge


@pytest.mark.serial
def test_joint_axes_are_marked_where_they_are():
    """By black rings with white inside: the axis of the outboard joint is not the mesh's end."""
    view = replace(beam("with bores", 1.1, 0.2, 20, 4), length=1.0)
    image = page.image_of(design.design_page([view], "title"))
    layout = page.stack_arms([view.corners])
    for x, y in layout.place(0, np.array([[0.0, 0.0], [1.0, 0.0]])):
        row, column = int(layout.height - y), int(x)
        assert (image[row, column] > 240).all()
        ring = image[row - 8 : row + 9, column - 8 : column + 9]
        assert (ring.max(axis=2) < 30).sum() >= 20


@pytest.mark.serial
def test_figure_of_the_designs_is_the_picture():
    views = [beam("upper", 1.0, 0.2, 20, 4)]
    figure, image = (
        design.design_figure(views, "title"),
        page.image_of(design.design_page(views, "title")),
    )
    figure.canvas.draw()
    shown = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    assert shown.shape == image.shape
    np.testing.assert_allclose(shown.astype(int), image, atol=1)


@pytest.mark.serial
def test_captions_give_the_axis_distance():
    """Which is not the extent of an arm with bosses beyond its bores."""
    view = replace(beam("with bores", 1.1, 0.2, 20, 4), length=1.0)
    drawn = design.design_page([view], "title")
    drawn.close()
    (caption,) = [words for words in drawn.texts if words.startswith("with")]
    assert "axis distance 1 m, 0.2 m high" in caption


def test_stress_says_where_when_and_in_what_unit(tmp_path):
    """Largest value, place and instant above every arm; a scale of round numbers; a picture."""
    views = []
    for name, largest in (("arm1", 61e6), ("arm2", 40e6)):
        view = beam(name, 1.0, 0.1, 20, 4)
        s = largest * (1.0 - view.centroid[:, 0]) / (1.0 - view.centroid[0, 0])
        views.append(replace(view, stress=s, stress_instant=np.full(len(s), 0.75)))
    drawn = stress.stress_page(views, "two arms")
    drawn.close()
    assert any("arm1   largest 61 MPa at x = 0.025 m" in words for words in drawn.texts)
    assert any("arm2   largest 40 MPa" in words and "t = 0.75 s" in words for words in drawn.texts)
    assert stress.STRESS in drawn.texts and "[MPa]" in stress.STRESS
    marks = stress.scale_marks(61.0)
    assert marks.tolist() == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0]
    assert {f"{mark:g}" for mark in marks} <= set(drawn.texts)
    path = stress.draw_stress(tmp_path / "stress.png", views, "two arms")
    with Image.open(path) as image:
        shown = np.asarray(image.convert("RGB")).astype(int)
    red = (shown[..., 0] > 100) & (shown[..., 1] < 60)  # the darkest end of the scale
    assert 100 < red.sum() < 0.1 * red.size
    blue = (shown[..., 2] > shown[..., 0] + 80).sum()  # the ring around the place
    assert 20 < blue < 2000


@pytest.mark.parametrize("largest", [0.0, 0.9, 1.0, 3.3, 61.0, 99.0, 1234.0])
def test_marks_of_the_stress(largest):
    marks = stress.scale_marks(largest)
    assert 2 <= len(marks) <= 9 and marks[0] == 0.0
    assert largest <= marks[-1] * (1.0 + 1e-9) and marks[-1] <= max(1.6 * largest, 1.0)


def test_outline_is_what_one_cell_has_alone():
    view = beam("a", 2.0, 1.0, 5, 3)
    ends = shapes.outline(view.corners)
    assert len(ends) == 2 * (5 + 3)
    assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum() == pytest.approx(6.0)
    hole = np.delete(view.corners, 7, axis=0)
    assert len(shapes.outline(hole)) == 2 * (5 + 3) + 4


# -- curves ----------------------------------------------------------------------------------


def history(count: int) -> list[HistoryRow]:
    return [
        HistoryRow(k, 28.0 * 0.9**k, 0.055 * 0.95**k, 1.0 / (k + 1), 0.5, 0.2, 0.1 * k)
        for k in range(count)
    ]


def assert_inside(figure) -> None:
    """Check that nothing is drawn beyond the figure's edges."""
    figure.canvas.draw()
    box = figure.get_tightbbox()
    width, height = figure.get_size_inches()
    assert min(box.x0, box.y0) >= 0.0
    assert box.x1 <= width
    assert box.y1 <= height


@pytest.mark.serial
@pytest.mark.parametrize("count", [1, 2, 400])
def test_history_shows_the_rows(count):
    rows = history(count)
    figure = curves.history_figure(rows, "compliance of the load cases [N m]")
    shown = {axes.get_title(loc="left"): axes for axes in figure.axes if axes.get_visible()}
    drawn = {title: axes.lines[0].get_ydata() for title, axes in shown.items()}
    columns = {
        "compliance of the load cases [N m]": [r.objective for r in rows],
        "maximal deviation [mm]": [1e3 * r.max_deviation for r in rows],
        "grayness [-]": [r.grayness for r in rows],
        "volume fraction [-]": [r.volume_fraction for r in rows],
        "largest change of the design [-]": [r.change for r in rows],
    }
    assert set(drawn) >= set(columns)
    for title, values in columns.items():
        np.testing.assert_allclose(drawn[title], values)
        np.testing.assert_array_equal(shown[title].lines[0].get_xdata(), np.arange(count))
        linear = title in ("grayness [-]", "volume fraction [-]")
        assert shown[title].get_yscale() == ("linear" if linear else "log")
    assert len({axes.get_xlim() for axes in shown.values()}) == 1
    assert_inside(figure)


def test_history_has_a_panel_for_every_column_there_is():
    """Constraints by name, a residual: as the rows have them."""

    @dataclass(frozen=True)
    class Row(HistoryRow):
        kkt: float = 0.0
        constraints: dict = field(default_factory=dict)

    rows = [
        Row(k, 2.0, 0.01, 0.5, 0.5, 0.1, 1.0, 10.0**-k, {"first frequency of arm1 [Hz]": 60.0 + k})
        for k in range(3)
    ]
    panels = curves.history_panels(rows, "objective [N m]")
    np.testing.assert_allclose(panels["Karush-Kuhn-Tucker residual [-]"], [1.0, 0.1, 0.01])
    np.testing.assert_allclose(panels["first frequency of arm1 [Hz]"], [60.0, 61.0, 62.0])


@pytest.mark.serial
def test_limits_have_panels_in_millimetres_and_megapascals():
    found = {"deviation": 0.02, "stress": 90e6}
    rows = [HistoryRow(k, 2.0, 0.02, 0.5, 0.5, 0.1, 1.0, constraints=found) for k in range(3)]
    panels = curves.history_panels(rows, "mass of the arms [kg]")
    np.testing.assert_allclose(panels["deviation [mm]"], 20.0)
    np.testing.assert_allclose(panels["stress [MPa]"], 90.0)
    assert "maximal deviation [mm]" not in panels
    figure = curves.history_figure(rows, "mass", {"deviation": 0.008, "stress": 60e6})
    lines = {axes.get_title(loc="left"): axes.lines for axes in figure.axes if axes.get_visible()}
    assert set(lines["deviation [mm]"][1].get_ydata()) == {8.0}
    assert set(lines["stress [MPa]"][1].get_ydata()) == {60.0}


@pytest.mark.serial
@pytest.mark.parametrize("size", [1e-7, 1e-5, 0.3, 50.0])  # m
def test_the_picture_of_the_deviation_holds_its_labels(size):
    t = np.linspace(0.0, 3.0, 301)
    deviation = size * np.stack([np.sin(7.0 * t), np.cos(7.0 * t) - 1.0], axis=1)
    figure = curves.deviation_figure(t, deviation, 1.3 * deviation)
    figure.canvas.draw()
    width, height = figure.canvas.get_width_height()
    axes = figure.axes[0]
    for text in (axes.yaxis.label, axes.xaxis.label, axes.title, *axes.texts):
        box = text.get_window_extent()
        assert box.x0 >= 0.0 and box.y0 >= 0.0 and box.x1 <= width and box.y1 <= height


def test_deviation_shows_millimetres_and_names_the_largest_where_it_is():
    t = np.linspace(0.0, 3.0, 301)
    optimised = 0.007 * np.sin(t)[:, None] * [0.6, 0.8]
    figure = curves.deviation_figure(t, optimised, 8.0 * optimised)
    (axes,) = figure.axes
    for line, note, largest in zip(axes.lines, axes.texts, (56.0, 7.0), strict=True):
        np.testing.assert_allclose(line.get_ydata(), largest * np.sin(t))
        assert line.get_markevery() == [157]
        np.testing.assert_allclose(note.xy, (t[157], largest), rtol=1e-4)
        assert note.get_color() == line.get_color()
    assert [text.get_text() for text in axes.texts] == [
        "initial design: largest 56 mm at 1.570 s",
        "optimised design: largest 7 mm at 1.570 s",
    ]
    assert axes.get_title(loc="left")
    assert "[s]" in axes.get_xlabel()
    assert "[mm]" in axes.get_ylabel()
    assert_inside(figure)


@pytest.mark.serial
def test_curves_are_written(tmp_path):
    from matplotlib.image import imread

    t, nothing = np.linspace(0.0, 1.0, 11), np.zeros((11, 2))
    for path in (
        curves.draw_history(tmp_path / "history.png", history(3), "objective [N m]"),
        curves.draw_deviation(tmp_path / "deviation.png", t, nothing),
    ):
        image = imread(path)
        assert min(image.shape[:2]) >= 600
        assert np.ptp(image[..., :3]) > 0.9
    assert sorted(p.name for p in tmp_path.iterdir()) == ["deviation.png", "history.png"]


# -- motion ----------------------------------------------------------------------------------


@pytest.mark.parametrize("arms", [1, 2, 3])
def test_chain_ends_at_the_end_effector(arms):
    mechanism = manipulator(arms)[1]
    random = np.random.default_rng(arms)
    q_r, q_e = random.normal(size=(9, 1 + arms)), 0.2 * random.normal(size=(9, 2 * arms))
    place = shapes.chain(mechanism, q_r, q_e)[0]
    tip = np.stack([place[:, -1].real, place[:, -1].imag], axis=1)
    np.testing.assert_allclose(tip, end_effector(mechanism, still(q_r), q_e), atol=1e-14)


def test_undeformed_arms_lie_where_the_angles_say():
    views, mechanism = manipulator(2)
    q_r, q_e = np.array([[0.3, 0.5 * np.pi, -0.5 * np.pi]]), np.zeros((1, 4))
    film = animation.make_film(views, mechanism, np.zeros(1), q_r, q_e, None, 1)
    x, y = views[0].corners[..., 0], views[0].corners[..., 1]
    upright = np.stack([0.3 - y, -0.5 + x], axis=-1)
    np.testing.assert_allclose(film.cells(0, 0), upright, atol=1e-14)
    level = np.add(views[1].corners, [0.3, 0.5])
    np.testing.assert_allclose(film.cells(1, 0), level, atol=1e-14)


@pytest.mark.parametrize("magnification", [1.0, 20.0])
def test_magnified_arms_join(magnification):
    views, mechanism = manipulator(3)
    film = animation.make_film(views, mechanism, *swinging(3), magnification, 5)
    for frame in range(5):
        for k, view in enumerate(views):
            cells = film.cells(k, frame)
            for end, joint in ((0.0, k), (LENGTHS[k], k + 1)):
                axis = np.all(np.abs(view.corners - [end, 0.0]) < 1e-12, axis=-1)
                place = film.place[frame, joint]
                assert axis.any()
                np.testing.assert_allclose(
                    cells[axis], np.tile([place.real, place.imag], (axis.sum(), 1)), atol=1e-13
                )


def test_film_runs_from_the_first_to_the_last_instant():
    views, mechanism = manipulator(2)
    t, q_r, q_e = swinging(2)
    film = animation.make_film(views, mechanism, t, q_r, q_e, 1.0, 7)
    assert (film.t[0], film.t[-1], len(film.t)) == (t[0], t[-1], 7)
    flexible, rigid = (end_effector(mechanism, still(q_r), q) for q in (q_e, 0.0 * q_e))
    np.testing.assert_allclose(film.trace, flexible, atol=1e-14)
    np.testing.assert_allclose(film.desired, rigid, atol=1e-14)
    np.testing.assert_allclose(film.t, t[film.at])
    np.testing.assert_allclose(film.place[:, -1].real, flexible[film.at, 0], atol=1e-14)
    magnified = animation.make_film(views, mechanism, t, q_r, q_e, 3.0, 7).trace
    np.testing.assert_allclose(magnified, end_effector(mechanism, still(q_r), 3 * q_e), atol=1e-14)
    largest = np.linalg.norm(flexible - rigid, axis=1).max()
    chosen = animation.make_film(views, mechanism, t, q_r, q_e, None, 7).magnification
    assert chosen == animation.round_magnification(largest, sum(LENGTHS[:2]))
    assert len(animation.make_film(views, mechanism, t, q_r, q_e, 1.0, 1000).t) == len(t)


def test_bounds_hold_all_cells():
    views, mechanism = manipulator(2)
    views[0] = beam("plate", 1.0, 1.5, 20, 4)  # reaches far beyond joints and paths
    film = animation.make_film(views, mechanism, *swinging(2), 10.0, 9)
    low, high = animation.film_bounds(film)
    cells = [film.cells(k, frame).reshape(-1, 2) for k in range(2) for frame in range(9)]
    points = np.concatenate([*cells, film.trace, film.desired])
    assert (points > low).all()
    assert (points < high).all()
    assert (high - low < 1.2 * np.ptp(points, axis=0)).all()  # and no more than that


def test_fine_mesh_is_thinned_to_the_means_of_its_cells():
    fine, coarse = beam("a", 1.0, 0.3, 80, 24), beam("a", 1.0, 0.3, 20, 6)
    density = np.random.default_rng(1).random((80, 24))
    fine = replace(fine, density=density.ravel())
    drawing = shapes.draw_coarsely(fine, 20 * 6)
    assert drawing.border(0.0, 1.0, np.zeros(2)) is None  # the arm is a rectangle itself
    thinned = drawing.view
    np.testing.assert_allclose(thinned.corners, coarse.corners, atol=1e-12)
    np.testing.assert_allclose(thinned.modes, coarse.modes, atol=1e-12)
    means = density.reshape(20, 4, 6, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(thinned.density, means.ravel())
    assert shapes.draw_coarsely(coarse, 120).view is coarse


def plate_with_bore(rows: int = 40, *, clockwise: bool = False) -> ArmView:
    """Return a solid plate of fine cells around a bore, with rows of larger cells at its end."""
    fine, large = beam("", 1.0, 0.4, 100, 40), beam("", 0.2, 0.4, 2, rows)
    ring = np.linalg.norm(fine.centroid - [0.5, 0.0], axis=1) > 0.13
    rounded = np.linalg.norm(fine.centroid - [0.2, 0.0], axis=1) < 0.2
    kept = ring & (rounded | (fine.centroid[:, 0] > 0.2))
    corners = np.concatenate([fine.corners[kept], np.add(large.corners, [1.0, 0.0])])
    x, y = corners[..., 0], corners[..., 1]
    bend = np.stack([-2 * x * y, x**2], axis=-1)
    modes = np.stack([np.stack([x, 0 * x], axis=-1), bend], axis=-1)
    around = [3, 2, 1, 0] if clockwise else [0, 1, 2, 3]
    corners, modes = corners[:, around], modes[:, around]
    return ArmView("plate", corners, corners.mean(axis=1), np.ones(len(corners)), modes)


def edges_of(points: np.ndarray) -> set[frozenset[tuple[float, float]]]:
    """Return edges (n, 2, 2) as sets of their ends, to nine digits."""
    return {frozenset((float(x), float(y)) for x, y in one) for one in np.round(points, 9) + 0.0}


@pytest.mark.parametrize("clockwise", [False, True])
def test_coarse_cells_cover_the_arm_and_its_rim_clips_them(clockwise):
    """The rim is that of the fine mesh wherever the arm is, and however it has deformed."""
    import shapely

    view = plate_with_bore(clockwise=clockwise)
    drawing = shapes.draw_coarsely(view, 300)
    assert 200 < len(drawing.view.density) <= 300
    where = (0.3 - 0.5j, np.exp(0.7j), np.array([0.05, 0.2]))
    border, fine = drawing.border(*where), shapes.moved(view.corners, view.modes, *where)
    loops = border.to_polygons()
    assert len(loops) == 2
    drawn = np.concatenate([np.stack([loop[:-1], loop[1:]], axis=1) for loop in loops])
    assert edges_of(drawn) == edges_of(shapes.outline(fine))
    # Holes are left open by either rule of filling: they run the other way round.
    signed = [float(shapes.signed_areas(loop[None, :-1])[0]) for loop in loops]
    assert sorted(np.sign(signed)) == [-1.0, 1.0]
    assert sum(signed) == pytest.approx(shapes.cell_areas(fine).sum(), rel=1e-12)
    arm = shapely.union_all(shapely.polygons(view.corners))
    covered = shapely.union_all(shapely.polygons(drawing.view.corners)).intersection(arm)
    assert covered.area == pytest.approx(arm.area, rel=1e-9)
    assert shapes.draw_coarsely(view, len(view.density)).border(*where) is None


def test_rectangles_without_a_centroid_take_the_density_around_their_middle():
    """Where cells differ in size, it is not that of the nearest centroid."""
    view = plate_with_bore(4)
    density = np.zeros(len(view.density))
    density[-8:] = 0.25 + 0.05 * np.arange(8)  # the large cells of 0.1 m by 0.1 m
    thinned = shapes.draw_coarsely(replace(view, density=density), 72 * 24).view
    inside = thinned.corners[:, :, 0].min(axis=1) > 1.0
    assert inside.sum() > 8 * 10
    column, row = np.floor((thinned.centroid[inside] - [1.0, -0.2]) / 0.1).T
    np.testing.assert_allclose(thinned.density[inside], 0.25 + 0.05 * (4 * column + row))


def dark(picture: np.ndarray) -> np.ndarray:
    """Return where solid material is shown."""
    return np.abs(picture[..., :3].astype(int) - [8, 29, 88]).max(axis=-1) < 60


@pytest.mark.serial
def test_pictures_of_coarse_cells_have_the_arms_outline(monkeypatch):
    """In the machine's poses and in the animation: hardly a pixel differs from the fine mesh's."""
    view = plate_with_bore()
    mechanism = Mechanism((beam_body(1.2),), 6.0, 0.0, (0.0, 0.0), joint_height=-0.5)
    t, q_r, q_e = swinging(1)

    def pictures() -> list[np.ndarray]:
        figure = machine.machine_figure([view], mechanism, t, q_r, "plate")
        figure.canvas.draw()
        film = animation.make_film([view], mechanism, t, q_r, q_e, 20.0, 3)
        stage = animation.Stage(film, mechanism, 1.0)
        return [np.asarray(figure.canvas.buffer_rgba()), *map(stage.draw, range(3))]

    wanted = pictures()
    for module in (machine, animation):
        monkeypatch.setattr(module, "CELLS", 150)
    for exact, coarse in zip(wanted, pictures(), strict=True):
        assert exact.shape == coarse.shape
        solid = dark(exact)
        assert solid.sum() > 5000
        # Of 0.3 % the edges are blended otherwise; of cells that are not clipped 4 % differ.
        assert (solid != dark(coarse)).sum() < 0.01 * solid.sum()


def test_common_colours_begin_with_the_most_frequent():
    picture = np.full((20, 20, 3), 253, dtype=np.uint8)  # nearly white is white
    picture[:3] = [0, 0, 0]
    picture[5, :5] = [217, 95, 2]
    np.testing.assert_array_equal(animation.common_colours(picture, 2), [[255] * 3, [0] * 3])
    colours = animation.common_colours(picture, 128)
    assert len(colours) == 3
    assert np.abs(colours[2].astype(int) - [217, 95, 2]).max() <= 8


@pytest.mark.serial
@pytest.mark.parametrize(("arms", "magnification"), [(1, 100.0), (3, 20000.0)])
def test_stage_has_all_labels_inside(arms, magnification):
    views, mechanism = manipulator(arms)
    t, q_r, q_e = swinging(arms)
    film = animation.make_film(views, mechanism, t, q_r, q_e / magnification, magnification, 3)
    stage = animation.Stage(film, mechanism, 0.333)
    stage.draw(1)
    assert_inside(stage.figure)
    assert f"deformation x {magnification:g}" in stage.axes.get_title(loc="right")
    spans = np.ptp([stage.axes.get_xlim(), stage.axes.get_ylim()], axis=1)
    box = stage.axes.get_window_extent()
    assert spans[0] / box.width == pytest.approx(spans[1] / box.height)


@pytest.mark.serial
def test_motion_shows_the_payload_where_it_is(tmp_path):
    from PIL import Image

    views, mechanism = manipulator(2)
    t, q_r, q_e = swinging(2)
    path = animation.draw_motion(
        tmp_path / "motion.gif", views, mechanism, t, q_r, q_e, frames=4, duration=0.2
    )
    assert [p.name for p in tmp_path.iterdir()] == ["motion.gif"]
    film = animation.make_film(views, mechanism, t, q_r, q_e, None, 4)
    axes = animation.Stage(film, mechanism, 1.0).axes
    with Image.open(path) as gif:
        assert (gif.n_frames, gif.info["duration"], gif.info["loop"]) == (4, 50, 0)
        pictures = []
        for frame in range(4):
            gif.seek(frame)
            picture = np.asarray(gif.convert("RGB")).astype(int)
            pictures.append(picture)
            assert (picture[0, 0] == 255).all()
            tip = film.place[frame, -1]
            x, y = axes.transData.transform([tip.real, tip.imag])
            shown = picture[round(len(picture) - y), round(x)]
            assert np.abs(shown - [217, 95, 2]).max() <= 16
    assert (pictures[3] != pictures[0]).any(axis=2).sum() > 1000


@pytest.mark.serial
def test_real_arms_join():
    from dolfinopt.arms.arm import build_arms
    from dolfinopt.dynamics.build import build_mechanism
    from dolfinopt.output.views import gather_views
    from dolfinopt.parallel import gather_arms, partition_arms
    from dolfinopt.profiling import Profile
    from dolfinopt.scene.load import load_scene

    cells = ["arms.0.cells=[20,4]", "arms.1.cells=[16,4]", "reduction.coordinates=5"]
    scene = load_scene(TWO_ARM, cells)
    partition = partition_arms(MPI.COMM_SELF, {0: 80, 1: 64})
    arms = build_arms(scene, partition, Profile())
    x = {k: np.full(arm.mesh.num_cells, 0.5) for k, arm in arms.items()}
    bodies = list(gather_arms(partition, {k: arm.reduce(x[k]) for k, arm in arms.items()}).values())
    views = gather_views(scene, partition, arms, x)
    mechanism = build_mechanism(scene, bodies)
    q_e = 0.01 * np.sin(np.arange(30.0)).reshape(3, 10)
    film = animation.make_film(views, mechanism, np.arange(3.0), np.zeros((3, 3)), q_e, 2.0, 3)
    for frame in range(3):
        for k, view in enumerate(views):
            tip = np.all(np.abs(view.corners - [1.0, 0.0]) < 1e-9, axis=-1)
            place = film.place[frame, k + 1]
            assert tip.any()
            shown = film.cells(k, frame)[tip]
            np.testing.assert_allclose(shown - [place.real, place.imag], 0.0, atol=1e-9)


# -- the machine -----------------------------------------------------------------------------


def test_poses_are_evenly_spaced_along_the_path():
    slow_then_fast = np.linspace(0.0, 1.0, 401) ** 3 * (1.0 + 1.0j)
    at = machine.poses_along(slow_then_fast, 5)
    np.testing.assert_allclose(np.abs(slow_then_fast[at]) / np.sqrt(2), np.arange(5) / 4, atol=0.01)
    np.testing.assert_array_equal(machine.poses_along(np.ones(9, dtype=complex), 5), [0])


@pytest.mark.serial
@pytest.mark.parametrize("arms", [1, 3])
def test_machine_shows_every_arm_where_it_is(arms):
    views, mechanism = manipulator(arms)
    t, q_r, _ = swinging(arms)
    figure = machine.machine_figure(views, mechanism, t, q_r, "title")
    axes = figure.axes[0]
    place = shapes.chain(mechanism, q_r, np.zeros((len(t), 2 * arms)))[0]
    at = machine.poses_along(place[:, -1], machine.POSES)
    assert [text.get_text() for text in axes.texts] == [f"{t[n]:.2f} s" for n in at]
    # Cells without material are left open: half of each arm's 80.
    cells = [one for one in axes.collections if one.get_array() is not None]
    assert [len(one.get_paths()) for one in cells] == [40] * (arms * len(at))
    tips = [line.get_xydata() for line in axes.lines if len(line.get_xydata()) == 1]
    ends = np.concatenate(tips[1::2] if arms == 1 else tips)
    np.testing.assert_allclose(ends, np.stack([place[at, -1].real, place[at, -1].imag], axis=1))
    assert_inside(figure)


@pytest.mark.serial
def test_machine_is_drawn(tmp_path):
    from matplotlib.image import imread

    views, mechanism = manipulator(2)
    t, q_r, _ = swinging(2)
    figure = machine.machine_figure(views, mechanism, t, q_r, "title")
    image = imread(style.save(figure, tmp_path / "machine.png"))
    assert [p.name for p in tmp_path.iterdir()] == ["machine.png"]
    solid = np.abs(image[..., :3] - np.array([8, 29, 88]) / 255.0).max(axis=2) < 0.05
    assert solid.sum() > 5000


# -- closed loops and control ----------------------------------------------------------------


def slider_crank(count: int = 61) -> tuple[list[ArmView], Mechanism, Closure, list[np.ndarray]]:
    """Return a rigid crank and a bending rod whose end is on y = 0, over more than a turn.

    The last entry has instants, desired and actual rigid coordinates, elastic coordinates.
    """
    crank = replace(beam("crank", 0.3, 0.2, 10, 2), modes=np.zeros((20, 4, 2, 0)), designed=False)
    views = [crank, beam("rod", 0.7, 0.06, 20, 4)]
    rigid = plane_body(
        mass=1.0, moment=np.zeros(2), inertia=1.0, C=np.zeros((2, 0)), j=np.zeros(0),
        r=np.zeros(0), M=np.zeros((0, 0)), G=np.zeros((0, 0)), K=np.zeros((0, 0)),
        D=np.zeros((0, 0)), outboard=np.zeros((3, 0)), outboard_point=np.array([0.3, 0.0]),
    )  # fmt: skip
    mechanism = Mechanism((rigid, beam_body(0.7)), 0.5, 0.0, (0.0, 0.0), joint_height=0.0)
    t = np.linspace(0.0, 0.1, count)
    angle = 80.0 * t
    desired = np.stack([0.0 * t, angle, -angle - np.arcsin(0.3 * np.sin(angle) / 0.7)], axis=1)
    q_e = 0.002 * np.stack([0.1 * np.sin(angle), np.sin(angle)], axis=1)
    closure = slider(0.0, 1.0)
    actual = loops.close_loop(mechanism, closure, desired, q_e)
    assert actual is not None
    return views, mechanism, closure, [t, desired, actual, q_e]


@pytest.mark.parametrize("kind", ["slider", "pin"])
def test_a_drawn_loop_is_closed_by_its_last_joints(kind):
    mechanism = manipulator(3)[1]
    q_r = np.array([[0.2, 0.5, -0.9, 0.7], [0.2, 0.48, -0.9, 0.8]])
    q_e = 0.02 * np.sin(np.arange(12.0)).reshape(2, 6)
    rigid_end = shapes.chain(mechanism, q_r[:1], 0.0 * q_e[:1])[0][0, -1]
    closure = pin(rigid_end) if kind == "pin" else slider(rigid_end, 1.0 + 0.5j)
    closed = loops.close_loop(mechanism, closure, q_r, q_e)
    end = shapes.chain(mechanism, closed, q_e)[0][:, -1]
    assert np.abs(closure.gap(end)).max() < 3e-6
    free = 4 - closure.count
    np.testing.assert_array_equal(closed[:, :free], q_r[:, :free])
    assert loops.close_loop(mechanism, pin(5.0), q_r, q_e) is None  # out of reach
    assert loops.close_loop(mechanism, None, q_r, q_e) is q_r


def test_magnified_loops_stay_closed():
    views, mechanism, closure, (t, desired, actual, q_e) = slider_crank()
    for asked in (1.0, 20.0, 1e4):
        film = animation.make_film(
            views, mechanism, t, actual, q_e, asked, 9, desired=desired, closure=closure
        )
        assert film.magnification == asked
        assert np.abs(film.place[:, -1].imag).max() < 2e-6
        assert np.abs(film.rigid[:, -1].imag).max() < 1e-12


def test_magnification_is_less_where_the_loop_does_not_reach_its_pin():
    views, mechanism = manipulator(3)
    t, desired = np.arange(2.0), np.array([[0.0, 0.5, -0.6, 0.8], [0.0, 0.52, -0.6, 0.8]])
    shortened = np.tile([-0.01, 0.0], (2, 3))
    closure = pin(shapes.chain(mechanism, desired[:1], 0.0 * shortened[:1])[0][0, -1])
    actual = loops.close_loop(mechanism, closure, desired, shortened)
    film = animation.make_film(
        views, mechanism, t, actual, shortened, 50.0, 2, desired=desired, closure=closure
    )
    assert 1.0 <= film.magnification < 50.0
    assert np.abs(closure.gap(film.place[:, -1])).max() < 3e-6


def test_control_errors_are_magnified_like_deformations():
    views, mechanism = manipulator(2)
    t, desired, q_e = swinging(2)
    actual = desired + 0.01 * np.cos(t)[:, None]
    film = animation.make_film(views, mechanism, t, actual, q_e, 3.0, 5, desired=desired)
    wanted = end_effector(mechanism, still(desired + 3.0 * (actual - desired)), 3.0 * q_e)
    np.testing.assert_allclose(film.trace, wanted, atol=1e-14)
    np.testing.assert_allclose(
        film.desired, end_effector(mechanism, still(desired), 0.0 * q_e), atol=1e-14
    )


@pytest.mark.serial
def test_stage_of_a_loop_shows_slider_and_guide():
    views, mechanism, closure, (t, desired, actual, q_e) = slider_crank()
    film = animation.make_film(
        views, mechanism, t, actual, q_e, None, 5, desired=desired, closure=closure
    )
    stage = animation.Stage(film, mechanism, 0.5)
    for frame in range(5):
        stage.draw(frame)
        middle = stage.slider.get_xy()[:4].mean(axis=0)
        np.testing.assert_allclose(middle, [film.place[frame, -1].real, 0.0], atol=2e-6)
    assert [text.get_text() for text in stage.figure.legends[0].texts] == [
        "rigid mechanism",
        "slider 0.5 kg",
    ]
    heights = [np.ptp(arm.view.corners[..., 1]) for arm in film.arms]
    np.testing.assert_allclose(heights, [shapes.BAR, 0.06])  # a rigid crank is a thin bar
    assert_inside(stage.figure)


@pytest.mark.serial
def test_machine_shows_one_turn_of_a_loop():
    views, mechanism, closure, (t, desired, actual, _) = slider_crank()
    figure = machine.machine_figure(
        views, mechanism, t, actual, "slider-crank", desired=desired, closure=closure
    )
    axes = figure.axes[0]
    named = [float(text.get_text().removesuffix(" s")) for text in axes.texts]
    np.testing.assert_allclose(80.0 * np.array(named), np.pi / 4 * np.array([1, 3, 5, 7]), atol=0.2)
    # Every pose ends on the line, whatever the deformation that is not drawn.
    drawn = [line for line in axes.lines if line.get_markerfacecolor() == style.ORANGE]
    ends = [line.get_xydata()[0] for line in drawn if len(line.get_xydata()) == 1]
    assert len(ends) == 4
    np.testing.assert_allclose(np.array(ends)[:, 1], 0.0, atol=2e-6)
    assert_inside(figure)


@pytest.mark.serial
def test_drives_have_a_row_each_and_the_ground_one():
    from machines import GAINS, controlled, loop

    from dolfinopt.plots import drives

    shown = {}
    soft = ["arms.joint_stiffness=2e4"]
    prescribed = controlled().to_tree() | {"control": None}
    cases = {
        "control": controlled(),
        "loop": loop(control={"stiffness": [2e3], "damping": [20.0]}),
        "pin": loop("pin"),
        "soft": load_soft(prescribed, soft),
    }
    for name, scene in cases.items():
        trajectory = simulated_alone(scene)
        figure = drives.drives_figure(trajectory)
        visible = [axes for axes in figure.axes if axes.get_visible()]
        shown[name] = [axes.get_title(loc="left") for axes in visible]
        assert_inside(figure)
        if name == "control":
            error = 1e6 * (trajectory.q_r - trajectory.desired.q)[:, 0]
            np.testing.assert_allclose(visible[0].lines[0].get_ydata(), error, atol=1e-9)
            force = trajectory.joint_forces[:, 0]
            np.testing.assert_allclose(visible[1].lines[0].get_ydata(), force)
            assert visible[1].get_title(loc="right") == f"largest {np.abs(force).max():.3g}"
    assert shown["control"][:2] == ["cart: error [µm]", "cart: force [N]"]
    assert len(shown["control"]) == 2 * len(GAINS["stiffness"])
    assert shown["loop"][1:] == ["crank: moment [N m]", "normal force on the slider [N]"]
    assert shown["pin"] == ["crank: moment [N m]", "force of the pin on the arm [N]"]
    # A cart that follows the desired motion exactly has no error to be shown.
    assert shown["soft"][0] == "cart: force [N]" and len(shown["soft"]) == 5


@pytest.mark.serial
@pytest.mark.parametrize("slides", [(), (0,), (1,), (0, 2)])
def test_units_of_drives_in_space(slides):
    """They follow the joints' kinds; the first joint of a tree is no cart."""
    from types import SimpleNamespace

    from dolfinopt.plots import drives

    scene = do.load_scene(ROOT / "demos" / "spatial_arm.toml")
    joints = tuple(
        joint.model_copy(update={"type": "prismatic" if k in slides else joint.type})
        for k, joint in enumerate(scene.movable)
    )
    count = len(joints)
    assert count == 3
    control = {"stiffness": (1.0,) * count, "damping": (1.0,) * count}
    scene = scene.model_copy(update={"joints": joints, "control": SimpleNamespace(**control)})
    zero = np.zeros((4, count))
    trajectory = SimpleNamespace(
        scene=scene, q_r=zero, desired=SimpleNamespace(q=zero), joint_forces=zero,
        closure_force=None,
    )  # fmt: skip
    shown = [(label.split(": ")[1], unit) for row in drives.drive_panels(trajectory)
             for label, unit, _ in row]  # fmt: skip
    of = {True: [("error", "m"), ("force", "N")], False: [("error", "rad"), ("moment", "N m")]}
    assert shown == [quantity for k in range(count) for quantity in of[k in slides]]


def load_soft(tree, changes):
    from dolfinopt.scene.load import scene_from_dict

    return scene_from_dict({k: v for k, v in tree.items() if v is not None}, overrides=changes)


def simulated_alone(scene):
    import dolfinopt as do

    partition, profile = do.partition_arms(MPI.COMM_SELF, scene.cell_counts), do.Profile()
    arms = do.build_arms(scene, partition, profile)
    x = {k: arm.uniform(0.5) for k, arm in arms.items()}
    return do.evaluate(scene, partition, arms, x, profile)[1]
