"""What becomes of one design in one scene, simulated or optimised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.dynamics.build import Trajectory
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.optimization.stopping import StopCode
from dolfinopt.parallel import Partition
from dolfinopt.profiling import Counts, Profile
from dolfinopt.responses.constraints import Limit, violated
from dolfinopt.responses.evaluation import Evaluation
from dolfinopt.responses.order_selection import OrderSelection
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.optimization.certificate import Certificate


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Result:
    """One design in one scene: what it does, and how it came about.

    Attributes:
        scene: in which.
        evaluation: all figures, on all ranks.
        trajectory: the motion over time; None but on rank 0.
        limits: every constraint and its value.
        choice: of the coordinates, and the error that they make of this design's motion; None where
            the scene states a number.
        crisp: evaluation of an optimised design cut at x_phys = 1/2; None without a projection.
        stop_code: why the iterations ended, "simulated" where there were none; `ending` in words.
        iterations: design updates made.
        best_iteration: updates after which this design was found.
        conflicts: what holds those limits back that are not met, see `stopping.conflicts`.
        kkt: residual by the gradient in use, see `residual.kkt_residual`; nan without one.
        exact_from: iteration from which on the gradient was exact, None where it never was.
        certificate: what the exact gradient says of an optimised design.
        bars: evaluation of straight solid bars of the same mass, where they were looked at.
        rows: of the history, one a design, the initial one first; rank 0.
        initial_deviation: (n, d) of the initial design, evenly over the horizon, m; rank 0.
    """

    scene: Scene
    evaluation: Evaluation
    trajectory: Trajectory | None
    limits: tuple[Limit, ...] = ()
    choice: OrderSelection | None = None
    crisp: Evaluation | None = None
    stop_code: StopCode = StopCode.SIMULATED
    ending: str = "simulated"
    iterations: int = 0
    best_iteration: int = 0
    conflicts: str = ""
    kkt: float = np.nan
    exact_from: int | None = None
    certificate: Certificate | None = None
    bars: Evaluation | None = None
    rows: list[HistoryRow] = field(default_factory=list)
    initial_deviation: np.ndarray | None = None

    @property
    def optimised(self) -> bool:
        """Whether the design is that of an optimisation."""
        return self.stop_code is not StopCode.SIMULATED

    @property
    def converged(self) -> bool:
        """Whether the iterations ended by themselves with a design that meets every limit."""
        settled = self.stop_code is StopCode.SETTLED and not self.violated
        return settled or not self.optimised

    @property
    def violated(self) -> str:
        """Which constraints the design does not meet, and why; "" if it meets all."""
        return "; ".join(filter(None, [violated(self.limits), self.conflicts]))

    @property
    def stop_reason(self) -> str:
        """Why the iterations ended, and which limits an optimised design does not meet."""
        missed = self.violated if self.optimised else ""
        return f"{self.ending}; not met: {missed}" if missed else self.ending


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RankResult(Result):
    """A result with this rank's part of the design.

    Attributes:
        partition, arms: which ranks did what, and this rank's arms with the design reduced.
        x_phys: physical densities (n_cells,) of this rank's arms.
        x_filtered: (n_cells,) what they were projected from, smooth from cell to cell; None without
            a projection.
        profile: seconds and counts of this rank.
        counts: those of the iterations alone, where not all of the profile's belong to them.
    """

    partition: Partition
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
    profile: Profile
    x_filtered: Mapping[int, np.ndarray] | None = None
    counts: Counts | None = None

    @property
    def history(self) -> list[HistoryRow]:
        """One row a design, the initial one first; on the root only."""
        return self.rows
