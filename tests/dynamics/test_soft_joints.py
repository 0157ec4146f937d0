"""Springs between controlled motors and arms: the stiff limit, tangents and exact gradients."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from runs import TWO_ARM, overrides, run, scene

from dolfinopt import Model
from dolfinopt.dynamics.build import build_system
from dolfinopt.dynamics.machine_system import MachineSystem

pytestmark = pytest.mark.serial  # one rank shows all there is

SMALL = ("arms.cells=[16,3]", "motion.horizon=1.9", "simulation.tolerance=1e-5")
CONTROL = "control={stiffness=[2e5, 2e4, 2e4], damping=[2e4, 600.0, 600.0]}"
ROTORS = ("arms.rotor_inertia=2e-5", "arms.gear_ratio=100.0")
GRAVITY = "motion.gravity=[0.0, -9.81]"


def simulated(*changes: str):
    model = Model(scene(*SMALL, CONTROL, *ROTORS, *changes))
    return model.simulate().trajectory


def test_stiff_springs_are_rigid_drives() -> None:
    """The motors' inertia acts on the joints then; the rest falls with the spring's softness."""
    rigid = simulated(GRAVITY)
    left = []
    for stiffness in (2e6, 2e7):
        soft = simulated(
            GRAVITY, f"arms.joint_stiffness={stiffness}", f"arms.joint_damping={1e-3 * stiffness}"
        )
        assert soft.problem.num_coordinates == rigid.problem.num_coordinates + 2
        left.append(np.abs(soft.deviation - rigid.deviation).max() / np.abs(rigid.deviation).max())
    assert left[0] / left[1] == pytest.approx(10.0, rel=0.05)
    assert left[1] < 5e-3  # the joints' own springs are a thousandth of this


@pytest.mark.parametrize("rotor", [0.0, 2e-5])
def test_generalised_alpha(rotor: float) -> None:
    """The conventional method finds the same motion, with motors of no inertia, too."""
    soft = ("arms.joint_stiffness=1e5", "arms.joint_damping=100.0", f"arms.rotor_inertia={rotor}")
    options = ("simulation.integrator=generalized-alpha", "simulation.tolerance=1e-3")
    expected, found = simulated(*soft), simulated(*soft, *options)
    off = np.abs(found.deviation - expected.deviation).max()
    assert off < 1e-3 * np.abs(expected.deviation).max()  # measured 2.8e-4


def test_tangent() -> None:
    """The derivative of the residual by coordinates and rates, by central differences."""
    options = ("arms.joint_stiffness=1e5", "arms.joint_damping=100.0", "simulation.stiffening=true")
    limits = CONTROL.replace("}", ", limits=[300.0, 300.0, 200.0]}")
    model = Model(scene(*SMALL, limits, *ROTORS, GRAVITY, *options))
    trajectory = model.simulate().trajectory
    system = build_system(trajectory.scene, list(trajectory.mechanism.bodies))
    assert isinstance(system, MachineSystem)
    instants = system.at(np.array([0.3, 0.9]))
    rng = np.random.default_rng(4)
    scale = np.abs(trajectory.unknowns[0]).max(axis=0) + 1e-6
    state = [rng.normal(size=(2, system.num_coordinates)) * s * scale for s in (1.0, 20.0, 400.0)]
    matrix = instants.linearise(*state).dense().reshape(2, len(scale), 3, len(scale))
    for order in range(3):
        for i, size in enumerate(scale):
            ahead, back = ([x.copy() for x in state] for _ in range(2))
            step = 1e-4 * size * (1.0, 20.0, 400.0)[order]
            ahead[order][:, i] += step
            back[order][:, i] -= step
            found = (instants.residual(*ahead) - instants.residual(*back)) / (2.0 * step)
            # Second-order terms of size step^2 and rounding of residuals of a thousand newtons.
            size_of = np.abs(matrix[:, :, order]).max(axis=(0, 2)) + 1e-6
            assert (np.abs(found - matrix[:, :, order, i]) < 1e-5 * size_of).all()


def test_motors_on_the_desired_motion_move_their_rotors() -> None:
    """Without control the drives give what the springs take, and what the rotors' inertia does."""
    soft = ("arms.joint_stiffness=1e5", "arms.joint_damping=100.0", "arms.gear_ratio=100.0")
    light, heavy = (
        Model(scene(*SMALL, *soft, f"arms.rotor_inertia={inertia}")).simulate().trajectory
        for inertia in (0.0, 2e-5)
    )
    np.testing.assert_array_equal(heavy.deviation, light.deviation)  # the arms do not feel it
    change = heavy.joint_forces - light.joint_forces
    expected = 2e-5 * 100.0**2 * heavy.desired.qdd
    expected[:, 0] = 0.0  # the cart is prescribed, and moved by what the arms do
    size = np.abs(heavy.joint_forces).max()
    np.testing.assert_allclose(change, expected, rtol=0, atol=1e-12 * size)


def test_angles_of_motors_are_written(tmp_path: Path) -> None:
    """At rest under gravity the drives give what the springs between motor and arm give."""
    soft = ("arms.joint_stiffness=1e5", "arms.joint_damping=100.0", "simulation.tolerance=1e-3")
    changes = (*SMALL[:2], CONTROL, *ROTORS, GRAVITY, *soft)
    run("simulate", TWO_ARM, "--no-plots", "--out", tmp_path / "run", *overrides(*changes))
    found = np.load(tmp_path / "run" / "trajectory.npz")
    apart = found["q_motors"][0] - found["q_r"][0, 1:]
    np.testing.assert_allclose(1e5 * apart, found["joint_forces"][0, 1:], rtol=1e-9)
    header = (tmp_path / "run" / "trajectory.csv").read_text().splitlines()[0]
    assert "q_motor_arm1,q_motor_arm2" in header
