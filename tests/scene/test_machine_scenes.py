"""Control, closed loops and soft joints in a scene: what cannot be combined is refused in one line.

The message names file, key and value, and says what to do.
"""

import os
import re

import numpy as np
import pytest
from machines import GAINS, controlled, loop, loop_tree
from mpi4py import MPI
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.dynamics.build import build_system, check_forces, check_motion
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.scene.load import describe_keys, load_scene, scene_from_dict

pytestmark = pytest.mark.serial

ONE_GAIN = {"stiffness": [2e3], "damping": [20.0]}


def refusal(make) -> str:
    with pytest.raises(InputError) as caught:
        make()
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    return message


@pytest.mark.parametrize(
    ("change", "shown", "reason"),
    [
        ("control.stiffness=[1, 2]", "control.stiffness = [1, 2]", "3 numbers, for cart, arm1"),
        ("control.damping=[1]", "control.damping = [1]", "3 numbers, for cart, arm1, arm2"),
        ("control.limits=[1, 2]", "control.limits = [1, 2]", "3 numbers, for cart, arm1, arm2"),
        ("control.limits=[1, 2, 0]", "control.limits = [1, 2, 0]", "1e-09"),
        ("control.stiffness=[1, 2, -3]", "control.stiffness = [1, 2, -3]", ">= 0"),
        ("control.feed_forward=flexible", 'feed_forward = "flexible"', '"rigid" | "none"'),
        ("control.forces=nothing.csv", 'forces = "nothing.csv"', "the path of a file"),
        ("control.gain=3", "control.gain", "unknown key"),
        ("closure.kind=slider", 'motion.base = "cart"', '"fixed" with [closure]'),
    ],
)
def test_controlled_machines_that_cannot_be(change, shown, reason):
    message = refusal(lambda: controlled(change))
    assert str(TWO_ARM) in message and shown in message and reason in message


@pytest.mark.parametrize(
    ("kind", "tables", "shown", "reason"),
    [
        ("slider", {"control": {"stiffness": [1.0, 2.0], "damping": [1.0]}},
         "control.stiffness = [1.0, 2.0]", "expected 1 number, for crank"),
        ("pin", {"control": {"stiffness": [1.0], "damping": [1.0, 2.0]}},
         "control.damping = [1.0, 2.0]", "expected 1 number, for crank"),
        ("slider", {"simulation": {"integrator": "generalized-alpha"},
                    "objective": {"kind": "esl", "gradient": "esl"}},
         'simulation.integrator = "generalized-alpha"', '"radau" with [closure]'),
        ("slider", {"closure": {"kind": "pin"}}, 'closure.kind = "pin"', "at least 3 arms, found"),
        ("slider", {"closure": {"direction": [0.0, 0.0]}}, "closure.direction = [0.0, 0.0]",
         "other than zero"),
        ("slider", {"closure": {"side": 0}}, "closure.side = 0", "-1 | 1"),
        ("pin", {"closure": {"force": 3.0}}, "closure.force = 3.0", '0.0, the default, with'),
        ("pin", {"closure": {"direction": [0.0, 1.0]}}, "closure.direction = [0.0, 1.0]",
         "the default, with closure.kind"),
        ("slider", {"motion": {"path": "arc"}}, "motion.", "expected"),
        ("pin", {"objective": {"kind": "deviation"}}, 'objective.kind = "deviation"',
         'another response with closure.kind = "pin"'),
    ],
)  # fmt: skip
def test_loops_that_cannot_be(kind, tables, shown, reason):
    message = refusal(lambda: loop(kind, **tables))
    assert shown in message and reason in message


def test_spring_at_a_joint_without_a_drive_is_refused():
    data = loop_tree()
    data["arms"][1] |= {"joint_stiffness": 10.0}
    message = refusal(lambda: scene_from_dict(data))
    assert "arms.1.joint_stiffness (rod) = 10.0" in message and "has no drive" in message


@pytest.mark.parametrize(
    ("kind", "closure", "reason"),
    [
        ("slider", {"point": [0.0, 1.0]}, "at t = 0 s the last arm is across the line"),
        ("slider", {"point": [0.0, 0.25]}, "s the last arm is across the line"),
        ("pin", {"point": [1.25, 0.0]}, "the last two arms are stretched, folded or too short"),
    ],
)
def test_loops_that_cannot_be_assembled_name_the_instant(kind, closure, reason):
    message = refusal(lambda: check_motion(loop(kind, closure=closure)))
    assert re.search(r"closure: at t = [0-9.e-]+ s", message)
    assert reason in message and "change the arms' lengths, closure.point" in message


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("t,cart,arm1\n0,0,0\n1,1,1\n", "missing column 'arm2'"),
        ("cart,arm1,arm2\n0,0,0\n1,1,1\n", "column t"),
        ("t,cart,arm1,arm2\n0,0,0,0\n1,1,one,1\n", "line 3"),
        ("t,cart,arm1,arm2\n1,0,0,0\n2,1,1,1\n", "line 2, column t = 1: expected 0"),
        ("", "drive.csv"),
    ],
)
def test_tables_of_forces_that_cannot_be_read(tmp_path, text, reason):
    file = tmp_path / "drive.csv"
    file.write_text(text)
    scene = controlled(f"control.forces={file}")
    message = refusal(lambda: check_forces(scene))
    assert str(file) in message and reason in message


def test_a_table_of_forces_adds_to_the_drives_until_it_ends(tmp_path):
    file = tmp_path / "drive.csv"
    file.write_text("t,arm2,arm1,cart\n0,1,2,3\n0.5,3,2,1\n1.25,3,2,1\n")
    plain, more = (
        build_system(scene, bodies_of(scene))
        for scene in (controlled(), controlled(f"control.forces={file}"))
    )
    t = np.array([0.0, 0.25, 1.25, 1.2500001])
    added = more.at(t).ahead - plain.at(t).ahead
    np.testing.assert_allclose(added, [[3, 2, 1], [2, 2, 2], [1, 2, 3], [0, 0, 0]], atol=1e-9)
    assert set(more.breakpoints) - set(plain.breakpoints) == {0.5, 1.25}
    file.write_text("t,arm2,arm1,cart\n0,1,2,3\n0.5,3,2,1\n")
    os.utime(file, ns=(1, 1))  # an older clock, as after a copy
    scene = controlled(f"control.forces={file}")
    assert 1.25 not in build_system(scene, bodies_of(scene)).breakpoints


def bodies_of(scene):
    partition = do.partition_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = do.build_arms(scene, partition, do.Profile())
    return [arm.reduce(arm.uniform(0.5)) for arm in arms.values()]


# -- limits of the keys ----------------------------------------------------------------------

MACHINE_KEYS = ("control.", "closure.", "arms.joint", "arms.rotor", "arms.gear", "motion.speed")
MACHINE_KEYS += ("motion.start_angle", "motion.cart_mass")


def limits() -> list[tuple[str, float]]:
    """Return key and TOML values at every limit of every number of a machine."""
    found = []
    for info in describe_keys():
        if info.key.startswith(MACHINE_KEYS):
            for sign, bound in re.findall(r"([<>]=?) (\S+)", info.allowed):
                value = float(bound)
                if "=" not in sign:
                    value = float(np.nextafter(value, np.inf if sign == ">" else -np.inf))
                found.append((info.key, value))
    return found


def tree_at(key: str, value: float):
    """Return a scene that uses the key, with it."""
    table, _, name = key.partition(".")
    quick = {"motion": {"speed": 20.0}, "simulation": {"sample": 5e-3, "tolerance": 1e-2}}
    data = loop_tree(**quick, reduction={"coordinates": 3})
    if table == "arms":
        data["arms"][0][name] = value
        data["arms"][1] |= {"joint_stiffness": 0.0, "joint_damping": 0.0}
        if name == "joint_damping" and value > 0.0:
            data["arms"][0]["joint_stiffness"] = 1e3
    elif table == "control":
        data["control"] = ONE_GAIN | {name: [value]}
    elif name in ("point", "direction"):
        data["closure"][name] = [value, value]
    elif name == "cart_mass":
        base = load_scene(TWO_ARM, ["arms.cells=[8,2]", "simulation.tolerance=0.01"]).to_tree()
        data = base | {"control": GAINS, "motion": base["motion"] | {name: value}}
    else:
        data[table][name] = value
    return data


@pytest.mark.slow
@pytest.mark.parametrize(("key", "value"), limits(), ids=str)
def test_a_number_of_a_machine_at_its_limit_runs_or_is_refused_in_one_line(key, value):
    try:
        scene = scene_from_dict(tree_at(key, value))
        check_motion(scene)
        partition, profile = do.partition_arms(MPI.COMM_SELF, scene.cell_counts), do.Profile()
        arms = do.build_arms(scene, partition, profile)
        x = {k: arm.uniform(0.5) for k, arm in arms.items()}
        evaluation, trajectory = do.evaluate(scene, partition, arms, x, profile)
        assert np.isfinite(evaluation.objective)
        assert np.isfinite(trajectory.joint_forces).all()
    except (InputError, ConvergenceError) as error:
        assert len(str(error).splitlines()) == 1


def test_scenarios_change_gains_and_closures():
    changes = [{"changes": ["control.stiffness=[1e3]"]}, {"changes": ["closure.force=10.0"]}]
    scene = scene_from_dict(loop_tree(control=ONE_GAIN) | {"scenarios": changes})
    assert len(scene.scenarios) == 2
    wrong = [{"changes": ["control.stiffness=[1e3, 1.0]"]}]
    refused = loop_tree(control=ONE_GAIN) | {"scenarios": wrong}
    assert "1 number, for crank" in refusal(lambda: scene_from_dict(refused))
