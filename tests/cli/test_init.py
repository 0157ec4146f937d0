"""What helps to write a scene: templates, keys, the schema; and a script's interpreter."""

import json
import re
import subprocess
import sys

import jsonschema
import pytest
from runs import ROOT, TWO_ARM, environment, refusal, run, shell, tomllib
from scenes import put_at

import dolfinopt
from dolfinopt.cli.begin import TABLES
from dolfinopt.data import template_folder
from dolfinopt.dynamics.build import check_motion
from dolfinopt.scene.load import read_scene
from dolfinopt.scene.messages import describe_keys, implausible
from dolfinopt.scene.schema import scene_schema

pytestmark = pytest.mark.serial  # nothing here knows of ranks
TEMPLATES = TABLES["init"]["template"]["choices"]
DEMOS = sorted((ROOT / "demos").glob("*.toml"))


def errors(data):
    """Return what the schema finds wrong, as an editor would."""
    schema = scene_schema()
    jsonschema.Draft7Validator.check_schema(schema)
    return [error.message for error in jsonschema.Draft7Validator(schema).iter_errors(data)]


def test_one_of_two_ranks_writes(tmp_path):
    done = shell("init", tmp_path / "machine", ranks=2)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "machine.toml").exists()
    assert done.stdout.count("edit the values") == 1


@pytest.mark.parametrize("template", TEMPLATES)
def test_a_template_is_a_scene(tmp_path, capsys, template):
    """Complete but for the own geometry, plausible, and known to the schema in its first line."""
    assert {path.stem for path in template_folder().glob("*.toml")} == set(TEMPLATES)
    run("init", tmp_path / 'my "machine"', template)
    scene = tmp_path / 'my "machine".toml'
    said = capsys.readouterr().out
    assert "dolfinopt optimize" in said and str(scene) in said
    lines = scene.read_text().splitlines()
    assert lines[0] == "#:schema ./dolfinopt.schema.json"
    assert sum("#" in line for line in lines) > 15  # it explains itself
    assert json.loads((tmp_path / "dolfinopt.schema.json").read_text()) == scene_schema()
    assert errors(tomllib.loads(scene.read_text())) == []
    if template == "step":
        assert str(tmp_path / "arm.step") in said
        refusal(lambda: read_scene(scene), "arm.step")
        (tmp_path / "arm.step").write_text("ISO-10303-21;")
    loaded = read_scene(scene)
    assert loaded.name == 'my "machine"'
    check_motion(loaded)
    assert implausible(loaded) == []


@pytest.mark.slow
@pytest.mark.parametrize("template", [name for name in TEMPLATES if name != "step"])
def test_a_template_is_improved_by_its_optimisation(tmp_path, template):
    """On its own mesh; pick-and-place ended softer than it began with its exact gradient."""
    run("init", tmp_path / "machine", template)
    scene = read_scene(tmp_path / "machine.toml", ["optimizer.max_iterations=30"])
    history = dolfinopt.optimize(scene).history
    assert history[-1].objective < history[0].objective / 3.0


def test_init_replaces_nothing(tmp_path):
    """No scene, and no table beside it; nothing is half-written."""
    mine = {"a.toml": "mine", "b.csv": "mine"}
    for name, text in mine.items():
        (tmp_path / name).write_text(text)
    for name, word in (("a", "exists"), ("a.toml", "exists"), ("b", "exists"), ("a.toml/c", "be")):
        line = ["init", tmp_path / name, "pick-and-place"]
        refusal(lambda: run(*line), word)  # noqa: B023
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == mine
    run("init", tmp_path / "deep" / "c.toml")
    assert read_scene(tmp_path / "deep" / "c.toml").name == "c"


def test_keys_are_explained_by_pattern(capsys):
    run("keys")
    said = capsys.readouterr().out
    assert all(f"\n{info.key}" in f"\n{said}" for info in describe_keys())
    run("keys", "payload.mass")
    head, meaning = capsys.readouterr().out.splitlines()
    assert head.startswith("payload.mass [kg]: a number >= 0")
    assert head.endswith("required") and meaning.strip() == "point mass at the end-effector"
    run("keys", "arms.*")
    heads = [line for line in capsys.readouterr().out.splitlines() if not line.startswith(" ")]
    names = [i.key for i in describe_keys() if i.key.startswith("arms.") or "arms" in i.also]
    assert {"arms.regions.circle", "material.density"} <= {*names}
    assert [line.split(":")[0].split(" ")[0] for line in heads] == names
    refusal(lambda: run("keys", "payload.mas2"), "payload.mas2", "payload.mass")


OLDER = """\
[reduction]
method = "krylov"
shifts = [
  0.0, 9.0,
]               # Hz
coordinates = 6
[simulation]
rho_inf = 0.5   # of another integrator
sample = 2e-3
[closure]
kind = "slider" # on a line
force = -10.0
"""


def test_older_words_are_rewritten(tmp_path, capsys):
    """Comments and order stay, the scene is the same, the file as it was is kept."""
    file = tmp_path / "old.toml"
    loop = 'path = "rotation"\nbase = "fixed"\n'
    run("init", file)
    text = re.sub(r'path = "arc".*\nradius.*\n', loop, file.read_text()) + OLDER
    text = text.replace('"arm2"  ', '"arm2"\njoint_stiffness = 0.0\nsymmetric_z = false\n')
    file.write_text(text.replace("[[arms]]  ", "[[arms]]\njoint_stiffness = 1e4  # N m/rad\n", 1))
    before, text = read_scene(file), file.read_text()
    capsys.readouterr()
    run("keys", "--upgrade", file)
    assert "arms.joint_stiffness -> arms.gear_stiffness" in capsys.readouterr().out
    assert read_scene(file) == before and read_scene(file).old_words == ()
    assert file.with_name("old.toml.old").read_text() == text
    new = file.read_text()
    for line in (
        "gear_stiffness = 10000.0  # N m/rad",
        "frequencies = [0.0, 9.0]               # Hz",
    ):
        assert line in new
    assert "rho_inf" not in new and "[[forces]]" in new and "[closure]" not in new
    run("keys", "--upgrade", file)
    assert "no older words" in capsys.readouterr().out


def test_schema_knows_every_key_with_its_meaning(capsys):
    """And takes the demos."""
    for path in DEMOS:
        assert errors(tomllib.loads(path.read_text())) == [], path
    run("keys", "--schema")
    schema = json.loads(capsys.readouterr().out)
    assert schema == scene_schema()
    for info in describe_keys():
        *tables, key = info.key.split(".")
        node = schema
        for table in tables:
            node = node["properties"][table]
            node = node.get("items", node)
            node = node.get("anyOf", [node])[-1]  # a material may be a name, too
            node = schema["definitions"][node["$ref"].rpartition("/")[2]]
        assert node["properties"][key]["description"] == info.description


def test_schema_finds_what_is_wrong():
    for path, value, word in (
        (("payload", "mas"), 1.0, "mas"),
        (("payload", "mass"), -1.0, "minimum"),
        (("payload", "mass"), "six", "number"),
        (("motion", "law"), "cubic", "cubic"),
        (("reduction", "coordinates"), "many", "many"),
        (("loads",), {}, "loads"),
        (("arms", 0, "cells"), [10], "[10]"),
        (("arms", 0, "cells"), [10, 2, 2, 2], "[10, 2, 2, 2]"),
    ):
        data = tomllib.loads(TWO_ARM.read_text())
        put_at(data, path, value)
        [message] = errors(data)
        assert word in message


def set_up(folder, interpreter, *stamps):
    """Return the launcher in a folder that is set up, with a script as interpreter."""
    launcher = folder / "dolfinopt.sh"
    launcher.write_bytes((ROOT / "dolfinopt.sh").read_bytes())
    (folder / "pyproject.toml").touch()
    python = folder / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(f"#!/bin/sh\n{interpreter}\n")
    python.chmod(0o755)
    stamp = f"cksum '{launcher}' '{folder}/pyproject.toml' /etc/debian_version 2>/dev/null"
    ready = subprocess.run(["bash", "-c", stamp], capture_output=True).stdout
    for name in stamps:
        (folder / ".venv" / name).write_bytes(ready)
    return launcher


@pytest.mark.parametrize("stamp", ["ready-docs", "ready-dev"])
@pytest.mark.parametrize("status", [0, 1])
def test_launcher_builds_the_documents(tmp_path, stamp, status):
    """Strictly, into site/; with the status of the build."""
    launcher = set_up(tmp_path, f'echo "$@"; exit {status}', stamp)
    options = {"capture_output": True, "text": True, "timeout": 60}
    done = subprocess.run(["bash", str(launcher), "docs"], **options)
    assert done.returncode == status
    assert "mkdocs build --strict" in done.stdout
    assert str(tmp_path / "docs" / "mkdocs.yml") in done.stdout
    assert ("site/index.html" in done.stderr) is (status == 0)
    done = subprocess.run(["bash", str(launcher), "docs", "here"], **options)
    assert done.returncode == 2 and "docs takes no arguments" in done.stderr


@pytest.mark.parametrize("ranks", [0, 2])
def test_launcher_runs_a_script(tmp_path, ranks):
    """With the interpreter of the set-up, its settings, and all arguments."""
    launcher = set_up(tmp_path, f'exec {sys.executable} "$@"', "ready")
    script = tmp_path / "my script.py"
    told = "f'{sys.argv[1:]} {os.environ[\"OMP_NUM_THREADS\"]}\\n'"
    script.write_text(f"import os, sys\nsys.stdout.write({told})\n")
    line = ["bash", str(launcher), *(["-n", str(ranks)] if ranks else []), "python"]
    env = {k: v for k, v in environment().items() if k != "OMP_NUM_THREADS"}
    options = {"capture_output": True, "text": True, "env": env, "timeout": 60}
    done = subprocess.run([*line, str(script), "a b", "--out"], **options)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["['a b', '--out'] 1"] * max(ranks, 1)
    done = subprocess.run(line, **options)
    assert done.returncode == 2 and "python needs a script" in done.stderr
