"""Model reduction: one file a method, each with one signature and an adjoint where one exists."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dolfinopt.elasticity import ElasticArm
from dolfinopt.reduction.basis import Basis
from dolfinopt.reduction.craig_bampton import craig_bampton, craig_bampton_adjoint
from dolfinopt.reduction.modal import modal, modal_adjoint


@dataclass(frozen=True)
class Method:
    """A reduction method.

    Attributes:
        reduce: (arm, coordinates, start) -> basis.
        adjoint: (arm, basis, interior slopes, outboard slopes) -> (mu, lambda), see
            `craig_bampton_adjoint`.
    """

    reduce: Callable[[ElasticArm, int, np.ndarray | None], Basis]
    adjoint: Callable[[ElasticArm, Basis, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


METHODS = {
    "craig-bampton": Method(craig_bampton, craig_bampton_adjoint),
    "modal": Method(modal, modal_adjoint),
}

__all__ = ["METHODS", "Basis", "Method", "craig_bampton", "modal"]
