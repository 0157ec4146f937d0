"""Elastic coordinates of a mechanism whose rigid coordinates are prescribed, as a `System`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from dolfinopt.dynamics import modal_coordinates
from dolfinopt.dynamics.modal_coordinates import Own
from dolfinopt.dynamics.system import Instants, State, System, relative_errors
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.body_gradient import body_gradient
from dolfinopt.multibody.inverse_dynamics import body_loads, elastic_residual
from dolfinopt.multibody.mechanism import ElasticBodies, Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.tangent import Tangent, linearise

MAX_NEWTON = 50  # iterations for the equilibrium: it converges in 3 to 6, or folds
ROUNDING = 1e-14  # a step below it changes nothing
# A step below this that is not half of the one before is rounding of an ill-conditioned stiffness.
STALLED = 1e-8


@dataclass(frozen=True, eq=False)
class ElasticInstants:
    """A mechanism and its prescribed motion at n instants."""

    mechanism: Mechanism
    motion: RigidMotion

    def __len__(self) -> int:
        """Return n."""
        return len(self.motion.q)

    def __getitem__(self, part: slice | np.ndarray) -> ElasticInstants:
        """Return it at some of the instants."""
        return ElasticInstants(self.mechanism[part], self.motion[part])

    def residual(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return the elastic residual (n, N)."""
        return elastic_residual(self.mechanism, self.motion, q, qd, qdd)

    def linearise(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, keep: np.ndarray | None = None
    ) -> Tangent:
        """Return its derivative by the coordinates `keep`, or all."""
        return linearise(self.mechanism, self.motion, q, qd, qdd, keep)


@dataclass(frozen=True)
class PrescribedSystem:
    """Elastic residual of a mechanism = 0 over a horizon, rigid coordinates prescribed.

    What plane and space have in common; of them know `at`, `describe` and `body_gradient`.

    Attributes:
        mechanism: N elastic coordinates.
        motion: rigid coordinates at given instants (n,) s.
        breakpoints: ascending instants, first 0 and last the horizon, between which the
            prescribed motion is smooth; steps end there. s.
    """

    mechanism: ElasticBodies
    motion: Callable[[np.ndarray], Any]
    breakpoints: tuple[float, ...]

    @property
    def num_coordinates(self) -> int:
        """Number N of elastic coordinates."""
        return self.mechanism.num_coordinates

    @property
    def elastic_columns(self) -> slice:
        """Where the elastic coordinates stand among the unknowns."""
        return slice(None)

    @property
    def runs(self) -> int:
        """One."""
        return 1

    def initial_state(self) -> State:
        """Return the static equilibrium (1, N) at t = 0: zero unless loads act there.

        Raises:
            ConvergenceError: no equilibrium near the undeformed state.
        """
        q, found = static_equilibrium(self)
        if not found.all():
            raise ConvergenceError(
                "the mechanism finds no static equilibrium at t = 0: the arms are too soft for "
                "gravity, or for the acceleration that a tabulated motion begins with; raise "
                "material.young_modulus or interpolation.floor, lower motion.gravity, or let the "
                "motion begin at rest"
            )
        return q, np.zeros_like(q)

    def norm(self, q: np.ndarray) -> np.ndarray:
        """Return the largest sqrt(q' K q) of every arm, see `System.norm`."""
        return self.mechanism.norm(q)

    def slowest_frequency(self) -> float:
        """Return that of the slowest vibration of the undeformed mechanism at t = 0, rad/s."""
        size = self.num_coordinates
        rest = np.zeros((1, size))
        blocks = self.at(np.zeros(1)).linearise(rest, rest, rest).dense()[0]
        stiffness, mass = self.mechanism.stiffness(), blocks[:, 2 * size :]
        squares = np.abs(np.linalg.eigvals(np.linalg.solve(stiffness, mass)))
        return float(np.sqrt(1.0 / squares.max()))

    def preconditioner(self: Own) -> modal_coordinates.Modes[Own]:
        """Return the arms' vibrations; simulation and adjoint ask for the same."""
        return self._modes

    @cached_property
    def _modes(self) -> modal_coordinates.Modes[Any]:
        return modal_coordinates.modes_of(self)

    def start_gradient(self, q: np.ndarray, by_q: np.ndarray) -> list[ShapeIntegrals]:
        """Return the derivative by every body of J through the equilibrium q (N,) at t = 0.

        Nothing where nothing loads the bodies there: they are at rest whatever they are.
        """
        if not q.any() and not self.is_loaded_at_rest():
            return []
        rest = np.zeros((1, len(q)))
        tangent = self.at(np.zeros(1)).linearise(q[None], rest, rest).dense()
        multipliers = np.linalg.solve(tangent[0, :, : len(q)].T, -by_q)
        return self.body_gradient(np.zeros(1), q[None], rest, rest, multipliers[None])

    def is_loaded_at_rest(self) -> bool:
        """Return whether anything may load the bodies at t = 0, while they are not deformed."""
        return True

    def at(self, t: np.ndarray) -> Instants:
        """Return mechanism and motion at instants t (n,), s."""
        raise NotImplementedError

    def describe(self, q: np.ndarray) -> str:
        """Say how far the bodies' ends turn in a motion q (n, N)."""
        raise NotImplementedError

    def deflection(self, q: np.ndarray) -> float:
        """Return the largest deflection of a body in a motion q (n, N), over its length."""
        return float(self.mechanism.deflections(q).max(initial=0.0))

    def body_gradient(
        self,
        t: np.ndarray,
        q: np.ndarray,
        qd: np.ndarray,
        qdd: np.ndarray,
        multipliers: np.ndarray,
    ) -> list[ShapeIntegrals]:
        """Return the derivative of sum_n multipliers_n . residual_n by every body's integrals."""
        raise NotImplementedError


@dataclass(frozen=True)
class ElasticSystem(PrescribedSystem):
    """That of a chain in the plane."""

    mechanism: Mechanism
    motion: Callable[[np.ndarray], RigidMotion]

    def at(self, t: np.ndarray) -> ElasticInstants:
        """Return mechanism and motion at instants t (n,), s."""
        return ElasticInstants(self.mechanism, self.motion(t))

    def describe(self, q: np.ndarray) -> str:
        """Say how far the arms' ends turn in a motion q (n, N)."""
        angle = 0.0
        for part, body in zip(self.mechanism.slices, self.mechanism.bodies, strict=True):
            angle = max(angle, float(np.abs(q[:, part] @ body.outboard[2]).max(initial=0.0)))
        return f"the arms' ends turn by {angle:.2g} rad"

    def body_gradient(
        self,
        t: np.ndarray,
        q: np.ndarray,
        qd: np.ndarray,
        qdd: np.ndarray,
        multipliers: np.ndarray,
    ) -> list[ShapeIntegrals]:
        """Return the derivative of sum_n multipliers_n . residual_n by every body's integrals."""
        return body_gradient(self.mechanism, self.motion(t), q, qd, qdd, multipliers)

    def is_loaded_at_rest(self) -> bool:
        """Return whether anything loads the arms at t = 0, while they are not deformed."""
        rest = np.zeros((1, self.num_coordinates))
        loads = body_loads(self.mechanism, self.motion(np.zeros(1)), (rest, rest, rest))
        return any(p.any() for p, _ in loads)


def static_equilibrium(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Return q (runs, N) at rest at t = 0 by Newton's method, and where it was found (runs,)."""
    instants, size = system.at(np.zeros(system.runs)), system.num_coordinates
    q = rest = np.zeros((system.runs, size))
    before = np.full(system.runs, np.inf)
    found = np.zeros(system.runs, dtype=bool)
    for _ in range(MAX_NEWTON):
        residual = instants.residual(q, rest, rest)
        found |= ~residual.any(axis=1)  # mostly at once: nothing loads the arms before they move
        if found.all():
            break
        stiffness = instants.linearise(q, rest, rest).dense()[:, :, :size]
        try:
            step = np.linalg.solve(stiffness, -residual[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            break
        q = np.where(found[:, None], q, q + step)
        size_of_step = relative_errors(system, step[:, None], q[:, None])
        stalled = (size_of_step <= STALLED) & (size_of_step >= 0.5 * before)
        found |= (size_of_step <= ROUNDING) | stalled
        before = size_of_step
    return q, found
