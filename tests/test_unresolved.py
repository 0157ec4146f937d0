"""The error of vibrations that steps are too long for."""

from __future__ import annotations

import numpy as np
import pytest

from dolfinopt.integrators.collocation import radau_iia
from dolfinopt.integrators.problem import lagrange_slopes
from dolfinopt.integrators.unresolved import _lost


def test_slopes_of_polynomials() -> None:
    """A cubic by four nodes: its own value and derivatives, at the ends and beyond."""
    nodes, tau = np.array([0.1, 0.4, 0.7, 1.0]), np.array([-0.2, 0.0, 0.55, 1.0])
    cubic = np.polynomial.Polynomial([1.0, -2.0, 0.5, 3.0])
    found = lagrange_slopes(nodes, tau) @ cubic(nodes)
    for k, row in enumerate(found):
        # Rounding of the inverted powers' matrix, some thousand large.
        np.testing.assert_allclose(row, cubic.deriv(k)(tau) if k else cubic(tau), atol=1e-11)


@pytest.mark.parametrize("stages", [2, 3, 4])
@pytest.mark.parametrize("z", [0.3j, 2.0j, -0.1 + 5.0j, -3.0 + 0.0j])
def test_lost_is_what_collocation_makes_of_a_free_vibration(stages: int, z: complex) -> None:
    """y' = z y over unit steps, the stages' equations solved one step after the other."""
    method = radau_iia(stages)
    y, apart = 1.0 + 0.0j, []
    for n in range(1, 6):
        k = np.linalg.solve(np.eye(stages) - z * method.A, np.full(stages, z * y))
        y = y + method.A[-1] @ k
        apart.append(abs(np.exp(n * z) - y))
    found = _lost(method, np.array([[[z]]]), np.array([5]))
    assert found[0, 0, 0] == pytest.approx(max(apart), rel=1e-9)
