"""Where the end-effector is, how far off the equivalent rigid machine's, and derivatives of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.body_motion import Constants
from dolfinopt.multibody.dimension import Turning, compose, product
from dolfinopt.multibody.kinematics import MovingJoint
from dolfinopt.multibody.measured import LEAST_INSTANTS
from dolfinopt.multibody.mechanism import GROUND, Mechanism, Site, several
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals


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


# -- in the plane: first and second derivatives by all coordinates, for what closes a loop
#
# Coordinates are ordered [rigid (1 + arms), elastic (N)]; places are complex, p = p_x + i p_y.
# Going outwards along the chain every coordinate moves all that lies outboard of it: it shifts it
# by t and rotates it by r about a point o,  dp = t + i r (p - o). A second coordinate further out
# is rotated with it, so d2p = i r dp'; this is all there is, but for the second order of the arms'
# own deformation.


def outboard(body: ShapeIntegrals, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the outboard point (n,), complex, and its rotation, for coordinates e (n, q)."""
    x, y, angle = body.outboard @ e.T
    if body.is_stiffened:
        bent = np.einsum("pkl,nk,nl->pn", body.K0_outboard, e, e, optimize=True)
        x, y, angle = x - 0.5 * bent[0], y - 0.5 * bent[1], angle - 0.5 * bent[2]
    return complex(*body.outboard_point) + (x + 1j * y), angle


@dataclass(frozen=True, eq=False)
class InterfacePlace:
    """Where the last outboard interface is, and how it moves with the coordinates; n instants.

    Attributes:
        place: (n,) complex, m.
        jacobian: (n, C) complex, C = 1 + arms + N.
        hessian: (n, C, C) complex, symmetric; None where it was not asked for.
    """

    place: np.ndarray
    jacobian: np.ndarray
    hessian: np.ndarray | None = None


def interface_place(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, *, second: bool = False
) -> InterfacePlace:
    """Return place, Jacobian and, if asked for, Hessian at the motion's n instants; q (n, N)."""
    if 0 < len(q) < LEAST_INSTANTS:
        few = interface_place(*several(mechanism, motion, q), second=second)
        H = None if few.hessian is None else few.hessian[: len(q)]
        return InterfacePlace(few.place[: len(q)], few.jacobian[: len(q)], H)
    count, rigid = len(q), 1 + len(mechanism.bodies)
    size = rigid + q.shape[1]
    origins, rotations, shifts = _frames(mechanism, motion, q)
    end = origins[-1]
    J = np.zeros((count, size), dtype=complex)
    turn = np.zeros((count, size))  # rotation of all that lies outboard, by each coordinate
    J[:, 0] = 1.0
    order = [np.array([0])]  # groups of coordinates from the base outwards
    for k, part in enumerate(mechanism.slices):
        columns = slice(rigid + part.start, rigid + part.stop)
        B, rotation = shifts[k]
        J[:, 1 + k], turn[:, 1 + k] = 1j * (end - origins[k]), 1.0
        lever = (end - origins[k + 1])[:, None]
        J[:, columns] = rotations[k][:, None] * B + 1j * lever * rotation
        turn[:, columns] = rotation
        order += [np.array([1 + k]), np.arange(columns.start, columns.stop)]
    if not second:
        return InterfacePlace(end, J)
    H = np.zeros((count, size, size), dtype=complex)
    for i, group in enumerate(order):
        beyond = np.concatenate([np.zeros(0, dtype=int), *order[i + 1 :]])
        H[:, group[:, None], beyond] = 1j * turn[:, group, None] * J[:, None, beyond]
        H[:, beyond[:, None], group] = H[:, group[:, None], beyond].swapaxes(1, 2)
    for k, part in enumerate(mechanism.slices):
        own = slice(rigid + part.start, rigid + part.stop)
        lever = end - origins[k + 1]
        H[:, 1 + k, 1 + k] = 1j * J[:, 1 + k]
        r = turn[:, own]
        H[:, own, own] = -lever[:, None, None] * r[:, :, None] * r[:, None, :]
        if mechanism.bodies[k].is_stiffened:
            x, y, turned = mechanism.bodies[k].K0_outboard
            H[:, own, own] -= rotations[k][:, None, None] * (x + 1j * y)
            H[:, own, own] -= 1j * lever[:, None, None] * turned
    return InterfacePlace(end, J, H)


def _frames(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray], list[tuple[np.ndarray, np.ndarray]]]:
    """Return origins (the last one the end's), rotations and (shift, rotation) by the modes."""
    origins = [motion.q[:, 0] + 1j * mechanism.origin[1]]
    rotations: list[np.ndarray] = []
    shifts: list[tuple[np.ndarray, np.ndarray]] = []
    outer = np.ones(len(q), dtype=complex)
    for k, part in enumerate(mechanism.slices):
        body, e = mechanism.bodies[k], q[:, part]
        rotations.append(outer * motion.joint_rotations[k])
        d, angle = outboard(body, e)
        origins.append(origins[-1] + rotations[-1] * d)
        outer = rotations[-1] * np.exp(1j * angle)
        B, rotation = body.outboard[0] + 1j * body.outboard[1], body.outboard[2]
        if body.is_stiffened:
            bent = np.tensordot(e, body.K0_outboard, (1, 1))  # K0_p is symmetric
            B, rotation = B - bent[:, 0] - 1j * bent[:, 1], rotation - bent[:, 2]
        shifts.append((B, np.broadcast_to(rotation, e.shape)))
    return origins, rotations, shifts


def place_gradient(
    mechanism: Mechanism,
    motion: RigidMotion,
    q: np.ndarray,
    weights: np.ndarray,
    moved: np.ndarray,
    pull: np.ndarray,
) -> list[dict[str, np.ndarray]]:
    """Return the derivative of sum_n Re(conj(weights) p + conj(pull) J moved) by every body.

    p is the end's place and J moved the direction in which the coordinates `moved` take it.

    Args:
        mechanism, motion, q: as for `interface_place`, n instants.
        weights, pull: (n,) complex.
        moved: (n, C) virtual displacements of all coordinates.

    Returns:
        Of every body, by its outboard modes (3, q) and K0_outboard (3, q, q).
    """
    if 0 < len(q) < LEAST_INSTANTS:
        few = several(mechanism, motion, q, weights, moved, pull)
        for x in few[3:]:
            x[len(q) :] = 0.0
        return place_gradient(*few)
    origins, rotations, shifts = _frames(mechanism, motion, q)
    first = 1 + len(mechanism.bodies)
    virtual = [moved[:, first + part.start : first + part.stop] for part in mechanism.slices]
    turns, swept = _virtual_motion(origins, rotations, shifts, moved[:, :first], virtual)
    found = []
    for k, (part, v) in enumerate(zip(mechanism.slices, virtual, strict=True)):
        e, back = q[:, part], np.conj(rotations[k])
        lever, change = origins[-1] - origins[k + 1], swept[-1] - swept[k + 1]
        # What a shift along the frame's axes, and a rotation of all that is outboard, are worth:
        # of the place itself and as the frame turns by `moved`, and of the modes' variation.
        turned = weights - 1j * turns[k] * pull
        spin = (np.conj(weights) * 1j * lever + np.conj(pull) * 1j * change).real
        values = ((back * turned).real, (back * turned).imag, spin)
        rates = ((back * pull).real, (back * pull).imag, (np.conj(pull) * 1j * lever).real)
        pairs = list(zip(values, rates, strict=True))
        by = {"outboard": np.stack([a @ e + b @ v for a, b in pairs])}
        if mechanism.bodies[k].is_stiffened:
            by["K0_outboard"] = -np.stack(
                [e.T @ (0.5 * a[:, None] * e + b[:, None] * v) for a, b in pairs]
            )
        found.append(by)
    return found


def _virtual_motion(
    origins: list[np.ndarray],
    rotations: list[np.ndarray],
    shifts: list[tuple[np.ndarray, np.ndarray]],
    rigid: np.ndarray,
    virtual: list[np.ndarray],
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return how far virtual displacements turn every frame, and shift every origin (complex)."""
    # Virtual displacements: of rigid coordinates (n, 1 + arms), of every arm's elastic ones (n, q).
    turns, swept = [], [rigid[:, 0].astype(complex)]
    turn = np.zeros(len(rigid))
    for k, ((B, rotation), v) in enumerate(zip(shifts, virtual, strict=True)):
        turn = turn + rigid[:, 1 + k]
        turns.append(turn)
        bend = np.einsum("nk,nk->n", np.broadcast_to(B, v.shape), v)
        arm = origins[k + 1] - origins[k]
        swept.append(swept[-1] + 1j * turn * arm + rotations[k] * bend)
        turn = turn + np.einsum("nk,nk->n", rotation, v)
    return turns, swept
