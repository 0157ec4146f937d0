"""Outlines as a shop cuts them: the tool's radius, rings, straight lines and fillets."""

import numpy as np
import pytest
import shapely
from cutter import deepest_left

from dolfinopt.part.part import Curves
from dolfinopt.part.plane.curves import Arc, Line, Piece, Shape, angle_of
from dolfinopt.part.plane.limits import thinnest_member
from dolfinopt.part.plane.part import make_part
from dolfinopt.part.plane.sides import Corner, Loop, Side, Sides

pytestmark = pytest.mark.serial
SIZE = 1e-4  # m, of rasters

SCARA = """
SetFactory("OpenCASCADE");
DefineConstant[
  length = {0.325, Name "Parameters/1 length (m)"},
  size = {0.004, Name "Parameters/3 mesh size (m)"}
];
Disk(1) = {0, 0, 0, 0.06}; Disk(2) = {length, 0, 0, 0.042};
Point(101) = {0, -0.052, 0}; Point(102) = {length, -0.036, 0};
Point(103) = {length, 0.036, 0}; Point(104) = {0, 0.052, 0};
Line(101) = {101, 102}; Line(102) = {102, 103}; Line(103) = {103, 104}; Line(104) = {104, 101};
Curve Loop(101) = {101, 102, 103, 104}; Plane Surface(3) = {101};
body() = BooleanUnion{ Surface{1}; Delete; }{ Surface{2, 3}; Delete; };
Disk(11) = {0, 0, 0, 0.031}; Disk(12) = {length, 0, 0, 0.02};
cut() = BooleanDifference{ Surface{body()}; Delete; }{ Surface{11, 12}; Delete; };
r = 0.0311; s = 0.0201; e = 1e-4;
Physical Curve("inboard", 1) = Curve In BoundingBox {-r, -r, -e, r, r, e};
Physical Curve("outboard", 2) = Curve In BoundingBox {length - s, -s, -e, length + s, s, e};
Physical Surface("design", 3) = {cut()};
MeshSize {:} = size;
"""


def webbed(x, y):
    """Two flanges and slanted webs of about 10 mm between rings; the ends are void."""
    flange = 0.05 - 0.045 * x
    between = (x > 0.04) & (x < 0.29)
    webs = between & (np.abs(np.abs((x - 0.07) % 0.12 - 0.06) - 0.06 * (y + 0.04) / 0.08) < 0.006)
    return (((np.abs(y) > flange - 0.012) & (np.abs(y) < flange) & (x > 0.0)) | webs) * 1.0


@pytest.fixture
def scara(design, tmp_path):
    """The domain of a SCARA-like arm of triangles with bearing bores and rings of 6 mm."""
    path = tmp_path / "scara.geo"
    path.write_text(SCARA)
    changes = (f"arms.0.mesh={path}", "arms.0.length=0.325", "arms.0.height=0.12",
               "arms.0.mesh_size=0.004", "arms.0.passive=0.006",
               'arms.0.regions=[{kind="solid", circle=[0.16, 0.0, 0.012]}]')  # fmt: skip
    return design(
        webbed, *changes, "motion.radius=0.4", "arms.1.length=0.325", "motion.joint_height=-0.1"
    )


@pytest.mark.slow
def test_a_cutter_of_3_mm_leaves_nothing_in_a_scara(scara):
    part = make_part(scara, Curves(0.003))
    shape = part.shape
    assert shape.area == pytest.approx(scara.volume, rel=1e-5)
    deep, _ = deepest_left(shape, 0.003, SIZE)
    assert deep <= part.tolerance + 1.5 * SIZE
    # Told are the arm's own corners, where the bar meets the boss; elsewhere a trifle may be.
    own = [one for one in part.tight if np.hypot(*(np.abs(one.place) - [0.305, 0.037])) < 2e-3]
    assert all(one.radius > 0.8 * 0.003 for one in part.tight if one not in own)
    assert {type(curve) for curve in shape.curves} == {Line, Arc}
    circles = {
        round(p.curve.radius, 9) for p in shape.pieces if not p.free and isinstance(p.curve, Arc)
    }
    assert {0.031, 0.02, 0.037, 0.026} <= circles  # bores, and the rings around them
    # The boss of 12 mm that `regions` keeps is there to the tolerance of polygons.
    outer, *holes = shape.polygons(1e-7)
    assert shapely.Polygon(outer, holes).buffer(2e-7).covers(shapely.Point(0.16, 0.0).buffer(0.012))


def test_openings_are_rounded_by_the_tool_alone(design):
    """One of 18 x 14 cells keeps its size: four fillets take (4 - pi) r^2."""

    def density(x, y):
        return ~((np.abs(x - 0.5) < 0.0215) & (np.abs(y) < 0.014))

    part = make_part(design(density, "arms.0.cells=[400,30]"), Curves(0.003))
    hole = shapely.Polygon(part.shape.polygons(1e-7)[1])
    x0, y0, x1, y1 = hole.bounds
    assert (x1 - x0, y1 - y0) == pytest.approx((0.045, 0.028), abs=5e-4)
    rounding = (x1 - x0) * (y1 - y0) - hole.area
    # Sides lie up to a cell, 2.5 mm, off the outline: 3.4 times, where half a cell gives below 3.
    assert 0.8 * (4.0 - np.pi) * 0.003**2 < rounding < 3.5 * (4.0 - np.pi) * 0.003**2


def square(side, notch=None):
    """Return a square about the origin as a shape, a sharp hole in it."""

    def loop(half, sense):
        corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]][::sense], dtype=float)
        return tuple(Piece(Line(corners[k - 1], corners[k]), free=True) for k in range(4))

    return Shape((loop(0.5 * side, 1), loop(0.5 * notch, -1)) if notch else (loop(0.5 * side, 1),))


def test_places_that_the_tool_does_not_reach_are_told():
    found = square(0.1, 0.04).concave
    assert len(found) == 4 == deepest_left(square(0.1, 0.04), 0.003, SIZE)[1]
    for one in found:
        assert np.abs(one.place) == pytest.approx([0.02, 0.02]) and one.radius == 0.0
    assert square(0.1, 0.04).concave_radius == 0.0
    assert not square(0.1).concave
    ring = Piece(Arc(np.zeros(2), 0.002, 0.0, -2.0 * np.pi))
    bored = Shape((*square(0.1).loops, (ring,)))
    assert [one.radius for one in bored.concave] == pytest.approx([0.002])
    assert bored.concave_radius == np.inf  # the arm's own


def outline(*loops):
    """Return sides that may move along closed polygons."""
    made = []
    for number, corners in enumerate(loops):
        points = np.array(corners, dtype=float)
        before = np.roll(points, 1, axis=0)
        sides = [
            Side(0.5 * (a + b), angle_of(b - a), key=100 * number + k)
            for k, (a, b) in enumerate(zip(before, points, strict=True))
        ]
        made.append(Loop(tuple(sides), tuple(Corner(place) for place in before)))
    return Sides(tuple(made)).centred()


def test_the_thinnest_member_is_a_neck_a_wall_or_a_dead_end():
    dumbbell = [(0, -0.02), (0.06, -0.02), (0.06, -0.003), (0.1, -0.003), (0.1, -0.02),
                (0.16, -0.02), (0.16, 0.02), (0.1, 0.02), (0.1, 0.003), (0.06, 0.003),
                (0.06, 0.02), (0, 0.02)]  # fmt: skip
    assert thinnest_member(outline(dumbbell), 0.005) == pytest.approx(0.006)
    upper = [(0.09, 0.002), (0.06, 0.006), (0.06, 0.02), (0.0, 0.02)]  # a tail
    tail = outline([(x, -y) for x, y in reversed(upper)] + upper)
    assert thinnest_member(tail, 0.005) == pytest.approx(0.004, rel=0.02)
    block, hole = ([(x, y) for x, y in ((a, a), (b, a), (b, b), (a, b))]
                   for a, b in ((0.0, 0.1), (0.006, 0.094)))  # fmt: skip
    for cell in (0.002, 0.012):
        walls = thinnest_member(outline(block, hole[::-1]), cell)
        assert walls == pytest.approx(0.006)
    assert thinnest_member(outline(block), 0.005) is None
