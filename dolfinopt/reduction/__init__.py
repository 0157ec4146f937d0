"""Model reduction: one file a method, one signature (arm, coordinates, start) -> Basis."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dolfinopt.elasticity import ElasticArm
from dolfinopt.reduction.basis import Basis
from dolfinopt.reduction.craig_bampton import craig_bampton
from dolfinopt.reduction.modal import modal

Reductor = Callable[[ElasticArm, int, "np.ndarray | None"], Basis]

METHODS: dict[str, Reductor] = {"craig-bampton": craig_bampton, "modal": modal}

__all__ = ["METHODS", "Basis", "craig_bampton", "modal"]
