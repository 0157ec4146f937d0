"""From a body to those that hang on it: its deformed outboard interfaces, and joints.

Motions and loads as in `body_motion`. What carries a motion outwards carries the derivatives of a
function inwards by its transpose.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.multibody.body_motion import BodyMotion, Load, Motion
from dolfinopt.multibody.dimension import (
    DIMENSIONS,
    PlaneTurning,
    Turning,
    product,
    transposed_product,
)

if TYPE_CHECKING:
    from dolfinopt.multibody.mechanism import Joint


class Interface:
    """An outboard interface of a body, displaced by u and turned by theta: a body's conjugates.

    Attributes:
        body: as it moves.
        number: which of its interfaces.
        place: reference point from the body's origin (d, n), m.
    """

    def __init__(self, body: BodyMotion, number: int = 0) -> None:
        """Take the body, and which of its interfaces it is."""
        self.body, self.number, self.dim = body, number, body.dim
        self.places = body.constants.outboard(number)
        point = body.constants.points[number][:, None]
        if body.is_flexible:
            self.u = body.conjugates[self.places][: self.dim.d]
            self.place = point + self.u[:, 0]
        else:
            self.place = np.broadcast_to(point, body.a.shape)

    @cached_property
    def turning(self) -> Turning:
        """Its rotation against the body's frame."""
        theta = self.body.conjugates[self.places][self.dim.d :]
        return self.body.constants.turning(theta[:, 0], theta[:, 1], theta[:, 2])

    @cached_property
    def _unturned(self) -> Motion:
        """Its motion in the body's components."""
        body, dim = self.body, self.dim
        a = body.a + dim.apply(body.alpha, self.place)
        if not body.is_flexible:
            return a, body.w, body.wd
        turning = self.turning
        a += dim.apply(body.beta, self.u[:, 1]) + self.u[:, 2]
        wd = body.wd + turning.acceleration
        if dim.r > 1:
            wd = wd + dim.commutator(body.w, turning.velocity)
        return a, body.w + turning.velocity, wd

    @cached_property
    def motion(self) -> Motion:
        """Its motion in its own components."""
        if not self.body.is_flexible:
            return self._unturned
        a, w, wd = self._unturned
        back = self.turning.R.swapaxes(0, 1)
        return product(back, a), self.dim.rotated(back, w), self.dim.rotated(back, wd)

    def in_body(self, load: Load) -> Load:
        """Return a load on the interface, in its components, in those of the body."""
        if not self.body.is_flexible:
            return load
        R = self.turning.R
        return product(R, load[0]), self.dim.rotated(R, load[1])

    def at_origin(self, load: Load) -> Load:
        """Return a load on the interface, in the body's components, about the body's origin."""
        return load[0], load[1] + self.dim.moment(self.place, load[0])

    def pushes(self, load: Load) -> np.ndarray:
        """Return what works on (u, theta) (b, n): force and J' moment, of `in_body`."""
        return np.concatenate([load[0], self.turning.pulled(load[1])])

    def virtual(self, body: Load, zeta: np.ndarray) -> Load:
        """Return its virtual displacement and rotation, the body's components.

        Args:
            body: those of the body's frame.
            zeta: (q, n) virtual coordinates.
        """
        p, phi = body
        p = p + self.dim.velocity(phi, self.place)
        if not self.body.is_flexible:
            return p, phi
        moved = np.einsum("pkn,kn->pn", self.body.V[self.places], zeta)
        return p + moved[: self.dim.d], phi + self.turning.pushed(moved[self.dim.d :])

    def in_interface(self, load: Load) -> Load:
        """Return vectors of the body's components in those of the interface."""
        if not self.body.is_flexible:
            return load
        back = self.turning.R.swapaxes(0, 1)
        return product(back, load[0]), self.dim.rotated(back, load[1])

    # -- derivatives: arrays (d + 2 r, ..., n) of motions, (d + r, ..., n) of loads -----------

    @cached_property
    def _by_spin(self) -> np.ndarray:
        """Derivative of the acceleration by the body's angular velocity (d, r, n)."""
        body, dim = self.body, self.dim
        out = dim.centripetal_by_spin(body.w, self.place)
        return out + 2.0 * dim.by_spin(self.u[:, 1]) if body.is_flexible else out

    def moved_by_body(self, motion: np.ndarray) -> np.ndarray:
        """Return the derivative of its motion, not turned yet, from that of the body's."""
        dim, d, r = self.dim, self.dim.d, self.dim.r
        w, wd = motion[d : d + r], motion[d + r :]
        out = motion.copy()
        out[:d] += dim.velocity(wd, self.place)
        out[:d] += product(self._by_spin, w)
        if self.body.is_flexible and r > 1:
            out[d + r :] -= dim.commutator(self.turning.velocity, w)
        return out

    @cached_property
    def _by_theta(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Derivatives of w and wd by theta, and of wd by theta'; None: zero, in the plane."""
        turning, w, dim = self.turning, self.body.w, self.dim
        if isinstance(turning, PlaneTurning):
            return None
        by_theta = turning.by_theta(turning.rate)
        of_wd = dim.commutator(w, by_theta) + turning.acceleration_by_theta
        return by_theta, of_wd, dim.commutator(w, turning.J) + turning.acceleration_by_rate

    def moved_by_rates(self, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the derivatives of its motion, not turned yet, by those e, e', e'' kept.

        What turns with the interface is counted: the derivatives are those of its components.
        """
        body, dim, d, r = self.body, self.dim, self.dim.d, self.dim.r
        B = body.V[self.places][:, kept]
        u, theta = B[:d], B[d:]
        by_e, by_ed, by_edd = np.zeros((3, d + 2 * r, *u.shape[1:]))
        phi = self.turning.pushed(theta)
        a, w, wd = self._unturned
        by_e[:d] = dim.apply(body.alpha, u) - dim.velocity(phi, a)
        by_ed[:d], by_edd[:d] = dim.apply(body.beta, u), u
        by_ed[d : d + r] = by_edd[d + r :] = phi
        if (by_theta := self._by_theta) is not None:
            of_w, of_wd, of_rate = by_theta
            by_e[d : d + r] = product(of_w, theta) + dim.commutator(w, phi)
            by_e[d + r :] = product(of_wd, theta) + dim.commutator(wd, phi)
            by_ed[d + r :] = product(of_rate, theta)
        if (rates := body.rates_by_e) is not None:
            Bd, Bdd = (x[self.places][:, kept] for x in rates)
            turned, second = self.turning.pushed(Bd[d:]), self.turning.pushed(Bdd[d:])
            by_e[:d] += dim.apply(body.beta, Bd[:d]) + Bdd[:d]
            by_ed[:d] += 2.0 * Bd[:d]
            by_e[d : d + r] += turned
            by_e[d + r :] += second
            by_ed[d + r :] += 2.0 * turned
            if by_theta is not None:
                by_e[d + r :] += product(by_theta[2], Bd[d:])
        return by_e, by_ed, by_edd

    def turned(self, motion: np.ndarray) -> np.ndarray:
        """Return the derivative of its motion in its own components."""
        d, r, back = self.dim.d, self.dim.r, self.turning.R.swapaxes(0, 1)
        parts = motion[:d], motion[d : d + r], motion[d + r :]
        a, w, wd = parts
        rotated = self.dim.rotated
        return np.concatenate([product(back, a), rotated(back, w), rotated(back, wd)])

    def pulled_back(self, by: Motion) -> tuple[Motion, Motion]:
        """Return derivatives by the body's motion from those by the interface's (n).

        And those by (u, theta), their rates and second ones, each (b, n); nothing of a rigid body.
        """
        body, dim = self.body, self.dim
        a, w, wd = by
        place = self.place
        if not body.is_flexible:
            by_w = w + transposed_product(self._by_spin, a)
            return (a, by_w, wd + dim.moment(place, a)), (a[:0], a[:0], a[:0])
        turning, R = self.turning, self.turning.R
        a, w, wd = product(R, a), dim.rotated(R, w), dim.rotated(R, wd)
        own_a, own_w, own_wd = self._unturned
        by_w = w + transposed_product(self._by_spin, a) + dim.commutator(turning.velocity, wd)
        turn = dim.commutator(w, own_w) + dim.commutator(wd, own_wd) - dim.moment(own_a, a)
        value, rate, second = turning.pulled(turn), turning.pulled(w), turning.pulled(wd)
        if (by_theta := self._by_theta) is not None:
            of_w, of_wd, of_rate = by_theta
            value = value + transposed_product(of_w, w) + transposed_product(of_wd, wd)
            rate = rate + transposed_product(of_rate, wd)
        moved = (
            np.concatenate([dim.applied_transposed(body.alpha, a), value]),
            np.concatenate([dim.applied_transposed(body.beta, a), rate]),
            np.concatenate([a, second]),
        )
        return (a, by_w, wd + dim.moment(place, a)), moved

    def load_by_rates(self, load: Load, kept: np.ndarray) -> np.ndarray:
        """Return the derivative of `in_body` by those e kept (d + r, k, n); `load` its result."""
        dim = self.dim
        phi = self.turning.pushed(self.body.V[self.places][self.dim.d :, kept])
        return np.concatenate([dim.velocity(phi, load[0]), dim.commutator(phi, load[1])])

    def pushes_by_e(self, load: Load, kept: np.ndarray) -> np.ndarray | None:
        """Return the derivative of J' moment by those e kept (r, k, n); None: zero."""
        by_theta = self.turning.by_theta(load[1], -1.0)
        if by_theta is None:
            return None
        return product(by_theta, self.body.V[self.places][self.dim.d :, kept])

    @cached_property
    def rows_by_load(self) -> np.ndarray:
        """Derivative of the rows by a load of `in_body` (d + r, q, n)."""
        B, d = self.body.V[self.places], self.dim.d
        return np.concatenate([B[:d], self.turning.pushed(B[d:])])


class MovingJoint:
    """A joint that moves: from an interface's motion to that of the body it holds.

    Attributes:
        joint: what it is.
        inner: motion of the interface that it sits on.
        R: (d, d, n) from the body's frame to the interface's, or one (d, d).
        r: (d, n) or (d, 1) from the interface to the body's origin, m.
    """

    def __init__(self, joint: Joint, inner: Motion, rates: np.ndarray | None) -> None:
        """Take the interface's motion, and the coordinate with its rates (3, n) if there is one."""
        self.joint, self.inner, self.rates = joint, inner, rates
        self.dim = DIMENSIONS[len(joint.origin)][0]
        self.slides = joint.kind == "prismatic"
        self.R, self.r = joint.rotation, joint.origin[:, None]
        if rates is None:
            return
        if self.slides:
            self.r = self.r + (joint.rotation @ joint.axis)[:, None] * rates[0]
            return
        # Of a column NumPy takes other instructions, and another last bit, where the end of its
        # stride touches the memory of the result.
        angle = np.ascontiguousarray(rates[0])
        turns = np.stack([np.ones_like(angle), np.sin(angle), 1.0 - np.cos(angle)])
        self.R = joint.turns @ turns

    @cached_property
    def _rate(self) -> np.ndarray:
        """Relative velocity or angular velocity, in the body's components (., n)."""
        assert self.rates is not None
        return self.joint.axis[:, None] * self.rates[1]

    @cached_property
    def is_offset(self) -> bool:
        """Whether the body's origin is not the interface's."""
        return bool(self.r.any())

    @cached_property
    def _passed(self) -> Motion:
        """The interface's motion at the joint, in the body's components, the joint held."""
        (a, w, wd), dim, back = self.inner, self.dim, self.R.swapaxes(0, 1)
        if self.is_offset:
            a = a + dim.apply(dim.alpha(w, wd), np.broadcast_to(self.r, a.shape))
        return product(back, a), dim.rotated(back, w), dim.rotated(back, wd)

    @cached_property
    def motion(self) -> Motion:
        """Motion of the body's frame."""
        a, w, wd = self._passed
        if self.rates is None:
            return a, w, wd
        second, dim = self.joint.axis[:, None] * self.rates[2], self.dim
        if self.slides:
            return a + 2.0 * dim.velocity(w, self._rate) + second, w, wd
        if dim.r > 1:
            wd = wd + dim.commutator(w, self._rate)
        return a, w + self._rate, wd + second

    def at_interface(self, load: Load) -> Load:
        """Return a load on the body's frame as the interface feels it, in its components."""
        force, moment = product(self.R, load[0]), self.dim.rotated(self.R, load[1])
        if self.is_offset:
            moment = moment + self.dim.moment(self.r, force)
        return force, moment

    def drive(self, load: Load) -> np.ndarray:
        """Return what the drive gives (..., n), N m or N, of a load on the body's frame."""
        return np.tensordot(self.joint.axis, load[0 if self.slides else 1], 1)

    def virtual(self, interface: Load, drive: np.ndarray | None) -> Load:
        """Return displacement and rotation of the body's frame, its components.

        Args:
            interface: those of the interface.
            drive: (n,) virtual coordinate.
        """
        p, phi = interface
        if self.is_offset:
            p = p + self.dim.velocity(phi, self.r)
        back = self.R.swapaxes(0, 1)
        p, phi = product(back, p), self.dim.rotated(back, phi)
        if drive is None:
            return p, phi
        own = self.joint.axis[:, None] * drive
        return (p + own, phi) if self.slides else (p, phi + own)

    # -- derivatives -------------------------------------------------------------------------

    def moved_by_interface(self, motion: np.ndarray) -> np.ndarray:
        """Return the derivative of the motion from that of the interface's (d + 2 r, ..., n)."""
        dim, d, r, back = self.dim, self.dim.d, self.dim.r, self.R.swapaxes(0, 1)
        a, w, wd = motion[:d], motion[d : d + r], motion[d + r :]
        if self.is_offset:
            a = a + dim.velocity(wd, self.r)
            a += product(dim.centripetal_by_spin(self.inner[1], self.r), w)
        a, w, wd = product(back, a), dim.rotated(back, w), dim.rotated(back, wd)
        if self.rates is not None and self.slides:
            a = a + 2.0 * dim.velocity(w, self._rate)
        elif self.rates is not None and r > 1:
            wd = wd - dim.commutator(self._rate, w)
        return np.concatenate([a, w, wd])

    def pulled_back(self, by: Motion) -> Motion:
        """Return derivatives by the interface's motion from those by the body's."""
        (a, w, wd), dim, R = by, self.dim, self.R
        if self.rates is not None and self.slides:
            w = w + 2.0 * dim.moment(self._rate, a)
        elif self.rates is not None:
            w = w + dim.commutator(self._rate, wd)
        a, w, wd = product(R, a), dim.rotated(R, w), dim.rotated(R, wd)
        if self.is_offset:
            w = w + transposed_product(dim.centripetal_by_spin(self.inner[1], self.r), a)
            wd = wd + dim.moment(self.r, a)
        return a, w, wd

    @cached_property
    def moved_by_joint(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of the motion by the coordinate and its rates (d + 2 r, n)."""
        dim, d, r = self.dim, self.dim.d, self.dim.r
        (a, w, wd), axis = self._passed, self.joint.axis[:, None]
        value, rate, second = np.zeros((3, d + 2 * r, a.shape[1]))
        along = np.broadcast_to(axis, (len(axis), a.shape[1]))
        if self.slides:
            value[:d] = dim.apply(dim.alpha(w, wd), along)
            rate[:d], second[:d] = 2.0 * dim.velocity(w, along), axis
            return value, rate, second
        turned = dim.commutator(w, along)
        value[:d], value[d : d + r] = -dim.velocity(along, a), turned
        value[d + r :] = dim.commutator(wd, along) + dim.commutator(turned, self._rate)
        rate[d : d + r], rate[d + r :], second[d + r :] = axis, turned, axis
        return value, rate, second

    def load_by_joint(self, load: Load) -> np.ndarray:
        """Return the derivative of `at_interface` by the coordinate (d + r, n)."""
        dim, R = self.dim, self.R
        along = np.broadcast_to(self.joint.axis[:, None], (len(self.joint.axis), load[0].shape[1]))
        if self.slides:
            axis = self.joint.rotation @ along
            force = np.zeros_like(load[0])
            return np.concatenate([force, dim.moment(axis, product(R, load[0]))])
        force = product(R, dim.velocity(along, load[0]))
        moment = dim.rotated(R, dim.commutator(along, load[1]))
        if self.is_offset:
            moment = moment + dim.moment(self.r, force)
        return np.concatenate([force, moment])
