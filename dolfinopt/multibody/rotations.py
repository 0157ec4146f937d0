"""Rotations in space by fixed numbers: vectors as matrices, URDF's frames."""

from __future__ import annotations

import numpy as np

ONE: np.ndarray = np.eye(3)
PERMUTATION = np.cross(ONE[:, None], ONE).transpose(2, 0, 1)  # e_cab


def skew(v: np.ndarray) -> np.ndarray:
    """Return v~ (..., 3, 3), v~ u = v x u."""
    out: np.ndarray = np.cross(v[..., None, :], ONE).swapaxes(-1, -2)
    return out


def roll_pitch_yaw(rpy: tuple[float, float, float]) -> np.ndarray:
    """Return the rotation (3, 3) of URDF's fixed-axis roll, pitch, yaw: Rz(y) Ry(p) Rx(r)."""
    from scipy.spatial.transform import Rotation  # takes as long to import as NumPy

    out: np.ndarray = Rotation.from_euler("xyz", rpy).as_matrix()
    return out
