"""Control, closed loops and soft joints in a scene: what cannot be combined is refused."""

import copy
import os
import re

import numpy as np
import pytest
from loops import BOOM_TABLE, boom, closed, four_bar
from machines import CRANK, ROD, controlled, fork, loop, loop_tree, simulated, two_arm, with_keys
from mpi4py import MPI
from remainders import built_of
from runs import ROOT, TWO_ARM, refusal, refused, scene
from scenes import put_at

from dolfinopt.dynamics.build import build_system, check_forces, check_motion
from dolfinopt.motion.build import loops_of
from dolfinopt.scene.load import pose_scenarios, read_scene, scene_from_dict
from dolfinopt.scene.messages import implausible

pytestmark = pytest.mark.serial
POLES, EFFORT = "constraints.damping_ratio=0.05", "objective.kind=effort"
KEPT = "constraints.deviation=9"
BALANCED = "reduction.method=balanced"
ESL = "objective.gradient=esl"


# What is wrong of the two-arm machine under control, key and value that are shown, remedy.
CONTROLLED = [
    ("control.stiffness=[1, 2]", "control.stiffness = [1, 2]", "3 numbers, for cart, arm1"),
    ("control.damping=[1]", "control.damping = [1]", "3 numbers, for cart, arm1, arm2"),
    ("control.limits=[1, 2]", "control.limits = [1, 2]", "3 numbers, for cart, arm1, arm2"),
    ("control.limits=[1, 2, 0]", "control.limits = [1, 2, 0]", "1e-09"),
    ("control.stiffness=[1, 2, -3]", "control.stiffness = [1, 2, -3]", ">= 0"),
    ("control.feed_forward=flexible", 'feed_forward = "flexible"', '"rigid" | "elastic"'),
    ("control.feed_forward=elastic", 'feed_forward = "elastic"', "gear_stiffness"),
    ("arms.joint_damping=3", "arms.0.gear_damping", "only with gear_stiffness"),
    ("arms.rotor_inertia=1e-4", "arms.0.rotor_inertia", "gear_ratio"),
    ("arms.gear_damping=3", "arms.0.gear_damping", "only with gear_stiffness"),
    ("arms.friction=[-1, 0]", "arms.0.friction", "two numbers >= 0"),
    ("arms.bearing_stiffness=[0, 0, 1e6, 0, 0, 0]", "arms.0.bearing_stiffness", "along z"),
    ("arms.bearing_stiffness=[0, 0, 0, 0, 1e6, inf]", "arms.0.bearing_stiffness", "about y"),
    ("control.forces=nothing.csv", 'forces = "nothing.csv"', "the path of a file"),
    ("control.gain=3", "control.gain", "unknown key"),
    ("closure.kind=slider", 'motion.base = "cart"', '"fixed" with [[closures]]'),
    ("constraints.poles_at=[0.5]", "poles_at = [0.5]", "without constraints.damping_ratio"),
    (POLES, "constraints.poles_at=[0.5,9.0]", "constraints.poles_at", "motion.horizon"),
    ("constraints.damping_ratio=1.5", "damping_ratio = 1.5", "<= 0.99"),
    ("objective.kind=pole_frequency", "control.stiffness=[1,1]", "control.stiffness", "3 numbers"),
]
# The same without control.
PRESCRIBED = [
    (POLES, "constraints.damping_ratio = 0.05", "[control]"),
    ("constraints.peak_force=[9.0]", "constraints.peak_force", "3 numbers, for cart, arm1, arm2"),
    (BALANCED, "constraints.effort=9", "reduction.method", "effort"),
    (EFFORT, KEPT, "objective.effort_weights=[1.0]", "effort_weights", "3 numbers, for cart, arm1"),
    (EFFORT, KEPT, "objective.effort_weights=[0.0,0.0,0.0]", "effort_weights", "above 0 for one"),
    (EFFORT, KEPT, BALANCED, 'objective.kind = "effort"', '"craig-bampton"'),
    # Without a limit of what arms do none of them would be left.
    (EFFORT, "constraints={mass=3.0}", 'kind = "effort"', "limit under [constraints]"),
    ("objective.kind=peak_force", "constraints={mass=3.0}", "peak_force", "[constraints]"),
    ("constraints.peak_force=[inf,inf,inf]", "peak_force", "one drive at least"),
    ("constraints.peak_force=[inf,1.0]", "peak_force", "3 numbers"),
    ("constraints.buckling=1.5", BALANCED, ESL, "reduction.method", "constraints.buckling"),
    (BALANCED, "optimizer.exact_iterations=1", "reduction.method", 'gradient = "exact"'),
    *((f"constraints.stiffness=[{one}]", *words) for one, *words in (
        ("{arm='arm3', moment=1.0, rotation=1.0}", "stiffness.0.arm", '"arm3"', "arm1, arm2"),
        ("{arm='arm1', moment=1.0}", "stiffness.0", "displacement or rotation"),
        ("{arm='arm1', rotation=1.0}", "stiffness.0", "force or moment"),
        ("{arm='arm1', force=[1.0,0.0,0.0], rotation=1.0}", "stiffness.0", "two components"),
        ("{arm='arm1', moment=1.0, rotatoin=1.0}", "rotatoin", "stiffness.0.rotation"),
        ("", "stiffness = []", "[[constraints.stiffness]]"))),
]  # fmt: skip


@pytest.mark.parametrize(
    ("make", "told"),
    [*((controlled, one) for one in CONTROLLED), *((scene, one) for one in PRESCRIBED)],
    ids=lambda one: " ".join(one) if isinstance(one, tuple) else "",
)
def test_two_arms_that_cannot_be(make, told):
    """Changes are "key=value", words of the message are not."""
    changes = [one for one in told if re.match(r"[a-z_.]+=", one)]
    refusal(lambda: make(*changes), str(TWO_ARM), *told[len(changes) :])


@pytest.mark.parametrize(
    ("kind", "tables", "words"),
    [
        ("slider", {"control": {"stiffness": [1.0, 2.0], "damping": [1.0]}},
         ["control.stiffness = [1.0, 2.0]", "1 number, for crank"]),
        ("pin", {"control": {"stiffness": [1.0], "damping": [1.0, 2.0]}},
         ["control.damping = [1.0, 2.0]", "1 number, for crank"]),
        ("slider", {"scenarios": [{"changes": ["control.stiffness=[1e3, 1.0]"]}],
                    "control": {"stiffness": [2e3], "damping": [20.0]}}, ["1 number, for crank"]),
        ("slider", {"closure": {"kind": "pin"}}, ['closures.0.kind (closure) = "pin"', "3 arms"]),
        ("slider", {"closure": {"direction": [0.0, 0.0]}}, ["closures.0.axis", "length zero"]),
        ("slider", {"closure": {"side": 0}}, ["motion.elbow = 0", "-1 | 1"]),
        ("pin", {"closure": {"force": 3.0}}, ["forces.0.factor (closure) = 3.0", "0.0, the"]),
        ("pin", {"closure": {"direction": [0.0, 1.0]}}, ["closures.0.axis", "the default, with"]),
        ("slider", {"motion": {"path": "arc"}}, ["motion.", "expected"]),
        ("pin", {"objective": {"kind": "deviation"}}, ['objective.kind = "deviation"', "a pin"]),
        ("slider", {"arms": [CRANK, ROD | {"gear_stiffness": 10.0}]},
         ["arms.1.gear_stiffness (rod) = 10.0", "no drive"]),
        ("slider", {"arms": [CRANK, ROD | {"bearing_stiffness": [1e6, 0, 0, 0, 0, 0]}]},
         ["arms.1.bearing_stiffness (rod)", "none with [[closures]]"]),
        ("slider", {"arms": [CRANK | {"joint_stiffness": 1.0, "gear_stiffness": 1.0}, ROD]},
         ["arms.joint_stiffness", "only one of"]),
        # Where it cannot be assembled the instant is named.
        ("slider", {"closure": {"point": [0.0, 1.0]}},
         ["closures: at t = 0 s the loop of closure", "cannot be closed"]),
        ("slider", {"closure": {"point": [0.0, 0.25]}},
         ["closures: at t = 0.", "the loop of closure"]),
        ("pin", {"closure": {"point": [1.25, 0.0]}}, ["closures: at t = ", "the arms' lengths"]),
    ],
)  # fmt: skip
def test_loops_that_cannot_be(kind, tables, words):
    refusal(lambda: check_motion(loop(kind, **tables)), *words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,cart,arm1\n0,0,0\n1,1,1\n", ["column", "arm2"]),
        ("cart,arm1,arm2\n0,0,0\n1,1,1\n", ["column t"]),
        ("t,cart,arm1,arm2\n0,0,0,0\n1,1,one,1\n", ["line 3"]),
        ("t,cart,arm1,arm2\n1,0,0,0\n2,1,1,1\n", ["line 2", "column t = 1", "0"]),
        ("", []),
    ],
)
def test_tables_of_forces_that_cannot_be_read(tmp_path, text, words):
    file = tmp_path / "drive.csv"
    file.write_text(text)
    refusal(lambda: controlled(f"control.forces={file}"), str(file), *words)


def test_a_table_of_forces_adds_to_the_drives_until_it_ends(tmp_path):
    file = tmp_path / "drive.csv"
    file.write_text("t,arm2,arm1,cart\n0,1,2,3\n0.5,3,2,1\n1.25,3,2,1\n")
    plain, more = (
        build_system(scene, bodies_of(scene))
        for scene in (controlled(), controlled(f"control.forces={file}"))
    )
    t = np.array([0.0, 0.25, 1.25, 1.2500001])
    added = more.at(t).ahead - plain.at(t).ahead
    np.testing.assert_allclose(added, [[3, 2, 1], [2, 2, 2], [1, 2, 3], [0, 0, 0]], atol=1e-9)
    assert set(more.breakpoints) - set(plain.breakpoints) == {1.25}  # where it ends
    file.write_text("t,arm2,arm1,cart\n0,1,2,3\n0.5,3,2,1\n")
    os.utime(file, ns=(1, 1))  # an older clock, as after a copy
    scene = controlled(f"control.forces={file}")
    assert 1.25 not in build_system(scene, bodies_of(scene)).breakpoints


def bodies_of(scene):
    built = built_of(scene, MPI.COMM_SELF)
    return [arm.reduce(arm.uniform(0.5)) for arm in built.arms.values()]


def test_scenarios_change_gains_and_closures():
    changes = [{"changes": ["control.stiffness=[1e3]"]}, {"changes": ["closure.force=10.0"]}]
    gains = {"stiffness": [2e3], "damping": [20.0]}
    first, second = pose_scenarios(loop(control=gains, scenarios=changes))
    assert first.control.stiffness == (1e3,) and not first.forces
    (force,) = second.forces
    assert (force.name, force.arm, force.factor) == ("closure", "rod", 10.0)
    assert force.force == (1.0, 0.0)


FORK_PUSH = {"arm": "link", "force": [0.0, 0.0, 1.0]}


@pytest.mark.parametrize(
    ("force", "words"),
    [
        ({"arm": "arm1"}, ["forces.0.force", "expected force, moment, or table", "acts"]),
        ({"force": [1.0, 2.0]}, ["forces.0.arm", "missing"]),
        ({"arm": "boom", "force": [1.0, 2.0]}, ['forces.0.arm = "boom"', '"arm1" | "arm2"']),
        ({"arm": "arm1", "interface": "side", "force": [1.0, 2.0]},
         ['forces.0.arm = "arm1.side"', '"arm1.outboard"']),
        ({"arm": "arm1", "force": [1.0, 2.0, 3.0]}, ["forces.0.force", "array of two numbers"]),
        ({"arm": "arm1", "moment": [0.0, 0.0, 3.0]}, ["forces.0.moment", "a number", "plane"]),
        ({"arm": "arm1", "force": [1.0, 2.0], "frame": "tip"}, ["frame", '"world" | "arm"']),
        ({"arm": "arm1", "force": [1.0, 2.0], "feed_forward": False},
         ["forces.0.feed_forward = false", "the default", "[control]"]),
        ({"arm": "arm1", "force": [1.0, 2.0], "factor": 1e13}, ["forces.0.factor", "<= 1e+12"]),
        ({"arm": "arm1", "table": "nowhere.csv"}, ['forces.0.table = "nowhere.csv"', "a file"]),
        ({**FORK_PUSH, "force": [1.0, 2.0]}, ["forces.0.force", "three numbers", "[[joints]]"]),
        ({**FORK_PUSH, "moment": 2.0}, ["forces.0.moment", "array of three numbers"]),
        ({**FORK_PUSH, "interface": "nose"}, ['"link.nose"', '"link.outboard" | "link.side"']),
    ],
)  # fmt: skip
def test_forces_that_cannot_act(force, words, tmp_path):
    if force.get("arm") != "link":
        refusal(lambda: scene_from_dict(two_arm() | {"forces": [force]}), *words)
        return
    (tmp_path / "table.csv").write_text("t,swing,slide\n0,0,0\n0.2,1,0.1\n")
    tree = fork() | {"forces": [force]}
    refusal(lambda: scene_from_dict(tree, str(tmp_path / "fork.toml")), *words)


def test_tables_of_applied_forces_need_time_and_columns(tmp_path):
    """The file, its columns; and a force alone on an interface is a use of it."""
    table = tmp_path / "push.csv"
    tree = two_arm() | {"forces": [{"arm": "arm2", "table": str(table)}]}
    for text, words in (("fx,fy,mz\n0,0,0\n1,2,3\n", ["push.csv", "column t"]),
                        ("t,fx,fy\n0,0,0\n1,2,3\n", ["push.csv", "mz"])):  # fmt: skip
        table.write_text(text)
        refusal(lambda: check_forces(scene_from_dict(tree)), *words)
    (tmp_path / "table.csv").write_text("t,swing\n0,0\n0.2,1\n")
    lone = fork()
    lone["arms"], lone["joints"] = lone["arms"][:2], lone["joints"][:2]
    lone["payload"] = {"mass": 1.0}
    source = str(tmp_path / "fork.toml")
    refusal(lambda: scene_from_dict(lone, source), "side", "[[forces]]")
    lone["forces"] = [{"arm": "link", "interface": "side", "force": [0.0, 1.0, 0.0]}]
    assert (0, 1) in scene_from_dict(lone, source).used_interfaces


def test_a_wrong_interface_of_a_force_is_told_before_that_the_right_one_is_idle():
    with refused("forces.0.interface", "nose", "lug"):
        read_scene(ROOT / "demos" / "lifting_arm.toml", ('forces.0.interface="nose"',))


# -- [[closures]]: what they state, and what is refused  ------------------------------------------


TURN = "t,turn\n0,0.5\n1,1.0\n"


def changed(tree, path, value):
    """Return a scene with another value at a path; None takes it away."""
    new = copy.deepcopy(tree)
    put_at(new, path, value)
    return new


def test_coordinates_and_drives(tmp_path):
    """Rods whose length changes are coordinates behind the joints; passive joints have no drive."""
    scene = closed(tmp_path, BOOM_TABLE, boom())
    assert scene.driven == ("slew", "cylinder")
    assert scene.rigid_units == {"slew": "rad", "luff": "rad", "cylinder": "m"}
    assert scene.driven_columns == [0, 2] and scene.num_rigid == 3
    assert scene.used_interfaces == {(1, 0), (0, 1), (0, 2), (1, 1)}
    rigid = closed(tmp_path, "t,slew\n0,0\n1,1\n", changed(boom(), ("closures", 0, "length"), 1.0))
    assert rigid.driven == ("slew",) and rigid.num_rigid == 2
    other = ["closures.cylinder.stiffness=1e6", "joints.luff.passive=true"]
    soft = load_from(tmp_path, boom(), other)
    assert soft.closures[0].is_spring


def load_from(folder, tree, overrides):
    (folder / "boom.csv").write_text(BOOM_TABLE)
    motion = {"path": "joints", "file": "boom.csv"}
    data = with_keys({"material": {"name": "steel S235"}}, tree)
    return scene_from_dict(with_keys(data, {"motion": motion}), str(folder / "a.toml"), overrides)


@pytest.mark.parametrize(
    ("keys", "count"),
    [
        ({"kind": "ball"}, 3),
        ({"kind": "pin", "axis": [0, 0, 2]}, 5),
        ({"kind": "slider", "axis": [1, 1, 0]}, 5),
        ({"kind": "universal", "axis": [0, 0, 1], "cross_axis": [1, 0, 0]}, 4),
        ({"kind": "rod", "length": 0.1}, 1),
    ],
)
def test_kinds(tmp_path, keys, count):
    """As many equations as the field has, all of them zero where both frames are the same."""
    one = {"name": "foot", "between": ["rocker", "crank"]} | keys
    loops = loops_of(closed(tmp_path, TURN, with_keys(four_bar(), {"closures": [one]})))
    assert loops is not None and loops.count == count
    assert np.isfinite(loops.lengths).all()


def in_plane(kind, **keys):
    """Return the plane slider-crank or four-bar that states its loop as [[closures]]."""
    tree = {key: value for key, value in loop_tree(kind).items() if key != "closure"}
    one = {"name": "end", "kind": kind, "between": [tree["arms"][-1]["name"], "ground"]}
    return tree | {"closures": [one | keys]}


def test_the_plane_has_closures_that_are_its_closure():
    named = {"name": "end"}
    for key in ("axis", "direction"):
        found = scene_from_dict(in_plane("slider", **{key: [2.0, 0.0]}))
        assert found == loop("slider", closure=named | {"direction": [2.0, 0.0]})
    pin = in_plane("pin", point=[0.25, 0.0])
    pin["motion"] |= {"elbow": -1}
    assert scene_from_dict(pin) == loop("pin", closure=named)
    # A third number says nothing new.
    for kind, flat, keys in (
        ("slider", {"axis": [2.0, 0.0]}, {"axis": [2.0, 0.0, 0.0]}),
        ("pin", {"point": [0.25, 0.0]}, {"point": [0.25, 0.0, 0.0], "axis": [0.0, 0.0, 1.0]}),
    ):
        (one,), (other,) = (
            loops_of(scene_from_dict(in_plane(kind, **given))).ties for given in (flat, keys)
        )
        np.testing.assert_array_equal(one.point, other.point)
        normals = [[k.e for k in tie.equations] for tie in (one, other)]
        np.testing.assert_array_equal(*normals)
    for keys, *words in (
        ({"point": [0.2, 0.0, 0.1]}, "closures.0.point", "two numbers"),
        ({"axis": [1, 0, 0]}, "closures.0.axis", "[0, 0, 1]"),
        ({"between": ["crank", "ground"]}, "closures.0.kind", "the last arm and the ground"),
        ({"rpy": [0.0, 0.0, 1.0]}, "closures.0.kind", "[[joints]]"),
    ):
        with refused(*words):
            scene_from_dict(in_plane("pin", **keys))


def test_both_spellings_of_a_loaded_slider_are_the_same():
    """The same scene and the same bits; changes are understood in both spellings."""
    line = {"point": [0.0, 0.01]}
    was = loop_tree(closure=line | {"direction": [1.0, 0.1], "force": -200.0})
    size = np.hypot(1.0, 0.1)
    now = in_plane("slider", axis=[1.0, 0.1], name="closure", **line)
    force = {"name": "closure", "arm": "rod", "force": [1.0 / size, 0.1 / size], "factor": -200.0}
    now["forces"] = [force]
    old, new = map(scene_from_dict, (was, now))
    assert old == new and old.old_words and not new.old_words
    assert ["[closure]" in one for one in implausible(old)] == [True] and not implausible(new)
    a, b = (simulated(one).trajectory for one in (was, now))
    np.testing.assert_array_equal(a.q_r, b.q_r)
    np.testing.assert_array_equal(a.closure_force, b.closure_force)
    for was, now in (
        ("closure.force=7", "forces.closure.factor=7.0"),
        ("closure.side=-1", "motion.elbow=-1"),
        ("closure.point=[0.0, 0.02]", "closures.0.point=[0.0, 0.02]"),
    ):
        assert scene_from_dict(old.to_tree(), overrides=[was]) == scene_from_dict(
            new.to_tree(), overrides=[now]
        )
    turned = scene_from_dict(new.to_tree(), overrides=["closure.direction=[0.0, 2.0]"])
    assert turned.forces[0].force == (0.0, 1.0) and turned.forces[0].factor == -200.0


@pytest.mark.parametrize(
    ("tree", "changes", "words"),
    [
        (loop_tree(), ["closure.side=0"], ("motion.elbow = 0", "-1 | 1")),
        (loop_tree(), ["closure.sides=1"], ("unknown key closures.0.sides", "name, kind")),
        (
            loop_tree(),
            ["closure.force=1e13"],
            ("forces.0.factor", "a number", "<= 1e+12"),
        ),
        (loop_tree(), ["closure.force=much"], ('forces.0.factor (closure) = "much"', "a number")),
        (loop_tree(), ["closure=3"], ("closure:", "[[closures]]")),
        (loop_tree() | {"closure": 3}, [], ("closure:", "[[closures]]")),
        (
            loop_tree(closure={"point": [0.0, 1e5]}),
            [],
            ("closures.0.point", "two numbers"),
        ),
        (
            in_plane("slider", axis=[1, 0]) | {"closure": {"side": 1}},
            [],
            ("closure:", "[[closures]]"),
        ),
    ],
)
def test_keys_of_the_closure_are_told_in_words_of_now(tree, changes, words):
    with refused(*words):
        scene_from_dict(tree, overrides=changes)


CLOSURE = ("closures", 0)
REFUSED = [
    ((*CLOSURE, "kind"), "hinge", ("closures.0.kind", '"ball"')),
    ((*CLOSURE, "axis"), None, ("closures.0.axis", "pin")),
    ((*CLOSURE, "axis"), [0, 0, 0], ("closures.0.axis", "length zero")),
    ((*CLOSURE, "cross_axis"), [1, 0, 0], ("closures.0.cross_axis", "with kind")),
    ((*CLOSURE, "length"), 0.2, ("closures.0.length", "none", "with kind")),
    ((*CLOSURE, "stiffness"), 1e5, ("closures.0.stiffness", "with kind")),
    ((*CLOSURE, "name"), "knee", ("closures.0.name", "no joint or other closure")),
    ((*CLOSURE, "name"), "t", ("closures.0.name", "the time")),
    ((*CLOSURE, "between"), ["rocker.tip", "ground"], ("closures.0.between", '"rocker.outboard"')),
    ((*CLOSURE, "between"), ["ground", "rocker"], ("closures.0.between", '"crank" | ')),
    ((*CLOSURE, "between"), ["rocker", "wall"], ("closures.0.between", '"ground"')),
    ((*CLOSURE, "between"), ["rocker", "rocker"], ("closures.0.between", "two arms")),
    (("closures",), [], ("joints.1.passive", "[[closures]]")),
    (("joints", 0, "passive"), True, ("joints.0.passive", "driven")),
    (("joints", 1, "gear_stiffness"), 1e4, ("joints.1.gear_stiffness", "passive = true")),
    (("arms", 1, "joint_stiffness"), 1e4, ("arms.1.gear_stiffness", "passive = true")),
    (("motion", "initial_joints"), [0.1], ("motion.initial_joints", "3 numbers")),
    (("objective", "kind"), "eigenfrequency", ("objective.attached", '"none"')),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value", "words"), REFUSED)
def test_refused(tmp_path, path, value, words):
    with refused("scene.toml", *words):
        closed(tmp_path, TURN, changed(four_bar(), path, value))


def test_refused_with_others(tmp_path):
    """A spring under control, a universal joint of one direction, closures in the plane."""
    spring = changed(boom(), (*CLOSURE, "stiffness"), 1e6)
    with refused("closures.0.stiffness", "[control]"):
        gains = {"stiffness": [1e5, 1e7], "damping": [1e3, 1e5]}
        closed(tmp_path, BOOM_TABLE, spring, control=gains)
    cross = {"kind": "universal", "axis": [0, 0, 1], "cross_axis": [0, 0.1, 1]}
    one = four_bar()["closures"][0] | cross
    with refused("closures.0.cross_axis", "across"):
        closed(tmp_path, TURN, with_keys(four_bar(), {"closures": [one]}))
    tree = read_scene(TWO_ARM).to_tree()
    end = {"name": "end", "kind": "ball", "between": ["arm2", "ground"]}
    with refused("closures.0.kind", "one pin or slider", "[[joints]]"):
        scene_from_dict(tree | {"closures": [end]})
    with refused("motion.initial_joints", "[[closures]]"):
        tree = four_bar()
        joints = [{k: v for k, v in one.items() if k != "passive"} for one in tree["joints"]]
        closed(tmp_path, TURN, with_keys(tree, {"joints": joints, "closures": []}))
