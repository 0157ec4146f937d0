"""The page on the architecture is true: picture, files, the words of the scene; and profiles."""

import importlib.util
import re
from typing import get_args

import pytest
from runs import ROOT

from dolfinopt import profiling as profile
from dolfinopt.density.interpolation import LAWS
from dolfinopt.fem.forms import ELEMENTS
from dolfinopt.profiling import Profile
from dolfinopt.reduction import METHODS
from dolfinopt.scene.tables.arms import ElementName
from dolfinopt.scene.tables.design import Law
from dolfinopt.scene.tables.motion import ReductionMethod

pytestmark = pytest.mark.serial  # nothing here knows of ranks


def rooms():
    spec = importlib.util.spec_from_file_location("rooms", ROOT / "docs" / "rooms.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_picture_is_that_of_the_code():
    """If it is not: `python docs/rooms.py`."""
    assert rooms().PICTURE.read_text(encoding="utf-8") == rooms().svg()
    # Arrows that follow from others are left out.
    graph = {"a": {"b", "c", "d"}, "b": {"c"}, "c": {"d"}, "d": set()}
    assert rooms().shortest(graph) == [("a", "b"), ("b", "c"), ("c", "d")]


INVENTED = {"responses/mean_acceleration.py", "dynamics/bdf.py", "reduction/hankel.py"}
INVENTED |= {"exchange/adams.py"}  # what the exercise adds


def test_files_that_the_pages_name_exist():
    pages = sorted((ROOT / "docs/pages").rglob("*.md"))
    text = {path.name: path.read_text(encoding="utf-8") for path in pages}
    every = "".join(text.values())
    for name in INVENTED:
        assert text["architecture.md"].count(name) == 1
        assert (ROOT / "dolfinopt" / name).parent.is_dir()
    named = re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.py|tests/[\w/]+(?:\.py)?)`", every)
    for name in {*named} - INVENTED:
        above = "" if name.startswith(("tests/", "docs/", "demos/")) else "dolfinopt"
        assert (ROOT / above / name).exists(), name


def test_words_of_the_scene_are_those_of_the_code():
    """A method is known to the scene by the word under which its room lists it."""
    assert set(get_args(ReductionMethod)) == METHODS.keys()
    assert set(get_args(Law)) == LAWS.keys()
    assert set(get_args(ElementName)) == set(ELEMENTS)


# -- seconds by phase: each is counted once  ------------------------------------------------------


def test_nested_phases_share_the_time(monkeypatch):
    """An inner phase stops the clock of the outer one, also where it ends by an error."""
    now = 0.0
    monkeypatch.setattr(profile.time, "perf_counter", lambda: now)
    found = Profile()
    with found.phase("outer"):
        now += 1.0
        with found.phase("inner"):
            now += 10.0
            with found.phase("outer"):  # of the same name again
                now += 100.0
        now += 1000.0
        with pytest.raises(ZeroDivisionError), found.phase("inner"):
            now += 10_000.0
            raise ZeroDivisionError
        now += 100_000.0
    now += 7.0  # in no phase
    with found.phase("later"):
        now += 3.0
    assert found.seconds == {"outer": 101_101.0, "inner": 10_010.0, "later": 3.0}
