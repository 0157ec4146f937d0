"""Ctrl-C at any moment of a command: one line, status 130."""

import os
import shutil
import signal
import subprocess
import sys
import time

import click
import pytest
from mpi4py import MPI
from runs import environment

from dolfinopt import interrupt
from dolfinopt.cli.main import commands
from dolfinopt.data import paper_scene
from dolfinopt.mesh.gmsh_session import gmsh_on_root

# Interrupts this process when a module is first imported, or when MPI is left.
SCRIPT = """
import os, signal, sys
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)
        return None
sys.meta_path.insert(0, Interrupting())
sys.argv = {arguments!r}
import runpy
runpy.run_module("dolfinopt", run_name="__main__", alter_sys=True)
"""
MOMENTS = ["dolfinopt.cli", "click", "pydantic", "petsc4py", "mpi4py.MPI", "dolfinopt.parallel"]
MOMENTS += ["dolfinx", "gmsh", "dolfinopt.responses.evaluation", "dolfinopt.output.summary"]


def run(module, tmp_path, *launcher):
    arguments = ["dolfinopt", "simulate", str(paper_scene()), "--out", str(tmp_path / "out")]
    arguments += ["--no-plots", "--set", "arms.cells=[12,3]", "--set", "design.filter_radius=0.2"]
    script = SCRIPT.format(module=module, arguments=arguments)
    line = [*launcher, sys.executable, "-c", script]
    options = {"capture_output": True, "text": True, "timeout": 120, "env": environment()}
    # A test run in the background of a shell ignores the signal, and so would its children.
    options["preexec_fn"] = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    return subprocess.run(line, **options)


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("module", MOMENTS)
def test_alone(module, tmp_path):
    done = run(module, tmp_path)
    lines = [one for one in done.stderr.splitlines() if one and "warning" not in one]
    assert lines == ["dolfinopt: interrupted"]
    assert done.returncode == 130 and done.stdout == ""
    assert not (tmp_path / "out" / "summary.json").exists()


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.skipif(shutil.which("mpirun") is None, reason="no mpirun")
@pytest.mark.parametrize("module", ["click", "mpi4py.MPI", "dolfinx"])
def test_under_mpirun(module, tmp_path):
    done = run(module, tmp_path, "mpirun", "-n", "2")
    assert done.stderr.splitlines().count("dolfinopt: interrupted") == 1
    assert "Traceback" not in done.stderr
    assert done.returncode == 130


def test_a_signal_that_is_somebody_elses_is_left_alone_and_gmsh_leaves_it_alone():
    before = signal.getsignal(signal.SIGINT)
    try:
        for handler in (signal.SIG_IGN, lambda *arguments: None):
            signal.signal(signal.SIGINT, handler)
            interrupt.end_at_once()
            assert signal.getsignal(signal.SIGINT) is handler
            assert not interrupt.raise_again()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        interrupt.end_at_once()
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        assert interrupt.raise_again()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    # On no rank does Ctrl-C kill without a word, during a session of Gmsh or after it.
    with gmsh_on_root(MPI.COMM_WORLD):
        assert signal.getsignal(signal.SIGINT) is before
    assert signal.getsignal(signal.SIGINT) is before


LAUNCHER = """
import os, subprocess, sys, time
rank = (
    "import time; from dolfinopt.interrupt import end_with_launcher; end_with_launcher(0.05); "
    "print('ready', flush=True); time.sleep(60)"
)
environment = {**os.environ, "OMPI_COMM_WORLD_RANK": "0"}
child = subprocess.Popen([sys.executable, "-c", rank], env=environment, stdout=subprocess.PIPE)
child.stdout.readline()
print(child.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.serial
def test_ranks_end_with_a_launcher_that_is_killed():
    line = [sys.executable, "-c", LAUNCHER]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as launcher:
        rank = int(launcher.stdout.readline())
        os.kill(rank, 0)  # it is there
        launcher.kill()
    limit = time.monotonic() + 30.0
    while alive(rank):
        assert time.monotonic() < limit
        time.sleep(0.05)


def alive(process):
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        with open(f"/proc/{process}/stat") as state:
            return state.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.serial
@pytest.mark.parametrize("option", ["", "--overwrite"])
def test_an_interrupted_optimisation_says_how_to_go_on(tmp_path, monkeypatch, option):
    from dolfinopt.output import run_folder as module

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(module.Optimization, "go", interrupted)
    words = ["optimize", str(paper_scene()), "--set", "arms.cells=[12,3]", "--out", str(tmp_path)]
    words += ["--set", "design.filter_radius=0.2", *filter(None, [option])]
    with pytest.raises(click.Abort) as caught:
        commands.main(words, standalone_mode=False, obj=MPI.COMM_WORLD)
    (advice,) = caught.value.__cause__.args
    assert "--resume" in advice and ("--overwrite" in advice) == bool(option)
