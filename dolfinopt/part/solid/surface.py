"""The surface of a solid's design: where its density passes the level that keeps its volume.

Densities of cells are averaged to their nodes, by the cells' volumes. The cells are cut at the
level; where the density is above it the solid's own faces stay, interfaces among them. What joins
both interfaces above the level is kept, smoothed where material ends within the arm, and moved a
little to its volume; crossings are found. Source of the smoothing: Taubin, Zhang & Golub, Optimal
surface smoothing as filter design, ECCV 1996, doi:10.1007/BFb0015544.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import brentq

from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import cell_sizes
from dolfinopt.mesh.solid_cells import TENSOR
from dolfinopt.part.domain import SolidDomain
from dolfinopt.part.plane.curves import MM

APART = 0.005  # least difference of a node's density from the level


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed surface of triangles.

    Attributes:
        points: (n, 3) m.
        triangles: (m, 3) indices of corners, counterclockwise seen from outside.
        cells: (m,) index of the cell behind every triangle, if it was cut from cells.
        fields: (n, ...) values at the points, by name.
    """

    points: np.ndarray
    triangles: np.ndarray
    cells: np.ndarray | None = None
    fields: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def corners(self) -> np.ndarray:
        """Corners (m, 3, 3) of the triangles, m."""
        return np.asarray(self.points[self.triangles])

    @property
    def volume(self) -> float:
        """Volume within, m3."""
        a, b, c = self.corners.swapaxes(0, 1)
        return float(np.einsum("na,na->", a, np.cross(b, c)) / 6.0)


def surface_at(
    corners: np.ndarray,
    density: np.ndarray,
    level: float,
    fields: Mapping[str, np.ndarray] | None = None,
) -> Surface:
    """Return the surface of what is denser than a level, in the cells' frame; it may be empty.

    Args:
        corners: (n, 4 or 8, 3) of the tetrahedra or hexahedra in any order, m; common ones are
            the same to the last bit.
        density: (n,) of the same cells.
        level: of the density.
        fields: (n, 4 or 8, ...) values at the same corners, to be carried to the surface's points.
    """
    points, nodes, values = nodal_densities(corners, density)
    if values.max() <= level - APART:
        empty = np.zeros((0, 3))
        return Surface(empty, empty.astype(int), np.zeros(0, dtype=int))
    at_nodes = {}
    for name, at_corners in (fields or {}).items():
        at_nodes[name] = np.empty((len(points), *at_corners.shape[2:]))
        at_nodes[name][_numbers(corners)[1]] = at_corners
    surface, result = outside(cut(points, nodes, values, level, at_nodes))
    carried = {name: result[name].reshape(-1, *item.shape[1:]) for name, item in at_nodes.items()}
    return replace(surface, fields=carried)


def _numbers(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (n, 3) of cells, and the cells' nodes in the order of their corners."""
    points, nodes = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return points, nodes.reshape(corners.shape[:2])


def nodal_densities(
    corners: np.ndarray, density: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (n, 3), nodes of right-handed cells, and the densities (n,) at the points.

    Args:
        corners, density: as for `surface_at`.
    """
    points, nodes = _numbers(corners)
    nodes = _right_handed(corners, nodes)
    sizes = cell_sizes(corners)
    weight, total = np.zeros((2, len(points)))
    for node in nodes.T:
        np.add.at(weight, node, sizes)
        np.add.at(total, node, sizes * density)
    return points, nodes, total / weight


def halved(corners: np.ndarray, density: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `nodal_densities` does of hexahedra cut in eight, 27 points in each.

    At a cell's centre its own density counts alone: a member as thick as one cell stays so.

    Args:
        corners: (n, 8, 3) m, common ones the same to the last bit.
        density: (n,) of the cells.

    Returns:
        Points (m, 3); nodes (n, 27) of every cell as a tensor product; densities (m,).
    """
    grid = corners.reshape(-1, 2, 2, 2, 3)
    for axis in (1, 2, 3):
        first, last = np.split(grid, 2, axis=axis)
        # Sums of the same two numbers, whichever comes first: halves of common edges are common.
        grid = np.concatenate([first, 0.5 * (first + last), last], axis=axis)
    for axis in (1, 2, 3):
        _centre_faces(grid, corners, axis)
    points, nodes = _numbers(grid.reshape(-1, 27, 3))
    nodes, sizes = _right_handed(corners, nodes), cell_sizes(corners)
    weight, total = (
        np.bincount(nodes.ravel(), np.repeat(item, 27), len(points))
        for item in (sizes, sizes * density)
    )
    return points, nodes, total / weight


def middles(faces: np.ndarray) -> np.ndarray:
    """Return the nine points (n, 9, 3) of `halved` on faces (n, 4, 3), corners around them, m."""
    a, b, c, d = faces.swapaxes(0, 1)
    ends = [0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + d), 0.5 * (d + a)]
    return np.stack([a, b, c, d, *ends, 0.25 * ((a + c) + (b + d))], axis=1)


def eighths(nodes: np.ndarray) -> np.ndarray:
    """Return the nodes (8 n, 8) of the cells that `halved` made of nodes (n, 27)."""
    grid = nodes.reshape(-1, 3, 3, 3)
    parts = [
        grid[:, z : z + 2, y : y + 2, x : x + 2].reshape(-1, 8)
        for z in (0, 1) for y in (0, 1) for x in (0, 1)
    ]  # fmt: skip
    return np.stack(parts, axis=1).reshape(-1, 8)


def tetrahedra(points: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the nodes (k, 4) of tetrahedra in which hexahedra of nodes (n, 8) are cut.

    By the numbers of the nodes: neighbours cut a face that they share alike, however they are
    turned, as VTK's ways to clip hexahedra do not.
    """
    import pyvista

    cells = _grid(points, nodes).triangulate().cells_dict[pyvista.CellType.TETRA]
    return _right_handed(points[cells], cells)


def _grid(points: np.ndarray, nodes: np.ndarray) -> Any:
    """Return the grid, of VTK, of cells of nodes (n, 4 or 8)."""
    import pyvista

    count = nodes.shape[1]
    kind = pyvista.CellType.TETRA if count == 4 else pyvista.CellType.HEXAHEDRON
    return pyvista.UnstructuredGrid({kind: nodes[:, TENSOR[count, 3]]}, points)


def _centre_faces(grid: np.ndarray, corners: np.ndarray, axis: int) -> None:
    """Put the centres of the faces across an axis where both of their cells have them."""
    cube = corners.reshape(-1, 2, 2, 2, 3)
    for place, side in ((0, 0), (2, 1)):
        face = np.take(cube, side, axis=axis)
        middle = 0.25 * ((face[:, 0, 0] + face[:, 1, 1]) + (face[:, 0, 1] + face[:, 1, 0]))
        at: list[slice | int] = [slice(None), 1, 1, 1]
        at[axis] = place
        grid[tuple(at)] = middle


def _right_handed(corners: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return nodes (n, ...) of cells with corners (n, 4 or 8, 3), left-handed ones mirrored."""
    edges = corners[:, [1, 2, 3 if corners.shape[1] == 4 else 4]] - corners[:, :1]
    if corners.shape[1] == 4:
        mirrored = nodes[:, [0, 2, 1, 3]]
    else:  # a tensor product, one layer after the other
        layers = round(nodes.shape[1] ** (1.0 / 3.0))
        mirrored = nodes.reshape(len(nodes), layers, -1)[:, ::-1].reshape(nodes.shape)
    return np.where((np.linalg.det(edges) < 0.0)[:, None], mirrored, nodes)


def cut(
    points: np.ndarray,
    nodes: np.ndarray,
    values: np.ndarray,
    level: float,
    fields: Mapping[str, np.ndarray] | None = None,
) -> Any:
    """Return the grid, of VTK, of what of the cells is above a level, with its nodes' density.

    Args:
        points, nodes, values: of `nodal_densities`.
        level: of the density.
        fields: (n, ...) further values at the nodes that the grid is to have, by their names.
    """
    grid = _grid(points, nodes)
    # Through a node or next to it triangles would have no size, and corners fall together.
    grid.point_data["density"] = np.where(np.abs(values - level) < APART, level + APART, values)
    for name, field_values in (fields or {}).items():
        grid.point_data[name] = field_values.reshape(len(points), -1)
    grid.cell_data["cell"] = np.arange(len(nodes))
    return grid.clip_scalar(scalars="density", invert=False, value=level)


def outside(solid: Any) -> tuple[Surface, dict[str, np.ndarray]]:
    """Return the surface of a grid of `cut`, and the values (n, ...) at its points by name."""
    import pyvista
    from vtkmodules.vtkFiltersGeometry import vtkDataSetSurfaceFilter

    faces = vtkDataSetSurfaceFilter()
    faces.SetInputData(solid)
    faces.PassThroughCellIdsOn()
    faces.Update()
    result = pyvista.PolyData(faces.GetOutput()).triangulate().clean()
    triangles = result.faces.reshape(-1, 4)[:, 1:].astype(int)
    within = solid.cell_centers().points[result.cell_data["vtkOriginalCellIds"]]
    surface = _outwards(np.asarray(result.points, dtype=float), triangles, within)
    values = {name: np.asarray(result.point_data[name]) for name in result.point_data}
    return replace(surface, cells=np.asarray(result.cell_data["cell"])), values


def _outwards(points: np.ndarray, triangles: np.ndarray, within: np.ndarray) -> Surface:
    """Return a surface whose triangles turn away from points (m, 3) within the cells they bound."""
    # VTK's own are not all counterclockwise seen from outside in every version. Triangles that
    # share an edge run along it in opposite directions; which way they turn is what most of them
    # say, by the volume to their point: that of a warped cell may be on the wrong side of one of
    # them.
    import scipy.sparse as sp
    from scipy.sparse.csgraph import connected_components

    count = len(triangles)
    a, b, c = points[triangles].swapaxes(0, 1)
    outwards = np.einsum("na,na->n", np.cross(b - a, c - a), a - within)
    edges, pairs = neighbours(triangles)
    (side, other), alike = pairs.T, edges[:, 0, 0] != edges[:, 1, 0]
    # Every triangle as it is, 0 ... m - 1, and turned, m ... 2 m - 1: which go together.
    start, end = np.concatenate([side, side + count]), np.where(alike, other, other + count)
    end = np.concatenate([end, (end + count) % (2 * count)])
    links = sp.csr_matrix((np.ones(len(start)), (start, end)), shape=(2 * count, 2 * count))
    sheet = connected_components(links, directed=False)[1]
    score = np.bincount(sheet, weights=np.concatenate([outwards, -outwards]))
    turned = score[sheet[:count]] < score[sheet[count:]]
    return Surface(points, np.where(turned[:, None], triangles[:, ::-1], triangles))


def edges_of(faces: np.ndarray) -> np.ndarray:
    """Return both nodes (n k, 2) of the edges around faces of nodes (n, k), face by face."""
    return np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)


def neighbours(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges that two faces of nodes (n, 3 or 4) share, and these faces (k, 2).

    Edges are (k, 2, 2): both nodes as either face runs along them.
    """
    edges = edges_of(faces)
    key = np.sort(edges, axis=1) @ [faces.max(initial=0) + 1, 1]
    order = np.argsort(key, kind="stable")
    pair = order[np.flatnonzero(np.diff(key[order]) == 0)[:, None] + [0, 1]]
    return edges[pair], pair // faces.shape[1]


# Of the windowed sinc: steps from cell to cell go, ripples of a smooth field's isosurface.
PASSES, STEPS, RIPPLES = 40, 0.03, 0.15
FURTHEST = 0.4  # of a cell that smoothing moves a point
ROOM = 0.5  # and of its distance from the arm's own faces
CORRECTIONS, SAME_VOLUME = 20, 1e-9  # Newton's steps; relative


def smooth_surface(
    surface: Surface,
    inner: np.ndarray,
    free: np.ndarray,
    cell: float,
    walls: np.ndarray,
    crisp: bool = True,
) -> Surface:
    """Return a surface whose free points are smoothed.

    By 0.4 cells at most, and half of the distance from the arm's own faces: none is passed.

    Args:
        surface: closed.
        inner: (m,) True of triangles where material ends within the arm.
        free: (n,) True of points that move, all of them on inner triangles alone.
        cell: size of the design's cells, m.
        walls: (k, 3 or 4, 3) corners of the arm's own faces, around them, m.
        crisp: whether the surface has the steps of cells.
    """
    import pyvista

    if not free.any():
        return surface
    patch = pyvista.PolyData.from_regular_faces(surface.points, surface.triangles[inner])
    smooth = patch.smooth_taubin(
        n_iter=PASSES,
        pass_band=STEPS if crisp else RIPPLES,
        boundary_smoothing=False,
        feature_smoothing=False,
        non_manifold_smoothing=False,
        normalize_coordinates=True,
    )
    move = np.asarray(smooth.points, dtype=float) - surface.points
    room = distance_to_faces(surface.points, walls)
    most = np.minimum(FURTHEST * cell, ROOM * room)
    length = np.linalg.norm(move, axis=1)
    move *= np.minimum(1.0, most / np.maximum(length, 1e-300))[:, None]
    return replace(surface, points=surface.points + np.where(free[:, None], move, 0.0))


def distance_to_faces(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the distance (n,) of points (n, 3) from the nearest of faces (k, 2 to 4, 3), m.

    Args:
        points: m.
        faces: corners around flat faces, or ends of edges, m.
    """
    import pyvista

    corners, count = faces.reshape(-1, 3), faces.shape[1]
    around = np.arange(len(corners), dtype=int).reshape(-1, count)
    cells = np.column_stack([np.full(len(around), count), around]).ravel()
    mesh: Any = pyvista.PolyData
    result = mesh(corners, lines=cells) if count == 2 else mesh(corners, cells)
    _, nearest = result.find_closest_cell(points, return_closest_point=True)
    return np.asarray(np.linalg.norm(np.asarray(nearest) - points, axis=1))


def with_volume(surface: Surface, free: np.ndarray, volume: float) -> Surface:
    """Return a surface whose free points are moved along their normals until it has a volume.

    All by the same length. Where that does not lead there the volume is not the one wanted.

    Args:
        surface: closed.
        free: (n,) True of points that move.
        volume: that it is to enclose, m3.
    """
    points = surface.points
    for _ in range(CORRECTIONS):
        now = replace(surface, points=points)
        lacks = volume - now.volume
        if abs(lacks) <= SAME_VOLUME * volume:
            break
        area = np.where(free[:, None], area_vectors(now), 0.0)
        size = np.linalg.norm(area, axis=1)
        if size.sum() == 0.0:
            break
        normal = area / np.maximum(size, 1e-300)[:, None]
        points = points + lacks / size.sum() * normal
    return replace(surface, points=points)


def area_vectors(surface: Surface) -> np.ndarray:
    """Return the derivative (n, 3) of the volume by the points, m2."""
    a, b, c = surface.corners.swapaxes(0, 1)
    result = np.zeros_like(surface.points)
    for corner, across in zip(
        surface.triangles.T, (np.cross(b, c), np.cross(c, a), np.cross(a, b)), strict=True
    ):
        np.add.at(result, corner, across / 6.0)
    return result


def crossings(surface: Surface) -> np.ndarray:
    """Return pairs (n, 2) of triangles of which an edge of the first passes through the second.

    Edges that have a corner in common with a triangle do not count, and neither does what only
    touches, as pieces of material that meet in a point.
    """
    import pyvista
    from vtkmodules.vtkCommonCore import vtkIdList

    points, triangles = surface.points, surface.triangles
    edges = edges_of(triangles)
    _, first = np.unique(np.sort(edges, axis=1), axis=0, return_index=True)
    locator = locator_of(pyvista.PolyData.from_regular_faces(points, triangles))
    hit, pairs = vtkIdList(), list[tuple[int, int]]()
    for k, (start, end) in zip(first.tolist(), points[edges[first]], strict=True):
        locator.IntersectWithLine(start, end, 0.0, None, hit)
        pairs += [(k, hit.GetId(i)) for i in range(hit.GetNumberOfIds())]
    edge, triangle = np.array(pairs, dtype=int).reshape(-1, 2).T
    apart = (edges[edge][:, :, None] != triangles[triangle][:, None]).all(axis=(1, 2))
    return np.column_stack([edge // 3, triangle])[apart]


def locator_of(triangles: Any) -> Any:
    """Return what finds where lines pass through triangles, both of VTK."""
    from vtkmodules.vtkCommonDataModel import vtkStaticCellLocator

    result = vtkStaticCellLocator()
    result.SetDataSet(triangles)
    result.BuildLocator()
    return result


def open_edges(surface: Surface) -> np.ndarray:
    """Return edges (n, 2) that no other triangle runs along in the opposite direction, but one."""
    triangles, count = surface.triangles, len(surface.points)
    edges = edges_of(triangles)
    there, back = (edges @ row for row in ([count, 1], [1, count]))
    _, which, times = np.unique(there, return_inverse=True, return_counts=True)
    return edges[~np.isin(back, there) | (times[which] > 1)]


def cavities(surface: Surface) -> np.ndarray:
    """Return the middles (k, 3) of closed cavities, m: sheets that turn inwards."""
    import pyvista

    _, sheet = _regions(pyvista.PolyData.from_regular_faces(surface.points, surface.triangles))
    a, b, c = surface.corners.swapaxes(0, 1)
    inwards = np.bincount(sheet, np.einsum("na,na->n", a, np.cross(b, c))) < 0.0
    middles = [surface.corners[sheet == k].mean(axis=(0, 1)) for k in np.flatnonzero(inwards)]
    return np.array(middles).reshape(-1, 3)


def check_surface(name: str, surface: Surface) -> None:
    """Raise InputError, with arm and place, unless a surface is closed and crosses itself nowhere.

    Args:
        name: of the arm.
        surface: of its part.
    """
    edges = open_edges(surface)
    if len(edges):
        where, what = surface.points[edges[0]], f"is open at {len(edges)} edges"
    else:
        crossed = crossings(surface)
        if not len(crossed):
            return
        where = surface.corners[crossed[0, 0]]
        what = f"crosses itself in {len(crossed)} places"
    x, y, z = MM * where.mean(axis=0)
    raise InputError(
        f"arm {name!r}: the surface of its part {what}, the first at ({x:.1f}, {y:.1f}, {z:.1f}) "
        "mm; optimise with larger members (design.filter_radius), and with "
        'design.projection = "robust" until the design is crisp'
    )


FINE, NEAR = 1e-6, 1e-3  # of the level; relative difference of volumes that will do
WHOLE = 1.0 - 1e-9  # of a mark that points between two marked nodes have, but for rounding
# Cells up to which they are halved for the isosurface; of finer ones nodes tell enough.
FEW = 20_000
MARKS = ("own", "inboard", "outboard")
FURTHER = "further "  # before the names of the marks of further interfaces


@dataclass(frozen=True, eq=False)
class _Field:
    """The density of a solid arm at nodes."""

    points: np.ndarray  # (n, 3) m
    nodes: np.ndarray  # (m, 4 or 8) of cells
    # (n,) with the highest one at interfaces: material along them that the design leaves void,
    # since interfaces are rigid
    values: np.ndarray
    # (n,) 1.0 of nodes on `SolidDomain`'s faces and in what stays solid, by name
    marks: dict[str, np.ndarray]

    def above(self, level: float) -> Any:
        """Return the grid of what is above a level, see `cut`; what stays solid is."""
        stays = self.marks["stays"] > 0.0
        values = np.where(stays, np.maximum(self.values, level + APART), self.values)
        return cut(self.points, self.nodes, values, level, self.marks)


def _field(domain: SolidDomain) -> _Field:
    corners, density = domain.corners, domain.field
    faces = {name: getattr(domain, name) for name in MARKS}
    faces |= {FURTHER + name: item for name, item in domain.further.items()}
    is_box = domain.is_box
    if corners.shape[1] == 8 and (len(corners) <= FEW or not is_box):
        points, nodes, values = halved(corners, density)
        cells = eighths(nodes) if is_box else tetrahedra(points, eighths(nodes))
        faces = {name: middles(face) for name, face in faces.items()}
    else:
        points, nodes, values = nodal_densities(corners, density)
        cells = nodes
    marks = {name: _among(points, face) for name, face in faces.items()}
    marks["stays"] = np.zeros(len(points))
    marks["stays"][nodes[domain.passive]] = 1.0
    values[(marks["inboard"] > 0.0) | (marks["outboard"] > 0.0)] = values.max()
    return _Field(points, cells, values, marks)


def at_volume(domain: SolidDomain) -> tuple[float, Any, int, float]:
    """Return the level that keeps the volume, the grid above it that joins both interfaces, the
    number of pieces that do not, and their volume, m3."""
    field, target, tried = _field(domain), domain.volume, list[tuple[float, float, Any, Any]]()

    def excess(level: float) -> float:
        above = field.above(level)
        joined = _joined(above)
        off = (0.0 if joined is None else outside(joined)[0].volume) - target
        if joined is not None:
            tried.append((abs(off), level, above, joined))
        return 0.0 if abs(off) <= NEAR * target else off

    with suppress(ValueError):  # whatever the level the volume is too large, or too small
        brentq(excess, APART, float(field.values.max()) - APART, xtol=FINE)
    if not tried:
        raise InputError(
            f"arm {domain.name!r}: its design does not hang together: no material joins both "
            "interfaces; optimise longer, or with a larger design.volume_fraction"
        )
    _, level, above, joined = min(tried, key=lambda item: item[0])
    count = _number_of_pieces(above) - _number_of_pieces(joined)
    lost = outside(above)[0].volume - outside(joined)[0].volume if count else 0.0
    return level, joined, count, lost


def _among(points: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Return 1.0 (n,) of points (n, 3) that are corners of some faces to the last bit, else 0.0."""
    kinds = np.unique(np.concatenate([points, some.reshape(-1, 3)]), axis=0, return_inverse=True)[
        1
    ].ravel()
    return np.isin(kinds[: len(points)], kinds[len(points) :]).astype(float)


def _regions(solid: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return which piece of a grid its points and its cells belong to."""
    result = solid.connectivity()
    return np.asarray(result.point_data["RegionId"]), np.asarray(result.cell_data["RegionId"])


def _number_of_pieces(solid: Any) -> int:
    return len(np.unique(_regions(solid)[1]))


def _joined(solid: Any) -> Any:
    """Return the pieces of a grid that have a part of both interfaces; None: there are none."""
    # Further interfaces have a part of them, too.
    if solid.n_cells == 0:
        return None
    of_points, of_cells = _regions(solid)
    ends = [of_points[solid.point_data[name] > WHOLE] for name in ("inboard", "outboard")]
    both = np.intersect1d(*ends)
    more = [name for name in solid.point_data if name.startswith(FURTHER)]
    marked = [of_points[solid.point_data[name] > WHOLE] for name in more]
    if not len(both) or not all(np.isin(item, both).any() for item in marked):
        return None
    stays = np.isin(of_cells, both)
    return solid if stays.all() else solid.extract_cells(stays)
