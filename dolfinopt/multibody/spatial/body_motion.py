"""One body that moves and deforms: its inertia force and elastic rows, and their derivatives.

The position of a point is p = N eta, see `shape_integrals`; its acceleration in the components of
the body's frame is a + A p + 2 Omega p' + p'' with A = wd~ + w~ w~, Omega = w~. So
    F = m a + A s + 2 Omega s' + s'',
    T = s x a + axial(G A' + 2 H Omega' + I),
    f = a . C + A_ab W_ab eta + 2 Omega_ab W_ab eta' + W_aa eta'' + K e + D e'
with s = w eta, G_ab = int p_a p_b, H_ab = int p_a p'_b, I_ab = int p_a p''_b. Geometric stiffness
K0 of the accelerations a and A_ab takes 1/2 e'K0 e from s and from int p_a X_b, and K0 e from
their derivatives C and W_ab eta by e. In products of the modes with each other the place of e is
taken by z, see `modal_displacement`. Loads are stacked (F, T), motions (a, w, wd).
Source: Schwertassek & Wallrapp (1999); Wallrapp & Schwertassek (1991),
doi:10.1002/nme.1620320818.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from dolfinopt.multibody.modal_displacement import ModalDisplacement, Rates
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.mechanism import TRANSPOSED, Constants
from dolfinopt.multibody.spatial.rotations import ONE, axial, cross, skew, times

PERMUTATION = np.zeros((3, 3, 3))  # e_cab
for _c in range(3):
    _a, _b = (_c + 1) % 3, (_c + 2) % 3
    PERMUTATION[_c, _a, _b], PERMUTATION[_c, _b, _a] = 1.0, -1.0
AXIAL = PERMUTATION.reshape(3, 9)  # of matrices as nine numbers
DIAGONAL = np.array([0, 4, 8])


class BodyMotion:
    """A body's frame and elastic coordinates at n instants.

    Attributes:
        constants: of the body; q modes.
        a, w, wd: (n, 3) acceleration of the frame's origin less gravity, angular velocity and
            acceleration, components of the frame.
        rates: e, e', e'' (n, q).
    """

    def __init__(
        self, constants: Constants, motion: tuple[np.ndarray, np.ndarray, np.ndarray], rates: Rates
    ) -> None:
        """Take the motion (a, w, wd)."""
        self.constants, self.rates = constants, rates
        self.a, self.w, self.wd = motion
        self.modal = ModalDisplacement(constants.L, rates)

    @property
    def is_flexible(self) -> bool:
        """Whether it has elastic coordinates."""
        return self.constants.num_modes > 0

    # -- the frame ---------------------------------------------------------------------------

    @cached_property
    def Omega(self) -> np.ndarray:
        """w~ (n, 3, 3)."""
        return skew(self.w)

    @cached_property
    def A(self) -> np.ndarray:
        """wd~ + w~ w~ (n, 3, 3)."""
        return skew(self.wd) + self.Omega @ self.Omega

    # -- integrals of the deformed body ------------------------------------------------------

    @cached_property
    def _stiffening(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """K0_p times e, e' and e'' (n, 12, q); None of a linear body."""
        K0 = self.constants.K0
        if K0 is None:
            return None
        flat = K0.transpose(1, 0, 2).reshape(K0.shape[1], -1)
        x, xd, xdd = ((one @ flat).reshape(-1, 12, K0.shape[1]) for one in self.rates)
        return x, xd, xdd

    @cached_property
    def _products(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """W_ab of all fields times eta, eta', eta'' (n, 9, 1 + q), of the modes times (1, z)."""
        constants, modal = self.constants, self.modal
        shape = (len(self.a), 9, 1 + constants.num_modes)
        along = (modal.z, modal.zd, modal.zdd)
        found = [(x @ constants.W_modes).reshape(shape) for x in along]
        if modal.L is not None:
            first = constants.W_modes[:, :: shape[2]]
            for product, x in zip(found, self.rates, strict=True):
                product[:, :, 0] = x @ first
        found[0] = found[0] + constants.W_rest.reshape(shape[1:])
        return found[0], found[1], found[2]

    @cached_property
    def _along(self) -> np.ndarray:
        """W_ab of the modes times z (n, 9, q)."""
        return self._products[0][:, :, 1:] - self.constants.body.W[:, 1:, 0]

    @cached_property
    def C(self) -> np.ndarray:
        """Derivative of s by e (n, 3, q), or (3, q)."""
        C, bent = self.constants.C, self._stiffening
        return C if bent is None else C - bent[0][:, :3]

    @cached_property
    def Y(self) -> np.ndarray:
        """W_ab eta (n, 9, q) of the modes' rows, less K0_ab e."""
        Y, bent = self._products[0][:, :, 1:], self._stiffening
        if self.modal.L is not None:
            Y = self.constants.body.W[:, 1:, 0] + self.modal.pulled(self._along)
        return Y if bent is None else Y - bent[0][:, 3:]

    @cached_property
    def moments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First moment s = int p and its relative rates (n, 3)."""
        c, C, (e, ed, edd) = self.constants.c, self.constants.C, self.rates
        if not self.is_flexible:
            none = np.zeros_like(self.a)
            return none + c, none, none
        s, sd, sdd = c + e @ C.T, ed @ C.T, edd @ C.T
        if (bent := self._stiffening) is not None:
            x, xd = bent[0][:, :3], bent[1][:, :3]
            s = s - 0.5 * times(x, e)
            sd = sd - times(x, ed)
            sdd = sdd - times(x, edd) - times(xd, ed)
        return s, sd, sdd

    @cached_property
    def second_moments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """G, H, I (n, 3, 3) = int p p', int p p'' of rates, see the module."""
        e, z = self.rates[0], self.modal.z
        found = [x[:, :, 0] + np.einsum("nck,nk->nc", x[:, :, 1:], z) for x in self._products]
        if self.modal.L is not None:
            found[0] = found[0] + (e - z) @ self.constants.body.W[:, 1:, 0].T
        if (bent := self._stiffening) is not None:
            x, xd = bent[0][:, 3:], bent[1][:, 3:]
            own, rate, second = (np.einsum("nck,nk->nc", x, one) for one in self.rates)
            found[0] = found[0] - 0.5 * (own + own[:, TRANSPOSED])
            found[1] = found[1] - rate[:, TRANSPOSED]
            second = second + np.einsum("nck,nk->nc", xd, self.rates[1])
            found[2] = found[2] - second[:, TRANSPOSED]
        G, H, second = (one.reshape(-1, 3, 3) for one in found)
        return G, H, second

    @cached_property
    def inertia(self) -> np.ndarray:
        """Inertia tensor of the deformed body about the frame's origin (n, 3, 3), kg m2."""
        G = self.second_moments[0]
        return np.trace(G, axis1=1, axis2=2)[:, None, None] * ONE - G

    # -- forces ------------------------------------------------------------------------------

    @cached_property
    def load(self) -> tuple[np.ndarray, np.ndarray]:
        """Inertia force F and moment T about the frame's origin (n, 3), N and N m."""
        s, sd, sdd = self.moments
        if not self.is_flexible:
            force = self.constants.body.mass * self.a + times(self.A, s)
            turned = times(self.inertia, self.w)
            moment = cross(s, self.a) + times(self.inertia, self.wd) + cross(self.w, turned)
            return force, moment
        force = self.constants.body.mass * self.a + times(self.A, s)
        force = force + 2.0 * cross(self.w, sd) + sdd
        G, H, second = self.second_moments
        inner = G @ self.A.swapaxes(1, 2) - 2.0 * (H @ self.Omega) + second
        return force, cross(s, self.a) + axial(inner)

    @cached_property
    def rows(self) -> np.ndarray:
        """The body's own elastic rows (n, q), nothing loading its outboard interface."""
        body, modal, (e, ed, _) = self.constants.body, self.modal, self.rates
        A, Omega = self.A.reshape(-1, 1, 9), self.Omega.reshape(-1, 1, 9)
        f = (A @ self.Y + 2.0 * (Omega @ modal.pulled(self._products[1][:, :, 1:])))[:, 0]
        f = f + (self.a @ self.C if self.C.ndim == 2 else (self.a[:, None] @ self.C)[:, 0])
        return f + modal.pulled(modal.zdd @ self.constants.M) + e @ body.K + ed @ body.D

    # -- derivatives -------------------------------------------------------------------------

    @cached_property
    def load_by_motion(self) -> np.ndarray:
        """Derivative of (F, T) by (a, w, wd), (n, 6, 9)."""
        s, sd, _ = self.moments
        out = np.zeros((len(self.a), 6, 9))
        S = skew(s)
        out[:, :3, :3] = self.constants.body.mass * ONE
        out[:, :3, 3:6] = -skew(cross(self.w, s)) - self.Omega @ S - 2.0 * skew(sd)
        out[:, :3, 6:], out[:, 3:, :3] = -S, S
        inertia = self.inertia
        by_w = self.Omega @ inertia - skew(times(inertia, self.w))
        if self.is_flexible:
            H = self.second_moments[1]
            trace = np.trace(H, axis1=1, axis2=2)[:, None, None]
            by_w += 2.0 * (trace * ONE - H.swapaxes(1, 2))
        out[:, 3:, 3:6], out[:, 3:, 6:] = by_w, inertia
        return out

    @cached_property
    def rows_by_motion(self) -> np.ndarray:
        """Derivative of the rows by (a, w, wd), (n, q, 9)."""
        count, q = self.rates[0].shape
        out = np.empty((count, 9, q))
        out[:, :3] = self.C
        Y = self.Y
        by_w = self.w[:, None] @ (Y + Y[:, TRANSPOSED]).reshape(count, 3, -1)
        out[:, 3:6] = by_w.reshape(count, 3, q)
        out[:, 3:6] -= 2.0 * self.w[:, :, None] * Y[:, DIAGONAL].sum(axis=1)[:, None]
        out[:, 3:6] -= 2.0 * (AXIAL @ self.modal.pulled(self._products[1][:, :, 1:]))
        out[:, 6:] = -(AXIAL @ Y)
        return out.swapaxes(1, 2)

    @cached_property
    def load_by_rates(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of (F, T) by e, e', e'' (n, 6, q), the frame's motion held."""
        count, q = self.rates[0].shape
        by_e, by_ed, by_edd = np.empty((3, count, 6, q))
        C, Y, bent = self.C, self.Y, self._stiffening
        Omega = self.Omega
        by_e[:, :3], by_ed[:, :3], by_edd[:, :3] = self.A @ C, 2.0 * (Omega @ C), C
        of_A, of_Omega = self._moment_by_second_moments
        modal = self.modal
        first, second = (modal.pulled(x[:, :, 1:]) for x in self._products[1:])
        turned, bending = Y[:, TRANSPOSED], None
        if modal.L is not None:
            across = self._along[:, TRANSPOSED]
            bending = modal.rate_by_q(across)
            first, second = first + bending, second + modal.second_rate_by_q(across)
        if bent is not None:
            xd, xdd = bent[1], bent[2]
            by_e[:, :3] -= 2.0 * (Omega @ xd[:, :3]) + xdd[:, :3]
            by_ed[:, :3] -= 2.0 * xd[:, :3]
            first = first - xd[:, 3:][:, TRANSPOSED]
            second = second - xdd[:, 3:][:, TRANSPOSED]
        by_e[:, 3:] = of_A @ (Y + turned) + of_Omega @ first + AXIAL @ second
        by_e[:, 3:] -= skew(self.a) @ C
        by_ed[:, 3:] = of_Omega @ turned
        if bent is not None:
            by_ed[:, 3:] -= 2.0 * (AXIAL @ bent[1][:, 3:][:, TRANSPOSED])
        if bending is not None:
            by_ed[:, 3:] += 2.0 * (AXIAL @ bending)
        by_edd[:, 3:] = AXIAL @ turned
        return by_e, by_ed, by_edd

    @cached_property
    def _moment_by_second_moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of T by G and H (n, 3, 9)."""
        count = len(self.a)
        of_A = (PERMUTATION.reshape(9, 3) @ self.A).reshape(count, 3, 9)
        of_Omega = (PERMUTATION.reshape(9, 3) @ (2.0 * self.Omega)).reshape(count, 3, 9)
        return of_A, of_Omega

    @cached_property
    def rows_by_rates(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of the rows by e, e' and e'' (n, q, q); the mass M (q, q) if z is e."""
        constants, body = self.constants, self.constants.body
        count, q = self.rates[0].shape
        A, Omega = self.A.reshape(count, 9), self.Omega.reshape(count, 9)
        by_z = (A @ constants.modes).reshape(count, q, q)
        by_zd = (2.0 * Omega @ constants.modes).reshape(count, q, q)
        by_e, by_ed, by_edd = by_z + body.K, by_zd + body.D, constants.M
        if self.modal.L is not None:
            more = self.modal.tangent(self._modal_inertia, constants.M, by_z, by_zd)
            by_e, by_ed, by_edd = by_e + more[0], by_ed + more[1], by_edd + more[2]
        if constants.K0 is not None:
            by_e -= np.tensordot(np.hstack([self.a, A]), constants.K0, 1)
        return by_e, by_ed, by_edd

    @cached_property
    def _modal_inertia(self) -> np.ndarray:
        """A_ab W_ab z + 2 Omega_ab W_ab z' + M z'' (n, q)."""
        A, Omega = self.A.reshape(-1, 1, 9), self.Omega.reshape(-1, 1, 9)
        forces = (A @ self._along + 2.0 * (Omega @ self._products[1][:, :, 1:]))[:, 0]
        return np.asarray(forces + self.modal.zdd @ self.constants.M)

    # -- gradient ----------------------------------------------------------------------------

    def integral_gradient(
        self, virtual: np.ndarray, multipliers: np.ndarray
    ) -> dict[str, np.ndarray | float]:
        """Return the derivative of the virtual work of F, T and the rows by the integrals.

        Args:
            virtual: (n, 6) displacement of the frame's origin and rotation, multiplies (F, T).
            multipliers: (n, q) of the rows.

        Returns:
            mass, w, W, K, D, K0 and along_modes under their names.
        """
        (e, ed, _), modal = self.rates, self.modal
        p, phi = virtual[:, :3], virtual[:, 3:]
        w, W = self._by_moments(p, phi, self.rates, multipliers)
        along_modes = np.zeros_like(self.constants.body.along_modes)
        if modal.L is not None:
            along = (modal.z, modal.zd, modal.zdd)
            by_modes = self._by_moments(p, phi, along, modal.pushed(multipliers))[1]
            W[:, 1:, 1:] = by_modes[:, 1:, 1:]
            by = self._by_modal_displacement(phi, multipliers)
            along_modes = modal.gradient(by, self._modal_inertia, multipliers)
        return {
            "mass": float((p * self.a).sum()),
            "w": w,
            "W": W,
            "K": multipliers.T @ e,
            "D": multipliers.T @ ed,
            "K0": self._by_stiffening(p, phi, multipliers),
            "along_modes": along_modes,
        }

    def _by_moments(
        self, p: np.ndarray, phi: np.ndarray, rates: Rates, multipliers: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative of the virtual work by w (3, 1 + q) and W (9, 1 + q, 1 + q)."""
        q = self.constants.num_modes
        eta, eta_d, eta_dd, zeta = (
            np.insert(x, 0, first, axis=1)[:, None, None]
            for x, first in zip((*rates, multipliers), (1.0, 0.0, 0.0, 0.0), strict=True)
        )
        one = ONE[:, :, None]
        # Of a point N_a,k: its virtual displacement, and its acceleration less a (n, 3, 3, 1 + q).
        moved = skew(phi)[..., None] * eta + one * zeta
        driven = self.A[..., None] * eta + 2.0 * self.Omega[..., None] * eta_d + one * eta_dd
        left, right = (x.reshape(-1, 3 * (1 + q)) for x in (moved, driven))
        W = (left.T @ right).reshape(3, 1 + q, 3, 1 + q).transpose(0, 2, 1, 3)
        w = (p.reshape(-1) @ right + self.a.reshape(-1) @ left).reshape(3, 1 + q)
        return w, W.reshape(9, 1 + q, 1 + q)

    def _by_modal_displacement(self, phi: np.ndarray, multipliers: np.ndarray) -> Rates:
        """Return the derivative of the virtual work by z, z' and z'' (n, q)."""
        count, q = multipliers.shape
        A, Omega = self.A.reshape(count, 1, 9), self.Omega.reshape(count, 1, 9)
        zeta, constants = self.modal.pushed(multipliers), self.constants
        of_rows = (zeta @ constants.modes.reshape(9, q, q)).swapaxes(0, 1)  # W_ab' zeta
        of_G, of_H = (phi[:, None] @ x for x in self._moment_by_second_moments)
        of_I = (phi @ AXIAL)[:, None]
        z, zd, zdd = self._along, self._products[1][:, :, 1:], self._products[2][:, :, 1:]
        across = z[:, TRANSPOSED]
        by_z = of_G @ (z + across) + of_H @ zd + of_I @ zdd + A @ of_rows
        by_zd = of_H @ across + 2.0 * (Omega @ of_rows)
        by_zdd = (of_I @ across)[:, 0] + zeta @ constants.M
        return by_z[:, 0], by_zd[:, 0], by_zdd

    def _by_stiffening(self, p: np.ndarray, phi: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Return the derivative by K0 (12, q, q); (0, q, q) of a linear body."""
        if self.constants.K0 is None:
            return np.zeros((0, multipliers.shape[1], multipliers.shape[1]))
        A, Omega = self.A, self.Omega
        of_A, of_Omega = self._moment_by_second_moments
        G, H = ((phi[:, None] @ x)[:, 0] for x in (of_A, of_Omega))
        second = phi @ AXIAL
        value = times(A.swapaxes(1, 2), p) + cross(self.a, phi)
        weights = Weights(
            np.hstack([value, G + G[:, TRANSPOSED]]),
            np.hstack([2.0 * times(Omega.swapaxes(1, 2), p), H[:, TRANSPOSED]]),
            np.hstack([p, second[:, TRANSPOSED]]),
            np.hstack([self.a, A.reshape(-1, 9)]),
        )
        return weights.quadratic(self.rates, multipliers)


class Weights:
    """Derivatives (n, P) of the virtual work by P quantities C_p e - 1/2 e'K0_p e.

    By their values, rates, second derivatives, and variations by the multipliers.
    """

    def __init__(
        self, value: np.ndarray, rate: np.ndarray, second: np.ndarray, virtual: np.ndarray
    ) -> None:
        """Take them."""
        self.value, self.rate, self.second, self.virtual = value, rate, second, virtual

    def linear(self, rates: Rates, multipliers: np.ndarray) -> np.ndarray:
        """Return the derivative (P, q) by C."""
        e, ed, edd = rates
        out: np.ndarray = self.value.T @ e + self.rate.T @ ed
        return out + self.second.T @ edd + self.virtual.T @ multipliers

    def quadratic(self, rates: Rates, multipliers: np.ndarray) -> np.ndarray:
        """Return the derivative (P, q, q) by K0, of which the symmetric part counts."""
        (e, ed, edd), (count, q) = rates, rates[0].shape
        pairs = ((self.value, 0.5 * e), (self.rate, ed), (self.second, edd))
        other = np.einsum("np,nk->npk", self.virtual, multipliers)
        for weight, x in pairs:
            other += np.einsum("np,nk->npk", weight, x)
        bent = np.einsum("np,nk->npk", self.second, ed)
        out = e.T @ other.reshape(count, -1) + ed.T @ bent.reshape(count, -1)
        return -out.reshape(q, -1, q).swapaxes(0, 1)


def with_outboard(
    found: dict[str, np.ndarray | float], outboard: np.ndarray, K0_outboard: np.ndarray
) -> ShapeIntegrals:
    """Return derivatives by all integrals from those of inertia and of the outboard interfaces."""
    every = found | {"outboard": outboard, "K0_outboard": K0_outboard}
    every["further_points"] = np.zeros((len(outboard) // 6 - 1, 3))
    return ShapeIntegrals(outboard_point=np.zeros(3), **every)  # type: ignore[arg-type]
