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


@dataclass(frozen=True)
class ArmShare:
    """Which ranks work on which arm.

    Up to as many ranks as arms, whole arms are dealt out and need no communication; with more
    ranks than arms, neighbouring ranks share one arm.

    Attributes:
        world: all ranks.
        comm: the ranks that share this rank's arms.
        arms: indices of this rank's arms.
    """

    world: MPI.Comm
    comm: MPI.Comm
    arms: tuple[int, ...]

    @property
    def leads(self) -> bool:
        """True on the one rank that speaks for its arms."""
        return self.comm.rank == 0


def share_arms(world: MPI.Comm, num_arms: int) -> ArmShare:
    """Deal `num_arms` arms out over the ranks of `world` (collective)."""
    if world.size <= num_arms:
        arms = tuple(range(world.rank, num_arms, world.size))
        color = world.rank
    else:
        color = world.rank * num_arms // world.size
        arms = (color,)
    return ArmShare(world=world, comm=world.Split(color, world.rank), arms=arms)


def gather_bodies(share: ArmShare, mine: Mapping[int, T]) -> list[T]:
    """Collect one object an arm on the root, in the arms' order; empty list elsewhere."""
    pieces = share.world.gather(dict(mine) if share.leads else {}, root=0)
    if pieces is None:
        return []
    merged: dict[int, T] = {}
    for piece in pieces:
        merged.update(piece)
    return [merged[arm] for arm in sorted(merged)]


def gather_cells(share: ArmShare, mine: Mapping[int, np.ndarray]) -> list[np.ndarray]:
    """Collect cell arrays (n_local, ...) of every arm on the root, ranks in order.

    Returns:
        One array (n_cells, ...) an arm on the root, an empty list elsewhere.
    """
    whole = {}
    for arm, values in mine.items():
        pieces = share.comm.gather(values, root=0)
        if pieces is not None:
            whole[arm] = np.concatenate(pieces)
    return gather_bodies(share, whole)


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
    try:
        yield
    except SystemExit:
        raise
    except BaseException as error:
        status = 2 if isinstance(error, InputError) else 1
        everywhere = _all_arrive(world)
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


def _all_arrive(world: MPI.Comm) -> bool:
    """Return True when every rank comes here within the grace period."""
    if world.size == 1:
        return True
    request = world.Ibarrier()
    limit = time.monotonic() + GRACE
    while time.monotonic() < limit:
        if request.Test():
            return True
        time.sleep(0.01)
    return False


def direct_solver(mat: PETSc.Mat, ordering: str) -> PETSc.KSP:
    """Return a Cholesky solver for `mat`: PETSc's own on one rank, MUMPS across ranks.

    Args:
        mat: symmetric positive definite, marked so.
        ordering: PETSc's name of the elimination order on one rank; MUMPS chooses its own.
    """
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOperators(mat)
    ksp.setType(PETSc.KSP.Type.PREONLY)
    pc = ksp.getPC()
    pc.setType(PETSc.PC.Type.CHOLESKY)
    if mat.comm.size == 1:
        pc.setFactorSolverType("petsc")
        pc.setFactorOrdering(ordering)
    else:
        pc.setFactorSolverType("mumps")
    return ksp
