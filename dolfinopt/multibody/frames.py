"""From a body to those that hang on it: interfaces, joints and the rotors that drive them.

Motions and loads as in `body`. What carries a motion outwards carries the derivatives of a
function inwards by its transpose.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.multibody.body import BodyMotion, Motion
from dolfinopt.multibody.dimension import (
    DIMENSIONS,
    Dimension,
    PlaneTurning,
    Turning,
    product,
    transposed_product,
)
from dolfinopt.multibody.tree import Joint


@dataclass(frozen=True, eq=False)
class MotionTransform:
    """Derivative of one frame's motion by that of the one that carries it, at n instants.

    Its blocks are (., ., n), or some of them (., .) alike at all instants; None: zero.

    Attributes:
        dim: plane or space.
        turn: the rotation into the components of the one carried.
        by_w, by_wd: of its acceleration (d, r, n).
        turned: of its angular acceleration by w (r, r, n).
    """

    dim: Dimension
    turn: np.ndarray
    by_w: np.ndarray | None
    by_wd: np.ndarray | None
    turned: np.ndarray | None = None

    @cached_property
    def matrix(self) -> np.ndarray:
        """It as matrices (n, d + 2 r, d + 2 r), or one."""
        d, r = self.dim.d, self.dim.r
        some = self.turn, self.by_w, self.by_wd, self.turned
        counts = {x.shape[2] for x in some if x is not None and x.ndim == 3}
        out = np.zeros((max(counts, default=1), d + 2 * r, d + 2 * r))
        a, w, wd = slice(0, d), slice(d, d + r), slice(d + r, d + 2 * r)
        rotated = self.turn if r == d else np.ones((1, 1))
        blocks = (a, a, self.turn), (w, w, rotated), (wd, wd, rotated), (wd, w, self.turned)
        for rows, columns, block in (*blocks, (a, w, self.by_w), (a, wd, self.by_wd)):
            if block is not None:
                out[:, rows, columns] = block if block.ndim == 2 else block.transpose(2, 0, 1)
        return out

    @cached_property
    def of_loads(self) -> np.ndarray:
        """What carries a load on the one frame to the origin of the other (n, d + r, d + r)."""
        # Forces and moments work on displacements and rotations as a and wd go.
        d, r = self.dim.d, self.dim.r
        kept = np.r_[0:d, d + r : d + 2 * r]
        return self.matrix[:, kept[:, None], kept].swapaxes(1, 2)

    def transposed(self, by: np.ndarray) -> np.ndarray:
        """Return derivatives by the carrying frame's motion from those by the carried one's."""
        d, s = self.dim.d, self.dim.b  # where w and wd begin; (d + 2 r, n) both
        back, a, wd = self.turn.swapaxes(0, 1), by[:d], by[s:]
        found = self.dim.turn(back, by)
        blocks = (d, s, self.by_w, a), (s, None, self.by_wd, a), (d, s, self.turned, wd)
        for first, last, block, x in blocks:
            if block is not None:
                found[first:last] += transposed_product(block, x)
        return found


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
        return self.body.constants.dim.turning(theta[:, 0], theta[:, 1], theta[:, 2])

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

    def in_body(self, load: np.ndarray) -> np.ndarray:
        """Return a load on the interface, in its components, in those of the body."""
        return self.dim.turn(self.turning.R, load) if self.body.is_flexible else load

    def at_origin(self, load: np.ndarray) -> np.ndarray:
        """Return a load on the interface, in the body's components, about the body's origin."""
        return self.dim.shifted(self.place, load)

    def load_coefficients(self, load: np.ndarray) -> np.ndarray:
        """Return what works on (u, theta) (b, n): force and J' moment, of `in_body`."""
        d = self.dim.d
        return np.concatenate([load[:d], self.turning.jacobian_transposed(load[d:])])

    def virtual(self, body: np.ndarray, zeta: np.ndarray) -> np.ndarray:
        """Return its virtual displacement and rotation (d + r, n), the body's components.

        Args:
            body: those of the body's frame.
            zeta: (q, n) virtual coordinates.
        """
        d, out = self.dim.d, body.copy()
        out[:d] += self.dim.velocity(body[d:], self.place)
        if self.body.is_flexible:
            moved = np.einsum("pkn,kn->pn", self.body.V[self.places], zeta)
            out += np.concatenate([moved[:d], self.turning.jacobian_times(moved[d:])])
        return out

    def in_interface(self, x: np.ndarray) -> np.ndarray:
        """Return vectors of the body's components in those of the interface."""
        if not self.body.is_flexible:
            return x
        return self.dim.turn(self.turning.R.swapaxes(0, 1), x)

    # -- derivatives: arrays (d + 2 r, ..., n) of motions, (d + r, ..., n) of loads -----------

    @cached_property
    def _by_spin(self) -> np.ndarray:
        """Derivative of the acceleration by the body's angular velocity (d, r, n)."""
        body, dim = self.body, self.dim
        out = dim.centripetal_by_spin(body.w, self.place)
        return out + 2.0 * dim.by_spin(self.u[:, 1]) if body.is_flexible else out

    @cached_property
    def passage(self) -> MotionTransform:
        """From the body's motion to its own, in its own components."""
        dim, by_w, by_wd = self.dim, self._by_spin, self.dim.by_spin(self.place)
        if not self.body.is_flexible:
            return MotionTransform(dim, np.eye(dim.d), by_w, by_wd)
        back, turned = self.turning.R.swapaxes(0, 1), None
        if dim.r > 1:
            turned = -product(back, dim.skew(self.turning.velocity))
        return MotionTransform(dim, back, product(back, by_w), product(back, by_wd), turned)

    @cached_property
    def _by_theta(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Derivatives of w and wd by theta, and of wd by theta'; None: zero, in the plane."""
        turning, w, dim = self.turning, self.body.w, self.dim
        if isinstance(turning, PlaneTurning):
            return None
        by_theta = turning.by_theta(turning.rate)
        of_wd = dim.commutator(w, by_theta) + turning.acceleration_by_theta
        return by_theta, of_wd, dim.commutator(w, turning.J) + turning.acceleration_by_rate

    def moved_by_rates(self, kept: np.ndarray) -> np.ndarray:
        """Return the derivatives of its motion by those e, e', e'' kept (d + 2 r, 3, k, n).

        What turns with the interface is counted: the derivatives are those of its components.
        """
        body, dim, d, r = self.body, self.dim, self.dim.d, self.dim.r
        B = body.V[self.places][:, kept]
        u, theta = B[:d], B[d:]
        out = np.zeros((d + 2 * r, 3, *u.shape[1:]))
        by_e, by_ed, by_edd = out.swapaxes(0, 1)
        phi = self.turning.jacobian_times(theta)
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
            turned, second = (
                self.turning.jacobian_times(Bd[d:]),
                self.turning.jacobian_times(Bdd[d:]),
            )
            by_e[:d] += dim.apply(body.beta, Bd[:d]) + Bdd[:d]
            by_ed[:d] += 2.0 * Bd[:d]
            by_e[d : d + r] += turned
            by_e[d + r :] += second
            by_ed[d + r :] += 2.0 * turned
            if by_theta is not None:
                by_e[d + r :] += product(by_theta[2], Bd[d:])
        back = self.turning.R.swapaxes(0, 1)
        return dim.turn(back, out)

    def by_displacement(self, by: np.ndarray) -> np.ndarray:
        """Return derivatives by (u, theta), their rates and second ones (b, 3, n).

        Those by its motion, in its components (d + 2 r, n), are given; of a flexible body.
        """
        body, dim, turning = self.body, self.dim, self.turning
        a, w, wd = np.split(dim.turn(turning.R, by), [dim.d, dim.b])
        own_a, own_w, own_wd = self._unturned
        turn = dim.commutator(w, own_w) + dim.commutator(wd, own_wd) - dim.moment(own_a, a)
        out = np.empty((dim.b, 3, a.shape[1]))
        out[: dim.d, 0] = dim.applied_transposed(body.alpha, a)
        out[: dim.d, 1], out[: dim.d, 2] = dim.applied_transposed(body.beta, a), a
        out[dim.d :] = turning.jacobian_transposed(np.stack([turn, w, wd], axis=1))
        if (by_theta := self._by_theta) is not None:
            of_w, of_wd, of_rate = by_theta
            out[dim.d :, 0] += transposed_product(of_w, w) + transposed_product(of_wd, wd)
            out[dim.d :, 1] += transposed_product(of_rate, wd)
        return out

    def load_by_rates(self, load: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return the derivative of `in_body` by those e kept (d + r, k, n); `load` its result."""
        dim, d = self.dim, self.dim.d
        phi = self.turning.jacobian_times(self.body.V[self.places][d:, kept])
        return np.concatenate([dim.velocity(phi, load[:d]), dim.commutator(phi, load[d:])])

    def coefficients_by_e(self, load: np.ndarray, kept: np.ndarray) -> np.ndarray | None:
        """Return the derivative of J' moment by those e kept (r, k, n); None: zero."""
        by_theta = self.turning.by_theta(load[self.dim.d :], -1.0)
        if by_theta is None:
            return None
        return product(by_theta, self.body.V[self.places][self.dim.d :, kept])

    @cached_property
    def rows_by_load(self) -> np.ndarray:
        """Derivative of the rows by a load of `in_body` (d + r, q, n)."""
        B, d = self.body.V[self.places], self.dim.d
        return np.concatenate([B[:d], self.turning.jacobian_times(B[d:])])

    @cached_property
    def rows_by_own_load(self) -> np.ndarray:
        """Derivative of the rows by a load in its own components (d + r, q, n)."""
        return self.in_interface(self.rows_by_load)


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
        self.dim = DIMENSIONS[len(joint.origin)]
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

    def at_interface(self, load: np.ndarray) -> np.ndarray:
        """Return a load on the body's frame as the interface feels it, in its components."""
        out = self.dim.turn(self.R, load)
        return self.dim.shifted(self.r, out) if self.is_offset else out

    @property
    def along(self) -> slice:
        """Where the joint's axis stands in loads and virtual displacements."""
        return slice(self.dim.d) if self.slides else slice(self.dim.d, None)

    def drive(self, load: np.ndarray) -> np.ndarray:
        """Return what the drive gives (..., n), N m or N, of a load on the body's frame."""
        return np.tensordot(self.joint.axis, load[self.along], 1)

    def virtual(self, interface: np.ndarray, drive: np.ndarray | None) -> np.ndarray:
        """Return displacement and rotation (d + r, n) of the body's frame, its components.

        Args:
            interface: those of the interface.
            drive: (n,) virtual coordinate.
        """
        d, moved = self.dim.d, interface
        if self.is_offset:
            moved = interface.copy()
            moved[:d] += self.dim.velocity(interface[d:], self.r)
        out = self.dim.turn(self.R.swapaxes(0, 1), moved)
        if drive is not None:
            out[self.along] += self.joint.axis[:, None] * drive
        return out

    # -- derivatives -------------------------------------------------------------------------

    @cached_property
    def passage(self) -> MotionTransform:
        """From the interface's motion to that of the body's frame."""
        dim, back = self.dim, self.R.swapaxes(0, 1)
        by_w = by_wd = turned = None
        if self.is_offset:
            by_w = product(back, dim.centripetal_by_spin(self.inner[1], self.r))
            by_wd = product(back, dim.by_spin(self.r))
        if self.rates is not None and self.slides:
            spun = 2.0 * dim.by_spin(self._rate)
            if dim.r > 1:
                spun = product(spun, back[..., None] if back.ndim == 2 else back)
            by_w = spun if by_w is None else by_w + spun
        elif self.rates is not None and dim.r > 1:
            turned = -product(dim.skew(self._rate), back)
        return MotionTransform(dim, back, by_w, by_wd, turned)

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

    def load_by_joint(self, load: np.ndarray) -> np.ndarray:
        """Return the derivative of `at_interface` by the coordinate (d + r, n)."""
        dim, d, out = self.dim, self.dim.d, np.zeros_like(load)
        along = np.broadcast_to(self.joint.axis[:, None], (len(self.joint.axis), load.shape[1]))
        if self.slides:
            out[d:] = dim.moment(self.joint.rotation @ along, product(self.R, load[:d]))
            return out
        out[:d], out[d:] = dim.velocity(along, load[:d]), dim.commutator(along, load[d:])
        return self.at_interface(out)


class MovingRotor:
    """A rotor whose axis n is fixed to the interface that carries it, in whose components all is.

    Its angular momentum is h = J s n beside what the interface's body has, s = n . w + N v with the
    interface's angular velocity w and the motor's speed v as the joint would have it. To move it,
    the motor gives N J s', and the interface the moment

        dh/dt = J s' n + w x J s n.

    Attributes:
        load: force (zero) and moment on the interface (d + r, n).
        force: of the motor (n,), N m, N.
    """

    def __init__(self, joint: Joint, inner: Motion, rates: np.ndarray) -> None:
        """Take the joint, the interface's motion, the motor's speed and acceleration (2, n)."""
        assert joint.rotor is not None
        a, self.w, wd = inner
        self.dim = dim = DIMENSIONS[len(joint.origin)]
        self.axis = dim.rotated(joint.rotation, joint.axis[:, None])
        self.inertia, self.ratio = joint.rotor.inertia, joint.rotor.ratio
        speed, change = ((self.axis * x).sum(axis=0) for x in (self.w, wd))
        self.momentum = self.inertia * (speed + self.ratio * rates[0])
        moment = self.inertia * (change + self.ratio * rates[1])
        self.force = self.ratio * moment
        self.load = np.concatenate([np.zeros_like(a), self.axis * moment])
        if dim.r > 1:
            self.load[dim.d :] += self._gyroscopic(self.momentum)

    def _gyroscopic(self, momentum: np.ndarray | float) -> np.ndarray:
        """Return w x n times a momentum (r, n): zero in the plane."""
        return self.dim.commutator(self.w, np.asarray(self.axis * momentum))

    @cached_property
    def load_by_motion(self) -> np.ndarray:
        """Derivative of force and moment by the interface's motion (d + r, d + 2 r, n)."""
        dim, d, r, J = self.dim, self.dim.d, self.dim.r, self.inertia
        out = np.zeros((d + r, d + 2 * r, self.w.shape[1]))
        out[d:, d + r :] = (J * self.axis @ self.axis.T)[:, :, None]
        if dim.r > 1:
            out[d:, d : d + r] = self._gyroscopic(J)[:, None] * self.axis[:, :, None].swapaxes(0, 1)
            out[d:, d : d + r] -= dim.skew(self.axis[:, 0])[:, :, None] * self.momentum
        return out

    @cached_property
    def force_by_motion(self) -> np.ndarray:
        """Derivative of the motor's force by the interface's motion (d + 2 r,)."""
        d, r = self.dim.d, self.dim.r
        return np.concatenate([np.zeros(d + r), self.ratio * self.inertia * self.axis[:, 0]])

    @cached_property
    def load_by_motor(self) -> np.ndarray:
        """Derivative of force and moment by the motor's angle and its rates (d + r, 3, n)."""
        d, own = self.dim.d, self.ratio * self.inertia
        out = np.zeros((d + self.dim.r, 3, self.w.shape[1]))
        out[d:, 2] = own * self.axis
        if self.dim.r > 1:
            out[d:, 1] = self._gyroscopic(own)
        return out

    @property
    def force_by_motor(self) -> float:
        """Derivative of the motor's force by its acceleration, kg m2."""
        return self.ratio**2 * self.inertia
