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
    mean = arm.comm.allreduce(np.einsum("ni,nik->k", weight, MV))
    return np.where(mean < 0.0, -1.0, 1.0)
