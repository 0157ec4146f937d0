"""Gramian-based reduction: the directions that inputs within a frequency band move most.

Source: Fehr, Fischer, Haasdonk & Eberhard, ZAMM 93 (2013) 501-519, doi:10.1002/zamm.201200014;
Fehr & Eberhard, Multibody Syst. Dyn. 25 (2011) 313-334, doi:10.1007/s11044-010-9238-5.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.assembly import combine
from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.parallel import on_root
from dolfinopt.reduction.basis import (
    Basis,
    FreeArm,
    InverseSpace,
    Options,
    Rows,
    dot,
    frame_fields,
    frame_loads,
    interface_loads,
    ritz,
)
from dolfinopt.reduction.measured import (
    KRYLOV_BLOCKS_LIMIT,
    RESPONSE_DEFLATION_SHARE,
    RESPONSE_RANK_SHARE,
    RESPONSE_TOLERANCE,
)


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
    arm.profile.counts.reductions += 1
    free = FreeArm(arm)
    space = InverseSpace(free, free.solve(_inputs(free)), RESPONSE_DEFLATION_SHARE)
    low, high = (2.0 * np.pi * frequency for frequency in options.band)
    for _ in range(KRYLOV_BLOCKS_LIMIT):
        space.extend()
        reduced = _Reduced.of(space, options.damping)
        omega, weights = quadrature(low, high, reduced.theta, options.damping)
        responses = reduced.responses(omega)
        if reduced.residual(omega, responses) <= RESPONSE_TOLERANCE:
            break
    else:
        raise ConvergenceError(
            f"arm {arm.mesh.name!r}: the responses up to {options.band[1]:g} Hz do not converge; "
            "lower reduction.band"
        )
    factor = responses * np.sqrt(weights / np.pi)[:, None]
    factor = np.concatenate([factor.real, factor.imag], axis=1).reshape(len(factor), -1)
    # In coordinates in which K is the identity; triangular first, there are many more columns.
    V = space.V[:, :, : len(factor)]
    upper = np.linalg.cholesky(arm.energy_matrix(V)).T
    _, triangle = np.linalg.qr((upper @ reduced.vectors @ factor).T)
    U, sigma, _ = on_root(arm.comm, partial(np.linalg.svd, triangle.T, full_matrices=False))
    found = int((sigma > RESPONSE_RANK_SHARE * sigma[0]).sum())
    if found < options.coordinates:
        raise ConvergenceError(
            f"arm {arm.mesh.name!r}: responses between {options.band[0]:g} and "
            f"{options.band[1]:g} Hz have only {found} of {options.coordinates} directions; "
            "ask for fewer reduction.coordinates or widen reduction.band"
        )
    return ritz(arm, combine(V, np.linalg.solve(upper, U[:, : options.coordinates])))


def _inputs(free: FreeArm) -> Rows:
    """Return the inputs (.., 2 b), all for the same unit of acceleration."""
    arm = free.arm
    fields = frame_fields(arm)
    mass = dot(arm, fields, arm.mass_times(fields))[0, 0]  # of the arm
    length = float(np.linalg.norm(arm.mesh.outboard_point))
    loads, inertia = interface_loads(free), frame_loads(free)
    turns = [1.0, 1.0 / length, 1.0] if arm.mesh.dim == 2 else [1.0, 1.0, *(1.0 / length,) * 3, 1.0]
    shift = arm.mesh.dim
    by_load = mass * np.array([*(1.0,) * shift, *(length,) * (len(turns) - shift)])
    by_load = np.tile(by_load, len(free.corner) // len(turns))
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
        theta, vectors = on_root(space.free.arm.comm, np.linalg.eigh, 0.5 * (T + T.T))
        theta = np.maximum(theta, np.finfo(float).eps * theta[-1])  # positive but for rounding
        inputs = vectors[: len(space.start)].T @ space.start
        beyond = space.H[r:] @ vectors
        if len(beyond):  # none where the space is invariant
            energy = space.free.arm.energy_matrix(space.V[:, :, r:])
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
