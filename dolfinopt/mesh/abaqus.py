"""Input files of Abaqus and CalculiX: nodes, elements, sets and surfaces.

A file is a sequence of blocks: a line of a keyword with its parameters, `*NSET, NSET=left,
GENERATE`, and lines of data. Keywords that say nothing of the mesh are left out. Every error
names the line and its keyword.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from dolfinopt.errors import InputError

SOLID = re.compile(r"(?:AC|DC|C)3D(\d+)")
FACE = re.compile(r"(?:STRI|CPS|CPE|CAX|M3D|SFM3D|R3D|DS|S)(\d)")
CELL_CORNERS = {4: 4, 10: 4, 8: 8, 20: 8}  # by the number of nodes: tetrahedra, hexahedra
FACE_CORNERS = {3: 3, 6: 3, 4: 4, 8: 4, 9: 4}
# Faces S1, S2, ... of cells by their corners.
SIDES = {
    4: [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]],
    8: [[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]],
}
WRITE_OUT = "save the mesh with all nodes and elements written out"
REFUSED = {
    "*INCLUDE": "it includes another file; save the mesh in one file",
    "*SYSTEM": f"coordinates of another system; {WRITE_OUT}",
    **dict.fromkeys(("*NGEN", "*NFILL", "*NCOPY", "*NMAP", "*ELGEN", "*ELCOPY"), WRITE_OUT),
}


@dataclass(frozen=True)
class Block:
    """A keyword, its parameters by their names in capitals, and its lines of data."""

    line: int
    text: str
    word: str
    parameters: Mapping[str, str]
    rows: list[tuple[int, list[str]]] = field(default_factory=list)

    def error(self, line: int, reason: str) -> InputError:
        """Return the error of a line of this block."""
        return InputError(f"line {line}, {self.text}: {reason}")

    def read(self, line: int, values: Iterable[str], kind: Callable[[str], float]) -> list[float]:
        """Return the values of a line as numbers of a kind."""
        result = []
        for value in values:
            try:
                result.append(kind(value))
            except ValueError:
                noun = "an integer" if kind is int else "a number"
                raise self.error(line, f"{value[:40]!r} is not {noun}") from None
        return result


@dataclass
class Abaqus:
    """The mesh of a file; sets and surfaces by their names in small letters.

    Attributes:
        nodes: places by the node's number, in the file's unit.
        cells: corners, numbers of nodes, by the element's number.
        faces: the same of shells and other elements of a surface.
        node_sets, element_sets: numbers.
        surfaces: elements' numbers and their faces S1, S2, ..; 0 is the element itself.
    """

    nodes: dict[int, list[float]] = field(default_factory=dict)
    cells: dict[int, list[int]] = field(default_factory=dict)
    faces: dict[int, list[int]] = field(default_factory=dict)
    node_sets: dict[str, list[int]] = field(default_factory=dict)
    element_sets: dict[str, list[int]] = field(default_factory=dict)
    surfaces: dict[str, list[tuple[int, int]]] = field(default_factory=dict)


def read_abaqus(text: str) -> Abaqus:
    """Read the text of a file.

    Raises:
        InputError: a line that cannot be read, with its number and keyword; a statement that
            generates nodes or elements, or reads another file.
    """
    readers = {
        "*NODE": _nodes,
        "*ELEMENT": _elements,
        "*NSET": _node_set,
        "*ELSET": _element_set,
        "*SURFACE": _surface,
    }
    mesh = Abaqus()
    for block in _blocks(text):
        if block.word in REFUSED:
            raise block.error(block.line, REFUSED[block.word])
        if reader := readers.get(block.word):
            if "INPUT" in block.parameters:
                raise block.error(block.line, REFUSED["*INCLUDE"])
            reader(mesh, block)
    return mesh


def _blocks(text: str) -> Iterator[Block]:
    """Yield the blocks of a file; a keyword's line may go on behind a comma at its end."""
    block, unfinished = None, ""
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if not line or line.startswith("**"):
            continue
        if line.startswith("*") or unfinished:
            unfinished += line
            if unfinished.endswith(","):
                continue
            if block is not None:
                yield block
            block, unfinished = _keyword(number, unfinished), ""
        elif block is not None:
            block.rows.append((number, [value.strip() for value in line.split(",")]))
    if block is not None:
        yield block


def _keyword(number: int, text: str) -> Block:
    word, *rest = (part.strip() for part in text.split(","))
    pairs = (part.partition("=") for part in rest if part)
    parameters = {key.strip().upper(): value.strip().strip('"') for key, _, value in pairs}
    return Block(number, text[:80], word.upper().replace(" ", ""), parameters)


def _name(block: Block, key: str) -> str:
    """Return the name that a block gives its set or surface."""
    if not (name := block.parameters.get(key, "")):
        raise block.error(block.line, f"expected {key}=name")
    return name.casefold()


def _nodes(mesh: Abaqus, block: Block) -> None:
    if block.parameters.get("SYSTEM", "R").upper() != "R":
        raise block.error(block.line, f"coordinates of another system; {WRITE_OUT}")
    numbers = []
    for line, (first, *rest) in block.rows:
        (number,) = map(int, block.read(line, [first], int))
        place = block.read(line, [value or "0" for value in rest[:3]], float)
        place += [0.0] * (3 - len(place))
        if mesh.nodes.setdefault(number, place) != place:
            raise block.error(
                line, f"node {number} for the second time; give the mesh of one part alone"
            )
        numbers.append(number)
    if name := block.parameters.get("NSET"):
        mesh.node_sets.setdefault(name.casefold(), []).extend(numbers)


def _elements(mesh: Abaqus, block: Block) -> None:
    """Read the elements of a block; lines, points and connectors are left out."""
    kind = block.parameters.get("TYPE", "").upper()
    solid, face = SOLID.match(kind), FACE.match(kind)
    if solid:
        count = int(solid[1])
        if count not in CELL_CORNERS:
            raise block.error(
                block.line, "expected tetrahedra (C3D4, C3D10) or hexahedra (C3D8, C3D20)"
            )
        known, corners = mesh.cells, CELL_CORNERS[count]
    elif face and int(face[1]) in FACE_CORNERS:
        count = int(face[1])
        known, corners = mesh.faces, FACE_CORNERS[count]
    else:
        return
    numbers = []
    for line, (number, *nodes) in _rows(block, 1 + count):
        if absent := [node for node in nodes[:corners] if node not in mesh.nodes]:
            raise block.error(line, f"there is no node {absent[0]}")
        known[number] = nodes[:corners]
        numbers.append(number)
    if name := block.parameters.get("ELSET"):
        mesh.element_sets.setdefault(name.casefold(), []).extend(numbers)


def _rows(block: Block, size: int) -> Iterator[tuple[int, list[int]]]:
    """Yield rows of `size` integers, each of which may go on over several lines."""
    row: list[int] = []
    for line, values in block.rows:
        row += map(int, block.read(line, filter(None, values), int))
        if len(row) > size:
            raise block.error(line, f"expected a number and {size - 1} nodes")
        if len(row) == size:
            yield line, row
            row = []
    if row:
        raise block.error(block.rows[-1][0], f"expected a number and {size - 1} nodes")


def _node_set(mesh: Abaqus, block: Block) -> None:
    members = _members(mesh.node_sets, block)
    if of := block.parameters.get("ELSET"):
        cells = mesh.cells | mesh.faces
        for number in mesh.element_sets.get(of.casefold(), []):
            members += cells.get(number, [])
    mesh.node_sets.setdefault(_name(block, "NSET"), []).extend(members)


def _element_set(mesh: Abaqus, block: Block) -> None:
    members = _members(mesh.element_sets, block)
    mesh.element_sets.setdefault(_name(block, "ELSET"), []).extend(members)


def _members(known: Mapping[str, list[int]], block: Block) -> list[int]:
    """Return the numbers of a set: each by itself, of other sets, or from first to last by step."""
    members: list[int] = []
    for line, values in block.rows:
        values = [value.strip('"') for value in values if value]
        if "GENERATE" in block.parameters:
            numbers = [int(number) for number in block.read(line, values, int)]
            if len(numbers) not in (2, 3) or 0 in numbers[2:]:
                raise block.error(line, "expected first, last and step (1 unless stated)")
            first, last, step = *numbers, *[1] * (3 - len(numbers))
            members += range(first, last + 1, step)
            continue
        for value in values:
            if value.casefold() in known:
                members += known[value.casefold()]
            else:
                members += map(int, block.read(line, [value], int))
    return members


def _surface(mesh: Abaqus, block: Block) -> None:
    """Read the faces of a surface, or the nodes of one made of nodes."""
    name = _name(block, "NAME")
    if block.parameters.get("TYPE", "ELEMENT").upper() == "NODE":
        rows = [(line, values[:1]) for line, values in block.rows]
        nodes = Block(block.line, block.text, block.word, {}, rows)
        mesh.node_sets.setdefault(name, []).extend(_members(mesh.node_sets, nodes))
        return
    faces = mesh.surfaces.setdefault(name, [])
    for line, (which, *face) in block.rows:
        own = Block(block.line, block.text, block.word, {}, [(line, [which])])
        side = face[0].upper() if face else ""
        number = int(side[1:]) if re.fullmatch(r"S\d", side) else 0
        for element in _members(mesh.element_sets, own):
            if number > len(SIDES.get(len(mesh.cells.get(element, [])), SIDES[8])):
                raise block.error(line, f"element {element} has no face {side}")
            faces.append((element, number))


def facets_of(mesh: Abaqus, surface: str) -> list[list[int]]:
    """Return the corners, numbers of nodes, of the facets of a surface."""
    facets = []
    for element, number in mesh.surfaces[surface]:
        if element in mesh.faces:
            facets.append(mesh.faces[element])
        elif number and element in mesh.cells:
            cell = mesh.cells[element]
            facets.append([cell[k] for k in SIDES[len(cell)][number - 1]])
    return facets


def numbered(mesh: Abaqus) -> tuple[np.ndarray, np.ndarray]:
    """Return the places (n, 3) of the nodes, and the row of every node by its number."""
    points = np.array(list(mesh.nodes.values())).reshape(-1, 3)
    row = np.zeros(max(mesh.nodes, default=0) + 1, dtype=int)
    row[list(mesh.nodes)] = np.arange(len(points))
    return points, row
