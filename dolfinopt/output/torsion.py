"""Whether a solid arm has too few cells over its section for the torsion of its motion.

Hexahedra with eight nodes, incompatible modes or not, are too stiff in torsion: their corners warp
bilinearly, and with one or two cells across symmetry forbids them to warp at all.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dolfinopt.dynamics.build import Trajectory
from dolfinopt.multibody.shape_integrals import ShapeIntegrals

# Errors of the torsion constant of square sections of n x n cells, relative to Saint-Venant's:
# 0.186, 0.186, 0.090, 0.052, 0.024, 0.014 for n = 1, 2, 3, 4, 6, 8. Oblong ones have less.
LARGEST_ERROR = 0.186
ERROR_TIMES_CELLS = 0.86
ERROR_LIMIT = 0.01  # of an arm's strain energy, from which on a warning tells of it


def torsion_error(across: int, through: int) -> float:
    """Return by how much hexahedra over height and thickness are too stiff, relative."""
    return min(LARGEST_ERROR, ERROR_TIMES_CELLS / (across * through))


def torsion_share(body: ShapeIntegrals, q: np.ndarray) -> float:
    """Return the part of torsion in the strain energy along a motion.

    About its own axis the first outboard interface turns by theta; with the compliance
    C = U K^-1 U' of the interface the energy is theta^2 / (2 C_theta).

    Args:
        body: of a solid arm.
        q: (n, q) its elastic coordinates.
    """
    about_x = body.outboard[3]
    compliance = about_x @ np.linalg.solve(body.K, about_x)
    torsion = ((q @ about_x) ** 2).sum() / compliance
    return float(torsion / np.einsum("nk,kl,nl->", q, body.K, q))


def torsion_warnings(trajectory: Trajectory) -> Iterator[str]:
    """Yield a sentence on every arm whose error in torsion counts."""
    if trajectory.scene.dimension == 2:
        return
    mechanism = trajectory.mechanism
    for arm, body, part in zip(
        trajectory.scene.arms, mechanism.bodies, mechanism.slices, strict=False
    ):
        q = trajectory.q_e[:, part]
        if not q.any() or arm.hollow or arm.element == "quadratic":
            continue
        if arm.cells is None or len(arm.cells) == 2:  # cells of a file are not counted
            continue
        error, share = torsion_error(*arm.cells[1:]), torsion_share(body, q)
        if error * share > ERROR_LIMIT:
            yield (
                f"arm {arm.name!r}: torsion is {100.0 * share:.0f} % of its strain energy, and "
                f"{arm.cells[1]} x {arm.cells[2]} cells over its section are too stiff in torsion "
                f'by {100.0 * error:.2g} %; set element = "quadratic", or use more cells there'
            )
