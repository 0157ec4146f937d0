"""Scenes of machines in space: [[joints]], rigid arms with their inertia, and what is refused."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from dolfinopt.errors import InputError
from dolfinopt.multibody.motion import check_motion
from dolfinopt.multibody.spatial.mechanism import build_spatial_mechanism, rigid_link
from dolfinopt.scene.load import load_scene, scene_from_dict

pytestmark = pytest.mark.serial

TABLE = "t,yaw,lift\n0,0,0\n0.5,1.2,0.1\n"
# A column that turns, and a slide on it: rigid, so that nothing is meshed.
ROBOT = {
    "name": "column and slide",
    "material": {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2700.0},
    "arms": [
        {"name": "column", "rigid": True, "length": 0.0, "mass": 1.0,
         "inertia": [0.2, 0.2, 0.1, 0.0, 0.01, 0.0], "centre": [0.0, 0.1, 0.3]},
        {"name": "slide", "rigid": True, "length": 0.4, "height": 0.02, "thickness": 0.01},
    ],
    "joints": [
        {"name": "yaw", "type": "revolute", "parent": "ground", "child": "column",
         "axis": [0, 0, 2]},
        {"name": "lift", "type": "prismatic", "parent": "column", "child": "slide",
         "axis": [0, 0, 1], "origin": [0.1, 0, 0.5], "rpy": [0.1, 0, 0]},
    ],
    "motion": {"path": "joints", "file": "table.csv", "gravity": [0, 0, -9.81]},
    "payload": {"mass": 2.0, "inertia": [0.1, 0.1, 0.1, 0, 0, 0], "offset": [0.05, 0, 0]},
}  # fmt: skip


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    (folder / "table.csv").write_text(TABLE)
    return str(folder / "robot.toml")


# Beside a link that is designed: a scene has at least one.
TOOL = {"name": "tool", "length": 0.3, "height": 0.02, "thickness": 0.01, "cells": [6, 2, 2]}
WRIST = {"name": "wrist", "type": "fixed", "parent": "slide", "child": "tool"}


def with_tool():
    """Return the robot with a flexible tool on a fixed joint."""
    data = copy.deepcopy(ROBOT)
    data["arms"].append(TOOL)
    data["joints"].append(WRIST)
    data["reduction"] = {"coordinates": 6}
    return data


def with_change(path, value):
    """Return the robot with another value at a path; None takes the key away."""
    data = copy.deepcopy(ROBOT)
    node = data
    for part in path[:-1]:
        node = node[part] if isinstance(part, int) else node.setdefault(part, {})
    if value is None:
        del node[path[-1]]
    else:
        node[path[-1]] = value
    return data


def test_machine_of_a_scene(source):
    scene = scene_from_dict(with_tool(), source)
    assert scene.is_spatial and scene.driven == ("yaw", "lift")
    assert scene.motion.duration == 0.5
    assert scene.arms[0].height == scene.arms[0].thickness == 0.01
    bodies = [rigid_link(arm, 2700.0) for arm in scene.arms]  # of the tool, too
    mass = 2700.0 * 0.4 * 0.02 * 0.01
    assert bodies[1].mass == pytest.approx(mass)
    # int x^2 of a bar about its end; the column's about its origin, by Huygens and Steiner.
    assert bodies[1].W[0, 0, 0] == pytest.approx(mass * 0.4**2 / 3.0)
    assert bodies[0].W[8, 0, 0] == pytest.approx(0.15 + 0.3**2)
    assert bodies[0].W[2, 0, 0] == pytest.approx(-0.01)
    machine = build_spatial_mechanism(scene, bodies)
    assert np.array_equal(machine.joints[0].axis, [0, 0, 1])
    assert (machine.joints[1].parent, machine.joints[1].coordinate) == (0, 1)
    assert (machine.joints[2].parent, machine.joints[2].coordinate) == (1, None)
    assert machine.carried[:2] == (None, None)
    assert machine.carried[2].w[0, 0] == pytest.approx(0.1)
    assert machine.end == 2


def test_joints_in_any_order(source):
    """The tree is that of the joints, whatever the order of the tables."""
    data = with_tool()
    data["joints"].reverse()
    scene = scene_from_dict(data, source)
    machine = build_spatial_mechanism(scene, [rigid_link(arm, 2700.0) for arm in scene.arms])
    assert scene.driven == ("lift", "yaw")
    assert machine.tree.order == (0, 1, 2) and machine.tree.movable == (1, 0)


ARM = {"name": "link", "length": 0.4, "height": 0.02, "thickness": 0.01, "cells": [8, 2]}
REFUSED = [
    (("joints", 0, "parent"), "tower", 'joints.0.parent (yaw) = "tower": expected the ground or'),
    (("joints", 1, "child"), "tool", 'joints.1.child (lift) = "tool": expected the name of an arm'),
    (("joints", 0, "parent"), "slide", "expected a tree that stands on the ground"),
    (("joints", 1, "child"), "column", "expected an arm that no other joint holds"),
    (("joints", 1, "name"), "yaw", "expected a name that no other joint has"),
    (("joints", 1, "name"), "t", 'a column "t" means the time'),
    (("joints", 1, "axis"), [0, 0, 0], "expected a direction, not of length zero"),
    (("joints", 1, "axis"), None, "expected an array of three numbers with a prismatic joint"),
    (("joints", 1, "type"), "fixed", "expected none with a fixed joint"),
    (("joints", 1, "type"), "ball", 'expected "revolute" | "prismatic" | "fixed"'),
    (("joints", 1, "position_limits"), [0.2, 0.1], "expected the least first, then the largest"),
    (("joints", 0, "effort_limit"), 0.0, "joints.0.effort_limit (yaw) = 0.0: expected a number"),
    (("joints", 0), {"name": "yaw", "type": "fixed", "parent": "ground", "child": "column",
                     "velocity_limit": 1.0}, "expected none with a fixed joint"),
    (("arms", 1, "interface_offset"), 0.1, "expected only with mesh"),
    (("arms", 0, "inertia"), [0.2, -0.1, 0.1, 0, 0, 0], "none can be negative"),
    (("arms", 0, "inertia"), [0.5, 0.2, 0.1, 0, 0, 0], "none can exceed the sum of the two others"),
    (("payload", "inertia"), [0.5, 0.2, 0.1, 0, 0, 0], "payload.inertia = "),
    (("arms", 1), ARM, "arms.1.cells (link) = [8, 2]: expected three integers"),
    (("arms", 1, "joint_stiffness"), 1e4, "expected 0 with [[joints]]"),
    (("motion", "path"), "arc", 'motion.path = "arc": expected "joints" | "points" | "line"'),
    (("motion",), {"path": "line"}, "[-1.0, 0.0] (default): expected an array of three"),
    (("motion", "initial_joints"), [0.1], "motion.initial_joints"),
    (("motion", "gravity"), [0, -9.81], "expected an array of three numbers with [[joints]]"),
    (("motion", "joint_height"), 0.3, "expected -0.5, the default, with [[joints]]"),
    (("motion", "cart_mass"), 2.0, "expected 0.0, the default, with [[joints]]"),
    (("objective",), {"kind": "static", "loads": [[0, 1, 2]]}, "expected arrays of six numbers"),
    (("objective",), {"kind": "eigenfrequency", "elbow_angle": 0.1}, "pose at the middle"),
    (("closure",), {"kind": "pin"}, "expected no [closure] with [[joints]]"),
    (("control",), {"stiffness": [1], "damping": [1, 1]}, "expected 2 numbers, for yaw, lift"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value", "text"), REFUSED)
def test_refusals(source, path, value, text):
    data = with_change(path, value)
    if path == ("motion", "path"):
        del data["motion"]["file"]
    if path == ("arms", 1):
        data["joints"][1]["child"] = "link"
    with pytest.raises(InputError) as caught:
        scene_from_dict(data, source)
    message = str(caught.value)
    assert text in message and len(message.splitlines()) == 1


# A frame with an interface on its side, on which a tool hangs; the payload is on the frame's end.
SIDE = {"name": "side", "point": [0.2, 0.01, 0.0]}


def with_fork():
    """Return the robot whose slide carries the tool at its side and the payload at its end."""
    data = with_tool()
    data["arms"][1]["interfaces"] = [dict(SIDE)]
    data["joints"][2]["parent_interface"] = "side"
    data["payload"]["arm"] = "slide"
    return data


def test_interfaces_of_a_scene(source):
    """Where joints and payload sit; the end-effector is the arm with the payload."""
    scene = scene_from_dict(with_fork(), source)
    assert scene.end_effector == (1, 0) and scene.used_interfaces == {(0, 0), (1, 0), (1, 1)}
    machine = build_spatial_mechanism(scene, [rigid_link(arm, 2700.0) for arm in scene.arms])
    assert (machine.joints[2].parent, machine.joints[2].interface) == (1, 1)
    assert np.array_equal(machine.bodies[1].points, [[0.4, 0, 0], [0.2, 0.01, 0]])
    assert machine.tree.sites == ((0,), (0, 1), ()) and set(machine.tree.loads) == {(1, 0)}
    assert machine.chain == (0, 1)
    data = with_fork()  # the payload at the side, beside the tool
    data["payload"]["interface"] = "Side"
    scene = scene_from_dict(data, source)
    machine = build_spatial_mechanism(scene, [rigid_link(arm, 2700.0) for arm in scene.arms])
    assert (machine.end, machine.end_interface) == (1, 1) and set(machine.tree.loads) == {(1, 1)}
    data["arms"][2]["interfaces"] = [{**SIDE, "name": "a", "radius": 0.01}]
    data["payload"] = {"mass": 2.0, "arm": "tool", "interface": "a"}
    data["reduction"]["coordinates"] = 12
    assert scene_from_dict(data, source).arms[2].num_outboard == 12


FORKS = [
    (("joints", 2, "parent_interface"), "top", 'joints.2.parent_interface (wrist) = "top": '
     'expected the name of an interface of slide: "outboard" | "side"'),
    (("joints", 0, "parent_interface"), "side", "expected none on the ground"),
    (("joints", 2, "parent_interface"), "outboard", "nothing sits on it"),
    (("payload", "interface"), "top", 'payload.interface = "top": expected the name of an'),
    (("payload", "arm"), "hand", 'payload.arm = "hand": expected the name of an arm'),
    (("arms", 1, "interfaces", 0, "name"), "Outboard", "are the arm's ends"),
    (("arms", 1, "interfaces", 0, "radius"), 0.1, "expected none with a rigid arm"),
    (("arms", 1, "interfaces"), [SIDE, SIDE], "expected a name that no other interface"),
    (("arms", 2, "interfaces"), [SIDE], "expected a number > 0 [m] with an arm made of cells"),
    (("arms", 2, "interfaces"), [{**SIDE, "radius": 0.01}], "nothing sits on it"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value", "text"), FORKS)
def test_refused_interfaces(source, path, value, text):
    data = with_fork()
    data["reduction"]["coordinates"] = 12
    node = data
    for part in path[:-1]:
        node = node[part]
    node[path[-1]] = value
    with pytest.raises(InputError) as caught:
        scene_from_dict(data, source)
    message = str(caught.value)
    assert text in message and len(message.splitlines()) == 1


def test_coordinates_of_several_interfaces(source):
    """Six of each; an arm that shares the design has the interfaces, too."""
    data = with_fork()
    data["arms"][2]["interfaces"] = [{**SIDE, "radius": 0.01}]
    data["payload"] = {"mass": 2.0, "arm": "tool", "interface": "side"}
    twin = copy.deepcopy(data)
    twin["arms"].append({"name": "twin", "design": "tool"})
    twin["joints"].append({**WRIST, "name": "second", "parent": "tool", "child": "twin"})
    twin["reduction"]["coordinates"] = 12
    arms = scene_from_dict(twin, source).arms
    assert arms[3].interfaces == arms[2].interfaces != ()
    with pytest.raises(InputError, match=r"expected an integer >= 12 .* interfaces, 2, have six"):
        scene_from_dict(data, source)


def test_a_table_of_one_row(source, tmp_path):
    """The table is told, not the duration that would follow from it."""
    (tmp_path / "one.csv").write_text("t,yaw,lift\n0,0,0\n")
    data = copy.deepcopy(ROBOT) | {"motion": ROBOT["motion"] | {"file": str(tmp_path / "one.csv")}}
    data |= {"reduction": {"coordinates": 6}}
    data["arms"][1] |= {"rigid": False, "cells": [4, 1, 1]}
    with pytest.raises(InputError, match=r"one\.csv: 1 row\(s\) below the column names"):
        check_motion(scene_from_dict(data, source))


def test_arm_without_joint(source):
    data = copy.deepcopy(ROBOT)
    data["joints"].pop()
    with pytest.raises(InputError, match=r'arms.1.name = "slide": expected one of \[\[joints\]\]'):
        scene_from_dict(data, source)


def test_size_is_not_made_up(source):
    """A rigid arm of a length whose mass or inertia would follow from its size must state it."""
    data = with_change(("arms", 0, "inertia"), None)
    data["arms"][0]["length"] = 0.2
    with pytest.raises(InputError, match=r"missing key arms\.0\.height"):
        scene_from_dict(data, source)


def test_plane_scenes_have_no_keys_of_space():
    """Three components of gravity, a tensor, a centre, a length of zero: each refused in a line."""
    for change in (
        "motion.gravity=[0,0,-9.81]",
        "payload.inertia=[1,1,1,0,0,0]",
        "payload.offset=[0,0,0.1]",
        "payload.arm=arm1",
        "arms.arm1.interfaces=[{name='side', point=[0.5, 0.03, 0], radius=0.01}]",
    ):
        with pytest.raises(InputError, match=r"without \[\[joints\]\]"):
            load_scene("demos/two_arm.toml", [change])
    data = copy.deepcopy(ROBOT)
    del data["joints"]
    data["motion"], data["payload"] = {"path": "arc"}, {"mass": 2.0}
    for key, value in (("centre", [0, 0, 0]), ("inertia", [1, 1, 1, 0, 0, 0]), ("length", 0.0)):
        data["arms"][0] = {"name": "a", "rigid": True, "length": 0.3, "height": 0.01,
                           "thickness": 0.01, key: value}  # fmt: skip
        with pytest.raises(InputError, match=rf"arms.0.{key} .*without \[\[joints\]\]"):
            scene_from_dict(data)
