"""Displacement of a body along its modes, second order included: what its own inertia sees.

A body with geometric stiffness deforms by Phi q + psi(q), psi being of second order. Along the
modes that is z with M z = int rho Phi . (Phi q + psi); by reciprocity the second-order part is that
of the inertia M Phi_k as a load:

    z = q - 1/2 q' L q,   L_k = sum_l (M^-1)_kl K0_l,   dz/dq = J = 1 - L q.

The kinetic energy of the relative motion is 1/2 zd' M zd = 1/2 qd' J' M J qd: its mass J' M J is
definite for every deformation. With z = q it would be M, and the second order of the interface's
motion alone would make the mass of light coordinates negative. Forces by z become forces by q
through J'. Without L, as of bodies from files, z is q.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

Rates = tuple[np.ndarray, np.ndarray, np.ndarray]  # q, qd, qdd


class ModalDisplacement:
    """z and its rates at n instants.

    Attributes:
        L: (q, q, q) L_k, symmetric; None for z = q.
        q, qd, qdd: (n, q) coordinates and their rates.
        z, zd, zdd: (n, q).
    """

    def __init__(self, L: np.ndarray | None, rates: Rates) -> None:
        """Take the coordinates and their rates."""
        self.L = L
        self.q, self.qd, self.qdd = self.z, self.zd, self.zdd = rates
        if L is None:
            return
        q, qd, _ = self._bent
        self.z = rates[0] - 0.5 * product(q, rates[0])
        self.zd = rates[1] - product(q, rates[1])
        self.zdd = rates[2] - product(q, rates[2]) - product(qd, rates[1])

    @cached_property
    def _bent(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """L_k times q, qd and qdd (n, q, q), k first."""
        assert self.L is not None
        size = len(self.L)
        flat = self.L.reshape(size * size, size).T
        q, qd, qdd = ((x @ flat).reshape(-1, size, size) for x in (self.q, self.qd, self.qdd))
        return q, qd, qdd

    def pulled(self, x: np.ndarray) -> np.ndarray:
        """Return J' x: forces by z as forces by q, (n, q) or (n, m, q); x itself if z is q."""
        if self.L is None:
            return x
        return x - self._transposed(x, 0)

    def pushed(self, x: np.ndarray) -> np.ndarray:
        """Return J x (n, q): what z changes by a change x of q."""
        return x if self.L is None else x - product(self._bent[0], x)

    def rate_by_q(self, x: np.ndarray) -> np.ndarray:
        """Return x . d(zd)/dq (n, q) or (n, m, q), where z is not q."""
        return -self._transposed(x, 1)

    def second_rate_by_q(self, x: np.ndarray) -> np.ndarray:
        """Return x . d(zdd)/dq; by qd it is twice `rate_by_q`."""
        return -self._transposed(x, 2)

    @property
    def convective(self) -> np.ndarray:
        """What zdd has without qdd: -qd' L qd (n, q), where z is not q."""
        return -product(self._bent[1], self.qd)

    def _transposed(self, x: np.ndarray, rate: int) -> np.ndarray:
        """Return x_k L_k times q, qd or qdd."""
        bent = self._bent[rate]
        found: np.ndarray = x @ bent if x.ndim == 3 else (x[:, None] @ bent)[:, 0]
        return found

    def tangent(
        self, inertia: np.ndarray, M: np.ndarray, by_z: np.ndarray, by_zd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return how J' times inertia depends on q, qd, qdd, less what it does for z = q.

        Args:
            inertia: (n, q) forces by z.
            M: (q, q) their derivative by zdd.
            by_z, by_zd: (n, q, q) their derivatives by z and zd.

        Returns:
            Three (n, q, q).
        """
        assert self.L is not None
        q, qd, qdd = self._bent
        J = np.eye(len(M)) - q
        left, size = J.swapaxes(1, 2), len(M)
        geometric = (inertia @ self.L.reshape(size, -1)).reshape(-1, size, size)
        by_q = left @ (by_z @ J - by_zd @ qd - M @ qdd) - geometric - by_z
        by_qd = left @ (by_zd @ J - 2.0 * (M @ qd)) - by_zd
        return by_q, by_qd, left @ M @ J - M

    def gradient(self, by: Rates, forces: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Return the derivative of a virtual work by L (q, q, q).

        Args:
            by: its derivatives by z, zd and zdd (n, q).
            forces: (n, q) by z, which `pulled` brought to the rows.
            multipliers: (n, q) of the rows.
        """
        assert self.L is not None
        size, (z, zd, zdd) = len(self.L), by
        pairs = (
            (0.5 * z, self.q, self.q),
            (zd, self.q, self.qd),
            (zdd, self.q, self.qdd),
            (zdd, self.qd, self.qd),
            (forces, self.q, multipliers),
        )
        by_L = np.zeros((size, size, size))
        for weight, left, right in pairs:
            outer = (left[:, :, None] * right[:, None]).reshape(len(left), -1)
            by_L -= (weight.T @ outer).reshape(by_L.shape)
        return by_L


def product(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return A x (n, q) at every instant of matrices (n, q, q)."""
    found: np.ndarray = (A @ x[:, :, None])[:, :, 0]
    return found
