"""The reduced basis of one arm, and what its methods share: the clamped-free arm, subspaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.assembly import combine
from dolfinopt.fem.elasticity import ElasticArm, Rows
from dolfinopt.fem.frames import by_rigid_motions, rigid_motions
from dolfinopt.fem.measured import ROUNDING_SHARE
from dolfinopt.parallel import on_root, total
from dolfinopt.reduction.measured import DEFLATION_SHARE, KRYLOV_BLOCKS_LIMIT, ROUNDING_LENGTH_SHARE


@dataclass(frozen=True)
class Options:
    """What a reduction method may be told.

    Attributes:
        coordinates: q, the columns of the basis.
        shifts: frequencies at which Krylov subspaces match moments, Hz.
        band: lowest and highest frequency of the Gramian, Hz.
        damping: beta in D = beta K, s; the Gramian's resonances depend on it.
    """

    coordinates: int
    shifts: tuple[float, ...] = (0.0,)
    band: tuple[float, float] = (0.0, 50.0)
    damping: float = 2e-4


@dataclass(frozen=True, eq=False)
class Basis:
    """u(X, t) = V(X) q(t) on one arm; q coordinates, d directions, b outboard coordinates.

    Attributes:
        V: (n_nodes, d, q) nodal values of the modes on this rank, ghosts included.
        MV: (n_nodes, d, q) mass matrix times V, contributions of this rank's cells.
        stiffness: (q, q) V' K V.
        outboard: (b, q) coordinates of the outboard interface in each mode.
        start: (interior dofs, k) eigenvectors, from which the next design's search starts.
    """

    V: np.ndarray
    MV: np.ndarray
    stiffness: np.ndarray
    outboard: np.ndarray
    start: np.ndarray


@dataclass(frozen=True, eq=False)
class AdjointFields:
    """Nodal fields that carry cotangents of V to the cells.

    d(cotangents . V) = sum_k -stiffness_k . dK V_k + mass_k . dM V_k + frame_k . dM R_k  with the
    rigid motions R of `frame_fields`.

    Attributes:
        stiffness, mass: (n_nodes, d, q).
        frame: (n_nodes, d, b), or None where the basis does not depend on M R.
    """

    stiffness: np.ndarray
    mass: np.ndarray
    frame: np.ndarray | None = None


def orient(arm: ElasticArm, V: np.ndarray, MV: np.ndarray) -> np.ndarray:
    """Return signs (k,) that make modes point the same way on any mesh and number of ranks.

    The sign is that of the mode's mass-weighted mean against a field without symmetry, so that
    neither symmetric nor antisymmetric modes give zero.
    """
    x = arm.points[:, 0] / arm.mesh.outboard_point[0]
    weight = np.stack([1.0 + x] * arm.mesh.dim, axis=1)
    if arm.mesh.dim == 3:  # torsion has no mean, bending in z and in y may have the same
        y, z = (arm.points[:, 1:] / arm.mesh.outboard_point[0]).T
        weight += np.stack([0.3 * z, -7.0 * z, 1.3 + 7.0 * y], axis=1)
    mean = total(arm.comm, np.einsum("ni,nik->k", weight, MV))
    return np.where(mean < 0.0, -1.0, 1.0)


def basis_of(
    arm: ElasticArm, rows: Rows, start: np.ndarray, held: np.ndarray | None = None
) -> Basis:
    """Return the basis of K-orthogonal modes, which point the same way on any mesh.

    Args:
        arm: with its design set.
        rows: of the modes, the constraint modes first where they are among them.
        start: eigenvectors among the last of them, see `Basis`.
        held: (b, b) stiffness of the constraint modes, whose signs stay.
    """
    arm.profile.counts.reductions += 1
    V = arm.expand(*rows)
    MV = arm.mass_times(V)
    b = 0 if held is None else len(held)
    energies = np.diag(arm.energy_matrix(V[:, :, b:]))
    sign, stiffness = orient(arm, V, MV), np.diag(np.append(np.zeros(b), energies))
    if held is not None:
        sign[:b], stiffness[:b, :b] = 1.0, held
    own = sign[len(sign) - start.shape[1] :]
    return Basis(V * sign, MV * sign, stiffness, rows[1] * sign, start * own)


# -- the inputs of the clamped-free arm, its outboard interface rigid --------------------------


# Of `frame_fields` among the rigid motions, by the number of directions.
FRAME_ORDER = {2: [1, 2, 0], 3: [1, 2, 5, 4, 3, 0]}


def interface_loads(arm: ElasticArm) -> Rows:
    """Return unit forces and moments (N, N m) at the outboard interface."""
    b = arm.rigid.shape[2]
    return np.zeros((arm.num_interior, b)), np.eye(b)


def frame_loads(arm: ElasticArm) -> Rows:
    """Return M times `frame_fields`: inertia loads of unit accelerations of the frame."""
    return arm.restrict(arm.mass_times(frame_fields(arm)))


def frame_fields(arm: ElasticArm) -> np.ndarray:
    """Return the rigid motions [1_y, S X, 1_x] of the frame (n_nodes, d, b).

    Transverse ones first: they bend the arm. In space 1_y, 1_z, e_z x X, e_y x X, e_x x X, 1_x.
    """
    order = FRAME_ORDER[arm.mesh.dim]
    return np.ascontiguousarray(rigid_motions(arm.points)[:, :, order])


def by_frame_fields(by: np.ndarray) -> np.ndarray:
    """Return the derivatives (n_nodes, d) by the nodes, given those by `frame_fields`."""
    return by_rigid_motions(by[:, :, np.argsort(FRAME_ORDER[by.shape[1]])])


# -- subspaces orthonormal in the mass matrix: block Gram-Schmidt, block Arnoldi, Ritz vectors -


def dot(arm: ElasticArm, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return left . right (k, l), summed over the ranks, one of them a product with K or M."""
    rows = left.shape[0] * left.shape[1]
    return np.asarray(
        total(arm.comm, left.reshape(rows, left.shape[2]).T @ right.reshape(rows, right.shape[2]))
    )


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

    Block Gram-Schmidt in two rounds, up to four where the check at its end asks for them.
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
    for _ in range(4):
        # Differences of nearly equal fields have lost the rigid motion of the interface.
        Q = arm.expand(interior_rows(arm, Q), arm.coordinates(Q))
        h = dot(arm, MV, Q)
        Q, again, still = _qr(arm, Q - combine(V, h), np.full(len(kept), ROUNDING_LENGTH_SHARE))
        by_V, R, kept = by_V + h @ R, again @ R, kept[still]
        MQ = arm.mass_times(Q)
        overlap = dot(arm, MQ, np.concatenate([V, Q], axis=2))
        goal = np.eye(V.shape[2] + len(kept))[V.shape[2] :]
        if np.abs(overlap - goal).max(initial=0.0) <= ROUNDING_SHARE:
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
            h = total(arm.comm, MQ[:n] @ w)
            w -= h @ Q[:n]
            R[:n, j] += h
        Mw = arm.mass_times(w.reshape(n_nodes, dim, 1)).ravel()
        length = np.sqrt(max(total(arm.comm, w @ Mw), 0.0))
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

    def __init__(self, arm: ElasticArm, first: np.ndarray):
        """Begin with the fields `first` (n_nodes, d, k)."""
        self.arm = arm
        none = np.empty((*first.shape[:2], 0))
        expansion = orthonormalise(arm, first, none, none, ROUNDING_SHARE)
        self.V, self.MV, self.start = expansion.Q, expansion.MQ, expansion.coefficients
        self.H = np.empty((self.V.shape[2], 0))

    def extend(self) -> None:
        """Apply K^-1 M to the newest block; nothing happens once the space is invariant."""
        done = self.H.shape[1]
        if done == self.V.shape[2]:
            return
        W = self.arm.static_response(*self.arm.restrict(self.MV[:, :, done:]))
        new = orthonormalise(self.arm, W, self.V, self.MV, ROUNDING_SHARE)
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
            if not shares[0] > ROUNDING_SHARE * shares[-1]:  # not a number included
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
    rows = interior_rows(arm, V), arm.coordinates(V)
    return basis_of(arm, rows, np.empty((arm.num_interior, 0)))


def interior_rows(arm: ElasticArm, field: np.ndarray) -> np.ndarray:
    """Return the owned interior rows (num_interior, k) of nodal fields."""
    return field[arm.interior_nodes].reshape(arm.num_interior, field.shape[2])


def solve_at(arm: ElasticArm, omega: float, right: Rows) -> np.ndarray:
    """Solve (T'KT - omega^2 T'MT) z = right for all columns at once; a field (n_nodes, d, k).

    Block GMRES preconditioned with the factor of K at hand, in the inner product of M. Above the
    first natural frequency K - omega^2 M is indefinite, but the preconditioned eigenvalues
    1 - omega^2 / lambda cluster at 1: at 1.1, 4, 13 and 43 times the first frequency each column
    takes 5, 6, 8 and 10 solves. A factor LDL' of the interior of K - omega^2 M would be dearer, and
    its constraint modes are infinite at the natural frequencies of the arm held at both ends.

    Residuals are relative, after multiplication by K^-1, in the norm of M.

    Args:
        arm: with its design set.
        omega: rad/s; 0 needs one solve.
        right: loads of interior and outboard rows.

    Raises:
        ConvergenceError: omega is too close to a natural frequency.
    """
    first = arm.static_response(*right)
    if omega == 0.0:
        return first
    space = InverseSpace(arm, first)
    for _ in range(KRYLOV_BLOCKS_LIMIT):
        space.extend()
        rows, columns = space.H.shape
        operator = np.eye(rows, columns) - omega**2 * space.H
        goal = np.zeros((rows, first.shape[2]))
        goal[: len(space.start)] = space.start
        y = np.linalg.lstsq(operator, goal, rcond=None)[0]
        residual = np.linalg.norm(operator @ y - goal, axis=0)
        if (residual <= ROUNDING_SHARE * np.linalg.norm(goal, axis=0)).all():
            return combine(space.V[:, :, :columns], y)
        if rows == columns:
            break
    raise ConvergenceError(
        f"arm {arm.mesh.name!r}: the response at {omega / (2.0 * np.pi):g} Hz does not "
        "converge: too close to a natural frequency, or too far above the first ones; move or "
        "lower reduction.frequencies"
    )
