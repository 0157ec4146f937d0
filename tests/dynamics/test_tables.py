"""What tables hold between two steps of the integrator: nothing is lost, whatever their length."""

from dataclasses import replace

import numpy as np
import pytest
from bodies import beam, plane_chain
from machines import distance

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.tables import LoadedMotion, Table
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.tree import AppliedForce
from dolfinopt.profiling import Profile

pytestmark = pytest.mark.serial  # arrays of one process

PULSE = np.array([0.5005, 0.5010, 0.5025, 0.5030])  # s, where it sets in, is up, falls, ends


def still(t):
    """Return no motion of cart and two joints."""
    zero = np.zeros((len(t), 3))
    return RigidMotion(zero + np.array([0.0, 0.6, 0.8]), zero, zero)


def loaded(rows):
    """Return two arms at rest with a pulse of 400 N at the end, in a table of these rows, s."""
    arm = beam(bending=10.0, axial=300.0, damping=1e-3)
    mechanism = plane_chain([arm.body()] * 2, 1.0, 0.01, (0.0, 0.0), 0.0)
    force = AppliedForce(site=(1, 0), column=0, in_world=True, known=False)
    mechanism = replace(mechanism, forces=(force,))
    t = np.union1d(rows, PULSE)
    values = np.zeros((len(t), 3))
    values[:, 1] = np.interp(t, PULSE, [0.0, 400.0, 400.0, 0.0])
    motion = LoadedMotion(still, (Table(t, values),))
    return MachineSystem(mechanism, motion, (0.0, 1.0))


@pytest.mark.parametrize("count", [2, 61, 1000, 100_000])
def test_a_pulse_in_a_table_of_any_length(count):
    """The same motion as with steps that end at the pulse's corners."""
    alone = loaded(np.array([0.0, 1.0]))
    stepped = replace(alone, breakpoints=(0.0, *PULSE.tolist(), 1.0))
    right = radau.integrate(stepped, 1e-6, 4, Profile())
    found = radau.integrate(loaded(np.linspace(0.0, 1.0, count)), 1e-4, 4, Profile())
    assert distance(alone, found, right) <= 1e-4
    assert len(found.a) < 1000


@pytest.mark.parametrize(
    ("move", "begin"),
    [
        ((2e-3, 0.0, 0.0), 0.501),
        ((0.0, 5.5e-3, 0.0), 0.501),
        ((0.0, 0.0, 5.5e-3), 0.501),
        ((0.0, 2e-2, 0.0), 0.501),  # is marched
        ((2e-2, 0.0, 0.0), 0.4567),  # from a rest of whose rounding no step is a small share
    ],
)
def test_a_jerk_in_a_table_of_a_motion_is_not_lost(move, begin):
    """Cart or joint move on by mm or mrad within 4 ms, far from any step's end."""
    corners = begin + np.array([0.0, 0.001, 0.003, 0.004])

    def jerk(t):
        u = np.clip((t - begin) / 0.004, 0.0, 1.0)
        s = np.stack([u**3 * (10 - 15 * u + 6 * u * u), 30 * u**2 * (1 - u) ** 2 / 0.004,
                      60 * u * (1 - u) * (1 - 2 * u) / 0.004**2])  # fmt: skip
        rest = still(t)
        by = np.array(move)
        return RigidMotion(rest.q + np.outer(s[0], by), *(np.outer(x, by) for x in s[1:]))

    alone = loaded(np.array([0.0, 1.0])).mechanism
    unloaded = replace(alone, forces=())
    stepped = MachineSystem(unloaded, jerk, (0.0, begin, corners[-1], 1.0))
    right = radau.integrate(stepped, 1e-6, 4, Profile())
    tabulated = MachineSystem(unloaded, LoadedMotion(jerk, rows=corners), (0.0, 1.0))
    found = radau.integrate(tabulated, 1e-4, 4, Profile())
    assert distance(stepped, found, right) <= 1e-4
