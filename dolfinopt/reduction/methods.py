"""Reductions: functions from an arm and options to a basis, with an adjoint where there is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.assembly import combine
from dolfinopt.fem.elasticity import ElasticArm, Rows
from dolfinopt.parallel import on_root, total
from dolfinopt.reduction.basis import (
    AdjointFields,
    Basis,
    Expansion,
    InverseSpace,
    Options,
    basis_of,
    dot,
    frame_fields,
    frame_loads,
    interface_loads,
    interior_rows,
    orthonormalise,
    ritz,
    solve_at,
)
from dolfinopt.reduction.eigenproblem import Pencil, complement_solve, lowest_eigenpairs
from dolfinopt.reduction.measured import (
    DEFLATION_SHARE,
    KRYLOV_BLOCKS_LIMIT,
)

# -- by modes: Craig-Bampton (constraint and fixed-interface modes), modes of a free arm ----------
#
# Source: Craig & Bampton, AIAA J. 6 (1968) 1313-1319, doi:10.2514/3.4741.


def craig_bampton(arm: ElasticArm, options: Options, start: np.ndarray | None = None) -> Basis:
    """Reduce to b constraint modes and q - b fixed-interface normal modes; b is 3, in space 6.

    Psi = [-K_II^-1 K_Ib; I],  K_II Phi = M_II Phi diag(lambda). The stiffness is block diagonal:
    Psi' K Psi and diag(lambda).

    Args:
        arm: with its design set.
        options: coordinates q >= b; with q = b no eigenproblem is solved.
        start: `Basis.start` of a nearby design, or None.
    """
    static = arm.constraint_modes
    b = len(static.stiffness)
    normal = options.coordinates - b
    modes = np.empty((arm.num_interior, 0))
    if normal > 0:
        _, modes = lowest_eigenpairs(Pencil(arm), normal, start)
    outboard = np.hstack([np.eye(b), np.zeros((b, normal))])
    return basis_of(arm, (np.hstack([static.interior, modes]), outboard), modes, static.stiffness)


def craig_bampton_adjoint(
    arm: ElasticArm,
    basis: Basis,
    options: Options,
    cotangents: Rows,
) -> AdjointFields:
    """Return mu and lambda mu with d(cotangents . V) = -sum_k mu_k . (dK - lambda_k dM) V_k.

    Constraint modes: K_II mu = cotangents, one solve each with the factor at hand. Normal modes:
    see `complement_solve`. The outboard rows of V are constant.

    Args:
        arm, basis, options: of the current design.
        cotangents: (.., q) of the rows of V; those of the outboard ones have no effect here.
    """
    (interior, outboard), b = cotangents, len(basis.outboard)
    mu = arm.solve(interior[:, :b])
    values = np.concatenate([np.zeros(b), np.diag(basis.stiffness)[b:]])
    if interior.shape[1] > b:
        normal = complement_solve(Pencil(arm), basis.start, values[b:], interior[:, b:])
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
    pencil = Pencil(arm, is_free=True)
    _, vectors = lowest_eigenpairs(pencil, options.coordinates, start)
    return basis_of(arm, pencil.split(vectors), vectors)


def modal_adjoint(
    arm: ElasticArm,
    basis: Basis,
    options: Options,
    cotangents: Rows,
) -> AdjointFields:
    """Return mu and lambda mu with d(cotangents . V) = -sum_k mu_k . (dK - lambda_k dM) V_k.

    Args:
        arm, basis, options: of the current design.
        cotangents: (.., q) of the rows of V.
    """
    pencil, values = Pencil(arm, is_free=True), np.diag(basis.stiffness)
    right = pencil.joined(*cotangents)
    field = pencil.field(complement_solve(pencil, basis.start, values, right))
    return AdjointFields(field, field * values)


# -- second-order Krylov subspaces: moments of the full arm at given shifts are matched -----------
#
# Source: Bai & Su, SIAM J. Sci. Comput. 26 (2005) 1692-1709, doi:10.1137/040605552; inputs and
# outputs of elastic bodies as in Lehner & Eberhard, at-Automatisierungstechnik 54 (2006) 170-177.


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
    return ritz(arm, _recursion(arm, options)[0])


def krylov_adjoint(
    arm: ElasticArm,
    basis: Basis,
    options: Options,
    cotangents: Rows,
) -> AdjointFields:
    """Return the fields of `AdjointFields` for cotangents of V of a function of its span.

    Column by column backwards through V_new = (K_w^-1 f - V H_1) H_2^-1, f = M V_source or inputs:
    one solve each. What the columns do within their span has no influence and is left out; each
    block's source and predecessors are complete, so that nothing else is.

    Args:
        arm, basis, options: of the current design.
        cotangents: (.., q) of the rows of V.
    """
    (_, MV, blocks), (interior, outboard) = _recursion(arm, options), cotangents
    turn = dot(arm, MV, basis.V)  # basis.V = V turn, an orthogonal matrix
    # Within the span a trajectory that is right to its tolerance leaves cotangents that are not
    # quite zero, and the recursion would amplify them.
    inner = total(arm.comm, interior_rows(arm, basis.V).T @ interior)
    inner += basis.outboard.T @ outboard
    weighted = arm.restrict(basis.MV)
    interior = (interior - weighted[0] @ inner) @ turn.T
    outboard = (outboard - weighted[1] @ inner) @ turn.T
    stiffness, mass = np.zeros_like(basis.V), np.zeros_like(basis.V)
    frame = np.zeros_like(frame_fields(arm))
    for block in reversed(blocks):
        kept, H = block.expansion.kept, block.expansion.coefficients[:, block.expansion.kept]
        old, new = slice(0, len(H) - len(kept)), slice(len(H) - len(kept), len(H))
        inverse = np.linalg.inv(H[new])
        own = interior[:, new] @ inverse.T, outboard[:, new] @ inverse.T
        interior[:, old] -= own[0] @ H[old].T
        outboard[:, old] -= own[1] @ H[old].T
        mu = solve_at(arm, block.omega, own)
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


_Group = Callable[[ElasticArm], Rows]


@dataclass(frozen=True, eq=False)
class _Block:
    """Columns of K_w^-1 f and what became of them."""

    omega: float  # shift, rad/s
    group: _Group | None  # the inputs f, or None for f = M V
    columns: np.ndarray  # (k,) which of the inputs, or of V
    expansion: Expansion  # of K_w^-1 f in V, its new columns included


_Chain = tuple[float, _Group | None, np.ndarray]  # shift, inputs and which of them, see `_Block`


def _recursion(arm: ElasticArm, options: Options) -> tuple[np.ndarray, np.ndarray, list[_Block]]:
    """Return M-orthonormal V (n_nodes, d, q), M V, and the blocks that made them, in order."""
    V = MV = np.empty((*arm.points.shape, 0))
    blocks: list[_Block] = []
    omegas = [2.0 * np.pi * shift for shift in options.shifts]
    groups = interface_loads, frame_loads
    counts = arm.rigid.shape[2], 3 if arm.mesh.dim == 2 else 6
    chains: list[_Chain] = [
        (omega, group, np.arange(count))
        for group, count in zip(groups, counts, strict=True)
        for omega in omegas
    ]
    while V.shape[2] < options.coordinates:
        if not chains:
            raise ConvergenceError(
                f"arm {arm.mesh.name!r}: only {V.shape[2]} of {options.coordinates} Krylov vectors "
                "are independent; ask for fewer reduction.coordinates or move reduction.frequencies"
            )
        longer: list[_Chain] = []
        for omega, group, columns in chains:
            first = V.shape[2]
            while len(columns) and V.shape[2] < options.coordinates:
                # No more than are missing; further ones where some of them are dependent.
                now, columns = np.split(columns, [options.coordinates - V.shape[2]])
                right = group(arm) if group else arm.restrict(MV)
                right = right[0][:, now], right[1][:, now]
                new = orthonormalise(arm, solve_at(arm, omega, right), V, MV)
                blocks.append(_Block(omega, group, now, new))
                V, MV = np.concatenate([V, new.Q], axis=2), np.concatenate([MV, new.MQ], axis=2)
            if V.shape[2] > first:
                longer.append((omega, None, np.arange(first, V.shape[2])))
        chains = longer
    return V, MV, blocks


# -- by Gramians: the directions that inputs within a frequency band move most --------------------
#
# Source: Fehr, Fischer, Haasdonk & Eberhard, ZAMM 93 (2013) 501-519, doi:10.1002/zamm.201200014;
# Fehr & Eberhard, Multibody Syst. Dyn. 25 (2011) 313-334, doi:10.1007/s11044-010-9238-5.


def balanced(arm: ElasticArm, options: Options, start: np.ndarray | None = None) -> Basis:
    """Reduce to the q directions that dominate the frequency-weighted position Gramian.

    P = 1/(2 pi) int over the band of H(i w) H(i w)^* dw,  H(s) = (s^2 M + s D + K)^-1 B,  D = beta
    K, negative frequencies included. The inputs B are those of `krylov` in the arm's own units:
    accelerations a and a / length of its frame, and at the interface the loads m a and m a length
    of a body as heavy as the arm. Dominant are the largest eigenvalues of P K v = sigma v: no
    other q vectors leave less mean square strain energy of the responses.

    All responses come from one block Krylov space of K^-1 M with the factor of K at hand, grown
    until their residuals vanish; there the Gramian is an integral of scalar resonances. The basis
    of the dominant space are its Ritz vectors, M-orthonormal, by ascending frequency.

    Args:
        arm: with its design set.
        options: coordinates q, band, damping > 0.
        start: without effect; there is no large eigenproblem.

    Raises:
        ConvergenceError: no convergence in the band, or fewer than q directions in it.
    """
    first = arm.static_response(*_inputs(arm))
    space = InverseSpace(arm, first)
    low, high = (2.0 * np.pi * frequency for frequency in options.band)
    for _ in range(KRYLOV_BLOCKS_LIMIT):
        space.extend()
        reduced = _Reduced.of(space, options.damping)
        omega, weights = quadrature(low, high, reduced.theta, options.damping)
        responses = reduced.responses(omega)
        if reduced.residual(omega, responses) <= DEFLATION_SHARE:
            break
    else:
        raise ConvergenceError(
            f"arm {arm.mesh.name!r}: the responses up to {options.band[1]:g} Hz do not converge; "
            "lower reduction.frequencies"
        )
    factor = responses * np.sqrt(weights / np.pi)[:, None]
    factor = np.concatenate([factor.real, factor.imag], axis=1).reshape(len(factor), -1)
    # In coordinates in which K is the identity; triangular first, there are many more columns.
    V = space.V[:, :, : len(factor)]
    upper = np.linalg.cholesky(arm.energy_matrix(V)).T
    _, triangle = np.linalg.qr((upper @ reduced.vectors @ factor).T)
    U, sigma, _ = on_root(arm.comm, partial(np.linalg.svd, triangle.T, full_matrices=False))
    result = int((sigma > DEFLATION_SHARE * sigma[0]).sum())
    if result < options.coordinates:
        raise ConvergenceError(
            f"arm {arm.mesh.name!r}: responses between {options.band[0]:g} and "
            f"{options.band[1]:g} Hz have only {result} of {options.coordinates} directions; "
            "ask for fewer reduction.coordinates or widen reduction.frequencies"
        )
    return ritz(arm, combine(V, np.linalg.solve(upper, U[:, : options.coordinates])))


def _inputs(arm: ElasticArm) -> Rows:
    """Return the inputs (.., 2 b), all for the same unit of acceleration."""
    fields = frame_fields(arm)
    mass = dot(arm, fields, arm.mass_times(fields))[0, 0]  # of the arm
    length = float(np.linalg.norm(arm.mesh.outboard_point))
    loads, inertia = interface_loads(arm), frame_loads(arm)
    turns = [1.0, 1.0 / length, 1.0] if arm.mesh.dim == 2 else [1.0, 1.0, *(1.0 / length,) * 3, 1.0]
    shift = arm.mesh.dim
    by_load = mass * np.array([*(1.0,) * shift, *(length,) * (len(turns) - shift)])
    by_load = np.tile(by_load, arm.rigid.shape[2] // len(turns))
    by_frame = np.array(turns)
    return (
        np.hstack([loads[0] * by_load, inertia[0] * by_frame]),
        np.hstack([loads[1] * by_load, inertia[1] * by_frame]),
    )


@dataclass(frozen=True, eq=False)
class _Reduced:
    """K^-1 M in a Krylov space, diagonal: scalar resonances."""

    theta: np.ndarray  # (r,) eigenvalues, 1 / (natural frequency)^2, s2
    vectors: np.ndarray  # (r, r) eigenvectors in the space's columns
    inputs: np.ndarray  # (r, 6) coordinates of K^-1 B
    # (k, r) what K^-1 M makes of the eigenvectors outside the space; lengths are square roots of
    # energy
    beyond: np.ndarray
    damping: float  # beta, s

    @classmethod
    def of(cls, space: InverseSpace, damping: float) -> _Reduced:
        """Diagonalise the part of the space that K^-1 M was applied to."""
        r = space.H.shape[1]
        T = space.H[:r]
        theta, vectors = on_root(space.arm.comm, np.linalg.eigh, 0.5 * (T + T.T))
        theta = np.maximum(theta, np.finfo(float).eps * theta[-1])  # positive but for rounding
        inputs = vectors[: len(space.start)].T @ space.start
        beyond = space.H[r:] @ vectors
        if len(beyond):  # none where the space is invariant
            energy = space.arm.energy_matrix(space.V[:, :, r:])
            beyond = np.linalg.cholesky(energy).T @ beyond
        return cls(theta, vectors, inputs, beyond, damping)

    def responses(self, omega: np.ndarray) -> np.ndarray:
        """Return the coordinates (r, n, 6), complex, of H(i omega) at n frequencies, rad/s."""
        gain = 1.0 / (1.0 + 1j * self.damping * omega - np.outer(self.theta, omega**2))
        return gain[:, :, None] * self.inputs[:, None]

    def residual(self, omega: np.ndarray, responses: np.ndarray) -> float:
        """Return the largest residual over its response."""
        rest = np.tensordot(self.beyond, responses * omega[:, None] ** 2, axes=1)
        size = np.linalg.norm(responses / np.sqrt(self.theta)[:, None, None], axis=0)
        return float((np.linalg.norm(rest, axis=0) / size).max())


def quadrature(
    low: float, high: float, theta: np.ndarray, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (n,) in [low, high] rad/s and weights of an integral over resonances.

    Gauss-Legendre in panels that halve in length towards each resonance, down to its half-width
    beta omega^2 / 2.

    Args:
        low, high: rad/s.
        theta: (r,) 1 / (natural frequency)^2, s2.
        damping: beta > 0, s.
    """
    peaks = np.sort(1.0 / np.sqrt(theta))
    peaks = peaks[peaks < 2.0 * high]
    middles = 0.5 * (peaks[1:] + peaks[:-1])
    begins, ends = np.append(0.0, middles), np.append(middles, 3.0 * high)
    edges = [*np.linspace(low, high, 5)]
    for peak, begin, end in zip(peaks, begins, ends, strict=False):
        half = 0.25 * damping * peak**2
        count = max(int(np.ceil(np.log2(max(peak - begin, end - peak) / half))), 1)
        steps = half * 2.0 ** np.arange(count)
        near = np.concatenate([peak - steps, peak + steps])
        edges += [*near[(near > max(low, begin)) & (near < min(high, end))]]
    grid = np.unique(edges)
    nodes, weights = np.polynomial.legendre.leggauss(8)  # exact to degree 15
    half_lengths = 0.5 * np.diff(grid)[:, None]
    centres = 0.5 * (grid[1:] + grid[:-1])[:, None]
    return (centres + half_lengths * nodes).ravel(), (half_lengths * weights).ravel()


# -- all of them by name ------------------------------------------------------------------------


@dataclass(frozen=True)
class Method:
    """A reduction method.

    Attributes:
        reduce: (arm, options, start) -> basis.
        adjoint: (arm, basis, options, cotangents) -> fields, see `craig_bampton_adjoint`; None
            where there is none.
    """

    reduce: Callable[[ElasticArm, Options, np.ndarray | None], Basis]
    adjoint: Callable[[ElasticArm, Basis, Options, Rows], AdjointFields] | None


METHODS = {
    "craig-bampton": Method(craig_bampton, craig_bampton_adjoint),
    "modal": Method(modal, modal_adjoint),
    "krylov": Method(krylov, krylov_adjoint),
    "balanced": Method(balanced, None),
}
