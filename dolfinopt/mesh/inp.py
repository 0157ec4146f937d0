"""Meshes of Abaqus and CalculiX (.inp), by meshio, as a model with the groups of an arm.

Cells are tetrahedra (C3D4, C3D10) or hexahedra (C3D8, C3D20); nodes between corners are left out,
sides become straight. Interfaces are node sets, surfaces made of element sets' faces, or sets of
shell elements; element sets are regions.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.disk import open_input
from dolfinopt.errors import InputError
from dolfinopt.mesh.gmsh_session import DESIGN, PASSIVE, VOID
from dolfinopt.mesh.measured import INP_BYTES_LIMIT
from dolfinopt.mesh.solid_cells import (
    ENDS,
    REGIONS,
    Entities,
    SolidCells,
    bores_of,
    boundary,
    group_named,
    interface_named,
    interface_names,
    into_model,
)
from dolfinopt.scene.load import Arm

# Corners of the cells that are read, by meshio's names; of shells, which only mark faces.
CELLS = {"tetra": 4, "tetra10": 4, "hexahedron": 8, "hexahedron20": 8}
FACES = {"triangle": 3, "triangle6": 3, "quad": 4, "quad8": 4}
KEYWORDS = ("*NODE", "*ELEMENT", "*NSET", "*ELSET")
# Faces S1, S2, ... of cells by their corners, in Abaqus's order.
SURFACES = {
    4: [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]],
    8: [[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]],
}
# Elements of faces that meshio does not know, and others of as many nodes that it does.
FACE_TYPES = {
    "CPS6": "STRI65", "CPE6": "STRI65", "CAX6": "STRI65", "M3D6": "STRI65", "SFM3D6": "STRI65",
    "S6": "STRI65", "SFM3D3": "S3", "SFM3D4": "S4", "CPE8": "S8R", "CAX8": "S8R", "M3D8": "S8R",
    "SFM3D8": "S8R", "S8": "S8R",
}  # fmt: skip


def read_inp(gmsh: Any, arm: Arm, _: list[str]) -> Entities:
    """Make the Gmsh model of a file's cells, its sets the arm's groups.

    Raises:
        InputError: it holds no such cells, or an interface is neither a set nor a bore.
    """
    mesh, surfaces = _read(Path(str(arm.mesh)))
    blocks = [(block, CELLS[block.type]) for block in mesh.cells if block.type in CELLS]
    others = sorted({block.type for block in mesh.cells} - set(CELLS) - set(FACES))
    if not blocks or others:
        held = ", ".join(others) or "none in space"
        raise InputError(
            f"its elements are {held}; expected tetrahedra (C3D4, C3D10) or hexahedra (C3D8, "
            "C3D20) alone"
        )
    if len({corners for _, corners in blocks}) > 1:
        raise InputError("it has both tetrahedra and hexahedra; expected cells of one kind")
    regions = _regions(mesh)
    corners = [np.asarray(block.data)[:, :count] for block, count in blocks]
    every = np.concatenate(corners)
    which = np.concatenate([regions[block.type, id(block)] for block, _ in blocks])
    cells = {group: every[which == group] for group in REGIONS}
    facets = {}
    for group, name in interface_names(arm).items():
        if group not in bores_of(arm):
            facets[group] = _interface(mesh, surfaces, every, group, name, arm)
    return into_model(gmsh, SolidCells(np.asarray(mesh.points, dtype=float), cells, facets))


Surfaces = dict[str, list[tuple[str, int]]]  # element sets and numbers of their cells' faces


def _read(path: Path) -> tuple[Any, Surfaces]:
    """Return meshio's mesh of a file that reads no others, and its surfaces."""
    try:
        import meshio
    except ImportError:
        raise InputError("meshio is needed to read .inp files: pip install meshio") from None
    with open_input(path) as stream:
        data = stream.read(INP_BYTES_LIMIT + 1)
    if len(data) > INP_BYTES_LIMIT:
        raise InputError(f"it has more than {INP_BYTES_LIMIT // 10**6} MB; mesh it coarser")
    text = data.decode("latin-1")
    first = next((line for line in text.splitlines() if line.strip()), "")
    if not first.lstrip().startswith("*"):
        raise InputError(
            "it is no input file of Abaqus or CalculiX, whose first line begins with *"
        )
    if "*INCLUDE" in text.upper().replace(" ", ""):
        raise InputError("it includes other files (*INCLUDE); save the mesh in one file")
    try:
        with tempfile.TemporaryDirectory() as folder:
            kept = Path(folder) / "mesh.inp"
            kept.write_text(_mesh_alone(text), encoding="latin-1")
            return meshio.read(kept, file_format="abaqus"), _surfaces(text)
    except (Exception, SystemExit) as error:  # meshio raises whatever a line makes of it
        told = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"it cannot be read ({told}); expected *NODE and *ELEMENT") from None


def _statements(text: str) -> Iterator[tuple[str, str]]:
    """Yield every line but comments, with the last line before that begins with a keyword."""
    keyword = ""
    for line in text.splitlines():
        if line.strip() and not line.startswith("**"):
            keyword = line if line.startswith("*") else keyword
            yield keyword, line


def _mesh_alone(text: str) -> str:
    """Return the nodes, elements and sets of a file, faces by names that meshio knows."""
    kept = []
    for keyword, line in _statements(text):
        word = keyword.partition(",")[0].strip().upper()
        if word in KEYWORDS:
            kept.append(line)
            if line.startswith("*") and word == "*ELEMENT":
                kept[-1] = re.sub(r"(?i)(TYPE\s*=\s*)(\w+)", _known_type, line)
    return "\n".join(kept) + "\n"


def _surfaces(text: str) -> Surfaces:
    """Return the surfaces of a file that are faces of element sets, by their names."""
    found: Surfaces = {}
    for keyword, line in _statements(text):
        name = re.search(r"(?i)NAME\s*=\s*\"?([^,\"]+)", keyword)
        by_node = re.search(r"(?i)TYPE\s*=\s*NODE", keyword)
        if (
            line.startswith("*")
            or not keyword.upper().startswith("*SURFACE,")
            or not name
            or by_node
        ):
            continue
        cells, _, face = (part.strip() for part in line.partition(","))
        if face[:1].upper() == "S" and face[1:].isdigit():
            found.setdefault(name[1].strip(), []).append((cells, int(face[1:])))
    return found


def _known_type(found: re.Match[str]) -> str:
    return found[1] + FACE_TYPES.get(found[2].upper(), found[2].upper())


def _regions(mesh: Any) -> dict[tuple[str, int], np.ndarray]:
    """Return the group of every cell of every block: of its element sets, or design."""
    found = {
        (block.type, id(block)): np.full(len(block.data), DESIGN, dtype=int) for block in mesh.cells
    }
    for name, members in mesh.cell_sets.items():
        group = group_named(name, PASSIVE, VOID)
        for block, own in zip(mesh.cells, members, strict=True):
            if group is not None and own is not None and len(own):
                found[block.type, id(block)][np.asarray(own, dtype=int)] = group
    return found


def _interface(
    mesh: Any, surfaces: Surfaces, cells: np.ndarray, group: int, name: str, arm: Arm
) -> np.ndarray:
    """Return the facets of an interface: a surface or shells of its name, or within its nodes."""

    def belongs(one: str) -> bool:
        return interface_named(one, arm) == group

    outer = boundary(cells)
    faces = [rows for one in surfaces if belongs(one) for rows in _of_surface(mesh, surfaces[one])]
    for one, members in mesh.cell_sets.items():
        for block, own in zip(mesh.cells, members, strict=True):
            if belongs(one) and block.type in FACES and own is not None and len(own):
                rows = np.asarray(block.data)[np.asarray(own, dtype=int), : FACES[block.type]]
                faces.append(rows)
    if faces:
        return np.concatenate(faces)
    marked = np.zeros(len(mesh.points), dtype=bool)
    for one, members in mesh.point_sets.items():
        if belongs(one):
            marked[np.asarray(members, dtype=int)] = True
    found = outer[marked[outer].all(axis=1)]
    if not len(found):
        names = sorted({*mesh.point_sets, *mesh.cell_sets, *surfaces})
        held = ", ".join(map(repr, names[:8])) or "none"
        why = "holds the corners of no cell's side on the surface" if marked.any() else "is missing"
        key = "inboard_bore, outboard_bore" if group in ENDS else "axis and radius"
        raise InputError(
            f'the node set "{name}" {why}; its sets are {held}: name that of the interface\'s '
            f"nodes so (*NSET, NSET={name}), or state the bore (arms.{key})"
        )
    return np.asarray(found)


def _of_surface(mesh: Any, rows: list[tuple[str, int]]) -> list[np.ndarray]:
    """Return the facets of a surface, those of every element set and block."""
    known = {name.casefold(): members for name, members in mesh.cell_sets.items()}
    found = []
    for name, face in rows:
        for block, own in zip(mesh.cells, known.get(name.casefold(), []), strict=False):
            corners = CELLS.get(block.type)
            if corners is None or own is None or not len(own):
                continue
            if face > len(SURFACES[corners]):
                raise InputError(f"its cells of set {name!r} have no face S{face}")
            side = SURFACES[corners][face - 1]
            found.append(np.asarray(block.data)[np.asarray(own, dtype=int)][:, side])
    return found
