"""The commands on controlled machines and closed loops."""

import json

import numpy as np
import pytest
from machines import controlled, loop
from mpi4py import MPI
from runs import refusal, run

from dolfinopt.part.files.scene_file import toml_text

WORLD = MPI.COMM_WORLD
QUICK = ["--set", "simulation.tolerance=1e-3"]


def write_scene(scene, folder):
    """Write a scene's file on the root; return its path."""
    path = folder / "machine.toml"
    if WORLD.rank == 0:
        path.write_text(toml_text({"name": scene.name} | scene.to_tree()))
    WORLD.barrier()
    return path


SCENES = {"slider": loop, "pin": lambda: loop("pin"), "control": controlled}


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("kind", SCENES)
def test_simulate_draws_and_plot_draws_again(kind, shared_tmp_path):
    path, out = write_scene(SCENES[kind](), shared_tmp_path), shared_tmp_path / "out"
    film = ["--animation"] if kind == "pin" else []
    run("simulate", path, *QUICK, "--out", out, *film)
    WORLD.barrier()
    pictures = {"design.png", "machine.png", "drives.png", "stress.png"}
    pictures |= {"motion.gif"} if film else {"deviation.png"}
    drawn = {one.name for one in out.iterdir() if one.suffix in (".png", ".gif")}
    assert drawn == pictures
    summary = json.loads((out / "summary.json").read_text())
    assert summary["converged"] and summary["ranks"] == WORLD.size
    WORLD.barrier()
    if WORLD.rank == 0:
        (out / "drives.png").unlink()
    WORLD.barrier()
    run("plot", out)
    WORLD.barrier()
    assert (out / "drives.png").stat().st_size > 5000


def test_bodies_of_a_loop_are_exported(shared_tmp_path):
    path = write_scene(loop("pin"), shared_tmp_path)
    run("export", path, "--out", shared_tmp_path / "bodies")
    WORLD.barrier()
    written = {one.name for one in (shared_tmp_path / "bodies").iterdir()}
    arms, kinds = ("coupler", "rocker"), (".sid", ".sid.npz", ".fem")
    assert written == {arm + kind for arm in arms for kind in kinds}


@pytest.mark.slow
@pytest.mark.serial
def test_gradient_of_machines_is_checked(shared_tmp_path, capsys):
    """Control's gradient: tests/responses/test_machine_gradients.py."""
    path = write_scene(loop(), shared_tmp_path)
    tight = ["--set", "simulation.tolerance=1e-4", "--set", "objective.kind=compliance"]
    out = shared_tmp_path / "gradient.npz"
    run("gradient", path, *tight, "--kind", "exact", "--check", "--out", out)
    WORLD.barrier()
    if WORLD.rank == 0:
        table = [line for line in capsys.readouterr().out.splitlines() if "e-" in line]
        rates = [float(line.split()[-1]) for line in table if line.split()[-1][0].isdigit()]
        assert len(rates) >= 4
        np.testing.assert_allclose(rates, 2.0, atol=0.05)


def test_a_table_without_a_column_leaves_no_folder(shared_tmp_path):
    path = write_scene(controlled(), shared_tmp_path)
    if WORLD.rank == 0:
        (shared_tmp_path / "drive.csv").write_text("t,cart\n0,0\n1,1\n")
    WORLD.barrier()
    out = shared_tmp_path / "out"
    line = ["simulate", path, "--set", "control.forces=drive.csv", "--out", out]
    refusal(lambda: run(*line), "drive.csv: line 1", "column 'arm1'")
    WORLD.barrier()
    assert not out.exists()
