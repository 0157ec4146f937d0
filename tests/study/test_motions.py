"""Motions of one machine side by side: rigid path, input shapers, feed-forward."""

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT, refusal

import dolfinopt as do
from dolfinopt.dynamics.build import build_system, desired_motion
from dolfinopt.scene.csv_table import read_table
from dolfinopt.study.cases import Runner
from dolfinopt.study.motions import RIGID, SHAPERS, study_motions

QUICK = ("arms.cells=[20,3]", "design.filter_radius=0", "simulation.tolerance=1e-3",
         "optimizer.max_iterations=1", "motion.horizon=2.3")  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """The study of two small arms, and its folder."""
    folder = tmp_path_factory.mktemp("motions")
    scene = do.load_scene(ROOT / "demos" / "two_arm.toml", QUICK)
    runner = Runner(folder, MPI.COMM_SELF, False)
    return runner.follow(study_motions(scene, (), folder)), folder, scene


@pytest.mark.serial
@pytest.mark.slow
def test_table(found):
    """Shapers end the vibration, feed-forward the deviation; both cost time."""
    study, _, scene = found
    frame = study.tables[0].frame.set_index("motion")
    rigid, forward = frame.loc[RIGID], frame.loc["feed-forward"]
    deviation, settling, finer = "maximal deviation [mm]", "settling [mm]", "finer model [mm]"
    assert forward[deviation] < 1e-3 * rigid[deviation]
    assert forward[finer] < 0.02 * rigid[finer]  # what geometric stiffness changes
    # 0.50, 0.33 and 0.31: forces of large rotations are no linear function of the joints.
    for label, limit in zip(SHAPERS.values(), (0.6, 0.4, 0.4), strict=True):
        assert frame.loc[label, settling] < limit * rigid[settling]
        assert frame.loc[label, deviation] > 0.5 * rigid[deviation]
        assert 0.0 < frame.loc[label, "longer by [s]"] < 0.5
    # Ten per cent of the payload leave about ten per cent of what bends the arms.
    share = forward["payload + 10 % [mm]"] / rigid[deviation]
    assert 0.03 < share < 0.2
    assert scene.rigid_units.keys() == {"cart", "arm1", "arm2"}
    assert (frame["peak arm1 [N m]"] > 0.0).all() and len(frame) == 6


@pytest.mark.serial
@pytest.mark.slow
def test_shaped_joints_are_the_command_in_parts(found):
    _, folder, scene = found
    table = read_table(str(folder / "motions" / "zv.csv"), scene.driven)
    assert table.t is not None
    late = table.t[-1] - scene.motion.duration
    begin, end = table.rows[0], table.rows[-1]
    early = table.t < 0.9 * late  # of the first part alone
    first = table.rows[early] - begin
    whole = desired_motion(scene)(table.t[early]).q - begin
    share = np.linalg.lstsq(whole.reshape(-1, 1), first.ravel(), rcond=None)[0][0]
    assert 0.5 < share < 0.52  # 1 / (1 + K) with little damping
    assert first == pytest.approx(share * whole, abs=1e-9)
    assert np.abs(end - desired_motion(scene)(np.array([2.3])).q[0]).max() < 1e-12


def test_vibration_is_the_first_frequency_of_the_machine():
    """With joints held, at the motion's end; damped in proportion to stiffness."""
    scene = do.load_scene(ROOT / "demos" / "two_arm.toml", QUICK)
    result = do.Model(scene).simulate()
    if result.trajectory is None:  # another rank's
        return
    system = build_system(scene, list(result.trajectory.mechanism.bodies))
    frequency, ratio = system.slowest_vibration(2)
    assert ratio == pytest.approx(0.5 * scene.damping.stiffness_proportional * frequency)
    assert frequency > 0.0


def test_refused(tmp_path):
    pinned = do.load_scene(ROOT / "demos" / "four_bar.toml")
    refusal(lambda: next(study_motions(pinned, (), tmp_path)), "feed_forward.kind")
