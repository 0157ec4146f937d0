"""A body that moves and deforms in the plane or in space: inertia force, rows, derivatives.

The instants are the last axis, see `dimension`. Motions are triples (a, w, wd): acceleration of a
frame's origin less gravity (d, n), angular velocity and acceleration (r, n), in the components of
that frame. Loads are (d + r, n), force and moment.

All that loads a body's elastic rows is linear in P numbers, its pushes: the frame's acceleration a,
the entries alpha_c of A, and the force and moment on every outboard interface. Each has a conjugate
that the coordinates e displace,

    v_p = T_p e - 1/2 e'K0_p e,   V_p = dv_p/de = T_p - K0_p e,

its geometric stiffness K0 zero of a linear body: first moment s - c for a, int X . E_c u for
alpha_c, displacement and rotation of an interface for its force and moment.

A body with geometric stiffness deforms by Phi e + psi(e), psi being of second order. Along the
modes that is z with M z = int Phi . (Phi e + psi); by reciprocity the second-order part is that of
the inertia M Phi_k as a load: z = e - 1/2 e'L e, L_k = sum_l (M^-1)_kl K0_l, J = dz/de = 1 - L e.
It takes the place of e in products of the modes with each other: the mass J'M J of the relative
motion is definite for every deformation. With z = e it would be M, and the second order of the
interface's motion alone would make the mass of light coordinates negative. Without L, as of bodies
from files, z is e.

With second moments G_c = int p . E_c p, H_c = int p . E_c p', I_c = int p . E_c p'' of the deformed
body the inertia force, moment and rows are

    F = m a + A s + 2 Omega s' + s'',   T = s x a + torque(alpha, G) + torque(beta, H) + axial(I),
    f = p . V + J'(alpha_c W_c z + beta_c W_c z' + M z'') + K e + D e'.

Source: Schwertassek & Wallrapp (1999); Wallrapp & Schwertassek (1991),
doi:10.1002/nme.1620320818; Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from dolfinopt.multibody.dimension import DIMENSIONS, product
from dolfinopt.multibody.shape_integrals import ShapeIntegrals

Motion = tuple[np.ndarray, np.ndarray, np.ndarray]


class Constants:
    """One body's integrals as the equations use them; q modes, P pushes.

    Attributes:
        body: the integrals.
        dim: what differs between the plane and space.
        mass: kg.
        T: (P, q) conjugates of the pushes by the coordinates.
        by_e: (P + q, q) the same, and behind it those of z.
        bent: (P + q, q, q) geometric stiffness K0 by every push, and L; None of a linear body.
        inertial: places among them of what inertia displaces: conjugates of a, of alpha, and z.
        c, W_rest: (d, 1), (g, 1) of the undeformed body.
        is_point: whether it is rigid with its centre at the origin.
        W: (g q, q) of the modes.
        M: (q, q) mass.
        K, D: (q, q), or diagonals (q, 1) where there is nothing else; no D, None.
        points: (i, d) reference positions of the outboard interfaces.
    """

    def __init__(self, body: ShapeIntegrals) -> None:
        """Take the integrals."""
        self.body, q = body, body.num_modes
        self.dim = DIMENSIONS[len(body.w)]
        self.num_modes = q
        self.T = np.concatenate([body.w[:, 1:], body.W[:, 1:, 0], body.outboard])
        self.by_e = np.concatenate([self.T, np.eye(q)])
        self.bent: np.ndarray | None = None
        if body.is_stiffened:
            L = body.along_modes if len(body.along_modes) else np.zeros((q, q, q))
            self.bent = np.concatenate([body.K0[self.dim.loads], body.K0_outboard, L])
        self.inertial = np.r_[: self.dim.d + self.dim.g, len(self.T) : len(self.by_e)]
        self.mass = body.mass
        self.c, self.W_rest = body.w[:, :1], body.W[:, :1, 0]
        self.is_point = q == 0 and not self.c.any()
        self.W = np.ascontiguousarray(body.W[:, 1:, 1:]).reshape(self.dim.g * q, q)
        self.M = body.M
        self.K = _diagonal_or_matrix(body.K)
        self.D = _diagonal_or_matrix(body.D) if body.D.any() else None
        self.points = body.points if self.dim.d == 3 else body.outboard_point[None]

    def outboard(self, number: int) -> slice:
        """Return an interface's place among the pushes."""
        first = self.dim.d + self.dim.g + self.dim.b * number
        return slice(first, first + self.dim.b)


def _diagonal_or_matrix(A: np.ndarray) -> np.ndarray:
    """Return the diagonal (q, 1) of a matrix that has nothing else, or the matrix."""
    diagonal = np.diagonal(A)
    alone = np.count_nonzero(A) == np.count_nonzero(diagonal)
    return diagonal[:, None].copy() if alone else A


def weighted(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return A x (q, n) of a matrix, or of its diagonal (q, 1)."""
    return A * x if A.shape[1] != len(A) or len(A) == 1 else A @ x


class BodyMotion:
    """A body's frame and elastic coordinates at n instants.

    Attributes:
        constants: of the body.
        a, w, wd: its motion.
        rates: (q, 3, n) coordinates e, e', e''.
    """

    def __init__(self, constants: Constants, motion: Motion, rates: np.ndarray) -> None:
        """Take motion and coordinates."""
        self.constants, self.dim, self.rates = constants, constants.dim, rates
        self.a, self.w, self.wd = motion
        self.is_flexible = constants.num_modes > 0
        self.alpha = self.dim.alpha(self.w, self.wd)

    @cached_property
    def beta(self) -> np.ndarray:
        """Entries of 2 Omega (g, n)."""
        return self.dim.beta(self.w)

    # -- conjugates of the pushes, displacement along the modes -------------------------------

    def _bent_by(self, rate: int) -> np.ndarray:
        """Return K0 and L times e, e' or e'' (P + q, q, n)."""
        bent, (q, _, count) = self.constants.bent, self.rates.shape
        assert bent is not None
        return (bent.reshape(-1, q) @ self.rates[:, rate]).reshape(-1, q, count)

    @cached_property
    def _bent(self) -> np.ndarray:
        return self._bent_by(0)

    @cached_property
    def _bent_rate(self) -> np.ndarray:
        return self._bent_by(1)

    @cached_property
    def _every(self) -> np.ndarray:
        """Conjugates of all pushes and, if it is not e, z, with their rates (P + q, 3, n)."""
        q, _, count = self.rates.shape
        linear = (self.constants.T @ self.rates.reshape(q, 3 * count)).reshape(-1, 3, count)
        if self.constants.bent is None:
            return linear
        linear = np.concatenate([linear, self.rates])
        e, ed, edd = self.rates.swapaxes(0, 1)
        bent = np.empty(linear.shape, dtype=self._bent.dtype)
        bent[:, 0] = 0.5 * np.einsum("pkn,kn->pn", self._bent, e)
        bent[:, 1] = np.einsum("pkn,kn->pn", self._bent, ed)
        bent[:, 2] = np.einsum("pkn,kn->pn", self._bent, edd)
        bent[:, 2] += np.einsum("pkn,kn->pn", self._bent_rate, ed)
        return np.asarray(linear - bent)

    @property
    def conjugates(self) -> np.ndarray:
        """Conjugates of the pushes and their rates (P, 3, n)."""
        return self._every[: len(self.constants.T)]

    @property
    def z(self) -> np.ndarray:
        """Displacement along the modes and its rates (q, 3, n)."""
        return self.rates if self.constants.bent is None else self._every[len(self.constants.T) :]

    @cached_property
    def _by_e(self) -> np.ndarray:
        """V, and J = dz/de behind it (P + q, q, n)."""
        by_e = self.constants.by_e[..., None]
        if self.constants.bent is None:
            return np.broadcast_to(by_e, (*by_e.shape[:2], self.w.shape[1]))
        return by_e - self._bent

    @property
    def V(self) -> np.ndarray:
        """Derivative of the conjugates by e (P, q, n)."""
        return self._by_e[: len(self.constants.T)]

    def jacobian_transposed(self, x: np.ndarray) -> np.ndarray:
        """Return J' x: forces by z as forces by e, (q, n) or (m, q, n)."""
        if self.constants.bent is None:
            return x
        return np.asarray(np.einsum("...ln,lkn->...kn", x, self._by_e[len(self.constants.T) :]))

    def _by_rates(self, places: np.ndarray | slice, kept: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return derivatives by those e kept, at `places`, and their first and second rates.

        (n, ., k), of a body with geometric stiffness.
        """
        every = self._by_e, -self._bent_rate, -self._bent_by(2)
        return tuple(by_instant(x[places][:, kept]) for x in every)

    def by_rates(self, by: np.ndarray, places: np.ndarray | slice, kept: np.ndarray) -> np.ndarray:
        """Return the derivative by those e, e', e'' kept of what conjugates displace (n, i, k, 3).

        Args:
            by: (i, 3, p, n) derivatives by conjugates, or z, and their rates.
            places: of these p among V and J.
            kept: (k,).
        """
        first = np.ascontiguousarray(np.moveaxis(by, -1, 0))
        if self.constants.bent is None:
            own = self.constants.by_e[places][:, kept]
            result = first.reshape(-1, len(own)) @ own
            return result.reshape(*first.shape[:3], -1).swapaxes(2, 3)
        return _chain([first[:, :, r] for r in range(3)], self._by_rates(places, kept))

    # -- integrals of the deformed body ------------------------------------------------------

    @cached_property
    def _Wz(self) -> np.ndarray:
        """W_c of the modes times z, z', z'' (g, q, 3, n)."""
        q, _, count = self.rates.shape
        return (self.constants.W @ self.z.reshape(q, 3 * count)).reshape(self.dim.g, q, 3, count)

    @cached_property
    def Y(self) -> np.ndarray:
        """Derivative of the rows by alpha_c (g, q, n); that of beta_c is `Yd`."""
        d, g = self.dim.d, self.dim.g
        return self.V[d : d + g] + self.jacobian_transposed(self._Wz[:, :, 0])

    @cached_property
    def Yd(self) -> np.ndarray:
        """J' W_c z' (g, q, n)."""
        return self.jacobian_transposed(self._Wz[:, :, 1])

    @cached_property
    def moments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First moment s = int p and its rates (d, n)."""
        d, c = self.dim.d, self.constants.c
        if not self.is_flexible:
            none = np.zeros_like(self.a)
            return none + c, none, none
        s, sd, sdd = self.conjugates[:d].swapaxes(0, 1)
        return c + s, sd, sdd

    @cached_property
    def second_moments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """G, H, I (g, n), see the module."""
        d, g, rest = self.dim.d, self.dim.g, self.constants.W_rest
        if not self.is_flexible:
            none = np.zeros_like(self.alpha)
            return none + rest, none, none
        v = self.conjugates[d : d + g]
        result = np.einsum("ckrn,kn->crn", self._Wz, self.z[:, 0]) + self.dim.transposed(v)
        return rest + v[:, 0] + result[:, 0], result[:, 1], result[:, 2]

    # -- forces ------------------------------------------------------------------------------

    @cached_property
    def load(self) -> np.ndarray:
        """Inertia force F and moment T about the frame's origin (d + r, n), N and N m."""
        dim, force = self.dim, self.constants.mass * self.a
        if self.constants.is_point:
            return np.concatenate([force, dim.torque(self.alpha, self.constants.W_rest)])
        (s, sd, sdd), (G, H, second) = self.moments, self.second_moments
        force = force + dim.apply(self.alpha, s)
        moment = dim.moment(s, self.a) + dim.torque(self.alpha, G)
        if self.is_flexible:
            force = force + dim.apply(self.beta, sd) + sdd
            moment = moment + dim.torque(self.beta, H) + dim.axial(second)
        return np.concatenate([force, moment])

    @cached_property
    def _pushes(self) -> np.ndarray:
        """Entries of A, 2 Omega and 1 (g, 3, n), that multiply p, p' and p''."""
        out = np.empty((len(self.alpha), 3, self.alpha.shape[1]), dtype=self.alpha.dtype)
        out[:, 0], out[:, 1], out[:, 2] = self.alpha, self.beta, self.dim.trace
        return out

    @cached_property
    def modal_inertia(self) -> np.ndarray:
        """alpha_c W_c z + beta_c W_c z' + M z'' (q, n)."""
        return np.asarray(np.einsum("crn,ckrn->kn", self._pushes, self._Wz))

    def load_coefficients(self, outboard: dict[int, np.ndarray]) -> np.ndarray:
        """Return all P of them (P, n) from those of the interfaces, by number."""
        count = self.a.shape[1]
        pulls = [
            outboard[s] if s in outboard else np.zeros((self.dim.b, count))
            for s in range(len(self.constants.points))
        ]
        return np.concatenate([self.a, self.alpha, *pulls])

    def _pushed(self, outboard: dict[int, np.ndarray]) -> np.ndarray:
        """Return what works on all conjugates and z (P + q, n), under pushes of the interfaces."""
        return np.concatenate([self.load_coefficients(outboard), self.modal_inertia])

    def rows(self, outboard: dict[int, np.ndarray]) -> np.ndarray:
        """Return the elastic rows (q, n) under pushes of the interfaces, by number."""
        constants = self.constants
        if constants.bent is None:
            f = self.modal_inertia + constants.T.T @ self.load_coefficients(outboard)
        else:
            f = np.einsum("pn,pkn->kn", self._pushed(outboard), self._by_e)
        f = f + weighted(constants.K, self.rates[:, 0])
        if constants.D is not None:
            f += weighted(constants.D, self.rates[:, 1])
        return f

    # -- derivatives -------------------------------------------------------------------------

    @cached_property
    def load_by_motion(self) -> np.ndarray:
        """Derivative of (F, T) by (a, w, wd), (d + r, d + 2 r, n)."""
        dim, d = self.dim, self.dim.d
        out = np.zeros((dim.b, dim.b + dim.r, self.a.shape[1]))
        out[range(d), range(d)] = self.constants.mass
        out[d:, :d] = dim.moment.matrix(self.moments[0])
        by_alpha, by_beta = (x.swapaxes(0, 1) for x in self._load_by_entries)
        out[:, d:] = dim.spin_gradient(self.w, by_alpha, by_beta).swapaxes(0, 1)
        return out

    @property
    def _load_by_entries(self) -> list[np.ndarray]:
        """Derivatives of (F, T) by alpha and beta (d + r, g, n)."""
        applied, torque = self.dim.applied.matrix, self.dim.torque_of.matrix
        pairs = zip(self.moments[:2], self.second_moments[:2], strict=True)
        return [np.concatenate([applied(s), torque(G)]) for s, G in pairs]

    def motion_gradient(self, virtual: np.ndarray, zeta: np.ndarray) -> np.ndarray:
        """Return derivatives (d + 2 r, n) of the virtual work of F, T and the rows by the motion.

        Args:
            virtual: (d + r, n) multiplies (F, T).
            zeta: (q, n) multiplies the rows.
        """
        result = product(self.load_by_motion.swapaxes(0, 1), virtual)
        return result + product(self.rows_by_motion, zeta) if self.is_flexible else result

    @cached_property
    def rows_by_motion(self) -> np.ndarray:
        """Derivative of the rows by (a, w, wd), (d + 2 r, q, n)."""
        by_spin = self.dim.spin_gradient(self.w, self.Y, self.Yd)
        return np.concatenate([self.V[: self.dim.d], by_spin])

    @cached_property
    def load_by_conjugates(self) -> np.ndarray:
        """Derivative of (F, T) by the inertial conjugates and their rates (d + r, 3, d + g + q, n).

        z is `Constants.inertial`'s last.
        """
        dim, d = self.dim, self.dim.d
        out = np.zeros((dim.b, 3, len(self.constants.inertial), self.a.shape[1]))
        by_s = out[:, :, :d]
        by_s[:d, 0], by_s[:d, 1] = dim.apply.matrix(self.alpha), dim.apply.matrix(self.beta)
        by_s[range(d), 2, range(d)] = 1.0
        by_s[d:, 0] = -dim.moment.matrix(self.a)
        out[d:, :, d:] = self._by_second_rates(self._torques)
        return out

    @property
    def _torques(self) -> list[np.ndarray]:
        """Derivatives of T by G, H, I (r, g, n); the last (r, g, 1)."""
        torque = self.dim.torque.matrix
        return [torque(self.alpha), torque(self.beta), -self.dim.spin.T[:, :, None]]

    def _by_second_rates(self, by: Sequence[np.ndarray]) -> np.ndarray:
        """Return derivatives (m, 3, g + q, n) by v, z and their rates from those by G, H, I."""
        # G, H and I have v and its transpose, v' and v'' transposed; W_c z takes the place of v.
        count, transposed = self.a.shape[1], self.dim.transposed
        out = np.empty((len(by[0]), 3, self.dim.g + len(self.rates), count))
        by_v, by_z = out[:, :, : self.dim.g], out[:, :, self.dim.g :]
        for rate, x in enumerate(by):
            by_v[:, rate] = transposed(x.swapaxes(0, 1)).swapaxes(0, 1)
        by_v[:, 0] += by[0]
        by_z[:] = np.einsum("mtgn,gqn->mtqn", by_v, self._Wz[:, :, 0])
        for rate in (1, 2):
            by_z[:, 0] += product(by[rate], self._Wz[:, :, rate])
        return out

    def load_by_rates(self, kept: np.ndarray) -> np.ndarray:
        """Return the derivatives of (F, T) by those e, e', e'' kept (n, d + r, k, 3)."""
        return self.by_rates(self.load_by_conjugates, self.constants.inertial, kept)

    def rows_by_rates(self, kept: np.ndarray, outboard: dict[int, np.ndarray]) -> np.ndarray:
        """Return the derivatives of the rows by those e, e', e'' kept (n, q, k, 3), pushes held."""
        constants, q, count = self.constants, self.constants.num_modes, self.w.shape[1]
        W, M = constants.W.reshape(-1, q, q), constants.M
        if constants.bent is None:
            W, M = W[:, :, kept], M[:, kept]
        flat = W.reshape(len(W), -1)
        by_z = [(x.T @ flat).reshape(count, *M.shape) for x in (self.alpha, self.beta)]
        by_z.append(np.broadcast_to(M, (count, *M.shape)))
        if constants.bent is None:
            out = np.empty((count, *M.shape, 3))
            for rate, x in enumerate(by_z):
                out[..., rate] = x
        else:
            jets = self._by_rates(slice(len(constants.T), None), np.arange(q))
            out = _chain(by_z, [x[:, :, kept] for x in jets]).reshape(count, q, -1)
            out = (jets[0].swapaxes(1, 2) @ out).reshape(count, q, -1, 3)
            held, bent = self._pushed(outboard), constants.bent[:, :, kept]
            out[..., 0] -= np.tensordot(held.T, bent, 1)
        out[..., 0] += constants.body.K[:, kept]
        if constants.D is not None:
            out[..., 1] += constants.body.D[:, kept]
        return out

    # -- gradient ----------------------------------------------------------------------------

    def integral_gradient(
        self, virtual: np.ndarray, multipliers: np.ndarray, outboard: dict[int, np.ndarray]
    ) -> ShapeIntegrals:
        """Return the derivative of the virtual work of F, T and the rows by the integrals.

        Args:
            virtual: displacement of the frame's origin and rotation (d + r, n), multiplies (F, T).
            multipliers: (q, n) of the rows.
            outboard: derivatives (b, 4, n) by the interfaces' (u, theta), by number: by their
                values, rates, second derivatives, and variations by the multipliers.
        """
        constants, body, zeta = self.constants, self.constants.body, multipliers
        d, ends, P = self.dim.d, self.dim.d + self.dim.g, len(constants.T)
        every = np.zeros((len(constants.by_e), 4, zeta.shape[1]))
        every[constants.inertial, :3] = self._inertia_gradient(virtual)
        every[:d, 3], every[d:ends, 3] = self.a, self.alpha
        for s, item in outboard.items():
            every[constants.outboard(s)] = item
        x = np.concatenate([self.rates, zeta[:, None]], axis=1)
        by_T = np.tensordot(every[:P], x, ((1, 2), (1, 2)))
        W = np.zeros_like(body.W)
        W[:, 0, 0] = self.dim.turned(virtual[d:], self.alpha).sum(axis=1)
        W[:, 1:, 0], W[:, 1:, 1:] = by_T[d:ends], self._by_second_moments(virtual[d:], zeta)
        bent = np.zeros((len(every), *body.K.shape))
        if constants.bent is not None:
            self._add_modal(every[P:], zeta)
            bent = self._by_bending(every, x)
        return ShapeIntegrals(
            mass=float((virtual[:d] * self.a).sum()),
            w=np.column_stack([every[:d, 0].sum(axis=1), by_T[:d]]),
            W=W,
            K=zeta @ self.rates[:, 0].T,
            D=zeta @ self.rates[:, 1].T,
            outboard=by_T[ends:],
            outboard_point=np.zeros(d),
            K0=bent[np.argsort(self.dim.loads)][: len(body.K0)],
            K0_outboard=bent[ends:P][: len(body.K0_outboard)],
            further_points=np.zeros_like(body.further_points),
            along_modes=bent[P:][: len(body.along_modes)].reshape(body.along_modes.shape),
        )

    def _inertia_gradient(self, virtual: np.ndarray) -> np.ndarray:
        """Return the virtual work of (F, T) by the inertial conjugates and rates (., 3, n)."""
        dim, (u, phi) = self.dim, np.split(virtual, [self.dim.d])
        by_first = dim.apply(dim.transposed(self.alpha), u) - dim.velocity(phi, self.a)
        by_s = np.stack([by_first, -dim.apply(self.beta, u), u], axis=1)  # 2 Omega is skew
        by_second = [np.einsum("rgn,rn->gn", x, phi)[None] for x in self._torques]
        by_rest = self._by_second_rates(by_second)[0].swapaxes(0, 1)
        return np.concatenate([by_s, by_rest])

    @property
    def accelerations(self) -> np.ndarray:
        """alpha_c z + beta_c z' + trace_c z'' (g, q, n)."""
        return np.asarray(np.einsum("crn,krn->ckn", self._pushes, self.z))

    def _virtual_z(self, zeta: np.ndarray) -> np.ndarray:
        """Return J zeta (q, n), the virtual displacement along the modes."""
        if self.constants.bent is None:
            return zeta
        return product(self._by_e[len(self.constants.T) :], zeta)

    def _by_second_moments(self, phi: np.ndarray, zeta: np.ndarray) -> np.ndarray:
        """Return the derivative of the virtual work by the modes' W (g, q, q)."""
        y = self.accelerations
        left = np.concatenate([self._virtual_z(zeta), self.z[:, 0]], axis=1)
        right = np.concatenate([y, self.dim.turned(phi, y)], axis=2)
        result: np.ndarray = left @ right.swapaxes(1, 2)  # of N_l' E_c N_k: l, k
        return result

    def _add_modal(self, every: np.ndarray, zeta: np.ndarray) -> None:
        """Add the derivatives of the rows' work by z, its rates and variation (q, 4, n)."""
        q = len(zeta)
        W = self.constants.W.reshape(-1, q, q)
        of_rows = np.einsum("ckl,kn->cln", W, self._virtual_z(zeta))
        every[:, :3] += np.einsum("crn,ckn->krn", self._pushes, of_rows)
        every[:, 3] = self.modal_inertia

    def _by_bending(self, every: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the derivative by K0 and L (., q, q), of which the symmetric part counts."""
        e, ed = x[:, 0], x[:, 1]
        half = x * np.array([0.5, 1.0, 1.0, 1.0])[:, None]
        result = e @ np.einsum("prn,krn->pnk", every, half)
        result += ed @ (every[:, 2, :, None] * ed.T)
        return np.asarray(-result)


def by_instant(x: np.ndarray) -> np.ndarray:
    """Return matrices (n, i, j) of (i, j, n)."""
    return np.ascontiguousarray(x.transpose(2, 0, 1))


def _chain(by: Sequence[np.ndarray], rates: Sequence[np.ndarray]) -> np.ndarray:
    """Return the derivative by e, e', e'' (n, i, k, 3) of f(v, v', v''), v a function of e.

    Args:
        by: of f by v, v', v'' (n, i, p).
        rates: V = dv/de, V', V'' (n, p, k).
    """
    (by_v, by_rate, by_second), (V, Vd, Vdd) = by, rates
    out = np.empty((len(V), by_v.shape[1], V.shape[2], 3))
    out[..., 0] = by_v @ V + by_rate @ Vd + by_second @ Vdd
    out[..., 1] = by_rate @ V + 2.0 * (by_second @ Vd)
    out[..., 2] = by_second @ V
    return out
