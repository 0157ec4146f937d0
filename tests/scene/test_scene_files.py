"""Files of scenes and those that they name: where they are found, and whatever else comes."""

import json
import string
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from runs import TWO_ARM, refusal
from scenes import ARM, FILE, MATERIAL, changed, minimal, refused

from dolfinopt.data import mesh_folder
from dolfinopt.errors import InputError
from dolfinopt.scene.load import Arm, Scene, read_scene, resolve_file, scene_from_dict
from dolfinopt.scene.messages import describe_keys

pytestmark = pytest.mark.serial  # nothing here knows of ranks


TABLE = {"path": "points", "file": "table.csv"}


def test_file_is_found_beside_the_scene_first_then_in_the_working_directory(tmp_path, monkeypatch):
    beside, working = tmp_path / "scenes", tmp_path / "working"
    for folder in (beside, working):
        folder.mkdir()
        (folder / "table.csv").write_text("")
    monkeypatch.chdir(working)
    source = "../scenes/some.toml"
    assert scene_from_dict(minimal(motion=TABLE), source).motion.file == str(beside / "table.csv")
    (beside / "table.csv").unlink()
    scene = scene_from_dict(minimal(motion=TABLE), source)
    assert scene.motion.file == str(working / "table.csv")
    monkeypatch.chdir(tmp_path)  # and loaded again from elsewhere
    assert scene_from_dict(scene.to_dict(), "results/summary.json") == scene


def test_file_of_the_package_is_found_last(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert resolve_file("x.toml", "meshes/arm.geo", "key") == str(mesh_folder() / "arm.geo")
    with pytest.raises(InputError, match=r"motion\.py"):  # its meshes, not its modules
        resolve_file("x.toml", "motion.py", "key")
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "arm.geo").write_text("")
    assert resolve_file("x.toml", "meshes/arm.geo", "key") == str(tmp_path / "meshes" / "arm.geo")


def test_missing_file_is_named_with_all_places(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    places = str(tmp_path / "some" / "table.csv"), str(tmp_path / "table.csv")
    refused(minimal(motion=TABLE), f'{FILE}: motion.file = "table.csv"', *places)
    overrides = ["motion.path=points", "motion.file=table.csv"]
    refused(minimal(), f'{FILE} with --set {overrides[1]}: motion.file = "', overrides=overrides)
    for value in ("", ".", "a\0b", 5000 * "x", "\ud800", "/"):
        refused(changed("motion.file", value), "motion.file = ")


def test_a_mesh_excludes_cells():
    """Where both are stated; one that is stated takes the place of one that is inherited."""
    bores = "meshes/arm_bores.geo"
    data = minimal(3)
    data["arms"][0] |= {"mesh": bores, "mesh_size": 0.01, "cell_shape": "triangle"}
    data["arms"][2] |= {"cells": [20, 2]}
    first, second, third = scene_from_dict(data).arms
    assert first.cells is None and Path(first.mesh).name == "arm_bores.geo"
    assert second == first.model_copy(update={"name": "arm2"})
    assert third == Arm(**ARM | {"name": "arm3"}, cells=(20, 2))
    data["arms"][2] |= {"mesh": bores}
    refused(data, "not both")
    scene = scene_from_dict(minimal(), overrides=[f"arms.mesh={bores}", "arms.1.mesh_size=0.01"])
    assert [arm.mesh_size for arm in scene.arms] == [None, 0.01]
    assert scene.cell_counts == {0: 0, 1: 600}
    restored = scene_from_dict(json.loads(json.dumps(scene.to_dict())))
    assert restored == scene and restored.arms == scene.arms
    back = scene_from_dict(scene.to_dict(), overrides=["arms.cells=[20, 2]"])
    assert back.arms == (Arm(**ARM, cells=(20, 2)), Arm(**ARM | {"name": "arm2"}, cells=(20, 2)))


def test_a_mesh_that_is_set_keeps_what_else_is_stated():
    """`--set` changes one key and no other."""
    data = minimal(1)
    bores = {"point": [0.0, 0.0, 0.0], "axis": [0.0, 0.0, 1.0], "radius": 0.01}
    data["arms"][0] |= {
        "mesh": "meshes/arm_bores.geo", "cell_shape": "triangle", "mesh_scale": 0.001,
    }  # fmt: skip
    (arm,) = scene_from_dict(data, overrides=["arms.mesh=meshes/arm_bores.geo"]).arms
    assert arm.mesh_scale == 0.001 and arm.cell_shape == "triangle"
    refused(data | {"arms": [data["arms"][0] | {"inboard_bore": bores}]}, "solid arm")


SIZED = 'DefineConstant[ h = {1, Name "Parameters/1 mesh size (m)"} ];'


@pytest.mark.parametrize(
    ("file", "text", "size", "shape"),
    [
        ("own.step", "", 0.004, "triangle"),
        ("own.geo", SIZED, 0.004, "triangle"),
        ("own.geo", "", None, "triangle"),  # it has no such parameter
        ("own.msh", "", None, None),  # it has its cells
    ],
)
def test_an_own_mesh_has_the_size_of_cells_of_the_arm_before(tmp_path, file, text, size, shape):
    """All keys an arm leaves out are those of the arm before, but those its file cannot have."""
    path = tmp_path / file
    path.write_text(text)
    data = minimal()
    bores = {"mesh": "meshes/arm_bores.geo", "mesh_size": 0.004, "cell_shape": "triangle"}
    data["arms"][0] |= bores
    data["arms"][1] |= {"mesh": str(path)}
    arm = scene_from_dict(data).arms[1]
    assert (arm.mesh_size, arm.cell_shape, arm.cells) == (size, shape, None)
    stated = scene_from_dict(data, overrides=["arms.arm1.mesh_size=0.003"]).arms
    assert [one.mesh_size for one in stated] == [0.003, size]


@pytest.mark.parametrize(
    ("suffix", "keys", "words"),
    [
        (".toml", {}, [".geo, .msh, .inp, .step, .stp"]),
        (".msh", {"mesh_size": 0.01}, [".msh", "says it itself"]),
        (".msh", {"cell_shape": "triangle"}, [".msh", "says it itself"]),
        (".geo", {"mesh_size": 0.07}, ["at most height = 0.06 [m]"]),
        (".geo", {"cell_shape": "triangle", "element": "incompatible"},
         ['= "incompatible"', '"linear" or "quadratic"', '= "triangle"']),
    ],
)  # fmt: skip
def test_kinds_of_mesh_files(tmp_path, suffix, keys, words):
    path = tmp_path / f"arm{suffix}"
    path.write_text("")
    data = minimal(1)
    data["arms"][0] |= {"mesh": str(path)} | keys
    refused(data, *words)


def load_error(path, *words):
    return refusal(lambda: read_scene(path), str(path), *words)


def toml(head, keys):
    return f"\n{head}\n" + "\n".join(f"{key} = {json.dumps(value)}" for key, value in keys.items())


# The required tables but the payload's, to follow the lines in question.
REQUIRED = toml("[material]", MATERIAL) + toml("[[arms]]", ARM) + toml("[motion]", {"path": "arc"})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["missing key material.young_modulus"]),
        ("name = 'a'\n[material\ndensity = 1", ["line 2, column 10", "TOML"]),
        ("name = ", ["end of document", "TOML"]),
        ("name = 'a'\nx = [1,\n", ["end of document", "TOML"]),
        ("name = 1\nname = 2", ["overwrite a value", "TOML"]),
        ("name = " + 5000 * "1", ["TOML"]),
        ("name = " + 2000 * "[", ["nested"]),
        ("name = 0x" + 5000 * "f" + REQUIRED, ["name = 2**19999...", "a string"]),
        ("payload.mass = 1e400" + REQUIRED, ["payload.mass = inf", "a finite number >= 0"]),
        ("payload.mass = nan" + REQUIRED, ["payload.mass = nan", "a finite number >= 0"]),
        ("payload.mass = 1979-05-27" + REQUIRED, ["payload.mass = 1979-05-27", "number >= 0"]),
        ("[[material]]\ndensity = 1", ["material = [{ density = 1 }]", "a table with the keys"]),
        ("name = 'a'\n# L\udce4nge\n", ["line 2", "UTF-8"]),  # a byte of Latin-1
    ],
    ids=range(13),
)
def test_bad_file_content(tmp_path, text, words):
    path = tmp_path / "one.toml"
    path.write_text(text, errors="surrogateescape")
    load_error(path, *words)
    path.write_text(REQUIRED + toml("[payload]", {"mass": 6.0}))  # is enough
    assert read_scene(path) == scene_from_dict(minimal(1, name="one"))


def test_files_that_cannot_be_read(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for path, reason in (
        (tmp_path / "absent.toml", "No such file"),
        (tmp_path, "Is a directory"),
        (".", "Is a directory"),
        (tmp_path / "file" / "scene.toml", "Not a directory"),
        ("a" * 5000, "File name too long"),
    ):
        load_error(path, reason)
    with pytest.raises(InputError, match=r"a\\x00b: not a file name"):
        read_scene("a\0b")

    # The superuser may read every file, so that file modes cannot make this happen.
    def deny(self):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "read_bytes", deny)
    load_error(TWO_ARM, "cannot be read (Permission denied)")


KEYS = [info.key for info in describe_keys()]
NAMES = st.text(max_size=5) | st.sampled_from(["name", "mass"])
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(17, 20_000).map(lambda n_bits: 1 << n_bits)
    | st.floats()
    | st.text(max_size=20)
    | st.dates()
    | st.sampled_from(["esl", "modal", "generalized-alpha", "arm1", b"bytes", {1: 2}]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=6,
)


def accept_or_refuse(make):
    """Call `make`: a scene that survives a round trip, or InputError of one line."""
    try:
        scene = make()
    except InputError as error:
        assert str(error).isprintable() and str(error)
        return None
    assert isinstance(scene, Scene)
    assert scene_from_dict(json.loads(json.dumps(scene.to_dict(), allow_nan=False))) == scene
    for arm in scene.arms:
        assert 0 <= 2 * arm.passive_columns <= arm.cells[0]
        assert scene.reduction.coordinates <= arm.n_reducible
    return scene


@given(st.dictionaries(st.sampled_from([*KEYS, "x"]) | st.text(max_size=8), VALUES, max_size=3))
def test_any_data_are_accepted_or_refused(data):
    accept_or_refuse(lambda: scene_from_dict(data))


LETTERS = st.text(string.printable + "é\u2028\0", max_size=12)


@given(st.binary(max_size=40) | LETTERS.map(str.encode))
def test_any_file_is_accepted_or_refused(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_bytes(content + REQUIRED.encode())
    accept_or_refuse(lambda: read_scene(path))
