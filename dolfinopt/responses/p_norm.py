"""The p-norm: the largest of several values, made smooth."""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.end_effector import lengths


def p_norm(
    values: np.ndarray, exponent: float, weights: np.ndarray | None = None
) -> tuple[float, np.ndarray]:
    """Return (sum_k w_k f_k^p)^(1/p) of f >= 0 and its derivative by f (n,).

    With w = 1 at least the largest value and at most n^(1/p) times it; with weights that add up to
    1 a p-mean, at most the largest. Powers are those of f over its largest, so that they neither
    over- nor underflow. All zero: 0 and no derivative.

    Args:
        values: (n,) f.
        exponent: p >= 1.
        weights: (n,) w >= 0; None: 1.
    """
    largest = values.max()
    if largest == 0.0:
        return 0.0, np.zeros_like(values)
    relative = values / largest
    powers = relative**exponent
    total = float(np.sum(powers) if weights is None else weights @ powers)
    by_values = relative ** (exponent - 1.0) * total ** (1.0 / exponent - 1.0)
    return (
        float(largest * total ** (1.0 / exponent)),
        by_values if weights is None else weights * by_values,
    )


def p_norm_of_lengths(
    vectors: np.ndarray, exponent: float, weights: np.ndarray | None = None
) -> tuple[float, np.ndarray]:
    """Return the p-norm of the lengths |e_k| and its derivative by the vectors (n, d).

    |e|^(p - 2) e: no division by a length of zero.

    Args:
        vectors: (n, d) e, d = 2 or 3.
        exponent: p >= 2.
        weights: as for `p_norm`.
    """
    distances = lengths(vectors)
    largest = distances.max()
    if largest == 0.0:
        return 0.0, np.zeros_like(vectors)
    relative = distances / largest
    weights = np.ones_like(distances) if weights is None else weights
    total = float(weights @ relative**exponent)
    factor = total ** (1.0 / exponent - 1.0) * weights * relative ** (exponent - 2.0) / largest
    return float(largest * total ** (1.0 / exponent)), factor[:, None] * vectors
