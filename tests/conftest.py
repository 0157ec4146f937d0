"""Tests alone and under mpirun: ranks agree on every outcome, and nothing hangs.

Under mpirun every rank runs every test. After each phase of a test the ranks exchange how it went;
a failure on one of them is a failure on all, reported by rank 0. A rank that failed while others
wait for it inside a collective call would wait for ever: after a grace period it ends the run.
"""

from __future__ import annotations

import faulthandler
import gc
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import hypothesis
import pytest
from mpi4py import MPI
from petsc4py import PETSc

COMM = MPI.COMM_WORLD.Dup()  # apart from the messages of the tests
TIME_LIMIT = 180.0  # s a test, unless marked timeout(seconds)
GRACE = 10.0  # s a failed rank waits for the others

# Examples that are the same on all ranks and in every run; no deadline on a shared machine.
hypothesis.settings.register_profile("ranks", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("ranks")

_stderr = pytest.StashKey[TextIO]()
_unread: list[str] = []


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """Silence all ranks but the first; keep standard error, which pytest captures in tests."""
    config.stash[_stderr] = os.fdopen(os.dup(2), "w")
    if COMM.rank > 0:
        reporter = config.pluginmanager.get_plugin("terminalreporter")
        reporter._tw._file = open(os.devnull, "w")  # for the life of the process


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests marked `serial` when there are more ranks."""
    if COMM.size > 1:
        for item in items:
            if item.get_closest_marker("serial"):
                item.add_marker(pytest.mark.skip(reason="needs a single rank"))


def pytest_collectreport(report: pytest.CollectReport) -> None:
    """Keep what went wrong in reading a test file."""
    if report.failed:
        _unread.append(report.longreprtext)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Stop unless all ranks run the same tests: else they would wait for one another."""
    plans = COMM.allgather(([item.nodeid for item in session.items], len(_unread)))
    if any(plan != plans[0] for plan in plans):
        print(*_unread, sep="\n", file=session.config.stash[_stderr], flush=True)
        pytest.exit("the ranks collected different tests", returncode=pytest.ExitCode.USAGE_ERROR)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """End the process, with all stacks printed, when a test exceeds its time limit.

    The watchdog works while a library holds the interpreter; mpirun then ends the other ranks.
    """
    marker = item.get_closest_marker("timeout")
    limit = float(marker.args[0]) if marker else TIME_LIMIT
    faulthandler.dump_traceback_later(limit, exit=True, file=item.config.stash[_stderr])
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo) -> Iterator[None]:
    """Agree with the other ranks on how a phase (setup, call, teardown) of a test went."""
    report = yield
    _meet(item, report)
    texts = COMM.allgather((report.outcome, report.longreprtext))
    if len({outcome for outcome, _ in texts}) > 1 and not report.failed:
        report.outcome = "failed"
        report.longrepr = "\n".join(
            f"{outcome} on rank {rank}, not on all\n{text}"
            for rank, (outcome, text) in enumerate(texts)
            if outcome != "passed"
        )
    return report


@pytest.fixture(autouse=True, scope="module")
def _clean_ranks() -> Iterator[None]:
    """Free what a file's tests left on all ranks together, and at no other time.

    Freeing PETSc's objects is collective, so that the collector must not run when it pleases; a
    run of it takes 0.1 s, too long for every test.
    """
    if COMM.size == 1:
        yield
        return
    gc.disable()
    yield
    gc.enable()
    gc.collect()
    PETSc.garbage_cleanup()


@pytest.fixture
def shared_tmp_path(tmp_path: Path) -> Path:
    """Rank 0's temporary folder, on all ranks."""
    return COMM.bcast(tmp_path, root=0)


def _meet(item: pytest.Item, report: pytest.TestReport) -> None:
    """Wait for all ranks; a rank that failed waits `GRACE` and then ends them all."""
    request = COMM.Ibarrier()
    give_up = time.monotonic() + GRACE
    while not request.Test():
        if report.failed and time.monotonic() > give_up:
            print(
                f"{report.longreprtext}\n{item.nodeid} failed on rank {COMM.rank} while others "
                f"wait for it: ending the run",
                file=item.config.stash[_stderr],
                flush=True,
            )
            COMM.Abort(1)
        time.sleep(1e-4)
