"""What a design must keep: every constraint by name, with its value, limit and unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dolfinopt.responses.evaluation import Evaluation
from dolfinopt.responses.response import constraints_of, find
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.constraints import Constraints

# Relative violation up to which a constraint counts as met: MMA meets an active one to a fraction
# of its last change, which optimizer.tolerance leaves at 1e-3.
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
        return f"{self.quantity}_{self.arm}".rstrip("_") if self.arm else self.quantity

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
    def sentence(self) -> str:
        """E.g. "first frequency of arm2: 60.4 Hz, at least 80 Hz required"."""
        what = self.quantity.replace("_", " ") + (f" of {self.arm}" if self.arm else "")
        unit = "" if self.unit == "-" else f" {self.unit}"
        value, limit = distinct(self.value, self.limit)
        bound = "at least" if self.least else "at most"
        return f"{what}: {value}{unit}, {bound} {limit}{unit} required"

    def to_dict(self) -> dict[str, Any]:
        """Return its entry of summary.json."""
        return {
            "value": self.value,
            "limit": self.limit,
            "unit": self.unit,
            "bound": "least" if self.least else "largest",
            "met": self.met,
        }


def distinct(value: float, limit: float) -> tuple[str, str]:
    """Return both numbers with three digits, or as many as it takes to tell them apart."""
    for digits in range(3, 17):
        texts = f"{value:.{digits}g}", f"{limit:g}"
        if float(texts[0]) != limit:
            break
    return texts


def limits_of(scene: Scene, evaluation: Evaluation) -> tuple[Limit, ...]:
    """Return every constraint of the scene and its value.

    Args:
        scene: with the limits.
        evaluation: of the design.
    """
    limits = []
    # The objective's values come first: it may be the response of a limit, too.
    for bound, found in zip(constraints_of(scene), evaluation.responses[1:], strict=True):
        response = bound.response
        unit = response.limit_unit or response.unit
        limits += [
            Limit(response.name, arm, float(value), bound.limit, unit, response.lower)
            for arm, value in zip(found.arms, found.values, strict=True)
        ]
    return tuple(limits)


def constraint_label(name: str) -> str:
    """Return e.g. "first frequency of arm2 [Hz]" for the column first_frequency_arm2."""
    for quantity in ("volume_fraction", *Constraints.model_fields):
        if name.startswith(quantity):
            unit = find(quantity).limit_unit or find(quantity).unit
            arm = name[len(quantity) + 1 :]
            return quantity.replace("_", " ") + (f" of {arm}" if arm else "") + f" [{unit}]"
    return name


def worst_limits(variants: Sequence[Sequence[Limit]]) -> tuple[Limit, ...]:
    """Return each constraint as the worst of several variants of a design has it.

    Or as the last variant, the nominal one, where the response says so.
    """
    worst = []
    for limit, *others in zip(*reversed(variants), strict=True):
        values = [limit.value, *(one.value for one in others)]
        extreme = min(values) if limit.least else max(values)
        kept = limit.value if find(limit.quantity).of_nominal else extreme
        worst.append(replace(limit, value=kept))
    return tuple(worst)


def violated(limits: Sequence[Limit]) -> str:
    """Return the sentences of all constraints that are not met, in one line; "" if all are."""
    return "; ".join(one.sentence for one in limits if not one.met)


def summary_of(limits: Sequence[Limit]) -> Mapping[str, Any]:
    """Return the constraints by name, for summary.json."""
    return {one.name: one.to_dict() for one in limits}
