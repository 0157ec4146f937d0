"""The optimiser's whole memory in one file, so that a resumed run ends in the same bits."""

from __future__ import annotations

import copyreg
import hashlib
import json
import pickle
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.disk import write_arrays
from dolfinopt.dynamics.collocation import Strategy
from dolfinopt.errors import InputError
from dolfinopt.optimization.state import HistoryRow, Memory
from dolfinopt.output.design import append_history, write_history
from dolfinopt.output.folders import CHECKPOINT, remove_stale
from dolfinopt.parallel import Partition, gather_tables, on_root, together
from dolfinopt.scene.law_variables import LAW
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import DIGEST, flattened, program, scene_content
from dolfinopt.solver import user_options

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

NAME, HISTORY = CHECKPOINT, "history.csv"
SEAL = "digest"  # of all other arrays
# All that a pickled memory may name: a file from elsewhere can run nothing.
CLASSES = {
    "dolfinopt.optimization.state": ("Memory", "Best", "Progress", "HistoryRow"),
    "dolfinopt.responses.order_selection": ("OrderSelection",),
    "dolfinopt.multibody.loads": ("Stiffening",),
    "dolfinopt.dynamics.collocation": ("Solution", "Strategy"),
}
copyreg.pickle(Strategy, lambda item: (Strategy, (item.value,)))  # by its class alone
MAKERS = "ndarray", "dtype", "_reconstruct", "_frombuffer", "scalar"  # of NumPy, private ones too
# Keys a resumed run may change: when to stop, and how to go on from where it is.
MAY_CHANGE = {
    *(f"optimizer.{key}" for key in ("max_iterations", "tolerance", "kkt_tolerance")),
    "objective.gradient",
    "name",  # which earlier versions kept
}


def _scene_text(scene: Scene) -> str:
    """Return the scene as JSON; its files by their content, so that a project can be moved."""
    return json.dumps(scene_content(scene), sort_keys=True)


def begin(folder: Path, scene: Scene) -> None:
    """Write the checkpoint of a run that has done nothing yet, and nothing else (root only)."""
    remove_stale(folder)
    _sealed(folder, _stamp(scene))


@contextmanager
def withdrawn(folder: Path | None) -> Iterator[None]:
    """Leave no checkpoint in a folder where bad input ends the block; None: let it be."""
    try:
        yield
    except InputError:
        if folder is not None:
            (folder / NAME).unlink(missing_ok=True)
        raise


def _stamp(scene: Scene) -> dict[str, np.ndarray]:
    """Return what a run must share with a checkpoint to go on from it."""
    return {
        "scene": np.array(_scene_text(scene)),
        "program": np.array(json.dumps(program())),
        "options": np.array(user_options()),
    }


def _sealed(folder: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write the checkpoint with a digest, so that a changed one is known."""
    write_arrays(folder / NAME, {**arrays, SEAL: np.array(_digest(arrays))})


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return what stands for names, types, shapes and values of arrays."""
    result = hashlib.blake2b(digest_size=16)
    for key in sorted(arrays):
        array = arrays[key]
        result.update(f"{key} {array.dtype.str} {array.shape}".encode())
        result.update(array.tobytes())
    return result.hexdigest()


def check(folder: Path, scene: Scene) -> None:
    """Raise `InputError` unless the folder holds a checkpoint of this scene (root only)."""
    _read(folder, scene)


@dataclass(frozen=True, eq=False)
class FolderRecorder:
    """Writes history.csv and checkpoint.npz, see `loop.Recorder`, and reads the latter.

    Attributes:
        folder: exists.
        scene, partition, arms: what the checkpoint describes.
    """

    folder: Path
    scene: Scene
    partition: Partition
    arms: Mapping[int, Arm]

    def begin(self, rows: Sequence[HistoryRow]) -> None:
        """Write the history anew with the rows known so far (collective)."""
        on_root(self.partition.world, write_history, self.folder / HISTORY, rows)

    def append(self, row: HistoryRow) -> None:
        """Add a line to the history (root only)."""
        append_history(self.folder / HISTORY, row)

    def save(self, memory: Memory) -> None:
        """Replace the checkpoint atomically (collective)."""
        with together(self.partition.world):
            own = {k: _of_arm(arm, k, memory) for k, arm in self.arms.items()}
        tables = gather_tables(self.partition, own)

        def write() -> None:
            _sealed(self.folder, {**_stamp(self.scene), "memory": _packed(memory, tables)})

        on_root(self.partition.world, write)

    def load(self) -> Memory | None:
        """Return the memory of an interrupted run, or None when it had only begun (collective).

        Rows go to the cells and nodes at the same place, on any number of ranks.

        Raises:
            InputError: no checkpoint, a damaged one, or one of another scene.
        """
        arrays = on_root(self.partition.world, _read, self.folder, self.scene)
        if "memory" not in arrays:
            return None
        with together(self.partition.world):
            return _memory(arrays["memory"], self.arms)


def _read(folder: Path, scene: Scene) -> dict[str, np.ndarray]:
    """Read and verify the checkpoint."""
    path = folder / NAME
    if not path.is_file():
        raise InputError(
            f"{path}: --resume finds no checkpoint here; start without --resume, or name the "
            "folder of the interrupted run with --out"
        )
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {key: data[key] for key in data.files}
        if str(arrays.pop(SEAL)) != _digest(arrays):
            raise ValueError("it was changed")
        theirs = json.loads(str(arrays["scene"]))
    except Exception as error:  # whatever a foreign or damaged file may raise
        raise InputError(
            f"{path}: --resume cannot read this checkpoint ({type(error).__name__}); start "
            "without --resume"
        ) from None
    if "program" not in arrays or json.loads(str(arrays["program"])) != program():
        raise InputError(
            f"{path}: --resume: another version of dolfinopt wrote this checkpoint and would go on "
            "to another design; start without --resume"
        )
    if str(arrays["options"]) != user_options():
        raise InputError(
            f"{path}: --resume: PETSc options were {str(arrays['options'])!r} there, and are "
            f"{user_options()!r} here; set PETSC_OPTIONS as it was, or start without --resume"
        )
    difference = _difference(theirs, json.loads(_scene_text(scene)))
    if difference:
        raise InputError(
            f"{path}: --resume: the checkpoint is of another scene: {difference}; start without "
            "--resume, or give the scene it was made for"
        )
    return arrays


def _difference(theirs: Any, ours: Any) -> str:
    """Describe the first difference between two scenes' data; empty when they compute the same."""
    there, here = dict(flattened(theirs)), dict(flattened(ours))
    for key in [*here, *there]:
        a, b = there.get(key), here.get(key)
        if a == b or key in MAY_CHANGE:
            continue
        if all(isinstance(item, str) and item.startswith(DIGEST) for item in (a, b)):
            return f"the content of the file {key} has changed"
        return f"{key} = {a!r} there, {b!r} here"
    return ""


# -- the memory as arrays of whole arms, and back ------------------------------------------------


# By arm: its cells, nodes and modes, by their names.
Tables = Mapping[int, Mapping[str, np.ndarray]]


def _packed(memory: Memory, tables: Tables) -> np.ndarray:
    """Return what does not belong to single arms, pickled with what does (root only)."""
    best = replace(memory.best, x=np.empty(0))
    memory = replace(memory, cells={LAW: memory.cells[LAW]}, modes={}, best=best)
    return np.frombuffer(pickle.dumps((memory, tables)), np.uint8)


class _Unpickler(pickle.Unpickler):
    """Reads data of some classes and arrays, and nothing else."""

    classes: Mapping[str, Sequence[str]]

    def find_class(self, module: str, name: str) -> Any:
        numpy = MAKERS if module.split(".")[0] == "numpy" else ()
        if name in self.classes.get(module, numpy):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name}")


def unpickled(data: np.ndarray, classes: Mapping[str, Sequence[str]]) -> Any:
    """Return what was pickled, of classes by their modules and of arrays alone."""
    reader = _Unpickler(BytesIO(data.tobytes()))
    reader.classes = classes
    return reader.load()


def _of_arm(arm: Arm, index: int, memory: Memory) -> dict[str, np.ndarray]:
    """Return this rank's rows of one arm's arrays."""
    arrays = {"centroid": arm.mesh.centroid, "points": _interior_points(arm)}
    if index in memory.cells:  # an arm that repeats another's design has no variables
        arrays["cells"] = memory.cells[index]
    inner = arm.substructure.T.num_interior
    for j, modes in enumerate(memory.modes[index]):
        arrays[f"modes{j}"], arrays[f"outboard{j}"] = modes[:inner], modes[inner:]
    return arrays


def _memory(packed: np.ndarray, arms: Mapping[int, Arm]) -> Memory:
    """Return the checkpoint's memory, cells and modes of this rank's arms."""
    found: tuple[Memory, Tables] = unpickled(packed, CLASSES)
    memory, tables = found
    cells = dict(memory.cells)
    for k, arm in arms.items():
        if "cells" in tables[k]:
            rows = _match(tables[k]["centroid"], arm.mesh.centroid)
            cells[k] = tables[k]["cells"][rows]
    modes = {k: _modes(tables[k], arm) for k, arm in arms.items()}
    return replace(memory, cells=cells, modes=modes)


def _modes(table: Mapping[str, np.ndarray], arm: Arm) -> list[np.ndarray]:
    """Return this rank's rows of an arm's sets of modes; its last rank has the interface's."""
    nodes = _match(table["points"], _interior_points(arm))
    rows = (arm.mesh.dim * nodes[:, None] + np.arange(arm.mesh.dim)).ravel()
    is_last = arm.mesh.comm.rank == arm.mesh.comm.size - 1
    modes = []
    for j in range(len(arm.initial_vectors)):
        interior, outboard = table[f"modes{j}"], table[f"outboard{j}"]
        modes.append(np.vstack([interior[rows], outboard if is_last else outboard[:0]]))
    return modes


def _interior_points(arm: Arm) -> np.ndarray:
    substructure = arm.substructure
    return substructure.operators.points[substructure.T.interior_nodes]


def _match(known: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return for each wanted point the row of the same point among the known ones."""
    from scipy.spatial import cKDTree

    if len(wanted) == 0:
        return np.zeros(0, dtype=int)
    return cKDTree(known).query(wanted)[1]
