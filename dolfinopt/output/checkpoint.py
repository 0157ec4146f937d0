"""The optimiser's whole memory in one file, so that a resumed run ends in the same bits."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.disk import write_arrays
from dolfinopt.dynamics.collocation import Solution, Strategy
from dolfinopt.errors import InputError
from dolfinopt.multibody.loads import Stiffening
from dolfinopt.optimization.state import Best, HistoryRow, Memory, Progress
from dolfinopt.output.folders import CHECKPOINT, remove_stale
from dolfinopt.parallel import Partition, gather_cells, on_root, together
from dolfinopt.responses.order_selection import OrderSelection
from dolfinopt.scene.law_variables import LAW
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import DIGEST, flattened, program, with_digests
from dolfinopt.solver import user_options

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

NAME = CHECKPOINT
SEAL = "digest"  # of all other arrays
# Numbers of the best design.
BEST = "iteration", "beta", "objective", "excess", "crisp"
# Keys a resumed run may change: when to stop, and how to go on from where it is.
MAY_CHANGE = {
    *(f"optimizer.{key}" for key in ("max_iterations", "tolerance", "kkt_tolerance")),
    "objective.gradient",
}


def _scene_text(scene: Scene) -> str:
    """Return the scene as JSON; its files by their content, so that a project can be moved."""
    data = with_digests(scene.to_dict())
    del data["part"]  # which comes after the run
    return json.dumps(data, sort_keys=True)


def begin(folder: Path, scene: Scene) -> None:
    """Write the checkpoint of a run that has done nothing yet, and nothing else (root only)."""
    remove_stale(folder)
    _sealed(folder, {**_stamp(scene), "iteration": np.array(-1)})


def _stamp(scene: Scene) -> dict[str, np.ndarray]:
    """Return what a run must share with a checkpoint to go on from it."""
    return {
        "scene": np.array(_scene_text(scene)),
        "program": np.array(json.dumps(program())),
        "options": np.array(user_options()),
    }


def reopen(folder: Path) -> None:
    """Remove what a run that goes on will write anew, so that nothing old stands beside it."""
    remove_stale(folder, keep=(NAME, "history.csv"))


def save(
    folder: Path, scene: Scene, partition: Partition, arms: Mapping[int, Arm], memory: Memory
) -> None:
    """Replace the checkpoint atomically (collective)."""
    number = len(scene.arms) + 1
    arrays = arrays_of(partition, arms, memory, number)
    with together(partition.world):
        if partition.world.rank == 0:
            _write(folder, scene, memory, arrays)


def _write(folder: Path, scene: Scene, memory: Memory, arrays: dict[str, Any]) -> None:
    """Write the file, with the designs' `arrays` (root only)."""
    arrays = {
        **_stamp(scene),
        **arrays,
        "history": np.array([row.values for row in memory.history]),
        "history_columns": np.array(memory.history[0].columns),
        "initial_deviation": memory.initial_deviation,
        "exact_from": -1 if memory.exact_from is None else memory.exact_from,
    }
    if memory.choice is not None:
        arrays["coordinates"] = memory.choice.coordinates
        arrays["tried"] = np.array(memory.choice.tried)
    if memory.stiffening is not None:
        estimate = memory.stiffening.estimate
        arrays["stiffening"] = [np.nan if estimate is None else estimate, memory.stiffening.on]
    _sealed(folder, {key: np.asarray(value) for key, value in arrays.items()})


def _sealed(folder: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write the checkpoint with a digest, so that a changed one is known."""
    write_arrays(folder / NAME, {**arrays, SEAL: np.array(_digest(arrays))})


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    result = hashlib.blake2b(digest_size=16)
    for key in sorted(arrays):
        array = arrays[key]
        result.update(f"{key} {array.dtype.str} {array.shape}".encode())
        result.update(array.tobytes())
    return result.hexdigest()


def check(folder: Path, scene: Scene) -> None:
    """Raise `InputError` unless the folder holds a checkpoint of this scene (root only)."""
    _read(folder, scene)


def load(
    folder: Path, scene: Scene, partition: Partition, arms: Mapping[int, Arm]
) -> Memory | None:
    """Return the memory of an interrupted run, or None when it had only begun (collective).

    Rows go to the cells and nodes at the same place, on any number of ranks.

    Raises:
        InputError: no checkpoint, a damaged one, or one of another scene.
    """
    arrays = on_root(partition.world, _read, folder, scene)
    if int(arrays["iteration"]) < 0:
        return None
    with together(partition.world):
        return _memory(arrays, arms)


def _memory(arrays: Mapping[str, Any], arms: Mapping[int, Arm]) -> Memory:
    """Return the checkpoint's memory, cells and modes of this rank's arms."""
    columns = arrays["history_columns"].tolist()
    history = [HistoryRow.from_values(columns, row.tolist()) for row in arrays["history"]]
    choice = None
    if "coordinates" in arrays:
        tried = tuple((int(number), float(error)) for number, error in arrays["tried"])
        count = int(arrays["coordinates"])
        choice = OrderSelection(count, dict(tried)[count], tried)
    stiffening = None
    if "stiffening" in arrays:
        estimate, on = arrays["stiffening"].tolist()
        stiffening = Stiffening(None if np.isnan(estimate) else estimate, bool(on))
    exact_from = int(arrays["exact_from"])
    return Memory(
        **fields_from(arrays, arms),
        history=history,
        initial_deviation=arrays["initial_deviation"],
        exact_from=None if exact_from < 0 else exact_from,
        choice=choice,
        stiffening=stiffening,
    )


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
        if int(arrays["iteration"]) >= 0:
            arrays["history_columns"], arrays["last"]  # those of earlier versions have none
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


# -- one design of an optimisation as arrays of whole arms, for the checkpoint, and back ---------

# A solution's arrays: name in the file, field.
SOLUTION = {"edges": "time_grid", "nodes": "nodes", "q": "q", "qd": "qd", "a": "a"}


def arrays_of(
    partition: Partition, arms: Mapping[int, Arm], memory: Memory, number: int
) -> dict[str, Any]:
    """Return the arrays of one design, of whole arms (collective; complete on the root).

    Args:
        number: of sets of modes.
    """
    with together(partition.world):
        points = {k: _interior_points(arm) for k, arm in arms.items()}
        known = [
            {k: _rows(arm, memory.modes[k], j) for k, arm in arms.items()} for j in range(number)
        ]
    columns: dict[str, Mapping[int, Any]] = {
        "centroid": gather_cells(partition, {k: arm.mesh.centroid for k, arm in arms.items()}),
        "cells": gather_cells(partition, {k: x for k, x in memory.cells.items() if k != LAW}),
        "points": gather_cells(partition, points),
    }
    for j, by_arm in enumerate(known):
        columns[f"modes{j}"] = gather_cells(partition, {k: rows for k, (rows, _) in by_arm.items()})
        columns[f"outboard{j}"] = gather_cells(
            partition, {k: last for k, (_, last) in by_arm.items()}
        )
    if partition.world.rank != 0:
        return {}
    arrays: dict[str, Any] = {
        "iteration": memory.iteration,
        "last": [memory.change, memory.reach, memory.returned_to, memory.mma_steps],
        "gradient": memory.gradient,
        "multipliers": memory.multipliers,
        "course": [memory.progress.objectives, memory.progress.excesses],
        "since": memory.progress.since,
        "best": [getattr(memory.best, name) for name in BEST],
        "sharpness": memory.beta,
        "law": memory.cells[LAW],
    }
    for k, solution in enumerate(memory.solutions):
        for name, field in (*SOLUTION.items(), ("error", "error")):
            arrays[f"solution{k}/{name}"] = getattr(solution, field)
        arrays[f"solution{k}/strategy"] = solution.strategy.name
    for key, by_arm in columns.items():
        arrays |= {f"arm{k}/{key}": value for k, value in by_arm.items()}
    return arrays


def fields_from(arrays: Mapping[str, Any], arms: Mapping[int, Arm]) -> dict[str, Any]:
    """Return the fields of `Memory`."""
    cells = {LAW: np.asarray(arrays["law"])}
    modes: dict[int, list[np.ndarray]] = {}
    for k, arm in arms.items():
        if f"arm{k}/cells" in arrays:  # an arm that repeats another's design has no variables
            rows = _match(arrays[f"arm{k}/centroid"], arm.mesh.centroid)
            cells[k] = arrays[f"arm{k}/cells"][rows]
        rows = _match(arrays[f"arm{k}/points"], _interior_points(arm))
        rows = (arm.mesh.dim * rows[:, None] + np.arange(arm.mesh.dim)).ravel()
        last = arm.mesh.comm.rank == arm.mesh.comm.size - 1
        modes[k] = []
        for j in range(len(arm.initial_vectors)):
            interior, outboard = (arrays[f"arm{k}/{part}{j}"] for part in ("modes", "outboard"))
            modes[k].append(np.vstack([interior[rows], outboard if last else outboard[:0]]))
    solutions: list[Solution] = []
    while f"solution{len(solutions)}/error" in arrays:
        of = f"solution{len(solutions)}"
        parts = {field: arrays[f"{of}/{name}"] for name, field in SOLUTION.items()}
        error, strategy = float(arrays[f"{of}/error"]), Strategy[str(arrays[f"{of}/strategy"])]
        solutions.append(Solution(**parts, error=error, iterations=0, strategy=strategy))
    change, reach, returned_to, mma_steps = arrays["last"].tolist()
    objectives, excesses = map(tuple, arrays["course"].tolist())
    best = dict(zip(BEST, arrays["best"].tolist(), strict=True))
    best["iteration"] = int(best["iteration"])
    best["crisp"] = bool(best["crisp"])
    return {
        "iteration": int(arrays["iteration"]),
        "change": change,
        "reach": reach,
        "returned_to": int(returned_to),
        "mma_steps": int(mma_steps),
        "gradient": str(arrays["gradient"]),
        "cells": cells,
        "modes": modes,
        "multipliers": arrays["multipliers"],
        "best": Best(x=np.empty(0), **best),
        "progress": Progress(objectives, excesses, int(arrays["since"])),
        "solutions": tuple(solutions),
        "beta": float(arrays["sharpness"]),
    }


def _rows(arm: Arm, modes: Sequence[np.ndarray], j: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the interior rows of the j-th modes and those of the outboard interface, if any."""
    inner = arm.substructure.T.num_interior
    whole = modes[j] if j < len(modes) else np.empty((inner, 0))
    return whole[:inner], whole[inner:]


def _interior_points(arm: Arm) -> np.ndarray:
    substructure = arm.substructure
    return substructure.operators.points[substructure.T.interior_nodes]


def _match(known: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return for each wanted point the row of the same point among the known ones."""
    from scipy.spatial import cKDTree

    if len(wanted) == 0:
        return np.zeros(0, dtype=int)
    return cKDTree(known).query(wanted)[1]
