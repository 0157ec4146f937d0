"""Frames that others carry: interfaces of bodies, joints, and the rotors that drive them.

Motions and loads as in `body`. What carries a motion outwards carries loads and the derivatives of
a function inwards by its transpose.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from dolfinopt.multibody.body import BodyMotion, Motion, by_instant
from dolfinopt.multibody.dimension import DIMENSIONS, Dimension, PlaneTurning, Turning, product
from dolfinopt.multibody.tree import Joint


class CarriedFrame:
    """A frame that coordinates x (k, n) displace and turn against the one that carries it.

    With its place p and its angular velocity v against the carrier, in the components of that, it
    moves by

        R' (a + A p + 2 Omega p' + p''),   R' (w + v),   R' (wd + w x v + v').

    Attributes:
        dim: plane or space.
        carrier: motion of the frame that carries it.
        place: p (d, n), m.
        shift_rates: p', p'' (d, n); None: zero.
        R: (d, d, n) from its components to the carrier's, or one (d, d); None: they are the same.
        spin: v, v' (r, n); None: zero.
        shifts: (d, k, 1) derivative of the place by x.
        spins: (r, k, n) that of the angular velocity by x'.
        spin_by_rotation: derivatives of v and w x v + v' by the rotations among x, of the latter
            by x' but for w x v; None: zero.
    """

    dim: Dimension
    carrier: Motion
    place: np.ndarray
    shift_rates: tuple[np.ndarray, np.ndarray] | None = None
    is_offset = True  # whether the place is not the carrier's origin

    R: Any
    spin: Any
    shifts: Any
    spins: Any
    spin_by_rotation: Any = None

    @cached_property
    def alpha(self) -> np.ndarray:
        """Entries of A (g, n)."""
        return self.dim.alpha(*self.carrier[1:])

    @cached_property
    def beta(self) -> np.ndarray:
        """Entries of 2 Omega (g, n)."""
        return self.dim.beta(self.carrier[1])

    def in_own(self, x: np.ndarray) -> np.ndarray:
        """Return vectors and what follows them, angular velocities, in its components."""
        return x if self.R is None else self.dim.turn(self.R.swapaxes(0, 1), x)

    def in_carrier(self, x: np.ndarray) -> np.ndarray:
        """Return them in the carrier's components."""
        return x if self.R is None else self.dim.turn(self.R, x)

    @cached_property
    def _unturned(self) -> Motion:
        """Its motion in the carrier's components."""
        (a, w, wd), dim = self.carrier, self.dim
        if self.is_offset:
            a = a + dim.apply(self.alpha, self.place)
        if self.shift_rates is not None:
            rate, second = self.shift_rates
            a = a + dim.apply(self.beta, rate) + second
        if self.spin is None:
            return a, w, wd
        v, change = self.spin
        wd = wd + change
        if dim.r > 1:
            wd = wd + dim.commutator(w, v)
        return a, w + v, wd

    @cached_property
    def motion(self) -> Motion:
        """Its motion in its own components."""
        a, w, wd = self._unturned
        if self.R is None:
            return a, w, wd
        back = self.R.swapaxes(0, 1)
        return product(back, a), self.dim.rotated(back, w), self.dim.rotated(back, wd)

    def load_on_carrier(self, load: np.ndarray) -> np.ndarray:
        """Return a load (d + r, ..., n) about the carrier's origin, in its components."""
        out = self.in_carrier(load)
        return self.dim.shifted(self.place, out) if self.is_offset else out

    def virtual(self, carrier: np.ndarray, x: np.ndarray | None) -> np.ndarray:
        """Return its virtual displacement and rotation (d + r, n), the carrier's components.

        Args:
            carrier: those of the carrier.
            x: (k, n) virtual coordinates; None: zero.
        """
        d, out = self.dim.d, carrier.copy()
        if self.is_offset:
            out[:d] += self.dim.velocity(carrier[d:], self.place)
        if x is not None:
            out[:d] += (self.shifts * x).sum(axis=1)
            out[d:] += (self.spins * x).sum(axis=1)
        return out

    # -- derivatives -------------------------------------------------------------------------

    @cached_property
    def transform(self) -> np.ndarray:
        """Derivative of its motion by the carrier's (n, d + 2 r, d + 2 r)."""
        dim, (a, w, _) = self.dim, self.carrier
        d, s, size = dim.d, dim.b, dim.b + dim.r
        out = np.zeros((size, size, a.shape[1]))
        out[range(size), range(size)] = 1.0
        if self.is_offset:
            by_alpha, by_beta = (x.swapaxes(0, 1) for x in self._accelerated)
            out[:d, d:] = dim.spin_gradient(w, by_alpha, by_beta).swapaxes(0, 1)
        if self.spin is not None and dim.r > 1:
            out[s:, d:s] = -dim.skew(self.spin[0])
        return by_instant(self.in_own(out))

    @property
    def _accelerated(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of its acceleration by alpha and beta (d, g, n), the carrier's components."""
        by_alpha = self.dim.applied.matrix(self.place)
        if self.shift_rates is None:
            return by_alpha, np.zeros_like(by_alpha)
        return by_alpha, self.dim.applied.matrix(self.shift_rates[0])

    def motion_gradient(self, by: np.ndarray) -> np.ndarray:
        """Return derivatives of a function by the carrier's motion, from those by its own.

        Both are (d + 2 r, n).
        """
        return np.asarray(np.einsum("nij,in->jn", self.transform, by))

    @cached_property
    def of_loads(self) -> np.ndarray:
        """What `load_on_carrier` does, as matrices (n, d + r, d + r)."""
        # Forces and moments work on displacements and rotations as a and wd go.
        kept = np.r_[0 : self.dim.d, self.dim.b : self.dim.b + self.dim.r]
        return self.transform[:, kept[:, None], kept].swapaxes(1, 2)

    @cached_property
    def by_coordinates(self) -> np.ndarray:
        """Derivatives of its motion by x, x' and x'' (d + 2 r, 3, k, n)."""
        dim, d, s = self.dim, self.dim.d, self.dim.b
        shifts, spins, (a, w, wd) = self.shifts, self.spins, self._unturned
        out = np.zeros((s + dim.r, 3, shifts.shape[1], a.shape[1]))
        by_x, by_rate, by_second = out.swapaxes(0, 1)
        # What turns with the frame is counted: derivatives are those of its components.
        by_x[:d] = dim.apply(self.alpha, shifts) - dim.velocity(spins, a)
        by_rate[:d], by_second[:d] = dim.apply(self.beta, shifts), shifts
        by_rate[d:s] = by_second[s:] = spins
        if dim.r > 1:
            by_x[d:s], by_x[s:] = dim.commutator(w, spins), dim.commutator(wd, spins)
            by_rate[s:] = dim.commutator(self.carrier[1], spins)
        if (by_rotation := self.spin_by_rotation) is not None:
            of_v, of_change, of_rate = by_rotation
            by_x[d:s, d:] += of_v
            by_x[s:, d:] += of_change
            by_rate[s:, d:] += of_rate
        return self.in_own(out)

    def turned_by_coordinates(self, load: np.ndarray) -> np.ndarray:
        """Return the derivative (d + r, k, n) by x of a load that turns with the frame.

        Load and derivative are in the carrier's components.
        """
        dim, d, spins = self.dim, self.dim.d, self.spins
        return np.concatenate([dim.velocity(spins, load[:d]), dim.commutator(spins, load[d:])])

    def load_by_coordinates(self, load: np.ndarray, turning: np.ndarray) -> np.ndarray:
        """Return the derivative (d + r, k, n) by x of `load_on_carrier`.

        Args:
            load: `in_carrier`.
            turning: the part of it that turns with the frame.
        """
        dim, d, out = self.dim, self.dim.d, self.turned_by_coordinates(turning)
        out[d:] += dim.moment(self.place, out[:d]) + dim.moment(self.shifts, load[:d])
        return out


class Interface(CarriedFrame):
    """An outboard interface of a body, displaced by u and turned by theta: x = (u, theta).

    Attributes:
        body: as it moves.
        places: of (u, theta) among the body's conjugates.
    """

    def __init__(self, body: BodyMotion, number: int = 0) -> None:
        """Take the body, and which of its interfaces it is."""
        self.body, self.dim, self.carrier = body, body.dim, (body.a, body.w, body.wd)
        self.places = body.constants.outboard(number)
        self.place = np.broadcast_to(body.constants.points[number][:, None], body.a.shape)
        if body.is_flexible:
            u, rate, second = body.conjugates[self.places][: self.dim.d].swapaxes(0, 1)
            self.place, self.shift_rates = self.place + u, (rate, second)

    @cached_property
    def turning(self) -> Turning:
        """Its rotation against the body's frame."""
        theta, rate, second = self.body.conjugates[self.places][self.dim.d :].swapaxes(0, 1)
        return self.dim.turning(theta, rate, second)

    @property
    def alpha(self) -> np.ndarray:  # type: ignore[override]
        """Entries of A (g, n)."""
        return self.body.alpha

    @property
    def R(self) -> np.ndarray | None:
        """The rotation to the body's components."""
        return self.turning.R if self.body.is_flexible else None

    @property
    def spin(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Angular velocity against the body's frame, and its change."""
        if not self.body.is_flexible:
            return None
        return self.turning.velocity, self.turning.acceleration

    @property
    def shifts(self) -> np.ndarray:
        """The place by (u, theta)."""
        return np.eye(self.dim.d, self.dim.b)[:, :, None]

    @cached_property
    def spins(self) -> np.ndarray:
        """The angular velocity by the rates of (u, theta)."""
        out = np.zeros((self.dim.r, self.dim.b, self.place.shape[1]))
        out[:, self.dim.d :] = self.turning.J
        return out

    @cached_property
    def spin_by_rotation(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """See `CarriedFrame`; None: zero, in the plane."""
        turning, w, dim = self.turning, self.body.w, self.dim
        if isinstance(turning, PlaneTurning):
            return None
        by_theta = turning.by_theta(turning.rate)
        of_change = dim.commutator(w, by_theta) + turning.acceleration_by_theta
        return by_theta, of_change, turning.acceleration_by_rate

    # -- what works on (u, theta) --------------------------------------------------------------

    def coefficients(self, load: np.ndarray) -> np.ndarray:
        """Return what works on (u, theta) (b, ..., n), of a load in the body's components."""
        d = self.dim.d
        return np.concatenate([load[:d], self.turning.jacobian_transposed(load[d:])])

    def coefficients_by_coordinates(self, load: np.ndarray, turning: np.ndarray) -> np.ndarray:
        """Return the derivative (b, b, n) by (u, theta) of `coefficients`, loads as there."""
        out, d = self.coefficients(self.turned_by_coordinates(turning)), self.dim.d
        by_theta = self.turning.by_theta(load[d:], -1.0)
        if by_theta is not None:
            out[d:, d:] += by_theta
        return out

    # -- gradients of a function -------------------------------------------------------------

    def displacement_gradient(self, by: np.ndarray) -> np.ndarray:
        """Return derivatives (b, 3, n) by (u, theta) and its rates, from those by the motion."""
        return np.asarray(np.einsum("srkn,sn->krn", self.by_coordinates, by))

    def load_gradient(
        self, load: np.ndarray, turning: np.ndarray, virtual: np.ndarray, x: np.ndarray
    ) -> np.ndarray:
        """Return derivatives (b, n) by (u, theta) of the virtual work of a load.

        Args:
            load, turning: as for `load_by_coordinates`.
            virtual: displacement and rotation of the body (d + r, n).
            x: (b, n) those of (u, theta).
        """
        by_load = self.load_by_coordinates(load, turning).swapaxes(0, 1)
        by_coefficients = self.coefficients_by_coordinates(load, turning).swapaxes(0, 1)
        return product(by_load, virtual) + product(by_coefficients, x)

    @cached_property
    def V(self) -> np.ndarray:
        """Derivative of (u, theta) by the body's coordinates (b, q, n)."""
        return self.body.V[self.places]

    @cached_property
    def of_coefficients(self) -> np.ndarray:
        """Derivative of `coefficients` by a load in the interface's components (n, b, b)."""
        out, d = np.zeros((self.dim.b, self.dim.b, self.place.shape[1])), self.dim.d
        out[range(d), range(d)], out[d:, d:] = 1.0, self.turning.J
        return by_instant(self.in_own(out)).swapaxes(1, 2)


class MovingJoint(CarriedFrame):
    """A joint that moves: the frame of the body that it holds, carried by an interface.

    Attributes:
        joint: what it is.
        rates: its coordinate with its rates (3, n); None of a fixed one.
    """

    def __init__(self, joint: Joint, carrier: Motion, rates: np.ndarray | None) -> None:
        """Take the interface's motion, and the coordinate with its rates (3, n) if there is one."""
        self.joint, self.carrier, self.rates = joint, carrier, rates
        self.dim = DIMENSIONS[len(joint.origin)]
        self.slides = joint.kind == "prismatic"
        place = joint.origin[:, None]
        if rates is not None and self.slides:
            if len(rates) == 3:
                self.shift_rates = self._axis * rates[1], self._axis * rates[2]
            place = place + self._axis * rates[0]
        self.place = np.broadcast_to(place, (self.dim.d, carrier[0].shape[1]))
        self.is_offset = bool(place.any())

    @cached_property
    def _axis(self) -> np.ndarray:
        """The axis in the interface's components (., 1)."""
        return self.dim.rotated(self.joint.rotation, self.joint.axis[:, None])

    @cached_property
    def R(self) -> np.ndarray:
        """The rotation to the interface's components."""
        if self.rates is None or self.slides:
            return self.joint.rotation
        # Of a column NumPy takes other instructions, and another last bit, where the end of its
        # stride touches the memory of the result. One number keeps its stride unless it is copied.
        angle = self.rates[0].copy()
        return self.joint.turns @ np.stack(
            [np.ones_like(angle), np.sin(angle), 1.0 - np.cos(angle)]
        )

    @cached_property
    def spin(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Angular velocity against the interface, and its change."""
        if self.rates is None or self.slides:
            return None
        return self._axis * self.rates[1], self._axis * self.rates[2]

    @property
    def shifts(self) -> np.ndarray:
        """The place by the coordinate."""
        return self._axis[:, None] if self.slides else np.zeros((self.dim.d, 1, 1))

    @property
    def spins(self) -> np.ndarray:
        """The angular velocity by the coordinate's rate."""
        return np.zeros((self.dim.r, 1, 1)) if self.slides else self._axis[:, None]

    @cached_property
    def drive_axis(self) -> np.ndarray:
        """What gives the drive's force of a load on the body's frame (d + r,)."""
        out = np.zeros(self.dim.b)
        out[slice(self.dim.d) if self.slides else slice(self.dim.d, None)] = self.joint.axis
        return out


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
