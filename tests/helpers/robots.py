"""Robots for tests: URDF texts, and the mechanism that a scene of one describes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from runs import ROOT, run, tomllib

from dolfinopt.motion.build import build_mechanism, rigid_link
from dolfinopt.multibody.shape_integrals import rigid_spatial_body
from dolfinopt.multibody.tree import Mechanism
from dolfinopt.scene.load import read_scene

DEMO = ROOT / "demos" / "robot.urdf"
DEMO_MOTION = ROOT / "demos" / "robot_motion.csv"

# Everything that URDF has and a scene must say otherwise: a sensor on a fixed joint, links that a
# solid carries without a joint, with mass and without, a branch, a finger that follows the other,
# axes that are no unit vectors, rotated inertias, pitch by a quarter turn, names with a slash.
UNEVEN = """<?xml version="1.0"?>
<robot name="uneven">
  <!-- kept -->
  <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="world"/>
  <link name="foot">{foot}</link>
  <link name="base/turn">{turn}</link>
  <link name="cover">{cover}</link>
  <link name="upper">{upper}
    <visual><origin xyz="0.02 0.2 0.1" rpy="0.3 0.2 -0.1"/>
      <geometry><box size="0.1 0.7 0.12"/></geometry><material name="grey"/></visual>
  </link>
  <link name="bracket">{bracket}</link>
  <link name="mark"/>
  <link name="slide">{slide}</link>
  <link name="lower">{lower}</link>
  <link name="hand">{hand}</link>
  <link name="left">{left}</link>
  <link name="right">{right}</link>
  <link name="grip"/>
  <joint name="stand" type="fixed"><parent link="world"/><child link="foot"/>
    <origin xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"/></joint>
  <joint name="yaw" type="continuous"><parent link="foot"/><child link="base/turn"/>
    <origin xyz="0 0.1 0.4" rpy="0.2 1.5707963267948966 0.5"/><axis xyz="0.1 0.2 2"/></joint>
  <joint name="screws" type="fixed"><parent link="base/turn"/><child link="cover"/>
    <origin xyz="0.1 0 0.2" rpy="0.4 0 0.2"/></joint>
  <joint name="lift" type="revolute"><parent link="cover"/><child link="upper"/>
    <origin xyz="0.05 0 0.15" rpy="1.2 -0.3 0.7"/><axis xyz="1 0 1"/>
    <limit lower="-2" upper="2" effort="1" velocity="3"/></joint>
  <joint name="weld" type="fixed"><parent link="upper"/><child link="bracket"/>
    <origin xyz="0.1 0.5 0.1" rpy="0.3 -0.2 0.5"/></joint>
  <joint name="spot" type="fixed"><parent link="upper"/><child link="mark"/>
    <origin xyz="0.0 0.1 0.2" rpy="0 -1.5707963267948966 0"/></joint>
  <joint name="rail" type="prismatic"><parent link="mark"/><child link="slide"/>
    <origin xyz="0.1 0 0"/><axis xyz="0 3 0"/>
    <limit lower="-0.2" upper="0.3" effort="1" velocity="0.5"/></joint>
  <joint name="bend" type="revolute"><parent link="bracket"/><child link="lower"/>
    <origin xyz="0.02 0.1 0.03" rpy="-0.5 0.4 0.2"/><axis xyz="0 -1 0.3"/>
    <limit lower="-2.5" upper="2.5" effort="1" velocity="3"/></joint>
  <joint name="roll" type="revolute"><parent link="lower"/><child link="hand"/>
    <origin xyz="0.4 0.05 0.1" rpy="0.1 0.2 0.3"/><axis xyz="1 0 0"/>
    <limit lower="-3" upper="3" effort="1" velocity="3"/></joint>
  <joint name="finger" type="prismatic"><parent link="hand"/><child link="left"/>
    <origin xyz="0.1 0.02 0"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.04" effort="1" velocity="0.2"/></joint>
  <joint name="other" type="prismatic"><parent link="hand"/><child link="right"/>
    <origin xyz="0.1 -0.02 0"/><axis xyz="0 1 0"/>
    <limit lower="-0.05" upper="0.01" effort="1" velocity="0.2"/>
    <mimic joint="finger" multiplier="-1" offset="0.005"/></joint>
  <joint name="tcp" type="fixed"><parent link="hand"/><child link="grip"/>
    <origin xyz="0.15 0 0.01" rpy="0 0.5 0"/></joint>
  <gazebo reference="hand"><selfCollide>true</selfCollide></gazebo>
</robot>
"""
UNEVEN_LINKS = (
    "foot", "turn", "cover", "upper", "bracket", "slide", "lower", "hand", "left", "right",
)  # fmt: skip


def run_import(file: Path, links: str, motion: Path, folder: Path, *more: str) -> None:
    """Import a robot with boxes for solids."""
    told = motion, links, "--out", folder, "--boxes"
    run("import", file, *told, *more)


def inertial(rng: np.random.Generator) -> str:
    """Return an element of some body that may be, its inertia turned against the link."""
    points, masses = rng.normal(scale=0.1, size=(6, 3)), rng.uniform(0.1, 1.0, size=6)
    r = points - masses @ points / masses.sum()
    second = np.einsum("n,na,nb->ab", masses, r, r)
    I = (np.trace(second) * np.eye(3) - second).tolist()  # noqa: E741
    x, y, z, *turn = (f"{one:.6f}" for one in rng.normal(scale=0.2, size=6))
    return (
        f'<inertial><origin xyz="{x} {y} {z}" rpy="{" ".join(turn)}"/>'
        f'<mass value="{float(masses.sum())!r}"/><inertia ixx="{I[0][0]!r}" ixy="{I[0][1]!r}" '
        f'ixz="{I[0][2]!r}" iyy="{I[1][1]!r}" iyz="{I[1][2]!r}" izz="{I[2][2]!r}"/></inertial>'
    )


def write_uneven(folder: Path) -> Path:
    """Write the robot and return its file."""
    rng = np.random.default_rng(8)
    file = folder / "uneven.urdf"
    file.write_text(UNEVEN.format(**{name: inertial(rng) for name in UNEVEN_LINKS}))
    return file


def tree_of(scene: Path) -> dict[str, Any]:
    """Return a scene file's tables."""
    return tomllib.loads(scene.read_text(encoding="utf-8"))


def mechanism_of(file: Path, solids: Mapping[str, Sequence[Any]]) -> Mechanism:
    """Return a scene's rigid mechanism, by mass, centre and inertia (6,) of arms that are not."""
    scene = read_scene(file)
    bodies = [
        rigid_link(arm, 0.0) if arm.rigid
        else rigid_spatial_body(*solids[arm.name], (arm.length, 0.0, 0.0))
        for arm in scene.arms
    ]  # fmt: skip
    return build_mechanism(scene, bodies)
