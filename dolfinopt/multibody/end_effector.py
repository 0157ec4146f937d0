"""Where the end-effector is, how far off the equivalent rigid machine's, and derivatives of it."""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.body_motion import Constants
from dolfinopt.multibody.dimension import Turning, compose, product
from dolfinopt.multibody.kinematics import MovingJoint
from dolfinopt.multibody.mechanism import GROUND, Mechanism, Site
from dolfinopt.multibody.motion import RigidMotion


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
