"""Closed loops beside a URDF file: `dolfinopt import --closures`."""

import numpy as np
import pytest
from robots import tree_of
from runs import refused, run

from dolfinopt.exchange.urdf.file import read_robot
from dolfinopt.exchange.urdf.scene import scene_of_robot
from dolfinopt.motion.build import rigid_motion
from dolfinopt.scene.load import read_scene

pytestmark = pytest.mark.serial

MASS = (
    '<inertial><origin xyz="0.1 0 0"/><mass value="1"/><inertia ixx="0.001" ixy="0" ixz="0" '
    'iyy="0.01" iyz="0" izz="0.01"/></inertial>'
)
# A crank, a coupler and a rocker, whose foot is a link fixed to the rocker's end and turned.
LINKAGE = f"""<?xml version="1.0"?>
<robot name="linkage">
  <link name="base"/>
  <link name="crank">{MASS}</link>
  <link name="coupler">{MASS}</link>
  <link name="rocker">{MASS}</link>
  <link name="foot"/>
  <link name="tool">{MASS}</link>
  <link name="tip"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="crank"/>
    <axis xyz="0 0 1"/></joint>
  <joint name="knee" type="continuous"><parent link="crank"/><child link="coupler"/>
    <origin xyz="0.1 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="rock" type="continuous"><parent link="coupler"/><child link="rocker"/>
    <origin xyz="0.28 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="sole" type="fixed"><parent link="rocker"/><child link="foot"/>
    <origin xyz="0.2 0 0" rpy="0 0 1.5"/></joint>
  <joint name="hold" type="fixed"><parent link="crank"/><child link="tool"/>
    <origin xyz="0 0 0.1"/></joint>
  <joint name="end" type="fixed"><parent link="tool"/><child link="tip"/>
    <origin xyz="0.2 0 0"/></joint>
</robot>
"""
TABLE = """
passive = ["knee", "rock"]
[[closures]]
name = "ankle"
kind = "{kind}"
links = ["{link}", "base"]
points = [[0.25, 0, 0], [0.25, 0, 0]]
axis = [0, 0, 1]
"""
MOTION = "t,turn,knee,rock\n0,0.5,0.5,-2.0\n1,1.5,0,0\n"


def linkage(folder, table, motion=MOTION):
    files = tuple(folder / name for name in ("linkage.urdf", "loops.toml", "motion.csv"))
    for file, text in zip(files, (LINKAGE, table, motion), strict=True):
        file.write_text(text)
    return files


def imported_to(folder, table, motion=MOTION):
    """Import the linkage; return the scene's file."""
    robot, loops, file = linkage(folder, table, motion)
    words = (file, "tool", "--boxes", "--out", folder / "scene")
    run("import", robot, *words, "--closures", loops)
    return folder / "scene" / "linkage.toml"


def test_a_linkage_is_closed(tmp_path):
    """Passive joints, the rocker's interface, the assembly by the table's first row."""
    path = imported_to(tmp_path, TABLE.format(kind="pin", link="rocker"))
    tree, scene = tree_of(path), read_scene(path)
    assert scene.driven == ("turn",)
    assert [one["name"] for one in tree["joints"] if one.get("passive")] == ["knee", "rock"]
    assert scene.closures[0].between == ("rocker.ankle", "ground")
    assert (tmp_path / "scene" / "trajectory.csv").read_text().startswith("t,turn\n")
    q = rigid_motion(np.linspace(0.0, 1.0, 5), scene).q
    a, b, c = np.cumsum(q, axis=1).T
    end = 0.1 * np.exp(1j * a) + 0.28 * np.exp(1j * b) + 0.25 * np.exp(1j * c)
    assert np.abs(end - 0.25).max() < 1e-10


def test_a_driven_rod_is_a_column(tmp_path):
    """From a link that is fixed to the rocker; its length stands in the table."""
    table = TABLE.replace("axis = [0, 0, 1]\n", "").replace("[[0.25, 0, 0],", "[[0, 0, 0],")
    table = table.replace('["knee", "rock"]', '["rock"]')
    motion = "t,turn,knee,ankle\n0,0.5,0.5,0.2\n1,0.6,0.5,0.25\n"
    scene = read_scene(imported_to(tmp_path, table.format(kind="rod", link="foot"), motion))
    assert scene.driven == ("turn", "knee", "ankle")
    assert scene.arms[2].interfaces[0].point == pytest.approx((0.2, 0.0, 0.0))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("passive = ['knees']\n", ("passive = 'knees'", "turn, knee, rock")),
        ("loops = 1\n", ("loops = 1", "[[closures]]")),
        ("[[closures]]\nname = 'a'\n", ("closures.0.kind", "a word")),
        (TABLE.format(kind="pin", link="shank"), ("closures.0.links = 'shank'", "rocker")),
        (TABLE.format(kind="pin", link="foot"), ("closures.0.links", "turned", "name rocker")),
        (TABLE.format(kind="pin", link="tool"), ("closures.0.links = 'tool'", "arms.interfaces")),
        (TABLE.replace("[0.25, 0, 0],", "[0.25, 0],"), ("closures.0.points", "two points")),
        ("passive = [", ("not valid TOML",)),
    ],
)
def test_refused(tmp_path, table, words):
    table = table.replace("{kind}", "pin").replace("{link}", "rocker")
    robot, loops, motion = linkage(tmp_path, table)
    with refused("loops.toml", *words):
        scene_of_robot(read_robot(robot), ("tool",), None, str(motion), loops, True, warn=print)
