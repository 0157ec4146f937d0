"""Scenes of machines in space: [[joints]], rigid arms with their inertia, and what is refused."""

import copy

import numpy as np
import pytest
from runs import TWO_ARM, refusal
from scenes import put_at

from dolfinopt.dynamics.build import check_motion
from dolfinopt.errors import InputError
from dolfinopt.motion.build import build_mechanism, rigid_link
from dolfinopt.scene.load import read_scene, scene_from_dict

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
def source(folder):
    (folder / "table.csv").write_text(TABLE)
    return str(folder / "robot.toml")


# Beside a link that is designed: a scene has at least one.
TOOL = {"name": "tool", "length": 0.3, "height": 0.02, "thickness": 0.01, "cells": [6, 2, 2]}
WRIST = {"name": "wrist", "type": "fixed", "parent": "slide", "child": "tool"}


def with_tool():
    """Return the robot with a flexible tool on a fixed joint."""
    data = copy.deepcopy(ROBOT)
    data["arms"].append(copy.deepcopy(TOOL))
    data["joints"].append(dict(WRIST))
    data["reduction"] = {"coordinates": 6}
    return data


# An interface on the slide's side, on which the tool hangs; the payload is on the slide's end.
SIDE = {"name": "side", "point": [0.2, 0.01, 0.0]}


def with_fork():
    """Return the robot whose slide carries the tool at its side and the payload at its end."""
    data = with_tool()
    data["arms"][1]["interfaces"] = [dict(SIDE)]
    data["joints"][2]["parent_interface"] = "side"
    data["payload"]["arm"] = "slide"
    return data


def machine_of(scene):
    return build_mechanism(scene, [rigid_link(arm, 2700.0) for arm in scene.arms])


def test_machine_of_a_scene(source):
    scene = scene_from_dict(with_tool(), source)
    assert scene.is_spatial and scene.driven == ("yaw", "lift")
    assert scene.motion.duration == 0.5
    assert scene.arms[0].height == scene.arms[0].thickness == 0.01
    machine = machine_of(scene)
    bodies = machine.bodies
    mass = 2700.0 * 0.4 * 0.02 * 0.01
    assert bodies[1].mass == pytest.approx(mass)
    # int x^2 of a bar about its end; the column's about its origin, by Huygens and Steiner.
    assert bodies[1].W[0, 0, 0] == pytest.approx(mass * 0.4**2 / 3.0)
    assert bodies[0].W[8, 0, 0] == pytest.approx(0.15 + 0.3**2)
    assert bodies[0].W[2, 0, 0] == pytest.approx(-0.01)
    assert np.array_equal(machine.joints[0].axis, [0, 0, 1])
    assert (machine.joints[1].parent, machine.joints[1].coordinate) == (0, 1)
    assert (machine.joints[2].parent, machine.joints[2].coordinate) == (1, None)
    assert set(machine.loads) == {(2, 0)}
    assert machine.loads[2, 0].body.w[0, 0] == pytest.approx(0.1)
    assert machine.end == (2, 0)
    data = with_tool()  # the tree is that of the joints, whatever the order of the tables
    data["joints"].reverse()
    scene = scene_from_dict(data, source)
    machine = machine_of(scene)
    assert scene.driven == ("lift", "yaw")
    assert machine.order == (0, 1, 2) and machine.movable == (1, 0)


FIXED = {"name": "yaw", "type": "fixed", "parent": "ground", "child": "column"}
TIGHT = [0.5, 0.2, 0.1, 0, 0, 0]  # a tensor of inertia no body has
# Paths in the robot, values, key or value that is shown, remedy.
REFUSED = [
    (("joints", 0, "parent"), "tower", 'joints.0.parent (yaw) = "tower"', '"ground" | '),
    (("joints", 1, "child"), "tool", 'joints.1.child (lift) = "tool"', "the name of an arm"),
    (("joints", 0, "parent"), "slide", "joints", "a tree that stands on the ground"),
    (("joints", 1, "child"), "column", "joints.1.child", "that no other joint holds"),
    (("joints", 1, "name"), "yaw", "joints.1.name", "a name that no other joint has"),
    (("joints", 1, "name"), "t", "joints.1.name", 'a column "t" means the time'),
    (("joints", 1, "axis"), [0, 0, 0], "joints.1.axis", "not of length zero"),
    (("joints", 1, "axis"), None, "joints.1.axis", 'with type = "prismatic"'),
    (("joints", 1, "type"), "fixed", "joints.1", 'with type = "fixed"'),
    (("joints", 1, "type"), "ball", "joints.1.type", '"revolute" | "prismatic" | "fixed"'),
    (("joints", 1, "position_limits"), [0.2, 0.1], "joints.1.position_limits", "the least first"),
    (("joints", 0, "effort_limit"), 0.0, "joints.0.effort_limit (yaw) = 0.0", "a number"),
    (("joints", 0), FIXED | {"velocity_limit": 1.0}, "joints.0", 'with type = "fixed"'),
    (("arms", 1, "interface_offset"), 0.1, "arms.1.interface_offset", "without mesh"),
    (("arms", 0, "inertia"), [0.2, -0.1, 0.1, 0, 0, 0], "arms.0.inertia", "be negative"),
    (("arms", 0, "inertia"), TIGHT, "arms.0.inertia", "exceed the sum of the two others"),
    (("payload", "inertia"), TIGHT, "payload.inertia = ", "exceed the sum of the two others"),
    # Its own would follow from its size, which is not made up.
    (("arms", 0), {"name": "column", "rigid": True, "length": 0.2, "mass": 1.0}, "missing key",
     "arms.0.height"),
    (("arms", 1, "cells"), [8, 2], "arms.1.cells (slide) = [8, 2]", "three integers"),
    (("joints", 0, "gear_damping"), 1.0, "joints.0.gear_damping", "only with gear_stiffness"),
    (("joints", 0, "rotor_inertia"), 1e-4, "joints.0.rotor_inertia (yaw) = 0.0001", "gear_ratio"),
    (("joints", 0), FIXED | {"friction": [1.0, 0.0]}, "joints.0", 'with type = "fixed"'),
    (("joints", 0, "friction_speed"), 1.0, "joints.0.friction_speed", "without friction"),
    (("joints", 0, "bearing_stiffness"), [1e6, 1e6], "joints.0.bearing_stiffness", "six numbers"),
    (("joints", 0, "bearing_damping"), [1.0, 0, 0, 0, 0, 0], "joints.0.bearing_damping",
     "bearing_stiffness has no spring there"),
    (("motion",), {"path": "arc"}, 'motion.path = "arc"', '"joints" | "points" | "line"'),
    (("motion",), {"path": "line"}, "[-1.0, 0.0] (default)", "an array of three"),
    (("motion", "initial_joints"), [0.1], "motion.initial_joints", ""),
    (("motion", "gravity"), [0, -9.81], "motion.gravity", "three numbers with [[joints]]"),
    (("motion", "joint_height"), 0.3, "motion.joint_height", "-0.5, the default, with [[joints]]"),
    (("motion", "cart_mass"), 2.0, "motion.cart_mass", "0.0, the default, with [[joints]]"),
    (("objective",), {"kind": "static", "loads": [[0, 1, 2]]}, "loads", "arrays of six numbers"),
    (("objective",), {"kind": "eigenfrequency", "elbow_angle": 0.1}, "elbow_angle",
     "none with [[joints]]"),
    (("closure",), {"kind": "pin"}, "closure", "[[closures]]"),
    (("control",), {"stiffness": [1], "damping": [1, 1]}, "control", "2 numbers, for yaw, lift"),
    (("joints",), ROBOT["joints"][:1], 'arms.1.name = "slide"', "one of [[joints]]"),
]  # fmt: skip
# The same of the robot with a fork.
FORKS = [
    (("joints", 2, "parent_interface"), "top", 'joints.2.parent (wrist) = "slide.top"',
     '"slide.outboard" | "slide.side"'),
    (("joints", 0, "parent"), "ground.side", "joints.0.parent", '"ground" | '),
    (("joints", 2, "parent_interface"), "outboard", "side", "nothing sits on it"),
    (("payload", "interface"), "top", 'payload.arm = "slide.top"', "an interface of slide"),
    (("payload", "arm"), "hand", 'payload.arm = "hand"', "the name of an arm"),
    (("arms", 1, "interfaces", 0, "name"), "Outboard", "arms.1.interfaces", "mesh file of a solid"),
    (("arms", 1, "interfaces", 0, "radius"), 0.1, "radius", "none: arms made of cells"),
    (("arms", 1, "interfaces"), [SIDE, SIDE], "arms.1.interfaces", "no other interface"),
    (("arms", 2, "interfaces"), [SIDE], "arms.2.interfaces", "> 0 [m]: arms made of cells"),
    (("arms", 2, "interfaces"), [{**SIDE, "radius": 0.01}], "arms.2.interf", "nothing sits on it"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("make", "path", "value", "shown", "remedy"),
    [(lambda: copy.deepcopy(ROBOT), *one) for one in REFUSED] + [(with_fork, *f) for f in FORKS],
)
def test_refusals(source, make, path, value, shown, remedy):
    data = make()
    data.setdefault("reduction", {"coordinates": 12})["coordinates"] = 12
    put_at(data, path, value)
    if path[-1] == "cells":
        del data["arms"][1]["rigid"]
    refusal(lambda: scene_from_dict(data, source), shown, remedy)


def test_interfaces_of_a_scene(source):
    """Where joints and payload sit; the end-effector is the arm with the payload."""
    scene = scene_from_dict(with_fork(), source)
    assert scene.end_effector == (1, 0) and scene.used_interfaces == {(0, 0), (1, 0), (1, 1)}
    machine = machine_of(scene)
    assert (machine.joints[2].parent, machine.joints[2].interface) == (1, 1)
    assert np.array_equal(machine.bodies[1].points, [[0.4, 0, 0], [0.2, 0.01, 0]])
    assert machine.sites == ((0,), (0, 1), ()) and set(machine.loads) == {(1, 0)}
    assert machine.way == ((0, 0), (1, 0))
    data = with_fork()  # the payload at the side, beside the tool
    data["payload"]["interface"] = "Side"
    machine = machine_of(scene_from_dict(data, source))
    assert machine.end == (1, 1) and set(machine.loads) == {(1, 1)}


def test_coordinates_of_several_interfaces(source):
    """Six of each; an arm that shares the design has the interfaces, too."""
    data = with_fork()
    data["arms"][2]["interfaces"] = [{**SIDE, "radius": 0.01}]
    data["payload"] = {"mass": 2.0, "arm": "tool", "interface": "side"}
    refusal(lambda: scene_from_dict(data, source), "an integer >= 12", "interfaces, 2")
    data["arms"].append({"name": "twin", "design": "tool"})
    data["joints"].append({**WRIST, "name": "second", "parent": "tool", "child": "twin"})
    data["reduction"]["coordinates"] = 12
    arms = scene_from_dict(data, source).arms
    assert arms[2].num_outboard == 12 and arms[3].interfaces == arms[2].interfaces != ()


def test_a_table_of_one_row(source, tmp_path):
    """The table is told, not the duration that would follow from it."""
    (tmp_path / "one.csv").write_text("t,yaw,lift\n0,0,0\n")
    data = copy.deepcopy(ROBOT) | {"motion": ROBOT["motion"] | {"file": str(tmp_path / "one.csv")}}
    data |= {"reduction": {"coordinates": 6}}
    data["arms"][1] |= {"rigid": False, "cells": [4, 1, 1]}
    with pytest.raises(InputError, match=r"one\.csv: 1 row\(s\) below the column names"):
        check_motion(scene_from_dict(data, source))


def test_plane_scenes_have_no_keys_of_space():
    """A tensor, a centre, a length of zero; gravity and the payload's keys: see test_scene."""
    side = "arms.arm1.interfaces=[{name='side', point=[0.5, 0.03, 0], radius=0.01}]"
    for change in ("payload.inertia=[1,1,1,0,0,0]", "payload.offset=[0,0,0.1]", side):
        refusal(lambda: read_scene(TWO_ARM, [change]), "without [[joints]]")  # noqa: B023
    data = copy.deepcopy(ROBOT)
    del data["joints"]
    data["motion"], data["payload"] = {"path": "arc"}, {"mass": 2.0}
    bar = {"name": "a", "rigid": True, "length": 0.3, "height": 0.01, "thickness": 0.01}
    for key, value in (("centre", [0, 0, 0]), ("inertia", [1, 1, 1, 0, 0, 0]), ("length", 0.0)):
        data["arms"][0] = bar | {key: value}
        refusal(lambda: scene_from_dict(data), f"arms.0.{key}", "without [[joints]]")


def test_coordinates_follow_from_the_interfaces(tmp_path):
    """Six of every outboard interface of a solid arm; in the plane four."""
    assert read_scene(TWO_ARM).reduction.coordinates == 4
    space = TWO_ARM.with_name("spatial_arm.toml")
    text = space.read_text().replace("coordinates = 6 ", "# ")
    path = tmp_path / "arm.toml"  # the demo without its number of coordinates
    path.write_text(text.replace('"spatial_arm.csv"', f'"{space.with_suffix(".csv")}"'))
    assert "coordinates" not in read_scene(path).to_tree()["reduction"]
    fork = 'arms.link2.interfaces=[{name="side", point=[0.2, 0.02, 0.0], radius=0.02}]'
    cases = ((6,), (12, fork, "payload.interface=side"), (7, "reduction.coordinates=7"))
    for number, *changes in (*cases, (4, "reduction.method=modal")):
        assert read_scene(path, changes).reduction.coordinates == number
