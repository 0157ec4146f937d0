"""Straight members of uniform section: area, and meshes of hexahedra with one layer in the wall.

The section lies in the y-z plane of the arm's frame, height along y and thickness along z, its
middle on the x axis. A share in (0, 1] tells how much material it has: that of a bar's sides, of
the others their wall over the largest one, with which no hollow is left.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dolfinopt.mesh.measured import (
    LAYER_SHARE,
    ROUND_CELLS,
    SECTION_ALONG_SHARE,
    SECTION_CELLS,
    SECTION_END_CELLS,
    SECTION_LEAST_ALONG,
)


@dataclass(frozen=True, eq=False)
class Member:
    """A mesh of hexahedra as `geometry.msh_bytes` writes it.

    Attributes:
        points: (n, 3) in the arm's frame, m.
        cells: (m, 8) in Gmsh's order.
        inboard, outboard: (k, 4) points of the end faces' facets, seen from outside.
    """

    points: np.ndarray
    cells: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray

    @property
    def extents(self) -> np.ndarray:
        """Extents (3,) along the axes of the arm's frame, m."""
        return np.asarray(np.ptp(self.points, axis=0))


Plane = tuple[np.ndarray, np.ndarray]  # points (n, 2) of y and z, m; quadrilaterals (m, 4)


@dataclass(frozen=True)
class Section:
    """A kind of section, by its outer height and thickness and a share.

    Attributes:
        area: (height, thickness, share): m2.
        measures: (height, thickness, share): its sizes in the order of `named`, m.
        named: what the measures are, in words.
        largest_wall: (height, thickness): its wall with a share of 1, m.
        plane: (height, thickness, wall, layers): its cells; None of a bar, which is a box.
    """

    area: Callable[[float, float, float], float]
    measures: Callable[[float, float, float], tuple[float, ...]]
    named: str
    largest_wall: Callable[[float, float], float] = lambda height, thickness: 0.5 * height
    plane: Callable[[float, float, float, int], Plane] | None = None


def member(section: Section, length: float, sides: tuple[float, float], share: float) -> Member:
    """Return the mesh of a member from x = 0 to its length.

    Args:
        section: its kind.
        length: m.
        sides: outer height and thickness, m.
        share: of the largest wall.
    """
    assert section.plane is not None
    layers = 1 + int(share / LAYER_SHARE)
    flat, quads = section.plane(*sides, share * section.largest_wall(*sides), layers)
    along = max(SECTION_LEAST_ALONG, round(length / (SECTION_ALONG_SHARE * max(sides))))
    cell = length / along
    ends = cell * np.array(SECTION_END_CELLS)
    stations = np.concatenate([[0.0], ends, cell * np.arange(1, along), (length - ends)[::-1]])
    stations = np.append(stations, length)
    points = np.concatenate([np.column_stack([np.full(len(flat), x), flat]) for x in stations])
    first = np.concatenate([quads, quads + len(flat)], axis=1)
    last = len(stations) - 1
    cells = np.concatenate([first + k * len(flat) for k in range(last)])
    return Member(points, cells, quads[:, ::-1], quads + last * len(flat))


# -- kinds -----------------------------------------------------------------------------------


def _grid(y: np.ndarray, z: np.ndarray, keep: Callable[..., np.ndarray]) -> Plane:
    """Return the cells between lines y and z whose middles are to be kept."""
    points = np.stack(np.meshgrid(y, z, indexing="ij"), axis=2).reshape(-1, 2)
    i, j = np.meshgrid(np.arange(len(y) - 1), np.arange(len(z) - 1), indexing="ij")
    corner = (i * len(z) + j).ravel()
    quads = np.stack([corner, corner + len(z), corner + len(z) + 1, corner + 1], axis=1)
    quads = quads[keep(*points[quads].mean(axis=1).T)]
    used, numbers = np.unique(quads, return_inverse=True)
    return points[used], numbers.reshape(-1, 4)


def _walled(size: float, wall: float, layers: int) -> np.ndarray:
    """Return lines across a side: those of both walls and of what lies between."""
    half, inner = 0.5 * size, 0.5 * size - wall
    upper = np.linspace(inner, half, layers + 1)
    between = np.linspace(-inner, inner, SECTION_CELLS + 1)
    return np.concatenate([-upper[:0:-1], between, upper[1:]])


def _rectangular_tube(height: float, thickness: float, wall: float, layers: int) -> Plane:
    def keep(y: np.ndarray, z: np.ndarray) -> np.ndarray:
        within = (np.abs(y) < 0.5 * height - wall) & (np.abs(z) < 0.5 * thickness - wall)
        return np.asarray(~within)

    return _grid(_walled(height, wall, layers), _walled(thickness, wall, layers), keep)


def _beam(height: float, thickness: float, wall: float, layers: int) -> Plane:
    """Return an I: flanges above and below, the web halfway, all as thick as the wall."""
    half = np.linspace(0.5 * wall, 0.5 * thickness, SECTION_CELLS // 2 + 1)
    z = np.concatenate([-half[::-1], np.linspace(-0.5 * wall, 0.5 * wall, layers + 1)[1:-1], half])

    def keep(y: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.asarray((np.abs(y) > 0.5 * height - wall) | (np.abs(z) < 0.5 * wall))

    return _grid(_walled(height, wall, layers), z, keep)


def _round_tube(height: float, thickness: float, wall: float, layers: int) -> Plane:
    """Return a ring of straight sides with the circle's area: so its moments are right, too."""
    angle = 2.0 * math.pi / ROUND_CELLS
    radius = 0.5 * min(height, thickness) * math.sqrt(angle / math.sin(angle))
    inner = radius * (1.0 - 2.0 * wall / min(height, thickness))
    turns = angle * np.arange(ROUND_CELLS)
    around = np.column_stack([np.cos(turns), np.sin(turns)])
    points = np.concatenate([r * around for r in np.linspace(inner, radius, layers + 1)])
    k = np.arange(ROUND_CELLS)
    ahead = (k + 1) % ROUND_CELLS
    ring = np.stack([k, k + ROUND_CELLS, ahead + ROUND_CELLS, ahead], axis=1)
    return points, np.concatenate([ring + layer * ROUND_CELLS for layer in range(layers)])


def _half(height: float, thickness: float) -> float:
    """Return half the smaller side, m: no tube's wall is thicker."""
    return 0.5 * min(height, thickness)


def _tube_area(height: float, thickness: float, share: float) -> float:
    wall = share * _half(height, thickness)
    return height * thickness - (height - 2.0 * wall) * (thickness - 2.0 * wall)


def _round_area(height: float, thickness: float, share: float) -> float:
    return math.pi * _half(height, thickness) ** 2 * (1.0 - (1.0 - share) ** 2)


def _beam_wall(height: float, thickness: float) -> float:
    return min(0.5 * height, thickness)


def _beam_area(height: float, thickness: float, share: float) -> float:
    wall = share * _beam_wall(height, thickness)
    return 2.0 * thickness * wall + (height - 2.0 * wall) * wall


# In the plane of motion the thickness is the scene's.
FLAT_BAR = Section(
    lambda h, b, share: share * h * b, lambda h, b, share: (share * h, b), "height x thickness"
)
SOLID_BAR = Section(
    lambda h, b, share: share * share * h * b,
    lambda h, b, share: (share * h, share * b),
    "height x thickness",
)
RECTANGULAR_TUBE = Section(
    _tube_area,
    lambda h, b, share: (h, b, share * _half(h, b)),
    "height x thickness x wall",
    _half,
    _rectangular_tube,
)
ROUND_TUBE = Section(
    _round_area,
    lambda h, b, share: (min(h, b), share * _half(h, b)),
    "diameter x wall",
    _half,
    _round_tube,
)
I_SECTION = Section(
    _beam_area,
    lambda h, b, share: (h, b, share * _beam_wall(h, b)),
    "height x width x wall",
    _beam_wall,
    _beam,
)
KINDS = {  # by the machine's dimension
    2: {"solid bar": FLAT_BAR},
    3: {
        "solid bar": SOLID_BAR,
        "rectangular tube": RECTANGULAR_TUBE,
        "round tube": ROUND_TUBE,
        "I section": I_SECTION,
    },
}
