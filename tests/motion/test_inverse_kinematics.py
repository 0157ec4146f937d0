"""Inverse kinematics in space: closed form, a six-axis robot, joints from the table, refusals."""

from pathlib import Path

import numpy as np
import pytest
from runs import refused, tomllib
from scipy.spatial.transform import Rotation

from dolfinopt.dynamics.build import check_motion
from dolfinopt.motion.build import breakpoints, rigid_motion, skeleton, target_of
from dolfinopt.motion.poses import relative_vectors
from dolfinopt.multibody.kinematics import Posed
from dolfinopt.scene.load import read_scene, scene_from_dict

pytestmark = pytest.mark.serial
ARM, ROBOT = "demos/spatial_arm.toml", "demos/robot_link.toml"
L1, L2 = 0.5, 0.45  # m, of the demo
EXACT = 1e-10


def write(file, names, *columns):
    """Write a table of columns (n,) or (n, k)."""
    rows = np.column_stack(columns).tolist()
    file.write_text("\n".join([names, *(",".join(map(repr, row)) for row in rows)]) + "\n")
    return file


def scene_of(demo, *changes):
    return read_scene(demo, ["motion.path=points", *changes])


def differences(scene, t, key, h=1e-3):
    """Return the derivative of a joint motion by differences of fourth order."""
    a, b, c, d = (getattr(rigid_motion(t + k * h, scene), key) for k in (-2, -1, 1, 2))
    return (a - 8.0 * b + 8.0 * c - d) / (12.0 * h)


def end_of(scene, q):
    """Return the end-effector's place (n, 3) and rotation (n, 3, 3) for joints (n, R)."""
    mechanism = skeleton(scene)
    place, R = Posed(mechanism, q, np.zeros((len(q), 0))).interface(*mechanism.end)
    return place.T, R.transpose(2, 0, 1)


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    """Yaw, pitch, pitch through three points, elbow below the chord."""
    t, points = [0.0, 0.25, 0.6], [[0.6, 0.0, 0.2], [0.5, 0.3, 0.4], [0.1, 0.6, 0.3]]
    file = write(tmp_path_factory.mktemp("paths") / "points.csv", "t,x,y,z", t, points)
    return scene_of(ARM, f"motion.file={file}", "motion.initial_joints=[0, 0.8, -1]")


def test_yaw_pitch_pitch(bent):
    """Against the closed form, and rates against differences; at rest at both ends."""
    t = np.linspace(0.0, 0.6, 41)
    q = rigid_motion(t, bent).q
    x, y, z = target_of(t, bent).place[0].T
    r = np.hypot(x, y)
    elbow = -np.arccos((r**2 + z**2 - L1**2 - L2**2) / (2.0 * L1 * L2))
    shoulder = np.arctan2(z, r) - np.arctan2(L2 * np.sin(elbow), L1 + L2 * np.cos(elbow))
    assert np.abs(q - np.stack([np.arctan2(y, x), shoulder, elbow], axis=1)).max() < EXACT
    inner = np.linspace(0.01, 0.59, 23)
    motion = rigid_motion(inner, bent)
    assert np.abs(differences(bent, inner, "q") - motion.qd).max() < 1e-7
    assert np.abs(differences(bent, inner, "qd") - motion.qdd).max() < 1e-6
    ends = rigid_motion(np.array([0.0, 0.6, 0.7]), bent)
    assert np.abs(ends.qd).max() < EXACT and np.abs(ends.qdd[2]).max() < EXACT
    one = rigid_motion(inner[5:6], bent)
    assert np.abs(one.q - motion.q[5:6]).max() < 1e-14  # whichever instants are asked for


def test_other_solution_by_the_guess(bent):
    """The elbow on the other side; whole turns as near as the guess."""
    guess = "motion.initial_joints=[6.2, -0.3, 1]"
    other = scene_of(ARM, f"motion.file={bent.motion.file}", guess)
    a, b = (rigid_motion(np.array([0.3]), scene).q[0] for scene in (bent, other))
    assert b[0] == pytest.approx(a[0] + 2.0 * np.pi, abs=EXACT)
    assert b[2] == pytest.approx(-a[2], abs=EXACT)


def test_line_by_a_law():
    """Along a line by the law, with its limits; steps end where its phases do."""
    data = tomllib.loads(Path(ARM).read_text())
    data["motion"] = {
        "path": "line", "start": [0.6, 0.0, 0.2], "end": [0.3, 0.4, 0.3], "law": "trapezoidal",
        "max_speed": 1.0, "max_acceleration": 5.0, "horizon": 1.0, "initial_joints": [0, 0.8, -1],
    }  # fmt: skip
    scene = scene_from_dict(data, ARM)
    length = np.linalg.norm([0.3, 0.4, 0.1])
    assert scene.motion.duration == pytest.approx(length / 1.0 + 1.0 / 5.0)
    t = np.linspace(0.0, scene.motion.duration, 9)
    found = end_of(scene, rigid_motion(t, scene).q)[0]
    along = (found - scene.motion.start) @ (np.array([-0.3, 0.4, 0.1]) / length)
    assert np.abs(np.linalg.norm(found - scene.motion.start, axis=1) - along).max() < EXACT
    assert breakpoints(scene)[1:3] == pytest.approx((0.2, scene.motion.duration - 0.2))
    data["motion"]["rpy"] = [0.0, 0.0, 0.0]
    with refused("cannot be at", "rad off"):
        check_motion(scene_from_dict(data, ARM))


JOINTS = np.array([0.3, -1.2, 1.5, -0.8, -1.4, 0.2])
TURNED = np.array([0.8, 0.4, -0.5, 0.3, 0.3, -0.6])


@pytest.mark.parametrize("kind", ["roll,pitch,yaw", "rx,ry,rz"])
def test_six_axes(kind, tmp_path):
    """Poses of a robot with an offset wrist: forward of inverse, and the joints they were of."""
    t = np.linspace(0.0, 1.8, 5)
    q = JOINTS + ((t / 1.8) ** 2 * (3.0 - 2.0 * t / 1.8))[:, None] * TURNED
    place, R = end_of(read_scene(ROBOT), q)
    turned = Rotation.from_matrix(R)
    rows = turned.as_euler("xyz") if kind == "roll,pitch,yaw" else turned.as_rotvec()
    file = write(tmp_path / "poses.csv", f"t,x,y,z,{kind}", t, place, rows)
    guess = f"motion.initial_joints={(JOINTS + 0.1).tolist()}"
    scene = scene_of(ROBOT, f"motion.file={file}", guess)
    assert np.abs(rigid_motion(t, scene).q - q).max() < EXACT
    between = np.linspace(0.01, 1.79, 37)
    motion, target = rigid_motion(between, scene), target_of(between, scene)
    place, R = end_of(scene, motion.q)
    assert np.abs(place - target.place[0]).max() < EXACT
    assert np.abs(R - target.turning[0]).max() < EXACT
    assert np.abs(differences(scene, between, "q") - motion.qd).max() < 1e-8
    assert np.abs(differences(scene, between, "qd") - motion.qdd).max() < 1e-7


def test_joints_of_the_table(tmp_path):
    """Columns of joints are prescribed; two others follow a path in the plane that is left."""
    yaw = 0.3 + np.array([0.0, 0.0, 0.0])
    points = np.outer([0.6, 0.5, 0.3], [np.cos(0.3), np.sin(0.3), 0.0])
    points[:, 2] = [0.1, 0.2, 0.4]
    file = write(tmp_path / "a.csv", "t,x,y,z,yaw", [0.0, 0.2, 0.4], points, yaw)
    end = "motion.horizon=0.4"
    scene = scene_of(ARM, f"motion.file={file}", end, "motion.initial_joints=[9, 0.8, -1]")
    free = write(tmp_path / "b.csv", "t,x,y,z", [0.0, 0.2, 0.4], points)
    other = scene_of(ARM, f"motion.file={free}", end, "motion.initial_joints=[0, 0.8, -1]")
    t = np.linspace(0.0, 0.4, 11)
    a, b = (rigid_motion(t, one) for one in (scene, other))
    for key in ("q", "qd", "qdd"):
        assert getattr(a, key) == pytest.approx(getattr(b, key), abs=EXACT)
    # With another yaw the point leaves the plane of the two.
    write(tmp_path / "a.csv", "t,x,y,z,yaw", [0.0, 0.2, 0.4], points, [0.3, 0.4, 0.3])
    with refused("(shoulder, elbow)", "m off at best"):
        rigid_motion(t, scene)


def test_rotation_vectors_go_on():
    """Beyond half a turn and past a whole one."""
    angles = np.linspace(0.0, 60.0, 61)
    turns = Rotation.from_rotvec([0.3, -0.2, 0.5]) * Rotation.from_rotvec(
        angles[:, None] * [0.0, 0.6, 0.8]
    )
    R = turns.as_matrix()
    assert np.abs(relative_vectors(R) - angles[:, None] * [0.0, 0.6, 0.8]).max() < 1e-12


UP = [[0.6, 0, 0.2], [0.5, 0, 0.2]]
LOW = [[0.5, 0, 0], [0.4, 0, 0.3]]
REFUSED = [
    (ARM, "x,y,z", [[0.6, 0, 0.2], [2.0, 0, 0.2]], "", ("at t = ", "off at best")),
    (ARM, "x,y,z", [[2.6, 0, 0.2], [0.6, 0, 0.2]], "", ("at t = 0 s", "motion.initial_joints")),
    (ARM, "x,y,z", [[0.5, 0, 0.2], [-0.5, 0, 0.2]], "", ("singular",)),
    (ARM, "x,y", [[0.6, 0], [0.5, 0]], "", ("path.csv", "missing column 'z'")),
    (ROBOT, "x,y,z,roll", np.pad(UP, ((0, 0), (0, 1))), "", ("missing column 'pitch'",)),
    (ARM, "x,y,z,wrist", np.pad(UP, ((0, 0), (0, 1))), "", ("unknown column 'wrist'",)),
    (ARM, "x,y,z,yaw,shoulder,elbow", np.pad(UP, ((0, 0), (0, 3))), "", ("cannot be at",)),
    (
        ROBOT,
        "x,y,z",
        UP,
        "",
        ("leave 3 of the joints", "prescribe 3", "or rx, ry, rz"),
    ),
    (ARM, "x,y,z", LOW, "payload.arm=link1", ("undetermined (elbow); prescribe 1",)),
]


@pytest.mark.parametrize(("demo", "names", "rows", "change", "words"), REFUSED)
def test_refusals(demo, names, rows, change, words, tmp_path):
    file = write(tmp_path / "path.csv", names, np.asarray(rows, dtype=float))
    end = "motion.duration=0.5", "motion.horizon=0.5"
    changes = [one for one in (f"motion.file={file}", *end, change) if one]
    with refused(*words):
        check_motion(scene_of(demo, *changes))
