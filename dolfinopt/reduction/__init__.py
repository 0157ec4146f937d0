"""Model reduction: one file a method, each with one signature and an adjoint where one exists."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.reduction.basis import AdjointFields, Basis, Options, by_frame_fields, frame_fields
from dolfinopt.reduction.gramian import balanced
from dolfinopt.reduction.krylov import krylov, krylov_adjoint
from dolfinopt.reduction.modal import craig_bampton, craig_bampton_adjoint, modal, modal_adjoint


@dataclass(frozen=True)
class Method:
    """A reduction method.

    Attributes:
        reduce: (arm, options, start) -> basis.
        adjoint: (arm, basis, options, cotangents interior, outboard) -> fields, see
            `craig_bampton_adjoint`; None where there is none.
    """

    reduce: Callable[[ElasticArm, Options, np.ndarray | None], Basis]
    adjoint: Callable[[ElasticArm, Basis, Options, np.ndarray, np.ndarray], AdjointFields] | None


METHODS = {
    "craig-bampton": Method(craig_bampton, craig_bampton_adjoint),
    "modal": Method(modal, modal_adjoint),
    "krylov": Method(krylov, krylov_adjoint),
    "balanced": Method(balanced, None),
}

__all__ = [
    "METHODS",
    "AdjointFields",
    "Basis",
    "Method",
    "Options",
    "balanced",
    "by_frame_fields",
    "craig_bampton",
    "frame_fields",
    "krylov",
    "modal",
]
