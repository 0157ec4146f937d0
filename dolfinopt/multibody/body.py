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

from functools import cached_property

import numpy as np

from dolfinopt.multibody.dimension import DIMENSIONS, product
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, rigid_body

Motion = tuple[np.ndarray, np.ndarray, np.ndarray]


class Constants:
    """One body's integrals as the equations use them; q modes, P pushes.

    Attributes:
        body: the integrals.
        dim: what differs between the plane and space.
        mass: kg.
        T: (P, q) conjugates of the pushes by the coordinates.
        K0: (P, q, q) geometric stiffness by every push, None of a linear body.
        L: (q, q, q) of the displacement along the modes, or None.
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
        self.K0 = self.L = None
        if body.is_stiffened:
            self.K0 = np.concatenate([body.K0[self.dim.loads], body.K0_outboard])
            self.L = body.along_modes if len(body.along_modes) else None
        self.mass = body.mass
        self.c, self.W_rest = body.w[:, :1], body.W[:, :1, 0]
        self.is_point = q == 0 and not self.c.any()
        self.W = np.ascontiguousarray(body.W[:, 1:, 1:]).reshape(self.dim.g * q, q)
        self.M = body.M
        self.K = _diagonal_or_matrix(body.K)
        self.D = _diagonal_or_matrix(body.D) if body.D.any() else None
        self.points = body.points if self.dim.d == 3 else body.outboard_point[None]

    @classmethod
    def of_point(cls, mass: float, inertia: float) -> Constants:
        """Return those of a mass (kg) with rotary inertia (kg m2) at the origin, in the plane."""
        return cls(rigid_body(mass, np.zeros(2), inertia, np.zeros(2)))

    @cached_property
    def bent(self) -> np.ndarray:
        """K0, and L behind it where there is one ((P + q) q, q)."""
        assert self.K0 is not None
        every = self.K0 if self.L is None else np.concatenate([self.K0, self.L])
        return every.reshape(-1, self.num_modes)

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
        q, _, count = self.rates.shape
        return (self.constants.bent @ self.rates[:, rate]).reshape(-1, q, count)

    @cached_property
    def _bent(self) -> np.ndarray:
        return self._bent_by(0)

    @cached_property
    def _bent_rate(self) -> np.ndarray:
        return self._bent_by(1)

    @cached_property
    def _every(self) -> np.ndarray:
        """Conjugates of all pushes and z, with their rates (P + q, 3, n)."""
        constants, (q, _, count) = self.constants, self.rates.shape
        linear = (constants.T @ self.rates.reshape(q, -1)).reshape(-1, 3, count)
        if constants.K0 is None:
            return linear
        if constants.L is not None:
            linear = np.concatenate([linear, self.rates])
        e, ed, edd = (self.rates[:, i] for i in range(3))
        bent = np.empty(linear.shape, dtype=self._bent.dtype)
        bent[:, 0] = 0.5 * np.einsum("pkn,kn->pn", self._bent, e)
        bent[:, 1] = np.einsum("pkn,kn->pn", self._bent, ed)
        bent[:, 2] = np.einsum("pkn,kn->pn", self._bent, edd)
        bent[:, 2] += np.einsum("pkn,kn->pn", self._bent_rate, ed)
        return np.asarray(linear - bent)

    @cached_property
    def conjugates(self) -> np.ndarray:
        """Conjugates of the pushes and their rates (P, 3, n)."""
        return self._every[: len(self.constants.T)]

    @cached_property
    def z(self) -> np.ndarray:
        """Displacement along the modes and its rates (q, 3, n)."""
        return self.rates if self.constants.L is None else self._every[len(self.constants.T) :]

    @cached_property
    def _by_e(self) -> np.ndarray:
        """V, and J behind it where z is not e (P + q, q, n)."""
        constants = self.constants
        if constants.K0 is None:
            return np.broadcast_to(constants.T[..., None], (*constants.T.shape, self.w.shape[1]))
        T = constants.T
        if constants.L is not None:
            T = np.concatenate([T, np.eye(constants.num_modes)])
        return T[..., None] - self._bent

    @cached_property
    def V(self) -> np.ndarray:
        """Derivative of the conjugates by e (P, q, n)."""
        return self._by_e[: len(self.constants.T)]

    @cached_property
    def _J(self) -> np.ndarray:
        """Derivative of z by e (q, q, n), where z is not e."""
        return self._by_e[len(self.constants.T) :]

    @cached_property
    def rates_by_e(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Derivatives of V's and J's first and second rate by e (P + q, q, n); None: zero."""
        if self.constants.K0 is None:
            return None
        return -self._bent_rate, -self._bent_by(2)

    def jacobian_transposed(self, x: np.ndarray) -> np.ndarray:
        """Return J' x: forces by z as forces by e, (q, n) or (m, q, n)."""
        if self.constants.L is None:
            return x
        out: np.ndarray = np.einsum("...ln,lkn->...kn", x, self._J)
        return out

    # -- integrals of the deformed body ------------------------------------------------------

    @cached_property
    def _Wz(self) -> np.ndarray:
        """W_c of the modes times z, z', z'' (g, q, 3, n)."""
        q, _, count = self.rates.shape
        return (self.constants.W @ self.z.reshape(q, -1)).reshape(-1, q, 3, count)

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
        found = np.einsum("ckrn,kn->crn", self._Wz, self.z[:, 0]) + self.dim.transposed(v)
        return rest + v[:, 0] + found[:, 0], found[:, 1], found[:, 2]

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

    def rows(self, outboard: dict[int, np.ndarray]) -> np.ndarray:
        """Return the elastic rows (q, n) under pushes of the interfaces, by number."""
        constants, p = self.constants, self.load_coefficients(outboard)
        f = self.jacobian_transposed(self.modal_inertia)
        if constants.K0 is None:
            f = f + constants.T.T @ p
        else:
            f = f + np.einsum("pn,pkn->kn", p, self.V)
        f = f + weighted(constants.K, self.rates[:, 0])
        if constants.D is not None:
            f += weighted(constants.D, self.rates[:, 1])
        return f

    # -- derivatives -------------------------------------------------------------------------

    @cached_property
    def load_by_motion(self) -> np.ndarray:
        """Derivative of (F, T) by (a, w, wd), (d + r, d + 2 r, n)."""
        dim, (s, sd, _), (G, H, _) = self.dim, self.moments, self.second_moments
        d, r = dim.d, dim.r
        out = np.zeros((d + r, d + 2 * r, self.a.shape[1]))
        out[range(d), range(d)] = self.constants.mass
        spun = dim.by_spin(s)
        out[:d, d : d + r] = dim.centripetal_by_spin(self.w, s) + 2.0 * dim.by_spin(sd)
        out[:d, d + r :], out[d:, :d] = spun, spun.swapaxes(0, 1)
        out[d:, d : d + r], out[d:, d + r :] = dim.torque_by_spin(self.w, G, H)
        return out

    @cached_property
    def rows_by_motion(self) -> np.ndarray:
        """Derivative of the rows by (a, w, wd), (d + 2 r, q, n)."""
        by_w, by_wd = self.dim.contracted_by_spin(self.w, self.Y, self.Yd)
        return np.concatenate([self.V[: self.dim.d], by_w, by_wd])

    def load_by_rates(self, kept: np.ndarray) -> np.ndarray:
        """Return the derivatives of (F, T) by those e, e', e'' kept (d + r, 3, k, n)."""
        dim, P = self.dim, len(self.constants.T)
        d, across = dim.d, slice(dim.d, dim.d + dim.g)
        C, Y, Yd = self.V[:d, kept], self.Y[:, kept], self.Yd[:, kept]
        turned = dim.transposed(Y)
        first, second = Yd, self.jacobian_transposed(self._Wz[:, :, 2])[:, kept]
        by_e = dim.apply(self.alpha, C)
        by_ed = dim.apply(self.beta, C)
        moved = None
        if (rates := self.rates_by_e) is not None:
            vd, vdd = rates[0][:, kept], rates[1][:, kept]
            by_e += dim.apply(self.beta, vd[:d]) + vdd[:d]
            by_ed += 2.0 * vd[:d]
            moved, bending = (dim.transposed(x[across]) for x in (vd, vdd))
            if self.constants.L is not None:
                z = dim.transposed(self._Wz[:, :, 0])
                moved = moved + np.einsum("cln,lkn->ckn", z, vd[P:])
                bending = bending + np.einsum("cln,lkn->ckn", z, vdd[P:])
            first, second = first + moved, second + bending
        T_e = dim.moment(C, self.a) + dim.torque(self.alpha, Y + turned)
        T_e += dim.torque(self.beta, first) + dim.axial(second)
        T_ed = dim.torque(self.beta, turned)
        if moved is not None:
            T_ed += 2.0 * dim.axial(moved)
        out = np.empty((d + dim.r, 3, *C.shape[1:]))
        out[:d, 0], out[:d, 1], out[:d, 2] = by_e, by_ed, C
        out[d:, 0], out[d:, 1], out[d:, 2] = T_e, T_ed, dim.axial(turned)
        return out

    def rows_by_rates(
        self, kept: np.ndarray, outboard: dict[int, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the derivatives of the rows by those e, e', e'' kept, pushes held.

        (n, q, k); the mass (q, k) if it is the same at all instants.
        """
        constants, q = self.constants, self.constants.num_modes
        if constants.L is None:
            by_e, by_ed, by_edd = *self._modal_tangent(kept), constants.M[:, kept]
            held = self.load_coefficients(outboard)
        else:
            by_z, by_zd = self._modal_tangent(np.arange(q))
            assert self.rates_by_e is not None
            P = len(constants.T)
            J, Jd, Jdd = (
                np.ascontiguousarray(x[P:].transpose(2, 0, 1))
                for x in (self._by_e, *self.rates_by_e)
            )
            left, own = J.swapaxes(1, 2), J[:, :, kept]
            M = constants.M
            by_e = left @ (by_z @ own + by_zd @ Jd[:, :, kept] + M @ Jdd[:, :, kept])
            by_ed = left @ (by_zd @ own + 2.0 * (M @ Jd[:, :, kept]))
            by_edd = left @ (M @ own)
            held = np.concatenate([self.load_coefficients(outboard), self.modal_inertia])
        if constants.K0 is not None:
            bent = constants.bent.reshape(len(held), q, q)[:, :, kept]
            by_e -= (held.T @ bent.reshape(len(held), q * len(kept))).reshape(by_e.shape)
        by_e += constants.body.K[:, kept]
        if constants.D is not None:
            by_ed += constants.body.D[:, kept]
        return by_e, by_ed, by_edd

    def _modal_tangent(self, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of `modal_inertia` by those z and z' kept (n, q, k)."""
        q = self.constants.num_modes
        W = self.constants.W.reshape(-1, q, q)[:, :, kept]
        flat, shape = W.reshape(len(W), q * len(kept)), (self.w.shape[1], q, len(kept))
        by_z, by_zd = ((x.T @ flat).reshape(shape) for x in (self.alpha, self.beta))
        return by_z, by_zd

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
        p, phi = virtual[:d], virtual[d:]
        turned = self.dim.turned(phi, self._pushes)
        every = np.zeros((P, 4, zeta.shape[1]))
        every[:ends] = self._by_conjugates(p, phi, turned)
        for s, one in outboard.items():
            every[constants.outboard(s)] = one
        x = np.concatenate([self.rates, zeta[:, None]], axis=1)
        by_T = np.tensordot(every, x, ((1, 2), (1, 2)))
        pushed = zeta if constants.L is None else product(self._J, zeta)
        W = np.zeros_like(body.W)
        W[:, 0, 0], W[:, 1:, 0] = turned[:, 0].sum(axis=1), by_T[d:ends]
        W[:, 1:, 1:] = self._by_second_moments(phi, pushed)
        inertial, bent = np.zeros_like(body.K0), np.zeros((0, *body.K.shape))
        if constants.K0 is not None:
            if constants.L is not None:
                every = np.concatenate([every, self._by_z(turned, pushed)])
            bent = self._by_bending(every, x)
            inertial[self.dim.loads] = bent[:ends]
        return ShapeIntegrals(
            mass=float((p * self.a).sum()),
            w=np.column_stack([every[:d, 0].sum(axis=1), by_T[:d]]),
            W=W,
            K=zeta @ self.rates[:, 0].T,
            D=zeta @ self.rates[:, 1].T,
            outboard=by_T[ends:],
            outboard_point=np.zeros(d),
            K0=inertial,
            K0_outboard=bent[ends:P],
            further_points=np.zeros_like(body.further_points),
            along_modes=bent[P:].reshape(body.along_modes.shape),
        )

    def _by_conjugates(self, p: np.ndarray, phi: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """Return the derivatives by the conjugates of a and alpha (d + g, 4, n)."""
        dim, d = self.dim, self.dim.d
        out = np.empty((d + dim.g, 4, p.shape[1]))
        out[:d, 0] = dim.applied_transposed(self.alpha, p) - dim.velocity(phi, self.a)
        out[:d, 1], out[:d, 2], out[:d, 3] = dim.applied_transposed(self.beta, p), p, self.a
        out[d:, :3], out[d:, 3] = dim.transposed(turned), self.alpha
        out[d:, 0] += turned[:, 0]
        return out

    @property
    def accelerations(self) -> np.ndarray:
        """alpha_c z + beta_c z' + trace_c z'' (g, q, n)."""
        return np.asarray(np.einsum("crn,krn->ckn", self._pushes, self.z))

    def _by_second_moments(self, phi: np.ndarray, pushed: np.ndarray) -> np.ndarray:
        """Return the derivative of the virtual work by the modes' W (g, q, q)."""
        y = self.accelerations
        left = np.concatenate([pushed, self.z[:, 0]], axis=1)
        right = np.concatenate([y, self.dim.turned(phi, y)], axis=2)
        found: np.ndarray = left @ right.swapaxes(1, 2)  # of N_l' E_c N_k: l, k
        return found

    def _by_z(self, turned: np.ndarray, pushed: np.ndarray) -> np.ndarray:
        """Return the derivatives of the virtual work by z, its rates and variation (q, 4, n)."""
        constants, q = self.constants, len(pushed)
        of_rows = np.einsum("ckl,kn->cln", constants.W.reshape(-1, q, q), pushed)
        across = self.dim.transposed(self._Wz[:, :, 0])
        by_z = np.einsum("crn,ckn->krn", self._pushes, of_rows)
        by_z += np.einsum("crn,ckn->krn", turned, across)
        by_z[:, 0] += np.einsum("crn,ckrn->kn", turned, self._Wz)
        return np.concatenate([by_z, self.modal_inertia[:, None]], axis=1)

    def _by_bending(self, every: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the derivative by K0 and L (., q, q), of which the symmetric part counts."""
        e, ed = x[:, 0], x[:, 1]
        half = x * np.array([0.5, 1.0, 1.0, 1.0])[:, None]
        found = e @ np.einsum("prn,krn->pnk", every, half)
        found += ed @ (every[:, 2, :, None] * ed.T)
        return np.asarray(-found)
