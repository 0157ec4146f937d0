"""Packaging: the conda recipe names what pyproject does, and what pip must not bring."""

import re
from pathlib import Path

import pytest
from runs import tomllib

import dolfinopt

pytestmark = pytest.mark.serial  # nothing here knows of ranks
yaml = pytest.importorskip("yaml")

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RECIPE = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
STACK = {"fenics-dolfinx", "petsc4py", "slepc4py", "mpi4py", "python-gmsh"}  # of conda or Debian


def names(requirements):
    return {re.match(r"[\w-]+", one)[0].removesuffix("-base"): one for one in requirements}


def test_recipe_has_the_dependencies_of_the_project():
    recipe = yaml.safe_load(RECIPE)
    ours, theirs = names(PROJECT["dependencies"]), names(recipe["requirements"]["run"])
    assert set(theirs) == {*ours, *STACK, "python"} - {"tomli"}
    for name, text in ours.items():
        if name != "tomli":  # of Python 3.10 alone
            assert theirs[name].partition(">=")[2] == text.partition(">=")[2], name
    assert recipe["context"]["version"] == dolfinopt.__version__


def test_pip_does_not_bring_another_dolfinx():
    assert not {*names(PROJECT["dependencies"])} & {*STACK, "gmsh", "fenics-basix", "petsc"}


def test_changelog_begins_with_this_version():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.findall(r"^## \[([^\]]+)\]", text, flags=re.MULTILINE)
    assert next(one for one in versions if one != "Unreleased") == dolfinopt.__version__
