"""What an optimisation must remember to go on as if it had never been interrupted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.solution import Solution
from dolfinopt.multibody.stiffening import Stiffening
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.responses.order_selection import OrderSelection


@dataclass(frozen=True, eq=False)
class Memory:
    """Everything the next iteration depends on; cell and node arrays are this rank's.

    Attributes:
        iteration: design updates made.
        cells: per arm (n_cells, k): the design variables and what MMA remembers of them.
        modes: per arm the eigenvectors (owned rows, k) from which this design's reduction and its
            loaded modes set out; k = 0 when they began from nothing.
        multipliers: MMA's, on all ranks.
        solutions: from which this design's simulations set out; the root's count.
        history: rows so far.
        initial_deviation: (n, 2) m of the initial design.
        finished: reason, or "" while running.
        beta: steepness of the projection.
        thresholds: per arm its eta.
        choice: of the coordinates, where the scene leaves it to "auto".
        stiffening: decided for the initial design; None where nothing was simulated.
    """

    iteration: int
    cells: Mapping[int, np.ndarray]
    modes: Mapping[int, Sequence[np.ndarray]]
    multipliers: np.ndarray
    solutions: tuple[Solution, ...]
    history: list[HistoryRow]
    initial_deviation: np.ndarray
    finished: str
    beta: float
    thresholds: Mapping[int, float]
    choice: OrderSelection | None = None
    stiffening: Stiffening | None = None
