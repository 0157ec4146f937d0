"""Interface between mechanics and integrators: what is solved, and by what it is measured.

An integrator sees a system of N coordinates through its residual r(t, q, q', q'') = 0 alone. What
a machine of elastic bodies makes of it stands in `machine_system`; another system is another file
with another implementation.

Coordinates may be free rigid ones (m, rad) beside elastic ones: control forces that depend on them
are part of the residual. A constraint g(q, t) = 0 is a row of the residual, its multiplier the
second derivative of a coordinate that nothing else depends on: collocation then fulfils it at every
stage, positions with order 2 s - 1, velocities s, multipliers s - 1 (Hairer, Lubich & Roche 1989,
doi:10.1007/BFb0093947). That holds for the method's own `collocation.stage_values`; a solution's
interpolant meets it at the steps' ends, and between them to its order. Neither is definite: such a
system has no preconditioner (`unchanged`), and all its coordinates are treated densely, with
pivots. tests/dynamics/test_system.py has examples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from dolfinopt.dynamics.measured import RESTING_GROUP_SHARE
from dolfinopt.multibody.tangent import Tangent
from dolfinopt.multibody.tree import Mechanism

State = tuple[np.ndarray, np.ndarray]  # q, qd


class Instants(Protocol):
    """A system at n instants, all that depends on time alone evaluated."""

    def __len__(self) -> int:
        """Return n."""

    def __getitem__(self, part: slice | np.ndarray) -> Instants:
        """Return it at some of the instants."""

    def residual(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return r (n, N) of q, qd, qdd (n, N); zero when the equations of motion hold."""

    def linearise(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, keep: np.ndarray | None = None
    ) -> Tangent:
        """Return the derivative by the ascending coordinates `keep` (S,), or all."""


class System(Protocol):
    """N coordinates over a horizon.

    Attributes:
        num_coordinates: N.
        breakpoints: ascending instants, first 0 and last the horizon, between which the residual
            is a smooth function of time but for the rows of tables; steps end there. s.
    """

    @property
    def num_coordinates(self) -> int: ...
    @property
    def breakpoints(self) -> tuple[float, ...]: ...

    def at(self, t: np.ndarray) -> Instants:
        """Return the system at instants t (n,), s."""

    def at_stages(self, time_grid: np.ndarray, nodes: np.ndarray) -> Instants:
        """Return it at the nodes (s,) of the steps of a grid (n + 1,), s; see `tables`.

        What tables hold counts there by its moments over the step, so that no row is lost.
        """

    def initial_state(self) -> State:
        """Return q, qd (1, N) at t = 0.

        Raises:
            ConvergenceError: there is none.
        """

    def norm(self, q: np.ndarray) -> np.ndarray:
        """Return the largest norm of q (..., n, N) over n instants, (..., groups).

        A group is what is measured by itself: errors are relative to its own size, or to
        `RESTING_GROUP_SHARE` of the largest group's. Groups of other units (m, rad, energy^(1/2))
        are weighted so that they compare; a multiplier's coordinate belongs to none.
        """

    def slowest_frequency(self) -> float:
        """Return that of the slowest vibration, rad/s: eight steps a period are tried first."""

    def deflection(self, q: np.ndarray) -> float:
        """Return the largest deflection of a body in a motion q (n, N), over its length."""

    def preconditioner(self) -> Preconditioner:
        """Return coordinates for Newton's method; `unchanged` where there are no better ones."""


@dataclass(frozen=True, eq=False)
class Preconditioner:
    """Coordinates z of a system in which its residual is nearly uncoupled, q = T z.

    Attributes:
        system: in z, a `System`.
        frequencies: (N,) of every coordinate by itself, rad/s; 0 of what must be treated densely.
        uncoupled: stiffness, damping and mass (N,) of every coordinate by itself.
        guided: whether zero is a guess of the whole motion: then all steps are solved at once.
        coupled: whether constraints couple fast coordinates: then these are treated densely, too.
        T, inverse: (N, N), of q = T z.
    """

    system: Any
    frequencies: np.ndarray
    uncoupled: tuple[np.ndarray, np.ndarray, np.ndarray]
    T: np.ndarray
    inverse: np.ndarray
    guided: bool = False
    coupled: bool = False

    def to_modes(self, q: np.ndarray) -> np.ndarray:
        """Return z (..., N) of coordinates q (..., N)."""
        return q @ self.inverse.T

    def from_modes(self, z: np.ndarray) -> np.ndarray:
        """Return q (..., N)."""
        return z @ self.T.T

    def gradient_to_modes(self, by_q: np.ndarray) -> np.ndarray:
        """Return dJ/dz = T' dJ/dq (..., N)."""
        return by_q @ self.T

    def gradient_from_modes(self, by_z: np.ndarray) -> np.ndarray:
        """Return dJ/dq = T^-T dJ/dz (..., N)."""
        return by_z @ self.inverse


def unchanged(system: System) -> Preconditioner:
    """Return a system in its own coordinates: all are treated densely, and it is marched."""
    ones = np.ones(system.num_coordinates)
    same = np.diag(ones)
    return Preconditioner(system, 0.0 * ones, (ones, 0.0 * ones, ones), same, same)


def relative_error(system: System | Mechanism, error: np.ndarray, q: np.ndarray) -> float:
    """Return the largest error in time over the largest value, worst group; both (n, N)."""
    return float((system.norm(error) * inverse_size(system.norm(q))).max(initial=0.0))


def inverse_size(size: np.ndarray) -> np.ndarray:
    """Return what errors of every group are multiplied by to be relative, of its size (groups,)."""
    largest = size.max(initial=0.0)
    if largest == 0.0:
        return np.ones_like(size)
    return 1.0 / np.maximum(size, RESTING_GROUP_SHARE * largest)
