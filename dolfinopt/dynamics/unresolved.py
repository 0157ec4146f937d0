"""The error of vibrations that steps do not resolve, which one stage more does not see.

Where the prescribed motion sets in, changes its law or ends, loads have breakpoints, and every
vibration sets in with an amplitude of its own. Steps much longer than its period damp it out by the
method with s stages and with s + 1 alike: the difference of both says nothing about it. Without
damping it is there to the end, though. So estimated by the amplitude at each breakpoint,
asymptotically for fast vibrations, times what the method with s + 1 stages makes of a free one.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.dynamics.collocation import Collocation, Stages, radau_iia
from dolfinopt.dynamics.solution import lagrange_derivatives

# Numbers of steps, about sixteen of them, after which a free vibration is compared.
LOOKS = 16
FASTEST = 1e30  # rad/s: beyond, squares overflow
ROUNDING = 1e-14  # of R, which grows with the steps


@np.errstate(over="ignore")  # of what has no mass
def unresolved(
    stages: Stages,
    single: tuple[np.ndarray, np.ndarray, np.ndarray],
    states: tuple[np.ndarray, np.ndarray, np.ndarray],
    rest: np.ndarray,
    breakpoint_steps: np.ndarray,
) -> np.ndarray:
    """Return the error of every coordinate's free vibrations (runs, N), in its units.

    With the load F = m a + d qd + k q that a coordinate feels, and w^2 = k / m, a jump of F, F',
    F'' excites (F - F'' / w^2) / k and F' / (k w) of cosine and sine.

    Args:
        stages: of the steps.
        single: stiffness, damping and mass (runs or 1, N) of every coordinate by itself.
        states: q, qd, a (n, s, N) at the stages.
        rest: (runs, N) coordinates before they move.
        breakpoint_steps: (P,) steps of a run behind which the motion's law changes; the first is 0.
    """
    k, d, m = (x[:, None] for x in single)
    jumps = _jumps(stages, single, states, breakpoint_steps)
    jumps[0, :, 0] -= k[:, 0] * rest
    square = np.minimum(k / m, FASTEST**2)
    amplitude = np.hypot(jumps[0] - jumps[2] / square, jumps[1] / np.sqrt(square)) / k
    decay = np.minimum(0.5 * (d / m), FASTEST)
    rate = -decay + np.sqrt((decay * decay - square).astype(complex))
    h = stages.h.reshape(stages.runs, -1, 1)[:, breakpoint_steps]
    lost = _lost(radau_iia(len(stages.method.c) + 1), rate * h, stages.length - breakpoint_steps)
    return np.sqrt(np.square(amplitude * lost).sum(axis=1))


def _jumps(
    stages: Stages,
    single: tuple[np.ndarray, np.ndarray, np.ndarray],
    states: tuple[np.ndarray, np.ndarray, np.ndarray],
    breakpoint_steps: np.ndarray,
) -> np.ndarray:
    """Return the jumps of F, F', F'' (3, runs, P, N) at breakpoints, from zero at first."""
    k, d, m = (x[:, None, None] for x in single)
    ends = lagrange_derivatives(stages.method.c, np.array([0.0, 1.0]))  # (3, 2, s)
    shape = (stages.runs, stages.length, *states[0].shape[1:])
    h = stages.h.reshape(shape[:2])
    sides = []
    for end, steps in zip(
        ends.swapaxes(0, 1), (breakpoint_steps, breakpoint_steps[1:] - 1), strict=True
    ):
        q, qd, a = (x.reshape(shape)[:, steps] for x in states)
        load = m * a + d * qd + k * q
        power = h[:, steps, None] ** -np.arange(3.0)[:, None, None, None]
        sides.append(np.einsum("ij,rpjk->irpk", end, load) * power)
    after, before = sides
    after[:, :, 1:] -= before
    return after


def _lost(method: Collocation, z: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the largest |exp(j z) - R(z)^j| of free vibrations, j steps on.

    R is the method's stability function, 1 + z b' (1 - z A)^-1 1.

    Args:
        method: collocation.
        z: (runs, P, N) eigenvalues times step.
        steps: (P,) that follow.
    """
    values, X = np.linalg.eig(method.A)
    weights = (method.A[-1] @ X) * np.linalg.solve(X, np.ones(len(values)))
    R = 1.0 + z * (weights / (1.0 - z[..., None] * values)).sum(axis=-1)
    j = np.unique(np.geomspace(1.0, steps.max(), LOOKS).round())
    apart = np.abs(np.exp(z[..., None] * j) - R[..., None] ** j)
    seen = (j <= steps[:, None, None]) & (apart > ROUNDING * j)
    return np.where(seen, apart, 0.0).max(axis=-1)
