"""Machines in space over time: the plane's result, and a chain of beams."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import beam, posed_machine, posed_motion
from spatial_beams import DURATION, quintic_motion, reference_chain

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.multibody.kinematics import deviation, end_rotation
from dolfinopt.multibody.mechanism import Drives, plane_chain
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.paths.time_laws import quintic
from dolfinopt.profiling import Profile

pytestmark = pytest.mark.serial
TOLERANCE = 1e-5


def plane_motion(t):
    """Cart and two joints by quintics in 0.5 s."""
    s, sd, sdd = (x[:, None] * [0.3, 1.2, -0.9] for x in quintic(t, 0.5))
    return RigidMotion(np.array([0.0, 0.4, 0.6]) + s, sd, sdd)


@pytest.mark.parametrize("controlled", [False, True])
def test_plane_machine_in_space(controlled):
    """The two-arm machine of beams, posed in space, has the plane's trajectory."""
    # Under control positions alone are compared to 1e-9, with the rigid machine's feed-forward.
    bodies = tuple(beam(damping=1e-3).body() for _ in range(2))
    plane = plane_chain(bodies, 0.5, 0.01, (0.0, -9.81), -0.3)
    ends = (0.0, 0.5)
    posed = posed_machine(plane), lambda t: posed_motion(plane_motion(t)), ends
    systems = [ElasticSystem(plane, plane_motion, ends), ElasticSystem(*posed)]
    if controlled:
        gains = np.array([2e3, 400.0, 200.0])
        limits, driven = np.full(3, np.inf), np.ones(3, dtype=bool)
        drives = Drives(np.arange(3), gains, 0.05 * gains, limits, driven, True)
        systems = [MachineSystem(plane, plane_motion, ends, drives), MachineSystem(*posed, drives)]
    grid = radau.integrate(systems[0], TOLERANCE, 4, Profile()).time_grid
    expected, found = (radau.on_grid(one, grid, TOLERANCE, 4) for one in systems)
    t = np.linspace(*ends, 101)
    y = expected.sample(t)
    assert np.abs(found.sample(t) - y).max() < 1e-9 * np.abs(y).max()
    if controlled:
        rates = [y, expected.sample(t, 1), expected.sample(t, 2)]
        forces = [one.at(t).forces(*rates) for one in systems]
        assert np.abs(forces[1] - forces[0]).max() < 1e-11 * np.abs(forces[0]).max()
    else:  # the end-effector turns about z by the plane's angle
        motions = plane_motion(t), posed_motion(plane_motion(t))
        turns = [
            end_rotation(one.mechanism, motion, y, motion)
            for one, motion in zip(systems, motions, strict=True)
        ]
        assert np.abs(turns[1] - turns[0] * [0.0, 0.0, 1.0]).max() < 1e-14 < np.abs(turns[0]).max()


def test_chain_of_beams():
    """Largest deviation of nonlinear Saint-Venant beams, 19.05 mm, within 1 %; static start."""
    system = ElasticSystem(reference_chain(2), quintic_motion, (0.0, DURATION))
    solution = radau.integrate(system, TOLERANCE, 4, Profile())
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
