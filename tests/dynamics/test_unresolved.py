"""The error of vibrations that steps are too long for."""

from __future__ import annotations

import numpy as np
import pytest

from dolfinopt.dynamics.collocation import Stages, _lost, radau_iia, unresolved
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.system import Unchanged
from dolfinopt.multibody.mechanism import plane_chain
from dolfinopt.multibody.motion import RigidMotion

pytestmark = pytest.mark.serial  # one rank shows all there is


def still(t: np.ndarray) -> RigidMotion:
    """Return a cart at rest."""
    return RigidMotion(*np.zeros((3, len(t), 1)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("damping", [0.0, 1e30])
def test_coordinates_without_mass_follow_their_loads(damping: float) -> None:
    """Next to no mass, F = t^2, within the polynomials: nothing vibrates, whatever the damping."""
    method, h = radau_iia(3), np.full(10, 0.1)
    nothing = ElasticSystem(plane_chain((), 0.0, 0.0, (0.0, 0.0), 0.0), still, (0.0, 1.0))
    instants = nothing.at(np.zeros(30))
    stages = Stages(Unchanged(nothing), method, h, instants, instants[::3])
    t = (np.arange(10)[:, None] * 0.1 + 0.1 * method.c)[:, :, None]
    states = (t**2, np.zeros_like(t), np.zeros_like(t))
    single = tuple(np.full((1, 1), x) for x in (1.0, damping, 1e-290))
    found = unresolved(stages, single, states, np.zeros((1, 1)), np.array([0]))
    assert found.shape == (1, 1)
    assert 0.0 <= found[0, 0] < 1e-12


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
