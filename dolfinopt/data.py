"""What comes with the package wherever it is installed: meshes, scenes, templates of files."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = [
    "benchmark_folder",
    "filled",
    "mesh_folder",
    "paper_scene",
    "tables_of",
    "template_folder",
    "tomllib",
]


def mesh_folder() -> Path:
    """Return the folder of the parametric meshes (`*.geo`).

    In a source tree it is a link to the folder `meshes` next to the package.
    """
    return Path(__file__).parent / "meshes"


def paper_scene() -> Path:
    """Return the paper's two-arm manipulator.

    In a source tree it is a link to `demos/two_arm.toml`.
    """
    return Path(__file__).parent / "paper" / "two_arm.toml"


def template_folder() -> Path:
    """Return the folder of the scenes that `dolfinopt init` starts from."""
    return Path(__file__).parent / "scene" / "templates"


def tables_of(file: str) -> dict[str, Any]:
    """Return the content of a TOML file of the package, named from its folder."""
    return tomllib.loads((Path(__file__).parent / file).read_text(encoding="utf-8"))


def filled(template: str, filters: Mapping[str, Callable[..., Any]], **content: Any) -> str:
    """Return a page or a file from a template (Jinja); what it names must be given."""
    templates = _templates()
    templates.filters |= filters
    return str(templates.get_template(template).render(**content))


@cache
def _templates() -> Any:
    """Return Jinja's environment, which keeps compiled templates: 12 ms each."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    here = Path(__file__).parent
    folders = [
        here / room / "pages" for room in ("cli", "study", "paper", "exchange", "exchange/urdf")
    ]
    return Environment(
        loader=FileSystemLoader(folders),
        autoescape=lambda name: str(name).endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )


def benchmark_folder() -> Path:
    """Return the folder of the published problems and their reference values.

    In a source tree it is a link to the folder `benchmarks` next to the package.
    """
    return Path(__file__).parent / "benchmarks"
