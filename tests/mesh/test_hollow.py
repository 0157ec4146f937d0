"""Hollow links: the hull's grid, the wall's volume in closed form, its map and what is refused."""

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT, refused
from solids import solid_arm

import dolfinopt as do
from dolfinopt.mesh.checks import cell_volumes, check_cells
from dolfinopt.mesh.hollow import Member, Wall, box_hull, hull_of, stations, tube_hull
from dolfinopt.mesh.solid_cells import TENSOR, msh_bytes

SIZE, CELLS, WALL = (0.5, 0.08, 0.06), (6, 4, 3), 0.004  # m
ROUND = (0.5, 0.06, 0.06)
HOLLOW = ("arms.link1.hollow=true", "arms.link1.wall=0.002")


@pytest.mark.parametrize(
    "hull, area",
    [(box_hull(SIZE, CELLS, WALL), 0.08 * 0.06 - 0.072 * 0.052),
     (tube_hull(ROUND, CELLS), np.pi * (0.03**2 - 0.026**2))],
    ids=["box", "tube"],
)  # fmt: skip
def test_the_wall_has_the_volume_of_its_section(hull, area):
    """To rounding: mitred corners of a box, and a circle's area of a polygon."""
    mesh = hull.member(WALL)
    check_cells(mesh.points, mesh.cells[:, TENSOR[8]])
    assert cell_volumes(mesh.points[mesh.cells[:, TENSOR[8]]]).sum() == pytest.approx(area * 0.5)
    assert len(mesh.inboard) == len(mesh.outboard) == hull.shape[1]


def test_the_wall_of_a_cone_is_as_thick_as_it_says():
    """Between two cones of half angle a and distance t along the normal; to (pi / r)^2 / 6."""
    around, slope, t = 120, 0.4, 0.002
    x, turns = stations(0.5, 8), 2.0 * np.pi * np.arange(around) / around
    radius = 0.3 - slope * x
    outer = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    points = np.empty((len(x), around, 3))
    points[:, :, 0], points[:, :, 1:] = x[:, None], radius[:, None, None] * outer
    inner = hull_of(points).points(t).reshape(2, len(x), around, 3)[1]
    found = (radius[:, None] - np.hypot(*inner[:, :, 1:].transpose(2, 0, 1))) / np.hypot(1.0, slope)
    assert found == pytest.approx(np.full_like(found, t), rel=1e-3)


def test_thickness_follows_the_cells_and_gradients_go_back():
    """t is linear in x: backward is its transpose, and a uniform x is a uniform wall."""
    rng = np.random.default_rng(2)
    hull = box_hull(SIZE, CELLS, WALL)
    along, around = hull.shape
    nodes = rng.permutation(2 * (along + 1) * around)
    wall = Wall(hull, 0.001, WALL, nodes, rng.permutation(along * around))
    comm = MPI.COMM_SELF
    assert wall.thickness(comm, np.full(along * around, 0.5)) == pytest.approx(0.0025)
    x, by = rng.random(along * around), rng.standard_normal((len(nodes), 3))
    moved = wall.points(comm, x) - wall.points(comm, np.zeros_like(x))
    assert (moved * by).sum() == pytest.approx(wall.backward(by) @ x)


def test_ends_are_flanges():
    """Cells nearer to the ends than arms.passive stay as thick as the largest wall."""
    arm = walled(cells=(10, 3, 2), passive=0.06)
    x = arm.mesh.centroid[:, 0]
    assert np.array_equal(arm.mesh.passive, (x < 0.06) | (x > 0.44))
    thickness = arm.mesh.wall.thickness(MPI.COMM_SELF, arm.uniform())
    assert thickness[[0, -1]] == pytest.approx(0.003)
    # A wall of 1 mm between 0.5 and 3 mm; its volume over that of the thickest.
    inner = ~arm.mesh.passive
    assert arm.uniform()[inner] == pytest.approx(0.2)


def walled(**keys):
    return solid_arm(MPI.COMM_SELF, hollow=True, wall=0.001, max_wall=0.003, **keys)


def test_ribs_are_rings_at_even_distances():
    """Two cells long; the station between them is as thick as the largest wall, its next is not."""
    arm = walled(cells=(12, 3, 2), passive=0.0, ribs=2)
    x, wall = arm.mesh.centroid[:, 0], arm.mesh.wall
    at = wall.hull.outer[:, 0, 0]
    cell = 0.5 / 12
    near = np.abs(x[:, None] - [0.5 / 3, 1.0 / 3]).min(axis=1) < cell
    assert np.array_equal(arm.mesh.passive, near)
    thickness = wall.thickness(MPI.COMM_SELF, arm.uniform())
    ribs = np.isclose(at[:, None], [0.5 / 3, 1.0 / 3]).any(axis=1)
    assert ribs.sum() == 2 and thickness[ribs] == pytest.approx(0.003)
    beyond = np.abs(at[:, None] - at[ribs]).min(axis=1) > 1.5 * cell
    assert thickness[beyond] == pytest.approx(0.001)


@pytest.mark.serial
@pytest.mark.parametrize(
    "changes, words",
    [
        (("arms.link1.ribs=2",), ("arms.0.ribs", "2", "hollow = true")),
        ((*HOLLOW, "arms.link1.ribs=20"), ("ribs", "20", "at most", "4 from rib to rib")),
        (("arms.link1.wall=0.002",), ("arms.0.wall", "0.002", "hollow = true")),
        (("arms.link1.hollow=true",), ("wall", "number > 0")),
        ((*HOLLOW, "arms.link1.max_wall=0.01"), ("max_wall", "0.01", "less than half")),
        ((*HOLLOW, "arms.link1.min_wall=0.005"), ("min_wall", "less than max_wall")),
        ((*HOLLOW, "arms.link1.min_wall=0.003"), ("wall", "0.002", "min_wall = 0.003")),
        ((*HOLLOW, "arms.link1.section=tube"), ("height", "0.04", "thickness = 0.02")),
        ((*HOLLOW, "arms.link1.extruded=true"), ("extruded", "none with hollow")),
        ((*HOLLOW, "arms.link1.element=quadratic"), ("element", "incompatible")),
        ((*HOLLOW, "arms.link1.cells=[60,60,40]"), ("cells", "at most 150", "200")),
        ((*HOLLOW, "design.projection=heaviside"), ("projection", "false with a hollow arm")),
        ((*HOLLOW, "arms.link2.hollow=true", "arms.link2.wall=0.002", "design.initial=0.7"),
         ("design.initial", "0.7", "arms.wall")),
    ],
)  # fmt: skip
def test_what_a_hollow_arm_cannot_have(changes, words):
    """One line: key, value and what is expected; and no plane arm has an inside."""
    with refused(*(word for word in words if not word.startswith("arms.0"))):
        do.load_scene(ROOT / "demos" / "spatial_arm.toml", changes)
    with refused("hollow", "cells = [nx, ny, nz]"):
        do.load_scene(ROOT / "demos" / "two_arm.toml", ("arms.hollow=true", "arms.wall=0.002"))


def taper() -> Member:
    """Return a solid whose section shrinks along it from 60 x 40 mm to half of both."""
    counts = np.array([7, 5, 5])
    grid = np.indices(counts).reshape(3, -1).T / (counts - 1.0)
    x, y, z = grid.T
    points = np.column_stack([0.5 * x, *((1.0 - 0.5 * x) * (np.array([[0.06], [0.04]])
                              * (np.array([y, z]) - 0.5)))])  # fmt: skip
    number = np.arange(len(grid)).reshape(counts)
    a = number[:-1, :-1, :-1], number[:-1, 1:, :-1], number[:-1, 1:, 1:], number[:-1, :-1, 1:]
    b = number[1:, :-1, :-1], number[1:, 1:, :-1], number[1:, 1:, 1:], number[1:, :-1, 1:]
    hexahedra = np.stack([one.ravel() for one in (*a, *b)], axis=1)
    first = np.stack([one[0].ravel() for one in a], axis=1)
    last = np.stack([one[-1].ravel() for one in b], axis=1)
    return Member(points, hexahedra, first[:, ::-1], last)


def hull_arm(tmp_path, mesh: Member, **keys):
    """Return the arm whose hull is a mesh's."""
    path = tmp_path / "hull.msh"
    path.write_bytes(msh_bytes(mesh))
    size = {"height": 0.06, "thickness": 0.04, "cells": (10, 4, 4)}
    told = {"hollow": True, "hull": str(path), "wall": 0.001, "passive": 0.0, "max_wall": 0.002}
    return solid_arm(MPI.COMM_SELF, **(size | told | keys))


@pytest.mark.serial
def test_hull_of_a_file_lies_on_its_surface(tmp_path):
    """Every point on a side of the taper, and the wall as thick as it should be there."""
    arm = hull_arm(tmp_path, taper())
    outer = arm.mesh.wall.hull.outer
    half = (1.0 - outer[:, :, 0]) * 0.5 * np.array([[[0.06]], [[0.04]]])
    apart = np.abs(outer[:, :, 1:].transpose(2, 0, 1)) / half
    assert apart.max(axis=0) == pytest.approx(np.ones(apart.shape[1:]), abs=1e-5)
    assert outer[[0, -1], 0, 0] == pytest.approx([0.0, 0.5])


@pytest.mark.serial
def test_hulls_that_are_refused(tmp_path):
    """A surface behind another one, and a wall that would cross itself."""
    behind = box_hull((0.5, 0.06, 0.04), (6, 4, 4), 0.005).member(0.005)
    with refused("hull.msh", "2 times", "star-shaped", "section"):
        hull_arm(tmp_path, behind)
    with refused("arms.max_wall = 0.015", "crosses itself", "thinner"):
        hull_arm(tmp_path, taper(), max_wall=0.015)
