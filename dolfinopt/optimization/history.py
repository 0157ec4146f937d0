"""What is known of an optimisation after every update of the design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields

import numpy as np


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
        kkt: Karush-Kuhn-Tucker residual of this design, see `optimality.kkt_residual`.
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
