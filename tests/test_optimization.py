"""The loop: what it reaches, that it resumes in the same bits, and on any number of ranks."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

import dolfinopt as do
from dolfinopt import checkpoint

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "demos" / "two_arm.toml"
WORLD = MPI.COMM_WORLD


def scene(*overrides):
    return do.load_scene(SCENE, overrides)


def small(*overrides, iterations=6):
    return scene("arms.cells=[40,4]", f"optimizer.max_iterations={iterations}", *overrides)


def command(*arguments, ranks=0):
    line = [sys.executable, "-m", "dolfinopt", *map(str, arguments)]
    return ["mpirun", "-n", str(ranks), *line] if ranks else line


# As it was before this process began MPI, which would confuse another mpirun.
ENVIRONMENT = dict(os.environ)


@pytest.mark.slow
def test_two_arm_manipulator():
    """The paper's example. An independent model reaches 2.6 N m in 200 iterations."""
    result = do.optimize(scene("optimizer.max_iterations=60"))
    if WORLD.rank == 0:
        first, last = result.history[0], result.history[-1]
        assert first.objective == pytest.approx(28.038, rel=1e-4)
        assert first.max_deviation == pytest.approx(55.575e-3, rel=1e-4)
        assert last.objective < 2.6
        assert last.max_deviation < 8e-3
        assert last.volume_fraction == pytest.approx(0.5, abs=1e-4)
        assert last.grayness < 0.35


def test_volume_limits():
    """Each arm keeps its own limit; a shared limit lets material move to the inner arm."""
    for shared in (False, True):
        settings = ["design.shared_volume=true"] if shared else []
        result = do.optimize(small(*settings, iterations=25))
        mine = {k: arm.volume_fraction(result.x_phys[k]) for k, arm in result.arms.items()}
        fractions = list(do.gather_arms(result.share, mine).values())
        if WORLD.rank == 0:
            assert np.mean(fractions) == pytest.approx(0.5, abs=2e-3)
            if shared:
                assert fractions[0] > 0.52 and fractions[1] < 0.48  # 0.531, 0.469
            else:
                assert fractions == pytest.approx([0.5, 0.5], abs=2e-3)


def test_stops_when_the_design_rests():
    result = do.optimize(small("optimizer.tolerance=0.05", iterations=200))
    assert result.converged and result.iterations < 200
    if WORLD.rank == 0:
        assert result.history[-1].change <= 0.05 < result.history[-2].change


def test_no_iterations_evaluate_the_initial_design():
    result = do.optimize(small(iterations=0))
    assert result.iterations == 0 and not result.converged
    assert len(result.history) == (1 if WORLD.rank == 0 else 0)


def test_passive_cells_stay_solid():
    result = do.optimize(small("arms.passive=0.05", iterations=4))
    for k, arm in result.arms.items():
        assert arm.mesh.passive.sum() == 2 * 2 * 4  # two columns of four cells at both ends
        assert (result.x_phys[k][arm.mesh.passive] == 1.0).all()


def test_load_cases_cost_nothing():
    """The work of an iteration does not depend on the number of load cases."""
    few = do.optimize(small("objective.load_cases=3", iterations=2))
    many = do.optimize(small("objective.load_cases=300", iterations=2))
    assert replace(few.ledger.counts, newton_iterations=0) == replace(
        many.ledger.counts, newton_iterations=0
    )


def test_three_coordinates_need_no_eigenproblem():
    result = do.optimize(small("reduction.coordinates=3", iterations=1))
    assert result.ledger.counts.eigenproblems == 0
    if result.arms:
        assert result.ledger.counts.factorisations == 2 * len(result.arms)


# -- resume ----------------------------------------------------------------------------------


def test_resume_gives_the_same_bits(shared_tmp_path, monkeypatch):
    """Interrupted after any iteration, whatever was saved last: the same designs and history."""
    monkeypatch.setattr("dolfinopt.optimization.CHECKPOINT_INTERVAL", 0.0)
    folders = {name: shared_tmp_path / str(name) for name in ("whole", 0, 1, 4, 6)}
    if WORLD.rank == 0:
        for folder in folders.values():
            folder.mkdir()
    WORLD.barrier()
    whole = do.optimize(small(), folders["whole"])
    for stop in (0, 1, 4, 6):
        folder = folders[stop]
        interrupted = small(iterations=stop)
        do.optimize(interrupted, folder)
        resumed = do.optimize(small(), folder, resume=True)
        for k in whole.x_phys:
            np.testing.assert_array_equal(resumed.x_phys[k], whole.x_phys[k])
        rows = [replace(row, seconds=0.0) for row in resumed.history]
        assert rows == [replace(row, seconds=0.0) for row in whole.history]
        if WORLD.rank == 0:
            np.testing.assert_array_equal(resumed.initial_deviation, whole.initial_deviation)


@pytest.mark.serial
@pytest.mark.slow
def test_sigkill_and_resume(tmp_path):
    """Killed at any moment, a resumed run writes the same design to the last bit."""
    line = ["optimize", SCENE, "--set", "arms.cells=[40,4]", "--no-plots"]
    line += ["--set", "optimizer.max_iterations=120"]
    run = {"env": ENVIRONMENT, "check": True, "capture_output": True, "timeout": 120}
    subprocess.run(command(*line, "--out", tmp_path / "whole"), **run)
    for moment in (0.0, 0.5, 1.5):
        folder = tmp_path / str(moment)
        process = subprocess.Popen(command(*line, "--out", folder), env=ENVIRONMENT)
        deadline = time.monotonic() + 60.0
        while not (folder / checkpoint.NAME).exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(moment)
        process.send_signal(signal.SIGKILL)
        process.wait()
        subprocess.run(command(*line, "--out", folder, "--resume"), **run)
        with np.load(tmp_path / "whole" / "design.npz") as a, np.load(folder / "design.npz") as b:
            assert a.files == b.files
            for key in a.files:
                np.testing.assert_array_equal(a[key], b[key])


def test_damaged_checkpoint(shared_tmp_path):
    if WORLD.rank == 0:
        (shared_tmp_path / checkpoint.NAME).write_bytes(b"PK\x03\x04 no archive")
    WORLD.barrier()
    with pytest.raises(do.InputError, match="cannot read this checkpoint"):
        do.optimize(small(), shared_tmp_path, resume=True)


def test_more_iterations_may_be_asked_for_on_resume(shared_tmp_path):
    do.optimize(small(iterations=2), shared_tmp_path)
    assert do.optimize(small(iterations=3), shared_tmp_path, resume=True).iterations == 3


# -- ranks -----------------------------------------------------------------------------------


@pytest.mark.serial
@pytest.mark.slow
def test_same_design_on_any_number_of_ranks(tmp_path):
    """1, 2, 3 and 4 ranks: whole arms are dealt out, sums run in the arms' order."""
    designs = []
    for ranks in (1, 2, 3, 4):
        folder = tmp_path / str(ranks)
        line = ["optimize", SCENE, "--no-plots", "--out", folder]
        line += ["--set", "arms.cells=[100,6]", "--set", "optimizer.max_iterations=15"]
        subprocess.run(command(*line, ranks=ranks), env=ENVIRONMENT, check=True, timeout=120)
        with np.load(folder / "design.npz") as data:
            designs.append(np.concatenate([data[key].ravel() for key in data.files]))
    for other in designs[1:]:
        np.testing.assert_array_equal(other, designs[0])
