"""Arms dealt out over ranks, collection on the root, and one ending for all ranks."""

import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from remainders import build
from runs import TWO_ARM, command, environment, overrides

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.parallel import (
    SPLIT_CELLS,
    abort_together,
    gather_arms,
    gather_cells,
    on_root,
    partition_arms,
    sum_over_arms,
)

COMM = MPI.COMM_WORLD


class FakeWorld:
    """One of `size` ranks; `Split` notes what was asked for."""

    def __init__(self, size, rank):
        self.size, self.rank, self.attributes = size, rank, {}
        self.Get_attr, self.Set_attr = self.attributes.get, self.attributes.__setitem__

    def Split(self, color, key):
        return SimpleNamespace(color=color, key=key)


def teams(size, cells):
    """Deal arms out over `size` ranks; return the partitions and, a communicator, its ranks."""
    cells = dict(enumerate(cells))
    partitions = [partition_arms(FakeWorld(size, rank), cells) for rank in range(size)]
    keys = [partition.comm.key for partition in partitions]
    assert keys == list(range(size))  # ranks keep their order
    groups = {}
    for rank, partition in enumerate(partitions):
        groups.setdefault(partition.comm.color, []).append(rank)
    return partitions, list(groups.values())


@pytest.mark.parametrize("num_arms", [1, 2, 3, 5])
@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 6])
def test_small_arms_stay_whole(size, num_arms):
    partitions, groups = teams(size, [2400] * num_arms)
    dealt = [arm for partition in partitions for arm in partition.arms]
    assert sorted(dealt) == list(range(num_arms))
    assert all(len(group) == 1 for group in groups)
    loads = [len(partition.arms) for partition in partitions]
    assert max(loads) - min(loads) <= 1
    assert all(partition.arms == tuple(sorted(partition.arms)) for partition in partitions)


@pytest.mark.parametrize("num_arms", [1, 2, 3, 5])
@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 6])
def test_large_arms_get_all_ranks(size, num_arms):
    # One large arm is enough: it sets the time that all wait for.
    partitions, groups = teams(size, [2400] * (num_arms - 1) + [SPLIT_CELLS])
    dealt = []
    for ranks in groups:
        arms = {partitions[rank].arms for rank in ranks}
        assert len(arms) == 1  # those who share a communicator share its arms
        dealt += arms.pop()
        assert ranks == list(range(ranks[0], ranks[-1] + 1))  # neighbours
    assert sorted(dealt) == list(range(num_arms))
    assert all(partition.arms for partition in partitions)
    sizes = [len(ranks) for ranks in groups]
    assert max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize("cells", [2400, SPLIT_CELLS])
@pytest.mark.parametrize("num_arms", [1, 2, 3, 4])
def test_objects_and_cells_are_collected_on_the_root(num_arms, cells):
    partition = partition_arms(COMM, dict.fromkeys(range(num_arms), cells))
    expected = {k: f"arm {k}" for k in range(num_arms)}
    # Given in any order, and by every rank of a team: the leader's counts.
    own = (lambda k: expected[k]) if partition.is_root else (lambda k: "not the leader's")
    bodies = gather_arms(partition, {k: own(k) for k in reversed(partition.arms)})
    assert bodies == (expected if COMM.rank == 0 else {})
    assert list(bodies) == sorted(bodies)
    assert COMM.allreduce(int(partition.is_root)) == min(num_arms, COMM.size)
    team = {k: n for arms, n in COMM.allgather((partition.arms, partition.comm.size)) for k in arms}
    rank = partition.comm.rank
    pieces = {k: np.full((2 + rank, 3), 10.0 * k + rank) for k in partition.arms}
    whole = gather_cells(partition, pieces)
    if COMM.rank > 0:
        assert whole == {}
        return
    assert len(whole) == num_arms
    for k, values in whole.items():
        pieces = [np.full((2 + rank, 3), 10.0 * k + rank) for rank in range(team[k])]
        assert np.array_equal(values, np.concatenate(pieces))


@pytest.mark.parametrize("cells", [2400, SPLIT_CELLS])
@pytest.mark.parametrize("num_arms", [1, 2, 3])
def test_sums_over_arms_have_the_same_bits_on_any_number_of_ranks(num_arms, cells):
    partition = partition_arms(COMM, dict.fromkeys(range(num_arms), cells))
    # Cancelling numbers: any other order of the arms gives other bits.
    values = np.array([[1.0, 0.1], [1e17, 0.2], [-1e17, 0.3]])[:num_arms]
    first = partition.comm.rank == 0  # a team's parts are added before
    total = sum_over_arms(partition, {k: values[k] * first for k in partition.arms})
    expected = values[0].copy()
    for value in values[1:]:
        expected += value
    assert np.array_equal(total, expected)


def test_the_root_works_for_all():
    calls = []

    def double(values):
        calls.append(COMM.rank)
        return {"twice": 2 * values}

    result = on_root(COMM, double, np.arange(3) + COMM.rank)
    assert np.array_equal(result["twice"], [0, 2, 4])  # of the root's argument
    assert COMM.allreduce(calls) == [0]


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (None, None, ""),
        (SystemExit(7), 7, ""),  # a status chosen on purpose stays
        (InputError("scene.toml: no"), 2, "dolfinopt: scene.toml: no\n"),
        (ConvergenceError("stuck"), 1, "dolfinopt: stuck\n"),
        (KeyboardInterrupt(), 130, "dolfinopt: interrupted\n"),
        (KeyboardInterrupt("add --resume"), 130, "dolfinopt: interrupted: add --resume\n"),
        (ZeroDivisionError("by nothing"), 1, "ZeroDivisionError: by nothing\n"),  # and where
    ],
)
def test_what_all_ranks_raise_the_root_reports_once(error, status, message, capsys):
    found = None
    try:
        with abort_together(COMM):
            if error is not None:
                raise error
    except SystemExit as ending:
        found = ending.code
    said = capsys.readouterr().err
    assert found == status
    if isinstance(error, ZeroDivisionError) and COMM.rank == 0:
        assert "test_parallel.py" in said and said.endswith(message)
    else:
        assert said == (message if COMM.rank == 0 else "")


TOGETHER = """from mpi4py import MPI
from dolfinopt.errors import InputError
from dolfinopt.parallel import abort_together
world = MPI.COMM_WORLD
assert world.size == 2
with abort_together(world):
    """
LONE = "if world.rank == 1: raise {}\nworld.Barrier()"
ENDINGS = [
    pytest.param(LONE.format("RuntimeError('lost')"), 1, "RuntimeError: lost", id="lone rank"),
    pytest.param(LONE.format("InputError('lost')"), 2, "dolfinopt: lost", id="lone input error"),
    pytest.param("raise InputError('all')", 2, "dolfinopt: all", id="all ranks"),
]


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.skipif(shutil.which("mpirun") is None, reason="no mpirun")
@pytest.mark.parametrize(("body", "status", "line"), ENDINGS)
def test_ranks_end_together(body, status, line):
    """Nobody waits for ever, the message stands once, and the status says what happened."""
    script = TOGETHER + body.replace("\n", "\n    ") + "\n"
    words = ["mpirun", "-n", "2", sys.executable, "-c", script]
    run = subprocess.run(words, capture_output=True, text=True, timeout=120, env=environment())
    assert run.returncode == status, run.stderr
    assert run.stderr.splitlines().count(line) == 1
    # What the user can mend needs no traceback, what he cannot has one.
    assert ("Traceback" in run.stderr) == ("RuntimeError" in body)
    assert run.stdout == ""


ORDERING = "pc_factor_mat_ordering_type"
VIEWED = {  # option, what the view shows by default and with the option
    "dolfinopt_stiffness_": (
        "ksp_view",
        f"{ORDERING} rcm -dolfinopt_stiffness_pc_factor_mat_solver_type petsc",
        "type: mumps",
        "ordering: rcm",
    ),
    "dolfinopt_filter_": ("ksp_view", f"{ORDERING} rcm", "ordering: nd", "ordering: rcm"),
    "dolfinopt_modes_": ("eps_view", "eps_type arnoldi", "type: krylovschur", "type: arnoldi"),
}


def views(folder, *options):
    """Return what PETSc shows of each solver of a simulation with these options."""
    given = [f"-{p}{one[0]} ascii:{folder}/{p}.txt" for p, one in VIEWED.items()]
    changes = overrides("arms.cells=[16,3]", "simulation.tolerance=0.1")
    line = command("simulate", TWO_ARM, *changes, "--out", folder / "out", "--no-plots")
    env = environment() | {"PETSC_OPTIONS": " ".join([*given, *options])}
    run = subprocess.run(line, env=env, capture_output=True, text=True, timeout=120)
    return run, {p: (folder / f"{p}.txt") for p in VIEWED}


@pytest.mark.slow
@pytest.mark.serial
def test_petsc_options_reach_every_solver(tmp_path):
    """What PETSC_OPTIONS says of a solver holds for it; every solver has its own prefix."""
    for kind, changes in (("default", ()), ("changed", VIEWED)):
        folder = tmp_path / kind
        folder.mkdir()
        run, files = views(folder, *(f"-{p}{VIEWED[p][1]}" for p in changes))
        assert run.returncode == 0, run.stderr
        for prefix, (_, _, default, other) in VIEWED.items():
            seen = files[prefix].read_text()
            assert f"({prefix})" in seen
            assert (other in seen) == bool(changes)
            assert (default in seen) != bool(changes)


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize(
    "key", ["stiffness_pc", "stiffness_pc_factor_mat_solver", "filter_pc", "modes_eps"]
)
def test_options_that_petsc_refuses(tmp_path, key):
    option = f"-dolfinopt_{key}_type nonsense"
    run, _ = views(tmp_path, option)
    assert run.returncode == 2
    assert "Traceback" not in run.stderr
    assert any(option in line for line in run.stderr.splitlines())


def test_options_of_other_programs_change_nothing():
    """Options without a prefix of ours are for other solvers in the same process."""
    options = PETSc.Options()
    for key, value in (("ksp_type", "cg"), ("pc_type", "jacobi"), ("eps_type", "arnoldi")):
        options[key] = value
    try:
        for arm in build(cells=(16, 3)).arms.values():
            arm.reduce(arm.uniform(0.5))
            name = arm.substructure.interior.solver.name
            assert name == ("LAPACK's band" if arm.mesh.comm.size == 1 else "mumps")
    finally:
        for key in ("ksp_type", "pc_type", "eps_type"):
            options.delValue(key)
