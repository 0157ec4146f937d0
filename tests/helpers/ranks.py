"""Tests alone and under mpirun: ranks agree on every outcome, and nothing hangs.

Ranks that wait for what the root does alone sleep meanwhile: MPI would keep their processors busy,
which other tests need.

Under mpirun every rank runs every test. After each phase of a test the ranks exchange how it went;
a failure on one of them is a failure on all, reported by rank 0. A rank that failed while others
wait for it inside a collective call would wait for ever: after a grace period it ends the run.
"""

import faulthandler
import gc
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mpi4py import MPI

from dolfinopt import parallel

TIME_LIMIT = 180.0  # s a test, unless marked timeout(seconds)
GRACE = 10.0  # s a failed rank waits for the others
SERIAL_FILE = re.compile(r"^pytestmark = pytest\.mark\.serial\b", re.MULTILINE)


def rest_while_the_root_works() -> None:
    """Let `parallel.on_root` begin with a wait of all other ranks, asleep."""
    at_once = parallel.on_root

    def on_root(world: MPI.Comm, action: Any, *arguments: Any) -> Any:
        def act(*given: Any) -> Any:
            try:
                return action(*given)
            finally:
                world.Ibarrier().Wait()

        if world.rank > 0:
            done = world.Ibarrier()
            while not done.Test():
                time.sleep(2e-4)
        return at_once(world, action if world.size == 1 else act, *arguments)

    parallel.on_root = on_root


class Ranks:
    """Hooks that make one run of all ranks' pytest processes.

    Attributes:
        comm: the ranks, apart from the messages of the tests.
        stderr: standard error, which pytest captures in tests.
        unread: what went wrong in reading test files.
        left_out: number of files and tests marked `serial` that several ranks do not run.
    """

    def __init__(self, config: pytest.Config) -> None:
        self.comm = MPI.COMM_WORLD.Dup()
        if self.comm.size > 1:
            rest_while_the_root_works()
        self.stderr = os.fdopen(os.dup(2), "w")
        self.unread: list[str] = []
        self.left_out = 0

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionstart(self, session: pytest.Session) -> None:
        """Silence all ranks but the first; the reporter does not exist before."""
        if self.comm.rank > 0:
            reporter = session.config.pluginmanager.get_plugin("terminalreporter")
            reporter._tw._file = open(os.devnull, "w")  # for the life of the process

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        """On several ranks import no file whose tests are all `serial`, unless it is named."""
        if self.comm.size == 1 or not collection_path.match("test_*.py"):
            return None
        if not SERIAL_FILE.search(collection_path.read_text(encoding="utf-8")):
            return None
        self.left_out += 1
        return True

    def pytest_collection_modifyitems(
        self, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        """Leave out tests marked `serial` when there are more ranks."""
        if self.comm.size == 1:
            return
        serial = [item for item in items if item.get_closest_marker("serial")]
        items[:] = [item for item in items if not item.get_closest_marker("serial")]
        config.hook.pytest_deselected(items=serial)
        self.left_out += len(serial)

    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        """Where all that was asked for is marked `serial`, nothing has failed."""
        if exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED and self.left_out:
            session.exitstatus = pytest.ExitCode.OK

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Keep what went wrong in reading a test file."""
        if report.failed:
            self.unread.append(report.longreprtext)

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Stop unless all ranks run the same tests: else they would wait for one another."""
        plan = [item.nodeid for item in session.items], len(self.unread)
        plans = self.comm.allgather(plan)
        if any(other != plans[0] for other in plans):
            print(*self.unread, sep="\n", file=self.stderr, flush=True)
            status = pytest.ExitCode.USAGE_ERROR
            pytest.exit("the ranks collected different tests", returncode=status)
        gc.collect()
        gc.freeze()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """End the process, with all stacks printed, when a test exceeds its time limit.

        The watchdog is a thread of faulthandler: it works while a library holds the interpreter
        (pytest-timeout's signal and thread wait for it), and mpirun then ends the other ranks.
        """
        marker = item.get_closest_marker("timeout")
        limit = float(marker.args[0]) if marker else TIME_LIMIT
        faulthandler.dump_traceback_later(limit, exit=True, file=self.stderr)
        try:
            return (yield)
        finally:
            faulthandler.cancel_dump_traceback_later()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo) -> Iterator[None]:
        """Agree with the other ranks on how a phase (setup, call, teardown) of a test went."""
        report = yield
        self._meet(item, report)
        texts = self.comm.allgather((report.outcome, report.longreprtext))
        if len({outcome for outcome, _ in texts}) > 1 and not report.failed:
            report.outcome = "failed"
            report.longrepr = "\n".join(
                f"{outcome} on rank {rank}, not on all\n{text}"
                for rank, (outcome, text) in enumerate(texts)
                if outcome != "passed"
            )
        return report

    def _meet(self, item: pytest.Item, report: pytest.TestReport) -> None:
        """Wait for all ranks; a rank that failed waits `GRACE` and then ends them all."""
        request = self.comm.Ibarrier()
        give_up = time.monotonic() + GRACE
        while not request.Test():
            if report.failed and time.monotonic() > give_up:
                print(
                    f"{report.longreprtext}\n{item.nodeid} failed on rank {self.comm.rank} while "
                    f"others wait for it: ending the run",
                    file=self.stderr,
                    flush=True,
                )
                self.comm.Abort(1)
            time.sleep(1e-4)
