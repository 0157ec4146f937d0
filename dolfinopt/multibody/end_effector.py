"""Where the end-effector is, how far off the equivalent rigid machine's, and derivatives of it."""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.instants import FEW, several
from dolfinopt.multibody.mechanism import Mechanism, ModalConstants
from dolfinopt.multibody.motion import RigidMotion


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
    for k, (part, constants) in enumerate(
        zip(mechanism.slices, mechanism.modal_constants, strict=True)
    ):
        joint_rotation = joint_rotation * np.exp(1j * motion.q[:, k + 1])
        d, angle = outboard(constants, q[:, part])
        place = place + joint_rotation * d
        joint_rotation = joint_rotation * np.exp(1j * angle)
    return np.stack([place.real, place.imag], axis=1)


def outboard(constants: ModalConstants, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the outboard point (n,), complex, and rotation, see `inverse_dynamics`."""
    d, angle = constants.outboard_position + e @ constants.B, e @ constants.rotation
    if constants.K0 is not None:
        x, y, bent = (-0.5 * np.einsum("nk,nk->n", e @ K0, e) for K0 in constants.K0[4:])
        d, angle = d + (x + 1j * y), angle + bent
    return d, angle


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
    for k, (part, constants) in enumerate(
        zip(mechanism.slices, mechanism.modal_constants, strict=True)
    ):
        joint_rotation = joint_rotation * np.exp(1j * motion.q[:, k + 1])
        rotations.append(joint_rotation)
        d, angle = outboard(constants, q[:, part])
        levers.append(joint_rotation * d)
        joint_rotation = joint_rotation * np.exp(1j * angle)
    by_q = np.empty_like(q)
    by_outboard: list[dict[str, np.ndarray]] = []
    beyond = np.zeros(len(q), dtype=complex)  # from this arm's outboard point to the end
    for k in reversed(range(len(rotations))):
        part, constants = mechanism.slices[k], mechanism.modal_constants[k]
        place = np.conj(rotations[k]) * w
        rotation = (np.conj(w) * 1j * beyond).real
        by_q[:, part] = (
            np.outer(place.real, constants.B.real)
            + np.outer(place.imag, constants.B.imag)
            + np.outer(rotation, constants.rotation)
        )
        e, pulls = q[:, part], (place.real, place.imag, rotation)
        by = {"outboard": np.stack([pull @ e for pull in pulls])}
        if constants.K0 is not None:
            pairs = zip(pulls, constants.K0[4:], strict=True)
            by_q[:, part] -= sum(pull[:, None] * (e @ K0) for pull, K0 in pairs)
            by["K0_outboard"] = np.stack([-0.5 * (e.T * pull) @ e for pull in pulls])
        by_outboard.insert(0, by)
        beyond = beyond + levers[k]
    return by_q, by_outboard
