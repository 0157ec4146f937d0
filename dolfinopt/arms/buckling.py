"""Buckling modes of one arm under the static stress of an instant.

With all loads grown by a factor, their directions kept, the lowest positive lambda of

    (K + lambda K0) phi = 0

is the factor at which the arm is no longer stable. It is clamped at its inboard interface; the
outboard ones are rigid and move freely, as in the reduction. Nothing else in the chain holds it:
what is beyond only loads it. Plane arms buckle in their plane.
Source: Cook, Malkus, Plesha & Witt, Concepts and Applications of Finite Element Analysis (2002),
ch. 18; Wallrapp & Schwertassek (1991), doi:10.1002/nme.1620320818.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.prestress import Prestress
from dolfinopt.reduction.eigenproblem import largest_eigenpairs
from dolfinopt.reduction.free_arm import FreeOperators


@dataclass(frozen=True, eq=False)
class BucklingModes:
    """The first modes to buckle.

    Attributes:
        inverse: (k,) mu = 1 / lambda = -phi'K0 phi, descending; negative where nothing buckles.
        field: (n_nodes, d, k) phi, phi'K phi = 1.
    """

    inverse: np.ndarray
    field: np.ndarray


# Residuals of mu, relative to the energy of a mode: of a first search, and of what counts. Under
# tension alone all mu crowd below zero: of 100 x 10 cells the first takes 22 solves for four modes,
# the second 2 266. Modes that follow far behind crowd as well.
ROUGHLY, TOLERANCE = 1e-4, 1e-9
COUNTS = 0.4  # of the largest mu, above which others count


def buckling_modes(stress: Prestress, count: int, least: float = 0.0) -> BucklingModes:
    """Return the first modes of K phi + lambda K0 phi = 0 (collective on the arm's ranks).

    The largest mu of -K0 phi = mu K phi, with the factor of the interior at hand; those that are
    much smaller than the largest are left out.

    Args:
        stress: of one instant.
        count: number of modes at most.
        least: mu below which nothing buckles: modes are rough then.

    Raises:
        ConvergenceError: they do not converge.
    """
    arm, free = stress.arm, FreeOperators(stress.arm)
    K0, D = stress.matrix(), stress.rotation[:, 0]
    dim = arm.mesh.dim

    def softened(rows: np.ndarray) -> np.ndarray:
        """Return -T'K0T times a vector."""
        interior, outboard = free.split(rows)
        field = arm.expand(interior[:, None], outboard[:, None])[:, :, 0]
        inner, lower = arm.restrict((K0 @ field)[:, :, None])
        turned = np.zeros((len(D), len(outboard) // len(D)))
        turned[:, dim:] = (D @ outboard.reshape(turned.shape)[:, dim:, None])[:, :, 0]
        return -free.joined(inner[:, 0], lower[:, 0] + turned.ravel())

    inverse, rows = largest_eigenpairs(free.pencil, softened, count, ROUGHLY)
    counts = int(np.count_nonzero(inverse > max(COUNTS * inverse[0], least)))
    if counts:
        near = rows[:, :counts]
        inverse, rows = largest_eigenpairs(free.pencil, softened, counts, TOLERANCE, near)
    parts = [free.split(one) for one in rows.T]
    interior, outboard = (np.stack(each, axis=1) for each in zip(*parts, strict=True))
    return BucklingModes(inverse, arm.expand(interior, outboard))
