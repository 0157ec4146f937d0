"""From a body to those that hang on it: its deformed outboard interface, and joints.

Motions are triples (a, w, wd): acceleration of a frame's origin less gravity, angular velocity and
acceleration, each (n, 3) in the components of that frame; stacked (n, 9) where they are
differentiated. Loads are pairs (force, moment), stacked (n, 6). What carries a motion outwards
carries the derivatives of a function inwards by its transpose.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.multibody.shape_integrals import ModalDisplacement, Rates, ShapeIntegrals
from dolfinopt.multibody.spatial.mechanism import (
    GROUND,
    ONE,
    TRANSPOSED,
    Constants,
    Joint,
    Site,
    SpatialMechanism,
    Turning,
    about,
    axial,
    cross,
    skew,
    times,
    transposed_times,
)

Motion = tuple[np.ndarray, np.ndarray, np.ndarray]
Load = tuple[np.ndarray, np.ndarray]


class Interface:
    """An outboard interface of a body, displaced by u and turned by the rotation vector theta.

    (u, theta) = B e - 1/2 e'K0 e. Derivatives by them and their rates have six columns, u first.

    Attributes:
        body: as it moves.
        rows_of: its place among the coordinates of all interfaces of the body.
        point: (3,) reference position, m.
    """

    def __init__(self, body: BodyMotion, number: int = 0) -> None:
        """Take the body, and which of its interfaces it is."""
        self.body, constants = body, body.constants
        self.rows_of = slice(6 * number, 6 * number + 6)
        self.point, self._B = constants.points[number], constants.B[self.rows_of]
        K0 = constants.K0_outboard
        self._K0 = None if K0 is None else K0[self.rows_of]

    @cached_property
    def _stiffening(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """K0 of the interface's loads times e, e', e'' (n, 6, q); None of a linear body."""
        K0 = self._K0
        if K0 is None:
            return None
        flat = K0.transpose(1, 0, 2).reshape(K0.shape[1], -1)
        x, xd, xdd = ((one @ flat).reshape(-1, 6, K0.shape[1]) for one in self.body.rates)
        return x, xd, xdd

    @cached_property
    def B(self) -> np.ndarray:
        """Derivative of (u, theta) by e (6, q), or (n, 6, q)."""
        B, bent = self._B, self._stiffening
        return B if bent is None else B - bent[0]

    @cached_property
    def _displacement(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(u, theta) and its two derivatives (n, 6)."""
        B, (e, ed, edd) = self._B, self.body.rates
        x, xd, xdd = e @ B.T, ed @ B.T, edd @ B.T
        if (bent := self._stiffening) is not None:
            x = x - 0.5 * np.einsum("npk,nk->np", bent[0], e)
            xd = xd - np.einsum("npk,nk->np", bent[0], ed)
            xdd = xdd - np.einsum("npk,nk->np", bent[0], edd) - np.einsum("npk,nk->np", bent[1], ed)
        return x, xd, xdd

    @cached_property
    def place(self) -> np.ndarray:
        """Reference point from the body's origin (n, 3), m; of a rigid body (1, 3)."""
        point = self.point
        if not self.body.is_flexible:
            return point[None]
        return point + self._displacement[0][:, :3]

    @cached_property
    def turning(self) -> Turning:
        """Its rotation against the body's frame."""
        return Turning(*(x[:, 3:] for x in self._displacement))

    @cached_property
    def motion(self) -> Motion:
        """Its motion in its own components."""
        body = self.body
        if not body.is_flexible:
            return (
                body.a + times(body.A, np.broadcast_to(self.place, body.a.shape)),
                body.w,
                body.wd,
            )
        return tuple(transposed_times(self.turning.R, x) for x in self._unturned)  # type: ignore

    @cached_property
    def _unturned(self) -> Motion:
        """Its motion in the body's components."""
        body, turning = self.body, self.turning
        _, xd, xdd = self._displacement
        a = body.a + times(body.A, self.place) + 2.0 * cross(body.w, xd[:, :3]) + xdd[:, :3]
        wd = body.wd + cross(body.w, turning.velocity) + turning.acceleration
        return a, body.w + turning.velocity, wd

    def in_body(self, load: Load) -> Load:
        """Return a load on the interface, in its components, in those of the body."""
        if not self.body.is_flexible:
            return load
        return times(self.turning.R, load[0]), times(self.turning.R, load[1])

    def at_origin(self, load: Load) -> Load:
        """Return a load on the interface, in the body's components, about the body's origin."""
        return load[0], load[1] + cross(np.broadcast_to(self.place, load[0].shape), load[0])

    def conjugate(self, load: Load) -> np.ndarray:
        """Return what works on (u, theta) (n, 6): force and J' moment, of `in_body`."""
        return np.hstack([load[0], transposed_times(self.turning.J, load[1])])

    def rows(self, load: Load) -> np.ndarray:
        """Return the elastic rows (n, q) of a load of `in_body`."""
        pull = self.conjugate(load)
        return pull @ self.B if self.B.ndim == 2 else (pull[:, None] @ self.B)[:, 0]

    # -- derivatives -------------------------------------------------------------------------

    @cached_property
    def motion_by_body(self) -> np.ndarray:
        """Derivative of its motion by the body's (n, 9, 9)."""
        body, d = self.body, skew(self.place)
        out = np.zeros((len(body.a), 9, 9))
        out[:, :3, :3] = out[:, 3:6, 3:6] = out[:, 6:, 6:] = ONE
        out[:, :3, 3:6] = -skew(cross(body.w, self.place)) - body.Omega @ d
        out[:, :3, 6:] = -d
        if not body.is_flexible:
            return out
        out[:, :3, 3:6] -= 2.0 * skew(self._displacement[1][:, :3])
        out[:, 6:, 3:6] = -skew(self.turning.velocity)
        return self._turned(out)

    @cached_property
    def motion_by_displacement(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of its motion by (u, theta), their rates and second ones (n, 9, 6)."""
        body, turning = self.body, self.turning
        value, rate, second = np.zeros((3, len(body.a), 9, 6))
        value[:, :3, :3], rate[:, :3, :3], second[:, :3, :3] = body.A, 2.0 * body.Omega, ONE
        by_theta, J = turning.by_theta(turning.rate), turning.J
        value[:, 3:6, 3:] = by_theta
        value[:, 6:, 3:] = body.Omega @ by_theta + turning.acceleration_by_theta
        rate[:, 3:6, 3:] = second[:, 6:, 3:] = J
        rate[:, 6:, 3:] = body.Omega @ J + turning.acceleration_by_rate
        for i, x in enumerate(self._unturned):  # by the components
            value[:, 3 * i : 3 * i + 3, 3:] += skew(x) @ J
        return self._turned(value), self._turned(rate), self._turned(second)

    def _turned(self, derivative: np.ndarray) -> np.ndarray:
        """Return derivatives (n, 9, m) in the interface's components."""
        R = self.turning.R.swapaxes(1, 2)[:, None]
        shape = derivative.shape
        return (R @ derivative.reshape(len(derivative), 3, 3, -1)).reshape(shape)

    @cached_property
    def motion_by_rates(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of its motion by e, e', e'' (n, 9, q)."""
        value, rate, second = self.motion_by_displacement
        bent = self._stiffening
        by_e, by_ed, by_edd = value @ self.B, rate @ self.B, second @ self.B
        if bent is not None:
            by_e -= rate @ bent[1] + second @ bent[2]
            by_ed -= 2.0 * (second @ bent[1])
        return by_e, by_ed, by_edd

    def load_by_displacement(self, load: Load) -> np.ndarray:
        """Return the derivative of `in_body` by (u, theta) (n, 6, 6); `load` is its result."""
        out = np.zeros((len(load[0]), 6, 6))
        for i, x in enumerate(load):
            out[:, 3 * i : 3 * i + 3, 3:] = -skew(x) @ self.turning.J
        return out

    @cached_property
    def rows_by_load(self) -> np.ndarray:
        """Derivative of the rows by a load of `in_body` (n, q, 6)."""
        B = np.broadcast_to(self.B, (len(self.body.a), *self.B.shape[-2:]))
        moment = B[:, 3:].swapaxes(1, 2) @ self.turning.J.swapaxes(1, 2)
        return np.concatenate([B[:, :3].swapaxes(1, 2), moment], axis=2)

    def rows_by_e(self, load: Load) -> np.ndarray:
        """Return the derivative of the rows by e (n, q, q), a load of `in_body` held."""
        B_theta = self.B[..., 3:, :]
        own = B_theta.swapaxes(-1, -2) @ self.turning.by_theta(load[1], -1.0) @ B_theta
        K0 = self._K0
        return own if K0 is None else own - np.tensordot(self.conjugate(load), K0, 1)


class MovingJoint:
    """A joint that moves: from an interface's motion to that of the body it holds.

    Attributes:
        joint: what it is.
        inner: motion of the interface that it sits on.
        motion: of the body's frame.
    """

    def __init__(self, joint: Joint, inner: Motion, rates: Rates | None) -> None:
        """Take the interface's motion, and the coordinate with its rates (n,) if there is one."""
        self.joint, self.inner, self.rates = joint, inner, rates
        self.R, self.r = joint.rotation, joint.origin[None]
        if rates is not None and joint.kind == "revolute":
            self.R = joint.rotation @ about(joint.axis, rates[0])
        elif rates is not None:
            self.r = joint.origin + rates[0][:, None] * (joint.rotation @ joint.axis)

    @cached_property
    def _passed(self) -> Motion:
        """The interface's motion at the joint, in the body's components, the joint held."""
        a, w, wd = self.inner
        r = np.broadcast_to(self.r, a.shape)
        moved = a + cross(wd, r) + cross(w, cross(w, r)) if self.r.any() else a
        R = self.R
        return transposed_times(R, moved), transposed_times(R, w), transposed_times(R, wd)

    @cached_property
    def motion(self) -> Motion:
        """Motion of the body's frame."""
        a, w, wd = self._passed
        if self.rates is None:
            return a, w, wd
        _, sd, sdd = (x[:, None] * self.joint.axis for x in self.rates)
        if self.joint.kind == "prismatic":
            return a + 2.0 * cross(w, sd) + sdd, w, wd
        return a, w + sd, wd + cross(w, sd) + sdd

    def at_interface(self, load: Load) -> Load:
        """Return a load on the body's frame as the interface feels it, in its components."""
        force, moment = times(self.R, load[0]), times(self.R, load[1])
        return force, moment + cross(np.broadcast_to(self.r, force.shape), force)

    def drive(self, load: Load) -> np.ndarray:
        """Return what the drive gives (n,), N m or N, of a load on the body's frame."""
        force: np.ndarray = load[0 if self.joint.kind == "prismatic" else 1] @ self.joint.axis
        return force

    @property
    def driven(self) -> np.ndarray:
        """Derivative of `drive` by the load (6,)."""
        out = np.zeros(6)
        out[slice(0, 3) if self.joint.kind == "prismatic" else slice(3, 6)] = self.joint.axis
        return out

    # -- derivatives -------------------------------------------------------------------------

    @cached_property
    def motion_by_interface(self) -> np.ndarray:
        """Derivative of the motion by the interface's (n, 9, 9)."""
        a, w, _ = self.inner
        out = np.zeros((len(a), 9, 9))
        turn = self.R.swapaxes(-1, -2)
        out[:, :3, :3] = out[:, 3:6, 3:6] = out[:, 6:, 6:] = turn
        r = np.broadcast_to(self.r, a.shape)
        S = skew(r)
        out[:, :3, 3:6] = turn @ (-skew(cross(w, r)) - skew(w) @ S)
        out[:, :3, 6:] = -(turn @ S)
        if self.rates is not None:
            slides = self.joint.kind == "prismatic"
            by_w = -skew(self.rates[1][:, None] * self.joint.axis) @ turn
            if slides:
                out[:, :3, 3:6] += 2.0 * by_w
            else:
                out[:, 6:, 3:6] = by_w
        return out

    @cached_property
    def motion_by_joint(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of the motion by the coordinate, its rate and second one (n, 9)."""
        assert self.rates is not None
        value, rate, second = np.zeros((3, len(self.inner[0]), 9))
        axis = self.joint.axis
        a, w, wd = self._passed
        if self.joint.kind == "prismatic":
            value[:, :3] = cross(wd, axis) + cross(w, cross(w, axis))
            rate[:, :3], second[:, :3] = 2.0 * cross(w, axis), axis
            return value, rate, second
        turned = cross(w, axis)  # -axis x w
        value[:, :3], value[:, 3:6] = cross(a, axis), turned
        value[:, 6:] = cross(wd, axis) + cross(turned, self.rates[1][:, None] * axis)
        rate[:, 3:6], rate[:, 6:], second[:, 6:] = axis, turned, axis
        return value, rate, second

    @cached_property
    def load_by_body(self) -> np.ndarray:
        """Derivative of `at_interface` by the load (n, 6, 6)."""
        out = np.zeros((len(self.inner[0]), 6, 6))
        out[:, :3, :3] = out[:, 3:, 3:] = self.R
        out[:, 3:, :3] = skew(self.r) @ self.R
        return out

    def load_by_joint(self, load: Load) -> np.ndarray:
        """Return the derivative of `at_interface` by the coordinate (n, 6)."""
        axis, out = self.joint.axis, np.zeros((len(load[0]), 6))
        if self.joint.kind == "prismatic":
            out[:, 3:] = cross(self.joint.rotation @ axis, times(self.R, load[0]))
            return out
        out[:, :3] = times(self.R, cross(axis, load[0]))
        turned = times(self.R, cross(axis, load[1]))
        out[:, 3:] = turned + cross(np.broadcast_to(self.r, turned.shape), out[:, :3])
        return out


# -- one body that moves and deforms: its inertia force and elastic rows, and their derivatives
#
# The position of a point is p = N eta, see `shape_integrals`; its acceleration in the components of
# the body's frame is a + A p + 2 Omega p' + p'' with A = wd~ + w~ w~, Omega = w~. So
#     F = m a + A s + 2 Omega s' + s'',
#     T = s x a + axial(G A' + 2 H Omega' + I),
#     f = a . C + A_ab W_ab eta + 2 Omega_ab W_ab eta' + W_aa eta'' + K e + D e'
# with s = w eta, G_ab = int p_a p_b, H_ab = int p_a p'_b, I_ab = int p_a p''_b. Geometric stiffness
# K0 of the accelerations a and A_ab takes 1/2 e'K0 e from s and from int p_a X_b, and K0 e from
# their derivatives C and W_ab eta by e. In products of the modes with each other the place of e is
# taken by z, see `modal_displacement`. Loads are stacked (F, T), motions (a, w, wd).
# Source: Schwertassek & Wallrapp (1999); Wallrapp & Schwertassek (1991),
# doi:10.1002/nme.1620320818.

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


# -- where every body of a machine in space is: frames and outboard interfaces, n instants -------


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of all bodies against the world's; b bodies in the mechanism's order.

    Attributes:
        origin: (n, b, 3) of every body's frame, where its joint is, m.
        rotation: (n, b, 3, 3) from every body's frame to the world's.
        outboard: (n, b, 3) of every body's first outboard interface, m.
        parents: of every body, or `GROUND`.
        axes: (n, b, 3) unit vectors along the joints' axes.
        held: (n, b, 3) of the interface that every body hangs on; the world's origin of those on
            the ground, m.
        end: (n, 3) of the end-effector, m.
    """

    origin: np.ndarray
    rotation: np.ndarray
    outboard: np.ndarray
    parents: tuple[int, ...]
    axes: np.ndarray
    held: np.ndarray
    end: np.ndarray

    def __getitem__(self, part: slice | np.ndarray) -> Frames:
        """Return those at some of the instants."""
        return Frames(
            self.origin[part],
            self.rotation[part],
            self.outboard[part],
            self.parents,
            self.axes[part],
            self.held[part],
            self.end[part],
        )


def body_frames(mechanism: SpatialMechanism, q_r: np.ndarray, q_e: np.ndarray) -> Frames:
    """Return the frames of all bodies.

    Args:
        mechanism: b bodies.
        q_r: (n, joints) rigid coordinates; rad or m.
        q_e: (n, N) elastic coordinates.
    """
    count, bodies = len(q_r), len(mechanism.bodies)
    still = (np.zeros((count, 3)),) * 3
    origin, outboard, held = np.zeros((3, count, bodies, 3))
    rotation = np.zeros((count, bodies, 3, 3))
    place: dict[Site, np.ndarray] = {}  # of interfaces
    turned: dict[Site, np.ndarray] = {}
    for i in mechanism.order:
        joint, own = mechanism.joints[i], None
        if (k := joint.coordinate) is not None:
            own = (q_r[:, k], *np.zeros((2, count)))
        moving = MovingJoint(joint, still, own)
        R = np.broadcast_to(np.eye(3), (count, 3, 3))
        if joint.parent != GROUND:
            site = joint.parent, joint.interface
            held[:, i], R = place[site], turned[site]
        origin[:, i] = held[:, i] + times(R, np.broadcast_to(moving.r, (count, 3)))
        rotation[:, i] = R @ moving.R
        e = q_e[:, mechanism.slices[i]]
        body = BodyMotion(mechanism.constants[i], still, (e, e, e))
        for s in range(len(body.constants.points)):
            interface = Interface(body, s)
            away = np.broadcast_to(interface.place, (count, 3))
            place[i, s] = origin[:, i] + times(rotation[:, i], away)
            turned[i, s] = rotation[:, i]
            if body.is_flexible:
                turned[i, s] = rotation[:, i] @ interface.turning.R
        outboard[:, i] = place[i, 0]
    axes = np.stack(
        [rotation[:, i] @ joint.axis for i, joint in enumerate(mechanism.joints)], axis=1
    )
    parents = tuple(joint.parent for joint in mechanism.joints)
    end = place[mechanism.end, mechanism.end_interface]
    return Frames(origin, rotation, outboard, parents, axes, held, end)
