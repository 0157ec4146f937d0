"""What the responses that a scene can name need; `dolfinopt.responses` computes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

# What must be known beside the densities.
Need = Literal["stiffness", "mass", "motion", "eigenproblem"]
MOTION: frozenset[Need] = frozenset({"stiffness", "mass", "motion"})
VIBRATION: frozenset[Need] = frozenset({"stiffness", "mass", "eigenproblem"})
STATICS: frozenset[Need] = frozenset({"stiffness"})
NEEDS: Mapping[str, frozenset[Need]] = {
    "esl": MOTION,
    "compliance": MOTION,
    "deviation": MOTION,
    "static": STATICS,
    "eigenfrequency": VIBRATION,
    "first_frequency": VIBRATION,
    "tip_deflection": STATICS,
}
