"""README, CONTRIBUTING and CITATION.cff: length, links, content. Their blocks run in test_docs."""

import re
from pathlib import Path

import pytest

import dolfinopt

pytestmark = pytest.mark.serial  # nothing here knows of ranks

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
LINKS = [
    (name, path)
    for name in ("README.md", "CONTRIBUTING.md")
    for pattern in (r"\]\(((?!https?:)[^)#]+)\)", r"src=\"((?!https?:)[^\"]+)\"")
    for path in re.findall(pattern, (ROOT / name).read_text(encoding="utf-8"))
]


def test_readme_is_short():
    assert len(README.splitlines()) <= 150


@pytest.mark.parametrize(("name", "path"), LINKS)
def test_links_lead_somewhere(name, path):
    assert (ROOT / path).exists()


def test_animation_is_small():
    assert (ROOT / "demos/pictures/motion.gif").stat().st_size < 1.5e6


def test_python_example_is_six_lines_with_model():
    code = re.search(r"```python\n(.*?)```", README, flags=re.DOTALL)[1]
    assert len([line for line in code.splitlines() if line]) <= 6 and "Model(" in code


def test_citation_names_this_version_and_the_paper():
    yaml = pytest.importorskip("yaml")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == dolfinopt.__version__
    assert citation["title"] and citation["message"] and citation["authors"]
    assert citation["references"][0]["doi"] == "10.1016/j.piutam.2015.01.018"
