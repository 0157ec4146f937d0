"""The picture of the rooms is that of the code."""

import importlib.util
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.serial  # nothing here knows of ranks

ROOT = Path(__file__).parents[1]


def rooms():
    spec = importlib.util.spec_from_file_location("rooms", ROOT / "docs" / "rooms.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_picture_is_that_of_the_code():
    """If it is not: `python docs/rooms.py`."""
    assert rooms().PICTURE.read_text(encoding="utf-8") == rooms().svg()


def test_arrows_that_follow_from_others_are_left_out():
    graph = {"a": {"b", "c", "d"}, "b": {"c"}, "c": {"d"}, "d": set()}
    assert rooms().shortest(graph) == [("a", "b"), ("b", "c"), ("c", "d")]


def test_files_that_the_page_names_exist():
    page = (ROOT / "docs/pages/develop/architecture.md").read_text(encoding="utf-8")
    for name in set(re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.py|tests/[\w/]+(?:\.py)?)`", page)):
        path = ROOT / name if name.startswith(("tests/", "docs/")) else ROOT / "dolfinopt" / name
        assert path.exists(), name
