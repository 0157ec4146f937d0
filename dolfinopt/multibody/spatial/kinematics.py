"""From a body to those that hang on it: its deformed outboard interface, and joints.

Motions are triples (a, w, wd): acceleration of a frame's origin less gravity, angular velocity and
acceleration, each (n, 3) in the components of that frame; stacked (n, 9) where they are
differentiated. Loads are pairs (force, moment), stacked (n, 6). What carries a motion outwards
carries the derivatives of a function inwards by its transpose.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from dolfinopt.multibody.modal_displacement import Rates
from dolfinopt.multibody.spatial.body_motion import BodyMotion
from dolfinopt.multibody.spatial.mechanism import Joint
from dolfinopt.multibody.spatial.rotations import (
    ONE,
    Turning,
    about,
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
