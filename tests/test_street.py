"""The order of the modules: imports point one way along the street."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import dolfinopt
from dolfinopt.data import mesh_folder

pytestmark = pytest.mark.serial  # nothing here knows of ranks

# Data walks down this street; a module imports only from those before it.
STREET = (
    "errors",
    "folders",
    "data",
    "ledger",
    "sid",
    "spelling",
    "scene_keys",
    "plausibility",
    "scene_messages",
    "scene_schema",
    "scene",
    "contents",
    "compat",
    "parallel",
    "budget",
    "step",
    "geometry",
    "mesh",
    "symmetry",
    "material",
    "filters",
    "projection",
    "elasticity",
    "reduction",
    "body",
    "standard_input",
    "mbdyn",
    "statics",
    "vibration",
    "arm",
    "tables",
    "motion",
    "mechanism",
    "integrators",
    "simulation",
    "objective",
    "scenarios",
    "coordinates",
    "sensitivity",
    "evaluation",
    "taylor",
    "mma",
    "files",
    "checkpoint",
    "optimization",
    "summary",
    "results",
    "progress",
    "board",
    "cases",
    "findings",
    "variants",
    "plans",
    "topics",
    "sweeps",
    "study",
    "uncertainty",
    "sampling",
    "random_study",
    "style",
    "plots",
    "study_plots",
    "bench",
    "claims",
    "paper",
    "report",
    "cli",
    "__main__",
)
# Slow to import or missing on a cluster: imported where they are used.
HEAVY = {"PIL", "gmsh", "matplotlib", "pyvista"}

PACKAGE = Path(dolfinopt.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))


def violations(name: str, source: str) -> list[str]:
    """Return what is wrong with the imports of module `name` ("reduction.modal", "__init__")."""
    tree = ast.parse(source)
    heavy = [
        f"{name}, line {line}: import {target} where it is used, not at the top"
        for target, line in _imports(_at_import_time(tree), name)
        if target.split(".")[0] in HEAVY
    ]
    if name == "__init__":  # the public names, from everywhere
        return heavy
    station = name.split(".")[0]
    if station not in STREET:
        return [*heavy, f"{name}: add it to STREET in {Path(__file__).name}, at its place"]

    wrong = []
    for target, line in _imports(ast.walk(tree), name):
        parts = target.split(".")
        if parts[0] != "dolfinopt" or parts[1:] == ["__version__"]:
            continue
        other = parts[1] if len(parts) > 1 else "__init__"
        if other == station and "." in name:  # within a subfolder
            continue
        if other not in STREET:
            wrong.append(f"{name}, line {line}: imports {target}, which is not a module in STREET")
        elif STREET.index(other) >= STREET.index(station):
            wrong.append(f"{name}, line {line}: imports {other}, which comes later in the street")
    return heavy + wrong


def _imports(nodes: Iterator[ast.AST], name: str) -> Iterator[tuple[str, int]]:
    """Yield the full name and the line of everything imported by `nodes` of module `name`."""
    package = ["dolfinopt", *name.split(".")]
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: -node.level] if node.level else []
            module = ".".join([*base, node.module] if node.module else base)
            if module == "dolfinopt":  # from dolfinopt import mesh
                yield from ((f"{module}.{alias.name}", node.lineno) for alias in node.names)
            else:
                yield module, node.lineno


def _at_import_time(node: ast.AST) -> Iterator[ast.AST]:
    """Walk what runs when the module is imported: no function bodies, no `if TYPE_CHECKING`."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING"):
            continue
        yield child
        yield from _at_import_time(child)


def _module_name(path: Path) -> str:
    parts = list(path.relative_to(PACKAGE).with_suffix("").parts)
    if len(parts) > 1 and parts[-1] == "__init__":
        parts[-1:] = ["__init__"]
    return ".".join(parts)


@pytest.mark.parametrize("path", SOURCES, ids=_module_name)
def test_imports_point_one_way(path):
    assert violations(_module_name(path), path.read_text()) == []


@pytest.mark.parametrize(
    ("name", "source", "found"),
    [
        ("mesh", "from dolfinopt.optimization import optimize", "optimization, which comes later"),
        ("mesh", "from dolfinopt import cli", "cli, which comes later"),
        ("mesh", "import dolfinopt.cli", "cli, which comes later"),
        ("mesh", "from . import cli", "cli, which comes later"),
        ("mesh", "from .cli import main", "cli, which comes later"),
        ("mesh", "def f():\n    from dolfinopt.cli import main", "line 2: imports cli"),
        ("mesh", "from dolfinopt import ArmMesh", "not a module in STREET"),
        ("mesh", "import dolfinopt", "not a module in STREET"),
        ("reduction.modal", "from ..body import ShapeIntegrals", "body, which comes later"),
        ("reduction.modal", "from dolfinopt.cli import main", "cli, which comes later"),
        ("attic", "", "add it to STREET"),
        ("plots", "import pyvista as pv", "import pyvista where it is used"),
        ("plots", "try:\n    import matplotlib.pyplot\nexcept ImportError: ...", "line 2"),
        ("plots", "class A:\n    from gmsh import model", "import gmsh where"),
        ("__init__", "import matplotlib", "import matplotlib where"),
    ],
)
def test_checker_finds(name, source, found):
    assert found in "; ".join(violations(name, source))


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("cli", "import numpy\nfrom dolfinopt.mesh import ArmMesh\nfrom dolfinopt import plots"),
        ("cli", "from dolfinopt import __version__"),
        ("reduction.modal", "from dolfinopt.mesh import ArmMesh\nfrom .basis import Basis"),
        ("reduction.__init__", "from dolfinopt.reduction.modal import reduce_modal"),
        ("reduction.__init__", "from .modal import reduce_modal"),
        ("plots", "def f():\n    import pyvista"),
        ("plots", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import pyvista"),
        ("__init__", "from dolfinopt.optimization import optimize"),
    ],
)
def test_checker_allows(name, source):
    assert violations(name, source) == []


def test_meshes_are_found():
    assert (mesh_folder() / "arm.geo").is_file()
