"""Sides, fillets and circles: their derivatives, limits and the nearest outline that keeps them."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import shapely
from parts import frame

from dolfinopt.errors import InputError
from dolfinopt.part.part import Curves
from dolfinopt.part.plane.curves import Arc, Line, Spline, angle_of
from dolfinopt.part.plane.limits import Limits
from dolfinopt.part.plane.part import make_part
from dolfinopt.part.plane.sides import Circle, Corner, Loop, Side, Sides
from dolfinopt.part.plane.struts import with_struts
from dolfinopt.part.program import _with_more, least_move, solve

pytestmark = pytest.mark.serial

DOME = Spline(
    np.array([0, 0, 0, 0, 1, 1, 1, 1.0]),
    np.array([[0.22, 0.05], [0.13, 0.08], [0.07, 0.08], [-0.02, 0.05]]),
)


def corners(*places, radius=0.0):
    return tuple(Corner(np.array(place), radius) for place in places)


def bracket():
    """Lines that move beside a line, a spline and a ring that stay; a hole, a circle."""
    floor = Line(np.array([0.0, 0.0]), np.array([0.2, 0.0]))
    ring = Arc(np.array([0.05, 0.03]), 0.015, 0.0, 2.0 * np.pi)
    outer = Loop(
        (Side(np.array([0.1, 0.0]), 0.0, floor), Side(np.array([0.2, 0.03]), 1.55, key=1),
         Side(np.array([0.1, 0.07]), 0.0, DOME), Side(np.array([0.0, 0.03]), -1.6, key=2)),
        corners([0.0, 0.0], [0.2, 0.0], [0.2, 0.06], [0.0, 0.06]),
    )  # fmt: skip
    hole = Loop(
        (Side(np.array([0.065, 0.03]), 0.0, ring), Side(np.array([0.09, 0.042]), 0.02, key=3),
         Side(np.array([0.11, 0.03]), -1.5, key=4), Side(np.array([0.09, 0.018]), 3.1, key=5)),
        corners([0.066, 0.021], [0.066, 0.039], [0.107, 0.039], [0.107, 0.021], radius=0.003),
    )  # fmt: skip
    return Sides((outer, hole), (Circle(np.array([0.155, 0.03]), 0.012),)).centred()


ARM, KEPT = shapely.box(-0.002, 0.0, 0.199, 0.1), shapely.box(0.08, 0.043, 0.1, 0.05)
LIMITS = Limits(0.005, 0.004, 0.019, 0.008, ARM, KEPT)


def differences(sides, value, step=1e-7):
    """Return the derivatives (m, n) by q of what is measured of sides, by central differences."""
    every = step * np.eye(sides.numbers[0])
    return np.array(
        [(value(sides.moved(e)) - value(sides.moved(-e))) / (2.0 * step) for e in every]
    ).T


def test_points_move_as_their_derivatives_say():
    """Of lines, fillets, circles and of the arm's own curves; of nodes that stand off arcs."""
    sides, t = bracket(), np.linspace(0.0, 1.0, 5)

    def points(some, count):
        found = []
        for one in some.placed:
            curve = one.piece.curve
            at = curve.at(t)
            if isinstance(curve, Arc) and one.piece.free:
                share = curve.off(t, count)[0][:, None]
                at = curve.centre + share * (at - curve.centre)
            found.append(at)
        return np.concatenate(found).ravel()

    for count in (0, 4):
        exact = np.zeros((len(sides.placed), 5, 2, sides.numbers[0]))
        for k, one in enumerate(sides.placed):
            g = np.eye(10).reshape(10, 5, 2)
            exact[k] = one.pull(t, g, count).reshape(5, 2, -1)
        expected = differences(sides, partial(points, count=count))
        np.testing.assert_allclose(exact.reshape(expected.shape), expected, atol=1e-6)


def test_straight_sides_between_nodes_have_the_area_of_an_arc():
    for sweep, count in ((-1.3, 3), (-2.0 * np.pi, 9), (2.2, 2)):
        arc, t = Arc(np.array([0.3, 0.1]), 0.02, 0.4, sweep), np.linspace(0.0, 1.0, count + 1)
        nodes = arc.centre + arc.off(t, count)[0][:, None] * (arc.at(t) - arc.centre)
        x, y = nodes.T
        assert 0.5 * (x[:-1] @ y[1:] - y[:-1] @ x[1:]) == pytest.approx(arc.area, rel=1e-9)


def test_area_and_limits_are_differentiated():
    sides = bracket()
    area = differences(sides, lambda some: np.array([some.shape.area]))
    assert sides.area_by_q() == pytest.approx(area[0], rel=1e-6, abs=1e-9)
    assert len(LIMITS.rows(sides)[0]) > 30
    for kind in ("_of_pieces", "_turns", "_places"):
        _, slopes = zip(*getattr(LIMITS, kind)(sides), strict=True)

        def rows(some, kind=kind):
            return np.array([value for value, _ in getattr(LIMITS, kind)(some)])

        np.testing.assert_allclose(slopes, differences(sides, rows), atol=2e-6)


def test_narrowest_member_and_gap_are_differentiated():
    """Of equally narrow places rounding tells which are looked at: the least is tested."""
    sides = bracket()
    for limits in (replace(LIMITS, gap=1e-4), replace(LIMITS, member=1e-4, gap=0.05)):
        values, slopes = zip(*limits._widths(sides), strict=True)

        def least(some, limits=limits):
            return np.array([max(value for value, _ in limits._widths(some))])

        expected = differences(sides, least)[0]
        np.testing.assert_allclose(slopes[np.argmax(values)], expected, atol=1e-5)


def test_sides_of_a_strut_are_parallel_and_stay_so():
    """Not its ends, which are further apart than they are long; steeper sides are a wedge."""
    for slope, tied in ((0.06, True), (0.2, False)):
        places = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.03], [0.0, 0.03 - 0.1 * slope]])
        ways = np.roll(places, -1, axis=0) - places
        middles = places + 0.5 * ways
        blade = (Side(*item, key=k) for k, item in enumerate(zip(middles, angle_of(ways))))
        sides = with_struts(Sides((Loop(tuple(blade), corners(*places)),)).centred())
        assert sides.count == 8 - tied
        bent = sides.moved(sides.ties @ np.full(sides.count, 1e-3))
        bottom, _, top, _ = bent.loops[0].sides
        assert bottom.angle
        assert (abs(np.sin(bottom.angle - top.angle)) < 1e-12) == tied


def test_nearest_outline_keeps_the_limits_and_an_area():
    sides = bracket()
    for area in (None, 0.99 * sides.shape.area):
        found, step = LIMITS.nearest(sides, area=area)
        assert LIMITS.rows(found)[0].max() < 3e-6
        assert 1e-3 < np.abs(step).max() < 1e-2  # m
        assert area is None or found.shape.area == pytest.approx(area, rel=1e-5)


def test_shortest_move_is_that_of_the_book():
    """The foot of the origin on x + y >= 2 and x >= 1.5."""
    A, b = np.array([[-1.0, -1.0], [-1.0, 0.0]]), -np.array([2e-3, 1.5e-3])
    x, dual = least_move(A, b, 1e-3)
    np.testing.assert_allclose(x, [1.5e-3, 5e-4], atol=1e-12)
    np.testing.assert_allclose(-dual @ A, x, atol=1e-12)
    assert least_move(np.array([[1.0], [-1.0]]), np.full(2, -1e-3), 1e-3) is None
    # Of two columns at a time the second one may bring exactly nothing.
    both = np.eye(2)
    assert _with_more(both, both[0], both, 0 * b, [0, 1])[0] == 1.0


def test_quadratic_programme_keeps_its_conditions():
    """Of Karush, Kuhn and Tucker: multipliers of limits that cost between 0 and what they cost."""
    rng = np.random.default_rng(0)
    n, m = 12, 6
    H, g = 0.1 * np.eye(n), rng.normal(size=n)
    F, f = rng.normal(size=(m, n)), rng.normal(size=m)
    A, b = rng.normal(size=(20, n)), rng.uniform(size=20)
    prices = np.full(m, 0.3)
    x, dual = solve(H, g, F, f, prices, np.arange(m), A, b)
    assert (A @ x <= b + 1e-9).all() and np.abs(x).max() <= 1.0
    missed = f + F @ x
    assert ((dual > -1e-9) & (dual <= prices * (1.0 + np.maximum(missed, 0.0)) + 1e-9)).all()
    assert np.abs(dual[missed < -1e-6]).max(initial=0.0) < 1e-9
    np.testing.assert_allclose(dual[missed > 1e-6], (prices * (1.0 + missed))[missed > 1e-6])

    def merit(y):
        s = np.maximum(f + F @ y, 0.0)
        return g @ y + 0.5 * y @ H @ y + prices @ (s + 0.5 * s**2)

    for y in np.clip(x + 1e-3 * rng.normal(size=(200, n)), -1.0, 1.0):
        assert (A @ y > b).any() or merit(y) >= merit(x) - 1e-12


def test_ties_hold_mirror_images():
    loop = bracket().loops[1]
    free = [replace(side, key=k) for k, side in enumerate(loop.sides)]
    free[1], free[3] = replace(free[1], twin=3), replace(free[3], twin=1)
    free[0], free[2] = replace(free[0], twin=0), replace(free[2], twin=2)
    sides = Sides((Loop(tuple(free), loop.corners),))
    # Offset and turn of both, the middle's offset, two pairs of radii.
    assert sides.count == 2 + 1 + 2
    # What a turn moves at the far ends of the fillets beside it, no further than x.
    for key, at in sides.numbers[1].items():
        assert np.abs(sides.ties[at + 1]).max() * (0.5 * sides.lengths[key] + 0.003) <= 1.0 + 1e-9


def test_sides_of_a_frame_are_straight_flanges_and_struts(design):
    part = make_part(design(frame), Curves(0.003))
    assert part.shape.area == pytest.approx(part.domain.volume, rel=1e-5)
    assert part.distance <= 0.5 * part.domain.cell
    assert not part.tight and len(part.shape.loops) == 5
    with pytest.raises(InputError, match="expected at most a cell"):
        make_part(part.domain, Curves(tolerance=0.5))
