"""Recipe, README, CONTRIBUTING and CITATION.cff: what they name, how long they are, their links."""

import re

import pytest
from runs import ROOT, tomllib

import dolfinopt

pytestmark = pytest.mark.serial  # nothing here knows of ranks
yaml = pytest.importorskip("yaml")

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RECIPE = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
STACK = {"fenics-dolfinx", "petsc4py", "slepc4py", "mpi4py", "python-gmsh"}  # of conda or Debian
README = (ROOT / "README.md").read_text(encoding="utf-8")
LINKS = [
    (name, path)
    for name in ("README.md", "CONTRIBUTING.md")
    for pattern in (r"\]\(((?!https?:)[^)#]+)\)", r"src=\"((?!https?:)[^\"]+)\"")
    for path in re.findall(pattern, (ROOT / name).read_text(encoding="utf-8"))
]


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
    # Pip does not bring another DOLFINx.
    assert not {*names(PROJECT["dependencies"])} & {*STACK, "gmsh", "fenics-basix", "petsc"}


def test_changelog_begins_with_this_version():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.findall(r"^## \[([^\]]+)\]", text, flags=re.MULTILINE)
    assert next(one for one in versions if one != "Unreleased") == dolfinopt.__version__


def test_readme_is_short():
    assert len(README.splitlines()) <= 150
    assert (ROOT / "demos/pictures/motion.gif").stat().st_size < 1.5e6


@pytest.mark.parametrize(("name", "path"), LINKS)
def test_links_lead_somewhere(name, path):
    assert (ROOT / path).exists()


def test_python_example_is_six_lines_with_model():
    code = re.search(r"```python\n(.*?)```", README, flags=re.DOTALL)[1]
    assert len([line for line in code.splitlines() if line]) <= 6 and "Model(" in code


def test_citation_names_this_version_and_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == dolfinopt.__version__
    assert citation["title"] and citation["message"] and citation["authors"]
    assert citation["references"][0]["doi"] == "10.1016/j.piutam.2015.01.018"
