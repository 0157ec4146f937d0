"""Names of edges and faces in a STEP file, which Gmsh does not read.

A STEP file (ISO 10303-21) holds one instance a statement, `#21 = EDGE_CURVE('name', #22, ...);`.
Shapes are told by their vertices: what bears a name is found again among Gmsh's shapes by place.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

TOLERANCE = 1e-6  # distance of vertices relative to the extent of all: digits of a file

_STATEMENT = re.compile(r"#(\d+)\s*=\s*([A-Z0-9_]+)\s*\(((?:'[^']*'|[^';])*)\)\s*;")
_EDGES = ("EDGE_CURVE",)
_FACES = ("ADVANCED_FACE", "FACE_SURFACE")
# From a face down to its vertices; the geometry of curves and surfaces is left aside.
_PATH = {*_EDGES, *_FACES, "FACE_BOUND", "FACE_OUTER_BOUND", "EDGE_LOOP", "ORIENTED_EDGE"}


@dataclass(frozen=True, eq=False)
class StepShapes:
    """Edges or faces that bear a name.

    Attributes:
        names: one a shape, in small letters.
        vertices: (n, 3) of each shape, in the file's unit.
        everywhere: (n, 3) all vertices of the file.
    """

    names: list[str]
    vertices: list[np.ndarray]
    everywhere: np.ndarray

    def names_at(self, points: np.ndarray, everywhere: np.ndarray) -> set[str]:
        """Return the names of the shapes with vertices at `points` (n, 3).

        Args:
            points: of a shape in Gmsh, any number of times each.
            everywhere: all points of the model in Gmsh; their extent gives the unit.
        """
        extent, there = _extent(self.everywhere), _extent(everywhere)
        scale = there / extent if extent > 0.0 else 1.0
        return {
            name
            for name, vertices in zip(self.names, self.vertices, strict=True)
            if _same_places(vertices * scale, points, TOLERANCE * there)
        }


def read_shapes(text: str) -> tuple[StepShapes, StepShapes]:
    """Return the edges and the faces that bear a name in the text of a STEP file."""
    instances = {int(n): (kind, rest) for n, kind, rest in _STATEMENT.findall(text)}
    points = {
        n: _point(instances, rest)
        for n, (kind, rest) in instances.items()
        if kind == "VERTEX_POINT"
    }
    everywhere = np.reshape(list(points.values()), (-1, 3))

    def shapes(kinds: tuple[str, ...]) -> StepShapes:
        names, vertices = [], []
        for n, (kind, rest) in instances.items():
            name = re.match(r"\s*'([^']*)'", rest)
            if kind in kinds and name and name[1].strip():
                names.append(name[1].strip().casefold())
                found = sorted(_reach(instances, n))
                vertices.append(np.reshape([points[k] for k in found], (-1, 3)))
        return StepShapes(names, vertices, everywhere)

    return shapes(_EDGES), shapes(_FACES)


def _references(rest: str) -> list[int]:
    return [int(n) for n in re.findall(r"#(\d+)", re.sub(r"'[^']*'", "", rest))]


def _point(instances: dict[int, tuple[str, str]], rest: str) -> list[float]:
    """Return the coordinates that a vertex refers to."""
    _, coordinates = instances[_references(rest)[0]]
    numbers = re.findall(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?", re.sub(r"'[^']*'", "", coordinates))
    return [float(number) for number in numbers]


def _reach(instances: dict[int, tuple[str, str]], start: int) -> set[int]:
    """Return the vertices below a shape."""
    found, ahead = set(), [start]
    while ahead:
        n = ahead.pop()
        kind, rest = instances.get(n, ("", ""))
        if kind == "VERTEX_POINT":
            found.add(n)
        elif kind in _PATH:
            ahead += _references(rest)
    return found


def _extent(points: np.ndarray) -> float:
    return float(np.ptp(points, axis=0).max()) if len(points) else 0.0


def _same_places(a: np.ndarray, b: np.ndarray, tolerance: float) -> bool:
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    near = max(distance.min(axis=0).max(), distance.min(axis=1).max())
    return bool(near < tolerance)
