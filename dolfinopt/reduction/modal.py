"""Reductions by modes: Craig-Bampton (constraint and fixed-interface modes), modes of a free arm.

Source: Craig & Bampton, AIAA J. 6 (1968) 1313-1319, doi:10.2514/3.4741.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.reduction.basis import AdjointFields, Basis, FreeOperators, Options, orient
from dolfinopt.reduction.eigenproblem import complement_solve, interior_pencil, lowest_eigenpairs


def craig_bampton(arm: ElasticArm, options: Options, start: np.ndarray | None = None) -> Basis:
    """Reduce to b constraint modes and q - b fixed-interface normal modes; b is 3, in space 6.

    Psi = [-K_II^-1 K_Ib; I],  K_II Phi = M_II Phi diag(lambda). The stiffness is block diagonal:
    Psi' K Psi and diag(lambda).

    Args:
        arm: with its design set.
        options: coordinates q >= b; with q = b no eigenproblem is solved.
        start: `Basis.start` of a nearby design, or None.
    """
    arm.profile.counts.reductions += 1
    static = arm.constraint_modes()
    b = len(static.stiffness)
    normal = options.coordinates - b
    modes = np.empty((arm.num_interior, 0))
    if normal > 0:
        _, modes = lowest_eigenpairs(interior_pencil(arm), normal, start)
    outboard = np.hstack([np.eye(b), np.zeros((b, normal))])
    V = arm.expand(np.hstack([static.interior, modes]), outboard)
    MV = arm.mass_times(V)
    sign = np.ones(options.coordinates)
    sign[b:] = orient(arm, V[:, :, b:], MV[:, :, b:])
    # Constraint and normal modes are K-orthogonal, normal modes among themselves, too.
    stiffness = np.zeros((options.coordinates, options.coordinates))
    stiffness[:b, :b] = static.stiffness
    if normal > 0:
        stiffness[b:, b:] = np.diag(np.diag(arm.energy_matrix(V[:, :, b:])))
    return Basis(V * sign, MV * sign, stiffness, outboard, modes * sign[b:])


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
        outboard: (b, q) cotangents of its outboard rows; without effect here.
    """
    b = len(basis.outboard)
    mu = arm.solve(interior[:, :b], "adjoint of constraint modes")
    values = np.concatenate([np.zeros(b), np.diag(basis.stiffness)[b:]])
    if interior.shape[1] > b:
        pencil = interior_pencil(arm)
        normal = complement_solve(pencil, basis.start, values[b:], interior[:, b:])
        mu = np.hstack([mu, normal])
    field = arm.expand(mu, np.zeros_like(outboard))
    return AdjointFields(field, field * values)


# -- modal truncation: the first clamped-free modes, outboard interface rigid --------------------


def modal(arm: ElasticArm, options: Options, start: np.ndarray | None = None) -> Basis:
    """Reduce to the first q modes of T'KT phi = lambda T'MT phi.

    Args:
        arm: with its design set.
        options: coordinates q >= 1.
        start: `Basis.start` of a nearby design, or None.
    """
    arm.profile.counts.reductions += 1
    operator = FreeOperators(arm)
    _, vectors = lowest_eigenpairs(operator.pencil, options.coordinates, start)
    interior, outboard = operator.split(vectors)
    V = arm.expand(interior, outboard)
    MV = arm.mass_times(V)
    sign = orient(arm, V, MV)
    stiffness = np.diag(np.diag(arm.energy_matrix(V)))
    return Basis(V * sign, MV * sign, stiffness, outboard * sign, vectors * sign)


def modal_adjoint(
    arm: ElasticArm,
    basis: Basis,
    options: Options,
    interior: np.ndarray,
    outboard: np.ndarray,
) -> AdjointFields:
    """Return mu and lambda mu with d(cotangents . V) = -sum_k mu_k . (dK - lambda_k dM) V_k.

    Args:
        arm, basis, options: of the current design.
        interior: (num_interior, q) cotangents of the owned interior rows of V.
        outboard: (b, q) cotangents of its outboard rows.
    """
    operator = FreeOperators(arm)
    values = np.diag(basis.stiffness)
    right = np.vstack([interior, outboard]) if operator.last else interior
    mu = complement_solve(operator.pencil, basis.start, values, right)
    field = arm.expand(*operator.split(mu))
    return AdjointFields(field, field * values)
