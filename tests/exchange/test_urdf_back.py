"""Robots written back as URDF."""

import json

import numpy as np
import pandas as pd
import pytest
from pages import Reader
from robots import DEMO, DEMO_MOTION, run_import, tree_of, write_uneven
from runs import ROOT, refusal, run, summary_of

from dolfinopt.cli.export import _check_robot
from dolfinopt.exchange.urdf.file import NewLink, implausible_inertias, read_robot, robot_text
from dolfinopt.exchange.urdf.robot import Inertia, default_tool, scene_bodies
from dolfinopt.exchange.urdf.scene import read_origin
from dolfinopt.plots.style import new_figure
from dolfinopt.scene.schema import file_digest
from dolfinopt.study.before_after import before_after

trimesh = pytest.importorskip("trimesh")
pytestmark = pytest.mark.serial
LINK = ROOT / "demos" / "robot_link.toml"


def same_kinematics(one, other):
    """Return whether all joints are alike, to the last bit."""
    told = ("name", "kind", "parent", "child", "lower", "upper", "velocity", "effort")
    return all(
        all(getattr(a, key) == getattr(b, key) for key in told)
        and np.array_equal(a.pose, b.pose) and np.array_equal(a.axis, b.axis)
        for a, b in zip(one.joints, other.joints, strict=True)
    )  # fmt: skip


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
        own = again.links[name].inertia
        assert own.mass == pytest.approx(link.inertia.mass, rel=1e-15)
        assert np.abs(own.centre - link.inertia.centre).max() < 1e-15
        assert np.abs(own.tensor - link.inertia.tensor).max() < 1e-14
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
    assert (upper.inertia.mass, *upper.inertia.centre) == (2.5, 0.1, 0.2, 0.3)
    assert np.array_equal(upper.inertia.tensor, body.tensor)
    assert len(upper.shapes) == 1 and upper.volume == pytest.approx(4 / 3 * np.pi * 1e-3, rel=0.02)
    assert hand_link.volume == pytest.approx(2 * 0.1 * 0.2 * 0.3)
    inside = back.read_text().split('<link name="upper">')[1].split("</link>")[0]
    assert inside.count("<visual>") == inside.count("<collision>") == 1
    assert '<material name="grey"/>' in inside and "box" not in inside
    refusal(lambda: robot_text(file, [NewLink("arm", body)], folder), "no link 'arm'")


def test_export_says_what_it_cannot_write(tmp_path):
    for words, expected in (
        ([], "add robot"),
        (["robot", "--set", "payload.mass=1"], "not with robot"),
        (["robot"], "summary.json"),
    ):
        refusal(lambda: run("export", tmp_path, *words), expected)  # noqa: B023
    record = tmp_path / "robot.json"
    for text in (None, "{", '{"urdf": "a", "solids": {"b": {"link": "c", "frame": [1]}}}'):
        if text is not None:
            record.write_text(text)
        refusal(lambda: read_origin(record), "robot.json", "cannot be read", "`dolfinopt import`")


def check_limits(summary, file):
    """The file's limits and those stated: worst values and instants, told where beyond."""
    rows = pd.read_csv(file)
    found = summary["joint_limits"]
    assert set(found) == set(summary["drive_peak"])
    for name, limits in found.items():
        force, q = rows[f"joint_force_{name}"].abs(), rows[f"q_r_{name}"]
        one = limits["effort"]
        assert one["value"] == pytest.approx(force.max(), rel=1e-3)  # instants beside the file's
        assert one["instant"] == pytest.approx(rows["t"][force.idxmax()], abs=2e-3)
        assert one["met"] == (one["value"] <= one["limit"]) and one["unit"] == "N m"
        rate = np.abs(np.gradient(q, rows["t"])).max()
        assert limits["velocity"]["value"] == pytest.approx(rate, rel=1e-2, abs=1e-3)
        assert limits["velocity"]["met"] and limits["position"]["met"] == (name != "elbow")
    beyond = found["elbow"]["position"]
    assert beyond["limit"] in (-1.0, 1.0) and abs(beyond["value"]) > 1.0
    effort = found["elbow"]["effort"]
    assert (effort["limit"], effort["met"]) == (20.0, False)
    (said,) = summary["warnings"]
    for one, unit in ((beyond, "rad"), (effort, "N m")):
        assert f"elbow {one['value']:.4g} of {one['limit']:.4g} {unit}" in said
        assert f"{one['instant']:.3g} s" in said
    assert summary["designed_mass"] == pytest.approx(summary["mass"]["forearm"], rel=1e-15)


def test_from_the_robot_to_a_run_and_back(tmp_path, capsys):
    """A finished run's link in the robot: its mass, its surface, and the same scene again."""
    run_import(DEMO, "forearm", DEMO_MOTION, tmp_path / "a")
    coarse = ("--set", "arms.forearm.cells=[12,4,4]", "--set", "design.initial=1.0",
              "--set", "simulation.tolerance=1e-2", "--no-plots",
              "--set", "joints.elbow.effort_limit=20",
              "--set", "joints.elbow.position_limits=[-1.0, 1.0]")  # fmt: skip
    run("simulate", tmp_path / "a" / "robot.toml", "--out", tmp_path / "run", *coarse)
    for name in ("machine.png", "design.png"):
        new_figure(1.0, 1.0).savefig(tmp_path / "run" / name)
    beside = tmp_path / "run" / "sections"
    beside.mkdir()
    question = {"designs": [file_digest(tmp_path / "run" / "design.npz")]}
    (beside / "sections.json").write_text(json.dumps({"question": question}))
    (beside / "sections.md").write_text("The lightest tube wins.\n")
    (beside / "sections.csv").write_text("section,mass [kg]\nround tube,2.5\n")
    run("export", tmp_path / "run", "robot", tmp_path / "run")
    said = capsys.readouterr().out
    assert "kg, was 7.879 kg" in said and "largest tool deflection" in said
    rows = pd.read_csv(tmp_path / "run" / "urdf" / "before_after.csv", index_col="figure")
    assert not rows["change [%]"].abs().max() > 0
    assert set(rows["unit"]) == {"kg", "mm", "mrad", "Hz", "N m"}
    page = Reader((tmp_path / "run" / "urdf" / "before_after.html").read_text())
    assert (
        len(page.all("img")) == 2 + 2 + 1 + 6 and len(page.all("h1")) == 1
    )  # machine, links, deflection, drives
    assert all(len(one["alt"]) > 10 and one["src"][:5] == "data:" for one in page.all("img"))
    assert len(page.all("tr")) == 1 + len(rows) + 2 and page.all("li") == []  # of one scene
    written = (tmp_path / "run" / "urdf" / "before_after.html").read_text()
    assert "The lightest tube wins." in written and "<td>round tube</td>" in written
    summary = summary_of(tmp_path / "run")
    check_limits(summary, tmp_path / "run" / "trajectory.csv")
    lighter = tmp_path / "run" / "urdf" / "robot.urdf"
    before, after = read_robot(DEMO), read_robot(lighter)
    assert "-->\n<robot " in lighter.read_text()
    assert same_kinematics(before, after)
    fore = after.links["forearm"]
    assert fore.inertia.mass == pytest.approx(summary["mass"]["forearm"], rel=1e-12)
    assert all(one.is_watertight for one in fore.shapes)
    assert fore.volume == pytest.approx(fore.inertia.mass / 2700.0, rel=0.01)
    # Its frame is the link's: the rod's middle beside the elbow, from it to the wrist.
    assert fore.inertia.centre == pytest.approx([-0.36435, 0.0, 0.06], abs=1e-9)
    assert fore.points.min(axis=0) == pytest.approx([-0.7287, -0.055, 0.005], abs=1e-3)
    assert implausible_inertias(after) == []
    run_import(lighter, "forearm", DEMO_MOTION, tmp_path / "b")
    trees = [tree_of(tmp_path / name / "robot.toml")["arms"] for name in "ab"]
    masses = [[(arm["name"], arm.get("mass")) for arm in tree] for tree in trees]
    assert masses[0] == masses[1]
    total = sum(link.inertia.mass for link in after.links.values())
    rest = sum(link.inertia.mass for name, link in before.links.items() if name != "forearm")
    assert total == pytest.approx(rest + summary["mass"]["forearm"], rel=1e-9)
    # Parts that were made are the links, whatever has become of their shape.
    run("part", tmp_path / "run", "--no-check", "--no-plots")
    thinner = trimesh.load(tmp_path / "run" / "part" / "forearm.stl")
    thinner.apply_scale([1.0, 0.5, 1.0]).export(tmp_path / "run" / "part" / "forearm.stl")
    run("export", tmp_path / "run", "--urdf", "--overwrite")
    link = trimesh.load(tmp_path / "run" / "urdf" / "forearm.stl")
    assert link.volume == pytest.approx(1e-9 * thinner.volume, rel=1e-5)


def test_a_robot_is_never_replaced_by_the_new_one(tmp_path):
    """--overwrite in the folder of the source deleted it."""
    source = tmp_path / "robot"
    source.mkdir()
    file = source / "robot.urdf"
    file.write_bytes(DEMO.read_bytes())
    run_import(file, "forearm", DEMO_MOTION, tmp_path / "a")
    coarse = ("--set", "arms.forearm.cells=[12,4,4]", "--set", "simulation.tolerance=1e-2",
              "--no-plots")  # fmt: skip
    run("simulate", tmp_path / "a" / "robot.toml", "--out", tmp_path / "run", *coarse)
    for words in ((), ("--overwrite",)):
        line = ["export", tmp_path / "run", "robot", "--out", source, *words]
        refusal(lambda: run(*line), "robot.urdf", "name another")  # noqa: B023
    assert [path.name for path in source.iterdir()] == ["robot.urdf"]
    mesh = source / "forearm.stl"
    trimesh.creation.box(extents=(0.1, 0.1, 0.8)).export(mesh)
    shape = '<geometry><cylinder radius="0.055" length="0.84"/></geometry>'
    own = '<geometry><mesh filename="robot/forearm.stl"/></geometry>'
    robot = tmp_path / "robot.urdf"
    robot.write_text(DEMO.read_text().replace(shape, own))
    refusal(lambda: _check_robot(robot, source, ["forearm.stl"]), "forearm.stl")


def test_before_and_after():
    """Figures of both runs, slides in N; runs of other machines are refused."""
    one = {
        "name": "robot", "mass": {"foot": 2.0, "link": 8.0}, "first_frequency": {"link": 50.0},
        "max_deviation": 2e-3, "settling": None, "drive_peak": {"yaw": 10.0, "rail": 4.0},
        "drive_rms": {"yaw": 5.0, "rail": 0.0},
        "units": {"drive_peak": {"yaw": "N m", "rail": "N"}},
    }  # fmt: skip
    other = one | {"mass": {"foot": 2.0, "link": 3.0}, "max_deviation": 1e-3}
    frame = before_after(one, other).frame.set_index("figure")
    assert frame.loc["mass of all arms"].tolist() == [10.0, 5.0, -50.0, "kg"]
    assert frame.loc["largest tool deflection"].tolist() == [2.0, 1.0, -50.0, "mm"]
    assert frame.loc["peak of drive rail", "unit"] == "N"
    assert frame.loc["peak of drive yaw", "unit"] == "N m"
    assert frame.loc["deflection at rest", ["before", "after"]].isna().all()
    words = "other arms", "foot, link before", "link after"
    refusal(lambda: before_after(one, one | {"mass": {"link": 1.0}}), *words)


def test_the_demo_is_what_the_import_writes(tmp_path):
    """But for what its head says is edited; its record leads to the robot."""
    run_import(DEMO, "upper_arm", DEMO_MOTION, tmp_path / "a")
    made, kept = tree_of(tmp_path / "a" / "robot.toml"), tree_of(LINK)
    for arm in (*made["arms"], *kept["arms"]):
        for key in ("cells", "passive"):
            arm.pop(key, None)
    assert made["arms"] == kept["arms"] and made["joints"] == kept["joints"]
    origins = [read_origin(one / "robot.json") for one in (tmp_path / "a", LINK.parent)]
    assert origins[0].links == origins[1].links and origins[1].file.samefile(DEMO)
    assert np.array_equal(*(one.frames["upper_arm"] for one in origins))
