"""What a design must keep: every constraint by name, with its value, limit and unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from dolfinopt.progress import shown, with_unit
from dolfinopt.responses.evaluation import Evaluation
from dolfinopt.responses.response import constraints_of
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.responses import limited_by

# Relative violation of the true value up to which a constraint counts as met: MMA meets an active
# one to a fraction of its last change, which optimizer.tolerance leaves at 1e-3.
EXCESS = 1e-3


@dataclass(frozen=True)
class Limit:
    """One constraint and what a design makes of it.

    Attributes:
        quantity: name of the response.
        arm: whose; "" of all together.
        value, limit: in `unit`.
        unit: of both.
        least: whether the limit is a lower one.
    """

    quantity: str
    arm: str
    value: float
    limit: float
    unit: str
    least: bool = False

    @property
    def name(self) -> str:
        """Its column in history.csv and its key in summary.json, e.g. "first_frequency_arm2"."""
        return f"{self.quantity}_{self.arm}".rstrip("_")

    @property
    def excess(self) -> float:
        """Relative violation; at most 0 where the constraint is met."""
        gap = self.limit - self.value if self.least else self.value - self.limit
        return gap / self.limit

    @property
    def met(self) -> bool:
        """Whether the value keeps the limit, to `EXCESS` of it."""
        return self.excess <= EXCESS

    @property
    def words(self) -> str:
        """E.g. "first frequency of arm2"."""
        return self.quantity.replace("_", " ") + (f" of {self.arm}" if self.arm else "")

    @property
    def of_mass(self) -> bool:
        """Whether it limits how much material there is."""
        return limited_by(self.quantity).of_nominal

    @property
    def usage(self) -> str:
        """E.g. "deviation 5.3 of 8 mm: 66 %"; of a lower limit the limit's share of the value.

        One that is missed with more digits, so that it differs from its limit.
        """
        (value, limit), unit = shown((self.value, self.limit), self.unit)
        of = "of at least" if self.least else "of"
        share = 100.0 * (limit / value if self.least else value / limit)
        digits, used = (3, f"{share:.0f}") if self.met else (5, f"{share:.4g}")
        both = with_unit(f"{value:.{digits}g} {of} {limit:.4g}", unit)
        return f"{self.words} {both}: {used} %"

    def to_dict(self) -> dict[str, Any]:
        """Return its entry of summary.json."""
        return {
            "value": self.value,
            "limit": self.limit,
            "unit": self.unit,
            "bound": "least" if self.least else "largest",
            "met": self.met,
        }


def limits_of(scene: Scene, evaluation: Evaluation) -> tuple[Limit, ...]:
    """Return every constraint of the scene and its value.

    Args:
        scene: with the limits.
        evaluation: of the design.
    """
    limits = []
    # The objective's values come first: it may be the response of a limit, too.
    for bound, result in zip(constraints_of(scene), evaluation.responses[1:], strict=True):
        unit_of, lower = bound.response.unit_of, bound.response.declared.lower
        limits += [
            Limit(bound.name, arm, float(value), float(limit), unit_of(arm), lower)
            for arm, value, limit in zip(
                result.arms, result.values, bound.limits(result), strict=True
            )
        ]
    return tuple(limits)


def worst_limits(variants: Sequence[Sequence[Limit]]) -> tuple[Limit, ...]:
    """Return each constraint as the worst of several variants of a design has it.

    Or as the last variant, the nominal one, where the response says so.
    """
    worst = []
    for limit, *others in zip(*reversed(variants), strict=True):
        values = [limit.value, *(other.value for other in others)]
        extreme = min(values) if limit.least else max(values)
        kept = limit.value if limited_by(limit.quantity).of_nominal else extreme
        worst.append(replace(limit, value=kept))
    return tuple(worst)


def violated(limits: Sequence[Limit]) -> str:
    """Return all constraints that are not met, in one line; "" if all are."""
    return "; ".join(limit.usage for limit in limits if not limit.met)


def tightest(limits: Sequence[Limit]) -> str:
    """Return how far the limits besides the volume are kept, in a few words; "" without any.

    E.g. "limits met" or "settling 12 % over limit".
    """
    asked = [limit for limit in limits if limit.quantity != "volume_fraction"]
    if not asked:
        return ""
    worst = max(asked, key=lambda item: item.excess)
    if worst.met:
        return "limits met"
    return f"{worst.words} {100.0 * worst.excess:.3g} % {'below' if worst.least else 'over'} limit"


def summary_of(limits: Sequence[Limit]) -> dict[str, Any]:
    """Return the constraints by name, for summary.json."""
    return {limit.name: limit.to_dict() for limit in limits}
