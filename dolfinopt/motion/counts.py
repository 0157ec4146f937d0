"""Whether closures move just the passive coordinates: ranks of their Jacobian at a closed pose.

With G = dg/dq of the closures, p the passive coordinates and R all of them: rank G - rank G_p
driven coordinates are held, too few are passive; p - rank G_p passive ones are undetermined, too
many; k - rank G equations follow from the others. Null vectors name the coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.motion.measured import SINGULAR_SHARE
from dolfinopt.multibody.ranks import rank


@dataclass(frozen=True)
class Counts:
    """What closures do to passive and driven coordinates.

    Attributes:
        redundant: number of equations that follow from the others for rigid links.
        undetermined: passive coordinates that nothing moves; `loose` of them are too many.
        held: driven coordinates that closures hold; `missing` of them should be passive.
    """

    redundant: int
    undetermined: tuple[int, ...]
    loose: int
    held: tuple[int, ...]
    missing: int


def counts_of(G: np.ndarray, passive: np.ndarray, driven: np.ndarray, share: float) -> Counts:
    """Return the counts by a scaled Jacobian (k, R) of a usual pose.

    Args:
        G: see the module.
        passive, driven: columns.
        share: see `ranks.rank`.
    """
    own = G[:, passive]
    followed, every = rank(own, share), rank(G[:, [*passive, *driven]], share)
    left, _, right = np.linalg.svd(own)
    undetermined = np.abs(right[followed:]).max(axis=0, initial=0.0) > SINGULAR_SHARE
    held: tuple[int, ...] = ()
    if followed < every:
        moved = left[:, followed:].T @ G
        held = tuple(int(k) for k in driven if np.abs(moved[:, k]).max() > SINGULAR_SHARE)
    return Counts(
        redundant=len(G) - every,
        undetermined=tuple(passive[undetermined].tolist()),
        loose=len(passive) - followed,
        held=held,
        missing=every - followed,
    )
