"""What is given of an arm: where material may be and must be, and how dense the design is.

Regions of a plane arm (all of it, what stays solid, what stays void) are known by the exact curves
around them. A mesh knows a bore as a polygon with corners on the circle: runs of its nodes that lie
on one line or circle within rounding become that line or arc again.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as default
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from scipy.interpolate import make_interp_spline
from scipy.spatial import cKDTree

from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh, box_arm
from dolfinopt.mesh.checks import cell_sizes, facet_corners
from dolfinopt.mesh.solid_cells import TENSOR
from dolfinopt.part.plane.curves import (
    DEGREE,
    MM,
    Arc,
    Curve,
    Line,
    Spline,
    angle_of,
    circle_through,
    cross,
    sampled,
    within_half_turn,
)
from dolfinopt.scene.load import Arm, Scene

if TYPE_CHECKING:
    from shapely import Geometry

    from dolfinopt.scene.tables.design import Region as Box
    from dolfinopt.scene.tables.design import RegionKind

SAME = 2e-8  # distance from a line or circle, of the extent: Gmsh's points, files of eight digits
SHARPEST = np.radians(40.0)  # turn from side to side up to which a polygon may stand for a curve
FEWEST = 6  # points of an arc: a circle goes through any three
# Share of the material in grey cells, or of the compliance, from which on parts are another design:
# with 2 % of grey material a part is 4 % stiffer than the densities, as crisp ones.
ANOTHER = 0.05


def nine_digits(size: float) -> float:
    """Return a size that is the same on every processor: meshers choose by the last digits."""
    return float(f"{size:.9g}")


@dataclass(frozen=True, eq=False)
class Edge:
    """A curve of a boundary and what it belongs to: "inboard", "outboard" or ""."""

    curve: Curve
    label: str


def loops(sides: np.ndarray) -> list[np.ndarray]:
    """Chain directed sides (n, 2) between nodes to closed loops; return the numbers of sides."""
    ahead: dict[int, list[int]] = {}
    for number, node in enumerate(map(int, sides[:, 0])):
        ahead.setdefault(node, []).append(number)
    result = []
    while ahead:
        loop, node = [], next(iter(ahead))
        while node in ahead:
            number = ahead[node].pop()
            if not ahead[node]:
                del ahead[node]
            loop.append(number)
            node = int(sides[number, 1])
        result.append(np.array(loop))
    return result


def recognise(points: np.ndarray, labels: np.ndarray, extent: float) -> list[Edge]:
    """Return the curves behind a closed polygon, in its order.

    Args:
        points: (n, 2) its corners, m.
        labels: (n,) of the side from each corner to the next; curves do not go beyond a label.
        extent: size of the whole mesh, m; `SAME` is relative to it.
    """
    near = SAME * extent
    n = len(points)
    if (labels == labels[0]).all() and (circle := _circle(points, near, closed=True)) is not None:
        return [Edge(circle, str(labels[0]))]
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    turn = np.arctan2(cross(before, after), (before * after).sum(axis=1))
    stops = (np.abs(turn) > SHARPEST) | (labels != np.roll(labels, 1))
    first = int(np.argmax(stops))
    if not stops.any():  # somewhere within a curve: begin where that ends
        around = points[np.arange(n + 1) % n]
        while first < n - 1:
            sides, _ = _longest(around[first:], near)
            first += sides
            if sides > 1:
                break
        first %= n
    order = (first + np.arange(n + 1)) % n
    points, labels = points[order], labels[order]
    halts = np.union1d(np.flatnonzero(stops[order[:-1]]), [0, n])
    return [
        Edge(curve, str(labels[a]))
        for a, b in pairwise(halts)
        for curve in _curves(points[a : b + 1], near)
    ]


def _curves(points: np.ndarray, near: float) -> Iterator[Curve]:
    """Yield lines and arcs along points, and splines through those that turn gently."""
    single, i = [points[0]], 0
    while i < len(points) - 1:
        sides, curve = _longest(points[i:], near)
        i += sides
        if sides == 1:
            single.append(points[i])
        else:
            yield from _through(single)
            yield curve
            single = [points[i]]
    yield from _through(single)


def _longest(points: np.ndarray, near: float) -> tuple[int, Curve]:
    """Return how many sides from the first point on make one line or arc, and that curve."""

    def reach(fits: Callable[[np.ndarray, float], object], least: int) -> int:
        """Return the largest number of points that a line or circle goes through."""
        counts = range(least + 1, len(points) + 1)
        return least + bisect(counts, False, key=lambda n: not fits(points[:n], near))

    straight = reach(_straight, 2)
    if straight == 2 and _circle(points[:FEWEST], near) is not None:
        count = reach(_circle, FEWEST)
        arc = _circle(points[:count], near)
        assert arc is not None
        return count - 1, arc
    return straight - 1, Line(points[0], points[straight - 1])


def _straight(points: np.ndarray, near: float) -> bool:
    along = points[-1] - points[0]
    size = np.linalg.norm(along)
    if size == 0.0:
        return False
    return bool(np.abs(cross(points - points[0], along)).max() <= near * size)


def _circle(points: np.ndarray, near: float, closed: bool = False) -> Arc | None:
    """Return the circle through points that follow one another on it, None where there is none."""
    if len(points) < FEWEST:
        return None
    centre, radius, off = circle_through(points)
    if off > near or radius == 0.0:
        return None
    angle = angle_of(points - centre)
    steps = within_half_turn(np.diff(np.append(angle, angle[0]) if closed else angle))
    if not ((steps > 0.0).all() or (steps < 0.0).all()) or np.abs(steps).max() > SHARPEST:
        return None
    sweep = float(steps.sum())
    if closed:
        sweep = float(2.0 * np.pi * np.sign(sweep))
    return Arc(centre, radius, float(angle[0]), sweep)


def _through(points: Sequence[np.ndarray]) -> Iterator[Curve]:
    """Yield a spline through points, parametrised by the chords; lines between three and fewer."""
    if len(points) < 4:
        yield from (Line(a, b) for a, b in pairwise(points))
        return
    t = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    # Not-a-knot ends; its second derivative is free there.
    spline = make_interp_spline(t / t[-1], points, k=DEGREE)
    yield Spline(spline.t, spline.c)


def snapped(edge: Edge, axes: np.ndarray, extent: float) -> Edge:
    """Return the edge with a circle about one of the axes (n, 2) exactly about it."""
    curve = edge.curve
    if isinstance(curve, Arc):
        for axis in axes:
            if np.linalg.norm(curve.centre - axis) < SAME * extent:
                curve = Arc(axis, curve.radius, curve.begin, curve.sweep)
    return Edge(curve, edge.label)


INBOARD, OUTBOARD = "inboard", "outboard"


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the plane by the closed loops of curves around it.

    Attributes:
        loops: one within another one is a hole.
        others: regions that belong to it, too, wherever they are.
    """

    loops: Sequence[Sequence[Edge]]
    others: Sequence[Region] = ()

    @property
    def edges(self) -> list[Edge]:
        """All curves."""
        own = [edge for loop in self.loops for edge in loop]
        return [*own, *(edge for other in self.others for edge in other.edges)]

    def area_inside(self, tolerance: float) -> Geometry:
        """Return the region as polygons whose sides stay within a distance of the curves, m."""
        import shapely

        rings = [sampled([edge.curve for edge in loop], tolerance) for loop in self.loops]
        # A loop within another one is a hole.
        own = shapely.build_area(shapely.MultiLineString([shapely.LinearRing(r) for r in rings]))
        return shapely.union_all([own, *(other.area_inside(tolerance) for other in self.others)])


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of a mesh as polygons.

    Attributes:
        nodes: (n_cells, 3 or 4) counterclockwise around each cell.
        points: (n_nodes, 2) m.
        facets: (n_cells, 3 or 4) the facet from each node to the next.
    """

    nodes: np.ndarray
    points: np.ndarray
    facets: np.ndarray

    @property
    def corners(self) -> np.ndarray:
        """Corners (n_cells, 3 or 4, 2) around each cell, m."""
        return self.points[self.nodes]

    def rim(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the sides that one of the chosen cells (n_cells,) alone has.

        Their nodes (n, 2), facets (n,), and which cells (n,) they are of.
        """
        facets = np.where(chosen[:, None], self.facets, self.facets.max() + 1)
        cell, place = np.nonzero(np.bincount(facets.ravel())[facets] == 1)
        after = np.roll(self.nodes, -1, axis=1)
        ends = np.stack([nodes[cell, place] for nodes in (self.nodes, after)], axis=1)
        return ends, facets[cell, place], cell


def region_of(mesh: ArmMesh, cells: Cells, chosen: np.ndarray) -> Region:
    """Return the region of the chosen cells (n_cells,), circles about joint axes exactly so."""
    extent = float(np.ptp(cells.points, axis=0).max())
    axes = np.array([[0.0, 0.0], mesh.outboard_point])
    ends, facets, _ = cells.rim(chosen)
    label = np.full(len(facets), "", dtype="<U8")
    label[np.isin(facets, mesh.inboard_facets)] = INBOARD
    label[np.isin(facets, mesh.outboard_facets)] = OUTBOARD
    return Region(
        [
            [
                snapped(edge, axes, extent)
                for edge in recognise(cells.points[ends[loop, 0]], label[loop], extent)
            ]
            for loop in loops(ends)
        ]
    )


def cells_of(mesh: ArmMesh) -> Cells:
    """Return the cells of a mesh that is whole on this rank."""
    nodes = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    points = mesh.mesh.geometry.x[:, :2]
    if nodes.shape[1] == 3:  # facets lie opposite to corners
        around, after = [0, 1, 2], [2, 0, 1]
    else:  # a tensor product; facets 01, 02, 13, 23
        around, after = [0, 1, 3, 2], [0, 2, 3, 1]
    nodes, facets = nodes[:, around], facets[:, after]
    corner = points[nodes]
    turned = cross(corner, np.roll(corner, -1, axis=1)).sum(axis=1) < 0.0
    back = np.arange(nodes.shape[1])[::-1]
    nodes = np.where(turned[:, None], nodes[:, back], nodes)
    facets = np.where(turned[:, None], facets[:, np.roll(back, -1)], facets)
    return Cells(nodes, points, facets)


def _kept(
    mesh: ArmMesh, cells: Cells, chosen: np.ndarray, arm: Arm, kind: RegionKind, outline: Region
) -> Region:
    """Return what stays solid or void: shapes that the scene states, and chosen cells (n,)."""
    stated, shapes = _stated(arm, kind, outline, mesh.centroid)
    return replace(region_of(mesh, cells, chosen & ~stated), others=shapes)


def _stated(
    arm: Arm, kind: RegionKind, outline: Region, centroid: np.ndarray
) -> tuple[np.ndarray, list[Region]]:
    """Return which cells (n,) the scene's lengths and regions keep, and their exact shapes."""
    result, shapes = np.zeros(len(centroid), dtype=bool), []
    for region in arm.regions:
        if region.kind == kind and region.depth is None:
            for mirror in (1.0, -1.0) if arm.symmetric_about[0] else (1.0,):
                result |= region.covers(centroid[:, 0], mirror * centroid[:, 1])
                shapes.append(Region([_shape(region, mirror)]))
    if kind == "solid" and arm.cells is None and arm.solid_ends > 0.0:
        for edge in outline.edges:
            ring = edge.curve
            if edge.label and isinstance(ring, Arc) and ring.is_circle:
                radius = ring.radius + arm.solid_ends
                result |= np.linalg.norm(centroid - ring.centre, axis=1) < radius
                circle = Arc(ring.centre, radius, 0.0, 2.0 * np.pi)
                shapes.append(Region([[Edge(circle, "")]]))
    return result, shapes


def _shape(region: Box, mirror: float) -> list[Edge]:
    """Return the curves around a region of the scene or its mirror image."""
    if region.circle is not None:
        x, y, radius = region.circle
        return [Edge(Arc(np.array([x, mirror * y]), radius, 0.0, 2.0 * np.pi), "")]
    x0, y0, x1, y1 = region.bounds
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) * [1.0, mirror]
    return [Edge(Line(corners[k - 1], corners[k]), "") for k in range(4)]


def _without_kept(mesh: ArmMesh, kept: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return a field with that of the nearest other cell where cells are kept."""
    # Shapes that are exact take their place; the steps of their cells must not show beside them.
    if not kept.any() or kept.all():
        return field
    nearest = cKDTree(mesh.centroid[~kept]).query(mesh.centroid[kept])[1]
    result = field.copy()
    result[kept] = field[~kept][nearest]
    return result


class Filled:
    """How much of an arm a design fills.

    Attributes:
        name: of the arm.
        x_phys: (n_cells,) physical densities.
    """

    name: str
    x_phys: np.ndarray

    @property
    def sizes(self) -> np.ndarray:
        """(n_cells,) of the cells: areas, m2, in space volumes, m3."""
        raise NotImplementedError

    @property
    def volume(self) -> float:
        """The material's, in the plane over the thickness; m3, m2."""
        return float(self.x_phys @ self.sizes)

    @property
    def full_volume(self) -> float:
        """All that material may fill; m3, m2."""
        return float(self.sizes.sum())

    @property
    def total(self) -> float:
        """Size of the arm with the cells that stay void; m3, m2."""
        return self.full_volume

    @property
    def grayness(self) -> float:
        """Mean of 4 x (1 - x) over the arm, cells that stay void included."""
        gray = 4.0 * self.x_phys * (1.0 - self.x_phys) @ self.sizes
        return float(gray / self.total)

    @property
    def gray_share(self) -> float:
        """Share of the material in cells of densities between 0.1 and 0.9."""
        gray = (self.x_phys > 0.1) & (self.x_phys < 0.9)
        return float((self.x_phys * self.sizes)[gray].sum() / self.volume)

    def left_out_words(self, count: int, size: float, dim: int) -> list[str]:
        """Return what is said of pieces of a size, m2 or m3, that were left out."""
        if not count:
            return []
        return [
            f"arm {self.name!r}: {count} piece{'s' * (count > 1)} without a joint to both "
            f"interfaces ({MM**dim * size:.3g} mm{dim}, {100.0 * size / self.volume:.2g} % of the "
            "volume) left out"
        ]

    @property
    def gray_words(self) -> list[str]:
        """What is said of a grey design."""
        if self.gray_share <= ANOTHER:
            return []
        return [
            f"arm {self.name!r}: grayness {self.grayness:.2g}: {100.0 * self.gray_share:.0f} % of "
            "the material is in cells that are neither solid nor void; the part is another design "
            'than the optimised one; with design.projection = "robust" more iterations make it '
            "crisp"
        ]


@dataclass(frozen=True, eq=False)
class Domain(Filled):
    """One arm before its outline is drawn.

    Attributes:
        name: of the arm.
        corners: (n_cells, 3 or 4, 2) around each cell, m.
        centroid: (n_cells, 2) m.
        area: (n_cells,) m2.
        x_phys: (n_cells,) physical densities.
        field: (n_cells,) what is smooth from cell to cell and falls where x_phys does: the
            filtered densities before they are projected, or x_phys itself; in cells that stay solid
            or void that of the nearest other one.
        crisp: whether `field` is a projected design, which leaps from cell to cell.
        links: (n, 2, 2) m, lines between the centroids of solid cells of a projected design that
            share a corner at least, where one of them is in a member no wider than a cell.
        rim, rim_cells: (n, 2, 2) m, the sides of cells on the arm's outline, counterclockwise
            around the cell; (n,) which cell.
        outline: the arm's own, bores included.
        solid, void: where material stays, and where there is none.
        length, thickness: m.
        symmetric: about y = 0.
        minimum_member: smallest width of members that the scene asks for, m; 0: none.
    """

    name: str
    corners: np.ndarray
    centroid: np.ndarray
    area: np.ndarray
    x_phys: np.ndarray
    field: np.ndarray
    crisp: bool
    links: np.ndarray
    rim: np.ndarray
    rim_cells: np.ndarray
    outline: Region
    solid: Region
    void: Region
    length: float
    thickness: float
    symmetric: bool
    minimum_member: float

    @property
    def cell(self) -> float:
        """Size of a cell: the root of the median area, m."""
        factor = 1.0 if self.corners.shape[1] == 4 else 1.5
        return nine_digits(factor * np.sqrt(np.median(self.area)))

    @property
    def edges(self) -> list[Edge]:
        """The curves of the arm's own outline, and around what stays void or solid."""
        return [*self.outline.edges, *self.void.edges, *self.solid.edges]

    @property
    def outer_edges(self) -> int:
        """Number of the first of them that no material lies beyond."""
        return len(self.outline.edges) + len(self.void.edges)

    @property
    def extent(self) -> float:
        """The larger side of the box around the arm, m."""
        return float(np.ptp(self.corners.reshape(-1, 2), axis=0).max())

    @property
    def height(self) -> float:
        """The arm's size across, m."""
        return float(np.ptp(self.corners[..., 1]))

    @property
    def sizes(self) -> np.ndarray:
        """See `Filled`."""
        return self.area


def domain_of(
    scene: Scene, index: int, mesh: ArmMesh, x_phys: np.ndarray, field: np.ndarray | None = None
) -> Domain:
    """Return an arm with a design.

    Args:
        scene: of the arm.
        index: its place in the chain.
        mesh: whole on this rank.
        x_phys: (n_cells,) physical densities.
        field: (n_cells,) filtered densities; None: not known.
    """
    entry, like = scene.arms[index], scene.arms[scene.patterns.get(index, index)]
    cells = cells_of(mesh)
    every = np.ones(mesh.num_cells, dtype=bool)
    rim, _, rim_cells = cells.rim(every)
    outline = region_of(mesh, cells, every)
    solid, void = region_of(mesh, cells, mesh.passive), region_of(mesh, cells, mesh.void)
    if index not in scene.patterns:  # there regions are scaled, and those of another arm
        solid = _kept(mesh, cells, mesh.passive, entry, "solid", outline)
        void = _kept(mesh, cells, mesh.void, entry, "void", outline)
    return Domain(
        name=entry.name,
        corners=cells.corners,
        centroid=mesh.centroid,
        area=mesh.area,
        x_phys=x_phys,
        field=_without_kept(mesh, mesh.fixed, x_phys if field is None else field),
        crisp=field is None and bool(scene.design.projection),
        links=_links(cells.nodes, mesh.centroid, x_phys, bool(scene.design.projection)),
        rim=cells.points[rim],
        rim_cells=rim_cells,
        outline=outline,
        solid=solid,
        void=void,
        length=entry.length,
        thickness=entry.thickness,
        symmetric=like.symmetric_about[0],
        minimum_member=scene.part.minimum_member or scene.design.minimum_member,
    )


def _links(
    nodes: np.ndarray, centroid: np.ndarray, x_phys: np.ndarray, projected: bool
) -> np.ndarray:
    """Return the lines along which a projected design hangs together, see `Domain`."""
    import scipy.sparse as sp

    if not projected:
        return np.empty((0, 2, 2))
    cells = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    touch = sp.csr_matrix((np.ones(nodes.size), (cells, nodes.ravel())))
    shared = sp.triu(touch @ touch.T, 1).tocoo()
    # Triangles that share a corner alone are linked by those between them.
    near = shared.data >= (1 if nodes.shape[1] == 4 else 2)
    a, b = shared.row[near], shared.col[near]
    solid = x_phys > 0.5
    # Wider than a cell is a member with a node that no void cell touches.
    inner = np.ones(int(nodes.max()) + 1, dtype=bool)
    inner[nodes[~solid]] = False
    thin = ~inner[nodes].any(axis=1)
    linked = solid[a] & solid[b] & (thin[a] | thin[b])
    return np.stack([centroid[a[linked]], centroid[b[linked]]], axis=1)


# -- of a solid arm ----------------------------------------------------------------------------


ROUNDING = 1e-6  # of densities over the thickness of a design that is extruded; of a cell


@dataclass(frozen=True, eq=False)
class SolidDomain(Filled):
    """A solid arm with a design, without its cells that stay void.

    Attributes:
        name: of the arm.
        corners: (n_cells, 4 or 8, 3) of the cells, m.
        x_phys: (n_cells,) physical densities.
        field: (n_cells,) what is smooth from cell to cell and falls where x_phys does: the
            filtered densities before they are projected, or x_phys itself.
        passive: (n_cells,) True where material stays.
        crisp: whether `field` is a projected design, which leaps from cell to cell.
        own: (n, 3 or 4, 3) corners of the arm's own faces, around them, m.
        inboard, outboard: those of the interfaces, likewise; outboard is all that are not inboard.
        kept: those around what stays solid, likewise.
        further: of the outboard interfaces besides the first, by their names, likewise; they are
            among outboard, too.
        void: volume of the cells that stay void, m3.
        filter_radius: of the design, m; 0: none.
        minimum_member, minimum_gap: smallest widths that the scene asks for, m; 0: none.
        flat: the same design in the plane, where it is the same over the thickness.
    """

    name: str
    corners: np.ndarray
    x_phys: np.ndarray
    field: np.ndarray
    passive: np.ndarray
    own: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray
    kept: np.ndarray
    crisp: bool
    further: Mapping[str, np.ndarray] = default(default_factory=dict)
    void: float = 0.0
    filter_radius: float = 0.0
    minimum_member: float = 0.0
    minimum_gap: float = 0.0
    flat: Domain | None = None

    @cached_property
    def sizes(self) -> np.ndarray:
        """(n_cells,) of the cells, m3."""
        return cell_sizes(self.corners)

    @property
    def total(self) -> float:
        """See `Filled`."""
        return self.full_volume + self.void

    @property
    def cell(self) -> float:
        """Size of a cell: the least of its median edges, m."""
        ends = (1, 2, 3) if self.corners.shape[1] == 4 else (1, 2, 4)
        edges = self.corners[:, ends] - self.corners[:, :1]
        return float(np.median(np.linalg.norm(edges, axis=2), axis=0).min())

    @property
    def is_box(self) -> bool:
        """Whether its cells are boxes along the axes, all turned alike."""
        if self.corners.shape[1] != 8:
            return False
        edges = np.abs(self.corners[:, [1, 2, 4]] - self.corners[:, :1])
        return bool((edges * (1.0 - np.eye(3))).max() <= ROUNDING * self.cell)

    @cached_property
    def outward(self) -> np.ndarray:
        """(n, 3) unit normals of the arm's own faces."""
        faces, centroids = self.own, self.corners.mean(axis=1)
        centre = faces.mean(axis=1)
        inner = centroids[cKDTree(centroids).query(centre)[1]]
        normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
        normal *= np.where(((centre - inner) * normal).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        return np.asarray(normal / np.linalg.norm(normal, axis=1)[:, None])


def domain_in_scene(
    scene: Scene, index: int, mesh: ArmMesh, x_phys: np.ndarray, field: np.ndarray | None = None
) -> SolidDomain:
    """Return a solid arm of a scene with a design, see `solid_domain`."""
    design = scene.design
    return replace(
        solid_domain(mesh, x_phys, field),
        crisp=field is None and bool(design.projection),
        filter_radius=design.radius,
        minimum_member=scene.part.minimum_member or scene.design.minimum_member,
        minimum_gap=design.minimum_gap,
        flat=_flat_domain(scene, index, mesh, x_phys, field),
    )


def solid_domain(mesh: ArmMesh, x_phys: np.ndarray, field: np.ndarray | None = None) -> SolidDomain:
    """Return a solid arm with a design.

    Args:
        mesh: of the arm, whole on this rank.
        x_phys: (n_cells,) physical densities.
        field: (n_cells,) filtered densities; None: not known.
    """
    corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    around = np.array(facet_corners(3, corners.shape[1]))
    if around.shape[1] == 4:
        around = around[:, TENSOR[4, 2]]
    stays = ~mesh.void
    corners, facets = corners[stays], facets[stays]
    passive, count = mesh.passive[stays], int(facets.max()) + 1
    once = np.bincount(facets.ravel(), minlength=count)[facets] == 1
    around_kept = np.bincount(facets[passive].ravel(), minlength=count)[facets] == 1
    outboard_facets = np.setdiff1d(mesh.interface_facets, mesh.inboard_facets)
    marks = [once, *(np.isin(facets, f) for f in (mesh.inboard_facets, outboard_facets))]
    marks.append(around_kept & passive[:, None])
    faces = corners[:, around]
    own, inboard, outboard, kept = (faces[mark] for mark in marks)
    return SolidDomain(
        mesh.name,
        corners,
        x_phys[stays],
        (x_phys if field is None else field)[stays],
        passive,
        own,
        inboard,
        outboard,
        kept,
        crisp=field is None,
        further={item.name: faces[np.isin(facets, item.facets)] for item in mesh.further},
        void=float(mesh.area[mesh.void].sum()),
    )


def _flat_domain(
    scene: Scene, index: int, mesh: ArmMesh, x_phys: np.ndarray, field: np.ndarray | None
) -> Domain | None:
    """Return the arm's design in the plane; None where it is not the same over the thickness."""
    arm = scene.arms[index]
    if arm.cells is None or len(arm.cells) != 3:
        return None
    plate = box_arm(MPI.COMM_SELF, arm.name, (arm.length, arm.height), arm.cells[:2])
    column = cKDTree(plate.centroid).query(mesh.centroid[:, :2])[1]
    rows = x_phys, x_phys if field is None else field, mesh.passive, mesh.void
    values = np.stack(rows, axis=1)[np.argsort(column, kind="stable")].reshape(
        plate.num_cells, -1, len(rows)
    )
    if np.ptp(values, axis=1).max() > ROUNDING:
        return None
    x, smooth, passive, void = values.mean(axis=1).T
    plate = replace(plate, passive=passive > 0.5, void=void > 0.5)
    return domain_of(scene, index, plate, x, None if field is None else smooth)
