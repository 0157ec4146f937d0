"""Robots from URDF: kinematics and inertia of the scene; solids."""

from __future__ import annotations

import re

import numpy as np
import pytest
from mpi4py import MPI
from robots import DEMO, DEMO_MOTION, frames_of, mechanism_of, tree_of, write_uneven
from runs import run

from dolfinopt.exchange.urdf.bodies import default_tool, scene_bodies
from dolfinopt.exchange.urdf.read import read_robot
from dolfinopt.exchange.urdf.robot import MASSLESS, Robot, roll_pitch_yaw_of
from dolfinopt.exchange.urdf.scene import INERTIA, cells_of, scene_names
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.multibody.spatial.end_effector import end_effector
from dolfinopt.multibody.spatial.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.rotations import exponential, roll_pitch_yaw
from dolfinopt.scene.load import load_scene

yourdfpy = pytest.importorskip("yourdfpy")
trimesh = pytest.importorskip("trimesh")
pytestmark = pytest.mark.serial
MOVED = 12  # random joint coordinates


def rigid_machine(file, scene, links):
    """Return robot, bodies, and the scene's mechanism with the solids as rigid as in the file."""
    robot = read_robot(file)
    bodies = scene_bodies(robot, links, default_tool(robot, links))
    names = scene_names(body.link for body in bodies)
    solids = {
        names[body.link]: (
            body.inertia.mass,
            body.inertia.centre,
            np.array([body.inertia.tensor[i] for i in INERTIA]),
        )
        for body in bodies
        if body.is_solid
    }
    assert [arm["name"] for arm in tree_of(scene)["arms"]] == list(names.values())
    return robot, bodies, mechanism_of(scene, solids)


def random_joints(robot: Robot, rng):
    """Return joint coordinates (MOVED, joints) of which those that follow do so."""
    q = {joint.name: rng.normal(size=MOVED) for joint in robot.movable if joint.mimic is None}
    for joint in robot.movable:
        if joint.mimic is not None:
            q[joint.name] = joint.mimic.multiplier * q[joint.mimic.joint] + joint.mimic.offset
    return q


def in_scene(robot, mechanism, q):
    """Return those coordinates in the order of the scene's joints."""
    by_name = {scene_names([joint.name])[joint.name]: q[joint.name] for joint in robot.movable}
    return np.column_stack([by_name[mechanism.joints[i].name] for i in mechanism.movable])


# -- kinematics and inertia ------------------------------------------------------------------


def test_the_scene_moves_as_the_robot(imported):
    """Frames of all bodies against yourdfpy's, the end-effector's the tool's."""
    file, scene, links = imported
    robot, bodies, mechanism = rigid_machine(file, scene, links)
    q = random_joints(robot, np.random.default_rng(1))
    rows = in_scene(robot, mechanism, q)
    none = np.zeros_like(rows)
    ends = end_effector(mechanism, JointMotion(rows, none, none), np.zeros((MOVED, 0)))
    model = yourdfpy.URDF.load(str(file), load_meshes=False)
    for k in range(MOVED):
        own_q = {name: values[k] for name, values in q.items() if name != "other"}
        if "rail" in own_q:  # whose axis yourdfpy does not make a unit vector
            own_q["rail"] /= 3.0
        model.update_cfg(own_q)
        frames = frames_of(mechanism, rows[k])
        for body, frame in zip(bodies, frames, strict=True):
            expected = model.get_transform(body.link)
            assert np.abs(frame - expected @ body.frame).max() < 1e-12
        tool = model.get_transform(bodies[-1].link)
        assert bodies[-1].link in ("tool", "grip")
        assert np.abs(ends[k] - tool[:3, 3]).max() < 1e-12


def test_mass_centre_and_inertia_in_the_world(imported):
    """Every link's mass is somewhere; each body's as that of its links."""
    file, scene, links = imported
    robot, bodies, mechanism = rigid_machine(file, scene, links)
    q = random_joints(robot, np.random.default_rng(2))
    frames = frames_of(mechanism, in_scene(robot, mechanism, q)[0])
    poses = robot.poses({name: values[0] for name, values in q.items()})
    for body, frame, constants in zip(bodies, frames, mechanism.constants, strict=True):
        expected = MASSLESS
        for name in body.links:
            expected = expected + robot.links[name].own.posed(poses[name])
        mass = constants.body.mass
        second = constants.body.W.reshape(3, 3)
        centre = constants.body.w[:, 0] / mass if mass else np.zeros(3)
        second = second - mass * np.outer(centre, centre)
        tensor = frame[:3, :3] @ (np.trace(second) * np.eye(3) - second) @ frame[:3, :3].T
        assert mass == pytest.approx(expected.mass, rel=1e-15)
        assert np.abs(tensor - expected.tensor).max() < 1e-12
        if mass:
            place = frame[:3, :3] @ centre + frame[:3, 3]
            assert np.abs(place - expected.centre).max() < 1e-12
    on_ground = {"world", "foot", "base"}
    total = sum(link.own.mass for name, link in robot.links.items() if name not in on_ground)
    assert sum(one.mass for one in mechanism.bodies) == pytest.approx(total, rel=1e-14)


def test_drive_forces_against_pinocchio(imported):
    pin = pytest.importorskip("pinocchio")
    file, scene, links = imported
    robot, _, mechanism = rigid_machine(file, scene, links)
    model = pin.buildModelFromUrdf(str(file))
    assert np.array_equal(model.gravity.linear, mechanism.gravity)
    data = model.createData()
    order = [model.getJointId(joint.name) for joint in robot.movable]
    rng = np.random.default_rng(3)
    q, qd, qdd = (random_joints(robot, rng) for _ in range(3))
    rows = [in_scene(robot, mechanism, one) for one in (q, qd, qdd)]
    none = np.zeros((MOVED, 0))
    found = inverse_dynamics(mechanism, JointMotion(*rows), none, none, none)[1]
    names = [mechanism.joints[i].name for i in mechanism.movable]
    for k in range(MOVED):
        x, v, a = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        for joint, index in zip(robot.movable, order, strict=True):
            one = model.joints[index]
            value = q[joint.name][k]
            x[one.idx_q : one.idx_q + one.nq] = (
                [np.cos(value), np.sin(value)] if one.nq == 2 else [value]
            )
            v[one.idx_v], a[one.idx_v] = qd[joint.name][k], qdd[joint.name][k]
        forces = pin.rnea(model, data, x, v, a)
        for joint, index in zip(robot.movable, order, strict=True):
            column = names.index(scene_names([joint.name])[joint.name])
            expected = forces[model.joints[index].idx_v]
            assert found[k, column] == pytest.approx(expected, abs=1e-10)


def test_roll_pitch_yaw_comes_back():
    rng = np.random.default_rng(4)
    some = [exponential(rng.normal(scale=2.0, size=3)) for _ in range(20)]
    quarter = 0.5 * np.pi
    upright = [roll_pitch_yaw((a, p, b)) for a, b in rng.normal(size=(5, 2)) for p in
               (quarter, -quarter, quarter - 1e-9, 1e-8 - quarter)]  # fmt: skip
    for R in (*some, *upright):
        assert np.abs(roll_pitch_yaw(roll_pitch_yaw_of(R)) - R).max() < 1e-14


# -- solids ----------------------------------------------------------------------------------


def test_a_solid_lies_along_its_link():
    """Between parallel axes, in the middle of the rod beside them; z is the joints' axis."""
    robot = read_robot(DEMO)
    bodies = {body.link: body for body in scene_bodies(robot, ("upper_arm", "forearm"), "tool")}
    upper, fore = bodies["upper_arm"], bodies["forearm"]
    assert upper.length == pytest.approx(0.862, abs=1e-15)
    assert upper.frame[:3, 3] == pytest.approx([0.0, 0.0, 0.21])
    assert upper.frame[:3, 0] == pytest.approx([-1.0, 0.0, 0.0])
    assert upper.axis == pytest.approx([0.0, 0.0, 1.0])
    assert upper.size == pytest.approx((0.14, 0.14), rel=2e-3) and upper.measured
    # The elbow turns about the same line, seen from the middle of either rod.
    assert fore.pose[:3, 3] == pytest.approx([0.0, 0.0, 0.06 - 0.21])
    assert fore.length == pytest.approx(0.7287, abs=1e-15)
    cells = cells_of(0.5, 0.04, 0.02)
    sides = np.array([0.5, 0.04, 0.02]) / cells
    assert sides.max() < 2.0 * sides.min() and 4000 < np.prod(cells) < 9000


def test_a_solid_without_geometry_is_a_guess(tmp_path):
    file = write_uneven(tmp_path)
    bodies = scene_bodies(read_robot(file), ("lower",), "grip")
    (lower,) = (body for body in bodies if body.is_solid)
    assert not lower.measured and lower.size == pytest.approx([lower.length / 10.0] * 2)
    assert lower.length == pytest.approx(np.linalg.norm([0.4, 0.05, 0.1]))
    # Its x axis points to the next joint, its z axis has no component of the joint's across both.
    direction = lower.frame[:3, 0] * lower.length
    assert direction == pytest.approx([0.4, 0.05, 0.1])
    assert abs(lower.frame[:3, 1] @ lower.joint.axis) < 1e-12


def test_what_a_solid_carries_without_a_joint_stays(tmp_path):
    """With mass as a body on a fixed joint; a frame without mass is only a place."""
    file = write_uneven(tmp_path)
    bodies = {body.link: body for body in scene_bodies(read_robot(file), ("upper",), "grip")}
    assert bodies["bracket"].joint.kind == "fixed" and bodies["bracket"].parent == "upper"
    assert "mark" not in bodies and bodies["slide"].parent == "upper"
    assert bodies["base/turn"].links == ("base/turn", "cover")
    assert list(bodies)[-1] == "grip"
    assert [one.links for one in bodies.values() if one.parent == "ground"] == [
        ("base/turn", "cover")
    ]


def test_the_end_effector_is_the_last_arm(tmp_path):
    """The tool's body, or one at its interface where others hang on it."""
    file = write_uneven(tmp_path)
    motion = tmp_path / "motion.csv"
    motion.write_text("t,yaw\n0,0\n1,1\n")
    words = ("import", file, "--links", "upper", "--trajectory", motion, "--boxes", "--tool")
    for tool, last in (("left", "left"), ("lower", "lower_end")):
        run(*words, tool, "--out", tmp_path / tool)
        scene = load_scene(tmp_path / tool / "uneven.toml")
        assert scene.arms[-1].name == last
        q = {joint.name: 0.3 for joint in read_robot(file).movable}
        row = np.array([[0.3] * len(scene.driven)])
        mechanism = mechanism_of(
            tmp_path / tool / "uneven.toml", {"upper": (1, (0, 0, 0), [1] * 6)}
        )
        motion_now = JointMotion(row, 0 * row, 0 * row)
        end = end_effector(mechanism, motion_now, np.zeros((1, 0)))[0]
        assert np.abs(end - read_robot(file).poses(q)[tool][:3, 3]).max() < 1e-12


def test_a_closed_geometry_becomes_the_solid(tmp_path, capsys):
    """Cut at the joints and meshed; a box with a reason where that cannot be."""
    file = tmp_path / "robot.urdf"
    rod = '<geometry><cylinder radius="0.07" length="1.0"/></geometry>'
    assert rod in DEMO.read_text()  # the upper arm's, which is to be too short
    file.write_text(DEMO.read_text().replace(rod, rod.replace("1.0", "0.8")))
    links = "upper_arm,forearm"
    run("import", file, "--links", links, "--trajectory", DEMO_MOTION, "--out", tmp_path / "a")
    said = capsys.readouterr()
    assert re.search(r"forearm: solid, 0.729 x 0.11 x 0.11 m, its shape, \d{4} cells", said.out)
    assert "upper_arm: solid, 0.862 x 0.14 x 0.14 m, a box to edit" in said.out
    assert "'upper_arm' becomes a box: its geometry does not reach the inboard joint" in said.err
    scene = load_scene(tmp_path / "a" / "robot.toml")
    index = [arm.name for arm in scene.arms].index("forearm")
    mesh = arm_mesh(MPI.COMM_SELF, scene.arms[index])
    ring = 0.5 * 64 * np.sin(2 * np.pi / 64) * 0.055**2  # of the cylinder's flat sides
    assert mesh.area.sum() == pytest.approx(ring * 0.7287, rel=0.02)
    assert 2000 < mesh.num_cells < 10000
    assert 0.05 < mesh.area[mesh.passive].sum() / mesh.area.sum() < 0.1
