"""The commands on controlled machines and closed loops."""

import numpy as np
import pytest
from machines import controlled, loop
from mpi4py import MPI
from runs import by_root, contents, refusal, run, summary_of
from scipy.io import loadmat

from dolfinopt.part.folder import toml_text

WORLD = MPI.COMM_WORLD
QUICK = ["--set", "simulation.tolerance=1e-3"]


@pytest.fixture
def write_scene(write):
    """Return what writes a scene's file on the root; it returns its path."""
    return lambda scene: write("machine.toml", toml_text({"name": scene.name} | scene.to_tree()))


SCENES = {"slider": loop, "pin": lambda: loop("pin"), "control": controlled}


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("kind", SCENES)
def test_simulate_draws_and_plot_draws_again(kind, shared_tmp_path, write_scene):
    path, out = write_scene(SCENES[kind]()), shared_tmp_path / "out"
    film = ["--animation"] if kind == "pin" else []
    run("simulate", path, *QUICK, "--out", out, *film)
    pictures = {"design.png", "machine.png", "drives.png", "stress.png"}
    pictures |= {"motion.gif"} if film else {"deviation.png"}
    assert {name for name in contents(out) if name.endswith(("png", "gif"))} == pictures
    summary = summary_of(out)
    assert summary["converged"] and summary["ranks"] == WORLD.size
    by_root((out / "drives.png").unlink)
    run("plot", out)
    assert (out / "drives.png").stat().st_size > 5000


def test_state_space_of_a_run_and_of_a_scene(shared_tmp_path, capsys, write_scene):
    """Both files hold the same matrices, with names, whatever the ranks; refusals write nothing."""
    path, out = write_scene(controlled()), shared_tmp_path / "run"
    run("simulate", path, *QUICK, "--out", out, "--no-plots")
    run("export", out, "--state-space", 3.0)
    run("export", path, *QUICK, "--state-space", 3.0, "--out", shared_tmp_path / "scene")
    folders = (out / "state-space", shared_tmp_path / "scene")
    first, second = (np.load(one / "state_space.npz") for one in folders)
    for key in first.files:  # numbers to rounding: where arrays lie in memory may tell
        a, b = first[key], second[key]
        if a.dtype.kind in "fc":
            assert np.allclose(a, b, rtol=1e-9, atol=1e-12 * np.abs(a).max(initial=0.0))
        else:
            assert np.array_equal(a, b)
    matlab = loadmat(folders[0] / "state_space.mat")
    for key in "ABCD":
        assert np.array_equal(matlab[key], first[key])
    assert [str(one[0]) for one in matlab["inputs"][:, 0]] == list(first["inputs"])
    assert first["A"].shape == (len(first["states"]),) * 2
    if WORLD.rank == 0:
        told = capsys.readouterr().out
        assert "with its control, at 3 s: 22 states, 6 inputs, 7 outputs" in told
    for words, expected in (
        ([path, "--state-space", 5.0], "motion.horizon = 3"),
        ([path, "--state-space", 1.0, "--urdf"], "--urdf"),
        ([out, "--state-space", 1.0, "--set", "payload.mass=2"], "--set"),
        ([out], "--state-space T"),
    ):
        line = ["export", *words, "--out", shared_tmp_path / "none"]
        refusal(lambda line=line: run(*line), expected)
    assert not (shared_tmp_path / "none").exists()


def test_bodies_of_a_loop_are_exported(shared_tmp_path, write_scene):
    run("export", write_scene(loop("pin")), "--out", shared_tmp_path / "bodies")
    arms, kinds = ("coupler", "rocker"), (".sid", ".sid.npz", ".fem")
    assert set(contents(shared_tmp_path / "bodies")) == {a + kind for a in arms for kind in kinds}


@pytest.mark.slow
@pytest.mark.serial
def test_gradient_of_machines_is_checked(shared_tmp_path, capsys, write_scene):
    """Control's gradient: tests/responses/test_gradients.py."""
    tight = ["--set", "simulation.tolerance=1e-4", "--set", "objective.kind=compliance"]
    out = shared_tmp_path / "gradient.npz"
    run("gradient", write_scene(loop()), *tight, "--kind", "exact", "--check", "--out", out)
    if WORLD.rank == 0:
        table = [line for line in capsys.readouterr().out.splitlines() if "e-" in line]
        rates = [float(line.split()[-1]) for line in table if line.split()[-1][0].isdigit()]
        assert len(rates) >= 4
        np.testing.assert_allclose(rates, 2.0, atol=0.05)


def test_a_table_without_a_column_leaves_no_folder(shared_tmp_path, write, write_scene):
    write("drive.csv", "t,cart\n0,0\n1,1")
    line = ["simulate", write_scene(controlled()), "--set", "control.forces=drive.csv", "--out"]
    refusal(lambda: run(*line, shared_tmp_path / "out"), "drive.csv: line 1", "column 'arm1'")
    WORLD.barrier()
    assert not (shared_tmp_path / "out").exists()
