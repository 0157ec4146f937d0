"""Robots as other programs write them: xacro, the exporters of SolidWorks and Onshape."""

from pathlib import Path

import pytest
from runs import refused, run

import dolfinopt as do

FOLDER = Path(__file__).parent / "programs"
# File, links that become solids, the joints that move, kg of the first link in the file.
ROBOTS = [
    ("xacro.urdf", "upper", ("shoulder", "elbow"), 2.16),
    ("swarm/urdf/swarm.urdf", "Link1", ("Joint1", "Joint2"), 2.3625),
    ("onshape/robot.urdf", "arm", ("dof1", "dof2"), 1.2),
]

pytestmark = pytest.mark.serial


def motion_of(tmp_path, joints):
    file = tmp_path / "motion.csv"
    file.write_text(f"t,{','.join(joints)}\n0,0,0\n0.5,0.8,-0.6\n")
    return file


def bring(robot, links, motion, folder):
    run("import", robot, motion, links, "--out", folder)


@pytest.mark.parametrize(("file", "links", "joints", "mass"), ROBOTS, ids=lambda x: str(x)[:5])
def test_robots_of_other_programs_are_imported(tmp_path, capsys, file, links, joints, mass):
    """Without a warning, in the shape of their meshes and with their masses."""
    robot = FOLDER / file
    bring(robot, links, motion_of(tmp_path, joints), tmp_path / "scene")
    scene = do.load_scene(tmp_path / "scene" / f"{robot.stem}.toml")
    assert scene.driven == joints
    told = capsys.readouterr()
    assert "warning" not in told.err and "its shape" in told.out
    assert f"the file says {mass:.3g} kg" in told.out


def test_a_last_link_without_a_tool_is_told_with_the_remedy(tmp_path):
    robot, motion = FOLDER / "onshape" / "robot.urdf", motion_of(tmp_path, ("dof1", "dof2"))
    with refused("robot.urdf: link 'hand'", "add a fixed joint there with a link for the tool"):
        bring(robot, "hand", motion, tmp_path / "scene")
