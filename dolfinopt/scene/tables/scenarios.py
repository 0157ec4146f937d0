"""`[[scenarios]]`."""

from __future__ import annotations

from pydantic import Field, field_validator

from dolfinopt.scene.spelling import shown
from dolfinopt.scene.tables.base import Refusal, Table

# What may differ between scenarios: not the arms, which are one design, reduced once.
TABLES = ("motion", "control", "closure", "payload", "damping", "material")


class Scenario(Table):
    """A scenario: another use of the same design, part of the objective."""

    changes: tuple[str, ...] = Field(
        description='changes to the scene as "key=value", of motion, control, closure, payload, '
        "damping or material [-]"
    )
    weight: float = Field(
        default=1.0, ge=1e-9, le=1e9, description="weight in the sum of the scenarios [-]"
    )

    @field_validator("changes")
    @classmethod
    def _check_changes(cls, changes: tuple[str, ...]) -> tuple[str, ...]:
        for change in changes:
            key = change.partition("=")[0].strip()
            table = key.partition(".")[0]
            if table not in TABLES:
                raise Refusal(
                    f"expected keys of {', '.join(TABLES[:-1])} or {TABLES[-1]}, found {shown(key)}"
                )
            if key == "material.poisson_ratio":
                raise Refusal("expected no material.poisson_ratio: the reduced basis depends on it")
            if key in ("material", "material.name"):
                raise Refusal(
                    "expected single values, e.g. material.young_modulus, not another material: "
                    "the reduced basis depends on its Poisson's ratio"
                )
        return changes
