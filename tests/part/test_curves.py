"""Lines, arcs and splines, the shapes behind polygons, and splines through points."""

import numpy as np
import pytest
import shapely

from dolfinopt.part.domain import loops, recognise
from dolfinopt.part.plane.curves import (
    Arc,
    Line,
    Piece,
    Shape,
    Spline,
    Target,
    curvature,
    direction,
    fit,
    joined,
    sampled,
)

pytestmark = pytest.mark.serial

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
    assert sorted(sorted(loop.tolist()) for loop in found) == [[0, 1, 2], [5, 6, 7]]


def wave(count=400):
    x = np.linspace(0.0, 1.0, count)
    return np.stack([x, 0.05 * np.sin(2.0 * np.pi * 2.0 * x)], axis=1)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4])
def test_spline_keeps_the_tolerance_with_few_points(tolerance):
    found = fit(Target(wave()), tolerance)
    line = shapely.LineString(fine(found)[::10])
    assert shapely.distance(shapely.points(wave(1500)), line).max() <= 1.01 * tolerance
    # Cubic: the fourth root of the tolerance; 8, 11 and 19 control points.
    assert len(found.points) <= 2 + 2.0 * tolerance**-0.25
    np.testing.assert_array_equal([found.start, found.end], wave()[[0, -1]])


def test_directions_at_the_ends_are_kept():
    first, last = np.array([0.6, 0.8]), np.array([0.8, 0.6])
    found = fit(Target(wave(), first, last), 1e-3)
    np.testing.assert_allclose(direction(found, 0.0), first, atol=1e-9)
    np.testing.assert_allclose(direction(found, 1.0), last, atol=1e-9)


def window(radius, stays=()):
    """Return a hole of two waves and two arcs; pieces with the numbers in `stays` are not free."""
    points = [[-1, radius], [-0.7, radius], [0.1, radius + 0.3], [0.6, radius], [1, radius]]
    wave = Spline(np.array([0, 0, 0, 0, 0.4, 1, 1, 1, 1]), np.array(points))
    right = Arc(np.array([1.0, 0.0]), radius, 0.5 * np.pi, -np.pi)
    left = Arc(np.array([-1.0, 0.0]), radius, 1.5 * np.pi, -np.pi)
    curves = [wave, right, Spline(wave.knots, -wave.points), left]
    return Shape((tuple(Piece(one, free=k not in stays) for k, one in enumerate(curves)),))


def test_free_curves_that_go_on_smoothly_are_one_spline():
    shape = window(0.2)
    [[piece]] = joined(shape).loops
    curve = piece.curve
    np.testing.assert_allclose(curve.start, curve.end, atol=1e-15)
    assert curve.area == pytest.approx(shape.area, rel=1e-6)
    boundary = shapely.LinearRing(shape.polygons(1e-7)[0])
    apart = shapely.distance(shapely.points(fine(curve)), boundary)
    assert apart.max() < 4.3e-6 * 0.2 + 1e-7  # arcs as cubics; chords of the polygon
    # The speed is continuous, and the splines are themselves: any derivative is theirs.
    t = curve.breaks[1:-1]
    before, after = (curve.derivative(t + d) for d in (-1e-9, 1e-9))
    np.testing.assert_allclose(before, after, rtol=1e-6, atol=1e-6)
    share = curve.breaks[2]  # of the first spline, which has two polynomials
    own = shape.loops[0][0].curve
    for order in (1, 2):
        found = curve.derivative(0.3 * t[1:2], order) * share**order
        np.testing.assert_allclose(found, own.derivative([0.3], order), rtol=1e-9)
    half = curve.part(0.1, 0.8)  # double knots within
    at = np.linspace(0.0, 1.0, 50)
    np.testing.assert_allclose(half.at(at), curve.at(0.1 + 0.7 * at), atol=1e-12)


def test_corners_and_what_stays_part_curves():
    corner = window(0.2)
    loop = list(corner.loops[0])
    loop[0].curve.points[1] += [0.0, 0.05]  # no longer level where the left arc ends
    assert len(joined(corner).curves) == 1  # the hole begins and ends there
    loop[0].curve.points[-2] += [0.0, 0.05]
    assert len(joined(corner).curves) == 2
    kept = joined(window(0.2, stays=(0,)))  # the arcs beside it are the tool's, and exact
    assert [type(piece.curve) for piece in kept.pieces] == [Spline, Arc, Spline, Arc]
