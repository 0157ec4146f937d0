"""Scenes, and commands run in this process or in processes of their own."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import click
import numpy as np
import pytest
from mpi4py import MPI

import dolfinopt as do
from dolfinopt.cli.main import commands
from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene

if sys.version_info >= (3, 11):
    import tomllib as tomllib  # for all tests
else:
    import tomli as tomllib  # noqa: F401

ROOT = Path(__file__).parents[2]
TWO_ARM = ROOT / "demos" / "two_arm.toml"
QUICK = ("arms.cells=[24,3]", "design.filter_radius=0.05", "motion.horizon=1.9",
         "simulation.tolerance=1e-2")  # fmt: skip
REFUSALS = (InputError, click.UsageError)
# The tables that every scene states, for tests of one arm's mesh, filter or keys.
STATED = {"motion": {"path": "arc"}, "payload": {"mass": 6.0}}  # kg


def scene(*changes: str) -> Scene:
    """Return the two-arm scene with "key.path=value" changed."""
    return do.load_scene(TWO_ARM, changes)


def quick(*changes: str, iterations: int = 0) -> Scene:
    """Return the two-arm scene in few cells, roughly solved."""
    return scene(*QUICK, f"optimizer.max_iterations={iterations}", *changes)


def overrides(*changes: str) -> list[str]:
    """Return the options of a command that change the scene."""
    return [word for change in changes for word in ("--set", change)]


@contextmanager
def refused(
    *words: str, error: type[Exception] | tuple[type[Exception], ...] = REFUSALS
) -> Iterator[list[str]]:
    """Check that what is run is refused in one line with all the words; it is added to the list."""
    told: list[str] = []
    with pytest.raises(error) as caught:
        yield told
    one = caught.value
    told.append(one.format_message() if isinstance(one, click.UsageError) else str(one))
    assert told[0] and told[0].isprintable()
    # No other exception would be printed above it; those of click have their own.
    if isinstance(one, InputError):
        assert one.__context__ is None or one.__suppress_context__
    assert [word for word in words if word not in told[0]] == [], told[0]


def refusal(make: Callable[[], object], *words: str) -> str:
    """Check that a call is refused so; return the line."""
    with refused(*words) as told:
        make()
    return told[0]


def run(*words: object, world: MPI.Comm = MPI.COMM_WORLD) -> None:
    """Run a command here until all ranks of `world` have done; errors of dolfinopt are raised."""
    commands.main([str(word) for word in words], standalone_mode=False, obj=world)
    world.barrier()


def by_root(act: Callable[[], object]) -> None:
    """Let the root alone change files that all ranks read before and after."""
    MPI.COMM_WORLD.barrier()
    if MPI.COMM_WORLD.rank == 0:
        act()
    MPI.COMM_WORLD.barrier()


def contents(folder: Path) -> dict[str, bytes]:
    """Return what all files of a folder hold, by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def summary_of(folder: Path) -> dict:
    """Return a run's summary."""
    return json.loads((folder / "summary.json").read_text())


def assert_same_bits(found: do.Result, expected: do.Result) -> None:
    """Assert that two optimisations have the same designs and history, but for the seconds."""
    for k, x in expected.x_phys.items():
        np.testing.assert_array_equal(found.x_phys[k], x)
    # As text, in which nan is nan.
    rows = ([str(replace(row, seconds=0.0)) for row in one.history] for one in (found, expected))
    assert next(rows) == next(rows)


def demo(name: str) -> ModuleType:
    """Import a demo by its path."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "demos" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


OF_A_PROCESS = re.compile("PMIX_|ORTE_|OMPI_(MCA_(pmix|ess|orte)|APP_|UNIVERSE|COMM_)")


def environment() -> dict[str, str]:
    """Return the environment without what the beginning of MPI adds to it: it misleads mpirun."""
    # A worker of pytest-xdist has it from the process that distributes the tests, if that has read
    # a file that imports MPI.
    return {name: value for name, value in os.environ.items() if not OF_A_PROCESS.match(name)}


def command(*words: object, ranks: int = 0) -> list[str]:
    """Return the command line of dolfinopt, or of mpirun with it."""
    line = [sys.executable, "-m", "dolfinopt", *map(str, words)]
    return ["mpirun", "-n", str(ranks), *line] if ranks else line


def shell(*words: object, ranks: int = 0) -> subprocess.CompletedProcess:
    """Run dolfinopt in a process of its own, or under mpirun; return status and output."""
    return subprocess.run(
        command(*words, ranks=ranks), capture_output=True, text=True, timeout=120, env=environment()
    )
