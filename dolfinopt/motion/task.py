"""Which coordinates of rigid links follow from which, and Newton's method for them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.motion.constraints import Constraints, Target
from dolfinopt.multibody.ranks import least_norm


@dataclass(frozen=True, eq=False)
class Task:
    """Coordinates `unknown` that keep constraints while the others, `given`, are prescribed.

    Attributes:
        constraints: equations.
        names: of all R coordinates.
        unknown: their places.
        passive: those without a drive: the closures alone must determine them.
        target: of instants (n,), s, what is prescribed.
        guess: (R,) near the start.
        width: of random starts around it, rad or the reach.
        side: sign of the last joint's angle at the start, which tells branches apart; 0: the guess
            does.
        end: of the motion, s.
        resolution: number of instants that resolve what is prescribed.
        source: of the scene, for messages.
        keys: that change what is prescribed, for messages.
    """

    constraints: Constraints
    names: tuple[str, ...]
    unknown: np.ndarray
    passive: np.ndarray
    target: Callable[[np.ndarray], Target]
    guess: np.ndarray
    width: float
    side: int
    end: float
    resolution: int
    source: str
    keys: str

    @cached_property
    def given(self) -> np.ndarray:
        """Places of the prescribed coordinates."""
        return np.setdiff1d(np.arange(len(self.names)), self.unknown)

    def called(self, places: Iterable[int]) -> str:
        """Return names of coordinates."""
        return ", ".join(self.names[k] for k in places)

    def with_given(self, q: np.ndarray, target: Target) -> np.ndarray:
        """Return poses (n, R) whose given coordinates are as prescribed."""
        out = q.copy()
        out[:, self.given] = target.joints[0][:, self.given]
        return out

    def newton(
        self, q: np.ndarray, target: Target, enough: float = 1e-9
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return poses (n, R) by Newton's method, and the last steps (n, u).

        Steps are least squares where there are more equations than unknowns: what they leave is
        the misfit of the links.

        Raises:
            numpy.linalg.LinAlgError: a singular pose.
        """
        units = self.constraints.units[self.unknown]
        for _ in range(5):  # from samples that are right to 1e-5, three leave rounding
            here = self.constraints.at(q)
            error = here.error(target) / self.constraints.reach
            step = least_norm(here.rows()[:, :, self.unknown], error)
            q = q.copy()
            q[:, self.unknown] += step * units
            if np.abs(step).max(initial=0.0) < enough:
                break
        return q, step

    def rates(self, q: np.ndarray, target: Target) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rates and accelerations (n, R) of poses on the path to rounding, and G there."""
        here = self.constraints.at(q)
        G, units = here.rows(), self.constraints.units

        def solved(order: int, right: np.ndarray) -> np.ndarray:  # G x = right with x as given
            x = target.joints[order].copy()
            left = right / self.constraints.reach - np.einsum("nkr,nr->nk", G, x / units)
            x[:, self.unknown] = least_norm(G[:, :, self.unknown], left) * units[self.unknown]
            return x

        qd = solved(1, self.constraints.right(target, 1))
        return qd, solved(2, self.constraints.right(target, 2) - here.acceleration(qd)), G
