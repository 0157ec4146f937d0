"""Ctrl-C before start-up or after shutdown: one line, and an end at once.

A `KeyboardInterrupt` would come out of any of hundreds of imports as a traceback, or be swallowed
by one of them. Commands that compute take it as an exception, see `parallel.abort_together`.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

INTERRUPTED = 130  # exit status, as of a shell's command that Ctrl-C has ended
# What Open MPI, PMIx, and MPICH with its relatives tell a rank.
RANK_VARIABLES = ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK")
PATIENCE = 0.5  # s that other ranks leave the first to speak: a launcher kills all when one ends


def launched_rank(environment: Mapping[str, str] = os.environ) -> int | None:
    """Return this process's rank as a launcher (mpirun) states it, None without one."""
    for name in RANK_VARIABLES:
        text = environment.get(name, "")
        if text.isdigit():
            return int(text)
    return None


def end_with_launcher(every: float = 1.0) -> None:
    """End this rank when its launcher is gone, looked for `every` so many seconds.

    A launcher that is killed cannot end its ranks. With Open MPI 5 they may then wait in MPI for
    ever, and hold the locks of the folder that they work in.
    """
    if launched_rank() is None:
        return
    launcher = os.getppid()

    def watch() -> None:
        while os.getppid() == launcher:
            time.sleep(every)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, name="launcher", daemon=True).start()


def end_at_once() -> None:
    """From now on Ctrl-C ends the process, unless it is ignored or somebody else's."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def raise_again() -> bool:
    """Let Ctrl-C raise KeyboardInterrupt if it ended the process; return whether it did."""
    ended = signal.getsignal(signal.SIGINT) is _end
    if ended:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return ended


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let Ctrl-C end the process within the block, which must not write anything.

    There are libraries that swallow the exception where they import others (trimesh).
    """
    before = signal.getsignal(signal.SIGINT)
    end_at_once()
    try:
        yield
    finally:
        if before is signal.default_int_handler:
            signal.signal(signal.SIGINT, before)


@contextmanager
def interrupted_later() -> Iterator[None]:
    """Let what raises KeyboardInterrupt, Ctrl-C among others, do so after a short block."""
    pressed, held = threading.Event(), list[int]()
    if threading.current_thread() is threading.main_thread():
        both = signal.SIGINT, signal.SIGTERM
        held = [n for n in both if signal.getsignal(n) is signal.default_int_handler]
    for number in held:
        signal.signal(number, lambda *_: pressed.set())
    try:
        yield
    finally:
        for number in held:
            signal.signal(number, signal.default_int_handler)
    if pressed.is_set():
        raise KeyboardInterrupt


def _end(number: int, frame: Any) -> None:
    if launched_rank():
        time.sleep(PATIENCE)
    else:
        os.write(2, b"dolfinopt: interrupted\n")
    os._exit(INTERRUPTED)
