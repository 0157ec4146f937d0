"""[[closures]]: what they state, and what is refused."""

import copy
from typing import Any

import numpy as np
import pytest
from loops import BOOM_TABLE, boom, closed, four_bar
from machines import loop, loop_tree, with_keys
from runs import TWO_ARM, refused
from scenes import put_at

from dolfinopt.multibody.machine import loops_of
from dolfinopt.scene.load import load_scene, scene_from_dict

pytestmark = pytest.mark.serial
TURN = "t,turn\n0,0.5\n1,1.0\n"


def changed(tree: dict, path: tuple[Any, ...], value: Any) -> dict:
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
    assert loops is not None and len(loops.given) == count
    assert np.isfinite(loops.lengths).all()


def in_plane(kind: str, **keys: Any) -> dict:
    """Return the plane slider-crank or four-bar that states its loop as [[closures]]."""
    tree = {key: value for key, value in loop_tree(kind).items() if key != "closure"}
    one = {"name": "end", "kind": kind, "between": [tree["arms"][-1]["name"], "ground"]}
    return tree | {"closures": [one | keys]}


def test_the_plane_has_closures_that_are_its_closure():
    found = scene_from_dict(in_plane("slider", axis=[2.0, 0.0, 0.0]))
    assert found == loop("slider", closure={"direction": [2.0, 0.0]}) and not found.closures
    found = scene_from_dict(in_plane("pin", point=[0.25, 0.0, 0.0], side=-1))
    assert found == loop("pin")
    up = {"axis": [0, 0, 1]}
    for keys in ({"point": [0.2, 0.0, 0.1]}, {"axis": [1, 0, 0]}, {"between": ["crank", "ground"]}):
        with refused("closures.0.kind", "the last arm and the ground", "[[joints]]"):
            scene_from_dict(in_plane("pin", **(up | keys)))


CLOSURE = ("closures", 0)
REFUSED = [
    ((*CLOSURE, "kind"), "hinge", ("closures.0.kind", '"ball"')),
    ((*CLOSURE, "axis"), None, ("closures.0.axis", "pin")),
    ((*CLOSURE, "axis"), [0, 0, 0], ("closures.0.axis", "length zero")),
    ((*CLOSURE, "cross_axis"), [1, 0, 0], ("closures.0.cross_axis", "closures.kind")),
    ((*CLOSURE, "length"), 0.2, ("closures.0.length", "none", "closures.kind")),
    ((*CLOSURE, "stiffness"), 1e5, ("closures.0.stiffness", "closures.kind")),
    ((*CLOSURE, "side"), -1, ("closures.0.side", "motion.initial_joints")),
    ((*CLOSURE, "name"), "knee", ("closures.0.name", "no joint or other closure")),
    ((*CLOSURE, "name"), "t", ("closures.0.name", "the time")),
    ((*CLOSURE, "between"), ["rocker.tip", "ground"], ("closures.0.between", '"outboard"')),
    ((*CLOSURE, "between"), ["ground", "rocker"], ("closures.0.between", '"crank.outboard"')),
    ((*CLOSURE, "between"), ["rocker", "wall"], ("closures.0.between", '"ground"')),
    ((*CLOSURE, "between"), ["rocker", "rocker"], ("closures.0.between", "two arms")),
    (("closures",), [], ("joints.1.passive", "[[closures]]")),
    (("joints", 0, "passive"), True, ("joints.0.passive", "driven")),
    (("simulation", "integrator"), "generalized-alpha", ("simulation.integrator", '"radau"')),
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
    tree = load_scene(TWO_ARM).to_tree()
    end = {"name": "end", "kind": "ball", "between": ["arm2", "ground"]}
    with refused("closures.0.kind", "one pin or slider", "[[joints]]"):
        scene_from_dict(tree | {"closures": [end]})
    with refused("motion.initial_joints", "[[closures]]"):
        tree = four_bar()
        joints = [{k: v for k, v in one.items() if k != "passive"} for one in tree["joints"]]
        closed(tmp_path, TURN, with_keys(tree, {"joints": joints, "closures": []}))
