"""What an optimisation returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.optimization.certificate import Certificate
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.parallel import Partition
from dolfinopt.profiling import Counts, Profile
from dolfinopt.responses.constraints import Limit, violated
from dolfinopt.responses.evaluation import Evaluation
from dolfinopt.responses.order_selection import OrderSelection

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm


@dataclass(frozen=True, eq=False)
class Result:
    """An optimised design.

    Attributes:
        partition, arms: which ranks did what, and this rank's arms with the final design reduced.
        x_phys: physical densities (n_cells,) of this rank's arms.
        x_filtered: (n_cells,) what they were projected from, smooth from cell to cell; None without
            a projection.
        evaluation: of the final design.
        trajectory: of the final design; on the root only.
        crisp: evaluation of the final design cut at x_phys = 1/2; None without a projection.
        initial_deviation: (n, 2) of the initial design, evenly over the horizon, m; on the root
            only.
        history: one row a design, the initial one first; on the root only.
        iterations: design updates made.
        best_iteration: updates after which this design was found.
        converged: True when the change of the design and the Karush-Kuhn-Tucker residual are
            within their tolerances and every constraint is met.
        stop_reason: in words.
        kkt: the residual of the final design by the gradient in use, see `optimality.kkt_residual`.
        certificate: what the exact gradient says of the final design.
        limits: every constraint and its value.
        conflicts: what holds those back that are not met, see `conflicts.conflict_sentences`.
        profile: seconds and counts of this rank.
        counts: those of the iterations alone, on this rank.
        choice: of the coordinates, and the error that they make of the final design's motion;
            None where the scene states a number.
    """

    partition: Partition
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
    x_filtered: Mapping[int, np.ndarray] | None
    evaluation: Evaluation
    crisp: Evaluation | None
    trajectory: Trajectory | None
    initial_deviation: np.ndarray
    history: list[HistoryRow]
    iterations: int
    best_iteration: int
    converged: bool
    stop_reason: str
    kkt: float
    certificate: Certificate
    limits: tuple[Limit, ...]
    conflicts: str
    profile: Profile
    counts: Counts
    choice: OrderSelection | None = None

    @property
    def violated(self) -> str:
        """Which constraints the final design does not meet, and why; "" if it meets all."""
        return "; ".join(filter(None, [violated(self.limits), self.conflicts]))
