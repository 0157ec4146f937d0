"""From a body to those that hang on it: interfaces, joints, and the end-effector of the machine.

Motions and loads as in `body_motion`. What carries a motion outwards carries the derivatives of a
function inwards by its transpose.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.multibody.body_motion import BodyMotion, Constants, Load, Motion
from dolfinopt.multibody.dimension import (
    DIMENSIONS,
    Dimension,
    PlaneTurning,
    Turning,
    compose,
    product,
    transposed_product,
)
from dolfinopt.multibody.mechanism import GROUND, Mechanism, Site
from dolfinopt.multibody.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from dolfinopt.multibody.mechanism import Joint


class Passage:
    """Derivative of one frame's motion by that of the one that carries it, at n instants.

    Attributes:
        matrix: (n, d + 2 r, d + 2 r), or one.
        of_loads: (n, d + r, d + r), or one: what carries a load on the one frame, in its
            components, to the origin of the other.
    """

    def __init__(
        self,
        dim: Dimension,
        turn: np.ndarray,
        by_w: np.ndarray | None,
        by_wd: np.ndarray | None,
        turned: np.ndarray | None = None,
    ) -> None:
        """Take the blocks (., ., n), or some of them alike at all instants; None: zero.

        Args:
            dim: plane or space.
            turn: the rotation (d, d, n) or (d, d) into the components of the one carried.
            by_w, by_wd: of its acceleration (d, r, n).
            turned: of its angular acceleration by w (r, r, n).
        """
        d, r = dim.d, dim.r
        counts = {x.shape[2] for x in (turn, by_w, by_wd, turned) if x is not None and x.ndim == 3}
        out = np.zeros((max(counts, default=1), d + 2 * r, d + 2 * r))
        a, w, wd = slice(0, d), slice(d, d + r), slice(d + r, d + 2 * r)
        rotated = turn if r == d else np.ones((1, 1))
        blocks = (a, a, turn), (w, w, rotated), (wd, wd, rotated), (wd, w, turned)
        for rows, columns, block in (*blocks, (a, w, by_w), (a, wd, by_wd)):
            if block is not None:
                out[:, rows, columns] = block if block.ndim == 2 else block.transpose(2, 0, 1)
        self.matrix = out
        # Forces and moments work on displacements and rotations as a and wd go.
        loads = np.empty((len(out), d + r, d + r))
        loads[:, :d, :d], loads[:, :d, d:] = out[:, a, a].swapaxes(1, 2), 0.0
        loads[:, d:, :d] = out[:, a, wd].swapaxes(1, 2)
        loads[:, d:, d:] = out[:, wd, wd].swapaxes(1, 2)
        self.of_loads = loads


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

    @cached_property
    def passage(self) -> Passage:
        """From the body's motion to its own, in its own components."""
        dim, by_w, by_wd = self.dim, self._by_spin, self.dim.by_spin(self.place)
        if not self.body.is_flexible:
            return Passage(dim, np.eye(dim.d), by_w, by_wd)
        back, turned = self.turning.R.swapaxes(0, 1), None
        if dim.r > 1:
            turned = -product(back, dim.skew(self.turning.velocity))
        return Passage(dim, back, product(back, by_w), product(back, by_wd), turned)

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
        back = self.turning.R.swapaxes(0, 1)
        parts = out[:d], out[d : d + r], out[d + r :]
        return np.concatenate([product(back, parts[0]), *(dim.rotated(back, x) for x in parts[1:])])

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

    @cached_property
    def rows_by_own_load(self) -> np.ndarray:
        """Derivative of the rows by a load in its own components (d + r, q, n)."""
        d = self.dim.d
        return np.concatenate(self.in_interface((self.rows_by_load[:d], self.rows_by_load[d:])))


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

    @cached_property
    def passage(self) -> Passage:
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
        return Passage(dim, back, by_w, by_wd, turned)

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


# -- the end-effector: where it is, how far off the equivalent rigid machine's, derivatives --


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths (n,) of vectors (n, 2), or (n, 3) in space."""
    if vectors.shape[1] == 2:
        return np.hypot(vectors[:, 0], vectors[:, 1])
    out: np.ndarray = np.linalg.norm(vectors, axis=1)
    return out


def end_effector(mechanism: Mechanism, motion: RigidMotion, q: np.ndarray) -> np.ndarray:
    """Return the end-effector's position (n, d), m, of the flexible mechanism; q (n, N)."""
    return Posed(mechanism, motion.q, q).interface(*mechanism.way[-1])[0].T


def deviation(mechanism: Mechanism, motion: RigidMotion, q: np.ndarray) -> np.ndarray:
    """Return the flexible minus the equivalent rigid end-effector (n, d), m.

    Source: Seifried, Moghadasi & Held (2015), eq. (6), doi:10.1016/j.piutam.2015.01.018.
    """
    rigid = end_effector(mechanism, motion, np.zeros_like(q))
    return end_effector(mechanism, motion, q) - rigid


def end_rotation(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, desired: RigidMotion
) -> np.ndarray:
    """Return the rotation vectors log(R R_0') of the end-effector (n, r), r = 1 or 3, rad.

    R is the rotation of the last outboard interface, R_0 that of rigid links along the desired
    motion; the vectors are in the ground's frame and at most pi long.

    Args:
        mechanism, motion, q: as for `end_effector`, n instants.
        desired: rigid coordinates that the rigid links have, n instants.
    """
    end = mechanism.way[-1]
    R = Posed(mechanism, motion.q, q).interface(*end)[1]
    rigid = Posed(mechanism, desired.q, np.zeros_like(q)).interface(*end)[1]
    apart = compose(R, rigid.swapaxes(0, 1))
    dim = mechanism.constants[0].dim
    vectors = dim.rotation_vector(apart.reshape(dim.d, dim.d, -1))
    return np.broadcast_to(vectors.T, (len(q), dim.r))


def end_effector_gradient(
    mechanism: Mechanism,
    motion: RigidMotion,
    q: np.ndarray,
    weights: np.ndarray,
    moments: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, list[dict[str, np.ndarray]]]:
    """Return the gradient of sum_n weights_n . end_effector_n + moments_n . spin_n.

    It is what a force and a moment of these weights on the end-effector do on every coordinate.
    The spin is the end-effector's virtual rotation; along a rotation vector, as of `end_rotation`,
    it changes the vector by itself.

    Args:
        mechanism, motion, q: as for `end_effector`, n instants.
        weights: (n, d).
        moments: (n, r), in the ground's frame; None: zero.

    Returns:
        By q (n, N), by the rigid coordinates (n, R), and by every body's outboard modes (b, q) and
        their geometric stiffness (b, q, q), under the names of the shape integrals.
    """
    posed, forces = Posed(mechanism, motion.q, q), weights.T
    turning = None if moments is None else moments.T
    end = posed.interface(*mechanism.way[-1])[0]
    by_q, by_rigid = np.zeros_like(q), np.zeros_like(motion.q)
    by_bodies = [{"outboard": np.zeros_like(one.outboard)} for one in mechanism.bodies]
    if (cart := mechanism.cart_coordinate) is not None:
        by_rigid[:, cart] = weights[:, 0]
    for i, number in mechanism.way:
        joint, origin, R = posed.body(i)
        section, dim, back = posed.section(i, number), joint.dim, R.swapaxes(0, 1)
        force, lever = product(back, forces), product(back, end - origin)
        own_moment = 0.0 if turning is None else dim.rotated(back, turning)
        if (k := joint.joint.coordinate) is not None:
            by_rigid[:, k] = joint.drive((force, dim.moment(lever, force) + own_moment))
        if section.turning is None:
            continue
        body, part, by = mechanism.bodies[i], mechanism.slices[i], by_bodies[i]
        own = slice(dim.b * number, dim.b * (number + 1))
        moment = dim.moment(lever - section.place, force) + own_moment
        pull, e = np.concatenate([force, section.turning.pulled(moment)]), q[:, part]
        by_q[:, part] = pull.T @ body.outboard[own]
        by["outboard"][own] = pull @ e
        if section.bent is not None:
            by_q[:, part] -= np.einsum("pn,pkn->nk", pull, section.bent)
            by["K0_outboard"] = np.zeros_like(body.K0_outboard)
            by["K0_outboard"][own] = -0.5 * (pull[:, None] * e.T) @ e
    return by_q, by_rigid, by_bodies


class Section:
    """An outboard interface where n sets of coordinates e (q, n) take it, in its body's frame.

    Attributes:
        place: (d, n) or (d, 1), m.
        turning: its rotation; None of a rigid body.
        bent: (b, q, n) what geometric stiffness takes from the outboard modes, or None.
    """

    def __init__(self, constants: Constants, number: int, e: np.ndarray) -> None:
        """Take the body's constants, which of its interfaces it is, and e."""
        self.place = constants.points[number][:, None]
        self.turning: Turning | None = None
        self.bent: np.ndarray | None = None
        if not constants.num_modes:
            return
        places, d = constants.outboard(number), constants.dim.d
        moved = constants.T[places] @ e
        if constants.K0 is not None:
            self.bent = np.tensordot(constants.K0[places], e, 1)
            moved -= 0.5 * np.einsum("pkn,kn->pn", self.bent, e)
        self.place = self.place + moved[:d]
        self.turning = constants.turning(*(moved[d:],) * 3)  # of its rates none is asked for


class Posed:
    """A mechanism at n poses, q_r (n, R) and q (n, N): what is asked for of its frames, each once.

    Rotations, to the ground's frame, are (d, d, n), or (d, d) where they are the same in all poses.
    """

    def __init__(self, mechanism: Mechanism, q_r: np.ndarray, q: np.ndarray) -> None:
        """Take the poses."""
        self.mechanism, self.q_r, self.q = mechanism, q_r, q
        base = mechanism.base(q_r)
        self._still = base, base, base  # no motion is asked for
        self._interfaces: dict[Site, tuple[np.ndarray, np.ndarray]] = {}
        self._interfaces[GROUND, 0] = base, np.eye(len(base))
        self._bodies: dict[int, tuple[MovingJoint, np.ndarray, np.ndarray]] = {}
        self._sections: dict[Site, Section] = {}

    def body(self, i: int) -> tuple[MovingJoint, np.ndarray, np.ndarray]:
        """Return the joint of body i, the place (d, n) and the rotation of its frame."""
        if i not in self._bodies:
            joint = self.mechanism.joints[i]
            place, R = self.interface(joint.parent, joint.interface)
            k = joint.coordinate
            moving = MovingJoint(joint, self._still, None if k is None else self.q_r[:, k][None])
            if moving.is_offset:
                place = place + product(R, moving.r)
            self._bodies[i] = moving, place, compose(R, moving.R)
        return self._bodies[i]

    def section(self, i: int, number: int) -> Section:
        """Return an outboard interface of body i."""
        if (i, number) not in self._sections:
            e = self.q[:, self.mechanism.slices[i]].T
            self._sections[i, number] = Section(self.mechanism.constants[i], number, e)
        return self._sections[i, number]

    def interface(self, i: int, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return its place (d, n) and its rotation; of `GROUND` where that is."""
        if (i, number) not in self._interfaces:
            (_, place, R), section = self.body(i), self.section(i, number)
            turned = R if section.turning is None else compose(R, section.turning.R)
            self._interfaces[i, number] = place + product(R, section.place), turned
        return self._interfaces[i, number]
