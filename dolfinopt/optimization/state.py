"""What an optimisation remembers: its history, and all that a resumed run needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from typing import Any

import numpy as np

from dolfinopt.dynamics.collocation import Solution
from dolfinopt.multibody.loads import Stiffening
from dolfinopt.optimization.measured import IMPROVED_SHARE
from dolfinopt.optimization.mma import Search
from dolfinopt.optimization.problem import Stage
from dolfinopt.responses.order_selection import OrderSelection


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
        kkt: Karush-Kuhn-Tucker residual of this design, see `stopping.kkt_residual`.
        constraints: value of every constraint, by its name, see `constraints.Limit`.
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
    constraints: Mapping[str, float] = field(default_factory=dict)
    tightest: str = field(default="", compare=False, repr=False)

    @property
    def columns(self) -> list[str]:
        """Names of `values`, the header of history.csv."""
        return [f.name for f in fields(self)][:-2] + list(self.constraints)

    @property
    def values(self) -> list[float]:
        """The row of history.csv."""
        return [*astuple(self)[:-2], *self.constraints.values()]

    @classmethod
    def from_values(cls, columns: Sequence[str], values: Sequence[float]) -> HistoryRow:
        """Return the row of which `columns` and `values` are."""
        own = len(fields(cls)) - 2
        pairs = zip(columns[own:], map(float, values[own:]), strict=True)
        iteration, *figures = values[:own]
        # Columns by name: one by one they would hide what mypy can check.
        named = dict(zip(columns[1:own], map(float, figures), strict=True))
        return cls(iteration=int(iteration), constraints=dict(pairs), **named)  # type: ignore[arg-type]


@dataclass(frozen=True)
class FurtherRow(HistoryRow):
    """The same of a further iteration with the exact gradient; shown, and not kept.

    Attributes:
        of: how many of them there are at most.
    """

    of: int = 0


# -- what an optimisation must remember to go on as if it had never been interrupted -------------


@dataclass(frozen=True, eq=False)
class Best:
    """The best design so far, among those that keep all limits; crisp ones before grey ones.

    Of grey ones that of the sharpest projection counts: a projection that becomes steeper may lose
    a design that was crisp already.

    Attributes:
        x: (n,) this rank's variables.
        iteration: updates made; -1 of none.
        beta: steepness of the projection.
        thresholds: per arm its eta.
        objective: what is minimised.
        excess: largest relative violation of a limit.
        crisp: whether nearly all of it is solid or void.
        improved: iteration of the last design that was better than the one before by a tenth of a
            percent, and `reference` its objective, of an infeasible one its excess.
    """

    x: np.ndarray
    iteration: int
    beta: float
    thresholds: Mapping[int, float]
    objective: float
    excess: float
    crisp: bool = False
    improved: int = 0
    reference: float = np.inf

    @classmethod
    def none(cls, x: np.ndarray) -> Best:
        """Return what every design betters."""
        return cls(x, -1, 0.0, {}, np.inf, np.inf)

    @property
    def sharpness(self) -> float:
        """Steepness of the projection, infinite of a crisp design."""
        return np.inf if self.crisp else self.beta

    @property
    def rank(self) -> tuple[bool, float, float]:
        """What is smaller for a better design; of infeasible ones the least violation counts."""
        if self.excess > 0.0:
            return True, self.excess, self.objective
        return False, -self.sharpness, self.objective

    def after(self, before: Best) -> Best:
        """Return it with what it has improved since `before`, which it follows."""
        value = self.excess or self.objective
        same = (self.excess > 0.0) == (before.excess > 0.0)
        same = same and self.sharpness <= before.sharpness
        if same and value > before.reference - IMPROVED_SHARE * abs(before.reference):
            return replace(self, improved=before.improved, reference=before.reference)
        return replace(self, improved=self.iteration, reference=value)


@dataclass(frozen=True, eq=False, kw_only=True)
class IterateMemory:
    """Everything the next step depends on; cell and node arrays are this rank's.

    Attributes:
        iteration: design updates made.
        change: largest one in the last update.
        cells: per arm (n_cells, k): the design variables and what MMA remembers of them.
        modes: per arm the eigenvectors (owned rows, k) from which this design's reduction and its
            loaded modes set out; k = 0 when they began from nothing.
        multipliers, convexity: MMA's, on all ranks.
        stage, search: that the design belongs to, and how the next step is sought.
        age, held: updates since beta rose, and whether it stays as it is.
        best: the best design so far; its variables are the last column of `cells`.
        solutions: from which this design's simulations set out; the root's count.
        beta: steepness of the projection.
        thresholds: per arm its eta.
    """

    iteration: int
    change: float
    cells: Mapping[int, np.ndarray]
    modes: Mapping[int, Sequence[np.ndarray]]
    multipliers: np.ndarray
    convexity: np.ndarray
    stage: Stage
    search: Search
    age: int
    held: bool
    best: Best
    solutions: tuple[Solution, ...]
    beta: float
    thresholds: Mapping[int, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class FurtherMemory(IterateMemory):
    """The further iterations with the exact gradient.

    Attributes:
        begun: updates of the design from which they set out.
        objectives: of every design, in the order of the iterations.
        feasible: whether it keeps all constraints.
    """

    begun: int
    objectives: tuple[float, ...]
    feasible: tuple[bool, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class Memory(IterateMemory):
    """A whole optimisation.

    Attributes:
        history: rows so far.
        initial_deviation: (n, 2) m of the initial design, evenly over the horizon.
        finished: reason, or "" while running.
        choice: of the coordinates, where the scene leaves it to "auto".
        stiffening: decided for the initial design; None where nothing was simulated.
        further: what has been done of the further iterations with the exact gradient.
    """

    history: list[HistoryRow]
    initial_deviation: np.ndarray
    finished: str
    choice: OrderSelection | None = None
    stiffening: Stiffening | None = None
    further: FurtherMemory | None = None


def fields_of(one: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as they are, by their names."""
    return {field.name: getattr(one, field.name) for field in fields(one)}
