"""Forces in rigid slider-cranks and four-bars, by Newton and Euler; nothing of the package.

Plane vectors are complex numbers, cross(a, b) = Im(conj(a) b). The crank has no mass; the other
bars are uniform, of length L, height h, mass m: inertia m (L^2 / 3 + h^2 / 12) about their ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Bar:
    """A uniform bar: m, m, kg."""

    length: float
    height: float
    mass: float

    @property
    def inertia(self) -> float:
        """About an end, kg m2."""
        return self.mass * (self.length**2 / 3.0 + self.height**2 / 12.0)

    def load(self, e: np.ndarray, rate: np.ndarray, growth: np.ndarray, a: np.ndarray):
        """Return force (complex) and moment about its first end that its motion takes.

        Args:
            e: direction, complex unit.
            rate, growth: of its angle, rad/s, rad/s2.
            a: acceleration of its first end less gravity, complex, m/s2.
        """
        middle = a + 0.5 * self.length * e * (1j * growth - rate**2)
        moment = self.inertia * growth + 0.5 * self.mass * self.length * cross(e, a)
        return self.mass * middle, moment


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a_x b_y - a_y b_x."""
    return (np.conj(a) * b).imag


def run_up(t: np.ndarray, speed: float, duration: float) -> tuple[np.ndarray, ...]:
    """Return angle from 0, rate and growth of a crank that runs up to `speed` in `duration`."""
    u = np.minimum(t / duration, 1.0)
    angle = speed * duration * (2.5 * u**4 - 3.0 * u**5 + u**6) + speed * np.maximum(
        t - duration, 0.0
    )
    rate = speed * (10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5)
    return angle, rate, speed / duration * (30.0 * u**2 - 60.0 * u**3 + 30.0 * u**4)


def slider_crank_forces(
    t: np.ndarray, speed: float, duration: float, crank: float, rod: Bar, slider: float, g: complex
) -> tuple[np.ndarray, np.ndarray]:
    """Return the guide's force on the slider along +y, N, and the crank's torque, N m.

    Args:
        t: instants, s.
        speed, duration: of the crank, rad/s, s.
        crank: its radius, m; its joint lies on the slider's line, the x axis.
        rod: from crank to slider.
        slider: its mass, kg.
        g: gravity, complex, m/s2.
    """
    angle, rate, growth = run_up(t, speed, duration)
    A = crank * np.exp(1j * angle)
    a = A * (1j * growth - rate**2)
    sine = -crank / rod.length * np.sin(angle)
    e = np.sqrt(1.0 - sine**2) + 1j * sine
    # Im of the slider's place vanishes with two derivatives: A + L e.
    turn = -(1j * A * rate).imag / (rod.length * e.real)
    turning = (rod.length * sine * turn**2 - a.imag) / (rod.length * e.real)
    place = (a + rod.length * e * (1j * turning - turn**2)).real  # acceleration of the slider
    force, moment = rod.load(e, turn, turning, a - g)
    # Force on the rod at the slider: i N + slider (g - place); moments about A give N.
    known = slider * (g - place)
    guide = (moment / rod.length - cross(e, known)) / e.real
    return guide, cross(A, force - 1j * guide - known)


def four_bar_forces(
    t: np.ndarray,
    speed: float,
    duration: float,
    crank: float,
    coupler: Bar,
    rocker: Bar,
    joint: float,
    pin: float,
    g: complex,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pin's force on the rocker, complex, N, and the crank's torque, N m.

    Args:
        t, speed, duration, crank, g: as for the slider-crank.
        coupler, rocker: from the crank, and from the coupler to the pin.
        joint: mass where they meet, kg.
        pin: its place on the x axis, m; the rocker turns to the right of the coupler.
    """
    angle, rate, growth = run_up(t, speed, duration)
    A = crank * np.exp(1j * angle)
    a = A * (1j * growth - rate**2)
    Lc, Lr = coupler.length, rocker.length
    # The triangle of A, the joint and the pin.
    chord = pin - A
    r = np.abs(chord)
    inner = np.arccos((Lc**2 + r**2 - Lr**2) / (2.0 * Lc * r))
    e = chord / r * np.exp(1j * inner)
    f = (chord - Lc * e) / Lr
    # A + Lc e + Lr f = pin with two derivatives; cross(e, f) is the determinant.
    det = cross(e, f)

    def split(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return x, y with v = x e + y f."""
        return cross(v, f) / det, cross(e, v) / det

    x, y = split(1j * (1j * A * rate))  # i Lc e x + i Lr f y = -i A rate for the rates x, y
    turn_c, turn_r = x / Lc, y / Lr
    x, y = split(1j * (a - Lc * e * turn_c**2 - Lr * f * turn_r**2))
    turning_c, turning_r = x / Lc, y / Lr
    b = a + Lc * e * (1j * turning_c - turn_c**2)
    force_c, moment_c = coupler.load(e, turn_c, turning_c, a - g)
    force_r, moment_r = rocker.load(f, turn_r, turning_r, b - g)
    force_c, moment_c = force_c + joint * (b - g), moment_c + Lc * cross(e, joint * (b - g))
    # B on the rocker: moments of coupler and joint about A, of the rocker about its first end.
    along_e, along_f = -moment_c / Lc, cross(f, force_r) - moment_r / Lr
    B = (along_e * f - along_f * e) / det
    return force_r - B, cross(A, force_c + B)
