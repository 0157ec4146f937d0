"""What an optimisation remembers: its history, and all that a resumed run needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from dolfinopt.dynamics.collocation import Solution
from dolfinopt.multibody.loads import Stiffening
from dolfinopt.responses.order_selection import OrderSelection

MULTIPLIER = "multiplier_"  # begins the columns of multipliers


@dataclass(frozen=True)
class HistoryRow:
    """One line of history.csv: the design after `iteration` updates; 0 is the initial design.

    Attributes:
        iteration: number of design updates made.
        objective: N m (N m s for the whole horizon).
        max_deviation: m.
        grayness: over all arms.
        volume_fraction: over all arms.
        change: largest change of a design variable in the update that led here.
        seconds: wall-clock time since the run's beginning, earlier parts included.
        kkt: Karush-Kuhn-Tucker residual of this design, see `residual.kkt_residual`.
        merit: objective over that of the initial design, and ten times the limits' excesses.
        constraints: value of every constraint, by its name, see `constraints.Limit`.
        multipliers: of every constraint by its name: by how much the objective betters, to first
            order, for each 100 % by which the limit is eased.
        tightest: how far limits are kept, in words; of the live line, not kept in history.csv.
    """

    iteration: int
    objective: float
    max_deviation: float
    grayness: float
    volume_fraction: float
    change: float
    seconds: float
    kkt: float = np.nan
    merit: float = np.nan
    constraints: Mapping[str, float] = field(default_factory=dict)
    multipliers: Mapping[str, float] = field(default_factory=dict)
    tightest: str = field(default="", compare=False, repr=False)

    @property
    def figures(self) -> dict[str, float]:
        """Its values by the heads of their columns of history.csv."""
        own = {item.name: getattr(self, item.name) for item in fields(self)[:-3]}
        shares = {MULTIPLIER + name: value for name, value in self.multipliers.items()}
        return own | dict(self.constraints) | shares

    @classmethod
    def from_figures(cls, figures: Mapping[str, float]) -> HistoryRow:
        """Return the row of which `figures` are."""
        rest = dict(figures)
        names = [item.name for item in fields(cls)[:-3]]
        own: dict[str, Any] = {name: rest.pop(name) for name in names if name in rest}
        own["iteration"] = int(own["iteration"])
        shares = {name: rest.pop(name) for name in figures if name.startswith(MULTIPLIER)}
        multipliers = {name.removeprefix(MULTIPLIER): x for name, x in shares.items()}
        return cls(**own, constraints=rest, multipliers=multipliers)


# -- what an optimisation must remember to go on as if it had never been interrupted -------------


@dataclass(frozen=True, eq=False)
class Best:
    """The best design so far, among those that keep all limits with the sharpest projection.

    Attributes:
        x: (n,) this rank's variables.
        iteration: updates made; -1 of none.
        beta: steepness of the projection.
        objective: what is minimised.
        excess: largest relative violation of a limit.
    """

    x: np.ndarray
    iteration: int
    beta: float
    objective: float
    excess: float

    @classmethod
    def none(cls, x: np.ndarray) -> Best:
        """Return what every design betters."""
        return cls(x, -1, 0.0, np.inf, np.inf)

    @property
    def rank(self) -> tuple[bool, float, float]:
        """What is smaller for a better design; of infeasible ones the least violation counts."""
        if self.excess > 0.0:
            return True, self.excess, self.objective
        return False, -self.beta, self.objective


@dataclass(frozen=True)
class Progress:
    """The course of the iterations, by which it is judged whether they still gain anything.

    Attributes:
        objectives, excesses: of every design so far: what is minimised, and the largest relative
            violation of a limit.
        since: number of the first one that can be compared with the last: of the same projection.
    """

    objectives: tuple[float, ...] = ()
    excesses: tuple[float, ...] = ()
    since: int = 0

    def after(self, objective: float, excess: float) -> Progress:
        """Return it with one design more."""
        objectives = (*self.objectives, float(objective))
        return Progress(objectives, (*self.excesses, float(excess)), self.since)

    def anew(self) -> Progress:
        """Return it where the next design is the first that counts."""
        return replace(self, since=len(self.objectives))

    @property
    def feasible(self) -> bool:
        """Whether a design that counts keeps all limits."""
        return 0.0 in self.excesses[self.since :]

    def gain(self, window: int) -> float:
        """Return by how much the best design got better in so many iterations, relative.

        Best is the least objective within all limits; where no design keeps them the least
        violation. Infinite as long as there are fewer iterations that count.
        """
        excesses = np.array(self.excesses[self.since :])
        if len(excesses) <= window:
            return np.inf
        values = np.array(self.objectives[self.since :])
        values = np.where(excesses > 0.0, np.inf, values) if self.feasible else excesses
        before, now = values[:-window].min(), values.min()
        return float((before - now) / (abs(now) or 1.0)) if np.isfinite(before) else np.inf


@dataclass(frozen=True, eq=False, kw_only=True)
class Memory:
    """Everything the next step depends on; cell and node arrays are this rank's.

    Attributes:
        iteration: design updates made.
        change: largest one in the last update.
        reach: factor on the move limit.
        mma_steps: taken since the asymptotes began.
        gradient: in use, "exact" or "esl".
        cells: per arm (n_cells, k), and of the law: the variables and what MMA remembers of them.
        modes: per arm the eigenvectors (owned rows, k) from which this design's reduction and its
            loaded modes set out; k = 0 when they began from nothing.
        multipliers: MMA's, on all ranks.
        best: the best design so far; its variables are the last column of `cells`.
        progress: the course of the iterations.
        held: smooth limits of every design, as steps hold them.
        solutions: from which this design's simulations set out; the root's count.
        beta: steepness of the projection.
        history: rows so far.
        initial_deviation: (n, 2) m of the initial design, evenly over the horizon.
        exact_from: iteration from which on the gradient is exact, None as long as it is not.
        choice: of the coordinates, where the scene leaves it to "auto".
        stiffening: decided for the initial design; None where nothing was simulated.
    """

    iteration: int
    change: float
    reach: float
    mma_steps: int
    gradient: str
    cells: Mapping[int, np.ndarray]
    modes: Mapping[int, Sequence[np.ndarray]]
    multipliers: np.ndarray
    best: Best
    progress: Progress
    held: list[np.ndarray] | None
    solutions: tuple[Solution, ...]
    beta: float
    history: list[HistoryRow]
    initial_deviation: np.ndarray
    exact_from: int | None
    choice: OrderSelection | None = None
    stiffening: Stiffening | None = None
