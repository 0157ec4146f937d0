"""Outlines and curves of designs that are known."""

import numpy as np
import pytest
import shapely
from parts import frame

from dolfinopt.data import mesh_folder
from dolfinopt.errors import InputError
from dolfinopt.part.domain import loops, recognise
from dolfinopt.part.part import Curves
from dolfinopt.part.plane.curves import (
    Arc,
    Line,
    Spline,
    curvature,
    direction,
    sampled,
)
from dolfinopt.part.plane.part import make_part

pytestmark = pytest.mark.serial

BORES = (f"arms.0.mesh={mesh_folder() / 'arm_bores.geo'}", "arms.0.mesh_size=0.006",
         "arms.0.passive=0.0075", "arms.0.symmetric=true")  # fmt: skip


def check(part, holes):
    """Check what every part fulfils."""
    shape, domain = part.shape, part.domain
    assert shape.area == pytest.approx(domain.volume, rel=1e-4)
    assert part.outline.area == pytest.approx(domain.volume, rel=5e-3)
    assert part.distance <= domain.cell
    assert shape.concave_radius >= part.outline.tool_radius - 1e-6
    assert shape.is_simple(0.05 * part.tolerance)
    assert len(shape.loops) == 1 + holes
    for loop in shape.loops:
        ends = np.array([piece.curve.end for piece in loop])
        starts = np.array([piece.curve.start for piece in loop])
        np.testing.assert_allclose(np.roll(ends, 1, axis=0), starts, atol=1e-9)
    areas = [sum(piece.curve.area for piece in loop) for loop in shape.loops]
    assert areas[0] > 0.0 and max(areas[1:], default=-1.0) < 0.0
    assert not any(isinstance(piece.curve, Spline) for piece in shape.pieces if piece.free)


def test_frame(design):
    part = make_part(design(frame))
    check(part, holes=4)
    assert part.outline.islands == part.outline.filled == 0
    outer = [piece.curve for piece in part.shape.loops[0]]
    assert [type(curve) for curve in outer] == [Line] * 4  # the arm's own outline
    corners = sorted(tuple(np.round(curve.start, 12)) for curve in outer)
    assert corners == [(0.0, -0.03), (0.0, 0.03), (1.0, -0.03), (1.0, 0.03)]
    assert sorted(piece.label for piece in part.shape.loops[0]) == ["", "", "inboard", "outboard"]
    # Four sides and four fillets around each hole, or two more by a passive end.
    assert all(len(loop) in (8, 10, 12) for loop in part.shape.loops[1:])
    # Flanges of 15 mm, struts of 25 mm; the level rounds corners and widens the windows for it.
    assert part.thinnest == pytest.approx(0.015, rel=0.05)
    assert len(part.warnings) == 1 and "blurred" in part.warnings[0]  # densities of cells alone


@pytest.mark.parametrize("radius", [0.001, 0.003, 0.006])
def test_concave_corners_have_the_radius_of_the_tool(design, radius):
    part = make_part(design(frame), Curves(radius))
    check(part, holes=4)
    assert radius * 0.98 <= part.shape.concave_radius <= radius + 0.005


def diagonal(x, y):
    """A chain of cells that share corners, which elements join at their nodes."""
    column, row = np.floor(x / 0.005 + 1e-9), np.floor((y + 0.03) / 0.005 + 1e-9)
    return (column - 72 == row - 3) & (np.abs(y) < 0.015)


# What stands in a window of the frame, and the windows then.
IN_A_WINDOW = {
    "island": (lambda x, y: np.hypot(x - 0.375, y) < 0.008, 4),
    "strut of one cell": (lambda x, y: np.abs(x - 0.3725) < 0.002, 5),
    "diagonal chain": (diagonal, 5),
}


@pytest.mark.parametrize("name", IN_A_WINDOW)
def test_struts_stay_and_islands_are_dropped(design, name):
    more, holes = IN_A_WINDOW[name]
    part = make_part(design(lambda x, y: frame(x, y) | more(x, y)), Curves(0.001))
    check(part, holes)
    assert part.outline.islands == (name == "island")
    told = "1 piece without a joint to both interfaces (" in " ".join(part.warnings)
    assert told == (name == "island")
    assert name != "strut of one cell" or 0.002 < part.thinnest < 0.006


def test_designs_and_tools_that_are_refused(design):
    with pytest.raises(InputError, match=r"arm 'arm1'.*does not hang together"):
        make_part(design(lambda x, y: np.abs(x - 0.5) > 0.05))
    with pytest.raises(InputError, match=r"--tool-radius = 0.03 m: the tool is as wide as"):
        make_part(design(frame), Curves(0.03))


def test_full_arm_is_its_own_outline(design):
    part = make_part(design(lambda x, y: np.ones_like(x)))
    assert part.shape.area == pytest.approx(0.06, rel=1e-12)
    assert len(part.shape.curves) == 4


def test_gray_design_says_what_it_is(design):
    def density(x, y):
        return 0.2 + 0.7 * (y / 0.03) ** 2

    part = make_part(design(density, "design.projection=false"))
    check(part, holes=len(part.shape.loops) - 1)
    assert any("grayness" in text and "robust" in text for text in part.warnings)


def test_bores_are_exact_and_the_part_is_its_mirror_image(design):
    def density(x, y):
        return (np.abs(y) > 0.0149) | (np.abs(x - 0.5) < 0.02) | (np.minimum(x, 1.0 - x) < 0.05)

    part = make_part(design(density, *BORES))
    check(part, holes=4)
    for label, x in (("inboard", 0.0), ("outboard", 1.0)):
        (curve,) = [piece.curve for piece in part.shape.pieces if piece.label == label]
        assert isinstance(curve, Arc) and curve.is_circle
        assert np.array_equal(curve.centre, [x, 0.0])
        assert curve.radius == pytest.approx(0.01, abs=1e-9)
    ends = [p.curve for p in part.shape.loops[0] if isinstance(p.curve, Arc)]
    assert [curve.radius for curve in ends] == pytest.approx([0.03, 0.03], abs=1e-9)
    outer, *holes = part.shape.polygons(1e-7)
    here = shapely.Polygon(outer, holes)
    there = shapely.affinity.scale(here, yfact=-1.0, origin=(0.0, 0.0))
    assert here.symmetric_difference(there).area < 1e-6 * here.area


def test_regions_stay_solid_and_void(design):
    solid, void = (f'{{kind="{kind}", box={box}}}' for kind, box in (
        ("solid", [0.3, -0.02, 0.4, 0.01]), ("void", [0.5, 0.02, 0.6, 0.03])))  # fmt: skip
    part = make_part(design(frame, f"arms.0.regions=[{solid}, {void}]"))
    outer, *holes = part.shape.polygons(1e-7)
    polygon = shapely.Polygon(outer, holes)
    assert polygon.buffer(1e-8).covers(shapely.box(0.3, -0.02, 0.4, 0.01))
    assert not polygon.buffer(-1e-8).intersects(shapely.box(0.5, 0.02, 0.6, 0.03))


def test_checkerboard_is_refused(design):
    """Its cells touch in corners alone."""

    def density(x, y):
        return np.rint((x - x.min()) / 0.02 + (y - y.min()) / 0.005).astype(int) % 2 == 0

    with pytest.raises(InputError, match="arm 'arm1'"):
        make_part(design(density, "arms.cells=[50,12]"))


# -- lines, arcs and splines, the shapes behind polygons, and splines through points  -------------


KNOTS = np.array([0, 0, 0, 0, 0.3, 0.7, 1, 1, 1, 1], dtype=float)
POINTS = np.array([[0, 0], [1, 2], [2, -1], [3, 1], [4, 0], [5, 1]], dtype=float)
CURVES = [
    Line(np.array([1.0, 2.0]), np.array([3.0, -1.0])),
    Arc(np.array([0.5, 0.2]), 2.0, 0.3, 2.5),
    Arc(np.array([0.5, 0.2]), 2.0, 0.3, -4.0),
    Spline(KNOTS, POINTS),
]


def fine(curve):
    return curve.at(np.linspace(0.0, 1.0, 20001))


@pytest.mark.parametrize("curve", CURVES)
def test_curves_reversed_and_mirrored(curve):
    """They run through the same points; their area is that of many chords."""
    points, t = fine(curve), np.linspace(0.0, 1.0, 6)
    x, y = points.T
    expected = 0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1]).sum()
    assert curve.area == pytest.approx(expected, abs=1e-7)
    for other in (curve.reversed(), curve.mirrored()):
        assert other.area == pytest.approx(-curve.area, rel=1e-12)
    np.testing.assert_allclose(fine(curve.reversed()), points[::-1], atol=1e-12)
    np.testing.assert_allclose(fine(curve.mirrored()), points * [1.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(direction(curve, 0.0), -direction(curve.reversed(), 1.0), atol=1e-9)
    np.testing.assert_allclose(curvature(curve.mirrored(), t), -curvature(curve, t), atol=1e-9)


@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize("tolerance", [1e-2, 1e-4])
def test_chords_stay_within_the_tolerance(curve, tolerance):
    line = shapely.LineString(np.vstack([sampled([curve], tolerance), curve.end]))
    assert shapely.distance(shapely.points(fine(curve)), line).max() <= 1.001 * tolerance


def test_parts_of_a_spline_are_the_spline():
    spline = CURVES[3]
    piece = spline.part(0.2, 0.9)
    t = np.linspace(0.0, 1.0, 50)
    np.testing.assert_allclose(piece.at(t), spline.at(0.2 + 0.7 * t), atol=1e-12)
    pieces = spline.bezier()
    assert pieces.shape == (3, 4, 2)
    middle = np.array([1, 3, 3, 1]) / 8.0 @ pieces  # at t = 1/2 of each
    np.testing.assert_allclose(middle, spline.at(np.array([0.15, 0.5, 0.85])), atol=1e-8)


def kinds(points):
    labels = np.full(len(points), "")
    return [edge.curve for edge in recognise(points, labels, float(np.ptp(points)))]


def circle(count):
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.array([0.3, 0.1]) + 0.01 * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize("shift", [0, 3, 17])
def test_rectangle_with_many_nodes_has_four_lines(shift):
    side, none = np.linspace(0.0, 1.0, 11)[:-1], np.zeros(10)
    x, y = (np.concatenate(parts) for parts in (
        (side, none + 1, 1 - side, none), (none, side, none + 1, 1 - side)))  # fmt: skip
    found = kinds(np.roll(np.stack([x, y], axis=1), shift, axis=0))
    assert [type(curve) for curve in found] == [Line] * 4
    corners = {tuple(np.round(curve.start, 12)) for curve in found}
    assert corners == {(0, 0), (1, 0), (1, 1), (0, 1)}


@pytest.mark.parametrize("count", [12, 60])
def test_polygon_of_a_bore_is_a_circle(count):
    points = circle(count) + 1e-11 * np.random.default_rng(0).normal(size=(count, 2))
    (found,) = kinds(points)
    assert isinstance(found, Arc) and found.is_circle
    assert found.radius == pytest.approx(0.01, abs=1e-10)
    np.testing.assert_allclose(found.centre, [0.3, 0.1], atol=1e-10)
    np.testing.assert_allclose(curvature(found, np.linspace(0.0, 1.0, 5)), 100.0)
    assert [type(curve) for curve in kinds(circle(6))] == [Line] * 6  # a hexagon is none


def slot(count):
    """A bar with round ends, no corner anywhere."""
    a = np.linspace(-0.5 * np.pi, 0.5 * np.pi, count)
    right = np.stack([1.0 + 0.1 * np.cos(a), 0.1 * np.sin(a)], axis=1)
    left = np.stack([-0.1 * np.cos(a), -0.1 * np.sin(a)], axis=1)
    between = np.linspace(0.0, 1.0, 9)[1:-1]
    top = np.stack([1.0 - between, np.full(7, 0.1)], axis=1)
    bottom = np.stack([between, np.full(7, -0.1)], axis=1)
    return np.vstack([right, top, left, bottom])


@pytest.mark.parametrize("shift", [0, 4, 20, 31])
def test_bar_with_round_ends_has_two_lines_and_two_arcs(shift):
    found = kinds(np.roll(slot(13), shift, axis=0))
    assert sorted(type(curve).__name__ for curve in found) == ["Arc", "Arc", "Line", "Line"]
    for curve in found:
        if isinstance(curve, Arc):
            assert curve.radius == pytest.approx(0.1, abs=1e-10)
            assert curve.sweep == pytest.approx(np.pi, abs=1e-7)


def test_ellipse_is_a_spline_through_its_nodes():
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    (found,) = kinds(np.stack([np.cos(angle), 0.4 * np.sin(angle)], axis=1))
    x, y = fine(found).T
    assert np.abs(np.hypot(x, y / 0.4) - 1.0).max() < 1e-3


def test_curves_do_not_go_beyond_a_label():
    labels = np.array(["inboard"] * 6 + [""] * 6)
    found = recognise(circle(12), labels, 1.0)
    assert [edge.label for edge in found] == ["inboard", ""]


def test_sides_are_chained_to_loops():
    found = loops(np.array([[0, 1], [5, 6], [1, 2], [6, 7], [2, 0], [7, 5]]))
    assert sorted(loop.tolist() for loop in found) == [[0, 2, 4], [1, 3, 5]]
