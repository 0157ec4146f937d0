"""Coordinates in which a machine is nearly uncoupled: its arms' own vibrations.

The preconditioner of machines, see `system.Preconditioner`: it takes stiffness and mass for
definite. Free coordinates and multipliers stay as they are, have no frequency of their own, and are
treated densely, with pivots.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from math import prod
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import LinAlgError, eigh

from dolfinopt.dynamics.measured import ROUNDING
from dolfinopt.multibody.measured import RANK_SHARE
from dolfinopt.multibody.shape_integrals import ShapeIntegrals

if TYPE_CHECKING:
    from dolfinopt.dynamics.machine_system import MachineSystem


@dataclass(frozen=True, eq=False)
class Modes:
    """A machine in the coordinates z of its arms' vibrations, q = T z arm by arm.

    Attributes:
        system: in z; every arm's stiffness is the identity there.
        transforms: T (q, q) of every arm.
        inverses: T^-1.
        frequencies: (S,) of every coordinate, rad/s, those of an arm descending.
    """

    system: MachineSystem
    transforms: tuple[np.ndarray, ...]
    inverses: tuple[np.ndarray, ...]
    frequencies: np.ndarray
    guided = True

    @cached_property
    def uncoupled(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stiffness, damping, mass (S,) of every coordinate; the mass with all it carries."""
        size = len(self.frequencies)
        k, d, m = np.ones(size), np.zeros(size), np.ones(size)
        for part, body in zip(self.system.body_columns, self.system.mechanism.bodies, strict=True):
            k[part], d[part] = np.diag(body.K), np.diag(body.D)
            m[part] = k[part] / self.frequencies[part] ** 2
        return k, d, m

    @cached_property
    def coupled(self) -> bool:
        """Whether directions in which closures hold rigid arms too often turn as the machine moves.

        Elastic coordinates then bear what these multipliers would: without their columns Newton's
        step and the error's estimate are off by the share of compliance that closures have.
        """
        t = np.linspace(0.0, self.system.breakpoints[-1], 5)
        found = self.system.redundant_at(self.system.motion(t))
        return found is not None and bool(np.ptp(found[0], axis=0).max() > RANK_SHARE)

    def to_modes(self, q: np.ndarray) -> np.ndarray:
        """Return z (..., S) of coordinates (..., S)."""
        return self._each(q, self.inverses)

    def from_modes(self, z: np.ndarray) -> np.ndarray:
        """Return the coordinates of z (..., S)."""
        return self._each(z, self.transforms)

    def gradient_to_modes(self, by_q: np.ndarray) -> np.ndarray:
        """Return dJ/dz = T' dJ/dq (..., S)."""
        return self._each(by_q, (T.T for T in self.transforms))

    def gradient_from_modes(self, by_z: np.ndarray) -> np.ndarray:
        """Return dJ/dq = T^-T dJ/dz (..., S)."""
        return self._each(by_z, (inverse.T for inverse in self.inverses))

    def _each(self, x: np.ndarray, maps: Iterable[np.ndarray]) -> np.ndarray:
        rows = x.reshape(prod(x.shape[:-1]), x.shape[-1]).copy()
        for part, T in zip(self.system.body_columns, maps, strict=True):
            rows[:, part] = rows[:, part] @ T.T
        return rows.reshape(x.shape)


def modes_of(system: MachineSystem) -> Modes:
    """Return the system in every arm's vibrations with all that it carries, T'KT = I.

    K v = w^2 M v with the arm's block of the chain's mass matrix at rest, the mean over some
    instants of the prescribed motion: the arms outboard weigh on this one in changing directions.
    Solved as M v = w^-2 K v, whose largest, slowest solutions are right to rounding however stiff
    the rest. The change of coordinates is exact; only how well they uncouple rests on the mean.
    """
    mechanism = system.mechanism
    t = np.linspace(0.0, system.breakpoints[-1], 3)  # 1 to 9 are as good
    mass = system.elastic_mass(t).mean(axis=0)
    bodies, transforms, inverses, frequencies = [], [], [], np.zeros(system.num_coordinates)
    for k, body in enumerate(mechanism.bodies):
        own = mechanism.slices[k]
        T, inverse, squares = _vibrations(body.K, mass[own, own])
        bodies.append(_changed(body, T))
        transforms.append(T)
        inverses.append(inverse)
        least = np.finfo(float).tiny
        frequencies[system.body_columns[k]] = 1.0 / np.sqrt(np.maximum(squares, least))
    changed = replace(system, mechanism=replace(mechanism, bodies=tuple(bodies)))
    return Modes(changed, tuple(transforms), tuple(inverses), frequencies)


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
    changed, one = body.in_basis(T), np.eye(body.num_modes)
    if np.abs(changed.K - one).max(initial=0.0) > ROUNDING or not len(one):
        return changed
    largest = np.abs(body.K).argmax()
    share = float(body.D.flat[largest] / body.K.flat[largest])
    proportional = np.abs(changed.D - share * one).max() <= ROUNDING * abs(share)
    return replace(changed, K=one, D=share * one if proportional else changed.D)
