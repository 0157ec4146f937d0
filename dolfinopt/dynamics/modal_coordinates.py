"""Coordinates in which the elastic residual is nearly uncoupled: each arm's own vibrations.

The preconditioner of elastic systems, see `system.Preconditioner`: it takes stiffness and mass for
definite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from scipy.linalg import LinAlgError, cholesky, eigh, solve_triangular

from dolfinopt.multibody.shape_integrals import ShapeIntegrals, in_basis

if TYPE_CHECKING:
    from dolfinopt.dynamics.elastic_system import PrescribedSystem

Own = TypeVar("Own", bound="PrescribedSystem")

# What T'KT may be away from the identity, and is still taken for it.
ROUNDING = 1e-9
# Relative difference of the integrals that rounding makes of a factor.
SAME = 1e-12
REFERENCES = 3  # instants of the horizon whose mass is averaged: 1 to 9 cost the same iterations


@dataclass(frozen=True, eq=False)
class Modes(Generic[Own]):
    """A system in the coordinates z of its arms' vibrations, q = T z arm by arm.

    Attributes:
        system: in z; every arm's stiffness is the identity there.
        transforms: T (q, q) of every arm.
        inverses: T^-1.
        frequencies: (1, N) of every coordinate, rad/s, those of an arm descending.
    """

    system: Own
    transforms: tuple[np.ndarray, ...]
    inverses: tuple[np.ndarray, ...]
    frequencies: np.ndarray
    definite = guided = True

    @cached_property
    def uncoupled(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stiffness, damping, mass (1, N) of every coordinate; the mass with all it carries."""
        bodies = self.system.mechanism.bodies
        k = np.concatenate([np.diag(body.K) for body in bodies])[None]
        d = np.concatenate([np.diag(body.D) for body in bodies])[None]
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

    def chosen(self, runs: np.ndarray) -> Modes[Own]:
        """Return itself: there is one run."""
        return self

    def _each(self, x: np.ndarray, maps: tuple[np.ndarray, ...] | list[np.ndarray]) -> np.ndarray:
        parts = self.system.mechanism.slices
        pieces = [x[..., part] @ T.T for part, T in zip(parts, maps, strict=True)]
        return np.concatenate(pieces, axis=-1)


def modes_of(system: Own) -> Modes[Own]:
    """Return the system in every arm's vibrations with all that it carries, T'KT = I.

    K v = w^2 M v with the arm's block of the chain's mass matrix at rest, the mean over some
    instants of the prescribed motion: the arms outboard weigh on this one in changing directions.
    Solved as M v = w^-2 K v, whose largest, slowest solutions are right to rounding however stiff
    the rest. The change of coordinates is exact; only how well they uncouple rests on the mean.
    """
    mechanism, size = system.mechanism, system.num_coordinates
    instants = system.at(np.linspace(0.0, system.breakpoints[-1], REFERENCES))
    rest = np.zeros((REFERENCES, size))
    mass = instants.linearise(rest, rest, rest).dense()[:, :, 2 * size :].mean(axis=0)
    bodies, transforms, inverses, frequencies = [], [], [], []
    for part, body in zip(mechanism.slices, mechanism.bodies, strict=True):
        T, inverse, squares = _vibrations(body.K, mass[part, part])
        bodies.append(_changed(body, T))
        transforms.append(T)
        inverses.append(inverse)
        frequencies.append(1.0 / np.sqrt(np.maximum(squares, np.finfo(float).tiny)))
    changed = replace(system, mechanism=replace(mechanism, bodies=tuple(bodies)))
    every = np.concatenate(frequencies)[None]
    return Modes(changed, tuple(transforms), tuple(inverses), every)


def _vibrations(K: np.ndarray, M: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return T with T'KT = 1, T'MT = diag(m), its inverse and m = 1 / w^2, ascending."""
    if len(K) == 0:  # a rigid body
        return K, K, np.zeros(0)
    try:
        L = cholesky(K, lower=True)
    except LinAlgError:  # indefinite by rounding: its own coordinates do, if not as well
        scale = np.sqrt(np.abs(np.diag(K)))
        scale[scale == 0.0] = 1.0
        return np.diag(1.0 / scale), np.diag(scale), np.abs(np.diag(M)) / scale**2
    half = solve_triangular(L, M, lower=True)
    scaled = solve_triangular(L, half.T, lower=True)
    m, Y = eigh(0.5 * (scaled + scaled.T))
    return solve_triangular(L, Y, trans="T", lower=True), (L @ Y).T, np.maximum(m, 0.0)


def _changed(body: ShapeIntegrals, T: np.ndarray) -> ShapeIntegrals:
    """Return the body in other coordinates.

    Stiffness, and damping in proportion to it, lose the rounding beside their diagonals: whoever
    uses them sees that the coordinates are uncoupled by them.
    """
    changed = in_basis(body, T)
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
        if np.abs(b - factor * a).max(initial=0.0) > SAME * abs(factor) * size:
            return None
    return factor
