"""Files of results: of any run, and of controlled machines and closed loops."""

import meshio
import numpy as np
import pytest
from loops import BOOM_TABLE, bar, boom, closed, flexible, four_bar
from machines import controlled, loop
from mpi4py import MPI
from remainders import built_of
from runs import TWO_ARM, by_root, contents, summary_of

import dolfinopt as do
from dolfinopt.output import run_folder as results
from dolfinopt.output.design import Designed
from dolfinopt.output.run_folder import simulated, views_of, write_result

WORLD = MPI.COMM_WORLD


def left_by(scene, folder):
    """Return trajectory.npz, trajectory.csv, summary.json, trajectory; both files hold the same."""
    built = built_of(scene)
    x = built.uniform()
    one = simulated(Designed(*built.place, x), built.profile)
    trajectory = one.trajectory
    write_result(folder, one, 0.0, paraview=False)
    with np.load(folder / "trajectory.npz") as data:
        arrays = {name: data[name] for name in data.files}
    table = np.genfromtxt(folder / "trajectory.csv", delimiter=",", names=True)
    assert trajectory is None or np.array_equal(trajectory.sampled.t, arrays["t"])
    summary = summary_of(folder)
    named = dict(text.split(": ", 1) for text in arrays["units"].tolist())
    assert set(named) == set(arrays) - {"units"} and all(named.values())
    assert list(summary["units"]["trajectory.csv"]) == list(table.dtype.names)
    np.testing.assert_allclose(table["t"], arrays["t"], atol=1e-12)
    return arrays, table, summary, trajectory


@pytest.mark.serial
def test_control_leaves_desired_and_actual_coordinates_and_its_forces(tmp_path):
    arrays, table, summary, trajectory = left_by(controlled(), tmp_path)
    error = arrays["q_r"] - arrays["q_r_desired"]
    assert 0.0 < np.abs(error[:, 0]).max() < 1e-3  # m
    np.testing.assert_allclose(table["q_r_desired_arm2"], arrays["q_r_desired"][:, 2], rtol=1e-9)
    # u = u_ff - Kp e - Kd ed, with the feed-forward of the problem itself.
    sampled = trajectory.sampled
    rate = sampled.unknowns[1][:, :3]
    ahead = trajectory.problem.at(arrays["t"]).ahead
    u = ahead - np.array([2e5, 2e4, 2e4]) * error - np.array([2e4, 600.0, 600.0]) * rate
    np.testing.assert_allclose(arrays["joint_forces"], u, rtol=1e-9, atol=1e-6)
    assert summary["units"]["drive_error_peak"] == {"cart": "m", "arm1": "rad", "arm2": "rad"}
    for k, name in enumerate(("cart", "arm1", "arm2")):
        # Every 10 ms there are smaller ones: figures look every millisecond.
        peak = np.abs(trajectory.joint_forces[:, k]).max()
        assert summary["drive_peak"][name] == pytest.approx(peak, rel=1e-12)
        away = np.abs(trajectory.q_r[:, k] - trajectory.desired.q[:, k]).max()
        assert summary["drive_error_peak"][name] == pytest.approx(away)
        assert np.abs(error[:, k]).max() < away
    assert "closure_peak" not in summary and "closure_force" not in arrays
    # The real end-effector from the desired path, the semicircle of 1 m: at rest in the end.
    place = sampled.end - arrays["deviation"]
    np.testing.assert_allclose(np.hypot(*place.T), 1.0, atol=1e-12)
    assert summary["max_deviation"] == pytest.approx(np.hypot(*trajectory.deviation.T).max())
    assert summary["settling"] < summary["max_deviation"]


@pytest.mark.serial
def test_slider_leaves_its_place_and_the_force_of_its_guide(tmp_path):
    arrays, table, summary, trajectory = left_by(loop(), tmp_path)
    assert arrays["closure_force"].shape == (101, 1)
    np.testing.assert_allclose(table["closure_force_normal"], arrays["closure_force"][:, 0])
    np.testing.assert_allclose(table["slider_position"], arrays["slider_position"], rtol=1e-9)
    assert list(summary["drive_peak"]) == list(summary["drive_rms"]) == ["crank"]
    assert summary["units"]["drive_peak"] == {"crank": "N m"}
    assert not np.any(arrays["joint_forces"][:, 2])  # the rod's joint follows
    # Deviation is along the line alone: position less that of rigid arms.
    crank = arrays["q_r"][:, 1]
    rigid = 0.15 * np.cos(crank) + np.sqrt(0.3**2 - (0.15 * np.sin(crank)) ** 2)
    away = arrays["slider_position"] - rigid
    np.testing.assert_allclose(arrays["deviation"][:, 0], away, atol=1e-12)
    assert np.abs(arrays["deviation"][:, 1]).max() < 1e-8
    peak = np.abs(trajectory.closure_force).max()
    assert summary["closure_peak"]["closure"]["N"] == pytest.approx(peak, rel=1e-12)


@pytest.mark.serial
def test_force_of_the_guide_is_positive_on_the_side_that_is_documented(tmp_path):
    """A standing slider-crank under gravity: the guide holds up part of the slider's weight."""
    still = {"speed": 1e-3, "start_angle": 1.0, "gravity": [0.0, -9.81]}
    for direction, sign in (([1.0, 0.0], 1.0), ([-1.0, 0.0], -1.0)):
        closure = {"kind": "slider", "direction": direction, "side": -1}
        scene = loop(motion=still, closure=closure)
        folder = tmp_path / f"side{sign:+.0f}"
        folder.mkdir()
        arrays, _, summary, _ = left_by(scene, folder)
        force, rod = arrays["closure_force"][:, 0], summary["mass"]["rod"]
        # Moments about the crank pin: the slider's weight, and half the rod's.
        expected = sign * 9.81 * (0.5 + 0.5 * rod)
        np.testing.assert_allclose(force, expected, rtol=2e-3)
        assert np.sign(arrays["slider_position"][0]) == sign


@pytest.mark.serial
def test_pin_leaves_its_force_along_x_and_y(tmp_path):
    arrays, table, summary, _ = left_by(loop("pin"), tmp_path)
    assert arrays["closure_force"].shape == (101, 2)
    np.testing.assert_allclose(table["closure_force_y"], arrays["closure_force"][:, 1])
    np.testing.assert_array_equal(table["closure_closure_y"], table["closure_force_y"])
    assert "slider_position" not in arrays
    assert list(summary["drive_peak"]) == ["crank"]
    largest = np.hypot(*arrays["closure_force"].T).max()
    assert summary["closure_peak"]["closure"]["N"] == pytest.approx(largest, rel=1e-12)
    assert summary["max_deviation"] < 1e-7  # m: the end is pinned
    assert summary["stiffening"]["on"] in (True, False)


@pytest.mark.serial
def test_loops_in_space_leave_their_forces_and_what_follows(tmp_path):
    """A cylinder's force is its drive's; a pin has forces and moments; what is left out is told."""
    folders = [tmp_path / name for name in ("boom", "linkage")]
    for folder in folders:
        folder.mkdir()
    arrays, table, summary, _ = left_by(closed(tmp_path, BOOM_TABLE, boom()), folders[0])
    assert arrays["q_r"].shape[1] == 3 and not np.any(arrays["joint_forces"][:, 1])
    np.testing.assert_allclose(table["closure_cylinder"], table["joint_force_cylinder"], rtol=1e-9)
    assert summary["units"]["drive_peak"] == {"slew": "N m", "cylinder": "N"}
    [peak] = summary["closure_peak"]["cylinder"].values()
    assert [*summary["closure_peak"]["cylinder"]] == ["N"]
    assert peak == pytest.approx(summary["drive_peak"]["cylinder"])
    assert not any("closures" in one for one in summary["warnings"])
    # With an arm beside it all of the linkage is rigid.
    tree = four_bar()
    tree["arms"] = [*tree["arms"][:2], bar("rocker", 0.25), flexible("tool", 0.5)]
    tree["joints"].append({"name": "hold", "type": "fixed", "parent": "crank", "child": "tool"})
    scene = closed(tmp_path, "t,turn\n0,0.5\n1,1.0\n", tree, reduction={"coordinates": 6})
    arrays, table, summary, _ = left_by(scene, folders[1])
    assert arrays["closure_force"].shape[1] == 5
    for k, name in enumerate(("x", "y", "z", "moment_1", "moment_2")):
        column = table[f"closure_foot_{name}"]
        np.testing.assert_allclose(column, arrays["closure_force"][:, k], atol=1e-9)
    assert set(summary["closure_peak"]["foot"]) == {"N", "N m"}
    (told,) = [one for one in summary["warnings"] if one.startswith("closures")]
    assert "of 5 equations 3 follow from the others" in told


# -- what a run leaves: the same files from both ways, the summary last  --------------------------


SMALL = ("arms.cells=[20,3]", "optimizer.max_iterations=1", "simulation.sample=0.01")
PARAVIEW = {"design.vtu"}
FILES = {"budget.csv", "design.npz", "summary.json", "trajectory.csv", "trajectory.npz"}


@pytest.fixture(scope="module")
def result():
    return do.optimize(do.load_scene(TWO_ARM, SMALL))


def simulated_again(result):
    design = do.load_scene(TWO_ARM, SMALL), result.partition, result.arms, result.x_phys
    return simulated(Designed(*design), do.Profile())


@pytest.mark.parametrize("paraview", [True, False])
def test_files(result, shared_tmp_path, paraview):
    one, other = shared_tmp_path / "one", shared_tmp_path / "other"
    by_root(lambda: (one.mkdir(), other.mkdir()))
    scene = do.load_scene(TWO_ARM, SMALL)
    first, (views, _) = write_result(one, result, 12.5, paraview=paraview), views_of(result)
    second = write_result(other, simulated_again(result), 2.5, paraview=paraview)
    if WORLD.rank > 0:
        assert first is None and second is None
        return
    expected = FILES | PARAVIEW if paraview else FILES
    for folder, wall, iterations in ((one, 12.5, 1), (other, 2.5, 0)):
        assert set(contents(folder)) == expected
        summary = summary_of(folder)
        assert wall <= summary["seconds"]["total"] < wall + 60.0
        assert summary["iterations"] == iterations
    assert [view.name for view in views] == ["arm1", "arm2"]
    assert first["compliance"] == result.evaluation.compliance
    if paraview:
        _check_stress(first, views, one / "design.vtu")
    # Of one design: the same keys in the same order, and motions to the scene's tolerance.
    assert list(first) == list(second)
    assert first["volume_fraction"] == second["volume_fraction"]
    # The optimisation's steps are those of the design before; energies take twice the error.
    error = 4.0 * scene.simulation.tolerance
    assert first["compliance"] == pytest.approx(second["compliance"], rel=error)


def _check_stress(summary, views, vtu):
    """The largest stress of the summary is that of its cell in the map, in ParaView's file, too."""
    found = summary["stress"]
    view = next(view for view in views if view.name == found["arm"])
    worst = int(np.argmax(view.stress))
    assert view.stress[worst] == pytest.approx(found["value"], rel=1e-3)
    assert found["value"] == max(found["by_arm"].values())
    assert list(found["by_arm"]) == ["arm1", "arm2"]
    assert 0.0 < found["instant"] <= 3.0 and len(found["place"]) == 2
    assert found["at_gauss_points"]["value"] > found["value"]
    assert summary["units"]["stress"] == "Pa"
    whole = np.concatenate([view.stress for view in views])
    np.testing.assert_allclose(meshio.read(vtu).cell_data["stress"][0], whole, rtol=1e-9)


def test_summary_comes_last(result, shared_tmp_path, monkeypatch):
    """Whatever fails before, no folder looks complete."""

    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(results, "write_trajectory", fail)
    one = simulated_again(result)
    with pytest.raises(OSError, match="disk full"):
        write_result(shared_tmp_path, one, 1.0)
    assert not (shared_tmp_path / "summary.json").exists()
