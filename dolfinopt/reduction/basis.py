"""The reduced basis of one arm, and what its methods share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm


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
    """u(X, t) = V(X) q(t) on one arm; q coordinates.

    Attributes:
        V: (n_nodes, 2, q) nodal values of the modes on this rank, ghosts included.
        MV: (n_nodes, 2, q) mass matrix times V, contributions of this rank's cells.
        stiffness: (q, q) V' K V.
        outboard: (3, q) coordinates (u_x, u_y, theta) of the outboard interface in each mode.
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
        stiffness, mass: (n_nodes, 2, q).
        frame: (n_nodes, 2, 3), or None where the basis does not depend on M R.
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
    weight = np.stack([1.0 + x, 1.0 + x], axis=1)
    mean = arm.comm.allreduce(np.einsum("ni,nik->k", weight, MV))
    return np.where(mean < 0.0, -1.0, 1.0)
