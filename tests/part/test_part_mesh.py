"""Meshes along the curves of parts, and the stress on their outline."""

from itertools import pairwise

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM

from dolfinopt.arms.arm import Arm
from dolfinopt.part.mesh import body_mesh, triangle_areas
from dolfinopt.part.plane.curves import Arc, Line, Piece, Shape, Spline
from dolfinopt.part.stress import corner_stress, singular_points
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import read_scene

pytestmark = pytest.mark.serial

LENGTH, HEIGHT, RADIUS = 0.3, 0.06, 0.015


def strip():
    """A rectangle with a round hole in its middle."""
    corners = np.array([[0, -1], [2, -1], [2, 1], [0, 1]]) * [0.5 * LENGTH, 0.5 * HEIGHT]
    labels = ("", "outboard", "", "inboard")
    ends = zip(corners, np.roll(corners, -1, axis=0), labels, strict=True)
    outer = tuple(Piece(Line(a, b), label) for a, b, label in ends)
    hole = Arc(np.array([0.5 * LENGTH, 0.0]), RADIUS, 0.0, -2.0 * np.pi)
    return Shape((outer, (Piece(hole),)))


@pytest.fixture(scope="module")
def meshes():
    """A coarse one, and one that is finer along the hole: twice, in 0.1 rad, as the check is."""
    hole = strip().loops[1][0].curve.at(np.linspace(0.0, 1.0, 65))
    return body_mesh(strip(), 0.005), body_mesh(strip(), 0.005, finer=[hole, hole])


def test_area_is_that_of_the_curves(meshes):
    exact = LENGTH * HEIGHT - np.pi * RADIUS**2
    assert strip().area == pytest.approx(exact, rel=1e-12)
    for mesh in meshes:
        assert mesh.area == pytest.approx(exact, rel=1e-6)
        assert triangle_areas(mesh.points, mesh.triangles).min() > 0.0


def test_sides_close_the_outline(meshes):
    for mesh in meshes:
        assert (np.sort(mesh.sides[:, 0]) == np.sort(mesh.sides[:, 1])).all()
        ends = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        keys, count = np.unique(ends, axis=0, return_counts=True)
        alone = {tuple(pair) for pair in keys[count == 1]}
        assert alone == {tuple(sorted(pair)) for pair in mesh.sides.tolist()}
        inboard = mesh.points[mesh.sides[mesh.labelled("inboard")]]
        assert np.abs(inboard[..., 0]).max() == 0.0
        assert np.ptp(inboard[..., 1]) == pytest.approx(HEIGHT)
    assert 1.5 < len(meshes[1].triangles) / len(meshes[0].triangles) < 5


def test_sides_are_short_where_the_outline_bends_and_members_are_thin(meshes):
    mesh = meshes[0]
    length = np.linalg.norm(np.diff(mesh.points[mesh.sides], axis=1)[:, 0], axis=1)
    hole = mesh.piece == 4
    assert length[hole].max() < 0.9 * RADIUS
    near = np.abs(mesh.points[mesh.sides[:, 0], 0] - 0.5 * LENGTH) < 0.5 * RADIUS
    assert length[near & ~hole].max() < length[~near & ~hole].max()


def test_a_coarser_mesh_is_no_finer():
    """Beside a hole that nearly touches the edge, too."""
    hole = Piece(Arc(np.array([0.15, 0.02967]), 0.0003, 0.0, -2.0 * np.pi))
    near_edge = Shape((*strip().loops[:1], (hole,)))
    fine, coarse = (body_mesh(near_edge, 0.005, factor) for factor in (1.0, 2.0))
    assert len(coarse.triangles) <= len(fine.triangles)


def test_mesh_follows_curves_that_move():
    points = np.array([[0, -0.01], [0.1, -0.01], [0.1, 0.01], [0, 0.01]])
    knots = np.array([0, 0, 0, 0, 1, 1, 1, 1.0])

    def bar(sag):
        bottom = Spline(knots, np.array([[0, -0.01], [0.03, -sag], [0.07, -sag], [0.1, -0.01]]))
        lines = [Line(points[k], points[(k + 1) % 4]) for k in (1, 2, 3)]
        sides = map(Piece, lines, ("outboard", "", "inboard"))
        return Shape(((Piece(bottom, free=True), *sides),))

    mesh = body_mesh(bar(0.01), 0.004)
    moved = mesh.morphed(bar(0.012))
    assert moved.area == pytest.approx(bar(0.012).area, rel=1e-3)  # chords of a spline
    assert triangle_areas(moved.points, moved.triangles).min() > 0.0
    inner = np.setdiff1d(np.arange(len(mesh.points)), mesh.sides)
    step = np.linalg.norm((moved.points - mesh.points), axis=1)
    assert 0.0 < step[inner].max() < step[mesh.sides].max()


def test_corners_and_ends_of_interfaces_are_singular():
    assert len(singular_points(strip())) == 4
    hole = [[0.1, 0.01], [0.12, 0.01], [0.12, -0.01], [0.1, -0.01]]  # clockwise
    ends = zip(np.array(hole), np.roll(hole, -1, axis=0), strict=True)
    square = tuple(Piece(Line(a, b)) for a, b in ends)
    found = singular_points(Shape((*strip().loops[:1], square)))
    assert len(found) == 8


def shoulder(fillet):
    """A bar of 60 mm that narrows to 40 mm."""
    x, y, top = 0.5 * LENGTH, HEIGHT / 3.0, 0.5 * HEIGHT
    right, off = x + fillet, y + fillet
    ends = [[x, top], [0.0, top], [0.0, -top], [x, -top], [x, -off],
            [right, -y], [LENGTH, -y], [LENGTH, y], [right, y], [x, off]]  # fmt: skip
    curves = [Line(a, b) for a, b in pairwise(np.array([*ends, ends[0]]))]
    for k, centre, begin in ((4, [right, -off], np.pi), (8, [right, off], -0.5 * np.pi)):
        curves[k] = Arc(np.array(centre), fillet, begin, -0.5 * np.pi)
    labels = {1: "inboard", 6: "outboard"}
    return Shape((tuple(Piece(c, labels.get(k, "")) for k, c in enumerate(curves)),))


def concentration(mesh, width, file):
    """Return the largest stress in the middle of a drawn bar, over that of a section's width."""
    mesh.write(file)
    arm1 = f"arms.0.mesh={file}", f"arms.0.length={LENGTH}", "arms.0.element=quadratic"
    one = read_scene(TWO_ARM, ("arms.1.rigid=true", "design.filter_radius=0", *arm1))
    arm = Arm(one, 0, MPI.COMM_SELF, Profile())
    assert arm.mesh.area.sum() == pytest.approx(mesh.shape.area, rel=1e-6)
    arm.state(np.ones(arm.mesh.num_cells))
    corners, q = corner_stress(arm.current), arm.current.load_fields.V.shape[2]
    middle = np.abs(corners.places[:, 0] - 0.5 * LENGTH) < 1.1 * RADIUS
    stress = np.linalg.norm(corners.A[:, :, q + 4], axis=0)  # of a unit force along the arm
    return stress[middle].max() * width * one.arms[0].thickness


def test_stress_at_a_hole_is_that_of_the_book(meshes, tmp_path):
    """2.16 times that of the net section in tension: Howland (1930), doi:10.1098/rsta.1930.0002."""
    width, file = HEIGHT - 2.0 * RADIUS, tmp_path / "hole.msh"
    coarse, fine = (concentration(mesh, width, file) for mesh in meshes)
    assert coarse == pytest.approx(2.16, rel=0.1) and fine == pytest.approx(2.16, rel=0.01)


def test_stress_at_a_shoulder_is_that_of_arcs_in_a_fiftieth_of_a_radian(tmp_path):
    """Of the check's mesh, in 0.1 rad; Peterson's charts, which are fits, say 1.976 and 2.435."""
    for fillet, chart in ((0.006, 1.976), (0.003, 2.435)):
        shape = shoulder(fillet)
        near = np.vstack([arc.at(np.linspace(0.0, 1.0, 33)) for arc in shape.curves[4::4]])
        meshes = body_mesh(shape, 0.005, finer=[near, near]), body_mesh(shape, 0.005, turn=0.02)
        found, exact = (concentration(one, HEIGHT / 1.5, tmp_path / "bar.msh") for one in meshes)
        assert found == pytest.approx(exact, rel=0.01)
        assert exact == pytest.approx(chart, rel=0.05)
