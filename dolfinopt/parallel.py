"""Arms on sub-communicators, collection on the root, and one ending for all ranks.

An exception on one rank is everybody's. Whatever one rank, or each rank for its own arms, does
between two collectives of a communicator and may fail, runs in `together(comm)` or `on_root`:
these agree on the outcome, and raise the same kind of exception on all ranks. What decides by
numbers that all ranks have, raises on all of them anyway.
"""

from __future__ import annotations

import errno
import os
import pickle
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI

from dolfinopt.errors import (
    InputError,
    OthersFailed,
    line_of,
)
from dolfinopt.interrupt import INTERRUPTED

T = TypeVar("T")

# How long a rank that failed waits for the others to fail the same way before it ends them all.
GRACE = 2.0  # s
# Nobody reads standard output any more, or the disk that it goes to is full.
CLOSED = (errno.EPIPE, errno.ENOSPC)


# Solid arms of fewer cells are faster on one rank than on two, and plane ones of 153 600 still (see
# `partition_arms`).
SPLIT_CELLS = 40_000


@dataclass(frozen=True)
class Partition:
    """Which ranks work on which arm.

    Attributes:
        world: all ranks.
        comm: the ranks that share this rank's arms.
        arms: indices of this rank's arms; empty on a rank that only looks on.
    """

    world: MPI.Comm
    comm: MPI.Comm
    arms: tuple[int, ...]

    @property
    def is_root(self) -> bool:
        """True on the one rank that speaks for its arms."""
        return bool(self.arms) and self.comm.rank == 0


def partition_arms(
    world: MPI.Comm, cells: Mapping[int, int], *, undivided: bool = False
) -> Partition:
    """Deal arms with a design of their own out over the ranks of `world` (collective).

    Up to as many ranks as arms, whole arms are dealt out and need no communication. Further
    ranks join them only where arms are large: neighbouring ranks then share one arm. Small arms
    lose by it (200 x 12 cells: 3 ms on one rank, 23 ms on two), and whole arms give the same
    bits on any number of ranks, where shared ones agree to rounding.

    Args:
        world: all ranks.
        cells: number of cells of every such arm, by its index in the scene.
        undivided: share no arm between ranks, however large, as plane arms: on two ranks MUMPS
            takes longer than one rank's band.
    """
    arms = sorted(cells)
    count, ranks = len(arms), range(world.size)
    colors = tuple(ranks)
    mine = arms[world.rank :: world.size]
    if world.size > count and not undivided and max(cells.values(), default=0) >= SPLIT_CELLS:
        colors = tuple(rank * count // world.size for rank in ranks)
        mine = [arms[colors[world.rank]]]
    return Partition(world=world, comm=_split(world, colors), arms=tuple(mine))


def _split(world: MPI.Comm, colors: tuple[int, ...]) -> MPI.Comm:
    """Return the communicator of this rank's color; the same one each time (collective)."""
    # There are only some tens of thousands of communicators, and nobody knows who still has one.
    known = world.Get_attr(_SPLITS)
    if known is None:
        known = {}
        world.Set_attr(_SPLITS, known)
    if colors not in known:
        known[colors] = world.Split(colors[world.rank], world.rank)
    comm: MPI.Comm = known[colors]
    return comm


def _free_all(world: MPI.Comm, key: int, known: dict[tuple[int, ...], MPI.Comm]) -> None:
    """Free what was split off a communicator that is freed itself."""
    for comm in known.values():
        comm.Free()


_SPLITS = MPI.Comm.Create_keyval(delete_fn=_free_all)


def total(comm: MPI.Comm, part: Any) -> Any:
    """Return the sum of numbers or arrays over the ranks; on a single one what it is given."""
    return part if comm.size == 1 else comm.allreduce(part)


def sum_over_arms(partition: Partition, mine: Mapping[int, np.ndarray]) -> np.ndarray:
    """Return the sum of one array an arm, added in the arms' order: the same bits on all ranks.

    Args:
        partition: which ranks do which arm.
        mine: arrays of this rank's arms, over its own cells; equal shapes.
    """
    if partition.comm.size > 1:
        mine = {arm: partition.comm.allreduce(value) for arm, value in mine.items()}
    pieces: dict[int, np.ndarray] = {}
    for piece in partition.world.allgather(dict(mine) if partition.is_root else {}):
        pieces.update(piece)
    return np.sum([pieces[arm] for arm in sorted(pieces)], axis=0)


def gather_arms(partition: Partition, mine: Mapping[int, T]) -> dict[int, T]:
    """Collect one object an arm on the root, in the arms' order; empty elsewhere."""
    pieces = partition.world.gather(dict(mine) if partition.is_root else {}, root=0)
    if pieces is None:
        return {}
    merged: dict[int, T] = {}
    for piece in pieces:
        merged.update(piece)
    return {arm: merged[arm] for arm in sorted(merged)}


def on_all_ranks(partition: Partition, mine: Mapping[int, T]) -> dict[int, T]:
    """Return one object an arm on all ranks, in the arms' order (collective)."""
    return partition.world.bcast(gather_arms(partition, mine), root=0)


def gather_cells(partition: Partition, mine: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Collect cell arrays (n_local, ...) of every arm on the root, ranks in order.

    Returns:
        One array (n_cells, ...) an arm on the root, empty elsewhere.
    """
    tables = gather_tables(partition, {k: {"": values} for k, values in mine.items()})
    return {k: table[""] for k, table in tables.items()}


def gather_tables(
    partition: Partition, mine: Mapping[int, Mapping[str, np.ndarray]]
) -> dict[int, dict[str, np.ndarray]]:
    """Collect several such arrays of every arm by their names, the same on all ranks of an arm."""
    whole = {}
    for arm, table in mine.items():
        pieces = partition.comm.gather(table, root=0)
        if pieces is not None:
            whole[arm] = {name: np.concatenate([piece[name] for piece in pieces]) for name in table}
    return gather_arms(partition, whole)


# -- one ending for all ranks ------------------------------------------------------------------


class RaisedElsewhere(RuntimeError):
    """The cause of an exception that another rank raised: its number and traceback."""


@contextmanager
def together(comm: MPI.Comm) -> Iterator[None]:
    """Make an exception that the block raises on any rank of `comm` everybody's (collective).

    The ranks meet at the end of the block, in one reduction of a single integer; on one rank
    nothing is done. If any failed, all raise: the first one that failed its own exception, the
    others a copy of it, whose cause tells rank and traceback.

    The rule: the block has no collective on `comm`, which a rank that failed would miss. It may
    have some on a part of its ranks, as those of an arm that several ranks share; what one of
    these does alone in between runs in a `together` of the part.

    An exception that cannot be pickled is raised elsewhere as the nearest of its base classes
    that can, with the same message.
    """
    if comm.size == 1:
        yield
        return
    failure: BaseException | None = None
    try:
        yield
    except GeneratorExit:  # the block is left for good, at any time: nobody meets
        raise
    except BaseException as error:
        failure = error
    failed = np.array([failure is not None], dtype=np.intc)
    comm.Allreduce(MPI.IN_PLACE, failed, op=MPI.MAX)
    if not failed[0]:
        return
    outcomes = comm.allgather(None if failure is None else _packed(failure, comm.rank))
    known = [outcome for outcome in outcomes if outcome is not None]
    chosen = next((item for item in known if not item.gave_up), known[0])
    if failure is not None and chosen.rank == comm.rank:
        raise failure
    raise chosen.exception() from chosen.cause()


@dataclass(frozen=True)
class _Packed:
    """An exception on its way to other ranks."""

    rank: int  # where it was raised
    pickled: bytes  # the exception, or its nearest relative that can be pickled
    text: str  # its traceback
    gave_up: bool  # another rank's failure was the reason

    def exception(self) -> BaseException:
        error: BaseException = pickle.loads(self.pickled)
        return error

    def cause(self) -> RaisedElsewhere:
        return RaisedElsewhere(f"on rank {self.rank}\n\n{self.text}")


def _packed(error: BaseException, rank: int) -> _Packed:
    text = "".join(traceback.format_exception(error))
    return _Packed(rank, _pickled(error), text, isinstance(error, OthersFailed))


def _pickled(error: BaseException) -> bytes:
    """Pickle an exception, or the nearest of its base classes that can be, with its message."""
    for kind in type(error).__mro__:
        try:
            data = pickle.dumps(error if kind is type(error) else kind(str(error)))
            if type(pickle.loads(data)) is kind:
                return data
        except Exception:  # whatever a foreign class may raise
            continue
    return pickle.dumps(RuntimeError(type(error).__name__))


def on_root(world: MPI.Comm, action: Callable[..., T], *arguments: Any) -> T:
    """Run `action(*arguments)` on the root and hand its result, or its exception, to all ranks."""
    if world.size == 1:
        return action(*arguments)
    if world.rank > 0:
        outcome = world.bcast(None, root=0)
        if isinstance(outcome, _Packed):
            raise outcome.exception() from outcome.cause()
        known: T = pickle.loads(outcome)
        return known
    try:
        result = action(*arguments)
        data = pickle.dumps(result)
    except BaseException as error:
        world.bcast(_packed(error, 0), root=0)
        raise
    world.bcast(data, root=0)
    return result


@contextmanager
def abort_together(world: MPI.Comm) -> Iterator[None]:
    """End the processes of all ranks together when the block fails on any of them.

    For commands and scripts; functions use `together`. All ranks meet at the end of the block.
    If one failed, its message is printed once and all exit: with status 2 for `InputError`, 130
    when interrupted, 1 otherwise. A rank that failed while others wait for it elsewhere, and would
    do so for ever, ends them all after `GRACE`.
    """
    # Its own communicator: the others may be waiting in a collective of `world`.
    roll_call = world.Dup()
    failure: BaseException | None = None
    try:
        yield
    except BaseException as error:
        failure = error
    status = _status(failure)
    try:
        statuses = _all_arrive(roll_call, status, None if failure is None else GRACE)
    except KeyboardInterrupt:  # once more
        statuses = None
    if statuses is None:
        _report(failure)
        world.Abort(status)
    elif status and world.rank == int(np.flatnonzero(statuses)[0]):
        _report(failure)
    if isinstance(failure, SystemExit):
        raise failure
    if statuses is not None and statuses.any():
        sys.exit(status or int(statuses.max()))


def _status(failure: BaseException | None) -> int:
    """Return the exit status that stands for an exception."""
    if isinstance(failure, SystemExit):
        code = failure.code
        return code if isinstance(code, int) else int(code is not None)
    if isinstance(failure, KeyboardInterrupt):
        return INTERRUPTED
    return 2 if isinstance(failure, InputError) else int(failure is not None)


def _report(error: BaseException | None) -> None:
    """Print one line for what the user can mend, the whole traceback for what he cannot."""
    if line := line_of(error):
        print(line, file=sys.stderr)
    elif isinstance(error, OSError) and error.errno in CLOSED:
        _give_up_output()
        print(f"dolfinopt: standard output: {error.strerror}", file=sys.stderr)
    elif error is not None and not isinstance(error, SystemExit):
        traceback.print_exception(error)
    try:
        sys.stdout.flush()
    except OSError:
        _give_up_output()
    sys.stderr.flush()


def _give_up_output() -> None:
    """Send what is left of standard output nowhere: Python would try again when it ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _all_arrive(comm: MPI.Comm, status: int, limit: float | None) -> np.ndarray | None:
    """Return the statuses (ranks,) of all, or None when some do not come within `limit` seconds."""
    statuses = np.zeros(comm.size, dtype=np.intc)
    mine = np.array([status], dtype=np.intc)
    if comm.size == 1:
        return mine
    request = comm.Iallgather(mine, statuses)
    begun = time.monotonic()
    while not request.Test():
        if limit is not None and time.monotonic() - begun > limit:
            return None
        time.sleep(0.01)
    return statuses
