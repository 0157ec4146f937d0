"""Hollow links, and straight members of uniform section: one layer of hexahedra in the wall."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import check_place
from dolfinopt.mesh.geometry import read_groups, telling_where, where_of
from dolfinopt.mesh.gmsh_session import DESIGN, PASSIVE
from dolfinopt.mesh.measured import (
    CORNER_CELL_RATIO,
    FILE_ROUNDING_SHARE,
    ROUND_CELLS,
    SECTION_CELLS,
    SECTION_END_CELLS,
    SECTION_LEAST_ALONG,
)
from dolfinopt.mesh.solid_cells import ENDS, boundary, elements_of, points_by_tag

if TYPE_CHECKING:
    from dolfinopt.scene.load import Arm

# -- straight members of uniform section: area and meshes
#
# The section lies in the y-z plane of the arm's frame, height along y and thickness along z, its
# middle on the x axis. A share in (0, 1] tells how much material it has: that of a bar's sides, of
# the others their wall over the largest one, with which no hollow is left.


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
    """A kind of section by its outer height h and thickness b, and a size w: the wall, m.

    Attributes:
        area_of: (h, b, w): m2.
        measures_of: (h, b, w): its sizes in the order of `named`, m.
        named: what the measures are, in words.
        largest: (h, b): w with a share of 1.
        plane: (h, b, w, layers): its cells; None of a bar, which is a box.
    """

    area_of: Callable[[float, float, float], float]
    measures_of: Callable[[float, float, float], tuple[float, ...]]
    named: str
    largest: Callable[[float, float], float]
    plane: Callable[[float, float, float, int], Plane] | None = None

    def area(self, height: float, thickness: float, share: float) -> float:
        """Return its area, m2."""
        return self.area_of(height, thickness, share * self.largest(height, thickness))

    def measures(self, height: float, thickness: float, share: float) -> tuple[float, ...]:
        """Return its sizes, m."""
        return self.measures_of(height, thickness, share * self.largest(height, thickness))


def member(section: Section, length: float, sides: tuple[float, float], share: float) -> Member:
    """Return the mesh of a member from x = 0 to its length.

    Args:
        section: its kind.
        length: m.
        sides: outer height and thickness, m.
        share: of the largest wall.
    """
    assert section.plane is not None
    layers = 1 + int(share * SECTION_CELLS)
    flat, quads = section.plane(*sides, share * section.largest(*sides), layers)
    along = max(SECTION_LEAST_ALONG, round(2.0 * length / max(sides)))
    places = stations(length, along)
    points = np.concatenate([np.column_stack([np.full(len(flat), x), flat]) for x in places])
    first = np.concatenate([quads, quads + len(flat)], axis=1)
    last = len(places) - 1
    cells = np.concatenate([first + k * len(flat) for k in range(last)])
    return Member(points, cells, quads[:, ::-1], quads + last * len(flat))


# -- kinds of members -------------------------------------------------------------------------


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


# Of bars w is the height, of solid ones in space the share itself: both sides are scaled by it. In
# the plane of motion the thickness is the scene's.
FLAT_BAR = Section(
    lambda h, b, w: w * b, lambda h, b, w: (w, b), "height x thickness", lambda h, b: h
)
SOLID_BAR = Section(
    lambda h, b, w: w * w * h * b,
    lambda h, b, w: (w * h, w * b),
    "height x thickness",
    lambda h, b: 1.0,
)
RECTANGULAR_TUBE = Section(
    lambda h, b, w: h * b - (h - 2.0 * w) * (b - 2.0 * w),
    lambda h, b, w: (h, b, w),
    "height x thickness x wall",
    _half,
    _rectangular_tube,
)
ROUND_TUBE = Section(
    lambda h, b, w: math.pi * (min(h, b) - w) * w,
    lambda h, b, w: (min(h, b), w),
    "diameter x wall",
    _half,
    _round_tube,
)
I_SECTION = Section(
    lambda h, b, w: 2.0 * b * w + (h - 2.0 * w) * w,
    lambda h, b, w: (h, b, w),
    "height x width x wall",
    lambda h, b: min(0.5 * h, b),
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


# -- hollow links: the outer surface as a grid of points
#
# The grid has s stations along the axis x and r points round every section, in its plane, so that
# the section of the hull is a polygon. A wall of thickness t has its inner nodes at
#
#     X_inner = X_outer + t d,
#
# with a fixed direction d of every point in the plane of its section, such that t is the distance
# of the two surfaces: at the corners of a box d is the mitre. Nodes beside a box's corners slide
# along the outer surface with the thickness at the corner, so that the cells there are as short as
# the wall is thick: the flow of shear turns in them, and cells of constant shear resist that.


@dataclass(frozen=True, eq=False)
class Hull:
    """The outer surface of a hollow link, and where its wall grows to.

    Attributes:
        outer: (s, r, 3) points in the arm's frame, x the same at a station, m; round the axis from
            y towards z.
        inward: (s, r, 3) d, the inner node's displacement by the wall's thickness; no x component.
        slide: (s, r, 3) displacement of both nodes by the thickness at another point of the same
            section, along the surface; 0 of most.
        lead: (r,) that point.
    """

    outer: np.ndarray
    inward: np.ndarray
    slide: np.ndarray
    lead: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along and round."""
        return self.outer.shape[0] - 1, self.outer.shape[1]

    def points(self, thickness: np.ndarray | float) -> np.ndarray:
        """Return outer and then inner nodes (2 s r, 3), given the thickness, one or (s, r), m."""
        t = np.broadcast_to(thickness, self.outer.shape[:2])[:, :, None]
        outer = self.outer + t[:, self.lead] * self.slide
        return np.concatenate([outer, outer + t * self.inward]).reshape(-1, 3)

    def by_thickness(self, by_points: np.ndarray) -> np.ndarray:
        """Return the derivatives (s, r) by the thickness, given those by `points` (2 s r, 3)."""
        outer, inner = by_points.reshape(2, *self.outer.shape)
        result = (inner * self.inward).sum(axis=2)
        np.add.at(result.T, self.lead, ((outer + inner) * self.slide).sum(axis=2).T)
        return np.asarray(result)

    def member(self, thickness: np.ndarray | float) -> Member:
        """Return the mesh of a wall of this thickness, one or (s, r), m."""
        along, around = self.shape
        count = (along + 1) * around
        k = np.arange(around)
        ahead = (k + 1) % around
        ring = np.stack([k, ahead, ahead + count, k + count], axis=1)
        first = np.concatenate([ring, ring + around], axis=1)
        cells = np.concatenate([first + i * around for i in range(along)])
        return Member(self.points(thickness), cells, ring[:, ::-1], ring + along * around)


def hull_of(outer: np.ndarray) -> Hull:
    """Return the hull with these points (s, r, 3), whose wall grows at right angles to its sides.

    In the section the thickness is the distance of parallel lines; where the hull is tapered, they
    are as far apart as gives the surfaces that distance.
    """
    section = outer[:, :, 1:]
    side = np.roll(section, -1, axis=1) - section
    side /= np.linalg.norm(side, axis=2, keepdims=True)
    after = np.stack([-side[:, :, 1], side[:, :, 0]], axis=2)
    before = np.roll(after, 1, axis=1)
    mitre = (before + after) / (1.0 + (before * after).sum(axis=2, keepdims=True))
    # How fast the surface comes nearer to the axis, along it.
    slope = (np.gradient(section, outer[:, 0, 0], axis=0) * mitre).sum(axis=2)
    slope /= (mitre * mitre).sum(axis=2)
    mitre *= np.sqrt(1.0 + slope * slope)[:, :, None]
    return _still(outer, np.concatenate([np.zeros((*slope.shape, 1)), mitre], axis=2))


def _still(outer: np.ndarray, inward: np.ndarray) -> Hull:
    """Return a hull whose outer nodes stay where they are."""
    return Hull(outer, inward, np.zeros_like(outer), np.arange(outer.shape[1]))


def stations(length: float, along: int) -> np.ndarray:
    """Return the stations of so many cells, m; the first and the last are cut once more.

    There the rigid interface holds the section's width, see `SECTION_END_CELLS`.
    """
    x = np.linspace(0.0, length, along + 1)
    ends = x[1] * np.array(SECTION_END_CELLS)
    return np.concatenate([x[:1], ends, x[1:-1], (length - ends)[::-1], x[-1:]])


def box_hull(
    size: tuple[float, float, float], cells: tuple[int, int, int], largest_wall: float
) -> Hull:
    """Return the hull of a box of length, height (y) and thickness (z), m, with so many cells."""
    length, height, thickness = size
    along, ny, nz = cells
    short = CORNER_CELL_RATIO * largest_wall
    y, z = _side(height, ny, short), _side(thickness, nz, short)
    half = np.concatenate(
        [
            np.column_stack([y, np.full(len(y), 0.5 * thickness)]),
            np.column_stack([np.full(len(z), -0.5 * height), z]),
        ]
    )
    hull = hull_of(_prism(stations(length, along), np.concatenate([half, -half])))
    corners = np.cumsum([0, len(y), len(z), len(y)])
    sides = (height / ny, thickness / nz) * 2
    for k, corner in enumerate(corners):
        # After the corner begins one side, before it ends another.
        for at, side in ((corner + 1, sides[k]), (corner - 1, sides[k - 1])):
            if _has_short(side, short):
                hull.slide[:, at] = (hull.outer[:, at] - hull.outer[:, corner]) / largest_wall
                hull.outer[:, at], hull.lead[at] = hull.outer[:, corner], corner
    return hull


def _has_short(side: float, short: float) -> bool:
    """Return whether cells of this side, m, are long enough for short ones at the corners."""
    return side - short > 0.5 * short


def _side(size: float, count: int, short: float) -> np.ndarray:
    """Return the places along a side of a box but the last, m, with short cells at both corners."""
    places = size * np.linspace(0.5, -0.5, count + 1)
    if _has_short(size / count, short):
        places = np.insert(places, [1, count], [0.5 * size - short, short - 0.5 * size])
    return places[:-1]


def tube_hull(size: tuple[float, float, float], cells: tuple[int, int, int]) -> Hull:
    """Return the hull of a round tube, size and cells as of a box.

    A polygon with the circle's area, as its inner one has: mass and moments are right, too.
    """
    length, diameter, _ = size
    along, ny, nz = cells
    around = 2 * (ny + nz)
    angle = 2.0 * math.pi / around
    scale = math.sqrt(angle / math.sin(angle))
    turns = angle * np.arange(around)
    circle = scale * np.column_stack([np.cos(turns), np.sin(turns)])
    outer = _prism(stations(length, along), 0.5 * diameter * circle)
    return _still(outer, -_prism(np.zeros(len(outer)), circle))


def _prism(x: np.ndarray, section: np.ndarray) -> np.ndarray:
    """Return the points (s, r, 3) of a section (r, 2) at every station."""
    points = np.empty((len(x), len(section), 3))
    points[:, :, 0], points[:, :, 1:] = x[:, None], section
    return points


@dataclass(frozen=True, eq=False)
class Wall:
    """The wall of a hollow arm's mesh, whose thickness x in [0, 1] of every cell decides.

    t = least + x (most - least); a node's is the mean of the cells around it. Linear, so that
    `backward` is the transpose of what `points` adds.

    Attributes:
        hull: the outer surface.
        least, most: wall thickness for x = 0 and 1, m.
        nodes: (n,) of the mesh's own nodes on this rank, in `Hull.points`.
        cells: (n_cells,) of the owned cells, row by row from inboard on.
    """

    hull: Hull
    least: float
    most: float
    nodes: np.ndarray
    cells: np.ndarray

    @cached_property
    def _mean(self) -> sp.csr_matrix:
        """What makes of the wall's cells the mean of those around every point of the hull."""
        along, around = self.hull.shape
        ahead = sp.eye(along + 1, along) + sp.eye(along + 1, along, k=-1)
        back = np.roll(np.arange(around), 1)
        turn = sp.eye(around) + sp.eye(around, format="csr")[back]
        sums = sp.kron(ahead, turn, format="csr")
        return sp.diags(1.0 / np.asarray(sums.sum(axis=1)).ravel()) @ sums

    def thickness(self, comm: MPI.Comm, x: np.ndarray) -> np.ndarray:
        """Return the thickness (s, r) at the points of the hull, m (collective on the arm)."""
        along, around = self.hull.shape
        all_shares = np.zeros(along * around)
        all_shares[self.cells] = x
        comm.Allreduce(MPI.IN_PLACE, all_shares)
        share = (self._mean @ all_shares).reshape(-1, around)
        return np.asarray(self.least + (self.most - self.least) * share)

    @property
    def normals(self) -> np.ndarray:
        """Return the outer surface's unit normals (n_cells, 3) in the owned cells' middles."""
        outer = self.hull.points(self.most)[: self.hull.outer[:, :, 0].size]
        outer = outer.reshape(self.hull.outer.shape)
        ahead = np.roll(outer, -1, axis=1)
        sides = (ahead - outer)[:-1] + (ahead - outer)[1:]
        result = np.cross(sides, (outer + ahead)[1:] - (outer + ahead)[:-1])
        result /= np.linalg.norm(result, axis=2, keepdims=True)
        return np.asarray(result.reshape(-1, 3)[self.cells])

    def points(self, comm: MPI.Comm, x: np.ndarray) -> np.ndarray:
        """Return the places (n, 3) of this rank's nodes, m (collective on the arm)."""
        return self.hull.points(self.thickness(comm, x))[self.nodes]

    def backward(self, by_points: np.ndarray) -> np.ndarray:
        """Return the derivative by x (n_cells,), given that by this rank's nodes (n, 3)."""
        by_hull = np.zeros((2 * self.hull.outer[:, :, 0].size, 3))
        by_hull[self.nodes] = by_points
        by_share = self._mean.T @ self.hull.by_thickness(by_hull).ravel()
        return np.asarray((self.most - self.least) * by_share[self.cells])


def wall_of(
    hull: Hull, limits: tuple[float, float], points: np.ndarray, centroid: np.ndarray
) -> Wall:
    """Return the wall of a mesh that `Hull.member` has been made into, its thickness `limits[1]`.

    Args:
        hull: the outer surface.
        limits: least and largest thickness, m.
        points: (n, 3) of the mesh's nodes on this rank, m.
        centroid: (n_cells, 3) of its owned cells, m.
    """
    known = hull.member(limits[1])
    nodes = cKDTree(known.points).query(points)[1]
    cells = cKDTree(known.points[known.cells].mean(axis=1)).query(centroid)[1]
    return Wall(hull, *limits, nodes, cells)


# -- the outer surface from a solid mesh file, by rays from the axis of the arm ----------------


def read_hull(gmsh: Any, arm: Arm) -> Hull:
    """Return the hull of the cells of `arms.hull`, between its interfaces (on the root).

    Raises:
        InputError: the file cannot be the arm, or one of its sections be told by rays from the
            axis; one line that names file and remedy.
    """
    points, cells, ends = read_cells(gmsh, arm.unchecked_copy({"mesh": arm.hull}))
    gmsh.clear()
    assert arm.cells is not None
    first, last = float(ends[0][:, 0].max()), float(ends[1][:, 0].min())
    x = first + stations(last - first, arm.cells[0])
    turns = 2.0 * np.pi * np.arange(arm.cells_around) / arm.cells_around
    rays = np.column_stack([arm.height * np.cos(turns), arm.thickness * np.sin(turns)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    facets = boundary(cells)
    halves = [facets[:, [0, k, k + 1]] for k in range(1, facets.shape[1] - 1)]
    triangles = points[np.concatenate(halves)]
    shift = FILE_ROUNDING_SHARE * (last - first)
    outer = np.empty((len(x), len(rays), 3))
    outer[:, :, 0] = x[:, None]
    for i, at in enumerate(x):
        # A little beside the nodes' own planes, and within the ends.
        plane = at + (shift if i < len(x) - 1 else -shift)
        outer[i, :, 1:] = _radii(triangles, plane, rays, arm)[:, None] * rays
    hull = hull_of(outer)
    _check_room(hull, arm)
    return hull


def read_cells(gmsh: Any, arm: Arm) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Read the solid of a .msh file, of whatever cells.

    Returns:
        Points by their tags (n, 3), m; cells (m, c) in Gmsh's order; points (k, 3) of the inboard
        and of the outboard interface.

    Raises:
        InputError: one line that names file, arm and remedy.
    """
    with telling_where(where_of(arm)):
        groups = read_groups(gmsh, arm, [])
        points = points_by_tag(gmsh)
        cells = elements_of(gmsh, 3, groups[DESIGN] + groups[PASSIVE])
        ends = [points[np.unique(elements_of(gmsh, 2, groups[tag]))] for tag in ENDS]
        for name, at, x in zip(("inboard", "outboard"), ends, (0.0, arm.length), strict=True):
            check_place(at, name, x, arm)
    return points, cells, ends


def _radii(triangles: np.ndarray, x: float, rays: np.ndarray, arm: Arm) -> np.ndarray:
    """Return how far the surface is from the axis in a section along rays (r, 2), m."""
    a, b = triangles, np.roll(triangles, -1, axis=1)
    cut = (a[:, :, 0] < x) != (b[:, :, 0] < x)  # two edges of a triangle, or none
    a, b = a[cut], b[cut]
    share = (x - a[:, :1]) / (b[:, :1] - a[:, :1])
    ends = (a + share * (b - a)).reshape(-1, 2, 3)[:, :, 1:]
    aside, along = ends @ np.array([-rays[:, 1], rays[:, 0]]), ends @ rays.T
    result = np.empty(len(rays))
    for k, ray in enumerate(rays):
        meets = (aside[:, 0, k] < 0.0) != (aside[:, 1, k] < 0.0)
        (s, t), (near, far) = aside[meets, :, k].T, along[meets, :, k].T
        radius = near + s / (s - t) * (far - near)
        radius = np.sort(radius[radius > 0.0])
        apart = np.diff(radius, prepend=-np.inf) > FILE_ROUNDING_SHARE * arm.height
        if apart.sum() != 1:
            raise InputError(
                f"{arm.hull}: arm {arm.name!r}: seen from the axis at x = {x:.4g} m in the "
                f"direction y, z = {ray[0]:.3g}, {ray[1]:.3g} a ray meets the surface "
                f"{apart.sum()} times, expected once: hollow arms have sections that are "
                'star-shaped about the axis; close holes, or take hollow = "box" or "tube"'
            )
        result[k] = radius[-1]
    return result


def _check_room(hull: Hull, arm: Arm) -> None:
    """Raise InputError where the thickest wall would turn its inner surface over."""
    most = arm.wall_limits[1]
    inner = hull.outer + most * hull.inward
    sides = [np.roll(item[:, :, 1:], -1, axis=1) - item[:, :, 1:] for item in (hull.outer, inner)]
    turned = (sides[0] * sides[1]).sum(axis=2) <= 0.0
    if turned.any():
        i, j = np.argwhere(turned)[0]
        place = ", ".join(f"{value:.4g}" for value in hull.outer[i, j])
        raise InputError(
            f"{arm.hull}: arm {arm.name!r}: arms.max_wall = {most:g}: the inner surface crosses "
            f"itself at ({place}) m; expected a thinner wall, or fewer arms.cells round a section "
            "so uneven"
        )
