"""Sessions of Gmsh on the root, that leave signals, terminal and the next session alone."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
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
        found = ours.recv()
    except EOFError:
        found = InputError("Gmsh gave up on it")
    except BaseException:  # Ctrl-C: nobody waits for it
        child.kill()
        raise
    finally:
        child.join()
    if isinstance(found, Exception):
        raise found
    return cast(Result, found)


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


# -- the groups of an arm's Gmsh model: interfaces, designed and solid surfaces ------------------
#
# Whatever a user's file calls its groups and however it numbers them, they become these four.

# Physical groups of the model.
INBOARD, OUTBOARD, DESIGN, PASSIVE, VOID = 1, 2, 3, 4, 5
FURTHER = 11  # the first of a solid's further interfaces; the next ones follow
NAMES = {INBOARD: "inboard", OUTBOARD: "outboard", DESIGN: "design", PASSIVE: "passive"}
NAMES[VOID] = "void"  # of solids alone; in the plane arms.regions say so


def group_named(name: str, *groups: int) -> int | None:
    """Return which of `groups` a name in a file means: "Passive2" begins with passive."""
    for group in groups:
        if name.strip().casefold().startswith(NAMES[group]):
            return group
    return None


def find_groups(gmsh: Any, unknown: list[str]) -> dict[int, list[int]]:
    """Return the curves or surfaces of each of our groups, by how the names in the file begin.

    Other names of surfaces are added to `unknown`.
    """
    model = gmsh.model
    named: dict[tuple[int, str], set[int]] = {}
    for dim, tag in model.getPhysicalGroups():
        name = model.getPhysicalName(dim, tag).strip()
        group = group_named(name, *((INBOARD, OUTBOARD) if dim == 1 else (PASSIVE, DESIGN)))
        if dim == 2 and group is None and name:
            unknown.append(name)
        key = dim, NAMES[group] if group else name.casefold()
        named.setdefault(key, set()).update(model.getEntitiesForPhysicalGroup(dim, tag))
    groups = {}
    for tag in (INBOARD, OUTBOARD):
        groups[tag] = named.get((1, NAMES[tag]), set())
        if not any(len(model.mesh.getElements(1, curve)[1]) for curve in groups[tag]):
            raise InputError(_missing(NAMES[tag], named))
    passive = named.get((2, NAMES[PASSIVE]), set())
    every = {tag for _, tag in model.getEntities(2) if len(model.mesh.getElements(2, tag)[1])}
    groups[PASSIVE] = passive & every
    groups[DESIGN] = named.get((2, NAMES[DESIGN]), every - passive) & every
    for a, b in ((INBOARD, OUTBOARD), (DESIGN, PASSIVE)):
        if groups[a] & groups[b]:
            raise InputError(
                f"{'curve' if a == INBOARD else 'surface'} {min(groups[a] & groups[b])} is in "
                f'both groups "{NAMES[a]}" and "{NAMES[b]}"; give each its own geometrical entity'
            )
    return {tag: sorted(int(entity) for entity in entities) for tag, entities in groups.items()}


def _missing(name: str, named: Mapping[tuple[int, str], set[int]]) -> str:
    kinds = {1: "curves", 2: "surfaces"}
    found = [f'{kinds[dim]} "{text}"' for dim, text in sorted(named) if dim in kinds]
    if (1, name) in named:
        return f'the curves of group "{name}" carry no lines; save the mesh of all curves'
    return (
        f'no curves in a group "{name}"; found {", ".join(found) or "no named groups"}; name the '
        f'interface\'s curves so: Physical Curve("{name}") = {{...}}'
    )


def rename_groups(gmsh: Any, groups: Mapping[int, list[int]]) -> None:
    """Put our groups in place of the file's, after a look at the kinds of cells."""
    model = gmsh.model
    _check_kinds(gmsh, groups[DESIGN] + groups[PASSIVE])
    model.removePhysicalGroups()
    for tag, entities in groups.items():
        if entities:
            dim = 1 if tag in (INBOARD, OUTBOARD) else 2
            entities = [e for e in entities if len(model.mesh.getElements(dim, e)[1])]
            model.addPhysicalGroup(dim, entities, tag)
            model.setPhysicalName(dim, tag, NAMES[tag])
    model.mesh.renumberNodes()  # DOLFINx wants 1, 2, ...


def _check_kinds(gmsh: Any, surfaces: list[int]) -> None:
    mesh = gmsh.model.mesh
    if len(mesh.getElementTypes(3)):
        raise InputError("it is a mesh of a body in 3D; give the mesh of the plane z = 0")
    kinds = {int(kind) for surface in surfaces for kind in mesh.getElements(2, surface)[0]}
    if not kinds:
        raise InputError("it has no cells; mesh its surfaces in 2D")
    if kinds == {TRIANGLE, QUADRILATERAL}:
        raise InputError(
            "it mixes triangles and quadrilaterals; expected one of them: set cell_shape (.geo, "
            ".step), or recombine fully (Mesh.RecombinationAlgorithm = 3)"
        )
    if not kinds <= {TRIANGLE, QUADRILATERAL}:
        found = mesh.getElementProperties(min(kinds - {TRIANGLE, QUADRILATERAL}))[0]
        raise InputError(
            f'it has cells of kind "{found}"; expected straight triangles or quadrilaterals '
            "(Mesh.ElementOrder = 1)"
        )


def unknown_names(where: str, names: list[str]) -> str:
    listed = ", ".join(f'"{name}"' for name in sorted(set(names)))
    return (
        f"{where}: the names of surfaces {listed} have no meaning: expected names that "
        "begin with passive (stays solid) or design; all other surfaces are "
        "designed, or left out if one is named design"
    )
