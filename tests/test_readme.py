"""The README says what the program does."""

import re
from pathlib import Path

import pytest

from dolfinopt.cli import commands
from dolfinopt.scene import describe_keys

pytestmark = pytest.mark.serial  # nothing here knows of ranks

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_every_scene_key_has_its_row():
    rows = set(re.findall(r"^\| `[a-z_.]+` \|.*\|$", README, flags=re.MULTILINE))
    for info in describe_keys():
        allowed = info.allowed.replace(" | ", " or ")
        row = f"| `{info.key}` | {allowed} | {info.default or 'required'} | {info.description} |"
        assert row in rows


def test_no_row_for_a_key_that_is_gone():
    known = {info.key for info in describe_keys()}
    table = README[README.index("## The scene") : README.index("## From Python")]
    shown = set(re.findall(r"^\| `([a-z_.]+)` \|", table, flags=re.MULTILINE))
    assert shown == known


def test_every_command_is_described():
    for name, command in commands.commands.items():
        if command.hidden:
            continue
        assert re.search(rf"dolfinopt {name}[ `]", README)
        for option in command.params:
            long = [flag for flag in option.opts if flag.startswith("--")]
            assert not long or long[0].replace("--plots", "--no-plots") in README


@pytest.mark.parametrize("path", re.findall(r"\]\(((?!https?:)[^)]+)\)", README))
def test_links_lead_somewhere(path):
    assert (ROOT / path).exists()


def test_python_example_runs(monkeypatch, capsys):
    """With fewer cells and iterations than it says."""
    code = re.search(r"```python\n(.*?)```", README, flags=re.DOTALL)[1]
    code = code.replace(
        '"optimizer.max_iterations=50"', '"arms.cells=[20,3]", "optimizer.max_iterations=2"'
    )
    monkeypatch.chdir(ROOT)
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out.strip()
