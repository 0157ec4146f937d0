"""Poses: where bodies and interfaces are, how coordinates move them, and the end-effector.

Rotations are to the ground's frame, vectors as in `body`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.body import Constants
from dolfinopt.multibody.dimension import Turning, compose, product
from dolfinopt.multibody.frames import MovingJoint
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.tree import GROUND, Mechanism, Site


class Section:
    """An outboard interface where n sets of coordinates e (q, n) take it, in its body's frame.

    Attributes:
        place: (d, n) or (d, 1), m.
        turning: its rotation; None of a rigid body.
        V: (b, q, n) derivative of its displacement and rotation by e, or (b, q, 1).
    """

    def __init__(self, constants: Constants, number: int, e: np.ndarray) -> None:
        """Take the body's constants, which of its interfaces it is, and e."""
        self.place = constants.points[number][:, None]
        self.turning: Turning | None = None
        if not constants.num_modes:
            return
        places, d = constants.outboard(number), constants.dim.d
        moved, self.V = constants.T[places] @ e, constants.T[places][..., None]
        if constants.bent is not None:
            bent = np.tensordot(constants.bent[places], e, 1)
            moved -= 0.5 * np.einsum("pkn,kn->pn", bent, e)
            self.V = self.V - bent
        self.place = self.place + moved[:d]
        self.turning = constants.dim.turning(*(moved[d:],) * 3)  # of its rates none is asked for


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
                place = place + product(R, moving.place)
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


@dataclass(frozen=True, eq=False)
class FlexibleLink:
    """A flexible body on the way to a site.

    Attributes:
        body, number: of the body, and of its interface that leads on.
        section: that interface.
        turning: its rotation.
        place: where it is (d, n), m.
        R: rotation of the body's frame.
        columns: places of the body's elastic coordinates among all C.
        order: how far out they act.
    """

    body: int
    number: int
    section: Section
    turning: Turning
    place: np.ndarray
    R: np.ndarray
    columns: slice
    order: int


class SiteMotion:
    """An interface of a body, or a point of the ground, at n poses, and how coordinates move it.

    Attributes:
        place: (d, n) of the joint's frame, m.
        R: (d, d, n) or (d, d), its rotation.
        by: (d + r, C, n) displacement and rotation by every coordinate, in the ground's frame;
            by_place, by_spin its parts.
        order: (C,) how far out a coordinate acts; -1: not on the way to the site.
        flexible: the flexible bodies on the way.
    """

    def __init__(self, posed: Posed, site: Site | None, point: np.ndarray, R: np.ndarray) -> None:
        """Take the poses, the interface, None for the ground, and the joint's frame on it."""
        self.posed, mechanism = posed, posed.mechanism
        self.dim = dim = mechanism.dim
        count = len(posed.q)
        size = mechanism.num_rigid + mechanism.num_coordinates
        self.by = np.zeros((dim.b, size, count))
        self.by_place, self.by_spin = self.by[: dim.d], self.by[dim.d :]
        self.order = np.full(size, -1)
        self.flexible: list[FlexibleLink] = []
        self.way = () if site is None else mechanism.way_to(site)
        if site is None:
            self.place, self.R = np.repeat(point[:, None], count, axis=1), R
            return
        place, turned = posed.interface(*site)
        self.place = place + product(turned, point[:, None])
        self.R = compose(turned, R)
        if (cart := mechanism.cart_coordinate) is not None:
            self.by_place[0, cart], self.order[cart] = 1.0, 0
        for step, (i, number) in enumerate(self.way):
            self._add_joint(i, 1 + 2 * step)
            self._add_modes(i, number, 2 + 2 * step)

    def _add_joint(self, i: int, order: int) -> None:
        moving, origin, R = self.posed.body(i)
        if (k := moving.joint.coordinate) is None:
            return
        axis, dim = moving.joint.axis[:, None], self.dim
        self.order[k] = order
        if moving.slides:
            self.by_place[:, k] = product(R, axis)
            return
        self.by_spin[:, k] = dim.rotated(R, axis)
        self.by_place[:, k] = dim.velocity(self.by_spin[:, k], self.place - origin)

    def _add_modes(self, i: int, number: int, order: int) -> None:
        posed, dim, section = self.posed, self.dim, self.posed.section(i, number)
        if (turning := section.turning) is None:
            return
        part, first = posed.mechanism.slices[i], posed.mechanism.num_rigid
        columns = slice(first + part.start, first + part.stop)
        place, R = posed.interface(i, number)[0], posed.body(i)[2]
        self.flexible.append(FlexibleLink(i, number, section, turning, place, R, columns, order))
        self.order[columns] = order
        spin = dim.rotated(R, turning.jacobian_times(section.V[dim.d :]))
        lever = (self.place - place)[:, None]
        self.by_spin[:, columns] = spin
        self.by_place[:, columns] = product(R, section.V[: dim.d]) + dim.velocity(spin, lever)

    def turned(self, v: np.ndarray) -> np.ndarray:
        """Return a vector (d,) that is fixed to the frame in the ground's components (d, n)."""
        result = product(self.R, v[:, None])
        return np.broadcast_to(result, (self.dim.d, len(self.posed.q)))

    def along(self, virtual: np.ndarray) -> np.ndarray:
        """Return displacement and rotation (d + r, n) by virtual coordinates (n, C)."""
        return np.asarray(np.einsum("bcn,nc->bn", self.by, virtual))

    def acceleration(self, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return acceleration (d, n) and angular acceleration (r, n) at rates (n, R) alone.

        Those of the coordinates are zero, the bodies rigid: going outwards with the angular
        velocity w so far, sum (2 w + s) x dp and sum w x s.
        """
        dim, count = self.dim, len(rates)
        a, (wd, w) = np.zeros((dim.d, count)), np.zeros((2, dim.r, count))
        inboard_first = np.argsort(self.order, kind="stable")
        for c in inboard_first[self.order[inboard_first] >= 0]:
            shift, spin = self.by_place[:, c] * rates[:, c], self.by_spin[:, c] * rates[:, c]
            a = a + dim.velocity(2.0 * w + spin, shift)
            wd = wd + dim.commutator(w, spin)
            w = w + spin
        return a, wd

    def hessian(self, load: np.ndarray) -> np.ndarray:
        """Return the derivative (n, C, C) of what a load does on the coordinates by these.

        Rows are the coordinates on which it works.
        """
        dim, s, order = self.dim, self.by_spin, self.order
        force, moment = load[: dim.d], load[dim.d :]
        on_way = order >= 0
        inboard = on_way & (order[None] < order[:, None])  # [j, i]: i is inboard of j
        pulled = dim.moment(self.by_place, force[:, None])
        by_force = np.einsum("rjn,rin->nji", pulled, s)
        result = np.where(inboard, by_force, 0.0)
        result = result + result.swapaxes(1, 2)
        joints = np.flatnonzero(on_way & (np.arange(len(order)) < self.posed.mechanism.num_rigid))
        result[:, joints, joints] += by_force[:, joints, joints]
        if dim.r > 1:
            turned = dim.commutator(s, moment[:, None])
            result += np.where(inboard, np.einsum("rjn,rin->nji", turned, s), 0.0)
        for link in self.flexible:
            result[:, link.columns, link.columns] += self._own_hessian(link, load)
        return result

    def _own_hessian(self, link: FlexibleLink, load: np.ndarray) -> np.ndarray:
        """Return the part (n, q, q) of one body's own deformation."""
        dim, d, spin = self.dim, self.dim.d, self.by_spin[:, link.columns]
        swung = dim.velocity(spin, (self.place - link.place)[:, None])
        pulled = dim.moment(swung, load[:d, None])
        result = np.einsum("rkn,rln->nkl", spin, pulled)
        by_theta = link.turning.by_theta(self._on_interface(link, load)[d:], -1.0)
        if by_theta is not None:
            theta = np.broadcast_to(link.section.V[d:], (dim.r, *spin.shape[1:]))
            result += np.einsum("akn,abn,bln->nkl", theta, by_theta, theta, optimize=True)
        constants = self.posed.mechanism.constants[link.body]
        if constants.bent is not None:
            bent = constants.bent[constants.outboard(link.number)]
            result -= np.einsum("pn,pkl->nkl", self.interface_load(link, load), bent)
        return result

    def load_on(self, point: np.ndarray, R: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Return force and moment about a point (d, n) in the components of a frame."""
        return self.dim.turn(R.swapaxes(0, 1), self.dim.shifted(self.place - point, load))

    def _on_interface(self, link: FlexibleLink, load: np.ndarray) -> np.ndarray:
        """Return force and moment about a body's interface in the body's components."""
        return self.load_on(link.place, link.R, load)

    def interface_load(self, link: FlexibleLink, load: np.ndarray) -> np.ndarray:
        """Return what works on (u, theta) (b, n) of a body's interface on the way."""
        own, d = self._on_interface(link, load), self.dim.d
        own[d:] = link.turning.jacobian_transposed(own[d:])
        return own

    def interface_load_along(
        self, link: FlexibleLink, load: np.ndarray, change: np.ndarray, virtual: np.ndarray
    ) -> np.ndarray:
        """Return the derivative of `interface_load` (b, n) along virtual coordinates (n, C).

        Args:
            link: as there.
            load: (d + r, n).
            change: its derivative along them.
            virtual: of all coordinates.
        """
        dim, d, force = self.dim, self.dim.d, load[: self.dim.d]
        lever, columns = self.place - link.place, link.columns
        on_way = self.order >= 0
        inner, own = (on_way & (self.order < k) for k in (link.order, link.order + 1))
        spin, shifted = self.along(virtual * inner)[d:], self.along(virtual * own)
        moved = (self.along(virtual) - shifted)[:d] + dim.velocity(shifted[d:], lever)
        about, back = dim.shifted(lever, load), link.R.swapaxes(0, 1)
        turned = np.concatenate([dim.velocity(spin, force), dim.commutator(spin, about[d:])])
        turned[d:] -= dim.moment(moved, force)
        by = self._on_interface(link, change) - dim.turn(back, turned)
        by[d:] = link.turning.jacobian_transposed(by[d:])
        by_theta = link.turning.by_theta(dim.turn(back, about)[d:], -1.0)
        if by_theta is not None:
            theta = (link.section.V[d:] * virtual[:, columns].T).sum(axis=1)
            by[d:] += product(by_theta, theta)
        return by

    def add_gradient(
        self,
        by_bodies: list[dict[str, np.ndarray]],
        load: np.ndarray,
        working: np.ndarray,
        change: np.ndarray,
        virtual: np.ndarray,
    ) -> None:
        """Add the derivative of load . motion + working . along(virtual) by the bodies.

        Args:
            found: see `no_gradient`.
            load, working: (d + r, n).
            change: that of `working` along the virtual coordinates.
            virtual: (n, C).
        """
        mechanism, b = self.posed.mechanism, self.dim.b
        for link in self.flexible:
            e, v = self.posed.q[:, mechanism.slices[link.body]], virtual[:, link.columns]
            rate, value = self.interface_load(link, working), self.interface_load(link, load)
            value = value + self.interface_load_along(link, working, change, virtual)
            own, by_body = slice(b * link.number, b * (link.number + 1)), by_bodies[link.body]
            by_body["outboard"][own] += value @ e + rate @ v
            if "K0_outboard" in by_body:
                bent = 0.5 * value[:, None] * e.T + rate[:, None] * v.T
                by_body["K0_outboard"][own] -= bent @ e


def no_gradient(mechanism: Mechanism) -> list[dict[str, np.ndarray]]:
    """Return zero derivatives by every body's outboard modes and their geometric stiffness."""
    # Under the names of the shape integrals, (b, q) and (b, q, q).
    return [
        {
            name: np.zeros_like(getattr(body, name))
            for name in ("outboard", "K0_outboard")[: 1 + body.is_stiffened]
        }
        for body in mechanism.bodies
    ]


# -- the end-effector: where it is, how far off the equivalent rigid machine's, derivatives -----


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths (n,) of vectors (n, 2), or (n, 3) in space."""
    out: np.ndarray = np.linalg.norm(vectors, axis=1)
    return out


def end_effector(mechanism: Mechanism, motion: RigidMotion, q: np.ndarray) -> np.ndarray:
    """Return the end-effector's position (n, d), m, of the flexible mechanism; q (n, N)."""
    return Posed(mechanism, motion.q, q).interface(*mechanism.way[-1])[0].T


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
    posed, dim = Posed(mechanism, motion.q, q), mechanism.dim
    site = SiteMotion(posed, mechanism.end, np.zeros(dim.d), np.eye(dim.d))
    load, still = np.zeros((dim.b, len(q))), np.zeros((dim.b, len(q)))
    load[: dim.d], load[dim.d :] = weights.T, 0.0 if moments is None else moments.T
    by_all, by_bodies = np.einsum("bn,bcn->nc", load, site.by), no_gradient(mechanism)
    site.add_gradient(by_bodies, load, still, still, np.zeros_like(by_all))
    by_rigid, by_q = np.split(by_all, [mechanism.num_rigid], axis=1)
    return by_q, by_rigid, by_bodies
