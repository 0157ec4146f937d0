"""Compliance and deflection of one arm under static loads, with their gradients."""

from __future__ import annotations

import numpy as np

from dolfinopt.arms.design_state import DesignState
from dolfinopt.responses.response import p_norm_of_lengths
from dolfinopt.responses.sensitivity import Tip, tip_gradient


def compliance(found: Tip) -> float:
    """Return the sum over the cases of load . displacement, N m."""
    return float(np.sum(found.loads * found.tip))


def deflection(found: Tip, exponent: float) -> tuple[float, np.ndarray]:
    """Return the p-norm of the displacements' lengths, m, and its derivative by the tip."""
    d, by = 2 if len(found.tip) == 3 else 3, np.zeros_like(found.tip)
    value, slope = p_norm_of_lengths(found.tip[:d].T, exponent)
    by[:d] = slope.T
    return value, by


def static_gradient(state: DesignState, found: Tip) -> np.ndarray:
    """Return the gradient of the compliance by the densities (n_cells,)."""
    return tip_gradient(state, found.loads, found.loads)


def deflection_gradient(state: DesignState, found: Tip, exponent: float) -> np.ndarray:
    """Return the gradient of the deflection by the densities (n_cells,)."""
    return tip_gradient(state, deflection(found, exponent)[1], found.loads)
