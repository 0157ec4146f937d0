"""Craig-Bampton reduction: constraint modes of the outboard interface plus fixed-interface modes.

Source: Craig & Bampton, AIAA J. 6 (1968) 1313-1319, doi:10.2514/3.4741.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.reduction.basis import AdjointFields, Basis, Options, orient
from dolfinopt.reduction.eigenproblem import complement_solve, interior_pencil, lowest_eigenpairs


def craig_bampton(arm: ElasticArm, options: Options, start: np.ndarray | None = None) -> Basis:
    """Reduce to 3 constraint modes and q - 3 fixed-interface normal modes.

    Psi = [-K_II^-1 K_Ib; I],  K_II Phi = M_II Phi diag(lambda). The stiffness is block diagonal:
    Psi' K Psi and diag(lambda).

    Args:
        arm: with its design set.
        options: coordinates q >= 3; with q = 3 no eigenproblem is solved.
        start: `Basis.start` of a nearby design, or None.
    """
    arm.profile.counts.reductions += 1
    normal = options.coordinates - 3
    static = arm.constraint_modes()
    modes = np.empty((arm.num_interior, 0))
    if normal > 0:
        _, modes = lowest_eigenpairs(interior_pencil(arm), normal, start)
    outboard = np.hstack([np.eye(3), np.zeros((3, normal))])
    V = arm.expand(np.hstack([static.interior, modes]), outboard)
    MV = arm.mass_times(V)
    sign = np.ones(options.coordinates)
    sign[3:] = orient(arm, V[:, :, 3:], MV[:, :, 3:])
    # Constraint and normal modes are K-orthogonal, normal modes among themselves, too.
    stiffness = np.zeros((options.coordinates, options.coordinates))
    stiffness[:3, :3] = static.stiffness
    if normal > 0:
        stiffness[3:, 3:] = np.diag(np.diag(arm.energy_matrix(V[:, :, 3:])))
    return Basis(V * sign, MV * sign, stiffness, outboard, modes * sign[3:])


def craig_bampton_adjoint(
    arm: ElasticArm,
    basis: Basis,
    options: Options,
    interior: np.ndarray,
    outboard: np.ndarray,
) -> AdjointFields:
    """Return mu and lambda mu with d(cotangents . V) = -sum_k mu_k . (dK - lambda_k dM) V_k.

    Constraint modes: K_II mu = cotangents, one solve each with the factor at hand. Normal modes:
    see `complement_solve`. The outboard rows of V are constant.

    Args:
        arm, basis, options: of the current design.
        interior: (num_interior, q) cotangents of the owned interior rows of V.
        outboard: (3, q) cotangents of its outboard rows; without effect here.
    """
    mu = arm.solve(interior[:, :3])
    values = np.concatenate([np.zeros(3), np.diag(basis.stiffness)[3:]])
    if interior.shape[1] > 3:
        pencil = interior_pencil(arm)
        normal = complement_solve(pencil, basis.start, values[3:], interior[:, 3:])
        mu = np.hstack([mu, normal])
    field = arm.expand(mu, np.zeros_like(outboard))
    return AdjointFields(field, field * values)
