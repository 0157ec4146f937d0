"""The scene: defaults, inheritance, overrides, and one helpful line for every kind of bad input."""

import json
import math
import pickle
import re

import pytest
from pydantic import ValidationError
from runs import TWO_ARM, refusal
from scenes import ARM, FILE, MATERIAL, changed, minimal, refused

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Arm, Scene, pose_scenarios, read_scene, scene_from_dict
from dolfinopt.scene.messages import describe_keys, implausible
from dolfinopt.scene.tables.arms import MAX_CELLS
from dolfinopt.scene.tables.objective import Constraints, Objective
from dolfinopt.scene.tables.responses import DECLARED

pytestmark = pytest.mark.serial  # nothing here knows of ranks

JOINTS = {"path": "joints", "file": str(TWO_ARM)}


def test_demo_holds_the_defaults():
    demo = read_scene(TWO_ARM)
    ends = ["arms.passive=0.0", "simulation.stiffening=false"]  # as in the paper
    assert scene_from_dict(minimal(name="two-arm manipulator"), overrides=ends) == demo
    assert demo.source == str(TWO_ARM)
    simulation = demo.simulation  # the demo leaves these out
    assert simulation.sample == 1e-3


def test_arm_takes_missing_keys_from_the_arm_before():
    data = minimal(3)
    data["arms"][0] |= {"cells": [50, 4], "passive": 0.1}
    data["arms"][1] |= {"length": 0.8, "passive": 0.05}
    first, second, third = scene_from_dict(data).arms
    assert first == Arm(**ARM, cells=(50, 4), passive=0.1)
    assert second == Arm(**ARM | {"name": "arm2", "length": 0.8}, cells=(50, 4), passive=0.05)
    assert third == second.model_copy(update={"name": "arm3"})


def test_name_defaults_to_the_file_and_windows_files_are_read(tmp_path):
    path = tmp_path / "crane.v2.toml"
    path.write_text(TWO_ARM.read_text().partition("\n")[2])
    assert read_scene(path).name == "crane.v2"
    assert scene_from_dict(minimal()).name == "scene"
    path.write_bytes(b"\xef\xbb\xbf" + TWO_ARM.read_bytes().replace(b"\n", b"\r\n"))
    assert read_scene(path) == read_scene(TWO_ARM)


def test_scene_is_frozen_hashable_and_picklable():
    scene = read_scene(TWO_ARM)
    for table, key in ((scene.payload, "mass"), (scene, "name")):
        with pytest.raises(ValidationError, match="frozen"):
            setattr(table, key, 3.0)
    other = read_scene(TWO_ARM, ["payload.mass=3"])
    assert len({scene, read_scene(TWO_ARM), other}) == 2
    restored = pickle.loads(pickle.dumps(scene))
    assert restored == scene and restored.source == scene.source
    one, two = (scene_from_dict(minimal(name="x"), source) for source in ("a.toml", "b.toml"))
    assert one == two  # whatever their source
    assert scene != str(TWO_ARM)


def test_ends_are_solid_unless_the_scene_says_otherwise():
    for keys, length in (
        ({}, 0.015),  # a quarter of the height
        ({"height": 0.8}, 0.1),  # a tenth of the length
        ({"passive": 0.0}, 0.0),
        ({"passive": 0.02}, 0.02),
        ({"mesh": "a.msh"}, 0.0),  # has groups of its own
        ({"mesh": "a.msh", "passive": 0.02}, 0.02),
    ):
        assert Arm(**ARM | keys).solid_ends == pytest.approx(length, rel=1e-15)
    data = scene_from_dict(minimal()).to_dict()  # the default is not frozen by writing it
    ends = [arm.solid_ends for arm in scene_from_dict(data, overrides=["arms.height=0.1"]).arms]
    assert ends == [0.025, 0.025]


@pytest.mark.parametrize(
    ("override", "read", "value"),
    [
        ("payload.mass=4", lambda s: s.payload.mass, 4.0),
        ("name=crane = big", lambda s: s.name, "crane = big"),
        ('name="crane"', lambda s: s.name, "crane"),
        ("design.projection=false", lambda s: s.design.projection, False),
        ("motion.gravity=[0, -9.81]", lambda s: s.motion.gravity, (0.0, -9.81)),
        ("payload={mass=1, inertia=2}", lambda s: (s.payload.mass, s.payload.inertia), (1, 2)),
        ("arms.0.length=0.8", lambda s: [a.length for a in s.arms], [0.8, 1.0, 1.0]),
        ("arms.arm2.length=0.8", lambda s: [a.length for a in s.arms], [1.0, 0.8, 1.0]),
        ("arms.length=0.8", lambda s: [a.length for a in s.arms], [0.8, 0.8, 0.8]),
        ("arms.2.name=tip", lambda s: [a.name for a in s.arms], ["arm1", "arm2", "tip"]),
        ("arms.2={name='tip', length=2}", lambda s: s.arms[2].length, 2.0),
    ],
)
def test_override(override, read, value):
    plain = scene_from_dict(minimal(3))
    scene = scene_from_dict(minimal(3), overrides=[override])
    assert read(scene) == value
    assert scene_from_dict(plain.to_tree(), overrides=[override]) == scene
    assert scene != plain or override == "design.projection=false"


def test_later_override_wins():
    scene = read_scene(TWO_ARM, ["arms.length=0.5", "arms.arm1.length=0.7", "payload.mass=1"])
    assert [arm.length for arm in scene.arms] == [0.7, 0.5]
    assert scene.payload.mass == 1.0
    scene = read_scene(TWO_ARM, ["arms.1.name=fore arm", "arms.fore arm.length=0.6"])
    assert scene.arms[1].length == 0.6  # found by its new name


@pytest.mark.parametrize(
    ("override", "words"),
    [
        *((f"payload.mass{number}", ["payload.mass = ", "number >= 0"])
          for number in ("=-1", "=heavy", "=", "=1\nname='x'", "=" + 600 * "[")),
        ("payload.mass.x=1", ["payload.mass.x", "set payload.mass as a whole"]),
        ("payload.mass", ["key.path=value"]),
        ("motion.gravity.1=1", ["unknown key motion.gravity.1", "an array of two numbers"]),
        ("payloads.mass=1", ["unknown key payloads", "payload?", "optimizer"]),
        ("arms.lenght=1", ["unknown key arms.lenght", "arms.length?", "arm2"]),
        ("arms.arm3.length=1", ["unknown key arms.arm3", "0, 1, arm1, arm2"]),
        ("arms." + 5000 * "1" + ".length=1", ['unknown key arms."111']),
        ("arms.1.grid=a.geo", ["unknown key arms.1.grid (arm2)", "name, length"]),
        ("arms.1.length=0", ["arms.1.length (arm2) = 0", ">= 1e-06", "[m]"]),
        ("arms.arm2.length=0", ["arms.1.length (arm2) = 0"]),
        ("arms=3", ["arms = 3", "[[arms]]"]),
        ("material=3", ["material = 3", "name of a material", "a table"]),
        ("=1", ["key.path=value"]),
        ("", ["key.path=value"]),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else "",
)  # fmt: skip
def test_bad_override_is_named(override, words):
    shown = override.replace("\n", "\\n") if len(override) <= 80 else f"{override[:77]}..."
    before = "payload.inertia=0.1"  # not to blame
    refused(minimal(), f"{FILE} with --set {shown}: ", *words, overrides=[before, override])


@pytest.mark.parametrize(
    ("path", "value", "overrides", "start"),
    [
        ("payload.mass", -1, ["payload.inertia=1", "motion.radius=1"], ": payload.mass = -1: "),
        ("payload.inertia", 1, ["payload.mass=1", "payload.mass=-2"],
         " with --set payload.mass=-2: payload.mass = -2: "),
        ("arms", 5, ["arms.length=1"], ": arms = 5: "),
        ("arms", [5], ["arms.0.length=1"], ": arms.0 = 5: "),
        ("material", [1], ["material.density=1"], ": material = [1]: "),
    ],
)  # fmt: skip
def test_the_file_or_the_last_override_is_blamed(path, value, overrides, start):
    assert refused(changed(path, value), overrides=overrides).startswith(FILE + start)


# Keys, values, what is allowed instead: what no type or range of a key says.
BAD_VALUES = [
    ("name", ["", "  ", 201 * "x"], "1 to 200 printable characters"),
    ("name", ["two\nlines"], "on one line"),
    ("arms.0.material", ["steel"], 'did you mean "steel S235" or "steel S355"'),
    ("arms.0.name", ["a/b", "", "-x", " x", "x ", "x\n", "..", "ärm"], "letters, digits"),
    ("arms.0.name", ["12"], "not a digit"),
    ("arms.0.name", [65 * "a"], "1 to 64"),
    ("arms.1.name", ["Arm1_R12"], "files of both parts would have one name"),
    ("arms.0.design arms.1.design", ["arm2"], "an earlier arm with a design of its own"),
    ("arms.0.centre", [[0, 0, 0]], "none with rigid = false"),
    ("arms.0.mass arms.0.inertia", [1.0], "none with rigid = false"),
    ("arms.0.cells", [[0, 12], [0, 0]], "two integers >= 1"),
    ("arms.0.cells", [[MAX_CELLS + 1, 1]], "<= 100000"),
    ("arms.0.cells", [[200], [200.0, 12], "200x12"], "two integers"),
    ("arms.0.cells", [[200, 12, 1]], "needs [[joints]]"),
    ("arms.0.cells", [[200, 12, 1, 1]], "an array of three integers"),
    ("arms.0.mesh_size arms.0.interface_offset", [0.01], "without mesh"),
    ("arms.0.cell_shape", ["triangle"], "without mesh"),
    ("arms.0.symmetric", ["z", "yz", "extruded"], "only with a solid arm"),
    ("arms.0.hollow", [True, "oval"], "false without cells = [nx, ny, nz]"),
    ("arms.0.hollow", ["absent.msh"], "there is no /"),
    ("arms.0.wall arms.0.min_wall arms.0.max_wall", [0.01], "none with hollow = false"),
    ("arms.0.passive", [0.5], "less than half of length = 1.0 [m]"),
    ("arms.0.bearing_stiffness arms.0.bearing_damping", [[1e6, 1e6, 1e6]], "six numbers >= 0"),
    ("motion.rpy", [[0, 0, 0]], 'with path = "arc"'),
    ("motion.initial_joints", [[0.1]], 'with path = "arc"'),
    ("motion.start", [[0.0, 1.0]], 'the default, with path = "arc"'),
    ("motion.file", ["absent.csv"], "there is no /"),
    ("motion.dwells", [[[0.5, 0.4]], [[0.5, 0.7], [0.6, 0.8]]], "start before end, one after"),
    ("motion.dwells", [[[2.5, 3.5]]], "dwells that end by motion.horizon = 3 [s]"),
    ("constraints.settling_after", [1.2], "at most 1.1 [s], from motion.duration = 1.9"),
    ("motion.horizon", [1.0], "at least motion.duration = 1.9 [s]"),
    ("motion.acceleration_share", [0.3], '0.25, the default, with law = "quintic"'),
    ("motion.gravity", [[0, 0, -9.81]], "two numbers without [[joints]]"),
    ("payload.inertia", [[1, 1]], "an array of six numbers"),
    ("payload.arm", ["arm1"], "none without [[joints]]"),
    ("reduction.coordinates", [2], 'an integer >= 3 with reduction.method = "craig-bampton"'),
    ("reduction.coordinates", [5178], "at most 5177"),  # 2*199*13 + 3
    ("reduction.coordinates", [0, 1e-7, 0.6], "an integer >= 1 | a number >= 1e-06 and <= 0.5"),
    ("reduction.frequencies", [[5.0]], 'none with method = "craig'),
    ("simulation.sample", [3.1], "motion.horizon = 3.0 [s]"),
    ("simulation.sample", [1e-9], "between 3e-07 and"),
    ("objective.load_cases", [3001], "at most 3000"),
    ("objective.loads", [[]], "at least one load [F_x, F_y, moment]"),
    ("objective.loads", [[[0, 0, 0]]], "between 1e-09 and"),
    ("objective.loads", [[[0, 1e-300, 0]], [[0, 1e10, 0]]], "between 1e-09 and 1e+09 [N, N m]"),
    ("objective.loads", [[[0, 1]], [0, 1, 0]], "an array of arrays of three numbers"),
    ("objective.effort_weights constraints.peak_force", [[1.0, 2.0]],
     "3 numbers, for cart, arm1, arm2"),
    ("material", [5], "a table with the keys name, kind, young_modulus, poisson_ratio"),
    ("motion", [[1, 2]], "a table with the keys path, radius"),
    ("arms", [[]], "[[arms]], at least one"),
]  # fmt: skip
# Values that are shown otherwise than they are, and contradictions shown at another key.
SHOWN = [
    ("material.young_modulus", 10**400, "material.young_modulus = 2**1328...", "a number >= 1 and"),
    ("objective.load_cases", 16**5000, "objective.load_cases = 2**20000...", "at most 3000"),
    ("payload.mass", [[[[1.0]]]], "payload.mass = [[[...]]]", "a number >= 0"),
    ("arms", {"name": "arm1"}, 'arms = { name = "arm1" }', "[[arms]], at least one"),
    ("arms.0.name", "ARM2", 'arms.1.name = "arm2"', "no other arm has"),
    ("arms.0.name", "arm2_face", 'arms.1.name = "arm2"', "both parts would have one name"),
    ("motion.path", "joints", "motion.file = None (default)", "table (CSV)"),
    ("material.name", "stone", 'material.name = "stone"', "dolfinopt keys material"),
    ("design.volume_fraction", 5e-4, "design.minimum = 0.001 (default)", "at most volume_fraction"),
    ("design.initial", 1e-3, "design.minimum = 0.001 (default)", "less than initial = 0.001"),
]


def written(value):
    """Return a value as messages show it."""
    text = json.dumps(value, ensure_ascii=False)
    for ours, theirs in (("Infinity", "inf"), ("NaN", "nan"), ("null", "None")):
        text = text.replace(ours, theirs)
    return text


@pytest.mark.parametrize(
    ("path", "values", "allowed"),
    [(path, values, allowed) for paths, values, allowed in BAD_VALUES for path in paths.split()],
)
def test_bad_value(path, values, allowed):
    for value in values:
        message = refused(changed(path, value))
        place, _, reason = message.removeprefix(f"{FILE}: ").partition(": expected ")
        key, _, found = place.partition(" = ")
        assert key.partition(" (")[0] == path
        assert found == written(value) if len(found) < 60 else found[:50] in written(value)
        assert allowed in reason


@pytest.mark.parametrize(("path", "value", "shown", "allowed"), SHOWN, ids=range(len(SHOWN)))
def test_value_that_is_shown_otherwise(path, value, shown, allowed):
    message = refused(changed(path, value))
    place, _, reason = message.partition(": expected ")
    assert shown in place.replace(" (arm2)", "").replace(" (ARM2)", "") and allowed in reason


def test_a_copy_is_checked_as_a_file_is():
    scene = read_scene(TWO_ARM)
    assert scene.model_copy(update={"name": "other"}).source == scene.source
    for table, values, words in (
        (scene.payload, {"mass": -1.0}, ["payload: mass = -1.0"]),
        (scene.payload, {"mas": 1.0}, ["payload: mas"]),
        (scene.motion, {"horizon": 1.0}, ["motion: horizon", "motion.duration"]),
        (scene, {"arms": (scene.arms[0],) * 2}, ["arms.1.name", "no other arm"]),
    ):
        refusal(lambda: table.model_copy(update=values), *words)  # noqa: B023


# Tables that a small scene does not have: test_regions, test_joints, test_machine_scenes.
ELSEWHERE = ("arms.regions", "arms.interfaces", "control", "closure", "joints", "forces",
             "constraints.stiffness.", "scenarios")  # fmt: skip
OPTIONAL = {info.key for info in describe_keys() if info.default == "none"}
OPTIONAL |= {"arms.cells", "design.volume_fraction"}  # with a mesh file, or a limited mass
KEYS = {info.key: info.allowed for info in describe_keys() if not info.key.startswith(ELSEWHERE)}


def beyond(allowed):
    """Yield a value of another type than is allowed, and the next numbers beyond the range."""
    yield {"x": 1}
    yield from [] if "a string" in allowed or "name of" in allowed else ["nonsense", None]
    yield from [] if "true or false" in allowed or " | true" in allowed else [True]
    kind = re.match(r"(a number|an integer)([^|]*)", allowed)
    for sign, text in re.findall(r"([<>]=?) (\S+)", kind[2] if kind else ""):
        limit, way = float(text), math.inf if sign[0] == "<" else -math.inf
        if kind[1] == "an integer":
            yield int(limit) + (1 if sign[0] == "<" else -1)
        else:
            yield limit if len(sign) == 1 else math.nextafter(limit, way)


@pytest.mark.parametrize("key", KEYS)
def test_every_key_refuses_what_is_beyond_its_range(key):
    for value in beyond(KEYS[key]):
        if value is None and key in OPTIONAL:
            continue
        message = refused(changed(key.replace("arms.", "arms.0."), value))
        place, _, reason = message.removeprefix(f"{FILE}: ").partition(": expected ")
        assert place.partition(" = ")[0].partition(" (")[0] == key.replace("arms.", "arms.0.")
        assert reason.startswith(KEYS[key]) or KEYS[key].startswith(reason.partition(" with ")[0])


KRYLOV, BALANCED = {"reduction.method": "krylov"}, {"reduction.method": "balanced"}
LINE = {"motion.path": "line"}
SHARED = {"arms.1.design": "arm1"}
CONTRADICTIONS = [
    (2, {"arms.0.gear_ratio": 9.0}, "arms.0.gear_ratio", "used only with rotor_inertia"),
    # changes, the key that is shown, what is allowed
    (2, LINE | {"motion.radius": 2.0}, "motion.radius = 2.0", "1.0, the default, with path"),
    (2, LINE | {"motion.end": [-1, 0]}, "motion.end = [-1, 0]", "another point than motion.start"),
    (2, {"motion.base": "fixed", "motion.cart_follow": 0.2}, "motion.cart_follow = 0.2", "0.5"),
    (2, {"motion.file": str(TWO_ARM)}, "motion.file = ", 'none with path = "arc"'),
    (2, {"motion.path": "points"}, "motion.file = None (default)", 'with path = "points"'),
    (2, {"motion": JOINTS | {"elbow": 1}}, "motion.elbow = 1", "-1, the default"),
    (1, {"motion.cart_follow": 0.0}, "motion.cart_follow = 0.0", "0.5, the default, with one arm"),
    (1, {"motion.base": "fixed"}, 'motion.base = "fixed"', '"cart" with one arm'),
    # Exact by default: the way out is told.
    (2, BALANCED | {"objective": {"kind": "integral_compliance"}}, "reduction.method",
     'objective.gradient = "exact" (state "esl")'),
    *((2, KRYLOV | {"reduction.frequencies": twice}, "reduction.frequencies", "none of them twice")
      for twice in ([], [5.0, 5.0])),
    *((2, BALANCED | {"reduction.frequencies": one}, "reduction.frequencies", "the lower one first")
      for one in ([0.0], [9.0, 9.0])),
    (2, KRYLOV | {"reduction.frequencies": [0.0, 9.0], "reduction.coordinates": 5},
     "reduction.coordinates = 5", "an integer >= 6"),
    (2, BALANCED | {"damping.stiffness_proportional": 0.0},
     "damping.stiffness_proportional = 0.0", 'a number > 0 with reduction.method = "balanced"'),
    (2, BALANCED | {"objective.gradient": "exact"}, 'reduction.method = "balanced"',
     '"craig-bampton", "modal" or "krylov" with objective.gradient = "exact"'),
    (2, {"arms.1.cells": [2, 1], "reduction.coordinates": 8}, "reduction.coordinates",
     'at most 7, the degrees of freedom of arm "arm2" with cells = [2, 1]'),
    (2, {"arms.1.height": -1}, "arms.1.height (arm2) = -1", "(height in the plane of motion"),
    # An arm that shares a design.
    (2, SHARED | {"arms.1.rigid": True}, "arms.1", "only one of design, rigid and a body"),
    (2, {"arms.1.design": "arm3"}, "arms.1.design", 'design of its own: "arm1"'),
    # Limits and what they need.
    (2, {"objective.kind": "mass", "constraints.mass": 1.0}, "objective", "under [constraints]"),
    (2, {"constraints.tip_deflection": [1e-3, 1e-3, 1e-3]}, "constraints.tip_deflection = [",
     "2 numbers, for arm1, arm2"),
    (2, {"constraints.tip_deflection": [1e-3, 0.0]}, "constraints.tip_deflection = [0.001, 0.0]",
     "a number >= 1e-15 and <= 10000 | an array of numbers"),
    (2, {"constraints.first_frequency": [10.0, 20.0], "arms.1.rigid": True},
     "constraints.first_frequency = [10.0, 20.0]", "1 number, for arm1"),
    (2, BALANCED | {"objective": {"kind": "static", "gradient": "exact"},
                    "constraints.deviation": 0.01}, "reduction.method", "has no adjoint"),
    *((2, {"scenarios": [{"changes": ["payload.mass=4"]}], "objective.kind": kind},
       f'objective.kind = "{kind}"', '"deviation"') for kind in ("static", "eigenfrequency")),
]  # fmt: skip


@pytest.mark.parametrize(("n_arms", "changes", "shown", "allowed"), CONTRADICTIONS)
def test_contradictions(n_arms, changes, shown, allowed):
    pairs = [part for pair in changes.items() for part in pair]
    message = refused(changed(*pairs, n_arms=n_arms), allowed)
    assert message.startswith(f"{FILE}: {shown}")


def test_whatever_is_shown_is_short_and_printable():
    refused(
        minimal(1001), "arms = ", "at most 1000 of them, found 1001"
    )  # more than any machine has
    assert len(refused(changed("objective.kind", 10_000 * "x"), "...")) < 500
    with pytest.raises(InputError) as caught:
        scene_from_dict(changed("objective.kind", "\x1b[31m\u2028\n"), "a\nb\udc80.toml")
    message = str(caught.value)
    assert message.startswith(r"a\nb\udc80.toml: objective.kind = ") and message.isprintable()
    assert r"\u001b[31m\u2028\n" in message
    for data in (5, [1], None, "name"):
        refused(data, "a table of scene keys", written(data))


@pytest.mark.parametrize(
    ("path", "unknown", "closest", "allowed"),
    [
        ("nam", "nam", "name", "name, material, interpolation, arms"),
        ("payload.mas", "payload.mas", "payload.mass", "mass, inertia"),
        ("arms.1.lenght", "arms.1.lenght (arm2)", "arms.1.length", "name, length, height"),
        ("payload.density", "payload.density", "material.density", "mass, inertia"),
        ("radius", "radius",
         "arms.interfaces.radius or motion.radius", "name, material"),
        ("tolerance", "tolerance",
         "simulation.tolerance or optimizer.tolerance or part.tolerance",
         "name, mat"),
        ("volum_fraction", "volum_fraction", "design.volume_fraction", "name, material"),
        ("arms.0.blocks", "arms.0.blocks (arm1)", None, "name, length, height, thickness, cells"),
        ("design.shared", "design.shared", "design.shared_volume", "volume_fraction, shared"),
        ("payload.x y", 'payload."x y"', None, "mass, inertia"),
        ("payload.", 'payload.""', None, "mass, inertia"),
        ("source", "source", "forces", "name, material"),
        ("_source", "_source", "forces", "name, material"),
        ("payload.1", "payload.1", None, "mass"),
    ],
)  # fmt: skip
def test_unknown_key(path, unknown, closest, allowed):
    message = refused(changed(path, 1), f"{FILE}: unknown key {unknown}; ", allowed)
    assert (f"did you mean {closest}?" in message) if closest else "did you mean" not in message


def test_misspelt_key_comes_before_the_missing_one():
    refused(minimal(payload={1: 2}), "unknown key payload.1", "mass")  # a key that is no string
    data = minimal()
    data["material"]["youngs_modulus"] = data["material"].pop("young_modulus")
    words = "unknown key material.youngs_modulus", "material.young_modulus?"
    refused(data, *words)


@pytest.mark.parametrize(
    ("table", "key", "described"),
    [
        ("material", "young_modulus", "[Pa]"), ("material", "density", "[kg/m3]"),
        ("arms.0", "name", "unique name"), ("arms.0", "length", "[m]"),
        ("arms.1", "name", "unique name"), ("motion", "path", "path of the end-effector"),
        ("payload", "mass", "[kg]"), ("", "material", ""), ("", "arms", ""),
    ],
)  # fmt: skip
def test_missing_key(table, key, described):
    data = minimal()
    del (data["arms"][int(table[-1])] if "arms" in table else data[table] if table else data)[key]
    named = f"{table}.{key}".strip(".") + " (arm1)" * (key == "length")
    named = "material.young_modulus" if key == "material" else named
    refused(data, f"{FILE}: missing key {named} (", described)


@pytest.mark.parametrize(
    ("table", "remedy"), [("motion", "[motion] with path"), ("payload", "[payload] with mass")]
)
def test_motion_and_payload_are_stated(table, remedy):
    """Not even a scene without dynamic responses has them by default: every run simulates."""
    data = minimal(objective={"kind": "static"})
    [[key, value]] = data.pop(table).items()
    refused(data, f"{FILE}: missing table [{table}] (", remedy)
    whole = scene_from_dict(minimal(objective={"kind": "static"}))
    assert scene_from_dict(data, overrides=[f"{table}.{key}={value}"]) == whole


@pytest.mark.parametrize(
    ("tables", "gradient"),
    [
        ({}, "esl"),
        ({"constraints": {"mass": 2.0, "tip_deflection": 1.0, "first_frequency": 1.0}}, "esl"),
        *(({"constraints": {one: 9.0}}, "exact") for one in ("deviation", "compliance", "effort")),
        ({"constraints": {"deviation": None}}, "esl"),  # as a summary has it
        ({"constraints": {"deviation": 0.01}, "objective": {"gradient": "esl"}}, "esl"),
        ({"objective": {"gradient": "exact"}}, "exact"),
        *(({"objective": {"kind": kind}}, "exact") for kind in ("integral_compliance", "settling")),
        ({"objective": {"kind": "mass"}, "constraints": {"stress": 6e7}}, "exact"),
    ],
)
def test_gradient_is_exact_but_of_the_esl_objective_alone(tables, gradient):
    scene = scene_from_dict(minimal(**tables))
    assert scene.objective.gradient == gradient
    assert scene_from_dict(scene.to_dict()) == scene
    # What is not stated follows a limit or an objective that is added later; what is stated stays.
    later = "esl" if tables.get("objective", {}).get("gradient") == "esl" else "exact"
    for change in ("constraints.settling=1e-3", "objective.kind=deviation"):
        assert scene_from_dict(scene.to_tree(), overrides=[change]).objective.gradient == later


def test_every_key_is_described_with_a_unit_and_its_default():
    keys = describe_keys()
    assert len({info.key for info in keys}) == len(keys)
    tables = {info.key.partition(".")[0] for info in keys}
    assert tables == Scene.model_fields.keys()
    for info in keys:
        assert info.description[-1] == "]" and " [" in info.description, info
        assert info.allowed and not info.allowed.endswith(" "), info
    defaults = {info.key: info.default for info in keys}
    assert defaults["arms.cells"] == "[200, 12]"
    assert defaults["reduction.method"] == '"craig-bampton"'
    required = {key for key, default in defaults.items() if not default}
    assert required == {
        "name",  # of the file
        *(f"material.{key}" for key in MATERIAL),
        *(f"arms.{key}" for key in ARM),
        "motion.path", "payload.mass", "forces.arm",
        "scenarios.changes", "arms.regions.kind",  # of every one that there is
        "closures.kind", "closures.between",
        "arms.interfaces.name", "arms.interfaces.point", "constraints.stiffness.arm",
        "control.stiffness", "control.damping",  # of tables that may be absent
        *(f"joints.{key}" for key in ("name", "type", "parent", "child")),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("scenario", "words"),
    [
        ({"changes": 5}, ["scenarios.0.changes = 5", "an array of strings"]),
        ({"changes": [], "weight": 0}, ["scenarios.0.weight = 0", "a number >= 1e-09"]),
        ({"weight": 1.0}, ["missing key scenarios.0.changes"]),
        ({"changes": [], "wait": 1.0}, ["unknown key scenarios.0.wait", "scenarios.0.weight?"]),
        ({"changes": ["arms.length=2"]}, ["motion, control, closures, payload, forces, damping"]),
        (
            {"changes": ["material.poisson_ratio=0.2"]},
            ["young_modulus or density alone", "Poisson's ratio"],
        ),
        ({"changes": ["payload.mas=2"]}, ["with --set payload.mas=2", "unknown key payload.mas"]),
        ({"changes": ["payload.mass=-2"]}, ["payload.mass = -2", "a number >= 0"]),
        (5, ["a table with the keys changes, weight"]),
    ],
)
def test_bad_scenario(scenario, words):
    refused(minimal(scenarios=[scenario]), *words)


def test_scenarios_change_what_they_name():
    first = {"changes": ["payload.mass=4", "motion.flattening=0.5"]}
    data = minimal(scenarios=[first, {"changes": ["material.density=2800"], "weight": 0.5}])
    scene = scene_from_dict(data, overrides=["objective.scenarios=worst"])
    first, second = pose_scenarios(scene)
    assert (first.payload.mass, first.motion.flattening) == (4.0, 0.5)
    assert (second.payload.mass, second.material.density) == (6.0, 2800.0)
    assert first.scenarios == second.scenarios == () and first.objective.scenarios == "sum"
    assert first.objective.gradient == second.objective.gradient == scene.objective.gradient
    assert scene_from_dict(scene.to_dict()) == scene


def test_who_owns_which_design_and_limits():
    data = minimal(4)
    data["arms"][1]["rigid"] = True
    data["arms"][3]["design"] = "arm1"
    scene = scene_from_dict(data)
    assert scene.owners == (0, None, 2, 0)
    assert scene.cell_counts == {0: 2400, 2: 2400}
    assert [arm.rigid for arm in scene.arms] == [False, True, False, False]  # not inherited
    # One limit for all or one for each flexible arm; none at all.
    scene = scene_from_dict(minimal(constraints={"first_frequency": [10.0, 20.0]}))
    assert scene.constraints.first_frequency == (10.0, 20.0)
    assert scene_from_dict(scene.to_dict()).constraints == scene.constraints
    scene_from_dict(minimal(objective={"kind": "mass", "direction": "maximize"}))


def test_nothing_attached_needs_solid_ends():
    for tables in (
        {"objective": {"kind": "eigenfrequency", "attached": "none"}},
        {"objective": {"attached": "none"}, "constraints": {"first_frequency": 10.0}},
    ):
        data = minimal(**tables)
        scene_from_dict(data)  # they have them by default
        data["arms"][0]["passive"] = 0.0
        refused(data, "arms.0.passive (arm1) = 0.0", "more than 0")


@pytest.mark.parametrize(
    ("tables", "limit"),
    [
        ({}, 0.5),
        ({"design": {"volume_fraction": None}}, 0.5),  # as a summary has it of another scene
        ({"constraints": {"mass": 2.0}}, None),
        ({"objective": {"kind": "mass"}, "constraints": {"deviation": 0.01}}, None),
        ({"constraints": {"mass": 2.0}, "design": {"volume_fraction": 0.4}}, 0.4),
    ],
)
def test_volume_is_limited_unless_mass_is(tables, limit):
    scene = scene_from_dict(minimal(**tables))
    assert scene.design.volume_fraction == limit
    assert scene_from_dict(scene.to_dict()) == scene
    # What was stated stays when the mass is limited later.
    stated = scene_from_dict(scene.to_tree(), overrides=["constraints.mass=1.0"])
    assert stated.design.volume_fraction == tables.get("design", {}).get("volume_fraction")


def test_length_of_a_body_from_a_file(tmp_path):
    from dolfinopt.exchange.in_space import in_space
    from dolfinopt.exchange.standard_input import to_sid
    from dolfinopt.multibody.shape_integrals import rigid_bar
    from dolfinopt.scene.sid import write_sid

    write_sid(tmp_path / "bar.sid", to_sid(in_space(rigid_bar(0.8, 0.05, 1.08))))
    data = minimal()
    data["arms"][1]["sid"] = "bar.sid"
    scene = scene_from_dict(data, str(tmp_path / "scene.toml"))
    assert scene.arms[1].length == pytest.approx(0.8, rel=1e-12)
    assert scene.owners == (0, None) and scene.arms[1].sid == str(tmp_path / "bar.sid")
    assert scene_from_dict(scene.to_dict()) == scene
    data["arms"][0] = {"name": "arm1", "sid": "bar.sid"}  # needs no geometry at all
    data["arms"][1] = dict(ARM, name="arm2")
    first = scene_from_dict(data, str(tmp_path / "scene.toml")).arms[0]
    assert first.height == first.thickness == pytest.approx(0.04)


# Key, a value that is not its default, and settings with which something uses it.
UNUSED = {
    "objective.stress_exponent": ("8.0", ["constraints.stress=1e8"]),
    "objective.loads": ("[[0.0,1.0,0.0]]", ["constraints.tip_deflection=0.1"]),
    "objective.effort_weights": ("[1.0,2.0,3.0]", ["constraints.effort=50.0"]),
    "objective.attached": ("point-mass", ["constraints.first_frequency=1.0"]),
    "objective.elbow_angle": ("1.0", ["objective.kind=eigenfrequency"]),
    "objective.modes": ("2", ["objective.kind=eigenfrequency"]),
    "objective.scenarios": ("worst", ["scenarios=[{changes=['payload.mass=1']}]"]),
    "design.sharpness": ("64.0", ["design.projection=heaviside"]),
    "design.continuation": ("10", ["design.projection=heaviside"]),
    "design.erosion": ("0.2", ["design.projection=robust"]),
}
# What does not: the wrong response, or none.
OTHERS = {
    "objective.effort_weights": ["constraints.peak_force=[9.0,9.0,9.0]"],
    "design.erosion": ["design.projection=heaviside"],
}


@pytest.mark.parametrize("key", UNUSED)
def test_options_that_nothing_uses_are_refused(key):
    value, used = UNUSED[key]
    setting = f"{key}={value}"
    assert read_scene(TWO_ARM, [*used, setting])
    text = refusal(lambda: read_scene(TWO_ARM, [*OTHERS.get(key, []), setting]))
    assert (f"{key} = " in text and "default" in text) or "expected none" in text


def test_every_option_of_a_response_is_used_by_one():
    """The table of their users names options, objectives and limits that there are."""
    tables = Objective.model_fields.keys() | Constraints.model_fields.keys()
    for one in DECLARED.values():
        assert {*one.options, *one.limit_options} <= tables
    # No volume is shared where none is limited.
    lightest, shared = TWO_ARM.with_name("lightest_two_arm.toml"), "design.shared_volume=true"
    assert read_scene(lightest, ["design.volume_fraction=0.4", shared]).design.shared_volume
    refusal(lambda: read_scene(lightest, [shared]), "design.shared_volume = true", "false")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (["simulation.integrator=generalized-alpha"], ["simulation.integrator"]),
        (["simulation.rho_inf=0.5", "arms.joint_stiffness=1e4"], ["gear_stiffness", "rho_inf"]),
        (["part.curves=arcs", "part.simplify=true"], ["part.curves", "part.simplify"]),
        (["simulation.integrator=radau", "part.curves=splines"], []),
    ],
)
def test_older_words_are_told_in_one_line(change, told):
    sentences = [one for one in implausible(read_scene(TWO_ARM, change)) if "older" in one]
    assert len(sentences) == bool(told) and all(word in sentences[0] for word in told)


def test_the_section_of_a_hollow_arm_by_its_older_word():
    scene = TWO_ARM.with_name("hollow_links.toml")
    old = read_scene(scene, ["arms.link2.section=tube"])
    assert old.arms == read_scene(scene).arms and "arms.section" in old.old_words[0]
