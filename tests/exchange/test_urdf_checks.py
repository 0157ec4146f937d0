"""The import of robots: what it says, refuses and finds doubtful."""

import re
import signal
import sys

import numpy as np
import pytest
from robots import DEMO, DEMO_MOTION, run_import, tree_of, write_uneven
from runs import ROOT, refusal, run

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.file import implausible_inertias, read_robot
from dolfinopt.exchange.urdf.robot import scene_bodies
from dolfinopt.scene.load import read_scene

trimesh = pytest.importorskip("trimesh")
pytestmark = pytest.mark.serial


def test_import_says_what_it_made(tmp_path, capsys):
    run_import(DEMO, "forearm", DEMO_MOTION, tmp_path / "a")
    said = capsys.readouterr()
    assert "6 joints that move" in said.out and "forearm: solid, 0.729 x 0.11 x 0.11 m" in said.out
    assert said.err == ""  # nothing is wrong with this robot
    tree = tree_of(tmp_path / "a" / "robot.toml")
    assert [arm["name"] for arm in tree["arms"] if not arm.get("rigid")] == ["forearm"]
    assert tree["arms"][-1]["name"] == "tool" and tree["motion"]["file"] == "trajectory.csv"
    scene = read_scene(tmp_path / "a" / "robot.toml")
    columns = DEMO_MOTION.read_text().splitlines()[1].replace(" ", "").split(",")
    assert scene.is_spatial and scene.driven == tuple(columns[1:])
    assert "7.879 kg" in (tmp_path / "a" / "robot.toml").read_text()
    before = (tmp_path / "a" / "robot.toml").read_bytes()
    refusal(lambda: run_import(DEMO, "upper_arm", DEMO_MOTION, tmp_path / "a"), "--overwrite")
    assert (tmp_path / "a" / "robot.toml").read_bytes() == before
    # With --overwrite the import is replaced, and a scene that was edited is kept beside it.
    run_import(DEMO, "forearm", DEMO_MOTION, tmp_path / "a", "--overwrite")
    assert not (tmp_path / "a" / "robot.1.toml").exists()
    (tmp_path / "a" / "robot.toml").write_bytes(before + b"# mine\n")
    run_import(DEMO, "forearm", DEMO_MOTION, tmp_path / "a", "--overwrite")
    assert (tmp_path / "a" / "robot.toml").read_bytes() == before
    assert (tmp_path / "a" / "robot.1.toml").read_bytes() == before + b"# mine\n"


def test_a_joint_that_follows_and_those_not_named_have_columns(tmp_path, capsys):
    file, motion = write_uneven(tmp_path), tmp_path / "motion.csv"
    motion.write_text("t,finger,yaw\n0,0.01,0\n1,0.03,2\n")
    run_import(file, "upper", motion, tmp_path / "a")
    rows = np.genfromtxt(tmp_path / "a" / "trajectory.csv", delimiter=",", names=True)
    assert {*rows.dtype.names} == {*"t yaw lift rail bend roll finger other".split()}
    assert rows["other"] == pytest.approx(0.005 - rows["finger"], abs=1e-15)
    assert not rows["lift"].any()
    assert "stand still: lift = 0, " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("shoulder_pan,elbow\n0,0\n1,1\n", ["column t"]),
        ("t,shoulder\n0,0\n1,1\n", ["column 'shoulder'", "t"]),
        ("t,flange\n0,0\n1,1\n", ["this joint is fixed"]),
        ("t,elbow\n0,0\n1,1\n1,2\n", ["line 4, column t = 1", "more than 1"]),
        ("t,elbow\n0,0\n1,45\n", ["line 3, joint elbow = 45", "-3.1416", "degrees?"]),
        ("t,elbow\n0,0\n1,3.2\n", ["line 3, joint elbow = 3.2", "[rad]", "limits"]),
    ],
)
def test_trajectories_that_cannot_be_followed(tmp_path, table, words):
    motion = tmp_path / "motion.csv"
    motion.write_text(table)
    refusal(lambda: run_import(DEMO, "forearm", motion, tmp_path / "a"), *words)
    assert not (tmp_path / "a").exists()


def test_a_motion_that_is_too_fast_is_told(tmp_path, capsys):
    """A quintic from rest to rest peaks at 15/8 of its mean speed."""
    motion = tmp_path / "motion.csv"
    motion.write_text("t,elbow\n0,0\n1,1.5\n")
    run_import(DEMO, "forearm", motion, tmp_path / "a")
    said = capsys.readouterr().err
    assert "elbow" in said and "2.812 rad/s" in said and "2.618" in said


@pytest.mark.parametrize(
    ("links", "words"),
    [
        ("fore_arm", ["'fore_arm'", "forearm?"]),
        ("base", ["'base'", "ground"]),
        ("tool", ["'tool'", "nothing hangs on it"]),
        ("forearm,forearm", ["twice"]),
        (",", ["a table and links"]),
    ],
)
def test_links_that_cannot_be_solids(tmp_path, links, words):
    refusal(lambda: run_import(DEMO, links, DEMO_MOTION, tmp_path / "a"), *words)
    assert not (tmp_path / "a").exists()


def test_ctrl_c_ends_the_import_before_it_writes(tmp_path, monkeypatch):
    """Libraries that swallow KeyboardInterrupt never see one; afterwards all is as before."""
    handlers = [signal.default_int_handler]
    monkeypatch.setattr(
        "dolfinopt.cli.robots.read_robot",
        lambda *of: handlers.append(signal.getsignal(signal.SIGINT)) or read_robot(*of),
    )
    before = signal.signal(signal.SIGINT, handlers[0])
    try:
        run_import(DEMO, "forearm", DEMO_MOTION, tmp_path / "a")
        assert handlers[1] not in handlers[:1] and signal.getsignal(signal.SIGINT) is handlers[0]
    finally:
        signal.signal(signal.SIGINT, before)


A, AB = '<link name="a"/>', '<link name="a"/><link name="b"/>'


def joint(kind, parent, child, inside="", name="j"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<limit lower="0" upper="1" effort="1" velocity="1"/>{inside}</joint>'
    )


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        ("", ["no links"]),
        (A + A, ["link 'a'", "2 times"]),
        (AB, ["2 links that no joint holds"]),
        (A + joint("revolute", "a", "b"), ["no link 'b'"]),
        (AB + joint("floating", "a", "b"), ["'j'", "'floating'", "revolute, continuous"]),
        (AB + joint("planar", "a", "b"), ["'planar'"]),
        (AB + joint("revolute", "a", "b", '<axis xyz="0 0 0"/>'), ["not all zero"]),
        (AB + joint("revolute", "a", "b", '<mimic joint="k"/>'), ["'k'", "a joint that moves"]),
        (AB + joint("revolute", "a", "b", '<dynamics damping="-1"/>'), ["'j'", "damping", "-1"]),
        (AB + '<link name="c"/>' + joint("fixed", "b", "c") + joint("fixed", "c", "b", name="k"),
         ["loop"]),
        ("<link/>", ["a link without a name"]),
        (AB + joint("revolute", "a", "b", '<origin xyz="nan 0 0"/>'), ["'j'", "origin", "nan"]),
        ('<link name="a"><visual><geometry><box size="-1 1 1"/></geometry></visual></link>',
         ["'a'", "size of a box", "positive", "-1, 1, 1"]),
    ],
)  # fmt: skip
def test_robots_that_a_scene_cannot_hold(tmp_path, inside, words):
    file = tmp_path / "r.urdf"
    file.write_text(f'<robot name="r">{inside}</robot>')
    refusal(lambda: read_robot(file), str(file), *words)


def test_meshes_that_are_none(tmp_path):
    """Told, and in their place a guess: no name, no volume."""
    (tmp_path / "flat.stl").write_text(
        "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 0 1\n"
        "endloop\nendfacet\nendsolid a\n"
    )
    shape = '<geometry><cylinder radius="0.055" length="0.84"/></geometry>'
    assert shape in DEMO.read_text()
    for name, message in (("", "mesh without a name"), (' filename="flat.stl"', "kg in 0 m3")):
        file = tmp_path / "r.urdf"
        file.write_text(DEMO.read_text().replace(shape, f"<geometry><mesh{name}/></geometry>"))
        robot = read_robot(file)
        assert any(message in one for one in implausible_inertias(robot))
        (forearm,) = (one for one in scene_bodies(robot, ("forearm",), "tool") if one.is_solid)
        assert not forearm.measured and forearm.size == pytest.approx([0.07287] * 2)


ENTITIES = """<!DOCTYPE robot [<!ENTITY other SYSTEM "file:///etc/hostname">]>
<robot name="a"><link name="b">&other;</link></robot>"""


XACRO = (
    '<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="b">\n'
    '<xacro:include filename="c"/></link></robot>'
)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("r.urdf", None, ["r.urdf", "cannot be read"]),
        ("r.urdf", "<robot", ["XML"]),
        ("r.urdf", "<sdf/>", ["<robot name"]),
        ("r.urdf", ENTITIES, ["XML entities"]),
        ("r.urdf", XACRO, ["line 2", "xacro, include", "xacro r.urdf > r-plain.urdf"]),
        # `xacro panda.urdf > panda.urdf` would leave an empty file.
        ("panda.urdf.xacro", XACRO, ["xacro panda.urdf.xacro > panda.urdf"]),
        ("panda.xacro", XACRO, ["xacro panda.xacro > panda.urdf"]),
    ],
)
def test_files_that_are_no_robots(tmp_path, name, text, words):
    file = tmp_path / name
    if text is not None:
        file.write_text(text)
    refusal(lambda: read_robot(file), *words)


def test_without_the_extra_one_line_says_what_to_install(monkeypatch):
    """The launcher installs it: whatever it sets up has an extra with trimesh."""
    monkeypatch.setitem(sys.modules, "trimesh", None)
    refusal(lambda: read_robot(DEMO), "packages", f"{sys.executable} -m pip install 'trimesh")
    projects = re.findall(r'ensure ready\S* "(.*)"', (ROOT / "dolfinopt.sh").read_text())
    extras = tree_of(ROOT / "pyproject.toml")["project"]["optional-dependencies"]
    assert len(projects) == 4 and any("trimesh" in one for one in extras["robots"])
    assert any("[docs,outside,robots]" in one for one in extras["dev"])
    kinds = {one.removeprefix("${here}") for one in projects}
    assert kinds == {"[robots]", "[robots,docs]", "[dev]"}


def test_the_name_space_that_xacro_leaves_behind_is_no_xacro(tmp_path):
    file = tmp_path / "r.urdf"
    head = '<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    file.write_text(f'{head}<!-- <xacro:include/> --><link name="b"/></robot>')
    assert list(read_robot(file).links) == ["b"]
    file.write_text('<robot><link name="b"/></robot>')
    assert read_robot(file).name == "r"  # its file's, where it has none
    line = ["import", DEMO, DEMO_MOTION, "forearm"]
    refusal(lambda: run(*line, "--package-path", tmp_path / "none"), "--package-path", "none")


@pytest.mark.parametrize("how", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", "above", "link"])
def test_meshes_are_found_in_their_package(tmp_path, monkeypatch, how):
    """package://arm/meshes/a.stl; a package of the same name without the mesh is passed over."""
    for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    package = tmp_path / "there" / ("share/arm" if how.startswith("AMENT") else "arm")
    (package / "meshes").mkdir(parents=True)
    (tmp_path / "empty" / "arm").mkdir(parents=True)
    trimesh.creation.box().export(package / "meshes" / "a.stl")
    mesh = '<visual><geometry><mesh filename="package://arm/meshes/a.stl"/></geometry></visual>'
    text = f'<robot name="r"><link name="b">{mesh}</link></robot>'
    here = tmp_path / "here"
    here.mkdir()
    file = here / "r.urdf"
    if how in ("above", "link"):
        file = package / "urdf" / "r.urdf"
        file.parent.mkdir()
    else:
        monkeypatch.setenv(how, f"{tmp_path / 'empty'}:{tmp_path / 'there'}")
    file.write_text(text)
    if how == "link":
        (here / "r.urdf").symlink_to(file)
        file = here / "r.urdf"
    link = read_robot(file).links["b"]
    assert not link.missing and link.volume == pytest.approx(1.0)
    if how == "ROS_PACKAGE_PATH":
        monkeypatch.delenv(how)
        assert read_robot(file).links["b"].missing == ["mesh package://arm/meshes/a.stl not found"]


def test_a_mesh_whose_name_differs_by_capitals_is_named(tmp_path):
    mesh = '<collision><geometry><mesh filename="meshes/Arm.STL"/></geometry></collision>'
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "arm.stl").write_bytes(b"")
    file = tmp_path / "r.urdf"
    file.write_text(f'<robot name="r"><link name="a">{mesh}</link></robot>')
    assert read_robot(file).links["a"].missing == [
        "mesh meshes/Arm.STL not found; there is arm.stl"
    ]


def test_a_loop_is_told_where_to_stand(tmp_path):
    joints = "".join(
        f'<joint name="{parent}{child}" type="revolute"><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 0 1"/><limit effort="1" velocity="1"/></joint>'
        for parent, child in ("ab", "ac", "bc")
    )
    file = tmp_path / "r.urdf"
    links = "".join(f'<link name="{name}"/>' for name in "abc")
    file.write_text(f'<robot name="r">{links}{joints}</robot>')
    with pytest.raises(InputError, match=r"held by 2 joints.*--closures"):
        read_robot(file)


def test_limits_and_friction_come_into_the_scene(tmp_path):
    """No limit where the file says none, or zero."""
    text = DEMO.read_text()
    old = '<limit lower="-3.1416" upper="3.1416" effort="430" velocity="2.618"/>'
    assert text.count(old) == 1
    new = '<limit lower="-3.1416" upper="3.1416" effort="0" velocity="0"/>'
    new += '<dynamics damping="0.4" friction="0.1"/>'
    (tmp_path / "r.urdf").write_text(text.replace(old, new, 1))
    run_import(tmp_path / "r.urdf", "forearm", DEMO_MOTION, tmp_path / "a")
    robot, scene = read_robot(DEMO), read_scene(tmp_path / "a" / "r.toml")
    joints = {joint.name: joint for joint in robot.movable}
    none = [one.name for one in scene.movable if one.effort_limit is None]
    assert len(none) == 1
    for one in scene.movable:
        joint = joints[one.name]
        assert one.position_limits == (joint.lower, joint.upper)
        if one.name in none:
            assert one.velocity_limit is None and one.friction == (0.4, 0.1)
        else:
            assert (one.velocity_limit, one.effort_limit) == (joint.velocity, joint.effort)
            assert one.friction is None


TENSOR = 'ixx="0.0261" ixy="-0.0001" ixz="-0.029" iyy="0.7576" iyz="0" izz="0.7533"'


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('iyy="0.7576"', 'iyy="-0.7576"', "none can be negative"),
        ('iyy="0.7576"', 'iyy="1.7576"', "exceed the sum of the two others"),
        ('<mass value="7.879"/>', '<mass value="0"/>', "no mass"),
        ('<mass value="7.879"/>', '<mass value="7879"/>', "100 to 20000"),
        ('xyz="-0.4053 0 0.0604"', 'xyz="-405.3 0 60.4"', "outside its geometry"),
        (TENSOR, 'ixx="26.1" ixy="-0.1" ixz="-29" iyy="757.6" iyz="0" izz="753.3"', "too large"),
        (TENSOR, 'ixx="1e-6" ixy="0" ixz="0" iyy="1e-6" iyz="0" izz="1e-6"', "too small"),
        ('<geometry><cylinder radius="0.055" length="0.84"/></geometry>',
         '<geometry><mesh filename="package://robot/forearm.stl"/></geometry>',
         "package://robot/forearm.stl"),
    ],
)  # fmt: skip
def test_inertias_that_cannot_be_are_told(tmp_path, old, new, words):
    text = DEMO.read_text()
    assert old in text and implausible_inertias(read_robot(DEMO)) == []
    file = tmp_path / "wrong.urdf"
    file.write_text(text.replace(old, new, 1))
    found = implausible_inertias(read_robot(file))
    assert any(words in one for one in found), found
    assert all("'forearm'" in one and "\n" not in one for one in found)


def test_an_inertia_that_no_body_has_is_to_be_corrected(tmp_path, capsys):
    """The scene is written, and says itself what is wrong with it."""
    file = tmp_path / "robot.urdf"
    file.write_text(DEMO.read_text().replace('izz="0.0012"', 'izz="0.012"'))
    run_import(file, "forearm", DEMO_MOTION, tmp_path / "a")
    said = capsys.readouterr().err
    assert "'wrist_3'" in said and "correct the scene" in said
    refusal(lambda: read_scene(tmp_path / "a" / "robot.toml"), "inertia (wrist_3)")
