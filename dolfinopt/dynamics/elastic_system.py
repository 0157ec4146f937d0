"""Elastic coordinates of a mechanism whose rigid coordinates are prescribed, as a `System`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import prod
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.linalg import LinAlgError, eigh

from dolfinopt.dynamics.equilibrium import equilibrium
from dolfinopt.dynamics.measured import (
    ROUNDING,
)
from dolfinopt.dynamics.system import Linearisation, State
from dolfinopt.dynamics.tables import motion_at_stages
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.gradient import body_gradient
from dolfinopt.multibody.loads import is_loaded_at_rest
from dolfinopt.multibody.newton_euler import elastic_residual
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.tangent import linearise


@dataclass(frozen=True, eq=False)
class ElasticInstants:
    """A mechanism and its prescribed motion at n instants."""

    mechanism: Any
    motion: RigidMotion

    def __len__(self) -> int:
        """Return n."""
        return len(self.motion.q)

    def __getitem__(self, part: slice | np.ndarray) -> ElasticInstants:
        """Return it at some of the instants."""
        return ElasticInstants(self.mechanism, self.motion[part])

    def residual(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return the elastic residual (n, N)."""
        return elastic_residual(self.mechanism, self.motion, q, qd, qdd)

    def linearise(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, keep: np.ndarray | None = None
    ) -> Linearisation:
        """Return its derivative by the coordinates `keep`, or all."""
        return linearise(self.mechanism, self.motion, q, qd, qdd, keep)


@dataclass(frozen=True)
class ElasticSystem:
    """Elastic residual of a mechanism = 0 over a horizon, rigid coordinates prescribed.

    Attributes:
        mechanism: N elastic coordinates.
        motion: rigid coordinates at given instants (n,) s.
        breakpoints: ascending instants, first 0 and last the horizon, between which the
            prescribed motion is smooth; steps end there. s.
    """

    mechanism: Any
    motion: Callable[[np.ndarray], RigidMotion]
    breakpoints: tuple[float, ...]

    @property
    def num_coordinates(self) -> int:
        """Number N of elastic coordinates."""
        return self.mechanism.num_coordinates

    @property
    def elastic_columns(self) -> slice:
        """Where the elastic coordinates stand among the unknowns."""
        return slice(None)

    def initial_state(self) -> State:
        """Return the static equilibrium (1, N) at t = 0: zero unless loads act there.

        Raises:
            ConvergenceError: no equilibrium near the undeformed state.
        """
        return self._equilibrium.copy(), np.zeros_like(self._equilibrium)

    @cached_property
    def _equilibrium(self) -> np.ndarray:
        """That of `initial_state`: every time grid asks for it."""
        instants, size = self.at(np.zeros(1)), self.num_coordinates
        rest = np.zeros((1, size))
        q = equilibrium(
            lambda q: instants.residual(q[None], rest, rest)[0],
            lambda q: instants.linearise(q[None], rest, rest).dense()[0, :, :size],
            rest[0],
        )
        if q is None:
            bearings = bool(self.mechanism.bearings)
            raise ConvergenceError(
                "the mechanism finds no static equilibrium at t = 0: the arms "
                + ("or their bearings " if bearings else "")
                + "are too soft for gravity, or for the acceleration that a tabulated motion "
                "begins with; raise "
                + ("bearing_stiffness, " if bearings else "")
                + "material.young_modulus or interpolation.floor, lower motion.gravity, or let the "
                "motion begin at rest"
            )
        return q[None]

    def norm(self, q: np.ndarray) -> np.ndarray:
        """Return the largest sqrt(q' K q) of every arm, see `System.norm`."""
        return self.mechanism.norm(q)

    def slowest_frequency(self) -> float:
        """Return that of the slowest vibration of the undeformed mechanism at t = 0, rad/s.

        0 of rigid arms.
        """
        size = self.num_coordinates
        if size == 0:
            return 0.0
        rest = np.zeros((1, size))
        blocks = self.at(np.zeros(1)).linearise(rest, rest, rest).dense()[0]
        stiffness, mass = self.mechanism.stiffness(), blocks[:, 2 * size :]
        squares = np.abs(np.linalg.eigvals(np.linalg.solve(stiffness, mass)))
        return float(np.sqrt(1.0 / squares.max()))

    def preconditioner(self: Own) -> Modes[Own]:
        """Return the arms' vibrations; simulation and adjoint ask for the same."""
        return self._modes

    @cached_property
    def _modes(self) -> Modes[Any]:
        return modes_of(self)

    def start_gradient(self, q: np.ndarray, by_q: np.ndarray) -> list[ShapeIntegrals]:
        """Return the derivative by every body of J through the equilibrium q (N,) at t = 0.

        Nothing where nothing loads the bodies there: they are at rest whatever they are.
        """
        if not q.any() and not self.is_loaded_at_rest():
            return []
        rest = np.zeros((1, len(q)))
        tangent = self.at(np.zeros(1)).linearise(q[None], rest, rest).dense()
        multipliers = np.linalg.solve(tangent[0, :, : len(q)].T, -by_q)
        return self.body_gradient(self.at(np.zeros(1)), q[None], rest, rest, multipliers[None])

    def is_loaded_at_rest(self) -> bool:
        """Return whether anything may load the bodies at t = 0, while they are not deformed."""
        return is_loaded_at_rest(self.mechanism, self.motion(np.zeros(1)))

    def at(self, t: np.ndarray) -> ElasticInstants:
        """Return mechanism and motion at instants t (n,), s."""
        return ElasticInstants(self.mechanism, self.motion(t))

    def at_stages(self, time_grid: np.ndarray, nodes: np.ndarray) -> ElasticInstants:
        """Return them at the stages of the steps of a grid, see `System.at_stages`."""
        return ElasticInstants(self.mechanism, motion_at_stages(self.motion, time_grid, nodes))

    def deflection(self, q: np.ndarray) -> float:
        """Return the largest deflection of a body in a motion q (n, N), over its length."""
        return float(self.mechanism.deflections(q)[0].max(initial=0.0))

    def body_gradient(
        self,
        instants: ElasticInstants,
        q: np.ndarray,
        qd: np.ndarray,
        qdd: np.ndarray,
        multipliers: np.ndarray,
    ) -> list[ShapeIntegrals]:
        """Return the derivative of sum_n multipliers_n . residual_n by every body's integrals."""
        return body_gradient(self.mechanism, instants.motion, q, qd, qdd, multipliers)


# -- coordinates in which the elastic residual is nearly uncoupled: each arm's own vibrations ----
#
# The preconditioner of elastic systems, see `system.Preconditioner`: it takes stiffness and mass
# for definite.

Own = TypeVar("Own", bound="ElasticSystem")


@dataclass(frozen=True, eq=False)
class Modes(Generic[Own]):
    """A system in the coordinates z of its arms' vibrations, q = T z arm by arm.

    Attributes:
        system: in z; every arm's stiffness is the identity there.
        transforms: T (q, q) of every arm.
        inverses: T^-1.
        frequencies: (N,) of every coordinate, rad/s, those of an arm descending.
    """

    system: Own
    transforms: tuple[np.ndarray, ...]
    inverses: tuple[np.ndarray, ...]
    frequencies: np.ndarray
    guided = True
    coupled = False

    @cached_property
    def uncoupled(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stiffness, damping, mass (N,) of every coordinate; the mass with all it carries."""
        bodies = self.system.mechanism.bodies
        k = np.concatenate([np.diag(body.K) for body in bodies])
        d = np.concatenate([np.diag(body.D) for body in bodies])
        return k, d, k / self.frequencies**2

    def to_modes(self, q: np.ndarray) -> np.ndarray:
        """Return z (..., N) of coordinates q (..., N)."""
        return self._each(q, self.inverses)

    def from_modes(self, z: np.ndarray) -> np.ndarray:
        """Return q = T z (..., N)."""
        return self._each(z, self.transforms)

    def gradient_to_modes(self, by_q: np.ndarray) -> np.ndarray:
        """Return dJ/dz = T' dJ/dq (..., N)."""
        return self._each(by_q, [T.T for T in self.transforms])

    def gradient_from_modes(self, by_z: np.ndarray) -> np.ndarray:
        """Return dJ/dq = T^-T dJ/dz (..., N)."""
        return self._each(by_z, [inverse.T for inverse in self.inverses])

    def _each(self, x: np.ndarray, maps: tuple[np.ndarray, ...] | list[np.ndarray]) -> np.ndarray:
        parts, rows = self.system.mechanism.slices, x.reshape(prod(x.shape[:-1]), x.shape[-1])
        pieces = [rows[:, part] @ T.T for part, T in zip(parts, maps, strict=True)]
        return np.concatenate(pieces, axis=1).reshape(x.shape)


def modes_of(system: Own) -> Modes[Own]:
    """Return the system in every arm's vibrations with all that it carries, T'KT = I.

    K v = w^2 M v with the arm's block of the chain's mass matrix at rest, the mean over some
    instants of the prescribed motion: the arms outboard weigh on this one in changing directions.
    Solved as M v = w^-2 K v, whose largest, slowest solutions are right to rounding however stiff
    the rest. The change of coordinates is exact; only how well they uncouple rests on the mean.
    """
    mechanism, size = system.mechanism, system.num_coordinates
    instants = system.at(np.linspace(0.0, system.breakpoints[-1], 3))  # 1 to 9 are as good
    rest = np.zeros((3, size))
    mass = instants.linearise(rest, rest, rest).dense()[:, :, 2 * size :].mean(axis=0)
    bodies, transforms, inverses, frequencies = [], [], [], []
    for part, body in zip(mechanism.slices, mechanism.bodies, strict=True):
        T, inverse, squares = _vibrations(body.K, mass[part, part])
        bodies.append(_changed(body, T))
        transforms.append(T)
        inverses.append(inverse)
        frequencies.append(1.0 / np.sqrt(np.maximum(squares, np.finfo(float).tiny)))
    changed = replace(system, mechanism=replace(mechanism, bodies=tuple(bodies)))
    every = np.concatenate(frequencies)
    return Modes(changed, tuple(transforms), tuple(inverses), every)


def _vibrations(K: np.ndarray, M: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return T with T'KT = 1, T'MT = diag(m), its inverse and m = 1 / w^2, ascending."""
    if len(K) == 0:  # a rigid body
        return K, K, np.zeros(0)
    try:
        m, T = eigh(0.5 * (M + M.T), K)
    except LinAlgError:  # indefinite by rounding: its own coordinates do, if not as well
        scale = np.sqrt(np.abs(np.diag(K)))
        scale[scale == 0.0] = 1.0
        return np.diag(1.0 / scale), np.diag(scale), np.abs(np.diag(M)) / scale**2
    return T, T.T @ K, np.maximum(m, 0.0)


def _changed(body: ShapeIntegrals, T: np.ndarray) -> ShapeIntegrals:
    """Return the body in other coordinates."""
    # Stiffness, and damping in proportion to it, lose the rounding beside their diagonals: whoever
    # uses them sees that the coordinates are uncoupled by them.
    changed = body.in_basis(T)
    one = np.eye(len(changed.K))
    if np.abs(changed.K - one).max(initial=0.0) > ROUNDING:
        return changed
    share = proportion([body.K], [body.D])
    return replace(changed, K=one, D=changed.D if share is None else share * one)


def proportion(here: Sequence[np.ndarray], there: Sequence[np.ndarray]) -> float | None:
    """Return f where all of `there` is f times what is `here`, to rounding."""
    largest = [float(np.abs(x).max(initial=0.0)) for x in here]
    k = int(np.argmax(largest))
    if largest[k] == 0.0:
        return None if any(np.any(x) for x in there) else 1.0
    place = np.unravel_index(np.abs(here[k]).argmax(), here[k].shape)
    factor = float(there[k][place] / here[k][place])
    for a, b, size in zip(here, there, largest, strict=True):
        if np.abs(b - factor * a).max(initial=0.0) > ROUNDING * abs(factor) * size:
            return None
    return factor
