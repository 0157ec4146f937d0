"""Gradients of the objective with respect to the physical densities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.mechanism import BodySlopes
from dolfinopt.reduction import METHODS

if TYPE_CHECKING:
    from dolfinopt.arm import Arm


# Directions of Q below this share of its largest are rounding.
RANK_TOLERANCE = 1e-14


def esl_gradient(arm: Arm, Q: np.ndarray) -> np.ndarray:
    """Return d(sum_j q_j' K q_j)/dx_phys of one arm with the equivalent static loads frozen.

    With f_j = K u_j held, dc/dE_e = -sum_j u_j' k_e u_j = -trace(V_e' k_e V_e Q): as many energy
    fields as coordinates at most, however many load cases.
    Source: Seifried, Moghadasi & Held (2015), eq. (11), doi:10.1016/j.piutam.2015.01.018.

    Args:
        arm: with the design reduced.
        Q: (q, q) sum of q_j q_j' over the load cases, weighted.

    Returns:
        (n_cells,) over this rank's cells.
    """
    assert arm.basis is not None
    with arm.ledger.phase("gradient"):
        values, vectors = np.linalg.eigh(Q)
        keep = values > RANK_TOLERANCE * max(values[-1], 0.0)
        fields = arm.basis.V @ (vectors[:, keep] * np.sqrt(values[keep]))
        energies = arm.elastic.cell_stiffness_products(fields, fields)
        modulus = arm.scene.material.young_modulus
        return -modulus * arm.material.stiffness_slope * energies


def exact_gradient(arm: Arm, slopes: BodySlopes) -> np.ndarray:
    """Return the derivative by x_phys of one arm of a function of its floating body.

    Every integral is a product u . M v or u . K v of modes and rigid motions, so its derivative
    has a part by M and K, cell by cell, and one by the modes V; the latter goes through
    `Method.adjoint`. Exact for the discrete model.

    Args:
        arm: with the design reduced.
        slopes: of the function by the body's constants; those of D go to K.

    Returns:
        (n_cells,) over this rank's cells.
    """
    assert arm.basis is not None
    with arm.ledger.phase("gradient"):
        elastic, V = arm.elastic, arm.basis.V
        damping = arm.scene.damping.stiffness_proportional
        by_K = slopes.K + damping * slopes.D
        Y = _mass_partners(elastic.points, V, slopes)
        by_V = elastic.mass_times(2.0 * Y.quadratic + Y.linear)
        by_V += elastic.stiffness_times(V @ (by_K + by_K.T))
        interior, outboard = elastic.restrict(by_V)
        method = METHODS[arm.scene.reduction.method]
        mu, values = method.adjoint(elastic, arm.basis, interior, outboard + slopes.outboard)
        energies = elastic.cell_stiffness_products(V @ by_K.T - mu, V)
        masses = elastic.cell_mass_products(Y.quadratic + Y.linear + mu * values, V)
        masses += elastic.cell_mass_products(*_rigid_partners(elastic.points, slopes))
        modulus, density = arm.scene.material.young_modulus, arm.scene.material.density
        slope = modulus * arm.material.stiffness_slope * energies
        return slope + density * arm.material.mass_slope * masses


@dataclass(frozen=True)
class _MassPartners:
    """Fields Y_k with d(integrals) = sum_k Y_k . dM V_k; (n_nodes, 2, q).

    Attributes:
        linear: from integrals with one mode.
        quadratic: from those with two, where dV_k meets its partner twice.
    """

    linear: np.ndarray
    quadratic: np.ndarray


def _mass_partners(points: np.ndarray, V: np.ndarray, slopes: BodySlopes) -> _MassPartners:
    X = points
    SX = np.stack([-X[:, 1], X[:, 0]], axis=1)
    SV = np.stack([-V[:, 1], V[:, 0]], axis=1)
    linear = X[:, :, None] * slopes.j + SX[:, :, None] * slopes.r + slopes.C[None]
    skew = 0.5 * (slopes.G - slopes.G.T)
    quadratic = V @ (0.5 * (slopes.M + slopes.M.T)) + SV @ skew.T
    return _MassPartners(linear, quadratic)


def _rigid_partners(points: np.ndarray, slopes: BodySlopes) -> tuple[np.ndarray, np.ndarray]:
    """Return fields whose mass products are the slopes of m, c and J by the cells' mass."""
    ones = np.zeros((len(points), 2, 1))
    ones[:, 0] = 1.0
    first = np.zeros_like(ones)
    first[:, 0, 0] = slopes.mass + points @ slopes.moment
    left = np.concatenate([first, slopes.inertia * points[:, :, None]], axis=2)
    return left, np.concatenate([ones, points[:, :, None]], axis=2)
