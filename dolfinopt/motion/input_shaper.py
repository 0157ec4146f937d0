"""Input shapers: a command in a few parts, one after the other, whose vibrations cancel.

q_s(t) = sum_i A_i q(t - t_i) with sum_i A_i = 1, of one vibration of angular frequency w and
damping ratio z, period T = 2 pi / (w sqrt(1 - z^2)) and K = exp(-pi z / sqrt(1 - z^2)):

    zv    A = (1, K) / (1 + K)              t = (0, T/2)
    zvd   A = (1, 2 K, K^2) / (1 + K)^2     t = (0, T/2, T)
    ei    A = ((1 + V) / 4, (1 - V) / 2, (1 + V) / 4), t as zvd, for little damping

V is the vibration that ei leaves at w, so that it leaves no more in a wide band about it.
Source: Singer & Seering (1990), doi:10.1115/1.2894142; Singhose, Seering & Singer (1994),
doi:10.1115/1.2919428.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

ShaperKind = Literal["zv", "zvd", "ei"]
EI_VIBRATION = 0.05  # V: the usual value of the literature


@dataclass(frozen=True, eq=False)
class InputShaper:
    """Parts of a command.

    Attributes:
        amplitudes: (m,) A, of sum 1.
        delays: (m,) t ascending, the first 0, s.
    """

    amplitudes: np.ndarray
    delays: np.ndarray

    @property
    def longer(self) -> float:
        """By how much a shaped command takes longer, s."""
        return float(self.delays[-1])

    def shaped(self, command: Callable[[np.ndarray], np.ndarray], t: np.ndarray) -> np.ndarray:
        """Return the shaped command (n, k) at instants t (n,), s, of one that rests before t = 0.

        Args:
            command: its values (m, k) at instants (m,) >= 0, s.
            t: ascending.
        """
        parts = zip(self.amplitudes, self.delays, strict=True)
        return np.asarray(sum(a * command(np.maximum(t - late, 0.0)) for a, late in parts))


def input_shaper(kind: ShaperKind, frequency: float, damping_ratio: float) -> InputShaper:
    """Return the shaper of a kind for one vibration.

    Args:
        kind: "zv", "zvd" or "ei".
        frequency: w, rad/s, above 0.
        damping_ratio: z, from 0 to below 1.
    """
    damped = np.sqrt(1.0 - damping_ratio**2)
    half, K = np.pi / (frequency * damped), np.exp(-np.pi * damping_ratio / damped)
    if kind == "zv":
        amplitudes = np.array([1.0, K]) / (1.0 + K)
    elif kind == "zvd":
        amplitudes = np.array([1.0, 2.0 * K, K * K]) / (1.0 + K) ** 2
    else:
        V = EI_VIBRATION
        amplitudes = np.array([0.25 * (1.0 + V), 0.5 * (1.0 - V), 0.25 * (1.0 + V)])
    return InputShaper(amplitudes, half * np.arange(len(amplitudes)))
