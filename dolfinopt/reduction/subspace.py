"""Subspaces orthonormal in the mass matrix: block Gram-Schmidt, block Arnoldi, Ritz vectors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.assembly import combine
from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.parallel import on_root
from dolfinopt.reduction.basis import Basis, FreeArm, Rows, orient
from dolfinopt.reduction.measured import (
    DEFLATION_SHARE,
    INDEPENDENT_ENERGY_RATIO,
    ORTHONORMAL_ROUNDS_LIMIT,
    ORTHONORMALITY_ERROR,
    ROUNDING_LENGTH_SHARE,
)


def dot(arm: ElasticArm, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return left . right (k, l), summed over the ranks, one of them a product with K or M."""
    rows = left.shape[0] * left.shape[1]
    return total(arm, left.reshape(rows, left.shape[2]).T @ right.reshape(rows, right.shape[2]))


def total(arm: ElasticArm, part: Any) -> Any:
    """Return the sum over the arm's ranks; without the detour through MPI on a single one."""
    return part if arm.comm.size == 1 else arm.comm.allreduce(part)


@dataclass(frozen=True, eq=False)
class Expansion:
    """W[kept] = [V, Q] coefficients; what is not kept lies in the span of V and Q.

    Attributes:
        Q, MQ: (n_nodes, d, k) new columns, M-orthonormal and M-orthogonal to V; M times them.
        coefficients: (columns of V + k, columns of W).
        kept: (k,) the columns of W that were independent.
    """

    Q: np.ndarray
    MQ: np.ndarray
    coefficients: np.ndarray
    kept: np.ndarray


def orthonormalise(
    arm: ElasticArm,
    W: np.ndarray,
    V: np.ndarray,
    MV: np.ndarray,
    deflation: float = DEFLATION_SHARE,
) -> Expansion:
    """Orthonormalise the columns of W against V and one another in the inner product of M.

    Block Gram-Schmidt in two rounds, and more where the check at its end asks for them.
    Source: Giraud et al., Numer. Math. 101 (2005) 87-100, doi:10.1007/s00211-005-0615-4.

    Args:
        arm: with its design set.
        W: (n_nodes, d, k).
        V, MV: (n_nodes, d, r) M-orthonormal, and M V.
        deflation: share of a column's length below which its remainder is dropped.

    Raises:
        ConvergenceError: the columns do not become orthonormal.
    """
    size = np.sqrt(np.maximum(np.diag(dot(arm, W, arm.mass_times(W))), 0.0))
    by_V = dot(arm, MV, W)
    Q, R, kept = _qr(arm, W - combine(V, by_V), deflation * size)
    if len(kept) == 0:
        return Expansion(Q, Q, by_V, kept)
    for _ in range(ORTHONORMAL_ROUNDS_LIMIT):
        # Differences of nearly equal fields have lost the rigid motion of the interface.
        Q = arm.expand(_interior(arm, Q), interface_coordinates(arm, Q))
        h = dot(arm, MV, Q)
        Q, again, still = _qr(arm, Q - combine(V, h), np.full(len(kept), ROUNDING_LENGTH_SHARE))
        by_V, R, kept = by_V + h @ R, again @ R, kept[still]
        MQ = arm.mass_times(Q)
        overlap = dot(arm, MQ, np.concatenate([V, Q], axis=2))
        goal = np.eye(V.shape[2] + len(kept))[V.shape[2] :]
        if np.abs(overlap - goal).max(initial=0.0) <= ORTHONORMALITY_ERROR:
            return Expansion(Q, MQ, np.vstack([by_V, R]), kept)
    raise ConvergenceError(
        f"arm {arm.mesh.name!r}: the vectors of the reduction do not become orthonormal; ask for "
        "fewer reduction.coordinates or raise interpolation.floor"
    )


def _qr(
    arm: ElasticArm, W: np.ndarray, least: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Q, R, kept with W[kept] = Q R[kept]; remainders up to `least` are dropped."""
    n_nodes, dim, k = W.shape
    columns = np.ascontiguousarray(W.reshape(dim * n_nodes, k).T)
    Q, MQ = np.empty_like(columns), np.empty_like(columns)
    R, kept = np.zeros((k, k)), list[int]()
    for j, w in enumerate(columns):
        n = len(kept)
        for _ in range(2):
            h = total(arm, MQ[:n] @ w)
            w -= h @ Q[:n]
            R[:n, j] += h
        Mw = arm.mass_times(w.reshape(n_nodes, dim, 1)).ravel()
        length = np.sqrt(max(total(arm, w @ Mw), 0.0))
        if length <= least[j]:
            continue
        Q[n], MQ[n], R[n, j] = w / length, Mw / length, length
        kept.append(j)
    n = len(kept)
    fields = np.ascontiguousarray(Q[:n].T).reshape(n_nodes, dim, n)
    return fields, R[:n], np.array(kept, dtype=int)


class InverseSpace:
    """Block Krylov space of K^-1 M from given fields, grown by block Arnoldi.

    K^-1 M V_j = V H_j, V' M V = I: with it (K - w^2 M) z = b is a small problem for any w.

    Attributes:
        V, MV: (n_nodes, d, r) with the newest block last.
        H: (r, columns that K^-1 M was applied to).
        start: (r_0, k) coefficients of the first fields in the first r_0 columns.
    """

    def __init__(self, free: FreeArm, first: np.ndarray, deflation: float):
        """Begin with the fields `first` (n_nodes, d, k)."""
        self.free, self.deflation = free, deflation
        none = np.empty((*first.shape[:2], 0))
        expansion = orthonormalise(free.arm, first, none, none, deflation)
        self.V, self.MV, self.start = expansion.Q, expansion.MQ, expansion.coefficients
        self.H = np.empty((self.V.shape[2], 0))

    def extend(self) -> None:
        """Apply K^-1 M to the newest block; nothing happens once the space is invariant."""
        done = self.H.shape[1]
        if done == self.V.shape[2]:
            return
        W = self.free.solve(self.free.arm.restrict(self.MV[:, :, done:]))
        new = orthonormalise(self.free.arm, W, self.V, self.MV, self.deflation)
        self.V = np.concatenate([self.V, new.Q], axis=2)
        self.MV = np.concatenate([self.MV, new.MQ], axis=2)
        H = np.zeros((self.V.shape[2], done + W.shape[2]))
        H[: len(self.H), :done] = self.H
        H[:, done:] = new.coefficients
        self.H = H


def ritz(arm: ElasticArm, V: np.ndarray) -> Basis:
    """Return the basis of Ritz vectors of span V: K_r y = lambda M_r y, ascending.

    M-orthonormal, with diagonal stiffness; they depend on the span alone, and are made to point
    the same way on any mesh.

    Args:
        arm: with its design set.
        V: (n_nodes, d, q) within the range of T.

    Raises:
        ConvergenceError: the columns of V are dependent.
    """
    energy, mass = arm.energy_matrix(V), dot(arm, V, arm.mass_times(V))
    dependent = ConvergenceError(
        f"arm {arm.mesh.name!r}: the vectors of the reduction are dependent; ask for fewer "
        "reduction.coordinates or raise interpolation.floor"
    )

    def solved() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        length = np.sqrt(np.diag(energy))
        try:
            shares = np.linalg.eigvalsh(energy / np.outer(length, length))
            if not shares[0] > INDEPENDENT_ENERGY_RATIO * shares[-1]:  # not a number included
                raise dependent
            inverse = np.linalg.inv(np.linalg.cholesky(energy))
        except np.linalg.LinAlgError:
            raise dependent from None
        # The lowest frequencies are the largest of these, which keep all their digits.
        mu, y = np.linalg.eigh(inverse @ (0.5 * (mass + mass.T)) @ inverse.T)
        if not mu[0] > 0.0:  # not a number included
            raise dependent
        return inverse, mu, y

    inverse, mu, y = on_root(arm.comm, solved)
    y = (inverse.T @ y[:, ::-1]) / np.sqrt(mu[::-1])
    # Stiffnesses differ by up to ten powers of ten, and y are as far from orthonormal as that.
    none = np.empty((*V.shape[:2], 0))
    V = orthonormalise(arm, combine(V, y), none, none).Q
    outboard = interface_coordinates(arm, V)
    V = arm.expand(_interior(arm, V), outboard)
    MV = arm.mass_times(V)
    sign = orient(arm, V, MV)
    stiffness = np.diag(np.diag(arm.energy_matrix(V)))
    start = np.empty((arm.num_interior, 0))
    return Basis(V * sign, MV * sign, stiffness, outboard * sign, start)


def _interior(arm: ElasticArm, field: np.ndarray) -> np.ndarray:
    """Return the owned interior rows (num_interior, k) of nodal fields."""
    return field[arm.interior_nodes].reshape(arm.num_interior, field.shape[2])


def interface_coordinates(arm: ElasticArm, field: np.ndarray) -> np.ndarray:
    """Return the coordinates (b, k) of the outboard interface in nodal fields that keep it rigid.

    Args:
        arm: the field's.
        field: (n_nodes, d, k).
    """
    rigid = arm.rigid[arm.outboard].reshape(-1, arm.rigid.shape[2])
    moved = field[arm.outboard].reshape(len(rigid), field.shape[2])
    # A node that several ranks know counts several times: the fit is exact all the same.
    normal, right = arm.comm.allreduce(rigid.T @ rigid), arm.comm.allreduce(rigid.T @ moved)
    return np.linalg.solve(normal, right)


def solve_at(free: FreeArm, omega: float, right: Rows, tolerance: float, most: int) -> np.ndarray:
    """Solve (T'KT - omega^2 T'MT) z = right for all columns at once; a field (n_nodes, d, k).

    Block GMRES preconditioned with the factor of K at hand, in the inner product of M. Above the
    first natural frequency K - omega^2 M is indefinite, but the preconditioned eigenvalues
    1 - omega^2 / lambda cluster at 1: at 1.1, 4, 13 and 43 times the first frequency each column
    takes 5, 6, 8 and 10 solves. A factor LDL' of the interior of K - omega^2 M would be dearer, and
    its constraint modes are infinite at the natural frequencies of the arm held at both ends.

    Args:
        free: the arm with its factor.
        omega: rad/s; 0 needs one solve.
        right: see `FreeArm.solve`.
        tolerance: of the residual, relative, after multiplication by K^-1, norm of M.
        most: steps.

    Raises:
        ConvergenceError: omega is too close to a natural frequency.
    """
    first = free.solve(right)
    if omega == 0.0:
        return first
    space = InverseSpace(free, first, 1e-13)
    for _ in range(most):
        space.extend()
        rows, columns = space.H.shape
        operator = np.eye(rows, columns) - omega**2 * space.H
        goal = np.zeros((rows, first.shape[2]))
        goal[: len(space.start)] = space.start
        y = np.linalg.lstsq(operator, goal, rcond=None)[0]
        residual = np.linalg.norm(operator @ y - goal, axis=0)
        if (residual <= tolerance * np.linalg.norm(goal, axis=0)).all():
            return combine(space.V[:, :, :columns], y)
        if rows == columns:
            break
    raise ConvergenceError(
        f"arm {free.arm.mesh.name!r}: the response at {omega / (2.0 * np.pi):g} Hz does not "
        "converge: too close to a natural frequency, or too far above the first ones; move or "
        "lower reduction.shifts"
    )
