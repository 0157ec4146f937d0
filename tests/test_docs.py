"""Every code block of the README, the tutorials and the how-to pages runs; the site builds.

A page is run from top to bottom in one folder, with small scenes: what it writes in one block the
next one finds. A comment in front of a block may say what a test needs to know:

    <!-- test: skip, REASON -->       the block is not run
    <!-- test: append FILE -->        the block's text is added to FILE
    <!-- test: fails -->              the command ends with an error that the text explains
    <!-- test: --samples 64 -->       further words for every dolfinopt command of the block
"""

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
from typing import NamedTuple

import pytest
from declared import withdrawn
from mpi4py import MPI
from runs import ROOT, tomllib

import dolfinopt
from dolfinopt.cli import commands
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.scene.messages import describe_keys

pytestmark = pytest.mark.serial  # nothing here knows of ranks

PAGES = ROOT / "docs" / "pages"
TESTED = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(PAGES.glob("tutorials/*.md")),
          *sorted(PAGES.glob("howto/*.md")), PAGES / "develop" / "add-response.md",
          PAGES / "develop" / "own-form.md"]  # fmt: skip
# Of every scene that a page simulates, so that it takes a fraction of a second.
SETTINGS = {"cells": "[20, 3]", "max_iterations": "2", "mesh_size": "0.01", "load_cases": "4"}
SUFFIXES = (".npz", ".md", ".gif", ".csv", ".vtu", ".png", ".json", ".toml", ".py")


class Block(NamedTuple):
    """A fenced block: what stands behind the fence, its text, and the comment in front."""

    language: str
    title: str
    text: str
    note: str


def blocks(page):
    """Return the fenced blocks of a page, indented ones of lists and notes included."""
    pattern = re.compile(
        r"(?:^[ ]*<!-- test: (?P<note>.*?) -->\n)?"
        r"^(?P<indent>[ ]*)```(?P<language>\w+)(?: title=\"(?P<title>[^\"]+)\")?[ ]*\n"
        r"(?P<text>.*?)\n(?P=indent)```$",
        flags=re.MULTILINE | re.DOTALL,
    )
    found = []
    for match in pattern.finditer(page.read_text(encoding="utf-8")):
        text = re.sub(rf"^{match['indent']}", "", match["text"], flags=re.MULTILINE)
        found.append(Block(match["language"], match["title"] or "", text, match["note"] or ""))
    return found


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to work in, with the demos' scenes made small."""
    shutil.copytree(ROOT / "demos", tmp_path / "demos", ignore=shutil.ignore_patterns("pictures"))
    for scene in (tmp_path / "demos").glob("*.toml"):
        scene.write_text(made_small(scene.read_text()))
    monkeypatch.chdir(tmp_path)
    with withdrawn():
        yield tmp_path


def with_key(scene, table, key, value):
    """Return the text of a scene with a key of a table set, whether it was there or not."""
    if f"[{table}]" not in scene:
        return f"{scene}\n[{table}]\n{key} = {value}\n"
    head, mark, rest = scene.partition(f"[{table}]")
    body, more = re.match(r"(.*?)(^\[.*)?\Z", rest, flags=re.MULTILINE | re.DOTALL).groups("")
    body = re.sub(rf"^{key} = .*\n?", "", body, flags=re.MULTILINE)
    return f"{head}{mark}\n{key} = {value}{body}{more}"


def made_small(scene):
    """Return the text of a scene with few cells, iterations and samples, roughly solved."""
    for key, value in SETTINGS.items():
        scene = re.sub(rf"^{key} = \S.*?(?=\s*#|$)", f"{key} = {value}", scene, flags=re.MULTILINE)
    scene = with_key(scene, "optimizer", "max_iterations", SETTINGS["max_iterations"])
    scene = with_key(scene, "simulation", "tolerance", "1e-2")
    if "sample =" not in scene:
        scene = with_key(scene, "simulation", "sample", "0.01")
    if 'projection = "' in scene:
        # A design cut at one half after two iterations falls apart unless it is dense.
        scene = with_key(scene, "design", "volume_fraction", "0.9")
        scene = with_key(scene, "design", "initial", "0.9")
    if "cells =" not in scene and "mesh =" not in scene:
        first = scene.index("\n", scene.index("[[arms]]")) + 1
        scene = f"{scene[:first]}cells = {SETTINGS['cells']}\n{scene[first:]}"
    return scene


@pytest.mark.parametrize("page", TESTED, ids=lambda page: page.stem)
def test_every_block_runs(page, folder):
    names = {"__name__": "__docs__"}
    for block in blocks(page):
        if block.note.startswith("skip"):
            assert len(block.note) > len("skip, "), f"{page.name}: say why a block is skipped"
        elif block.note.startswith("append "):
            with open(folder / block.note.split()[1], "a") as file:
                file.write("\n" + block.text + "\n")
        elif block.title:
            small = made_small(block.text) if block.title.endswith(".toml") else block.text
            (folder / block.title).write_text(small + "\n")
        elif block.language == "python" and "gmsh.initialize" in block.text:
            # OpenCASCADE keeps the unit of the file that this process has read last.
            subprocess.run([sys.executable, "-c", block.text], cwd=folder, check=True)
        elif block.language == "python":
            exec(compile(block.text, page.name, "exec"), names)
        elif block.language == "sh":
            for line in re.sub(r"\\\n\s*", "", block.text).splitlines():
                run(line, block.note, folder)
        elif block.language == "toml":
            tomllib.loads(block.text)


def run(line, note, folder):
    """Run one line of a shell block in this process; scenes that it writes are made small."""
    words = shlex.split(line, comments=True)
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        del words[0]  # the environment of one command
    if words[:2] == ["mpirun", "-n"]:
        del words[:3]  # one rank does the same
    if not words:
        return
    assert words[0] in ("dolfinopt", "./dolfinopt.sh"), f"{line}: only dolfinopt is tested"
    words = words[3:] if words[1:2] == ["-n"] else words[1:]
    before = set(folder.glob("*.toml"))
    expected = note == "fails"
    extra = [] if expected else shlex.split(note)
    command = commands.commands.get(words[0])
    if command and "--plots" in {flag for one in command.params for flag in one.opts}:
        extra = [*extra, *(["--no-plots"] if "--no-plots" not in words else [])]
    try:
        commands.main([*words, *extra], standalone_mode=False, obj=MPI.COMM_WORLD)
    except (InputError, ConvergenceError) as error:
        assert expected, f"{line}: {error}"
    else:
        assert not expected, f"{line}: was expected to fail"
    for scene in set(folder.glob("*.toml")) - before:
        scene.write_text(made_small(scene.read_text()))


@pytest.mark.parametrize("page", TESTED, ids=lambda page: page.stem)
def test_scene_keys_of_a_page_exist(page):
    known = {info.key for info in describe_keys()}
    known |= {f"{table}.{info.key.rpartition('.')[2]}"
              for info in describe_keys() for table in info.also}  # fmt: skip
    tables = {key.rpartition(".")[0] for key in known}
    text = page.read_text(encoding="utf-8")
    for key in re.findall(r"`([a-z]+\.[a-z_]+)(?: = [^`]*)?`", text):
        if key.split(".")[0] in tables and not key.endswith(SUFFIXES):
            assert key in known, key
    for block in blocks(page):
        if block.language == "toml":
            for table, value in tomllib.loads(block.text).items():
                for row in value if isinstance(value, list) else [value]:
                    names = {f"{table}.{key}" for key in row} if isinstance(row, dict) else {table}
                    # A material may be a name; arrays of tables stand in tables.
                    assert names <= known | tables, names - known


@pytest.mark.parametrize("page", TESTED, ids=lambda page: page.stem)
def test_commands_in_the_text_exist(page):
    for name in re.findall(r"`dolfinopt ([a-z]+)[ `]", page.read_text(encoding="utf-8")):
        assert name in commands.commands, name


def test_messages_of_troubleshooting_are_those_of_the_program():
    """What the page quotes between ellipses stands in code or templates, word for word."""
    package = ROOT / "dolfinopt"
    told = "\n".join(text for path in package.rglob("*.py") for text in strings(path))
    told += "\n".join(path.read_text(encoding="utf-8") for path in package.rglob("*.jinja"))
    page = (PAGES / "howto" / "troubleshooting.md").read_text(encoding="utf-8")
    quoted = re.findall(r"^\| `([^`]+)` \|", page, flags=re.MULTILINE)
    assert len(quoted) > 20
    for part in "…".join(quoted).split("…"):
        assert part.strip() in told, part


def strings(path):
    """Return the texts of a module; one with values put in is joined without them."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    constants = [one.value for one in ast.walk(tree) if isinstance(one, ast.Constant)]
    return [text for text in constants if isinstance(text, str)]


def test_blocks_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "text\n\n<!-- test: skip, why -->\n```sh\na\n\nb\n```\n\n"
        '- x\n\n    ```toml title="s.toml"\n    k = 1\n    ```\n'
    )
    found = Block("sh", "", "a\n\nb", "skip, why"), Block("toml", "s.toml", "k = 1", "")
    assert blocks(page) == [*found]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site."""
    pytest.importorskip("mkdocs", reason="needs the extra docs")
    path = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    command += ["-f", ROOT / "docs" / "mkdocs.yml", "-d", path]
    done = subprocess.run(command, capture_output=True, text=True, env=dict(os.environ))
    assert done.returncode == 0, done.stdout + done.stderr
    return path


def test_site_fetches_nothing(site):
    """No script, style, font or picture from elsewhere: it works without a network."""
    assert (site / "index.html").exists()
    elsewhere = r"<(?:script|link|img|iframe)\b[^>]*?(?:src|href)=\"(https?:[^\"]+)"
    for page in site.rglob("*.html"):
        assert not re.findall(elsewhere, page.read_text()), page


def test_scene_reference_has_every_key(site):
    page = (site / "reference" / "scene.html").read_text()
    for info in describe_keys():
        table, _, key = info.key.rpartition(".")
        section = page.split(f'id="{table or "top"}"')[1].split("<h2")[0]
        assert f"<code>{key}</code>" in section, info.key


def test_command_reference_has_every_option(site):
    page = (site / "reference" / "commands.html").read_text()
    for name, command in commands.commands.items():
        section = page.split(f'id="{name}"')[1].split("<h2")[0]
        for option in (one for one in command.params if not getattr(one, "hidden", False)):
            for flag in option.opts:
                assert not flag.startswith("--") or flag in section, (name, flag)


def test_python_reference_has_every_public_name(site):
    page = (site / "reference" / "python.html").read_text()
    for name in dolfinopt.__all__:
        assert name == "__version__" or re.search(rf'id="dolfinopt[a-z_.]*\.{name}"', page), name


def test_every_module_is_listed(site):
    page = (site / "develop" / "modules.html").read_text()
    for path in (ROOT / "dolfinopt").glob("**/[!_]*.py"):
        if (path.parent / "__init__.py").exists():
            assert f"<code>{path.stem}</code>" in page, path


def test_formulas_are_set(site):
    for page in site.rglob("*.html"):
        assert "arithmatex" not in page.read_text(), page
    assert "<math" in (site / "theory" / "gradient.html").read_text()
