"""Products of the modes' gradients that stresses multiply, and their transpose; s stresses.

Gradients are d_a phi_c as (d, d, q, points); pairs of modes i <= j as by `np.triu_indices`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Directions a, b and component c of every term of stress xx, yy, xy.
PLANE_TERMS = (
    ((0, 0, 0), (0, 0, 1)),
    ((1, 1, 0), (1, 1, 1)),
    ((0, 1, 0), (0, 1, 1), (1, 0, 0), (1, 0, 1)),
)
# Of stress xx, yy, zz, xy, yz, zx.
SOLID_TERMS = tuple(
    tuple((d, e, c) for d, e in sorted({(a, b), (b, a)}) for c in range(3))
    for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))
)


def pairs(H: np.ndarray, terms: Sequence[tuple[int, int, int]], out: np.ndarray) -> np.ndarray:
    """Return d_a phi_i . d_b phi_j (pairs, points), what one stress multiplies, in `out`.

    Mode by mode in place: index arrays would take ten times as long.
    """
    (a, b, c), *others = terms
    term = np.empty(H.shape[3])
    for one, i, j in zip(out, *np.triu_indices(H.shape[2]), strict=True):
        np.multiply(H[a, c, i], H[b, c, j], out=one)
        for d, e, f in others:
            one += np.multiply(H[d, f, i], H[e, f, j], out=term)
    return out


def pairs_transposed(
    H: np.ndarray, by_pairs: np.ndarray, kinds: Sequence[Sequence[tuple[int, int, int]]]
) -> np.ndarray:
    """Return the derivatives (d, d, q, points) by H, given those by `pairs` (s, pairs, points).

    The latter are scaled in place.
    """
    by_H, term = np.zeros_like(H), np.empty(H.shape[3])
    for place, (i, j) in enumerate(zip(*np.triu_indices(H.shape[2]), strict=True)):
        for weight, terms in zip(by_pairs[:, place], kinds, strict=True):
            if i == j:  # both factors are the same: once, twice as heavy
                weight *= 2.0
            for a, b, c in terms:
                by_H[a, c, i] += np.multiply(weight, H[b, c, j], out=term)
                if i != j:
                    by_H[b, c, j] += np.multiply(weight, H[a, c, i], out=term)
    return by_H
