"""Interpolation of stiffness and mass between void and solid, with derivatives.

Every law is a pair of shapes e(x), m(x) from 0 to 1 above a weak second material ("void"):

    E = (void + (1 - void) e(x)) E0,  rho = (void + (1 - void) m(x)) rho0,

so that K and M are positive definite down to x = 0. For "two-material" void is the scene's
`floor`. The other laws were published without a second material, for x >= x_min > 0; they get a
trace of one, floor^2: with the defaults 1e-12, a thousandth of x^3 at design.minimum = 1e-3, which
leaves them as published (with floor itself, "simp" would be "two-material").

Where e(x) falls faster than m(x), cells near void vibrate on their own at low frequencies,
proportional to sqrt(E / rho): "simp" has such localised modes, and the laws after it were made
against them (demos/demo_localised_modes.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

SWITCH = 0.1  # x below which "pedersen" and "du-olhoff" leave "simp"
# Du and Olhoff's c1, c2: mass and slope meet those of m = x at the switch.
MASS_6, MASS_7 = 6e5, -5e6


@dataclass(frozen=True, eq=False)
class Interpolated:
    """Relative stiffness and mass of cells, and derivatives; arrays like x, dimensionless.

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
    """Mix solid with a weak second material: e = x^p, m = x; smooth everywhere.

    Source: Seifried, Moghadasi & Held (2015), eq. (5), doi:10.1016/j.piutam.2015.01.018.
    """
    return _above_void(floor, *_power(x, penalty), *_linear(x))


def simp(x: np.ndarray, penalty: float, floor: float) -> Interpolated:
    """Penalise the stiffness only, classic SIMP: e = x^p, m = x; smooth everywhere.

    Source: Seifried, Moghadasi & Held (2015), eq. (4), doi:10.1016/j.piutam.2015.01.018.
    """
    return _above_void(floor**2, *_power(x, penalty), *_linear(x))


def pedersen(x: np.ndarray, penalty: float, floor: float) -> Interpolated:
    """Soften the penalty near void: e = x^p, below x = 0.1 the line 0.1^(p-1) x; m = x.

    The published x / 100 is that of p = 3. e is continuous, its slope is not: at the switch it
    is that of x^p. E / rho >= 0.1^(p-1).
    Source: Pedersen (2000), SMO 20, 2-11, doi:10.1007/s001580050130.
    """
    value, slope = _power(x, penalty)
    line = SWITCH ** (penalty - 1.0)
    below = np.real(x) < SWITCH  # of a complex step as well
    return _above_void(
        floor**2, np.where(below, line * x, value), np.where(below, line, slope), *_linear(x)
    )


def du_olhoff(x: np.ndarray, penalty: float, floor: float) -> Interpolated:
    """Take the mass away near void: e = x^p; m = x, below x = 0.1 6e5 x^6 - 5e6 x^7.

    m and its slope are continuous. For p = 3 E / rho >= 0.0091, at x = 0.09.
    Source: Du & Olhoff (2007), SMO 34, 91-110, eq. (4b), doi:10.1007/s00158-007-0101-y.
    """
    below = np.real(x) < SWITCH
    value, slope = _linear(x)
    mass = np.where(below, (MASS_6 + MASS_7 * x) * x**6, value)
    mass_slope = np.where(below, (6.0 * MASS_6 + 7.0 * MASS_7 * x) * x**5, slope)
    return _above_void(floor**2, *_power(x, penalty), mass, mass_slope)


def ramp(x: np.ndarray, penalty: float, floor: float) -> Interpolated:
    """Penalise rationally: e = x / (1 + q (1 - x)), m = x, with q = penalty; smooth everywhere.

    E / rho >= 1 / (1 + q), also at void. q = 6 has the stiffness of x^3 at x = 1/2.
    Source: Stolpe & Svanberg (2001), SMO 22, 116-124, doi:10.1007/s001580100129.
    """
    below = 1.0 + penalty * (1.0 - x)
    return _above_void(floor**2, x / below, (1.0 + penalty) / below**2, *_linear(x))


def _power(x: np.ndarray, penalty: float) -> tuple[np.ndarray, np.ndarray]:
    return x**penalty, penalty * x ** (penalty - 1.0)


def _linear(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return x, np.ones_like(x)


def _above_void(
    void: float,
    stiffness: np.ndarray,
    stiffness_slope: np.ndarray,
    mass: np.ndarray,
    mass_slope: np.ndarray,
) -> Interpolated:
    """Add the second material to the functions e, m and their derivatives."""
    span = 1.0 - void
    return Interpolated(
        stiffness=void + span * stiffness,
        stiffness_slope=span * stiffness_slope,
        mass=void + span * mass,
        mass_slope=span * mass_slope,
    )


LAWS: dict[str, Callable[[np.ndarray, float, float], Interpolated]] = {
    "two-material": two_material,
    "simp": simp,
    "pedersen": pedersen,
    "du-olhoff": du_olhoff,
    "ramp": ramp,
}


def interpolate(x: np.ndarray, law: str, penalty: float, floor: float) -> Interpolated:
    """Evaluate the named law at physical densities x in [0, 1].

    Args:
        x: any shape.
        law: a key of `LAWS`.
        penalty: p >= 1, or q of "ramp".
        floor: in (0, 1), see the top of this file.

    Raises:
        KeyError: unknown law; the scene's validation comes before.
    """
    return LAWS[law](x, penalty, floor)
