"""Robots from URDF: drive forces against Pinocchio's; solids."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from robots import DEMO, DEMO_MOTION, mechanism_of, run_import, tree_of, write_uneven
from runs import run

from dolfinopt.arms.arm import build_arms, uniform_design
from dolfinopt.exchange.urdf import robot as urdf
from dolfinopt.exchange.urdf.file import read_robot
from dolfinopt.exchange.urdf.geometry import NoSolid, cells_between_joints
from dolfinopt.exchange.urdf.robot import scene_bodies
from dolfinopt.exchange.urdf.scene import cells_of, scene_names
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.mesh.checks import check_cells
from dolfinopt.mesh.solid_cells import TENSOR
from dolfinopt.multibody.kinematics import end_effector
from dolfinopt.multibody.newton_euler import inverse_dynamics
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import read_scene

trimesh = pytest.importorskip("trimesh")
yourdfpy = pytest.importorskip("yourdfpy")
pytestmark = pytest.mark.serial
MOVED = 12  # random joint coordinates


@pytest.fixture
def rigid(imported):
    """The robot, its bodies, and the scene's mechanism with the solids as rigid as in the file."""
    file, scene, links = imported
    robot = read_robot(file)
    bodies = scene_bodies(robot, links, urdf.default_tool(robot, links))
    names = scene_names(body.link for body in bodies)
    own = {names[body.link]: body.inertia for body in bodies if body.is_solid}
    solids = {name: (one.mass, one.centre, one.moments)
              for name, one in own.items()}  # fmt: skip
    assert [arm["name"] for arm in tree_of(scene)["arms"]] == list(names.values())
    return robot, bodies, mechanism_of(scene, solids)


def random_joints(robot, rng):
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


def test_drive_forces_against_pinocchio(imported, rigid):
    pin = pytest.importorskip("pinocchio")
    robot, _, mechanism = rigid
    model = pin.buildModelFromUrdf(str(imported[0]))
    assert np.array_equal(model.gravity.linear, mechanism.gravity)
    data = model.createData()
    order = [model.getJointId(joint.name) for joint in robot.movable]
    rng = np.random.default_rng(3)
    q, qd, qdd = (random_joints(robot, rng) for _ in range(3))
    rows = [in_scene(robot, mechanism, one) for one in (q, qd, qdd)]
    none = np.zeros((MOVED, 0))
    found = inverse_dynamics(mechanism, RigidMotion(*rows), none, none, none)[1]
    names = [mechanism.joints[i].name for i in mechanism.movable]
    for k in range(MOVED):
        x, v, a = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        for joint, index in zip(robot.movable, order, strict=True):
            one = model.joints[index]
            value = q[joint.name][k]
            place = [np.cos(value), np.sin(value)] if one.nq == 2 else [value]
            x[one.idx_q : one.idx_q + one.nq] = place
            v[one.idx_v], a[one.idx_v] = qd[joint.name][k], qdd[joint.name][k]
        forces = pin.rnea(model, data, x, v, a)
        for joint, index in zip(robot.movable, order, strict=True):
            column = names.index(scene_names([joint.name])[joint.name])
            expected = forces[model.joints[index].idx_v]
            assert found[k, column] == pytest.approx(expected, abs=1e-10)


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


def test_the_end_effector_is_the_last_arm(tmp_path):
    """The tool's body, or one at its interface where others hang on it."""
    file = write_uneven(tmp_path)
    motion = tmp_path / "motion.csv"
    motion.write_text("t,yaw\n0,0\n1,1\n")
    words = ("import", file, motion, "upper", "--boxes", "--tool")
    for tool, last in (("left", "left"), ("lower", "lower_end")):
        run(*words, tool, "--out", tmp_path / tool)
        scene = read_scene(tmp_path / tool / "uneven.toml")
        assert scene.arms[-1].name == last
        robot = yourdfpy.URDF.load(str(file), load_meshes=False)
        robot.update_cfg({joint.name: 0.3 for joint in read_robot(file).movable})
        row = np.array([[0.3] * len(scene.driven)])
        some = {"upper": (1, (0, 0, 0), [1] * 6)}
        mechanism = mechanism_of(tmp_path / tool / "uneven.toml", some)
        end = end_effector(mechanism, RigidMotion(row, 0 * row, 0 * row), np.zeros((1, 0)))[0]
        assert np.abs(end - robot.get_transform(tool)[:3, 3]).max() < 1e-12


def test_a_links_geometry_becomes_the_solid(tmp_path, capsys):
    """Cut at the joints and meshed, off centre and a little short, too; else a box and a reason."""
    text = DEMO.read_text()
    rod = '<geometry><cylinder radius="0.07" length="1.0"/></geometry>'
    assert rod in text  # the upper arm's, which is to be too short
    text = text.replace(rod, rod.replace("1.0", "0.8"))
    wrist = '<link name="wrist_1">'
    assert wrist in text
    ball = '<geometry><sphere radius="0.09"/></geometry>'
    away = f'<collision><origin xyz="0 0.7 0.17"/>{ball}</collision>'
    file = tmp_path / "robot.urdf"
    file.write_text(text.replace(wrist, wrist + away))
    links = "upper_arm,forearm,wrist_1"
    run("import", file, DEMO_MOTION, links, "--out", tmp_path / "a")
    said = capsys.readouterr()
    for words in (
        r"forearm: solid, 0.729 x 0.11\d* x 0.11\d* m, its shape, \d{4} cells",
        r"upper_arm: solid, 0.862 x 0.1\d+ x 0.1\d+ m, its shape, \d{4}",
        r"upper_arm: ends 0.0569 m before the inboard joint[;,] ends 0.0569 m before the out",
        r"wrist_1: solid, .* m, a box to edit; starts at",
    ):
        assert re.search(words, said.out)
    assert "link 'wrist_1' becomes a box: its geometry is " in said.err
    scene = read_scene(tmp_path / "a" / "robot.toml")
    arms = {arm.name: (k, arm) for k, arm in enumerate(scene.arms)}
    fore, upper = (arm_mesh(MPI.COMM_SELF, arms[name][1]) for name in ("forearm", "upper_arm"))
    assert fore.area.sum() == pytest.approx(np.pi * 0.055**2 * 0.7287, rel=0.02)
    assert upper.area.sum() == pytest.approx(np.pi * 0.07**2 * (0.862 - 2 * 0.0569), rel=0.02)
    assert 5000 < fore.num_cells < 8000
    # The median edge, what the filter's radius is compared with: about a mean cube's side.
    _, arm = arms["forearm"]
    side = arm.cell_size or fore.cell_size
    assert side == pytest.approx((fore.area.sum() / fore.num_cells) ** (1 / 3), rel=0.05)
    assert scene.design.radius >= 2.0 * side * (1.0 - 1e-9)
    # One layer of cells stays solid at both ends.
    assert 0.01 < fore.area[fore.passive].sum() / fore.area.sum() < 0.05


def test_the_start_weighs_what_the_file_says(tmp_path):
    """Boxes as they are written, their ends solid and the design filtered."""
    run_import(DEMO, "upper_arm,forearm", DEMO_MOTION, tmp_path / "a")
    scene = read_scene(tmp_path / "a" / "robot.toml")
    partition = partition_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = build_arms(scene, partition, Profile())
    start = uniform_design(scene, partition, arms, scene.design.initial)
    found = sum(scene.material_of(k).density * arm.mesh.area @ start[k] for k, arm in arms.items())
    robot = read_robot(DEMO)
    expected = sum(robot.links[name].inertia.mass for name in ("upper_arm", "forearm"))
    assert found == pytest.approx(expected, rel=0.01)  # of the filter's ends
    fractions = [arm.volume_fraction(start[k]) for k, arm in arms.items()]
    assert np.mean(fractions) == pytest.approx(scene.design.volume_fraction, rel=0.01)


SIDES = (0.5, 0.1, 0.08)
SPAN = SimpleNamespace(frame=np.eye(4), length=0.4)  # joints at x = 0 and 0.4 m
BETWEEN = 0.4 * 0.1 * 0.08


def bar(sides=SIDES, at=(0.2, 0.0, 0.0)):
    found = trimesh.creation.box(extents=sides)
    found.apply_translation(at)
    return found


def inverted(found):
    found.invert()
    return found


def without_a_lid():
    found = bar()
    found.update_faces(found.face_normals[:, 2] < 0.5)
    return [found]


def in_shards():
    """Every triangle apart from its neighbours, as in drawings for screens."""
    whole = bar().subdivide_to_size(0.03)
    corners = whole.triangles
    middle = corners.mean(axis=1, keepdims=True)
    points = (middle + 0.97 * (corners - middle)).reshape(-1, 3)
    return [trimesh.Trimesh(points, np.arange(len(points)).reshape(-1, 3), process=False)]


def one_file(*pieces):
    return [trimesh.util.concatenate(pieces)]


@pytest.mark.parametrize(
    ("shapes", "volume", "done"),
    [
        (lambda: [bar()], BETWEEN, ()),
        (lambda: [inverted(bar())], BETWEEN, ("1 piece inside out turned",)),
        (without_a_lid, BETWEEN, ("holes of 1 piece closed",)),
        (lambda: one_file(bar(at=(0.15, 0, 0)), bar(at=(0.25, 0, 0))), BETWEEN,
         ("2 pieces united",)),
        (lambda: [bar(at=(0.15, 0, 0)), bar(at=(0.25, 0, 0))], BETWEEN, ("2 pieces united",)),
        (lambda: one_file(bar(), inverted(bar((0.3, 0.06, 0.04)))),  # hollow
         BETWEEN - 0.3 * 0.06 * 0.04, ()),
        (in_shards, BETWEEN, ("wide holes filled",)),
        (lambda: [bar(), bar((0.5, 0.02, 0.02), (0.2, 0.0, 0.2))], BETWEEN,
         ("2 pieces united", "the largest part kept, 9")),
        (lambda: [bar(at=(0.2, 0.07, 0.0))], BETWEEN, ()),
        (lambda: [bar((0.45, 0.1, 0.08), (0.255, 0, 0))], 0.895 * BETWEEN, ("ends 0.042 m bef",)),
        (lambda: [bar((0.9, 0.1, 0.08))], None, ("not cut at the joints",)),
    ],
)  # fmt: skip
def test_geometry_is_mended(shapes, volume, done):
    """Closed, open, turned inwards, in parts, off centre, too short, and an elbow."""
    found = cells_between_joints(shapes(), SPAN)
    for one in done:
        assert any(one in word for word in found.done), found.done
    assert done or found.done == ()
    check_cells(found.points, found.cells[:, TENSOR[8, 3]])
    assert 1500 < len(found.cells) < 20000
    if volume is not None:  # but for corners, and voxels of open surfaces
        assert found.volume == pytest.approx(volume, rel=0.03 if "fill" in str(done) else 0.01)
        for facets in (found.inboard, found.outboard):
            assert np.ptp(found.points[facets][..., 0]) < 1e-12
    else:
        assert found.volume == pytest.approx(0.9 * 0.1 * 0.08, rel=0.01)
        assert not np.intersect1d(found.inboard, found.outboard).size
    assert found.offset(0.4) < 0.25


FLAT = [[0, 0, 0], [0.4, 0, 0], [0.4, 0.01, 0], [0.4, 0, 0.01]]


@pytest.mark.parametrize(
    ("shapes", "words"),
    [
        (lambda: [], "no geometry"),
        # But for a place too thin to be filled.
        (lambda: [trimesh.Trimesh(FLAT, [[0, 1, 2], [0, 1, 3]])], "encloses nothing"),
        (lambda: [bar(at=(0.2, 0.0, 2.0))], "1.9"),
    ],
)
def test_geometry_that_is_no_solid(shapes, words):
    with pytest.raises(NoSolid, match=words):
        cells_between_joints(shapes(), SPAN)


def test_walls_thinner_than_cells_are_told():
    """A box with walls of 4 mm; solid ones have none."""
    inside = inverted(bar((0.412, 0.092, 0.072)))
    found = cells_between_joints(one_file(bar((0.42, 0.1, 0.08)), inside), SPAN)
    assert found.side > 0.004
    assert "walls, about 4 mm" in found.done[-1] and "arms.hollow" in found.done[-1]


def test_visual_geometry_where_the_collision_one_is_no_solid(tmp_path, capsys):
    """A mesh in mm, turned inwards, found in its package."""
    folder = tmp_path / "ws" / "my_robot" / "meshes"
    folder.mkdir(parents=True)
    visual = trimesh.creation.cylinder(radius=55.0, height=840.0, sections=24)
    visual.invert()
    visual.export(folder / "rod.stl")
    shape = '<geometry><cylinder radius="0.055" length="0.84"/></geometry>'
    text = DEMO.read_text()
    start = text.index("<collision>", text.index('<link name="forearm">'))
    end = text.index("</collision>", start) + len("</collision>")
    own = text[start:end]
    assert shape in own
    name = "package://my_robot/meshes/rod.stl"
    mesh = f'<geometry><mesh filename="{name}" scale="0.001 0.001 0.001"/></geometry>'
    away = '<origin xyz="3 0 0.06"/><geometry><sphere radius="0.1"/></geometry>'
    new = own.replace(shape, mesh).replace("collision>", "visual>")
    new += f"<collision>{away}</collision>"
    file = tmp_path / "robot.urdf"
    file.write_text(text[:start] + new + text[end:])
    run("import", file, DEMO_MOTION, "forearm", "--out",
        tmp_path / "a", "--package-path", tmp_path / "ws")  # fmt: skip
    said = capsys.readouterr()
    assert "forearm: visual geometry; 1 piece inside out turned" in said.out
    assert "forearm: solid, 0.729 x 0.1" in said.out
