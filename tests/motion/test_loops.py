"""Closed loops of rigid arms: joints that follow, rates, branches, counts, what is refused."""

from pathlib import Path

import numpy as np
import pytest
import tomllib
from loops import (
    BASE,
    BOOM_TABLE,
    FOOT,
    HEAD,
    LOWER,
    LUG,
    PLATE,
    UPPER,
    boom,
    closed,
    cranks,
    crossed_crank,
    delta,
    driven_slider,
    five_bar,
    four_bar,
    guided_crank,
    parallelogram,
    rhombus,
)
from machines import loop_tree, with_keys
from runs import refused

from dolfinopt.dynamics.build import check_motion
from dolfinopt.motion.build import follower, loop_start, rigid_motion
from dolfinopt.motion.paths import rotation
from dolfinopt.scene.laws import Limits, law_for
from dolfinopt.scene.load import scene_from_dict

pytestmark = pytest.mark.serial


# -- joints that follow in closed loops of space: closed forms, branches, rates, what is refused


T = np.linspace(0.0, 1.0, 21)  # s
EXACT = 1e-10  # rad, m: Newton's method to rounding


def of_five_bar(q):
    """The tool, where two circles meet above the line between the knees."""
    a, a2, b, b2 = q.T
    left, right = 0.2 * np.exp(1j * a), 0.3 + 0.2 * np.exp(1j * b)
    away = right - left
    half = 0.5 * np.abs(away)
    tool = left + away * (0.5 + 0.5j * np.sqrt(0.3**2 - half**2) / half)
    return np.stack([np.angle(tool - left) - a - a2, np.angle(tool - right) - b - b2])


def of_parallelogram(q):
    """The hand stays as it is."""
    return q.sum(axis=1)


def of_boom(q):
    """The law of cosines in the triangle of head, foot and lug."""
    _, luff, length = q.T
    lug, foot = complex(*LUG[:2]), complex(FOOT[0] - HEAD[0], FOOT[2] - HEAD[2])
    angle = luff + np.angle(lug) - np.angle(foot)
    square = abs(lug) ** 2 + abs(foot) ** 2 - 2.0 * abs(lug) * abs(foot) * np.cos(angle)
    return np.sqrt(square) - length


def of_delta(q):
    """Its plate does not turn, and is as far as the rods are long from all three elbows."""
    found = [*q[:, 6:].T]
    for k in range(3):
        angle, down = 2.0 * np.pi * k / 3.0, np.array([0.0, 0.0, -1.0])
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        elbow = (BASE + UPPER * np.cos(q[:, k, None])) * out + UPPER * np.sin(q[:, k, None]) * down
        found.append(np.linalg.norm(q[:, 3:6] + PLATE * out - elbow, axis=1) - LOWER)
    return np.stack(found)


def of_four_bar(q):
    """Coupler and rocker end at the foot."""
    a, b, c = np.cumsum(q, axis=1).T
    return np.abs(0.1 * np.exp(1j * a) + 0.28 * np.exp(1j * b) + 0.25 * np.exp(1j * c) - 0.25)


def of_guided_crank(q):
    """The block is where the rod reaches the axis, and does not turn."""
    a, b, c = np.cumsum(q, axis=1).T
    end = 0.1 * np.exp(1j * a) + 0.28 * np.exp(1j * b)
    place = 0.1 * np.cos(a) + np.sqrt(0.28**2 - (0.1 * np.sin(a)) ** 2)
    return np.stack([np.abs(end - place), c])


def of_crossed_crank(q):
    """The slider is as far from the crank's pin as the rod is long."""
    y, z = 0.1 - 0.08 * np.sin(q[:, 0]), 0.12 + 0.08 * np.cos(q[:, 0])
    return q[:, 1] - np.sqrt(0.3**2 - y**2 - z**2)


@pytest.mark.parametrize(
    ("tree", "table", "law"),
    [
        (guided_crank(), "t,turn\n0,0.5\n1,5.5\n", of_guided_crank),
        (crossed_crank(), "t,turn\n0,0\n1,5.5\n", of_crossed_crank),
        (four_bar("pin"), "t,turn\n0,0.5\n1,5.5\n", of_four_bar),
        (five_bar(), "t,a,b\n0,2.0,1.1\n1,1.6,0.8\n", of_five_bar),
        (parallelogram(), "t,shoulder\n0,0.3\n1,1.0\n", of_parallelogram),
        (boom(), BOOM_TABLE, of_boom),
        (delta(), "t,drive0,drive1,drive2\n0,0.5,0.5,0.5\n1,0.9,0.3,0.6\n", of_delta),
    ],
    ids=lambda one: one["name"] if isinstance(one, dict) else "",
)
def test_closed_forms(tmp_path, tree, table, law):
    scene = closed(tmp_path, table, tree)
    motion = rigid_motion(T, scene)
    assert np.abs(law(motion.q)).max() < EXACT
    inner, h = T[2:-2], 1e-3  # of the table's law, which is smooth there
    for key in ("q", "qd"):
        a, b, c, d = (getattr(rigid_motion(inner + k * h, scene), key) for k in (-2, -1, 1, 2))
        by = (a - 8.0 * b + 8.0 * c - d) / (12.0 * h)
        expected = getattr(motion[2:-2], key + "d")
        assert np.abs(by - expected).max() < 1e-8 * (1.0 + np.abs(expected).max())


def test_a_path_of_the_tool_moves_the_drives(tmp_path):
    """All joints of the five-bar are unknown: two follow, two drive the tool along points."""
    file, points = tmp_path / "points.csv", np.array([[0.15, 0.4], [0.2, 0.38], [0.1, 0.42]])
    file.write_text(
        "t,x,y,z\n" + "".join(f"{0.5 * k},{x},{y},0\n" for k, (x, y) in enumerate(points))
    )
    scene = closed(tmp_path, "", five_bar(), motion={"path": "points", "file": str(file)})
    q = rigid_motion(np.array([0.0, 0.5, 1.0]), scene).q
    assert np.abs(of_five_bar(q)).max() < EXACT
    tool = 0.2 * np.exp(1j * q[:, 0]) + 0.3 * np.exp(1j * (q[:, 0] + q[:, 1]))
    assert np.abs(tool - points @ [1.0, 1.0j]).max() < EXACT


def test_redundant_equations_are_counted(tmp_path):
    """Of a pin's five equations a plane four-bar needs two; rods of the delta all count."""
    for tree, table, redundant in (
        (four_bar("pin"), "t,turn\n0,0.5\n1,1.0\n", 3),
        (four_bar("ball"), "t,turn\n0,0.5\n1,1.0\n", 1),
        (delta(), "t,drive0,drive1,drive2\n0,0.5,0.5,0.5\n1,0.6,0.5,0.5\n", 0),
    ):
        start = follower(closed(tmp_path, table, tree)).start
        assert start.redundant == redundant and start.misfit == 0.0


TURN = "t,turn\n0,0.5\n1,1.0\n"


def far(tree):
    """Return the four-bar with a foot that no rocker reaches."""
    return with_keys(tree, {"closures": [tree["closures"][0] | {"point": [1.0, 0, 0]}]})


def driven(tree):
    """Return it with two driven joints, of which the loop leaves one."""
    joints = [dict(one) for one in tree["joints"]]
    del joints[1]["passive"]
    return with_keys(tree, {"joints": joints})


def loose(tree):
    """Return it held by a rod, which leaves the coupler to itself."""
    rod = {"name": "foot", "kind": "rod", "between": ["rocker", "ground"], "length": 0.1,
           "point": [0.25, 0.1, 0]}  # fmt: skip
    return with_keys(tree, {"closures": [rod]})


@pytest.mark.parametrize(
    ("tree", "table", "words"),
    [
        (far(four_bar()), TURN, ("closures: at t = 0 s the loop of foot", "initial_joints")),
        (driven(four_bar()), "t,turn,knee\n0,0.5,0.3\n1,1.0,0.2\n",
         ("closures (foot): they hold 1", "turn, knee", "passive = true")),
        (loose(four_bar()), TURN, ("closures (foot): they leave 1", "knee, rock")),
        (boom(), "t,slew,cylinder\n0,0,1.0\n1,0,3.0\n",
         ("closures: at t = 0.", "the loop of cylinder", "motion.file")),
    ],
    ids=["too far", "too many drives", "too few equations", "out of reach"],
)  # fmt: skip
def test_refused(tmp_path, tree, table, words):
    scene = closed(tmp_path, table, tree)
    with refused(*words):
        check_motion(scene)
        rigid_motion(T, scene)


# -- a joint that runs up --------------------------------------------------------------------


DURATION, SPEED = 0.05, 150.0  # s, rad/s


def crank(t, law="quintic"):
    """Return angle and rates of the first joint (n, 1)."""
    one = law_for(law, 1.0, Limits(np.inf, np.inf, np.inf), 0.25)
    return rotation(t, one, SPEED, 0.4, DURATION)


def test_run_up_of_a_crank():
    """start + speed duration (2.5 u^4 - 3 u^5 + u^6), then constant speed."""
    t = np.linspace(0.0, 2.0 * DURATION, 41)
    angle, rate, growth = (x[:, 0] for x in crank(t))
    u = t / DURATION
    first = 0.4 + SPEED * DURATION * (2.5 * u**4 - 3.0 * u**5 + u**6)
    later = 0.4 + SPEED * (0.5 * DURATION + t - DURATION)
    np.testing.assert_allclose(angle, np.where(u < 1.0, first, later), rtol=0, atol=1e-13)
    assert rate[-1] == SPEED and growth[-1] == 0.0


# -- loops of the plane ----------------------------------------------------------------------


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("kind", ["slider", "pin"])
def test_loops_of_the_plane(kind, side):
    """The end stays on its line, or at its pin; `side` is the sign of the last joint's angle."""
    line = {"point": [0.3, 0.05], "direction": [1.0, 0.2]} if kind == "slider" else {}
    tree = loop_tree(kind, closure={"side": side} | line, motion={"initial_joints": [0.4]})
    scene = scene_from_dict(tree)
    t = np.linspace(0.0, scene.motion.horizon, 101)
    motion = rigid_motion(t, scene)
    lengths = np.array([arm.length for arm in scene.arms])
    end = (lengths * np.exp(1j * np.cumsum(motion.q[:, 1:], axis=1))).sum(axis=1)
    end = end + 1j * scene.motion.joint_height - complex(*scene.closures[0].point)
    gap = (np.conj(1j * complex(*line["direction"])) * end).real if line else np.abs(end)
    assert np.abs(gap).max() < 1e-14
    assert np.sign(np.angle(np.exp(1j * motion.q[0, -1]))) == side
    assert np.abs(np.diff(motion.q, axis=0)).max() < 1.0  # no jump by a turn
    inner, h = t[2:-2], 1e-4
    for key in ("q", "qd"):
        a, b, c, d = (getattr(rigid_motion(inner + k * h, scene), key) for k in (-2, -1, 1, 2))
        expected = getattr(rigid_motion(inner, scene), key + "d")
        by = (a - 8.0 * b + 8.0 * c - d) / (12.0 * h)
        assert np.abs(by - expected).max() < 1e-6 * np.abs(expected).max()


def test_initial_joints_choose_a_branch_of_the_plane():
    """As `side` does, and the branch is told."""
    starts = []
    for side in (-1, 1):
        tree = loop_tree("pin", closure={"side": side})
        start = loop_start(scene_from_dict(tree))
        assert list(start) == ["coupler", "rocker"]
        starts.append(start)
    near = [0.0, *(x + 0.05 for x in starts[0].values())]
    chosen = loop_start(scene_from_dict(with_keys(tree, {"motion": {"initial_joints": near}})))
    assert list(chosen.values()) == pytest.approx(list(starts[0].values()), abs=1e-12)


# -- which joints are passive ----------------------------------------------------------------

FEW, NONE, MANY = {"elbow left": False}, {"elbow left": False, "elbow right": False}, {
    "motor right": True
}  # fmt: skip


def five_bar_demo(folder, passive, path, control):
    """Return the demo with other joints passive, along points or a table of driven joints."""
    data = tomllib.loads(Path("demos/five_bar.toml").read_text())
    data["motion"]["file"] = str(Path("demos/five_bar.csv").resolve())
    for one in data["joints"]:
        one["passive"] = passive.get(one["name"], one.get("passive", False))
    names = [one["name"] for one in data["joints"]]
    start = dict(zip(names, data["motion"]["initial_joints"], strict=True))
    driven = [one["name"] for one in data["joints"] if not one["passive"]]
    if path == "joints":
        rows = [",".join(f"{start[k] - away}" for k in driven) for away in (0.0, 0.1)]
        (folder / "bar.csv").write_text(f"t,{','.join(driven)}\n0,{rows[0]}\n0.3,{rows[1]}\n")
        data["motion"] |= {"path": "joints", "file": str(folder / "bar.csv")}
    if control:
        data["control"] = {"stiffness": [2e3] * len(driven), "damping": [20.0] * len(driven)}
    return scene_from_dict(data, "five_bar")


@pytest.mark.parametrize("control", [False, True])
@pytest.mark.parametrize("path", ["points", "joints"])
@pytest.mark.parametrize(
    ("passive", "words"),
    [
        (FEW, ("hold 1 of the driven", "1 more", "elbow left")),
        (NONE, ("hold 2 of the driven", "2 more", "elbow right")),
        (MANY, ("leave 1 of the passive", "drive 1 of", "motor right")),
    ],
    ids=["too few", "none", "too many"],
)
def test_wrong_numbers_of_passive_joints(tmp_path, passive, words, path, control):
    """One check for every path, with names."""
    with refused("closures (gripper)", *words):
        check_motion(five_bar_demo(tmp_path, passive, path, control))


# -- singular positions ----------------------------------------------------------------------

FLAT = "t,j1\n0,{}\n0.8,{}\n"


@pytest.mark.parametrize(
    ("tree", "table", "words"),
    [
        (driven_slider(), "t,slide\n0,0.35\n0.5,0.3\n", ("t = 0 s", "pin", "wrist, shaft")),
        (rhombus(start=0.0), FLAT.format(0, 0.5), ("t = 0 s", "pin", "j2, j3")),
        (rhombus(), FLAT.format(0.5, -0.5), ("t = 0.4 s", "pin", "j2, j3")),
        (rhombus(start=1.5), FLAT.format(1.5, -1.4), ("t = 0.4074 s", "pin", "j2, j3")),
        (cranks(start=0.6), FLAT.format(0.6, -0.5), ("dead centre", "pin two, pin three", "j3")),
    ],
    ids=["dead start", "flat start", "through flat", "between samples", "three cranks"],
)
def test_singular_positions_are_refused(tmp_path, tree, table, words):
    """With instant, closure, joints and remedy, wherever they lie between samples."""
    with refused("dead centre", "undetermined", "drive one of them", *words):
        check_motion(closed(tmp_path, table, tree))


@pytest.mark.parametrize(
    "tree",
    [rhombus(0.199), rhombus(0.15), cranks(apart=0.15, start=0.5)],
    ids=["nearly flat", "short crank", "pins out of line"],
)
def test_what_stays_determined_goes_on(tmp_path, tree):
    """A crank that is shorter passes near by; three cranks out of line determine each other."""
    scene = closed(tmp_path, FLAT.format(0.5, -0.5), tree)
    q = rigid_motion(np.linspace(0.0, 0.8, 201), scene).q
    assert np.abs(np.diff(q, axis=0)).max() < 0.5
    if len(tree["closures"]) == 2:  # cranks stay parallel
        assert np.abs(q[:, 2:] - q[:, :1]).max() < EXACT


def test_links_that_nearly_fit_are_joined(tmp_path):
    """And those that do not are refused by how much."""
    start = follower(closed(tmp_path, FLAT.format(1.0, 2.2), cranks(longer=1e-5))).start
    assert start.misfit == pytest.approx(9e-6, rel=0.02) and start.redundant == 7
    with refused("pin two", "cannot be closed", "leave it 0.00"):
        check_motion(closed(tmp_path, FLAT.format(1.0, 2.2), cranks(longer=2e-3)))
