"""What spatial codes ask for beyond a plane body's integrals: those of a plate of its thickness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.multibody.shape_integrals import ShapeIntegrals

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm
    from dolfinopt.reduction import Basis


@dataclass(frozen=True, eq=False)
class SpatialMoments:
    """Integrals over the mass of a plate of constant thickness about its middle plane z = 0.

    Attributes:
        second: (2, 2) int X X', kg m2.
        depth: int z^2, kg m2.
        first: (2, 2, q) int X_i Phi_jk.
        mixed: (2, 2, q, q) int Phi_ik Phi_jl.
    """

    second: np.ndarray
    depth: float
    first: np.ndarray
    mixed: np.ndarray


def spatial_moments(arm: ElasticArm, basis: Basis, thickness: float) -> SpatialMoments:
    """Integrate over the arm's current design (collective on the arm's ranks).

    Args:
        arm: with its design set.
        basis: of that design.
        thickness: t, m; int z^2 = m t^2 / 12.
    """
    X, V, MV = arm.points, basis.V, basis.MV
    q = V.shape[2]
    rigid = arm.rigid_inertia
    # The mass matrix treats x and y alike: its product with (x, y) has M x and M y as components.
    parts = (
        rigid[:, 0, 0].sum(),
        np.einsum("ni,nj->ij", X, rigid[:, :, 1]),
        np.einsum("ni,njk->ijk", X, MV),
        np.einsum("nik,njl->ijkl", V, MV),
    )
    packed = np.concatenate([np.ravel(part) for part in parts])
    if arm.comm.size > 1:
        packed = arm.comm.allreduce(packed)
    mass, second, first, mixed = np.split(packed, np.cumsum([1, 4, 4 * q]))
    return SpatialMoments(
        second=second.reshape(2, 2),
        depth=float(mass[0]) * thickness**2 / 12.0,
        first=first.reshape(2, 2, q),
        mixed=mixed.reshape(2, 2, q, q),
    )


def slender_moments(body: ShapeIntegrals) -> SpatialMoments:
    """Return a guess from the planar integrals alone: all mass on the x axis, moving across it.

    int y^2 = int z^2 = int y Phi = int Phi_x Phi_x = 0, the rest as the planar integrals have it:
    the same motion in the plane, and out of it that of a thin bar.
    """
    q = body.num_modes
    first, mixed = np.zeros((2, 2, q)), np.zeros((2, 2, q, q))
    first[0, 0], first[0, 1] = body.j, body.r
    mixed[1, 1] = body.M
    mixed[0, 1], mixed[1, 0] = -0.5 * body.G, 0.5 * body.G
    return SpatialMoments(np.diag([body.inertia, 0.0]), 0.0, first, mixed)
