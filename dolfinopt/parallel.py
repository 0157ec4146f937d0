"""Arms on sub-communicators, collection on the root, and one ending for all ranks."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dolfinopt.errors import ConvergenceError, InputError

T = TypeVar("T")

# How long a rank that failed waits for the others to fail the same way before it ends them all.
GRACE = 2.0  # s


# Arms of fewer cells are faster on one rank than on two (see `share_arms`). One factorisation and
# 18 solves, as an iteration needs, at 800 x 48 cells: 470 ms on one rank, 340 ms on two.
SPLIT_CELLS = 40_000
# From so many rows on nested dissection beats the narrow band in PETSc's Cholesky. One
# factorisation and 18 solves on one rank and thread, 400 x 24 cells: 47 against 43 ms, MUMPS 97,
# CHOLMOD 57; 800 x 48: 330 against 460 ms, MUMPS 520, CHOLMOD 490; 1600 x 96: 2.2 against 5.5 s,
# MUMPS 2.7, CHOLMOD 2.3 (`dolfinopt bench`, solvers). A second thread helps CHOLMOD alone: 0.37 and
# 2.1 s.
NESTED_ROWS = 30_000


@dataclass(frozen=True)
class ArmShare:
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
    def leads(self) -> bool:
        """True on the one rank that speaks for its arms."""
        return bool(self.arms) and self.comm.rank == 0


def share_arms(world: MPI.Comm, cells: Mapping[int, int]) -> ArmShare:
    """Deal arms with a design of their own out over the ranks of `world` (collective).

    Up to as many ranks as arms, whole arms are dealt out and need no communication. Further
    ranks join them only where arms are large: neighbouring ranks then share one arm. Small arms
    lose by it (200 x 12 cells: 3 ms on one rank, 23 ms on two), and whole arms give the same
    bits on any number of ranks, where shared ones agree to rounding.

    Args:
        world: all ranks.
        cells: number of cells of every such arm, by its index in the scene.
    """
    arms = sorted(cells)
    if world.size <= len(arms):
        mine = tuple(arms[world.rank :: world.size])
        color = world.rank
    elif max(cells.values()) >= SPLIT_CELLS:
        color = world.rank * len(arms) // world.size
        mine = (arms[color],)
    else:
        color = world.rank
        mine = (arms[world.rank],) if world.rank < len(arms) else ()
    return ArmShare(world=world, comm=world.Split(color, world.rank), arms=mine)


def sum_over_arms(share: ArmShare, mine: Mapping[int, np.ndarray]) -> np.ndarray:
    """Return the sum of one array an arm, added in the arms' order: the same bits on all ranks.

    Args:
        share: which ranks do which arm.
        mine: arrays of this rank's arms, over its own cells; equal shapes.
    """
    if share.comm.size > 1:
        mine = {arm: share.comm.allreduce(value) for arm, value in mine.items()}
    pieces: dict[int, np.ndarray] = {}
    for piece in share.world.allgather(dict(mine) if share.leads else {}):
        pieces.update(piece)
    return np.sum([pieces[arm] for arm in sorted(pieces)], axis=0)


def gather_arms(share: ArmShare, mine: Mapping[int, T]) -> dict[int, T]:
    """Collect one object an arm on the root, in the arms' order; empty elsewhere."""
    pieces = share.world.gather(dict(mine) if share.leads else {}, root=0)
    if pieces is None:
        return {}
    merged: dict[int, T] = {}
    for piece in pieces:
        merged.update(piece)
    return {arm: merged[arm] for arm in sorted(merged)}


def gather_cells(share: ArmShare, mine: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Collect cell arrays (n_local, ...) of every arm on the root, ranks in order.

    Returns:
        One array (n_cells, ...) an arm on the root, empty elsewhere.
    """
    whole = {}
    for arm, values in mine.items():
        pieces = share.comm.gather(values, root=0)
        if pieces is not None:
            whole[arm] = np.concatenate(pieces)
    return gather_arms(share, whole)


def on_root(world: MPI.Comm, action: Any, *arguments: Any) -> Any:
    """Run `action(*arguments)` on the root and hand its result, or its exception, to all ranks."""
    outcome: tuple[Any, BaseException | None] = (None, None)
    if world.rank == 0:
        try:
            outcome = (action(*arguments), None)
        except (InputError, ConvergenceError) as error:
            outcome = (None, error)
    result, failure = world.bcast(outcome, root=0)
    if failure is not None:
        raise failure
    return result


@contextmanager
def one_ending(world: MPI.Comm) -> Iterator[None]:
    """End all ranks together when the block fails on any of them.

    Status 2 for `InputError`, 1 for everything else. When all ranks fail, the root prints the
    message and every rank exits; when only some do, those print and abort the rest, which would
    otherwise wait for ever.
    """
    # Its own communicator: the others may be waiting in a collective of `world`.
    roll_call = world.Dup()
    try:
        yield
    except SystemExit:
        raise
    except BaseException as error:
        status = 2 if isinstance(error, InputError) else 1
        everywhere = _all_arrive(roll_call)
        if world.rank == 0 or not everywhere:
            _report(error)
        if not everywhere:
            world.Abort(status)
        sys.exit(status)


def _report(error: BaseException) -> None:
    """Print one line for what the user can mend, the whole traceback for what he cannot."""
    if isinstance(error, KeyboardInterrupt):
        print("dolfinopt: interrupted", file=sys.stderr)
    elif isinstance(error, InputError | ConvergenceError):
        print(f"dolfinopt: {error}", file=sys.stderr)
    else:
        traceback.print_exception(error)
    sys.stdout.flush()
    sys.stderr.flush()


def _all_arrive(comm: MPI.Comm) -> bool:
    """Return True when every rank comes here within the grace period."""
    if comm.size == 1:
        return True
    request = comm.Ibarrier()
    limit = time.monotonic() + GRACE
    while time.monotonic() < limit:
        if request.Test():
            return True
        time.sleep(0.01)
    return False


@contextmanager
def obeying_options(prefix: str) -> Iterator[None]:
    """Name the user's PETSc options of this prefix where PETSc or SLEPc refuses them.

    Raises:
        InputError: PETSc failed, and there are such options.
    """
    try:
        yield
    except PETSc.Error as error:
        given = PETSc.Options(prefix).getAll()
        if not given:
            raise
        options = " ".join(f"-{prefix}{key} {value}".strip() for key, value in given.items())
        raise InputError(
            f"PETSc options {options}: PETSc refuses them or fails with them (error {error.ierr})"
        ) from None


def direct_solver(mat: PETSc.Mat, ordering: str, prefix: str) -> PETSc.KSP:
    """Return a Cholesky solver: PETSc's own on one rank, MUMPS across ranks.

    PETSc options that begin with the prefix replace these choices.

    Args:
        mat: symmetric positive definite, marked so.
        ordering: PETSc's name of the elimination order of a small matrix on one rank; large ones
            take nested dissection, MUMPS chooses its own.
        prefix: of the options, e.g. "dolfinopt_stiffness_".

    Raises:
        InputError: PETSc refuses the user's options.
    """
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOptionsPrefix(prefix)
    ksp.setOperators(mat)
    ksp.setType(PETSc.KSP.Type.PREONLY)
    pc = ksp.getPC()
    pc.setType(PETSc.PC.Type.CHOLESKY)
    if mat.comm.size == 1:
        pc.setFactorSolverType("petsc")
        pc.setFactorOrdering(ordering if mat.getSize()[0] < NESTED_ROWS else "nd")
    else:
        pc.setFactorSolverType("mumps")
    with obeying_options(prefix):
        ksp.setFromOptions()
    return ksp
