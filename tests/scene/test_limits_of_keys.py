"""Every number of a scene at the limits of its range: it runs, or one line says why not."""

import re

import numpy as np
import pytest
from machines import GAINS, loop_tree
from mpi4py import MPI
from remainders import built_of
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.dynamics.build import check_motion
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.scene.load import read_scene, scene_from_dict
from dolfinopt.scene.messages import describe_keys

pytestmark = pytest.mark.serial  # a hundred small runs

# Slow, small and roughly solved: the arithmetic is tried, not the machine.
QUICK = ["arms.cells=[12,2]", "motion.duration=4", "motion.horizon=4", "simulation.sample=0.05"]
QUICK += ["objective.load_cases=5", "optimizer.max_iterations=1", "simulation.tolerance=0.01"]
DENSE = "design.initial=0.6"  # cut at one half, a uniform design of one half is nothing
# What a key needs to be used at all.
USED = {
    "reduction.frequencies": ["reduction.method=krylov"],
    "motion.start": ["motion.path=line"],
    "motion.end": ["motion.path=line"],
    # With stiffening they are refused after a long search, as payload.mass is.
    "arms.joint_inertia": ["simulation.stiffening=false", "reduction.coordinates=3"],
    "payload.inertia": ["simulation.stiffening=false", "reduction.coordinates=3"],
    "motion.horizon": ["motion.duration=1e5", "simulation.sample=1e3"],
    "motion.gravity": ["motion.duration=2", "motion.horizon=2"],
    "design.sharpness": ["design.projection=heaviside", DENSE],
    "design.continuation": ["design.projection=heaviside", DENSE],
    "design.erosion": ["design.projection=robust", DENSE],
    "objective.exponent": ["objective.kind=deviation", "objective.gradient=exact"],
    "optimizer.max_iterations": ["optimizer.tolerance=1", "optimizer.kkt_tolerance=1e6"],
    "objective.stress_exponent": ["objective.kind=stress"],
    "objective.effort_weights": ["objective.kind=effort", "constraints.deviation=1.0"],
    "objective.modes": ["objective.kind=eigenfrequency"],
    "objective.elbow_angle": ["objective.kind=eigenfrequency"],
    "constraints.tip_deflection": ["objective.kind=static"],
    "constraints.first_frequency": ["objective.kind=static"],
    "arms.mesh_size": ["arms.mesh=meshes/arm_bores.geo", "arms.passive=0.001"],
}
# Loads and weights have tests of their own; the smallest tolerances run for minutes.
NO_LIMITS = {"objective.loads", "scenarios.weight", "simulation.tolerance"}


MACHINE_KEYS = (
    "control.",
    "closures.point",
    "closures.axis",
    "arms.joint",
    "arms.rotor",
    "arms.gear",
    "motion.speed",
)
MACHINE_KEYS += ("motion.cart_mass",)


def limits(keys=()):
    """Return key, value and allowed words at every limit of every number."""
    for info in describe_keys():
        if info.key.startswith(keys) if keys else info.key not in NO_LIMITS:
            for sign, bound in re.findall(r"([<>]=?) (\S+)", info.allowed):
                value = float(bound)
                if "=" not in sign:  # just inside
                    value = float(np.nextafter(value, np.inf if sign == ">" else -np.inf))
                yield info.key, value, info.allowed


def toml(value, allowed):
    text = f"{value:.0f}" if "integer" in allowed else repr(value)
    if "two" in allowed:
        return f"[{text}, {text}]"
    return f"[{text}]" if allowed.startswith("an array") else text


def tree_at(key, value):
    """Return a machine that uses the key, with it."""
    table, _, name = key.partition(".")
    quick = {"motion": {"speed": 20.0}, "simulation": {"sample": 5e-3, "tolerance": 1e-2}}
    data = loop_tree(**quick, reduction={"coordinates": 3})
    if table == "arms":
        if name == "joint_inertia":  # at 20 rad/s a march of 1 430 steps, until it is refused
            data["motion"]["speed"] = 1.0
        data["arms"][0][name] = value
        data["arms"][1] |= {"gear_stiffness": 0.0, "gear_damping": 0.0}
        if name == "gear_damping" and value > 0.0:
            data["arms"][0]["gear_stiffness"] = 1e3
    elif table == "control":
        data["control"] = {"stiffness": [2e3], "damping": [20.0], name: [value]}
    elif table == "closures":
        data["closure"][{"axis": "direction"}.get(name, name)] = [value, value]
    elif name == "cart_mass":
        base = read_scene(TWO_ARM, ["arms.cells=[8,2]", "simulation.tolerance=0.01"]).to_tree()
        data = base | {"control": GAINS, "motion": base["motion"] | {name: value}}
    else:
        data[table][name] = value
    return data


def run(overrides):
    """Evaluate a scene's initial design with its gradient and make one design step."""
    scene = read_scene(TWO_ARM, [*QUICK, *overrides])
    result = do.optimize(scene, world=MPI.COMM_SELF)
    assert np.isfinite(result.evaluation.objective)
    assert all(np.isfinite(x).all() for x in result.x_phys.values())


def run_machine(scene):
    """Evaluate a machine's initial design."""
    check_motion(scene)
    built = built_of(scene, MPI.COMM_SELF)
    evaluation, trajectory = built.evaluate(built.uniform())
    assert np.isfinite(evaluation.objective)
    assert np.isfinite(trajectory.joint_forces).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("machine", "key", "value", "allowed"),
    [(bool(keys), *case) for keys in ((), MACHINE_KEYS) for case in limits(keys)],
    ids=str,
)
def test_a_number_at_its_limit_runs_or_is_refused_in_one_line(machine, key, value, allowed):
    try:
        if machine:
            run_machine(scene_from_dict(tree_at(key, value)))
        else:
            run([*USED.get(key, []), f"{key}={toml(value, allowed)}"])
    except (InputError, ConvergenceError) as error:
        assert "\n" not in str(error)


def test_loads_and_weights_at_their_limits():
    for load in ("[1e9, 0.0, 0.0]", "[0.0, 1e-9, 0.0]", "[0.0, 0.0, -1e9]"):
        run(["objective.kind=static", f"objective.loads=[{load}]"])
    for weight in (1e-9, 1e9):
        run([f'scenarios=[{{changes = ["payload.mass=4"], weight = {weight}}}]'])


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_least_duration_of_an_arc_that_follows_the_arms(scale):
    """The radius that is not stated is half of the arms' length, and the path pi times that."""
    scene = scene_from_dict({
        "material": {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2700.0},
        "arms": [
            {"name": "arm1", "length": scale, "height": 0.06, "thickness": 0.01},
            {"name": "arm2"},
        ],
        "motion": {"path": "arc", "max_speed": 2.0},
        "payload": {"mass": 6.0},
    })  # fmt: skip
    # The quintic's largest speed is 15/8 of the mean.
    assert scene.motion.duration == pytest.approx(15.0 / 8.0 * np.pi * scale / 2.0, rel=1e-6)
