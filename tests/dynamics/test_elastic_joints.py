"""Bearings, gears, motors and friction in joints: against another program, energy, limits."""

import numpy as np
import pytest
from machines import (
    check_energy,
    fork,
    machine,
    reference,
    simulated,
    small_two_arm,
    two_arm,
    with_keys,
)
from mpi4py import MPI
from remainders import built_of

from dolfinopt.dynamics.build import build_system
from dolfinopt.responses.response import bodies_in
from dolfinopt.scene.load import scene_from_dict

pytestmark = pytest.mark.serial  # the trajectory belongs to one rank

EARTH = {"gravity": [0.0, -9.81]}
# The program's rotors do not turn with what carries them: so do those of a very large ratio.
GEARS = [
    {"gear_stiffness": 2e4, "gear_damping": 10.0, "gear_ratio": 1e5, "rotor_inertia": 2e-11,
     "friction": [3.0, 4.0]},
    {"gear_stiffness": 1e4, "gear_damping": 5.0, "gear_ratio": 1e5, "rotor_inertia": 1e-11,
     "friction": [2.0, 3.0]},
]  # fmt: skip
SPRINGS = {
    "plane": [[2e6, 3e6, 0.0, 0.0, 0.0, 3e4], [1e6, 2e6, 0.0, 0.0, 0.0, 2e4]],
    "space": [[2e6, 3e6, 4e6, 3e4, 4e4, 0.0], [1e6, 2e6, 3e6, 1e4, 8e4, 2e4]],
}


def robot(kind, folder):
    """Return the two links of `benchmarks/reference`, their motors alone controlled."""
    parts = [
        gear | {"bearing_stiffness": k, "bearing_damping": [1e-4 * x for x in k]}
        for gear, k in zip(GEARS, SPRINGS[kind], strict=True)
    ]
    bar, file = {"height": 0.05, "thickness": 0.04}, folder / "table.csv"
    upper = {"name": "upper", "rigid": True, "length": 0.5, "mass": 3.0, **bar}
    fore = {"name": "fore", "length": 0.4, "passive": 0.0, **bar}
    tree = {
        "name": kind,
        "material": {"young_modulus": 7e14, "poisson_ratio": 0.33, "density": 2700.0},
        "payload": {"mass": 2.0},
        "control": {"stiffness": [4e4, 2e4], "damping": [800.0, 300.0], "feed_forward": "none"},
        "simulation": {"tolerance": 1e-5, "sample": 0.01, "stiffening": False},
        "design": {"initial": 1.0},
        "damping": {"stiffness_proportional": 1e-6},
        "objective": {"kind": "deviation"},
        "motion": {"path": "joints", "file": str(file), "horizon": 0.6},
    }
    if kind == "plane":
        file.write_text("t,upper,fore\n0,0.4,-0.9\n0.4,1.3,-0.2\n")
        arms = [upper | {"inertia": 0.08} | parts[0], fore | {"cells": [8, 2]} | parts[1]]
        base = {"base": "fixed", "joint_height": 0.0, **EARTH}
        return with_keys(tree, {"arms": arms, "reduction": {"coordinates": 3}, "motion": base})
    file.write_text("t,yaw,elbow\n0,0,0.3\n0.4,1.2,-0.6\n")
    yaw = {"name": "yaw", "parent": "ground", "child": "upper", "axis": [0, 0, 1]}
    elbow = {"name": "elbow", "parent": "upper", "child": "fore", "axis": [0, 1, 0]}
    return with_keys(tree, {
        "arms": [upper | {"inertia": [0.01, 0.08, 0.08, 0, 0, 0]}, fore | {"cells": [8, 2, 2]}],
        "joints": [one | {"type": "revolute"} | own
                   for one, own in zip((yaw, elbow), parts, strict=True)],
        "reduction": {"coordinates": 6},
        "motion": {"gravity": [0, 0, -9.81]},
    })  # fmt: skip


@pytest.mark.parametrize(("kind", "most"), [("plane", 5e-6), ("space", 4e-4)])
def test_elastic_joints_of_another_program(kind, most, tmp_path):
    """Exudyn's kinematic trees, see `reference/README.md`."""
    expected, found = reference(f"elastic_joints_{kind}"), machine(simulated(robot(kind, tmp_path)))
    trajectory = found[0]
    assert np.allclose(trajectory.t, expected["t"])
    axes = "xyz"[: trajectory.mechanism.dim.d]
    path = np.stack([expected[f"dev_{axis}"] for axis in axes], axis=1)
    size = np.linalg.norm(path, axis=1).max()
    off = np.linalg.norm(trajectory.deviation - path, axis=1).max()
    assert off < most * size  # measured 1.0e-6, 1.8e-4
    assert trajectory.motors is not None
    angles = np.column_stack([trajectory.q_r[:, -2:], trajectory.motors])
    wanted = np.column_stack([expected[key] for key in ("q_1", "q_2", "motor_1", "motor_2")])
    away = np.abs(wanted[:, :2] - trajectory.desired.q[:, -2:]).max()
    assert np.abs(angles - wanted).max() < most * away  # 1e-6, 9e-5


def small(joints, **changes):
    """Return the controlled machine under gravity."""
    return small_two_arm(joints, **{"motion": EARTH, **changes})


def forked(tmp_path, parts, **changes):
    """Return the fork in space with parts of its two joints that move, one of them prismatic."""
    (tmp_path / "table.csv").write_text("t,swing,slide\n0,0,0\n0.2,1,0.1\n")
    tree = fork() | {"name": "fork"}
    tree["motion"]["file"] = str(tmp_path / "table.csv")
    for joint in tree["joints"]:
        if joint["type"] != "fixed":
            joint |= parts
    return with_keys(tree, {"simulation": {"tolerance": 1e-5}, **changes})


PLANE = {
    "bearing_stiffness": [1e6, 2e6, 0.0, 0.0, 0.0, 5e4],
    "bearing_damping": [10.0] * 2 + [0.0] * 4,
}
SPACE = {"bearing_stiffness": [1e6, 2e6, 3e6, 3e4, 4e4, 5e4], "bearing_damping": [10.0] * 6}
ELASTIC = {"feed_forward": "elastic"}
HELD = {"stiffness": [2e4, 2e5], "damping": [600.0, 6e3]}
SCENES = {
    "bearings": lambda _: small(PLANE) | {"control": None},
    "gears": lambda _: small(PLANE | GEARS[0]) | {"control": None},
    "controlled": lambda _: small(PLANE | GEARS[0], control=ELASTIC),
    "rigid gears": lambda _: small({"friction": [5.0, 10.0], "friction_speed": 0.1}),
    "bearings in space": lambda path: forked(path, SPACE),
    "gears in space": lambda path: forked(path, SPACE | GEARS[0]),
    "controlled in space": lambda path: forked(path, GEARS[1] | SPACE, control=ELASTIC | HELD),
}


@pytest.mark.parametrize("kind", SCENES)
def test_work_is_energy(kind, tmp_path):
    """Drive work = kinetic + strain + potential energy + what dampers and friction took."""
    check_energy(simulated(SCENES[kind](tmp_path)), 1e-7)  # measured 3e-10 at most


def test_inf_is_rigid_as_zero_is():
    """JSON does not know it: scenes keep 0."""
    given = scene_from_dict(small({"bearing_stiffness": [1e6, np.inf, np.inf, 0.0, 0.0, 5e4]}))
    assert given.arms[0].bearing_stiffness == (1e6, 0.0, 0.0, 0.0, 0.0, 5e4)


def test_friction_of_prescribed_joints_is_the_drives():
    """The motion keeps its bits; forces grow by f_v v + f_c tanh(v / v_s)."""
    free, rubbed = (
        simulated(small(parts) | {"control": None}).trajectory
        for parts in ({}, {"friction": [5.0, 10.0], "friction_speed": 0.1})
    )
    np.testing.assert_array_equal(free.deviation, rubbed.deviation)
    v = free.desired.qd[:, 1:]
    expected = 5.0 * v + 10.0 * np.tanh(v / 0.1)
    change = (rubbed.joint_forces - free.joint_forces)[:, 1:]
    size = np.abs(free.joint_forces).max()
    np.testing.assert_allclose(change, expected, rtol=0, atol=1e-12 * size)


def test_bearings_stand_in_files(tmp_path):
    """Their coordinates have columns and units of their own; compliance is the arms'."""
    from dolfinopt.output.trajectory import trajectory_units, write_trajectory

    trajectory = simulated(robot("space", tmp_path)).trajectory
    units = trajectory_units(trajectory)
    own = {key: unit for key, unit in units.items() if key.startswith("q_bearing")}
    assert own == {
        **{f"q_bearing_yaw_{key}": "m" for key in "xyz"},
        **{f"q_bearing_yaw_{key}": "rad" for key in ("rx", "ry")},
        **{f"q_bearing_elbow_{key}": "m" for key in "xyz"},
        **{f"q_bearing_elbow_{key}": "rad" for key in ("rx", "ry", "rz")},
    }
    write_trajectory(tmp_path, trajectory)
    table = np.genfromtxt(tmp_path / "trajectory.csv", delimiter=",", names=True)
    assert list(table.dtype.names) == list(units)
    found = np.load(tmp_path / "trajectory.npz")
    # At rest under gravity the first bearing bears the weight of both links and the payload.
    mass = sum(body.mass for body in trajectory.mechanism.arms) + 2.0
    assert found["q_e"][0, 6 + 2] == pytest.approx(-9.81 * mass / 4e6, rel=1e-4)
    assert found["compliance"].shape[1] == 2


def frequencies(tree, elbow, folder):
    """Return the frequencies of two links at rest, the second turned by `elbow` degrees, Hz."""
    angle, file = np.deg2rad(elbow), folder / "still.csv"
    file.write_text(f"t,upper,fore\n0,0,{angle}\n0.2,0,{angle}\n")
    tree |= {"design": {"initial": 1.0}, "motion": {
        "path": "joints", "file": str(file), "base": "fixed", "joint_height": 0.0,
        "duration": 0.2, "horizon": 0.2}}  # fmt: skip
    scene = scene_from_dict(tree)
    built = built_of(scene, MPI.COMM_SELF)
    owned = {k: arm.reduce(arm.uniform(1.0)) for k, arm in built.arms.items()}
    system = build_system(scene, bodies_in(scene, scene, owned))
    rest = np.zeros((1, system.num_coordinates))
    K, _, M = np.split(system.at(np.zeros(1)).linearise(rest, rest, rest).dense()[0], 3, axis=1)
    return np.sort(np.sqrt(1.0 / np.linalg.eigvals(np.linalg.solve(K, M)).real)) / (2.0 * np.pi)


# The lowest three frequencies of two clamped links with lumped masses at elbow and tip, as
# Timoshenko beams, Hz; by L1/h and the elbow's angle. Source: doi:10.1155/2011/890258.
TWO_LINKS = {
    (33.33, 0.0): (10.929, 63.334, 190.43),
    (33.33, 45.0): (11.673, 51.653, 185.95),
    (33.33, 90.0): (14.360, 38.309, 184.94),
    (8.333, 0.0): (46.417, 277.52, 773.81),
    (8.333, 45.0): (49.661, 221.88, 753.86),
    (8.333, 90.0): (61.550, 162.32, 751.29),
}


@pytest.mark.parametrize(("slenderness", "elbow"), TWO_LINKS)
def test_frequencies_of_two_links_with_lumped_masses(slenderness, elbow, tmp_path):
    """Against published ones, with the masses and sections that belong to them."""
    # Those are known from its Euler-Bernoulli columns, seven numbers by least squares from 96
    # frequencies, which a frame of beams then meets to 2e-4.
    height = 0.5 / slenderness
    bar = {"thickness": 0.025, "passive": 0.0, "element": "quadratic"}
    cells = [40, 4]
    tree = two_arm("reduction.coordinates=10") | {
        "material": {"young_modulus": 2.12217e11, "poisson_ratio": 0.3, "density": 7850.0},
        "payload": {"mass": 0.110625, "inertia": 6.46838e-5},
        "arms": [
            {"name": "upper", "length": 0.5, "height": 1.016426 * height, "cells": cells,
             "joint_mass": 0.301512, "joint_inertia": 7.38959e-4, **bar},
            {"name": "fore", "length": 0.540456, "height": height, "cells": cells,
             "joint_mass": 0.0, "joint_inertia": 0.0, **bar},
        ],
    }  # fmt: skip
    expected = TWO_LINKS[slenderness, elbow]
    found = frequencies(tree, elbow, tmp_path)[:3]
    # Measured 3e-4 to 1.1e-3 of slender links, 1.1e-3 to 2.2e-3 of stubby ones: sections that the
    # interfaces keep plane, and what the seven numbers leave.
    np.testing.assert_allclose(found, expected, rtol=3e-3)
