"""The inertia shape integrals (standard input data) of one flexible arm in planar motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from dolfinopt.elasticity import ElasticArm
    from dolfinopt.reduction import Basis


@dataclass(frozen=True, eq=False)
class FloatingBody:
    """One arm reduced to q elastic coordinates in its tangent frame at the inboard joint.

    With reference positions X, modes Phi and S = [[0, -1], [1, 0]]; all integrals over the mass.
    Source: Wallrapp (1994), doi:10.1080/08905459408905214; Schwertassek & Wallrapp (1999).

    Attributes:
        mass: m, kg.
        moment: (2,) c = int X, kg m.
        inertia: J = int X . X, kg m2.
        C: (2, q) int Phi.
        j: (q,) int X . Phi_k.
        r: (q,) int (S X) . Phi_k.
        M: (q, q) int Phi_k . Phi_l.
        G: (q, q) int Phi_k . (S Phi_l), skew.
        K: (q, q) stiffness Phi' K Phi.
        D: (q, q) damping.
        outboard: (3, q) u_x, u_y, theta of the outboard interface in each mode.
        outboard_point: (2,) its reference position, m.
    """

    mass: float
    moment: np.ndarray
    inertia: float
    C: np.ndarray
    j: np.ndarray
    r: np.ndarray
    M: np.ndarray
    G: np.ndarray
    K: np.ndarray
    D: np.ndarray
    outboard: np.ndarray
    outboard_point: np.ndarray

    @property
    def coordinates(self) -> int:
        """Number q of elastic coordinates."""
        return len(self.K)


def floating_body(arm: ElasticArm, basis: Basis, stiffness_proportional: float) -> FloatingBody:
    """Integrate the body's inertia over its current design (collective on the arm's ranks).

    Args:
        arm: with its design set.
        basis: of that design.
        stiffness_proportional: beta in D = beta K, s.
    """
    V, MV = basis.V, basis.MV
    q = V.shape[2]
    X = arm.points
    SX = np.stack([-X[:, 1], X[:, 0]], axis=1)
    rigid = arm.mass_times(np.stack([np.ones_like(X), X], axis=2))  # M [1, X], per component
    ones, positions = rigid[:, :, 0], rigid[:, :, 1]
    flat = V.reshape(-1, q)
    rotated = np.stack([-V[:, 1], V[:, 0]], axis=1).reshape(-1, q)  # S Phi
    # One reduction for all integrals.
    parts = (
        ones[:, 0].sum(),
        positions.sum(axis=0),
        np.sum(X * positions),
        MV.sum(axis=0),
        np.einsum("ni,nik->k", X, MV),
        np.einsum("ni,nik->k", SX, MV),
        MV.reshape(-1, q).T @ flat,
        MV.reshape(-1, q).T @ rotated,
    )
    packed = np.concatenate([np.ravel(part) for part in parts])
    if arm.comm.size > 1:
        packed = arm.comm.allreduce(packed)
    splits = np.cumsum([np.size(part) for part in parts])[:-1]
    m, c, J, C, j, r, M, G = np.split(packed, splits)
    M, G = M.reshape(q, q), G.reshape(q, q)
    return FloatingBody(
        mass=float(m[0]),
        moment=c,
        inertia=float(J[0]),
        C=C.reshape(2, q),
        j=j,
        r=r,
        M=0.5 * (M + M.T),
        G=0.5 * (G - G.T),
        K=basis.stiffness,
        D=stiffness_proportional * basis.stiffness,
        outboard=basis.outboard,
        outboard_point=arm.mesh.outboard_point,
    )


def rigid_bar(length: float, height: float, thickness: float, density: float) -> FloatingBody:
    """Return a solid bar without elastic coordinates; m, kg/m3."""
    mass = density * length * height * thickness
    none, square = np.zeros(0), np.zeros((0, 0))
    return FloatingBody(
        mass=mass,
        moment=np.array([0.5 * mass * length, 0.0]),
        inertia=mass * (length**2 / 3.0 + height**2 / 12.0),
        C=np.zeros((2, 0)),
        j=none,
        r=none,
        M=square,
        G=square,
        K=square,
        D=square,
        outboard=np.zeros((3, 0)),
        outboard_point=np.array([length, 0.0]),
    )


def scaled(body: FloatingBody, mass: float, stiffness: float, damping: float) -> FloatingBody:
    """Return the body of a denser, stiffer material: all its integrals are linear in them.

    Args:
        body: reduced; its basis is that of the other material, too.
        mass, stiffness: factors.
        damping: beta in D = beta K of the result, s.
    """
    K = stiffness * body.K
    return replace(
        body,
        mass=mass * body.mass,
        moment=mass * body.moment,
        inertia=mass * body.inertia,
        C=mass * body.C,
        j=mass * body.j,
        r=mass * body.r,
        M=mass * body.M,
        G=mass * body.G,
        K=K,
        D=damping * K,
    )


def first_frequency(body: FloatingBody) -> float:
    """Return the lowest natural frequency of the reduced clamped-free body, Hz; inf if rigid."""
    if body.coordinates == 0:
        return float("inf")
    lower = np.linalg.cholesky(body.M)
    inverse = np.linalg.inv(lower)
    values = np.linalg.eigvalsh(inverse @ body.K @ inverse.T)
    return float(np.sqrt(max(values[0], 0.0)) / (2.0 * np.pi))
