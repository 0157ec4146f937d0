"""Second-order Krylov subspaces: the reduced arm matches moments of the full one at given shifts.

Source: Bai & Su, SIAM J. Sci. Comput. 26 (2005) 1692-1709, doi:10.1137/040605552; inputs and
outputs of elastic bodies as in Lehner & Eberhard, at-Automatisierungstechnik 54 (2006) 170-177.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.assembly import combine
from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.reduction.basis import (
    AdjointFields,
    Basis,
    Expansion,
    FreeArm,
    Options,
    Rows,
    dot,
    frame_fields,
    frame_loads,
    interface_loads,
    orthonormalise,
    ritz,
    solve_at,
)
from dolfinopt.reduction.measured import KRYLOV_BLOCKS_LIMIT, SHIFT_TOLERANCE


def krylov(arm: ElasticArm, options: Options, start: np.ndarray | None = None) -> Basis:
    """Reduce to q vectors of the block Krylov subspaces at the shifts w = 2 pi f.

    With K_w = K - w^2 M the subspace of one shift is spanned by K_w^-1 B, K_w^-1 M K_w^-1 B, ...,
    for the inputs B: unit loads of the outboard interface, then M times unit accelerations of the
    frame. Projection onto k complete blocks matches 2 k moments of B' (K - s M)^-1 B about
    s = w^2, as K and M are symmetric, also under damping proportional to K. Blocks of three
    (six in space) are taken in turn: interface loads at all shifts, accelerations at all shifts,
    then the next power.

    The basis of that space are its Ritz vectors, M-orthonormal, by ascending frequency.

    Args:
        arm: with its design set.
        options: coordinates q, shifts.
        start: without effect; there is no eigenproblem.

    Raises:
        ConvergenceError: fewer than q independent vectors, or a shift at a natural frequency.
    """
    arm.profile.counts.reductions += 1
    return ritz(arm, _recursion(arm, options).V)


def krylov_adjoint(
    arm: ElasticArm,
    basis: Basis,
    options: Options,
    interior: np.ndarray,
    outboard: np.ndarray,
) -> AdjointFields:
    """Return the fields of `AdjointFields` for cotangents of V of a function of its span.

    Column by column backwards through V_new = (K_w^-1 f - V H_1) H_2^-1, f = M V_source or inputs:
    one solve each. What the columns do within their span has no influence and is left out; each
    block's source and predecessors are complete, so that nothing else is.

    Args:
        arm, basis, options: of the current design.
        interior: (num_interior, q) cotangents of the owned interior rows of V.
        outboard: (b, q) cotangents of its outboard rows.
    """
    recursion = _recursion(arm, options)
    turn = dot(arm, recursion.MV, basis.V)  # basis.V = V turn, an orthogonal matrix
    # Within the span a trajectory that is right to its tolerance leaves cotangents that are not
    # quite zero, and the recursion would amplify them.
    inner = arm.comm.allreduce(basis.V[arm.interior_nodes].reshape(interior.shape).T @ interior)
    inner += basis.outboard.T @ outboard
    weighted = arm.restrict(basis.MV)
    interior = (interior - weighted[0] @ inner) @ turn.T
    outboard = (outboard - weighted[1] @ inner) @ turn.T
    stiffness, mass = np.zeros_like(basis.V), np.zeros_like(basis.V)
    frame = np.zeros_like(frame_fields(arm))
    for block in reversed(recursion.blocks):
        kept, H = block.expansion.kept, block.expansion.coefficients[:, block.expansion.kept]
        old, new = slice(0, len(H) - len(kept)), slice(len(H) - len(kept), len(H))
        inverse = np.linalg.inv(H[new])
        cotangents = interior[:, new] @ inverse.T, outboard[:, new] @ inverse.T
        interior[:, old] -= cotangents[0] @ H[old].T
        outboard[:, old] -= cotangents[1] @ H[old].T
        mu = solve_at(recursion.free, block.omega, cotangents, SHIFT_TOLERANCE, KRYLOV_BLOCKS_LIMIT)
        paired = combine(mu, H.T)
        stiffness[:, :, : len(H)] += paired
        mass[:, :, : len(H)] += block.omega**2 * paired
        source = block.columns[kept]
        if block.group is frame_loads:
            frame[:, :, source] += mu
        elif block.group is None:
            mass[:, :, source] += mu
            by_interior, by_outboard = arm.restrict(arm.mass_times(mu))
            interior[:, source] += by_interior
            outboard[:, source] += by_outboard
    return AdjointFields(combine(stiffness, turn), combine(mass, turn), frame)


_Group = Callable[[FreeArm], Rows]


@dataclass(frozen=True, eq=False)
class _Block:
    """Columns of K_w^-1 f and what became of them."""

    omega: float  # shift, rad/s
    group: _Group | None  # the inputs f, or None for f = M V
    columns: np.ndarray  # (k,) which of the inputs, or of V
    expansion: Expansion  # of K_w^-1 f in V, its new columns included


@dataclass(frozen=True, eq=False)
class _Recursion:
    """M-orthonormal V (n_nodes, d, q), M V, and the blocks that made them, in their order."""

    free: FreeArm
    V: np.ndarray
    MV: np.ndarray
    blocks: list[_Block]


def _recursion(arm: ElasticArm, options: Options) -> _Recursion:
    """Build exactly q columns."""
    free = FreeArm(arm)
    V = MV = np.empty((*arm.points.shape, 0))
    blocks: list[_Block] = []
    omegas = [2.0 * np.pi * shift for shift in options.shifts]
    chains: list[tuple[float, _Group | None, np.ndarray]] = [
        (omega, group, np.arange(columns))
        for group, columns in (
            (interface_loads, len(free.corner)),
            (frame_loads, 3 if arm.mesh.dim == 2 else 6),
        )
        for omega in omegas
    ]
    while V.shape[2] < options.coordinates:
        if not chains:
            raise ConvergenceError(
                f"arm {arm.mesh.name!r}: only {V.shape[2]} of {options.coordinates} Krylov vectors "
                "are independent; ask for fewer reduction.coordinates or move reduction.shifts"
            )
        longer: list[tuple[float, _Group | None, np.ndarray]] = []
        for omega, group, columns in chains:
            first = V.shape[2]
            while len(columns) and V.shape[2] < options.coordinates:
                # No more than are missing; further ones where some of them are dependent.
                now, columns = np.split(columns, [options.coordinates - V.shape[2]])
                right = group(free) if group else arm.restrict(MV)
                right = right[0][:, now], right[1][:, now]
                raw = solve_at(free, omega, right, SHIFT_TOLERANCE, KRYLOV_BLOCKS_LIMIT)
                new = orthonormalise(arm, raw, V, MV)
                blocks.append(_Block(omega, group, now, new))
                V, MV = np.concatenate([V, new.Q], axis=2), np.concatenate([MV, new.MQ], axis=2)
            if V.shape[2] > first:
                longer.append((omega, None, np.arange(first, V.shape[2])))
        chains = longer
    return _Recursion(free, V, MV, blocks)
