"""Heaviside projection of filtered designs: crisp at a threshold, with its exact derivative."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.optimize import brentq

MIDDLE_THRESHOLD = 0.5  # threshold where none is better than another


@dataclass(frozen=True, eq=False)
class Projected:
    """A design projected at a fixed threshold; arrays (n_cells,), dimensionless.

    Attributes:
        value: y in [0, 1].
        slope: dy / dx of the same cell.
    """

    value: np.ndarray
    slope: np.ndarray

    def backward(self, slope: np.ndarray) -> np.ndarray:
        """Return the derivative with respect to x, given that with respect to y."""
        return slope * self.slope


def project(x: np.ndarray, beta: float, eta: float) -> Projected:
    """Push densities to 0 below a threshold and to 1 above it.

    y = (tanh(beta eta) + tanh(beta (x - eta))) / (tanh(beta eta) + tanh(beta (1 - eta)))
      = sinh(beta x) cosh(beta (1 - eta)) / (sinh(beta) cosh(beta (x - eta))),

    the second form in exponentials that neither overflow nor cancel. Keeps 0, 1 and the order.
    Source: Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y.

    Args:
        x: (n_cells,) in [0, 1].
        beta: sharpness >= 0; 0 is the identity, infinity the step.
        eta: threshold in [0, 1].
    """
    if beta == 0.0:
        return Projected(x.copy(), np.ones_like(x))
    distance = np.abs(x - eta)
    near = np.exp(-2.0 * beta * distance)
    right = 1.0 + np.exp(-2.0 * beta * (1.0 - eta))
    left = 1.0 + np.exp(-2.0 * beta * eta)
    whole = -np.expm1(-2.0 * beta)
    value = np.where(x < eta, near, 1.0) * -np.expm1(-2.0 * beta * x) * right
    value /= whole * (1.0 + near)
    slope = 2.0 * beta / whole * left * right * near / (1.0 + near) ** 2
    return Projected(np.minimum(value, 1.0), slope)  # one unit of rounding above 1 at most


def robust_thresholds(erosion: float, dilation: float) -> tuple[float, float, float]:
    """Return eta of eroded, nominal and dilated design: 1/2 + erosion, 1/2, 1/2 - dilation.

    Source: Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y.
    """
    return MIDDLE_THRESHOLD + erosion, MIDDLE_THRESHOLD, MIDDLE_THRESHOLD - dilation


def preserving_threshold(x: np.ndarray, area: np.ndarray, beta: float, comm: MPI.Comm) -> float:
    """Return eta with sum area y = sum area x over all ranks (collective, equal on all).

    y falls with eta in every cell, from at least x at eta = 0 to at most x at eta = 1: there is
    one root, unless all cells are 0 or 1, which any threshold keeps; then it is 1/2.
    Source: Xu, Cai & Cheng (2010), doi:10.1007/s00158-009-0452-7.

    Args:
        x: (n_cells,) in [0, 1], of this rank.
        area: (n_cells,) m2; cells of area 0 do not count.
        beta: sharpness >= 0.
        comm: the ranks that share the design.
    """

    def gain(eta: float) -> float:
        return float(comm.allreduce(area @ (project(x, beta, eta).value - x)))

    if beta == 0.0 or not gain(0.0) > 0.0 > gain(1.0):
        return MIDDLE_THRESHOLD
    # As exact as eta can be: the volume is then right to about beta times its rounding.
    return float(brentq(gain, 0.0, 1.0, xtol=1e-16, rtol=4.0 * np.finfo(float).eps))
