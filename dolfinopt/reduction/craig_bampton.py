"""Craig-Bampton reduction: constraint modes of the outboard interface plus fixed-interface modes.

Source: Craig & Bampton, AIAA J. 6 (1968) 1313-1319, doi:10.2514/3.4741.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.elasticity import ElasticArm
from dolfinopt.reduction.basis import Basis, lowest_eigenpairs, orient


def craig_bampton(arm: ElasticArm, coordinates: int, start: np.ndarray | None = None) -> Basis:
    """Reduce to 3 constraint modes and `coordinates` - 3 fixed-interface normal modes.

    Psi = [-K_II^-1 K_Ib; I],  K_II Phi = M_II Phi diag(lambda). The stiffness is block diagonal:
    Psi' K Psi and diag(lambda).

    Args:
        arm: with its design set.
        coordinates: q >= 3; with q = 3 no eigenproblem is solved.
        start: `Basis.start` of a nearby design, or None.
    """
    normal = coordinates - 3
    coupling, _ = arm.restrict(arm.stiffness_times(arm.rigid))
    interior = arm.solve(-coupling)
    modes = np.empty((arm.num_interior, 0))
    if normal > 0:
        K, M = arm.interior_stiffness(), arm.interior_mass()
        _, modes = lowest_eigenpairs(arm, K, M, arm.solve_vector, normal, start)
    outboard = np.hstack([np.eye(3), np.zeros((3, normal))])
    V = arm.expand(np.hstack([interior, modes]), outboard)
    MV = arm.mass_times(V)
    sign = np.ones(coordinates)
    sign[3:] = orient(arm, V[:, :, 3:], MV[:, :, 3:])
    # Constraint and normal modes are K-orthogonal, normal modes among themselves, too.
    energy = arm.energy_matrix(V)
    stiffness = np.diag(np.diag(energy))
    stiffness[:3, :3] = energy[:3, :3]
    return Basis(V * sign, MV * sign, stiffness, outboard, modes * sign[3:])
