"""Time laws, paths and inverse kinematics against differences and the forward kinematics.

At the end scenes with one and three arms, from the motion to the gradient.
"""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from bodies import assert_close, derivative
from runs import refused

from dolfinopt.dynamics.build import check_motion
from dolfinopt.errors import InputError
from dolfinopt.motion.build import breakpoints, desired_path, forced_rest, rigid_motion
from dolfinopt.motion.measured import TABLE_CORNERS_LIMIT
from dolfinopt.scene.load import scene_from_dict

pytestmark = pytest.mark.serial  # one rank shows all there is

DURATION = 1.9  # s
INSIDE = np.linspace(0.1, 1.8, 18)  # s, where the path is smooth
DIFFERENCES = 1e-10  # relative: the sixth power of a step over the tenths of a second of a turn
DENSE = np.linspace(0.0, 3.0, 601)  # s, over path and rest

# Paths all over the plane: cart still, half way, along and against; links of two lengths.
SCENES = pytest.mark.parametrize(
    "keys",
    [
        {},
        {"elbow": 1},
        {"flattening": 0.0},
        {"flattening": 0.4, "cart_follow": 0.0},
        {"cart_follow": 1.0, "lengths": (1.2, 0.9)},
        {"cart_follow": -0.2, "lengths": (0.8, 1.1), "elbow": 1},
        {"joint_height": 0.3, "cart_follow": 0.0},  # the shoulder's angle passes pi
    ],
    ids=str,
)


def scene(
    lengths=(1.0, 1.0),
    tables=None,
    cells=(20, 2),
    **motion,
):
    """Return the paper's example with these arms, this motion and other tables of the scene."""
    section = {"height": 0.06, "thickness": 0.01, "cells": list(cells), "passive": 0.0}
    return scene_from_dict(
        {
            "material": {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2700.0},
            "arms": [
                {"name": f"arm{k}", "length": length, **section} for k, length in enumerate(lengths)
            ],
            "motion": {"path": "arc", "duration": DURATION, "horizon": 3.0, **motion},
            "payload": {"mass": 6.0},
            **(tables or {}),
        },
        source="test.toml",
    )


def end_points(motion, of):
    """Return the rigid chain's end-effector (n, 2)."""
    lengths = np.array([arm.length for arm in of.arms])
    angles = np.cumsum(motion.q[:, 1:], axis=1)
    x = motion.q[:, 0] + np.cos(angles) @ lengths
    return np.stack([x, of.motion.joint_height + np.sin(angles) @ lengths], axis=1)


@pytest.mark.parametrize("flattening", [0.0, 0.3, 1.0])
def test_arc_runs_from_left_over_the_top_to_right(flattening):
    """On the ellipse, monotone in x, a straight line when it is flattened altogether."""
    of = scene(radius=0.9, flattening=flattening)
    path = desired_path(np.array([0.0, DURATION / 2.0, DURATION, 3.0]), of)
    expected = [[-0.9, 0.0], [0.0, 0.9 * flattening], [0.9, 0.0], [0.9, 0.0]]
    assert_close(path[0], expected, 1e-14)
    place = desired_path(DENSE, of)[0]
    height = flattening * np.sqrt(np.maximum(0.9**2 - place[:, 0] ** 2, 0.0))
    # The square root of a rounding error at the ends, where x^2 = r^2.
    assert_close(place[:, 1], height, 1e-7, 0.9)
    assert (np.diff(place[DENSE <= DURATION, 0]) > 0.0).all()
    path = desired_path(INSIDE, of)
    for k in (0, 1):
        by = derivative(lambda t, k=k: desired_path(INSIDE + t, of)[k])
        assert_close(by, path[k + 1], DIFFERENCES)


def assert_rates(of, t):
    """Assert that rates are the coordinates' derivatives at t, by differences."""
    here = rigid_motion(t, of)
    for key, rate in (("q", here.qd), ("qd", here.qdd)):
        found = derivative(lambda h, key=key: getattr(rigid_motion(t + h, of), key), step=2e-3)
        assert_close(found, rate, DIFFERENCES)


@SCENES
def test_two_arms_trace_the_arc(keys):
    """With the elbow on the side asked for and the cart where it should be; then all is at rest."""
    of = scene(**keys)
    motion, path = rigid_motion(DENSE, of), desired_path(DENSE, of)
    assert_close(end_points(motion, of), path[0], 1e-14)
    assert (np.sign(motion.q[:, 2]) == of.motion.elbow).all()
    for found, of_path in zip((motion.q, motion.qd, motion.qdd), path, strict=True):
        assert np.array_equal(found[:, 0], of.motion.cart_follow * of_path[:, 0])
    assert_rates(of, INSIDE)
    steps = np.abs(np.diff(motion.q, axis=0)).max(axis=0)  # no jump by 2 pi
    assert (steps <= 1.1 * np.abs(motion.qd).max(axis=0) * DENSE[1]).all()
    rest = DENSE >= DURATION
    assert not motion.qd[rest].any() and not motion.qdd[rest].any()
    assert_close(motion.q[rest], np.broadcast_to(motion.q[-1], motion.q[rest].shape), 1e-15)


LENGTHS = {1: (1.0,), 2: (1.1, 0.9), 3: (0.8, 0.7, 0.5), 4: (0.6, 0.5, 0.5, 0.4)}  # m
POINTS = np.array([[-0.7, 0.0], [-0.5, 0.3], [0.0, 0.2], [0.4, 0.35], [0.6, 0.1]])  # m
TIMES = np.array([0.0, 0.5, 0.9, 1.3, DURATION])  # s
PATHS = {
    "arc": {"path": "arc", "radius": 0.7, "flattening": 0.5},
    "line": {"path": "line", "start": [-0.7, -0.1], "end": [0.6, 0.4]},
    "points": {"path": "points"},
    "points in time": {"path": "points", "law": "quintic"},
    "joints": {"path": "joints"},
    "joints in time": {"path": "joints", "law": "quintic"},
}
BASES = {"cart": {}, "fixed": {"base": 0.1}}
MOTIONS = [
    (arms, path, law, base)
    for arms in (1, 2, 3, 4)
    for path in PATHS
    for law in ("quintic", "septic")
    for base in BASES
    if "law" not in PATHS[path] or law == "quintic"  # a table with times has its own
    if arms > 1 or base == "cart" or path.startswith("joints")
]


def joint_rows(columns):
    """Return joint coordinates at `TIMES` (n, columns)."""
    k = np.arange(columns)
    return 0.4 * np.sin(TIMES[:, None] * (1.0 + 0.7 * k) + k) + 0.2 * k


def table_text(path, arms, base):
    """Return a table of points or joints, with times where the path's name says so."""
    names, rows = ["x", "y"], POINTS
    if path.startswith("joints"):
        names = ([] if base == "fixed" else ["cart"]) + [f"arm{k}" for k in range(arms)]
        rows = joint_rows(len(names))
    if path.endswith("time"):
        names, rows = ["t", *names], np.column_stack([TIMES, rows])
    return "\n".join([",".join(names), *(",".join(map(repr, row)) for row in rows.tolist())])


def of_kind(folder, arms, path, law, base, **keys):
    """Return one of `MOTIONS`, with its table in `folder`."""
    motion = {**PATHS[path], **BASES[base], "law": law, **keys}
    if motion["path"] in ("points", "joints"):
        motion["file"] = str(folder / f"{path}{arms}{base}.csv".replace(" ", "-"))
        Path(motion["file"]).write_text(table_text(path, arms, base))
    return scene(LENGTHS[arms], **motion)


@pytest.mark.parametrize(("arms", "path", "law", "base"), MOTIONS)
def test_every_motion(tmp_path, arms, path, law, base):
    """Traces the path or the rows; rates by differences; continuous, at rest at both ends."""
    of = of_kind(tmp_path, arms, path, law, base)
    check_motion(of)
    motion = rigid_motion(DENSE, of)
    assert motion.q.shape == motion.qd.shape == motion.qdd.shape == (len(DENSE), 1 + arms)
    if path.startswith("joints"):
        rows = joint_rows(arms + (base == "cart"))
        at = TIMES if path == "joints in time" else np.array(breakpoints(of)[:-1])
        assert_close(rigid_motion(at, of).q[:, -rows.shape[1] :], rows, 1e-12)
    else:
        assert_close(end_points(motion, of), desired_path(DENSE, of)[0], 2e-14)
    if base == "fixed":
        assert (motion.q[:, 0] == 0.1).all()
        assert not motion.qd[:, 0].any()
        assert not motion.qdd[:, 0].any()
    # Differences across a row, where a higher derivative of the spline jumps, would be off.
    knots = TIMES if path.endswith("time") else np.array(breakpoints(of))
    inside = INSIDE[np.abs(INSIDE[:, None] - knots).min(axis=1) > 0.01]
    assert len(inside) >= 12
    assert_rates(of, inside)
    size = np.abs(motion.qdd).max()
    ends = rigid_motion(np.array([0.0, 1e-7, DURATION - 1e-7, DURATION, 2.5]), of)
    # The jerk is some hundred times the acceleration per second.
    assert np.abs(ends.qdd).max() < 1e-4 * size
    assert np.abs(ends.qd).max() < 1e-10 * size
    assert_close(ends.q[:2], ends.q[[0, 0]], 1e-12)
    assert_close(ends.q[3:], ends.q[[2, 2]], 1e-12)


LINE = {
    "path": "line",
    "base": "fixed",
    "start": [-1, 0.1],
    "end": [1, 0.1],
    "joint_height": -0.5,
}
FAR = {"path": "line", "start": [0, 0], "end": [1e4, 1e4], "cart_follow": 1e3}
UNREACHABLE = [  # arms, motion, worst instant and distance there, what it is, keys that help
    ((1.0, 1.0), {"radius": 4.0}, 0.95, 4.5, "than 0 m and less than 2 m", "motion.joint_height"),
    ((1.0, 1.0), {"joint_height": -1.0}, 0.95, 2.0, "arms of 1, 1 m reach", "motion.radius"),
    # Within a millionth of stretched or folded.
    ((1.0, 1.0), {"joint_height": -0.9999999}, 0.95, 2.0, "less than 2 m", "motion.radius"),
    ((1.0, 1.0), {"radius": 1e-6, "joint_height": 0.0, "cart_follow": 0.0}, None, 1e-6,
     "more than 0 m", "motion.radius"),
    ((1.4, 0.6), {"joint_height": -0.5}, 0.0, np.sqrt(0.5), "more than 0.8 m",
     "motion.cart_follow"),
    ((1.0, 1.0), {"flattening": 0.0, "joint_height": 0.0, "cart_follow": 0.0}, 0.95, 0.0,
     "more than 0 m", "motion.flattening"),
    ((0.5, 0.5, 0.5), {"cart_follow": 0.0, "radius": 1.0, "joint_height": -0.5}, 0.95, 1.5,
     "elbows bent alike", "the arms' length"),
    ((1.0, 0.2, 0.2), LINE, 0.95, 0.6, "from the shoulder", "motion.base"),
    ((1.2,), {"radius": 1.0, "joint_height": -0.5}, 0.95, 1.5, "above the shoulder; arms of 1.2 m",
     "motion.flattening"),
    ((1.2,), LINE | {"base": "cart", "end": [1, -2]}, 1.9, -1.5, "above the", "motion.end"),
    ((1.0, 1.0), FAR, None, 1e7, "from the shoulder", "motion.start"),
]  # fmt: skip


@pytest.mark.parametrize(("lengths", "keys", "time", "distance", "words", "key"), UNREACHABLE)
def test_reach_of_any_number_of_arms(lengths, keys, time, distance, words, key):
    """In one line the worst instant, the distance there, and the keys that help."""
    with pytest.raises(InputError) as caught:
        check_motion(scene(lengths, **keys))
    said = str(caught.value)
    found = re.match(r"test\.toml: motion: at t = (\S+) s the end-effector is (\S+) m ", said)
    assert found and words in said and key in said and "\n" not in said
    assert time is None or float(found[1]) == pytest.approx(time, abs=5e-3)
    assert float(found[2]) == pytest.approx(distance, rel=1e-3, abs=5e-6)


def test_breakpoints(tmp_path):
    """The end of the path, and the rows of a short table without times."""
    assert breakpoints(scene()) == (0.0, DURATION, 3.0)
    assert breakpoints(scene(horizon=DURATION)) == (0.0, DURATION)
    assert breakpoints(of_kind(tmp_path, 2, "points in time", "quintic", "cart")) == (
        0.0,
        DURATION,
        3.0,
    )
    of = of_kind(tmp_path, 2, "points", "septic", "cart")
    instants = breakpoints(of)
    assert len(instants) == len(POINTS) + 1
    assert_close(desired_path(np.array(instants[:-1]), of)[0], POINTS, 1e-13)
    x = np.linspace(-0.5, 0.5, TABLE_CORNERS_LIMIT + 3)
    file = tmp_path / "many.csv"
    file.write_text("\n".join(["x,y", *(f"{a!r},{a * a!r}" for a in x.tolist())]))
    assert breakpoints(scene(path="points", file=str(file))) == (0.0, DURATION, 3.0)


def test_changed_table_is_read_anew(tmp_path):
    """The curve is kept, but not longer than the file."""
    file = tmp_path / "points.csv"
    file.write_text("x,y\n-0.5,0\n0.5,0\n")
    of = scene(path="points", file=str(file))
    before = end_points(rigid_motion(DENSE, of), of)
    file.write_text("x,y\n-0.5,0\n0.5,0.3\n")
    os.utime(file, ns=(1, 1))  # another time, even where the clock is coarse
    after = end_points(rigid_motion(DENSE, of), of)
    assert_close([before[-1], after[-1]], [[0.5, 0.0], [0.5, 0.3]], 1e-14)
    file.unlink()
    with refused("points.csv", "No such file"):
        rigid_motion(DENSE, of)


@pytest.mark.parametrize(
    ("text", "keys", "words"),
    [
        ("t,cart,arm0,arm1\n0,0,0,0\n1.5,1,1,1\n", {},
         ("line 3", "column t = 1.5", "motion.duration = 1.9", "set motion.duration = 1.5")),
        ("t,cart,arm0,arm1\n0,0,0,0\n1,0,1,1\n1.9,1,1,1\n", {"law": "septic"},
         ("line 3", "motion.law = 'septic'", "repeat the row", "leave out the column t")),
        ("arm0,arm1\n0,0\n1,1\n", {}, ("line 1", "missing column 'cart'", "cart,arm0,arm1")),
        ("cart,arm0,arm1\n0,0,0\n1,1,1\n", {"base": "fixed"},
         ("line 1", "unknown column 'cart'", "arm0,arm1 or t,arm0,arm1")),
    ],
    ids=["duration", "law", "no cart", "cart"],
)  # fmt: skip
def test_table_that_does_not_suit_the_scene(tmp_path, text, keys, words):
    """One line that says what to set."""
    file = tmp_path / "joints.csv"
    file.write_text(text)
    of = scene(path="joints", file=str(file), **keys)
    for call in (check_motion, breakpoints):
        with refused(f"{file}: ", *words):
            call(of)


@pytest.mark.parametrize("name", ["t", "cart"])
def test_arm_with_the_name_of_another_column(tmp_path, name):
    """Its column would have two meanings."""
    file = tmp_path / "joints.csv"
    file.write_text("t,cart,arm1\n0,0,0\n1,1,1\n")
    keys = {"path": "joints", "file": str(file)}
    of = scene(**keys)
    arms = (of.arms[0].unchecked_copy({"name": name}), of.arms[1])
    with refused(f"'{name}'", "another name"):
        check_motion(of.unchecked_copy({"arms": arms}))


def sampled(folder, count=200, **keys):
    """Return joints that swing as 0.6 sin(2 t), a recording from the midst of the motion."""
    t = np.linspace(0.0, 0.5, count)
    rows = np.column_stack([t, 0.3 * t, 0.6 * np.sin(2.0 * t), 0.5 * np.cos(2.0 * t)])
    file = folder / "cut.csv"
    text = ["t,cart,arm0,arm1", *(",".join(map(repr, row)) for row in rows.tolist())]
    file.write_text("\n".join(text))
    tables = {"motion": {"path": "joints", "file": str(file), **keys}}
    return scene_from_dict(scene(tables=tables).to_tree() | tables, "test.toml")


@pytest.mark.parametrize("count", [4, 6, 200])
def test_a_table_may_move_at_its_ends(tmp_path, count):
    """At its own rates there, and no rest is forced upon it; its horizon is its own."""
    of = sampled(tmp_path, count, table_ends="moving")
    assert of.motion.horizon == of.motion.duration == 0.5
    t = np.linspace(0.0, 0.5, 41)
    motion = rigid_motion(t, of)
    close = 1e-7 if count == 200 else 0.2 / count
    assert_close(motion.qd[:, 1], 1.2 * np.cos(2.0 * t), close)
    assert_close(motion.q[:, 1], 0.6 * np.sin(2.0 * t), close)
    assert forced_rest(of) is None


def test_a_forced_rest_is_told(tmp_path):
    """With the acceleration that it needs, that of the rows, and the key that takes their rates."""
    of = sampled(tmp_path)
    motion = rigid_motion(np.linspace(0.0, 0.5, 4001), of)
    told = forced_rest(of)
    assert told is not None and 'motion.table_ends = "moving"' in told
    largest = float(re.search(r"acceleration of (\S+)", told)[1])
    assert largest == pytest.approx(np.abs(motion.qdd).max(), rel=0.02) and largest > 100.0
    assert float(re.search(r"rows have (\S+):", told)[1]) == pytest.approx(2.0, rel=0.1)
    calm = of_kind(tmp_path, 2, "joints in time", "quintic", "cart")
    assert forced_rest(calm) is None
    with refused("motion.horizon = 1", "motion.duration = 0.5", "table_ends"):
        sampled(tmp_path, table_ends="moving", horizon=1.0)
