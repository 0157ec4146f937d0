"""`[[scenarios]]`."""

from __future__ import annotations

from pydantic import Field, field_validator

from dolfinopt.scene.spelling import shown
from dolfinopt.scene.tables.base import Refusal, Table


class Scenario(Table):
    """A scenario: another use of the same design, part of the objective."""

    changes: tuple[str, ...] = Field(
        description='changes to the scene as "key=value", of motion, payload, damping or '
        "material [-]"
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
            if table not in ("motion", "payload", "damping", "material"):
                raise Refusal(
                    f"expected keys of motion, payload, damping or material, found {shown(key)}"
                )
            if key == "material.poisson_ratio":
                raise Refusal("expected no material.poisson_ratio: the reduced basis depends on it")
        return changes
