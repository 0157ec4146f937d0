"""One design of an optimisation as arrays of whole arms, for the checkpoint, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.dynamics.solution import Solution
from dolfinopt.fem.interior import Guesses
from dolfinopt.optimization.memory import IterateMemory
from dolfinopt.parallel import Partition, gather_arms, gather_cells, together

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

GUESS = "guess/"  # before what iterative solves set out from
# A solution's arrays: name in the file, field.
SOLUTION = {"edges": "time_grid", "nodes": "nodes", "q": "q", "qd": "qd", "a": "a"}


def arrays_of(
    partition: Partition, arms: Mapping[int, Arm], memory: IterateMemory, number: int
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
        "cells": gather_cells(partition, memory.cells),
        "threshold": gather_arms(partition, memory.thresholds),
        "points": gather_cells(partition, points),
    }
    for j, by_arm in enumerate(known):
        columns[f"modes{j}"] = gather_cells(partition, {k: rows for k, (rows, _) in by_arm.items()})
        columns[f"outboard{j}"] = gather_cells(
            partition, {k: last for k, (_, last) in by_arm.items()}
        )
    columns |= _guesses(partition, arms, memory)
    if partition.world.rank != 0:
        return {}
    arrays: dict[str, Any] = {
        "iteration": memory.iteration,
        "last": [memory.change, memory.kkt],
        "multipliers": memory.multipliers,
        "convexity": memory.convexity,
        "sharpness": memory.beta,
    }
    for k, solution in enumerate(memory.solutions):
        for name, field in (*SOLUTION.items(), ("error", "error")):
            arrays[f"solution{k}/{name}"] = getattr(solution, field)
    for key, by_arm in columns.items():
        arrays |= {f"arm{k}/{key}": value for k, value in by_arm.items()}
    return arrays


def _guesses(
    partition: Partition, arms: Mapping[int, Arm], memory: IterateMemory
) -> dict[str, dict[int, np.ndarray]]:
    """Return what iterative solves set out from, by its name and arm (collective)."""
    known = {k: memory.guesses[k] for k in arms if k in memory.guesses}
    every = partition.world.allgather({name for one in known.values() for name in one.fields})
    found = {
        f"{GUESS}{name}": gather_cells(
            partition, {k: one.fields[name] for k, one in known.items() if name in one.fields}
        )
        for name in sorted(set().union(*every))
    }
    if any(partition.world.allgather(bool(known))):
        young = {k: one.young for k, one in known.items()}
        found["hierarchy"] = gather_cells(partition, young)
        solver = {k: np.array([one.gradual, *one.progress]) for k, one in known.items()}
        found["solver"] = gather_arms(partition, solver)
    return found


def fields_from(arrays: Mapping[str, Any], arms: Mapping[int, Arm]) -> dict[str, Any]:
    """Return the fields of `IterateMemory`."""
    cells: dict[int, np.ndarray] = {}
    modes: dict[int, list[np.ndarray]] = {}
    guesses: dict[int, Guesses] = {}
    for k, arm in arms.items():
        if f"arm{k}/cells" in arrays:  # an arm that repeats another's design has no variables
            rows = _match(arrays[f"arm{k}/centroid"], arm.mesh.centroid)
            cells[k] = arrays[f"arm{k}/cells"][rows]
        rows = _match(arrays[f"arm{k}/points"], _interior_points(arm))
        rows = (arm.mesh.dim * rows[:, None] + np.arange(arm.mesh.dim)).ravel()
        last = arm.mesh.comm.rank == arm.mesh.comm.size - 1
        if f"arm{k}/hierarchy" in arrays:
            names = [key for key in arrays if key.startswith(f"arm{k}/{GUESS}")]
            fields = {name.removeprefix(f"arm{k}/{GUESS}"): arrays[name][rows] for name in names}
            own = _match(arrays[f"arm{k}/centroid"], arm.mesh.centroid)
            gradual, *rates = arrays[f"arm{k}/solver"].tolist()
            young = arrays[f"arm{k}/hierarchy"][own]
            guesses[k] = Guesses(fields, young, bool(gradual), (rates[0], rates[1]))
        modes[k] = []
        for j in range(len(arm.initial_vectors)):
            interior, outboard = (arrays[f"arm{k}/{part}{j}"] for part in ("modes", "outboard"))
            modes[k].append(np.vstack([interior[rows], outboard if last else outboard[:0]]))
    solutions: list[Solution] = []
    while f"solution{len(solutions)}/error" in arrays:
        of = f"solution{len(solutions)}"
        parts = {field: arrays[f"{of}/{name}"] for name, field in SOLUTION.items()}
        solutions.append(Solution(**parts, error=float(arrays[f"{of}/error"]), iterations=0))
    change, kkt = arrays["last"].tolist()
    return {
        "iteration": int(arrays["iteration"]),
        "change": change,
        "kkt": kkt,
        "cells": cells,
        "modes": modes,
        "guesses": guesses,
        "multipliers": arrays["multipliers"],
        "convexity": arrays["convexity"],
        "solutions": tuple(solutions),
        "beta": float(arrays["sharpness"]),
        "thresholds": {k: float(arrays[f"arm{k}/threshold"]) for k in cells},
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
