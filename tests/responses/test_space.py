"""The yaw-pitch-pitch chain of solid links: its deviation, gradients of responses, its files."""

import numpy as np
import pytest
from mpi4py import MPI
from remainders import built_of
from runs import ROOT, overrides, run, summary_of

import dolfinopt as do

pytestmark = pytest.mark.serial
DEMO = ROOT / "demos" / "spatial_arm.toml"
COARSE = ("arms.link1.cells=[8,2,2]", "arms.link2.cells=[8,2,2]", "arms.passive=0.06",
          "simulation.sample=0.01", "objective.load_cases=6",
          "simulation.stiffening=false")  # fmt: skip
SOLID = ("design.initial=1.0", "design.volume_fraction=1.0")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a simulation of solid links."""
    out = tmp_path_factory.mktemp("space") / "run"
    keys = (f"arms.{link}.{key}" for link in ("link1", "link2")
            for key in ("cells=[16,3,2]", "element=quadratic"))  # fmt: skip
    changes = overrides(*SOLID, *keys, "simulation.sample=0.002")
    run("simulate", DEMO, "--out", out, "--no-plots", *changes)
    return out


def test_deviation_of_the_demo(folder):
    """Within 1 % of nonlinear beams with rigid end faces, 18.62 mm; the demo's cells 18.49 mm."""
    # 20 x 4 x 3 quadratic cells: 18.69 mm.
    summary = summary_of(folder)
    assert summary["max_deviation"] == pytest.approx(18.62e-3, rel=0.01)
    assert summary["max_deviation"] == pytest.approx(18.612e-3, rel=1e-4)
    assert summary["max_deviation_time"] == pytest.approx(0.416, abs=0.003)
    assert summary["mass"] == pytest.approx({"column": 0.0, "link1": 1.08, "link2": 0.972})
    assert set(summary["drive_peak"]) == {"yaw", "shoulder", "elbow"}
    assert len(summary["stress"]["place"]) == 3
    assert summary["units"]["drive_peak"] == dict.fromkeys(("yaw", "shoulder", "elbow"), "N m")


def test_files_in_space(folder):
    with np.load(folder / "trajectory.npz") as found:
        assert found["q_r"].shape == found["joint_forces"].shape == (301, 3)
        assert found["deviation"].shape == found["rotation"].shape == (301, 3)
        assert found["q_r"][-1] == pytest.approx([1.6, 1.1, -0.5])
        deviation = found["deviation"]
    table = np.genfromtxt(folder / "trajectory.csv", delimiter=",", names=True)
    assert np.abs(table["deviation_z"] - deviation[:, 2]).max() < 1e-9
    assert table["q_r_elbow"][0] == -1.9
    with np.load(folder / "design.npz") as found:
        assert found["link1/centroid"].shape == (16 * 3 * 2, 3)
    pyvista = pytest.importorskip("pyvista")
    grid = pyvista.read(folder / "design.vtu")
    assert grid.n_cells == 2 * 96 and set(grid.celltypes) == {12}
    assert grid.volume == pytest.approx(0.95 * 0.04 * 0.02, rel=1e-9)
    # Of places that are equal but for rounding the map's largest is the one that is told.
    told = summary_of(folder)["stress"]
    worst = int(np.argmax(grid["stress"]))
    assert grid["stress"][worst] == pytest.approx(told["value"], rel=1e-9)
    assert grid.cell_centers().points[worst] == pytest.approx(told["place"], abs=1e-6)


@pytest.mark.parametrize("stiffening", ["false", "auto"])
def test_no_geometric_stiffness_is_built_where_none_is_asked_for(monkeypatch, stiffening):
    """It takes two thirds of the memory of tetrahedra; the estimate of "auto" needs it."""
    from dolfinopt.arms import design_state
    from dolfinopt.arms.arm import stiffening_of

    built = []

    def counted(arm):
        built.append(arm)
        return unit_loads(arm)

    unit_loads = design_state.unit_loads
    monkeypatch.setattr(design_state, "unit_loads", counted)
    scene = do.load_scene(DEMO, (*COARSE, f"simulation.stiffening={stiffening}"))
    machine = built_of(scene, MPI.COMM_SELF)
    machine.gradient(machine.evaluate(machine.uniform())[1])
    assert bool(built) == (stiffening == "auto")
    assert (stiffening_of(machine.arms).estimate is None) == (stiffening == "false")
