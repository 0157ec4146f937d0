"""Where the end-effector is, how far off the equivalent rigid machine's, and derivatives of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.mechanism import FEW, Mechanism, several
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths (n,) of vectors (n, 2), or (n, 3) in space."""
    if vectors.shape[1] == 2:
        return np.hypot(vectors[:, 0], vectors[:, 1])
    out: np.ndarray = np.linalg.norm(vectors, axis=1)
    return out


def end_effector(mechanism: Mechanism, motion: RigidMotion, q: np.ndarray) -> np.ndarray:
    """Return the end-effector's position (n, 2), m, of the flexible mechanism."""
    if 0 < len(q) < FEW:
        return end_effector(*several(mechanism, motion, q))[: len(q)]
    place = motion.q[:, 0] + 1j * mechanism.joint_height
    joint_rotation = np.ones(len(q), dtype=complex)
    for k, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies, strict=True)):
        joint_rotation = joint_rotation * np.exp(1j * motion.q[:, k + 1])
        d, angle = outboard(body, q[:, part])
        place = place + joint_rotation * d
        joint_rotation = joint_rotation * np.exp(1j * angle)
    return np.stack([place.real, place.imag], axis=1)


def outboard(body: ShapeIntegrals, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the outboard point (n,), complex, and its rotation, for coordinates e (n, q)."""
    x, y, angle = body.outboard @ e.T
    if body.is_stiffened:
        bent = np.einsum("pkl,nk,nl->pn", body.K0_outboard, e, e, optimize=True)
        x, y, angle = x - 0.5 * bent[0], y - 0.5 * bent[1], angle - 0.5 * bent[2]
    return complex(*body.outboard_point) + (x + 1j * y), angle


def deviation(mechanism: Mechanism, motion: RigidMotion, q: np.ndarray) -> np.ndarray:
    """Return the flexible minus the equivalent rigid end-effector (n, 2), m.

    Source: Seifried, Moghadasi & Held (2015), eq. (6), doi:10.1016/j.piutam.2015.01.018.
    """
    rigid = end_effector(mechanism, motion, np.zeros_like(q))
    return end_effector(mechanism, motion, q) - rigid


def end_effector_gradient(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """Return the gradient of sum_n weights_n . end_effector_n.

    Args:
        mechanism, motion, q: as for `end_effector`, n instants.
        weights: (n, 2).

    Returns:
        By q (n, N), and by every body's outboard modes (3, q) and their geometric stiffness
        (3, q, q), under the names of the shape integrals.
    """
    if 0 < len(q) < FEW:
        few = several(mechanism, motion, q, weights)
        few[-1][len(q) :] = 0.0
        by_q, by_bodies = end_effector_gradient(*few)
        return by_q[: len(q)], by_bodies
    w = weights[:, 0] + 1j * weights[:, 1]
    rotations, levers = [], []
    joint_rotation = np.ones(len(q), dtype=complex)
    for k, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies, strict=True)):
        joint_rotation = joint_rotation * np.exp(1j * motion.q[:, k + 1])
        rotations.append(joint_rotation)
        d, angle = outboard(body, q[:, part])
        levers.append(joint_rotation * d)
        joint_rotation = joint_rotation * np.exp(1j * angle)
    by_q = np.empty_like(q)
    by_outboard: list[dict[str, np.ndarray]] = []
    beyond = np.zeros(len(q), dtype=complex)  # from this arm's outboard point to the end
    for k in reversed(range(len(rotations))):
        part, body = mechanism.slices[k], mechanism.bodies[k]
        place = np.conj(rotations[k]) * w
        rotation = (np.conj(w) * 1j * beyond).real
        e, pulls = q[:, part], (place.real, place.imag, rotation)
        by_q[:, part] = np.stack(pulls, axis=1) @ body.outboard
        by = {"outboard": np.stack([pull @ e for pull in pulls])}
        if body.is_stiffened:
            pairs = zip(pulls, body.K0_outboard, strict=True)
            by_q[:, part] -= sum(pull[:, None] * (e @ K0) for pull, K0 in pairs)
            by["K0_outboard"] = np.stack([-0.5 * (e.T * pull) @ e for pull in pulls])
        by_outboard.insert(0, by)
        beyond = beyond + levers[k]
    return by_q, by_outboard


# -- first and second derivatives of the end-effector's place by all coordinates of a mechanism
#
# Coordinates are ordered [rigid (1 + arms), elastic (N)]; places are complex, p = p_x + i p_y.
# Going outwards along the chain every coordinate moves all that lies outboard of it: it shifts it
# by t and rotates it by r about a point o,  dp = t + i r (p - o). A second coordinate further out
# is rotated with it, so d2p = i r dp'; this is all there is, but for the second order of the arms'
# own deformation.


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
    if 0 < len(q) < FEW:
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
    origins = [motion.q[:, 0] + 1j * mechanism.joint_height]
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
    if 0 < len(q) < FEW:
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
