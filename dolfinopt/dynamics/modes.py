"""Coordinates in which a machine is nearly uncoupled: its arms' own vibrations.

The preconditioner of machines, see `system.Preconditioner`: it takes stiffness and mass for
definite. Free coordinates and multipliers stay as they are, have no frequency of their own, and are
treated densely, with pivots.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import LinAlgError, eigh

from dolfinopt.dynamics.measured import ROUNDING
from dolfinopt.dynamics.system import Preconditioner
from dolfinopt.multibody.measured import RANK_SHARE
from dolfinopt.multibody.shape_integrals import ShapeIntegrals

if TYPE_CHECKING:
    from dolfinopt.dynamics.machine_system import MachineSystem


def modes_of(system: MachineSystem) -> Preconditioner:
    """Return the system in every arm's vibrations with all that it carries, T'KT = I.

    K v = w^2 M v with the arm's block of the chain's mass matrix at rest, the mean over some
    instants of the prescribed motion: the arms outboard weigh on this one in changing directions.
    Solved as M v = w^-2 K v, whose largest, slowest solutions are right to rounding however stiff
    the rest. The change of coordinates is exact; only how well they uncouple rests on the mean.
    Those of an arm are ordered by descending frequencies.
    """
    mechanism, parts, size = system.mechanism, system.body_columns, system.num_coordinates
    mass = system.rest_mass.mean(axis=0)
    bodies, frequencies = [], np.zeros(size)
    every, inverses = np.eye(size), np.eye(size)
    k, d, m = np.ones(size), np.zeros(size), np.ones(size)
    for part, own, body in zip(parts, mechanism.slices, mechanism.bodies, strict=True):
        T, inverse, squares = _vibrations(body.K, mass[own, own])
        bodies.append(_changed(body, T))
        every[part, part], inverses[part, part] = T, inverse
        frequencies[part] = 1.0 / np.sqrt(np.maximum(squares, np.finfo(float).tiny))
        k[part], d[part] = np.diag(bodies[-1].K), np.diag(bodies[-1].D)
        m[part] = k[part] / frequencies[part] ** 2
    changed = replace(system, mechanism=replace(mechanism, bodies=tuple(bodies)))
    guided = True, _coupled(system)
    return Preconditioner(changed, frequencies, (k, d, m), every, inverses, *guided)


def _coupled(system: MachineSystem) -> bool:
    """Return whether directions in which closures hold rigid arms too often turn with the machine.

    Elastic coordinates then bear what these multipliers would: without their columns Newton's step
    and the error's estimate are off by the share of compliance that closures have.
    """
    if system.num_redundant == 0:
        return False
    result = system.redundant_at(system.motion(np.linspace(0.0, system.breakpoints[-1], 5)))
    return result is not None and bool(np.ptp(result[0], axis=0).max() > RANK_SHARE)


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
    changed, identity = body.in_basis(T), np.eye(body.num_modes)
    if np.abs(changed.K - identity).max(initial=0.0) > ROUNDING or not len(identity):
        return changed
    largest = np.abs(body.K).argmax()
    share = float(body.D.flat[largest] / body.K.flat[largest])
    proportional = np.abs(changed.D - share * identity).max() <= ROUNDING * abs(share)
    return replace(changed, K=identity, D=share * identity if proportional else changed.D)
