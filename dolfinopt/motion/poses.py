"""Orientations along a path in space: rows of angles or rotation vectors, joined without jumps.

An orientation is interpolated as the rotation vector theta against that of the first row,
R = R_0 exp(theta~), whose angular velocity and acceleration `SpaceTurning` knows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from dolfinopt.multibody.dimension import SpaceTurning
from dolfinopt.scene.laws import SAME, Values

RPY = ("roll", "pitch", "yaw")
VECTOR = ("rx", "ry", "rz")


def orientations(kind: tuple[str, ...], rows: np.ndarray) -> np.ndarray:
    """Return rotations (n, 3, 3) of rows (n, 3) of `RPY` about fixed axes, or of `VECTOR`, rad."""
    result = Rotation.from_rotvec(rows) if kind == VECTOR else Rotation.from_euler("xyz", rows)
    matrices: np.ndarray = result.as_matrix()
    return matrices


def relative_vectors(R: np.ndarray) -> np.ndarray:
    """Return rotation vectors (n, 3) against the first of the rotations (n, 3, 3).

    Of the vectors whole turns apart each is the one nearest to that before it.
    """
    vectors: np.ndarray = Rotation.from_matrix(R[0].T @ R).as_rotvec()
    for k in range(1, len(vectors)):
        before, angle = vectors[k - 1], float(np.linalg.norm(vectors[k]))
        # Without a turn its axis may be any: that before.
        axis = vectors[k] if angle > SAME else before
        axis = axis / max(float(np.linalg.norm(axis)), SAME)
        turns = np.round((axis @ before - angle) / (2.0 * np.pi))
        vectors[k] = (angle + 2.0 * np.pi * turns) * axis
    return vectors


def turning(start: np.ndarray, vectors: Sequence[np.ndarray]) -> Values:
    """Return R (n, 3, 3), angular velocity and acceleration (n, 3) in the ground's frame.

    Args:
        start: R_0 (3, 3).
        vectors: theta (n, 3) and two time derivatives.
    """
    space_turning = SpaceTurning(*(x.T for x in vectors))
    back = start.T
    return (
        start @ space_turning.R.transpose(2, 0, 1),
        space_turning.velocity.T @ back,
        space_turning.acceleration.T @ back,
    )
