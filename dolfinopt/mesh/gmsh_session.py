"""Sessions of Gmsh on the root, that leave signals, terminal and the next session alone."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar, cast

from mpi4py import MPI

from dolfinopt.errors import InputError
from dolfinopt.mesh.measured import UNREAD_STATEMENTS_LIMIT
from dolfinopt.parallel import together

Result = TypeVar("Result")

# Gmsh's numbers of straight triangles and quadrilaterals.
LINE, TRIANGLE, QUADRILATERAL = 1, 2, 3


@contextmanager
def gmsh_on_root(comm: MPI.Comm) -> Iterator[Any]:
    """Yield the module gmsh, with a session of it on rank 0 of `comm` (collective)."""
    with together(comm), _interrupts_kept():
        import gmsh

        if comm.rank == 0:
            _begin(gmsh)
    failed = True
    try:
        yield gmsh
        failed = False
    finally:
        if comm.rank == 0:
            with _interrupts_kept():
                gmsh.finalize()
                if failed:
                    _finish_reading(gmsh)


@contextmanager
def _interrupts_kept() -> Iterator[None]:
    """Keep what Ctrl-C does: Gmsh would have it kill the process without a word."""
    # 4.8 from its import, which takes 0.2 s, until a session ends, which only the root has; later
    # ones during a session.
    change = signal.signal

    def keep(number: int, handler: Any) -> Any:
        return signal.getsignal(number) if number == signal.SIGINT else change(number, handler)

    signal.signal = keep  # type: ignore[assignment]
    try:
        yield
    finally:
        signal.signal = change


@contextmanager
def telling(told: Callable[[str], Exception]) -> Iterator[None]:
    """Put what Gmsh says about its own errors into those that `told` makes of it."""
    try:
        yield
    except Exception as error:
        if type(error) is not Exception:  # Gmsh raises no other
            raise
        raise told(" ".join(str(error).split()) or "Gmsh failed") from None


def _begin(gmsh: Any) -> None:
    gmsh.initialize(readConfigFiles=False)  # same cells for every user
    gmsh.option.setNumber("General.Terminal", 0)
    # Parameters outlive gmsh.finalize: drop those of the mesh before.
    gmsh.onelab.clear()


def _finish_reading(gmsh: Any) -> None:
    """Have Gmsh's parser come to the end of a text it gave up, a statement a session."""
    # It would go on with the rest of it when it is asked to read the next file.
    with tempfile.TemporaryDirectory() as folder:
        empty = Path(folder) / "empty.geo"
        empty.write_text("\n")
        for _ in range(UNREAD_STATEMENTS_LIMIT):
            _begin(gmsh)
            try:
                gmsh.open(str(empty))
                return
            except Exception:  # of the rest of the text
                continue
            finally:
                gmsh.finalize()


def in_child(work: Callable[..., Result], *given: Any) -> Result:
    """Return what `work` returns in a process of its own, which Gmsh may end.

    Raises:
        InputError: the process was ended; or what `work` raises.
    """
    ours, theirs = multiprocessing.Pipe(duplex=False)
    with warnings.catch_warnings():
        # Of threads of the parent, none of which hold what Gmsh needs.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = multiprocessing.get_context("fork").Process(
            target=_report, args=(theirs, work, given), daemon=True
        )
        child.start()
    theirs.close()
    try:
        result = ours.recv()
    except EOFError:
        result = InputError("Gmsh gave up on it")
    except BaseException:  # Ctrl-C: nobody waits for it
        child.kill()
        raise
    finally:
        child.join()
    if isinstance(result, Exception):
        raise result
    return cast(Result, result)


def _report(pipe: Connection, work: Callable[..., Any], given: tuple[Any, ...]) -> None:
    """Send what `work` returns, or raises."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends it
    try:
        pipe.send(work(*given))
    except Exception as error:
        pipe.send(error)


@contextmanager
def silent_terminal() -> Iterator[None]:
    """Keep off the terminal what Open CASCADE writes there itself, past Gmsh's options."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(1), os.dup(2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # what C has buffered belongs there, too
        for target, copy in enumerate(kept, start=1):
            os.dup2(copy, target)
            os.close(copy)
        os.close(nowhere)


def mesh_surfaces(gmsh: Any, shape: str | None) -> None:
    """Mesh the surfaces of the open model, in cells of `shape` if one is asked for."""
    gmsh.option.setNumber("Mesh.ElementOrder", 1)
    gmsh.model.mesh.generate(2)
    kinds = set(gmsh.model.mesh.getElementTypes(2))
    if shape == "quadrilateral" and kinds - {QUADRILATERAL}:
        gmsh.option.setNumber("Mesh.RecombineAll", 1)
        # Blossom, then all cells divided: the only algorithm that leaves no triangle.
        gmsh.option.setNumber("Mesh.RecombinationAlgorithm", 3)
        gmsh.model.mesh.clear()
        gmsh.model.mesh.generate(2)
    elif shape == "triangle" and QUADRILATERAL in kinds:
        gmsh.model.mesh.splitQuadrangles(2.0)  # those of less than twice the best quality: all


def mesh_volumes(gmsh: Any, size: float | None, shape: str | None) -> None:
    """Mesh the volumes: tetrahedra, or hexahedra by cutting each into four."""
    halves = shape == "hexahedron"
    if halves:
        gmsh.option.setNumber("Mesh.SubdivisionAlgorithm", 2)
    if size is not None:
        gmsh.option.setNumber("Mesh.MeshSizeMax", 2.0 * size if halves else size)
    gmsh.model.mesh.generate(3)


# Physical groups of an arm's Gmsh model, whatever a user's file calls and numbers them.
INBOARD, OUTBOARD, DESIGN, PASSIVE, VOID = 1, 2, 3, 4, 5
FURTHER = 11  # the first of a solid's further interfaces; the next ones follow
NAMES = {INBOARD: "inboard", OUTBOARD: "outboard", DESIGN: "design", PASSIVE: "passive"}
NAMES[VOID] = "void"  # of solids alone; in the plane arms.regions say so
