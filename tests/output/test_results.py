"""What a run leaves: the same files from both ways, the summary last."""

import meshio
import numpy as np
import pytest
from mpi4py import MPI
from remainders import built_of
from runs import TWO_ARM, by_root, contents, summary_of

import dolfinopt as do
from dolfinopt.fem.elements import ELEMENTS
from dolfinopt.output import run_folder as results
from dolfinopt.output.design import gather_views
from dolfinopt.output.run_folder import Simulated, write_result, write_simulation

WORLD = MPI.COMM_WORLD
SMALL = ("arms.cells=[20,3]", "optimizer.max_iterations=1", "simulation.sample=0.01")
PARAVIEW = {"design.vtu", "design.xdmf"}
FILES = {"budget.csv", "design.npz", "summary.json", "trajectory.csv", "trajectory.npz"}


@pytest.fixture(scope="module")
def result():
    return do.optimize(do.load_scene(TWO_ARM, SMALL))


def simulated(result):
    profile = do.Profile()
    design = do.load_scene(TWO_ARM, SMALL), result.partition, result.arms, result.x_phys
    return Simulated(*design, *do.evaluate(*design, profile), profile)


@pytest.mark.parametrize("paraview", [True, False])
def test_files(result, shared_tmp_path, paraview):
    one, other = shared_tmp_path / "one", shared_tmp_path / "other"
    by_root(lambda: (one.mkdir(), other.mkdir()))
    scene = do.load_scene(TWO_ARM, SMALL)
    written = write_result(scene, one, result, 12.5, paraview=paraview)
    again = write_simulation(other, simulated(result), 2.5, paraview=paraview)
    if WORLD.rank > 0:
        assert written is None and again is None
        return
    expected = FILES | PARAVIEW if paraview else FILES
    for folder, wall, iterations in ((one, 12.5, 1), (other, 2.5, 0)):
        assert set(contents(folder)) == expected
        summary = summary_of(folder)
        assert wall <= summary["seconds"]["total"] < wall + 60.0
        assert summary["iterations"] == iterations
    assert [view.name for view in written.views] == ["arm1", "arm2"]
    assert written.summary["compliance"] == result.evaluation.compliance
    if paraview:
        _check_stress(written, one / "design.vtu")
    # Of one design: the same keys in the same order, and motions to the scene's tolerance.
    first, second = written.summary, again.summary
    assert list(first) == list(second)
    assert first["volume_fraction"] == second["volume_fraction"]
    # The optimisation's steps are those of the design before; energies take twice the error.
    error = 4.0 * scene.simulation.tolerance
    assert first["compliance"] == pytest.approx(second["compliance"], rel=error)


def _check_stress(written, vtu):
    """The largest stress of the summary is that of its cell in the map, in ParaView's file, too."""
    found = written.summary["stress"]
    view = next(view for view in written.views if view.name == found["arm"])
    worst = int(np.argmax(view.stress))
    assert view.stress[worst] == pytest.approx(found["value"], rel=1e-3)
    assert found["value"] == max(found["by_arm"].values())
    assert list(found["by_arm"]) == ["arm1", "arm2"]
    assert 0.0 < found["instant"] <= 3.0 and len(found["place"]) == 2
    assert found["at_gauss_points"]["value"] > found["value"]
    assert written.summary["units"]["stress"] == "Pa"
    whole = np.concatenate([view.stress for view in written.views])
    np.testing.assert_allclose(meshio.read(vtu).cell_data["stress"][0], whole, rtol=1e-9)


def test_summary_comes_last(result, shared_tmp_path, monkeypatch):
    """Whatever fails before, no folder looks complete."""

    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(results, "write_trajectory", fail)
    one = simulated(result)
    with pytest.raises(OSError, match="disk full"):
        write_simulation(shared_tmp_path, one, 1.0)
    assert not (shared_tmp_path / "summary.json").exists()


@pytest.mark.parametrize("element", [*ELEMENTS])
def test_views_of_arms_without_a_current_design(element):
    """Designs that studies read but never assembled; nodes between corners are not drawn."""
    built = built_of(do.load_scene(TWO_ARM, [*SMALL, f"arms.element={element}"]))
    views = gather_views(built.scene, built.partition, built.arms, built.uniform())
    if WORLD.rank == 0:
        assert [view.name for view in views] == ["arm1", "arm2"]
        for view in views:
            assert view.corners.shape == (60, 4, 2) and view.modes.shape[-1] == 0
            assert view.corners[..., 0].max() - view.corners[..., 0].min() == pytest.approx(1.0)
