"""Parts of hollow arms: a watertight surface with the wall's volume, and what its mesh does."""

import json
from importlib import metadata

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT, demo, run, summary_of
from solids import solid_arm

import dolfinopt as do
from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import cell_sizes, check_cells
from dolfinopt.mesh.solid_cells import TENSOR
from dolfinopt.part.hollow import make_hollow_part
from dolfinopt.part.part import Curves

pytestmark = pytest.mark.serial


def part():
    """Return the part of a box whose wall varies, and the volume of its cells, m3."""
    arm = solid_arm(MPI.COMM_SELF, cells=(8, 3, 2), hollow=True, wall=0.002, max_wall=0.004)
    x, y, _ = arm.mesh.centroid.T
    x_phys = arm.physical(0.5 + 0.4 * np.sin(9.0 * x + 80.0 * y))
    state = arm.state(x_phys)
    return make_hollow_part(arm.mesh, x_phys), state.mesh.area.sum()


def test_the_surface_is_closed_and_holds_the_wall():
    """Every edge has two triangles that run along it in opposite directions; one ring, genus 1."""
    found, volume = part()
    triangles, points = found.surface.triangles, found.surface.points
    edges = np.concatenate([triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    there, back = ({tuple(edge) for edge in some.tolist()} for some in (edges, edges[:, ::-1]))
    assert there == back and len(there) == len(edges)
    assert len(points) - len(edges) // 2 + len(triangles) == 0  # Euler's number of a torus
    # Warped quadrilaterals are two triangles in the one and bilinear in the other.
    assert found.volume == pytest.approx(volume, rel=1e-3)


def test_meshes_have_the_same_surfaces():
    """Cells cut in four have the volume of the design's to rounding."""
    found, volume = part()
    for mesh, share in ((found.mesh(found.COARSER), 1), (found.mesh(), 4)):
        cells = mesh.cells[:, TENSOR[8, 3]]
        check_cells(mesh.points, cells)
        assert cell_sizes(mesh.points[cells]).sum() == pytest.approx(volume, rel=1e-12)
        assert len(cells) == share * len(found.mesh(found.COARSER).cells)


def test_walls_that_leap_beside_corners_have_no_folded_cells():
    """Every point of the wall as thin or as thick as it may be."""
    arm = solid_arm(MPI.COMM_SELF, cells=(8, 3, 2), hollow=True, wall=0.002, max_wall=0.004)
    x_phys = np.where(np.arange(arm.mesh.num_cells) % 3, 0.0, 1.0)
    found = make_hollow_part(arm.mesh, x_phys)
    assert np.ptp(found.thickness) > 0.0005
    for mesh in (found.mesh(found.COARSER), found.mesh()):
        check_cells(mesh.points, mesh.cells[:, TENSOR[8, 3]])


def test_no_curves_are_asked_for():
    """The inner surface has none."""
    arm = solid_arm(MPI.COMM_SELF, cells=(8, 3, 2), hollow=True, wall=0.002)
    with pytest.raises(InputError, match="--tolerance"):
        make_hollow_part(arm.mesh, arm.uniform(), Curves(tolerance=1e-4))


@pytest.mark.slow
def test_part_toml_does_what_the_design_does(tmp_path):
    """The design's own cells in the .msh file have its mass; a finer wall is a little softer."""
    changes = (
        "arms.link1.hollow=true", "arms.link1.wall=0.002", "arms.link1.cells=[10,3,2]",
        "arms.link2.cells=[6,2,2]", "arms.link2.rigid=true", "arms.link2.mass=0.5",
        "design.initial=0.5",
    )  # fmt: skip
    told = [word for one in changes for word in ("--set", one)]
    scene = ROOT / "demos" / "spatial_arm.toml"
    run("simulate", scene, "--out", tmp_path / "run", "--no-plots", *told)
    run("part", tmp_path / "run", "--no-plots", "--no-check")
    folder = tmp_path / "run" / "part"
    figures = json.loads((folder / "part.json").read_text())["arms"]["link1"]
    summary = summary_of(tmp_path / "run")
    assert figures["mass"] == pytest.approx(summary["mass"]["link1"], rel=1e-3)
    assert figures["least_wall"] == pytest.approx(0.002, rel=1e-9)
    assert {path.suffix for path in folder.glob("link1.*")} == {".stl", ".3mf", ".msh"}
    again = do.Model(folder / "part.toml").simulate()
    assert again.max_deviation == pytest.approx(summary["max_deviation"], rel=0.03)


@pytest.mark.slow
def test_the_forearm_of_a_robot_is_lighter_than_the_tube(tmp_path):
    """The demo's tube weighs what a box with walls does; 1.79 kg after 10 iterations."""
    pytest.importorskip("yourdfpy")
    try:
        metadata.distribution("example-robot-data")
    except metadata.PackageNotFoundError:
        pytest.skip("needs the meshes of the extra 'robot-data' (example-robot-data)")
    tube, link = demo("demo_ur10_forearm").main(tmp_path, 10)
    wall, height, width, length = 0.002858, 0.121, 0.137, 0.5723
    section = height * width - (height - 2.0 * wall) * (width - 2.0 * wall)
    assert tube["mass [kg]"] == pytest.approx(2700.0 * section * length, rel=1e-4)
    assert link["mass [kg]"] < 0.85 * tube["mass [kg]"]
    for name in ("deviation [um]", "orientation [mrad]"):
        assert link[name] <= tube[name]
