"""Interpolation of stiffness and mass between void and solid, with derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Interpolated:
    """Relative stiffness and mass of cells and their slopes; every array like x, dimensionless.

    Attributes:
        stiffness: E / E0.
        stiffness_slope: d(E / E0) / dx.
        mass: rho / rho0.
        mass_slope: d(rho / rho0) / dx.
    """

    stiffness: np.ndarray
    stiffness_slope: np.ndarray
    mass: np.ndarray
    mass_slope: np.ndarray


def two_material(x: np.ndarray, penalty: float, floor: float) -> Interpolated:
    """Mix solid with a weak second material; smooth everywhere.

    E = (floor + (1 - floor) x^p) E0,  rho = (floor + (1 - floor) x) rho0.
    Source: Seifried, Moghadasi & Held (2015), eq. (5), doi:10.1016/j.piutam.2015.01.018.
    """
    span = 1.0 - floor
    return Interpolated(
        stiffness=floor + span * x**penalty,
        stiffness_slope=span * penalty * x ** (penalty - 1.0),
        mass=floor + span * x,
        mass_slope=np.full_like(x, span),
    )


LAWS: dict[str, Callable[[np.ndarray, float, float], Interpolated]] = {
    "two-material": two_material,
}


def interpolate(x: np.ndarray, law: str, penalty: float, floor: float) -> Interpolated:
    """Evaluate the named law at physical densities x in [0, 1].

    Raises:
        KeyError: unknown law; the scene's validation comes before.
    """
    return LAWS[law](x, penalty, floor)
