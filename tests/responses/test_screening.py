"""The search for the largest stress misses nothing, and looks at few instants."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from dolfinopt.responses.stress import every, maxima, screen


def lengths(A: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return |A_e a_n| (points, n)."""
    return np.sqrt(np.square(A @ a.T).sum(axis=0))


def vibration(rng: np.random.Generator, n: int, m: int) -> np.ndarray:
    """Return coefficients of slow and fast vibrations that decay."""
    t = np.linspace(0.0, 1.0, n)[:, None]
    slow = np.sin(2.0 * np.pi * rng.uniform(0.5, 8.0, m) * t + rng.uniform(0.0, 6.0, m))
    fast = np.sin(2.0 * np.pi * rng.uniform(50.0, 400.0, m) * t) * np.exp(-5.0 * t)
    return slow + 0.2 * fast * rng.uniform(0.0, 1.0, m)


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("seed", range(12))
def test_no_maximum_is_missed(seed: int) -> None:
    """Against all points at all instants; with columns that cancel, and ones without stress."""
    rng = np.random.default_rng(seed)
    n, points, m = 901, 300, 9
    components = 5 if seed % 2 else 3  # in space, in the plane
    A = rng.normal(size=(components, points, m)) * 10.0 ** rng.uniform(-8.0, 8.0, m)
    A[:, :, 3] = 2.0 * A[:, :, 1]  # the same twice
    A[:, :, 5] = 0.0
    a = vibration(rng, n, m) / np.linalg.norm(A, axis=(0, 1)).clip(1e-300)
    cancelled = 1e3 * np.abs(a[:, 1]).max() * np.sin(np.arange(n))
    a[:, 1] += cancelled
    a[:, 3] -= 0.5 * cancelled
    a[:, 5] = 1.0
    if seed % 3 == 0:  # a single sample that sticks out
        a[rng.integers(n)] *= 3.0
    truth = lengths(A, a)
    coarse = every(n, 60)
    found = screen(MPI.COMM_SELF, A, a, coarse)
    assert found.largest == pytest.approx(truth.max(), rel=1e-9)
    assert truth[found.point, found.instant] == pytest.approx(truth.max(), rel=1e-9)
    np.testing.assert_allclose(found.values, truth[:, coarse].max(axis=0), rtol=1e-3)
    by_point, when = maxima(MPI.COMM_SELF, A, a)
    np.testing.assert_allclose(by_point, truth.max(axis=1), atol=2e-3 * truth.max())
    np.testing.assert_allclose(truth[np.arange(points), when], by_point, atol=2e-3 * truth.max())
    assert found.looked_at <= n


def test_nothing_is_loaded() -> None:
    found = screen(MPI.COMM_SELF, np.zeros((3, 4, 2)), np.zeros((7, 2)), every(7))
    assert found.largest == 0.0


def test_ranks_without_points() -> None:
    """Ranks share the points, one has none; all know the largest, one has the point."""
    rng = np.random.default_rng(5)
    A, a = rng.normal(size=(3, 40, 4)), vibration(rng, 200, 4)
    comm = MPI.COMM_WORLD
    mine = A if comm.rank == 0 else A[:, :0]
    found = screen(comm, mine, a, every(200, 20))
    assert found.largest == pytest.approx(lengths(A, a).max(), rel=1e-12)
    assert (found.point >= 0) == (comm.rank == 0)
