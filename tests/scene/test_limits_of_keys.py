"""Every number of a scene at the limits of its range: it runs, or one line says why not."""

from __future__ import annotations

import re

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.scene.load import describe_keys, load_scene

pytestmark = pytest.mark.serial  # a hundred small runs

# Slow, small and roughly solved: the arithmetic is tried, not the machine.
QUICK = ["arms.cells=[12,2]", "motion.duration=4", "motion.horizon=4", "simulation.sample=0.05"]
QUICK += ["objective.load_cases=5", "optimizer.max_iterations=1", "simulation.tolerance=0.01"]
DENSE = "design.initial=0.6"  # cut at one half, a uniform design of one half is nothing
# What a key needs to be used at all.
USED = {
    "reduction.shifts": ["reduction.method=krylov"],
    "reduction.band": ["reduction.method=balanced"],
    "reduction.tolerance": ["reduction.coordinates=auto"],
    "motion.start": ["motion.path=line"],
    "motion.end": ["motion.path=line"],
    # With stiffening they are refused after a long search, as payload.mass is.
    "arms.joint_inertia": ["simulation.stiffening=false", "reduction.coordinates=3"],
    "payload.inertia": ["simulation.stiffening=false", "reduction.coordinates=3"],
    "motion.horizon": ["motion.duration=1e5", "simulation.sample=1e3"],
    "motion.gravity": ["motion.duration=2", "motion.horizon=2"],
    "motion.base_position": ["motion.base=fixed"],
    "simulation.rho_inf": ["simulation.integrator=generalized-alpha", "simulation.tolerance=0.1"],
    "design.sharpness": ["design.projection=heaviside", DENSE],
    "design.continuation": ["design.projection=heaviside", DENSE],
    "design.erosion": ["design.projection=robust", DENSE],
    "objective.exponent": ["objective.kind=deviation", "objective.gradient=exact"],
    "optimizer.max_iterations": ["optimizer.tolerance=1", "optimizer.kkt_tolerance=1e6"],
    "optimizer.exact_iterations": ["optimizer.tolerance=1", "optimizer.kkt_tolerance=1e6"],
    "objective.stress_exponent": ["objective.kind=stress"],
    "objective.effort_weights": ["objective.kind=effort", "constraints.deviation=1.0"],
    "objective.modes": ["objective.kind=eigenfrequency"],
    "objective.elbow_angle": ["objective.kind=eigenfrequency"],
    "constraints.tip_deflection": ["objective.kind=static"],
    "constraints.first_frequency": ["objective.kind=static"],
    "arms.mesh_size": ["arms.mesh=meshes/arm_bores.geo", "arms.passive=0.001"],
}
# Loads and weights have tests of their own; the smallest tolerances run for minutes.
NO_LIMITS = {
    "objective.loads",
    "scenarios.weight",
    "reduction.tolerance",
    "simulation.tolerance",
}


def limits():
    """Return key and TOML value at every limit of every number."""
    found = []
    for info in describe_keys():
        if info.key in NO_LIMITS:
            continue
        for sign, bound in re.findall(r"([<>]=?) (\S+)", info.allowed):
            value = float(bound)
            if "=" not in sign:  # just inside
                value = float(np.nextafter(value, np.inf if sign == ">" else -np.inf))
            text = f"{value:.0f}" if "integer" in info.allowed else repr(value)
            if "two" in info.allowed:
                text = f"[{text}, {text}]"
            elif info.allowed.startswith("an array"):
                text = f"[{text}]"
            found.append((info.key, text))
    return found


def run(overrides):
    """Evaluate a scene's initial design with its gradient and make one design step."""
    scene = load_scene(TWO_ARM, [*QUICK, *overrides])
    result = do.optimize(scene, world=MPI.COMM_SELF)
    assert np.isfinite(result.evaluation.objective)
    assert all(np.isfinite(x).all() for x in result.x_phys.values())


@pytest.mark.slow
@pytest.mark.parametrize(("key", "value"), limits(), ids=lambda part: str(part))
def test_a_number_at_its_limit_runs_or_is_refused_in_one_line(key, value):
    try:
        run([*USED.get(key, []), f"{key}={value}"])
    except (InputError, ConvergenceError) as error:
        assert len(str(error).splitlines()) == 1


@pytest.mark.parametrize("load", ["[1e9, 0.0, 0.0]", "[0.0, 1e-9, 0.0]", "[0.0, 0.0, -1e9]"])
def test_loads_at_their_limits(load):
    run(["objective.kind=static", f"objective.loads=[{load}]"])


@pytest.mark.parametrize("weight", [1e-9, 1e9])
def test_weights_at_their_limits(weight):
    scenario = f'[{{changes = ["payload.mass=4"], weight = {weight}}}]'
    run([f"scenarios={scenario}"])
