"""Widths of members and gaps of crisp designs: drawn by hand, and those of robust ones."""

import json

import numpy as np
import pytest
from mpi4py import MPI
from remainders import built_of
from runs import TWO_ARM, overrides, refused, run
from solids import grid, sixths, solid_scene

import dolfinopt as do
from dolfinopt.density.filter import HelmholtzFilter
from dolfinopt.density.members import WIDE, thinnest
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.problem import problem_of
from dolfinopt.output.summary import _widths

WORLD = MPI.COMM_WORLD
CELL = 0.005  # m


def cells(along=200, across=12, triangles=False):
    """Return corners (n, 3 or 4, 2) and the cells' column and row."""
    x, y = np.arange(along + 1) * CELL, np.arange(across + 1) * CELL
    p = np.stack(np.meshgrid(x, y, indexing="ij"), axis=2)
    quads = np.stack([p[:-1, :-1], p[1:, :-1], p[:-1, 1:], p[1:, 1:]], axis=2).reshape(-1, 4, 2)
    corners = quads
    if triangles:
        corners = np.concatenate([quads[:, [0, 1, 3]], quads[:, [3, 2, 0]]])
    i, j = (quads.mean(axis=1) / CELL).astype(int).T
    return corners, i, j


def flanges(j, thick):
    return (j < thick) | (j >= 12 - thick)


DRAWN = [  # solid by column and row; member and gap in cells
    ("flanges", lambda i, j: flanges(j, 2), 2.0, 8.0),
    ("webs", lambda i, j: flanges(j, 3) | (i % 20 < 4), 3.0, 6.0),
    ("thin webs", lambda i, j: flanges(j, 3) | (i % 20 < 1), 1.0, 6.0),
    ("slots", lambda i, j: flanges(j, 3) | (i % 20 > 4), 3.0, 5.0),
    ("diagonal webs", lambda i, j: flanges(j, 4) | ((i - j) % 30 < 6), 4.0, 4.0),
    ("islands", lambda i, j: (i % 20 < 3) & (j % 6 < 3), 3.0, 3.0),
    ("neck", lambda i, j: (abs(i - 100) > 1) | (abs(2 * j - 11) < 3), 2.0, None),
    ("chain by corners", lambda i, j: flanges(j, 2) | (i % 12 == j), 0.0, None),
    ("solid", lambda i, j: i >= 0, 12.0, None),
]


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("triangles", [False, True], ids=["squares", "triangles"])
@pytest.mark.parametrize(("name", "solid", "member", "gap"), DRAWN, ids=[d[0] for d in DRAWN])
def test_widths_of_drawn_designs(name, solid, member, gap, triangles):
    """To half a sample, an eighth of a cell, where edges follow the cells."""
    corners, i, j = cells(triangles=triangles)
    crisp = np.tile(solid(i, j), 2 if triangles else 1)
    found_member, found_gap = thinnest(corners, crisp)
    # A triangle is half a square: its samples are closer, and hit edges less squarely.
    close = 0.25 if triangles else 0.01
    assert found_member.size / CELL == pytest.approx(member, abs=close)
    if gap is not None:
        assert found_gap.size / CELL == pytest.approx(gap, abs=close)
    elif name == "solid":
        assert found_gap is None


@pytest.mark.serial  # ranks have no part in it
def test_corners_are_no_members():
    """A triangular island in the middle of a wide field: its corners are thin, it is not."""
    corners, i, j = cells(60, 60)
    member, _ = thinnest(corners, (j > 10) & (abs(2 * i - 59) < 50 - j))
    assert member.size > 10.0 * CELL
    assert thinnest(corners, i < 0) == (None, None)


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize(
    ("member", "gap", "erosion"),
    [
        *((0.05, 0.0, erosion) for erosion in (0.05, 0.1, 0.25, 0.4)),
        *((member, gap, erosion) for erosion in (0.05, 0.1, 0.25)
          for member, gap in ((0.04, 0.08), (0.05, 0.025), (0.05, 0.05))),
    ],
)  # fmt: skip
def test_the_radius_of_widths(member, gap, erosion):
    """Strips whose middle just reaches the eroded and the dilated threshold are as wide as asked.

    Filtered on 8000 cells along a line. Void within solid is solid within void, turned round.
    """
    data = {"projection": "robust", "erosion": erosion, "minimum_member": member}
    data |= {"minimum_gap": gap} if gap else {}
    fine = ("arms.height=0.2", "arms.cells=[400,60]")
    design = do.load_scene(TWO_ARM, (f"design={toml(data)}", *fine)).design
    assert min(design.erosions) == pytest.approx(erosion) and max(design.erosions) < 0.5
    cell = 1.0 / 8000.0
    mesh = box_arm(MPI.COMM_SELF, "a", (1.0, 0.002), (8000, 1))
    smooth = HelmholtzFilter(mesh, design.radius)
    for wanted, distance in zip((member, gap or member), design.erosions, strict=True):
        half = -design.radius / (2.0 * np.sqrt(3.0)) * np.log(0.5 - distance)
        strip = np.clip((half - np.abs(mesh.centroid[:, 0] - 0.5)) / cell + 0.5, 0.0, 1.0)
        y = smooth.forward(strip)
        assert y.max() == pytest.approx(0.5 + distance, abs=2e-3)
        assert (y > 0.5).sum() * cell == pytest.approx(wanted, abs=3.0 * cell)


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("key", ["minimum_member", "minimum_gap"])
def test_one_width_is_that_of_members_and_gaps(key):
    design = do.load_scene(TWO_ARM, ("design.projection=robust", f"design.{key}=0.018")).design
    assert design.least_widths == (0.018, 0.018) and design.erosions == (0.1, 0.1)
    other = do.load_scene(TWO_ARM, ("design.projection=robust", "design.minimum_member=0.018"))
    assert design.radius == other.design.radius and other.design.controls_widths


@pytest.mark.serial  # ranks have no part in it
def test_what_repeats_a_design_smaller_keeps_the_width():
    """The filter of the pattern is wider by as much as the smallest copy is smaller."""
    width = ("design.projection=robust", "design.minimum_member=0.015")
    small = ("arms.arm2.design=arm1", "arms.arm2.height=0.048", "arms.arm2.length=0.9")
    scene = do.load_scene(TWO_ARM, (*width, *small))
    assert scene.filter_radius(0) == pytest.approx(scene.design.radius / 0.8)
    plain = do.load_scene(TWO_ARM, small)  # without a width it is the stated radius
    assert plain.filter_radius(0) == plain.design.filter_radius


def toml(data):
    return "{" + ", ".join(f"{k}={v!r}" for k, v in data.items()) + "}"


ROBUST = ("arms.arm2.rigid=true", "arms.length=0.28", "arms.cells=[84,18]", "motion.radius=0.15",
          "motion.joint_height=-0.2", "objective.kind=static", "design.projection=robust",
          "design.continuation=5", "design.sharpness=32",
          "optimizer.max_iterations=40")  # fmt: skip


@pytest.mark.serial
def test_members_of_a_robust_design_are_as_wide_as_asked():
    """To one cell; members along the edges, too, which a mirroring filter would halve."""
    width, cell = 0.012, 0.06 / 18
    asked = f"design.minimum_member={width}", "design.erosion=0.25"
    result = do.optimize(do.load_scene(TWO_ARM, (*ROBUST, *asked)))
    widths = _widths(result.scene, result.partition, result.arms, result.x_phys)
    volume = WORLD.bcast(result.history[-1].volume_fraction if WORLD.rank == 0 else None, root=0)
    assert volume == pytest.approx(0.5, abs=0.01)  # of the nominal design
    if WORLD.rank == 0:
        member, gap = widths[0]
        assert member.size >= width - cell
        assert gap.size >= width - cell


@pytest.mark.serial  # ranks have no part in it
def test_widths_of_solids():
    """A web of two cells over a window of four, in boxes and in tetrahedra; to a voxel."""
    boxes, places = grid(10, 9, 3, step=CELL)
    i, j, _ = places.T
    ends = (i < 3) | (i >= 7)
    solid = ends | (j < 3) | (j >= 7)
    # The side of a tetrahedron's cube is twice that of its own volume: voxels are as fine.
    for corners, filled, asked in ((boxes, solid, 3.3), (sixths(boxes), np.tile(solid, 6), 1.0)):
        member, gap = thinnest(corners, filled, WIDE * asked * CELL)
        assert member.size == pytest.approx(2.0 * CELL, abs=CELL / 4.0)
        x, y, z = np.array(member.place) / CELL
        assert 2.0 < x < 8.0 and y == pytest.approx(8.0, abs=0.5) and 0.0 < z < 3.0
        if asked < 2.0:  # gaps are looked for up to one and a half times that
            assert gap is None
            continue
        # A ball that is a little wider reaches through it from both sides.
        assert gap.size == pytest.approx(4.0 * CELL, abs=1.001 * CELL / 4.0)
        assert gap.place[1] / CELL == pytest.approx(5.0, abs=0.5)
    assert thinnest(boxes, np.zeros(len(boxes), dtype=bool), CELL) == (None, None)
    whole, none = thinnest(boxes, np.ones(len(boxes), dtype=bool), CELL)
    assert none is None and whole.size == pytest.approx(3.0 * CELL, abs=CELL / 4.0)


@pytest.mark.serial
@pytest.mark.parametrize(("volume", "misses"), [(0.5, False), (0.3, True)])
def test_widths_that_are_missed_are_told(volume, misses, tmp_path, capsys):
    """Of a run that ends before its members are crisp, and of none that holds them."""
    told = (*ROBUST, "design.minimum_member=0.012", "design.erosion=0.25")
    told = (*told, f"design.volume_fraction={volume}", f"design.initial={volume}")
    told = (*told, "optimizer.max_iterations=30")
    run("optimize", TWO_ARM, "--out", tmp_path / "run", "--no-plots", *overrides(*told))
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    printed, missed = capsys.readouterr(), summary["too_narrow"]
    measured = {"member": summary["minimum_member_measured"]["arm1"],
                "gap": summary["minimum_gap_measured"]["arm1"]}  # fmt: skip
    least = {what for what, width in measured.items() if width is not None and width < 0.012}
    assert {one["what"] for one in missed} == least and bool(least) == misses
    for one in missed:
        assert one["asked"] == 0.012 and one["width"] == measured[one["what"]]
        assert not one["fixed"]
        (text,) = [t for t in summary["warnings"] if f"below design.minimum_{one['what']}" in t]
        x, y = one["place"]
        assert f"at ({x:.4g}, {y:.4g}) m" in text and "raise design.sharpness" in text
        assert text in printed.err


@pytest.mark.parametrize("width", [0.012, 0.0])
def test_which_design_carries_the_volume(width):
    """With a width the dilated one, scaled so that the nominal one meets its limit; else that."""
    scene = do.load_scene(TWO_ARM, (*ROBUST, f"design.minimum_member={width}"))
    built = built_of(scene)
    evaluator = Evaluator(scene, built.partition, built.arms, built.profile)
    evaluator.projection.beta = 4.0
    designs = evaluator.evaluate(np.linspace(0.1, 0.9, evaluator.variables.size))
    problem = problem_of(scene, designs)
    _, dilated, nominal = (np.array(one.evaluation.constraints) for one in designs)
    assert problem.f == pytest.approx(nominal)
    assert dilated > nominal
    expected = designs[1 if width else 2].constraints
    factor = (1.0 + nominal) / (1.0 + dilated) if width else np.ones(len(nominal))
    np.testing.assert_allclose(problem.dfdx, expected * factor[:, None], rtol=1e-14)


ROBUSTLY = "design.projection=robust"
TALL = (ROBUSTLY, "arms.height=0.3", "arms.cells=[200,60]")
REFUSED = [  # keys changed; key, value and what is expected
    (["design.minimum_member=0.015"], ("minimum_member = 0.015", 'with projection = "robust"')),
    (["design.minimum_gap=0.015"], ("minimum_gap = 0.015", 'with projection = "robust"')),
    (["design.minimum_member=-1.0"], ("minimum_member = -1", ">= 0")),
    ([ROBUSTLY, "design.minimum_member=0.014"], ("minimum_member = 0.014", "3 cells", "0.015 [m]")),
    ([ROBUSTLY, "design.minimum_gap=0.014"], ("minimum_gap = 0.014", "3 cells", "0.015 [m]")),
    ([ROBUSTLY, "design.minimum_member=0.021"], ("0.021", "two members", "0.06 [m]")),
    ([ROBUSTLY, "design.minimum_member=0.02", "design.filter_radius=0.01"],
     ("filter_radius = 0.01", "0.0075", "minimum_member = 0.02", "0.049976")),
    ([*TALL, "design.minimum_member=0.015", "design.minimum_gap=0.08"],
     ("minimum_gap = 0.08", "0.06477 [m]", "4.32 times minimum_member")),
    ([*TALL, "design.minimum_member=0.08", "design.minimum_gap=0.015"],
     ("minimum_member = 0.08", "0.06477 [m]", "4.32 times minimum_gap")),
    ([ROBUSTLY, "design.minimum_member=0.015", "design.minimum_gap=0.035"],
     ("0.015 [m]", "0.035 [m]", "height of arm")),
    ([ROBUSTLY, "design.minimum_member=0.018", "arms.arm2.design=arm1", "arms.arm2.height=0.05"],
     ("0.018", "two members", "arm1", "0.05 [m]")),
]  # fmt: skip


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize(("overrides", "words"), REFUSED)
def test_widths_that_cannot_be(overrides, words):
    with refused(*words):
        do.load_scene(TWO_ARM, overrides)


BORES = ("arms.mesh=meshes/arm_bores.geo", "arms.arm2.design=arm1", "design.projection=robust")


@pytest.mark.parametrize("shape", ["quadrilateral", "triangle"])
def test_widths_need_three_cells_of_a_file_that_has_its_own(shape):
    """The file's own size is 5 mm; that of most edges differs from it by a few per cent."""
    told = (*BORES, f"arms.cell_shape={shape}", "design.minimum_member=0.014")
    scene = do.load_scene(TWO_ARM, told)  # which says nothing of the size
    with refused("design.minimum_member = 0.014", "3 cells"):
        do.Arm(scene, 0, WORLD, do.Profile())
    wide = do.load_scene(TWO_ARM, (*told, "design.minimum_member=0.017"))
    assert do.Arm(wide, 0, WORLD, do.Profile()).mesh.cell_size == pytest.approx(CELL, rel=0.05)


@pytest.mark.serial  # ranks have no part in it
def test_widths_need_three_cells_of_a_step_file_without_a_size(tmp_path):
    path = tmp_path / "arm.step"
    path.write_text("")
    told = (*BORES[1:], f"arms.mesh={path}")
    with refused("3 cells", "arm1", "0.015 [m]"):
        do.load_scene(TWO_ARM, (*told, "design.minimum_member=0.014"))
    do.load_scene(TWO_ARM, (*told, "design.minimum_member=0.015"))


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("extruded", [False, True])
def test_widths_of_solid_arms_are_measured_where_they_are_asked_for(extruded):
    """Of a design that is the same over the thickness in the plane: the arm's own is no member."""
    told = {"cells": (20, 12, 2), "height": 0.06, "thickness": 0.01}
    told["symmetric"] = "extruded" if extruded else False
    scene = solid_scene(**told)
    width = {"projection": "robust", "minimum_member": 0.015}
    asked = scene.unchecked_copy(
        {"design": scene.design.model_copy(update=width | {"filter_radius": 0.0075})}
    )
    for one in (scene, asked):
        arm = do.Arm(one, 0, MPI.COMM_SELF, do.Profile())
        partition = do.partition_arms(MPI.COMM_SELF, {0: 480})
        x, y = arm.mesh.centroid.T[:2]
        solid = (x < 0.05) | (x > 0.45) | (np.abs(y) > 0.015)  # flanges of three cells
        found = _widths(one, partition, {0: arm}, {0: solid * 1.0})
        if one is scene:
            assert found == {}
            continue
        member, gap = found[0]
        # The shorter side of a cell is 5 mm; voxels are a quarter of its mean side, 8 mm.
        assert member.size == pytest.approx(0.015 if extruded else 0.01, abs=0.003)
        assert gap is None or gap.size > 0.02
        assert not (extruded and member.fixed)  # the whole arm is as thin otherwise
        stub = _widths(one, partition, {0: arm}, {0: arm.mesh.passive * 1.0})[0][0]
        assert stub.fixed  # nothing but the solid ends
