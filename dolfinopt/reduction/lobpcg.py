"""The lowest modes where no factor is at hand: locally optimal block conjugate gradients.

Source: Knyazev, SIAM J. Sci. Comput. 23 (2001) 517-541, doi:10.1137/S1064827500366124; bases made
orthonormal as in Hetmaniuk & Lehoucq, J. Comput. Phys. 218 (2006) 324-332,
doi:10.1016/j.jcp.2006.02.007.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.parallel import on_root

Columns = Callable[[np.ndarray], np.ndarray]
GUARDS = 3  # vectors beyond those that are wanted: the last ones converge slowly
MAX_STEPS = 200
TOLERANCE = 1e-8  # of the vectors in energy
INDEPENDENT = 1e-12  # share of a direction's length, squared, below which it is the others'


@dataclass(frozen=True, eq=False)
class Operators:
    """What a search needs: products with columns (rows, k) of this rank.

    Attributes:
        rows: of this rank.
        stiffness, mass, precondition: K, M, and an approximation of K^-1.
        total: sum over the ranks.
        comm: the ranks that share the rows.
    """

    rows: int
    stiffness: Columns
    mass: Columns
    precondition: Columns
    total: Columns
    comm: MPI.Comm


def interior_operators(arm: ElasticArm) -> Operators:
    """Return those of the interior of an arm whose systems are solved iteratively."""
    arm.factorise()
    stiffness, cycle = arm.substructure.interior.multigrid(arm.K.matrix)
    return Operators(
        arm.num_interior,
        stiffness,
        lambda V: by_column(arm.interior_mass_times, V),
        cycle,
        lambda part: part if arm.comm.size == 1 else arm.comm.allreduce(part),
        arm.comm,
    )


def by_column(times: Columns, V: np.ndarray) -> np.ndarray:
    """Return the products of a matrix with the columns of V (rows, k), one after the other."""
    return np.column_stack([times(vector) for vector in V.T]) if V.shape[1] else V.copy()


def lowest_without_factor(
    arm: ElasticArm, operators: Operators, count: int, start: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lowest eigenvalues and vectors, None if that fails (collective).

    Args:
        arm: for its communicator.
        operators: of the interior, or of the clamped-free arm.
        count: number of eigenpairs.
        start: (rows, k) vectors of a nearby design, or None.
    """
    rows, size = operators.rows, count + GUARDS
    known = np.empty((rows, 0)) if start is None else start[:, :size]
    first = 0 if arm.comm.size == 1 else arm.comm.exscan(rows) or 0
    columns = 12.9898 + np.arange(size - known.shape[1])
    noise = np.sin(np.outer(np.arange(first + 1.0, first + rows + 1.0), columns))
    noise = np.modf(np.abs(noise) * 43758.5453)[0] - 0.5
    smooth = operators.precondition(operators.precondition(noise))
    found = lobpcg(operators, np.hstack([known, smooth]), count, TOLERANCE)
    return None if found is None else found[:2]


def lobpcg(
    operators: Operators, start: np.ndarray, count: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Return the lowest eigenvalues (count,), M-orthonormal vectors, and steps; None if it fails.

    A pair is found once its residual, in the norm of the preconditioner, is below the tolerance
    times the square root of its eigenvalue: about the error of the vector in energy.

    Args:
        operators: symmetric positive definite.
        start: (rows, m) independent vectors, m > count.
        count: number of eigenpairs.
        tolerance: relative.
    """
    m = start.shape[1]
    S = _products(operators, start)
    C, values = _ritz(operators, S)
    X, KX, MX = (part @ C[:, :m] for part in S)
    values, P = values[:m], [np.empty((len(start), 0))] * 3
    for step in range(MAX_STEPS):
        R = KX - MX * values
        W = operators.precondition(R)
        size = operators.total(np.einsum("nk,nk->k", R, W))
        if not np.isfinite(size).all():
            return None
        if (np.sqrt(np.maximum(size, 0.0)) <= tolerance * np.sqrt(values))[:count].all():
            return values[:count], X[:, :count], step
        W -= X @ operators.total(MX.T @ W)
        new = _products(operators, W)
        S = [np.concatenate(parts, axis=1) for parts in zip((X, KX, MX), new, P, strict=True)]
        C, values = _ritz(operators, S)
        C, values = C[:, :m], values[:m]
        # The next directions: what the new vectors have of the last residuals and directions.
        P = [part[:, m:] @ C[m:] for part in S]
        X = S[0] @ C
        _, KX, MX = _products(operators, X)  # combined ones drift by rounding
    return None


def _products(operators: Operators, V: np.ndarray) -> list[np.ndarray]:
    """Return V, K V, M V."""
    return [V, operators.stiffness(V), operators.mass(V)]


def _ritz(operators: Operators, space: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients of all Ritz vectors of S, given S, K S and M S, and their values."""
    S, KS, MS = space
    k = S.shape[1]
    both = operators.total(S.T @ np.concatenate([KS, MS], axis=1))
    K, M = 0.5 * (both[:, :k] + both[:, :k].T), 0.5 * (both[:, k:] + both[:, k:].T)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(M), np.finfo(float).tiny))

    def solved() -> tuple[np.ndarray, np.ndarray]:
        lengths, basis = np.linalg.eigh(M * np.outer(scale, scale))
        kept = lengths > INDEPENDENT * lengths[-1]
        T = (scale[:, None] * basis[:, kept]) / np.sqrt(lengths[kept])
        values, vectors = np.linalg.eigh(T.T @ K @ T)
        return T @ vectors, values

    # One rank decides how many vectors are independent, and when the search ends.
    found: tuple[np.ndarray, np.ndarray] = on_root(operators.comm, solved)
    return found
