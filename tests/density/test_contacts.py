"""Pieces that share faces, contacts that do not, and designs rated without these."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from remainders import built_of
from runs import TWO_ARM, overrides, run
from solids import grid, sixths, solid_arm

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.density.contacts import contacts_of
from dolfinopt.optimization.assessment import _crisp
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.output.summary import _contact_warnings

WORLD = MPI.COMM_WORLD
STEP = 0.25  # a power of two: corners are the same to the last bit


def found(corners, solid):
    """Return the contacts of an arm from x = 0 to its other end."""
    x = corners[:, :, 0]
    held = np.where(x == 0.0, 1, np.where(x == x.max(), 2, 0))
    return contacts_of(corners, solid, held, np.ones(len(corners)))


def drawn(*rows):
    """Return corners and solid cells of a drawing, its first line on top."""
    lines = [list(row) for row in reversed(rows)]
    corners, (i, j) = (one := grid(len(lines[0]), len(lines), step=STEP))[0], one[1].T
    return corners, np.array(lines)[j, i] == "#"


PLANE = [  # the drawing, pieces, corners, what is kept of it, whether that joins the ends
    (("####", "####"), 1, 0, 8, True),
    (("##..", "..##"), 2, 1, 2, False),  # nothing but a corner between the halves
    (("####", ".#..", "#...", "####"), 2, 1, 9, True),  # the interfaces hold two pieces
    (("#####", "#...#", "##..#", "..#.#", "#####"), 1, 1, 16, True),  # a loop closed by a corner
    (("#####", "#...#", "#.#..", "##..#", "#####"), 2, 1, 16, True),  # a single cell falls out
    (("######", "#..###", "###..#", "######"), 1, 1, 19, True),
    (("######", "#....#", "#.##.#", "######"), 1, 0, 18, True),
    (("#.#.#", ".#.#.", "#.#.#"), 8, 8, 2, False),  # a chequerboard
]


@pytest.mark.serial
@pytest.mark.parametrize(("rows", "pieces", "corners", "kept", "joins"), PLANE)
def test_drawings(rows, pieces, corners, kept, joins):
    cells, solid = drawn(*rows)
    one = found(cells, solid)
    assert (one.pieces, one.corners, one.edges) == (pieces, corners, 0)
    assert one.joins == joins and not (one.kept & ~solid).any()
    assert one.remaining == 0
    assert one.left_out == pytest.approx(1.0 - one.kept.sum() / solid.sum())


@pytest.mark.serial
def test_contacts_of_solids():
    """Cubes meet in faces, edges or corners; a corner of cubes that share an edge is none more."""
    cells, places = grid(4, 2, 2, step=STEP)
    i, j, k = places.T
    low, high = (i < 2) & (j == 0) & (k == 0), (i >= 2) & (k == 0)
    by_face = found(cells, low | (high & (j == 0)))
    assert (by_face.pieces, by_face.corners, by_face.edges, by_face.joins) == (1, 0, 0, True)
    by_edge = found(cells, low | (high & (j == 1)))
    assert (by_edge.pieces, by_edge.corners, by_edge.edges, by_edge.joins) == (2, 0, 1, False)
    assert by_edge.places.tolist() == [[0.5, 0.25, 0.125]] and by_edge.left_out == 0.5
    by_corner = found(cells, low | ((i >= 2) & (j == 1) & (k == 1)))
    assert (by_corner.pieces, by_corner.corners, by_corner.edges) == (2, 1, 0)
    assert by_corner.places.tolist() == [[0.5, 0.25, 0.25]]
    # The same halves beside a bar that joins the ends: the contact is opened, the bar stays.
    bar = found(cells, (j == 0) & (k == 1) | low | (high & (j == 1)))
    assert bar.joins and bar.remaining == 0 and bar.kept[(j == 0) & (k == 1)].all()


@pytest.mark.serial
def test_triangles_and_tetrahedra():
    quads, places = grid(4, 2, step=STEP)
    first, second = quads[:, [0, 1, 3]], quads[:, [0, 3, 2]]
    halves = np.concatenate([first, second])
    i, j = np.tile(places, (2, 1)).T
    corner = found(halves, ((i < 2) & (j == 0)) | ((i >= 2) & (j == 1)))
    assert (corner.pieces, corner.corners) == (2, 1) and not corner.joins
    assert found(halves, j == 0).pieces == 1
    cubes, places = grid(4, 2, 2, step=STEP)
    i, j, k = np.tile(places, (6, 1)).T
    edge = found(sixths(cubes), (k == 0) & (((i < 2) & (j == 0)) | ((i >= 2) & (j == 1))))
    assert (edge.pieces, edge.corners, edge.edges) == (2, 0, 1)


def test_nothing_solid():
    cells, solid = drawn("....", "....")
    one = found(cells, solid)
    assert (one.pieces, one.count, one.left_out, one.joins) == (0, 0, 0.0, False)


@pytest.mark.parametrize("dim", [2, 3])
def test_an_arm_on_any_ranks(dim):
    """Halves that meet at one corner, or one edge; one is kept, on whatever rank it lies."""

    def arm(comm):
        if dim == 3:
            return solid_arm(comm, cells=(10, 4, 2))
        return Arm(do.load_scene(TWO_ARM, ("arms.cells=[24,4]",)), 0, comm, do.Profile())

    def contacts(one):
        x, y = one.mesh.centroid.T[:2]
        solid = (x < 0.5 * one.mesh.outboard_point[0]) == (y < 0.0)
        found = one.contacts(solid)
        assert (found.pieces, found.count, found.joins) == (2, dim - 1, False)
        assert not found.kept[x > 0.5 * one.mesh.outboard_point[0]].any()
        return one.mesh.comm.allreduce(int(found.kept.sum())), found.places

    (kept, places), (alone, there) = contacts(arm(WORLD)), contacts(arm(MPI.COMM_SELF))
    assert kept == alone and np.array_equal(places, there)
    assert places[0][:2] == pytest.approx([0.25 if dim == 3 else 0.5, 0.0], abs=1e-12)


QUICK = ("arms.cells=[24,6]", "arms.arm2.rigid=true", "arms.passive=0", "objective.kind=static",
         "design.projection=heaviside", "design.filter_radius=0")  # fmt: skip


@pytest.mark.serial
def test_the_crisp_design_is_rated_without_contacts():
    """A strut that hangs by a corner changes nothing; a chain alone is no crisp design."""
    built = built_of(do.load_scene(TWO_ARM, QUICK), MPI.COMM_SELF)
    evaluator = Evaluator(built.scene, built.partition, built.arms, built.profile)
    i, j = (built.arms[0].mesh.centroid * [24.0, 100.0] + [0.0, 3.0]).astype(int).T

    def crisp(solid):
        return _crisp(evaluator, {0: np.where(solid, 1.0, 0.0)})

    bars = (j == 0) | (j == 5) | (i < 2) | (i > 21)
    end = (i == 13) & (j == 4)
    strut = (i == 12) & (j > 0) & (j < 4)  # from the lower bar to a corner of that end
    opened = crisp(bars | strut | end).objective
    joined = evaluator.evaluate_densities({0: (bars | strut | end) * 1.0}).objective
    assert opened > 1.01 * joined
    assert opened in (crisp(bars | strut).objective, crisp(bars | end).objective,
                      crisp(bars | end | (strut & (j < 3))).objective)  # fmt: skip
    assert crisp((i < 12) & (j < 3) | (i >= 12) & (j >= 3)) is None


TRUSS = ("arms.arm2.rigid=true", "arms.length=0.16", "arms.cells=[48,18]", "arms.passive=0",
         "motion.radius=0.08", "motion.joint_height=-0.1", "objective.kind=static",
         "objective.loads=[[0.0,100.0,0.0],[0.0,50.0,5.0]]", "design.volume_fraction=0.3",
         "design.initial=0.3", "design.continuation=8", "design.sharpness=64",
         "optimizer.max_iterations=200")  # fmt: skip
CELL = 0.06 / 18  # m


@pytest.mark.serial
@pytest.mark.parametrize(
    ("projection", "radius"), [("heaviside", 1.0), ("robust", 2.0)], ids=["filter", "robust"]
)
def test_contacts_are_told_and_robust_designs_have_none(projection, radius, tmp_path, capsys):
    """A filter of a cell leaves chains of cells; eroded by 1/4 the design must hold together."""
    erosion = ("design.erosion=0.25",) * (projection == "robust")
    told = (*TRUSS, f"design.projection={projection}", f"design.filter_radius={radius * CELL}")
    run("optimize", TWO_ARM, "--out", tmp_path / "run", "--no-plots", "--verbose",
        *overrides(*told, *erosion))  # fmt: skip
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    printed = capsys.readouterr()
    own = summary["contacts"]["arm1"]
    told = [text for text in summary["warnings"] if "no joints in a workshop" in text]
    if projection == "robust":
        assert own["pieces"] == summary["connected"] == 1 and own["corners"] == own["left_out"] == 0
        assert not told and "falls into" not in printed.out
        return
    assert summary["connected"] == own["pieces"] > 1 and own["edges"] == 0
    # Four, of which the three worst are told.
    assert own["corners"] >= 4 and len(own["places"]) == 3 and own["left_out"] > 0.0
    (text,) = told
    x, y = own["places"][0]
    assert f"the worst at ({x:.4g}, {y:.4g}) m" in text and f"{own['corners']} corners" in text
    cure = f'"robust", design.erosion = 0.25, design.filter_radius = {2.0 * CELL:.4g}'
    assert cure in text and text in printed.err
    counted = f"arm1 falls into {own['pieces']} pieces, {own['corners']} of whose contacts"
    assert counted in printed.out
    assert summary["crisp"]["objective"] > 0.0


@pytest.mark.serial
@pytest.mark.parametrize(("solid", "contacts"), [("#.##", 0), ("##..|..##", 1)])
def test_why_there_is_no_crisp_design(solid, contacts):
    """A gap between the ends is another thing than ends that a corner joins."""
    cells, crisp = drawn(*solid.split("|"))
    one = found(cells, crisp)
    assert one.count == contacts and not one.joins
    scene = do.load_scene(TWO_ARM, ("design.projection=heaviside",))
    run_ = SimpleNamespace(scene=scene, iterations=3, crisp=None)
    told = [*_contact_warnings(run_, {0: SimpleNamespace(contacts=one, cell_size=0.005)})]
    assert len(told) == 1 + contacts
    assert ("contacts alone" in told[-1]) == bool(contacts)
    assert ("too weak" in told[-1]) == (not contacts)


@pytest.mark.serial
def test_a_uniform_design_of_one_half_is_one_piece(tmp_path):
    """The filter's rounding leaves some of its cells below one half."""
    run("simulate", TWO_ARM, "--out", tmp_path / "run", "--no-plots",
        *overrides("arms.cells=[100,6]"))  # fmt: skip
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert [(one["pieces"], one["corners"]) for one in summary["contacts"].values()] == 2 * [(1, 0)]
