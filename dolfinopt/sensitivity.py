"""Gradients of the objective with respect to the physical densities."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

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
