"""Values that are the same at all instants, or given at each: several mechanisms in one batch.

Scenarios of the same bodies (other payloads, gravity, materials) lie one after the other in the
arrays of instants; what they share is stored once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

# One number, or one at each of the n instants that a function is given.
PerInstant = float | np.ndarray

# Fewer instants are computed as so many. On processors with AVX-512, NumPy 1.24 multiplies complex
# arrays of less than 64 bytes in one of two ways that round differently, and chooses by how far the
# arrays lie from each other in memory: equal runs would end in different bits.
FEW = 4


def repeated(count: int) -> np.ndarray:
    """Return indices that make `count` instants `FEW`, the last one repeated."""
    return np.minimum(np.arange(FEW), count - 1)


def several(*arguments: Any) -> tuple[Any, ...]:
    """Return the arguments at `FEW` instants, the last one as often as it takes."""
    every = repeated(len(arguments[-1]))
    return tuple(x[every] for x in arguments)


def at(x: PerInstant, part: slice | np.ndarray) -> PerInstant:
    """Return a value at some of the instants."""
    return x[part] if isinstance(x, np.ndarray) else x


def as_column(x: PerInstant) -> PerInstant:
    """Return what multiplies (n, m) arrays instant by instant."""
    return x[:, None] if isinstance(x, np.ndarray) else x


@dataclass(frozen=True, eq=False)
class Scale:
    """Factors of a body's mass integrals, stiffness and damping."""

    mass: PerInstant = 1.0
    stiffness: PerInstant = 1.0
    damping: PerInstant = 1.0

    def __getitem__(self, part: slice | np.ndarray) -> Scale:
        """Return it at some of the instants."""
        return Scale(*(at(x, part) for x in (self.mass, self.stiffness, self.damping)))


UNSCALED = Scale()
