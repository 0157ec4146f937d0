"""Modal truncation: the first clamped-free modes, outboard interface rigid."""

from __future__ import annotations

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.reduction.basis import AdjointFields, Basis, Options, orient
from dolfinopt.reduction.complement import complement_solve
from dolfinopt.reduction.eigenproblem import lowest_eigenpairs
from dolfinopt.reduction.free_arm import FreeOperators


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
