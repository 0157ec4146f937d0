"""Material laws C: stresses by strains, as matrices; what they say of equivalent stress.

Strains are xx, yy, 2 xy in the plane and xx, yy, zz, 2 xy, 2 yz, 2 zx in space, stresses xx, yy, xy
and xx, yy, zz, xy, yz, zx. Forms hold a law as a constant: another one compiles nothing.
"""

from __future__ import annotations

import numpy as np

# Pairs of directions that shear, in the order of strains and stresses.
SHEARS = {2: ((0, 1),), 3: ((0, 1), (1, 2), (2, 0))}

# Components whose length is von Mises's stress. In the plane
# s^2 = ((xx + yy) / 2)^2 + 3/4 (xx - yy)^2 + 3 xy^2, in space
# s^2 = ((xx - yy)^2 + (yy - zz)^2 + (zz - xx)^2) / 2 + 3 (xy^2 + yz^2 + zx^2), with the first sum
# that of ((xx + yy) / 2 - zz)^2 and 3/4 (xx - yy)^2.
_SHARE = 0.75**0.5
VON_MISES = {
    2: np.array([[0.5, 0.5, 0.0], [_SHARE, -_SHARE, 0.0], [0.0, 0.0, 3.0**0.5]]),
    3: np.zeros((5, 6)),
}
VON_MISES[3][0, :3], VON_MISES[3][1, :2] = (0.5, 0.5, -1.0), (_SHARE, -_SHARE)
VON_MISES[3][2:, 3:] = 3.0**0.5 * np.eye(3)


def isotropic(dim: int, poisson_ratio: float) -> np.ndarray:
    """Return C (3, 3) of plane stress or (6, 6) of space, of unit Young's modulus."""
    directions = np.eye(dim) * (1.0 + poisson_ratio) - poisson_ratio
    shears = len(SHEARS[dim])
    compliance = np.zeros((dim + shears, dim + shears))
    compliance[:dim, :dim] = directions
    compliance[dim:, dim:] = 2.0 * (1.0 + poisson_ratio) * np.eye(shears)
    return np.linalg.inv(compliance)
