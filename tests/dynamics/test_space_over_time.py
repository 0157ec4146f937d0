"""Machines in space over time: the plane's result, a chain of beams, the adjoint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import beam
from spatial_beams import DURATION, quintic_motion, reference_chain
from spatial_bodies import changes, posed_machine, posed_motion

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.adjoint import Adjoint
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.multibody.mechanism import Drives, Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.spatial.end_effector import deviation, end_effector_gradient
from dolfinopt.multibody.spatial.equations import SPACE
from dolfinopt.profiling import Profile

pytestmark = pytest.mark.serial
TOLERANCE = 1e-5


def plane_motion(t):
    """Cart and two joints by quintics in 0.5 s."""
    u = t[:, None] / 0.5
    s, sd = u**3 * (10.0 - 15.0 * u + 6.0 * u * u), 30.0 * u**2 * (1.0 - u) ** 2 / 0.5
    sdd = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / 0.25
    step = np.array([0.3, 1.2, -0.9])
    return RigidMotion(step * s + [0.0, 0.4, 0.6], step * sd, step * sdd)


@pytest.mark.parametrize("controlled", [False, True])
def test_plane_machine_in_space(controlled):
    """The two-arm machine of beams, posed in space, has the plane's trajectory; under control, too.

    There positions alone are compared to 1e-9 and the feed-forward is that of the rigid machine.
    """
    bodies = tuple(beam(damping=1e-3).body() for _ in range(2))
    plane = Mechanism(bodies, 0.5, 0.01, (0.0, -9.81), -0.3)
    tree, ends = posed_machine(plane), (0.0, 0.5)

    def joints(t):
        return posed_motion(plane_motion(t))

    systems = [ElasticSystem(plane, plane_motion, ends), ElasticSystem(tree, joints, ends, SPACE)]
    if controlled:
        gains = np.array([2e3, 400.0, 200.0])
        limits, driven = np.full(3, np.inf), np.ones(3, dtype=bool)
        drives = Drives(np.arange(3), gains, 0.05 * gains, limits, driven, True)
        systems = [
            MachineSystem(plane, plane_motion, ends, drives),
            MachineSystem(tree, joints, ends, drives, equations=SPACE),
        ]
    grid = radau.integrate(systems[0], TOLERANCE, 4, Profile()).time_grid
    expected, found = (radau.on_grid(one, grid, TOLERANCE, 4) for one in systems)
    t = np.linspace(*ends, 101)
    y = expected.sample(t)
    assert np.abs(found.sample(t) - y).max() < 1e-9 * np.abs(y).max()
    if controlled:
        rates = [y, expected.sample(t, 1), expected.sample(t, 2)]
        forces = [one.at(t).forces(*rates) for one in systems]
        assert np.abs(forces[1] - forces[0]).max() < 1e-11 * np.abs(forces[0]).max()


@pytest.fixture(scope="module")
def chain():
    """The reference chain, simulated."""
    system = ElasticSystem(reference_chain(2), quintic_motion, (0.0, DURATION), SPACE)
    return system, radau.integrate(system, TOLERANCE, 4, Profile())


def test_chain_of_beams(chain):
    """Largest deviation of nonlinear Saint-Venant beams, 19.05 mm, within 1 %; static start."""
    system, solution = chain
    t = np.linspace(0.0, DURATION, 601)
    motion = quintic_motion(t)
    found = np.linalg.norm(deviation(system.mechanism, motion, solution.sample(t)), axis=1)
    assert found.max() == pytest.approx(19.05e-3, rel=0.01)
    assert found.max() == pytest.approx(19.173e-3, rel=1e-4)  # linear in the beams' deformation
    q, qd = system.initial_state()
    rest = np.zeros_like(q)
    residual = system.at(np.zeros(1)).residual(q, rest, rest)
    assert np.abs(residual).max() < 1e-10 * np.abs(q @ system.mechanism.stiffness()).max()
    assert not qd.any() and np.abs(solution.q[0] - q[0]).max() < 1e-12 * np.abs(q).max()
    assert found[0] == pytest.approx(0.370e-3, rel=0.01)  # under gravity


def test_gradient_of_a_trajectory(chain):
    """Adjoint of the largest deviation's square by all integrals against central differences."""
    system, solution = chain
    t = np.array([0.2, 0.417])
    motion = quintic_motion(t)

    def value(mechanism, found):
        return float(np.sum(deviation(mechanism, motion, found.sample(t)) ** 2))

    mechanism, q = system.mechanism, solution.sample(t)
    weights = 2.0 * deviation(mechanism, motion, q)
    by_q, _, own = end_effector_gradient(mechanism, motion, q, weights)
    followed = Adjoint(system, solution).gradient(t, by_q)
    rng = np.random.default_rng(4)
    for i in (1, 2):
        body = mechanism.bodies[i]
        change = {
            name: 0.1 * np.asarray(getattr(body, name)) * rng.uniform(0.5, 1.0)
            for name in changes(rng, body)
        }
        expected = sum(np.sum(getattr(followed[i], name) * x) for name, x in change.items())
        expected += sum(np.sum(own[i][name] * change[name]) for name in own[i])

        def moved(h, i=i, body=body, change=change):
            bodies = list(mechanism.bodies)
            bodies[i] = replace(body, **{k: getattr(body, k) + h * x for k, x in change.items()})
            other = replace(system, mechanism=replace(mechanism, bodies=tuple(bodies)))
            found = radau.on_grid(other, solution.time_grid, 1e-9, 4, solution)
            return value(other.mechanism, found)

        step = 1e-4
        slope = (moved(step) - moved(-step)) / (2.0 * step)
        assert slope == pytest.approx(expected, rel=1e-6)
