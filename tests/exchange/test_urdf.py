"""Robots from URDF: kinematics and inertia of the scene, checks, and back."""

from __future__ import annotations

import json
import re
import sys

import numpy as np
import pytest
from mpi4py import MPI
from robots import frames_of, mechanism_of, tree_of, write_uneven
from runs import ROOT, run
from solids import DENSITY, HEIGHT, LENGTH, THICKNESS, solid_scene

from dolfinopt.arms.arm import Arm
from dolfinopt.cli.export_robot import link_inertia
from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.bodies import default_tool, scene_bodies
from dolfinopt.exchange.urdf.checks import implausible_inertias
from dolfinopt.exchange.urdf.read import read_robot
from dolfinopt.exchange.urdf.robot import MASSLESS, Inertia, Robot, roll_pitch_yaw_of
from dolfinopt.exchange.urdf.scene import INERTIA, cells_of, read_origin, scene_names
from dolfinopt.exchange.urdf.write import NewLink, robot_text
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.multibody.spatial.end_effector import end_effector
from dolfinopt.multibody.spatial.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.rotations import exponential, roll_pitch_yaw
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import load_scene

yourdfpy = pytest.importorskip("yourdfpy")
trimesh = pytest.importorskip("trimesh")
pytestmark = pytest.mark.serial
DEMO = ROOT / "demos" / "robot.urdf"
DEMO_MOTION = ROOT / "demos" / "robot_motion.csv"
UNEVEN_MOTION = "t,yaw,lift,bend,roll,rail\n0,0,0,0,0,0\n1,0.5,-1,0.7,0.2,0.1\n"
MOVED = 12  # random joint coordinates


def run_import(file, links, motion, folder, *more):
    """Import a robot with boxes for solids."""
    run("import", file, "--links", links, "--trajectory", motion, "--out", folder, "--boxes", *more)


@pytest.fixture(scope="module", params=["six axes", "uneven"])
def imported(request, tmp_path_factory):
    """The folder of an imported robot, and what was imported."""
    folder = tmp_path_factory.mktemp("robot")
    if request.param == "six axes":
        file, motion, links = DEMO, DEMO_MOTION, "upper_arm,forearm"
    else:
        file, motion, links = write_uneven(folder), folder / "motion.csv", "upper,lower"
        motion.write_text(UNEVEN_MOTION)
    run_import(file, links, motion, folder / "scene")
    return file, folder / "scene" / f"{file.stem}.toml", tuple(links.split(","))


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


# -- the command -----------------------------------------------------------------------------


def test_import_says_what_it_made(tmp_path, capsys):
    run_import(DEMO, "forearm", DEMO_MOTION, tmp_path / "a")
    said = capsys.readouterr()
    assert "6 joints that move" in said.out and "forearm: solid, 0.729 x 0.11 x 0.11 m" in said.out
    assert said.err == ""  # nothing is wrong with this robot
    tree = tree_of(tmp_path / "a" / "robot.toml")
    assert [arm["name"] for arm in tree["arms"] if not arm.get("rigid")] == ["forearm"]
    assert tree["arms"][-1]["name"] == "tool" and tree["motion"]["file"] == "trajectory.csv"
    scene = load_scene(tmp_path / "a" / "robot.toml")
    assert scene.is_spatial and scene.driven == tuple(
        DEMO_MOTION.read_text().splitlines()[1].replace(" ", "").split(",")[1:]
    )
    assert "7.879 kg" in (tmp_path / "a" / "robot.toml").read_text()
    before = (tmp_path / "a" / "robot.toml").read_bytes()
    with pytest.raises(InputError, match="exists already"):
        run_import(DEMO, "upper_arm", DEMO_MOTION, tmp_path / "a")  # fmt: skip
    assert (tmp_path / "a" / "robot.toml").read_bytes() == before


def test_a_joint_that_follows_and_those_not_named_have_columns(tmp_path, capsys):
    file, motion = write_uneven(tmp_path), tmp_path / "motion.csv"
    motion.write_text("t,finger,yaw\n0,0.01,0\n1,0.03,2\n")
    run_import(file, "upper", motion, tmp_path / "a")
    rows = np.genfromtxt(tmp_path / "a" / "trajectory.csv", delimiter=",", names=True)
    assert set(rows.dtype.names) == {
        "t", "yaw", "lift", "rail", "bend", "roll", "finger", "other"
    }  # fmt: skip
    assert rows["other"] == pytest.approx(0.005 - rows["finger"], abs=1e-15)
    assert not rows["lift"].any()
    assert "stand still: lift = 0, " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("shoulder_pan,elbow\n0,0\n1,1\n", "no column t"),
        ("t,shoulder\n0,0\n1,1\n", "column 'shoulder': the robot has no such joint; expected t"),
        ("t,flange\n0,0\n1,1\n", "this joint is fixed"),
        ("t,elbow\n0,0\n1,1\n1,2\n", "line 4, column t = 1: expected more than 1"),
        ("t,elbow\n0,0\n1,45\n", r"line 3, joint elbow = 45: expected -3.1416 .*degrees\?"),
        ("t,elbow\n0,0\n1,3.2\n", r"line 3, joint elbow = 3.2: .* \[rad\], its limits$"),
    ],
)
def test_trajectories_that_cannot_be_followed(tmp_path, table, message):
    motion = tmp_path / "motion.csv"
    motion.write_text(table)
    with pytest.raises(InputError, match=message):
        run_import(DEMO, "forearm", motion, tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_a_motion_that_is_too_fast_is_told(tmp_path, capsys):
    """A quintic from rest to rest peaks at 15/8 of its mean speed."""
    motion = tmp_path / "motion.csv"
    motion.write_text("t,elbow\n0,0\n1,1.5\n")
    run_import(DEMO, "forearm", motion, tmp_path / "a")
    assert "joint elbow moves at up to 2.812 rad/s, beyond its limit of 2.618" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("links", "message"),
    [
        ("fore_arm", "no link 'fore_arm'; did you mean forearm?"),
        ("base", "'base' stands on the ground"),
        ("tool", "'tool': nothing hangs on it"),
        ("forearm,forearm", "a link is named twice"),
        (",", "expected names of links"),
    ],
)
def test_links_that_cannot_be_solids(tmp_path, links, message):
    with pytest.raises(InputError, match=message):
        run_import(DEMO, links, DEMO_MOTION, tmp_path / "a")
    assert not (tmp_path / "a").exists()


LINK = '<link name="{}"/>'
JOINT = (
    '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/>'
    '<limit lower="0" upper="1" effort="1" velocity="1"/>{}</joint>'
)


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ([], "no links"),
        ([LINK.format("a"), LINK.format("a")], "link 'a' stands there 2 times"),
        ([LINK.format("a"), LINK.format("b")], "2 links that no joint holds"),
        ([LINK.format("a"), JOINT.format("j", "revolute", "a", "b", "")], "no link 'b', its child"),
        (
            [LINK.format("a"), LINK.format("b"), JOINT.format("j", "floating", "a", "b", "")],
            "joint 'j': type 'floating'; a scene has joints of type revolute, continuous",
        ),
        (
            [LINK.format("a"), LINK.format("b"), JOINT.format("j", "planar", "a", "b", "")],
            "type 'planar'",
        ),
        (
            [LINK.format("a"), LINK.format("b"),
             JOINT.format("j", "revolute", "a", "b", '<axis xyz="0 0 0"/>')],
            "expected three numbers, not all zero",
        ),
        (
            [LINK.format("a"), LINK.format("b"),
             JOINT.format("j", "revolute", "a", "b", '<mimic joint="k"/>')],
            "follows 'k'; expected a joint that moves",
        ),
        (
            [*map(LINK.format, "abc"), JOINT.format("j", "fixed", "b", "c", ""),
             JOINT.format("k", "fixed", "c", "b", "")],
            "part of a loop",
        ),
        (["<link/>"], "not a robot that yourdfpy can read"),
    ],
)  # fmt: skip
def test_robots_that_a_scene_cannot_hold(tmp_path, inside, message):
    file = tmp_path / "r.urdf"
    file.write_text(f'<robot name="r">{"".join(inside)}</robot>')
    with pytest.raises(InputError, match=message) as caught:
        read_robot(file)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(str(file))


def test_files_that_are_no_robots(tmp_path):
    file = tmp_path / "r.urdf"
    with pytest.raises(InputError, match=r"r\.urdf: cannot be read"):
        read_robot(file)
    for text, message in (
        ("<robot", "not XML"),
        ('<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro"/>', "xacro"),
        ("<sdf/>", "expected an element <robot name"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=message):
            read_robot(file)


def test_without_the_extra_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "yourdfpy", None)
    with pytest.raises(InputError, match=r"pip install 'dolfinopt\[robots\]'"):
        read_robot(DEMO)


# -- inertias --------------------------------------------------------------------------------


def test_this_robots_inertias_may_be():
    assert implausible_inertias(read_robot(DEMO)) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('iyy="0.7576"', 'iyy="-0.7576"', "not positive definite"),
        ('iyy="0.7576"', 'iyy="1.7576"', "largest exceeds the sum of the others"),
        ('<mass value="7.879"/>', '<mass value="0"/>', "no mass, though"),
        ('<mass value="7.879"/>', '<mass value="7879"/>', "kg/m3; expected 100 to 20000"),
        ('xyz="-0.4053 0 0.0604"', 'xyz="-405.3 0 60.4"', "m outside its geometry"),
        (
            'ixx="0.0261" ixy="-0.0001" ixz="-0.029" iyy="0.7576" iyz="0" izz="0.7533"',
            'ixx="26.1" ixy="-0.1" ixz="-29" iyy="757.6" iyz="0" izz="753.3"',
            "inertia is too large",
        ),
        (
            'ixx="0.0261" ixy="-0.0001" ixz="-0.029" iyy="0.7576" iyz="0" izz="0.7533"',
            'ixx="1e-6" ixy="0" ixz="0" iyy="1e-6" iyz="0" izz="1e-6"',
            "inertia is too small",
        ),
        ('<geometry><cylinder radius="0.055" length="0.84"/></geometry>',
         '<geometry><mesh filename="package://robot/forearm.stl"/></geometry>',
         "mesh package://robot/forearm.stl cannot be read"),
    ],
)  # fmt: skip
def test_inertias_that_cannot_be_are_told(tmp_path, old, new, message):
    text = DEMO.read_text()
    assert old in text
    file = tmp_path / "wrong.urdf"
    file.write_text(text.replace(old, new, 1))
    found = implausible_inertias(read_robot(file))
    assert any(message in one for one in found), found
    assert all("link 'forearm': " in one and "\n" not in one for one in found)


# -- back ------------------------------------------------------------------------------------


def same_kinematics(one: Robot, other: Robot) -> bool:
    """Return whether all joints are alike, to the last bit."""
    return all(
        (a.name, a.kind, a.parent, a.child, a.lower, a.upper, a.velocity)
        == (b.name, b.kind, b.parent, b.child, b.lower, b.upper, b.velocity)
        and np.array_equal(a.pose, b.pose)
        and np.array_equal(a.axis, b.axis)
        for a, b in zip(one.joints, other.joints, strict=True)
    )


def test_there_and_back(imported, tmp_path):
    """Frames of solids are undone: mass, centre and inertia come back to rounding."""
    file, _, links = imported
    robot = read_robot(file)
    bodies = scene_bodies(robot, links, default_tool(robot, links))
    new = [NewLink(b.link, b.inertia.posed(b.frame)) for b in bodies if b.is_solid]
    back = tmp_path / "back" / "robot.urdf"
    back.parent.mkdir()
    back.write_bytes(robot_text(file, new, back.parent))
    again = read_robot(back)
    assert list(again.links) == list(robot.links) and same_kinematics(robot, again)
    for name, link in robot.links.items():
        own = again.links[name].own
        assert own.mass == pytest.approx(link.own.mass, rel=1e-15)
        assert np.abs(own.centre - link.own.centre).max() < 1e-15
        assert np.abs(own.tensor - link.own.tensor).max() < 1e-14
    text = back.read_text()
    if file == DEMO:
        assert "Denavit-Hartenberg" in text and "the rod between shoulder and elbow" in text
    else:
        assert "<!-- kept -->" in text and '<gazebo reference="hand"><selfCollide>' in text
    changed = sum(a != b for a, b in zip(file.read_text().splitlines(), text.splitlines()))
    assert changed > 0 and text.count("<inertial>") == file.read_text().count("<inertial>")


def test_new_meshes_take_the_place_of_all_shapes(tmp_path):
    """The material stays; meshes of other links are found from the new folder."""
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box(extents=(0.1, 0.2, 0.3)).export(tmp_path / "meshes" / "hand.stl")
    file = write_uneven(tmp_path)
    hand = '<link name="hand">'
    shape = '<visual><geometry><mesh filename="meshes/hand.stl" scale="2 1 1"/></geometry></visual>'
    file.write_text(file.read_text().replace(hand, hand + shape))
    folder = tmp_path / "new"
    folder.mkdir()
    trimesh.creation.icosphere(radius=0.1).export(folder / "upper.stl")
    body = Inertia(2.5, np.array([0.1, 0.2, 0.3]), np.diag([0.01, 0.02, 0.025]))
    back = folder / "uneven.urdf"
    back.write_bytes(robot_text(file, [NewLink("upper", body, "upper.stl")], folder))
    robot = read_robot(back)
    upper, hand_link = robot.links["upper"], robot.links["hand"]
    assert not upper.missing and not hand_link.missing
    assert (upper.own.mass, *upper.own.centre) == (2.5, 0.1, 0.2, 0.3)
    assert np.array_equal(upper.own.tensor, body.tensor)
    assert len(upper.shapes) == 1 and upper.volume == pytest.approx(4 / 3 * np.pi * 1e-3, rel=0.02)
    assert hand_link.volume == pytest.approx(2 * 0.1 * 0.2 * 0.3)
    inside = back.read_text().split('<link name="upper">')[1].split("</link>")[0]
    assert inside.count("<visual>") == inside.count("<collision>") == 1
    assert '<material name="grey"/>' in inside and "box" not in inside
    with pytest.raises(InputError, match="no link 'arm'; is it the robot of the scene"):
        robot_text(file, [NewLink("arm", body)], folder)


def test_a_links_inertia_is_its_bodys_and_its_motors():
    """Against parallel axes by hand: a box, and a motor at its outboard end."""
    scene = solid_scene(cells=(10, 3, 2), joint_mass=0.7, joint_inertia=0.01)
    arm = Arm(scene, 0, MPI.COMM_SELF, Profile())
    found = link_inertia(scene, 0, arm.reduce(np.ones(60)))
    box = DENSITY * LENGTH * HEIGHT * THICKNESS
    mass = box + 0.7
    centre = (0.5 * box * LENGTH + 0.7 * LENGTH) / mass
    squares = np.array([HEIGHT**2 + THICKNESS**2, LENGTH**2 + THICKNESS**2, LENGTH**2 + HEIGHT**2])
    apart = box * (centre - 0.5 * LENGTH) ** 2 + 0.7 * (LENGTH - centre) ** 2
    expected = np.diag(box * squares / 12.0 + 0.01 + [0.0, apart, apart])
    assert found.mass == pytest.approx(mass, rel=1e-13)
    assert found.centre == pytest.approx([centre, 0.0, 0.0], abs=1e-14)
    assert np.abs(found.tensor - expected).max() < 1e-13


def test_export_says_what_it_cannot_write(tmp_path):
    with pytest.raises(InputError, match="add --urdf for a robot's run"):
        run("export", tmp_path)
    with pytest.raises(InputError, match="expected no --design and no --set"):
        run("export", tmp_path, "--urdf", "--set", "payload.mass=1")
    with pytest.raises(InputError, match=r"summary.json: cannot be read .* finished"):
        run("export", tmp_path, "--urdf")
    record = tmp_path / "robot.json"
    for text in (None, "{", '{"urdf": "a", "solids": {"b": {"link": "c", "frame": [1]}}}'):
        if text is not None:
            record.write_text(text)
        with pytest.raises(InputError, match=r"robot\.json: cannot be read .* `dolfinopt import`"):
            read_origin(record)


def test_an_inertia_that_no_body_has_is_to_be_corrected(tmp_path, capsys):
    """The scene is written, and says itself what is wrong with it."""
    file = tmp_path / "robot.urdf"
    file.write_text(DEMO.read_text().replace('izz="0.0012"', 'izz="0.012"'))
    run_import(file, "forearm", DEMO_MOTION, tmp_path / "a")
    said = capsys.readouterr().err
    assert "link 'wrist_3': its inertia cannot be" in said
    assert "correct the scene before you simulate it: " in said
    with pytest.raises(InputError, match=r"inertia \(wrist_3\)"):
        load_scene(tmp_path / "a" / "robot.toml")


def test_from_the_robot_to_a_run_and_back(tmp_path, capsys):
    """A finished run's link in the robot: its mass, its surface, and the same scene again."""
    run_import(DEMO, "forearm", DEMO_MOTION, tmp_path / "a")
    coarse = ("--set", "arms.forearm.cells=[12,4,4]", "--set", "design.initial=1.0",
              "--set", "simulation.tolerance=1e-2", "--no-plots")  # fmt: skip
    run("simulate", tmp_path / "a" / "robot.toml", "--out", tmp_path / "run", *coarse)
    run("export", tmp_path / "run", "--urdf")
    assert "kg, was 7.879 kg" in capsys.readouterr().out
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    before, after = read_robot(DEMO), read_robot(tmp_path / "run" / "urdf" / "robot.urdf")
    assert same_kinematics(before, after)
    fore = after.links["forearm"]
    assert fore.own.mass == pytest.approx(summary["mass"]["forearm"], rel=1e-12)
    assert fore.is_closed and fore.volume == pytest.approx(fore.own.mass / 2700.0, rel=0.01)
    # Its frame is the link's: the rod's middle beside the elbow, from it to the wrist.
    assert fore.own.centre == pytest.approx([-0.36435, 0.0, 0.06], abs=1e-9)
    assert fore.points.min(axis=0) == pytest.approx([-0.7287, -0.055, 0.005], abs=1e-3)
    assert implausible_inertias(after) == []
    run_import(tmp_path / "run" / "urdf" / "robot.urdf", "forearm", DEMO_MOTION, tmp_path / "b")
    masses = [
        {arm["name"]: arm.get("mass") for arm in tree_of(tmp_path / name / "robot.toml")["arms"]}
        for name in "ab"
    ]
    assert masses[0] == masses[1]
    again = read_robot(tmp_path / "run" / "urdf" / "robot.urdf")
    total = sum(link.own.mass for link in again.links.values())
    rest = sum(link.own.mass for name, link in before.links.items() if name != "forearm")
    assert total == pytest.approx(rest + summary["mass"]["forearm"], rel=1e-9)
