"""The free surface of a solid part as variables: normal moves of the nodes of its mesh, smooth.

Free are the facets of the mesh where material ends within the arm. Their nodes move by s = F x,

    F = (M + r^2 K)^-1 M,

M the areas of the surface that belong to the nodes and K the stiffness of a membrane through them:
moves are smooth over the length r. Nodes move along the outward normals d that they had when the
mesh was made; those on a flat face of the arm stay on it and move as far as the surface there does.
The nodes inside, and those on flat faces across an axis, follow harmonically.
Source: Lazarov & Sigmund (2011), doi:10.1002/nme.3072.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.mesh.solid_cells import Tetrahedra
from dolfinopt.part.domain import SolidDomain
from dolfinopt.part.mesh import NEAR, facing
from dolfinopt.part.solid.part import SolidPart
from dolfinopt.part.solid.surface import (
    FURTHER,
    Surface,
    area_vectors,
    crossings,
    distance_to_faces,
    nearest_facets,
)

REACH = 1.5  # length r over which moves are smooth, cells of the design
FLAT = 1e-6  # of a normal, by which facets of one flat face differ, and faces from an axis
WIDTH_SHARE = 0.2  # of a member's or a gap's width that one side may take in a step
ROOM_SHARE = 0.45  # of what a member or gap is wider than it must be, likewise
EDGE_SHARE = 0.9  # of the distance to where material may not be, or must be
LEAST_MEMBER, LEAST_GAP = 0.75, 0.3  # cells: of members that nobody asks to be wider, of gaps
STEEP = 0.3  # sine between surface and face from which on the rim between them moves
NEAREST, WALLS = 400, 60  # places around each that may be the other side; the arm's own faces
# Worst shape of a cell over that when the mesh was made: a new one is due, or a step goes too far.
WORN, SPOILT = 0.6, 0.2
# What is left of moves, within how many cells of what would wear; tried in turn.
KEPT_BACK = (0.5, 1.0), (0.5, 1.0), (0.0, 1.0), (0.0, 2.0), (0.0, 4.0)


REPEATED = (
    "--optimize: arm {name!r} repeats the design of another solid (arms.pattern); its part would "
    "get a shape of its own; leave --optimize out"
)


@dataclass(frozen=True, eq=False)
class FreeSurface:
    """The surface of one solid part, with its mesh.

    Attributes:
        part: that it was made of.
        mesh: as its nodes have moved.
        nodes: (n,) that move by the variables.
        along: (n, 3) by which place for every m.
        frame: what follows them, and how smoothly they move.
    """

    part: SolidPart
    mesh: Tetrahedra
    nodes: np.ndarray
    along: np.ndarray
    frame: Frame

    STEPS: ClassVar[int] = 10  # that one mesh follows: a new one has other variables

    @property
    def count(self) -> int:
        """Number of nodes that move."""
        return len(self.nodes)

    @property
    def current(self) -> SolidPart:
        """The part with this surface."""
        return self.made

    def scaled(self, part: SolidPart, factors: np.ndarray) -> FreeSurface:
        """Raise InputError: arms that repeat a solid's design each have their own surface."""
        raise InputError(REPEATED.format(name=part.name))

    def meshed(self, _: np.ndarray | None = None) -> tuple[FreeSurface, Tetrahedra]:
        """Return the surface with a new mesh, whose nodes are other variables."""
        mesh = self.made.mesh()
        return free_surface(self.made, mesh), mesh

    def followed(self, _: Tetrahedra) -> Tetrahedra:
        """Return its mesh, which moved with it."""
        return self.mesh

    @cached_property
    def made(self) -> SolidPart:
        """The part with this surface: its own points follow the facets of the mesh."""
        moves = self.frame.carried @ (self.mesh.points - self.frame.places)
        surface = replace(self.part.surface, points=self.part.surface.points + moves)
        if len(crossings(surface)):  # the mesh's own does not, see `is_valid`
            used, triangles = np.unique(self.mesh.boundary, return_inverse=True)
            surface = Surface(self.mesh.points[used], triangles.reshape(-1, 3))
        far = float(np.linalg.norm(moves, axis=1).max())
        far += self.part.distance
        return replace(self.part, surface=surface, distance=far, moved=self.mesh)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """What `restored` makes it of."""
        part, mesh = self.made, self.mesh
        further = {f"{FURTHER}{name}": facets for name, facets in mesh.further.items()}
        return {
            "surface": part.surface.points, "triangles": part.surface.triangles,
            "distance": np.array(part.distance), "points": mesh.points, "cells": mesh.cells,
            "inboard": mesh.inboard, "outboard": mesh.outboard, **further,
        }  # fmt: skip

    def restored(self, arrays: Mapping[str, np.ndarray]) -> FreeSurface:
        """Return the surface of these `arrays`, of one that this has become."""
        further = {
            name.removeprefix(FURTHER): facets
            for name, facets in arrays.items()
            if name.startswith(FURTHER)
        }
        mesh = Tetrahedra(
            *(arrays[name] for name in ("points", "cells", "inboard", "outboard")), further=further
        )
        surface = Surface(arrays["surface"], arrays["triangles"])
        far = float(arrays["distance"])
        return free_surface(replace(self.part, surface=surface, distance=far, moved=mesh), mesh)

    @property
    def size(self) -> float:
        """Volume, m3."""
        return float(self.mesh.volumes.sum())

    def filtered(self, x: np.ndarray) -> np.ndarray:
        """Return s = F x (count,), m."""
        return np.asarray(self.frame.filter.solve(self.frame.areas * x))

    def by_x(self, _: Tetrahedra, by_nodes: np.ndarray) -> np.ndarray:
        """Return derivatives (m, count) by x from those (m, n, 3) by the places of all nodes."""
        by_s = np.array([self._by_s(one) for one in by_nodes])
        return np.asarray(self.frame.filter.solve(by_s.T, "T").T * self.frame.areas)

    def moved(self, s: np.ndarray) -> FreeSurface:
        """Return the surface and its mesh with nodes moved outwards by s (count,), m.

        Less near places where cells would wear or the surface cross itself: one thin wall must not
        keep back all others, nor become one that cannot be meshed again.
        """
        found = self._moved(s)
        for share, cells in KEPT_BACK:
            if not len(bad := found.bad(WORN)):
                break
            tree, near = cKDTree(bad), cells * self.part.domain.cell
            ends = (mesh.points[self.nodes] for mesh in (self.mesh, found.mesh))
            beside = np.any([tree.query(places)[0] < near for places in ends], axis=0)
            s = np.where(beside, share * s, s)
            found = self._moved(s)
        return found

    def _moved(self, s: np.ndarray) -> FreeSurface:
        """Return it with its nodes moved, as `moved`, wherever that leads."""
        step = np.zeros_like(self.mesh.points)
        step[self.nodes] = s[:, None] * self.along
        for a, follower in enumerate(self.frame.followers):
            step[:, a] += follower.followed(step[:, a])
        return replace(self, mesh=replace(self.mesh, points=self.mesh.points + step))

    def _by_s(self, by_nodes: np.ndarray) -> np.ndarray:
        """Return derivatives (count,) by s from those by the places (n, 3) of all nodes."""
        found = np.zeros_like(by_nodes)
        for a, follower in enumerate(self.frame.followers):
            found[:, a] = by_nodes[:, a] + follower.transposed(by_nodes[:, a])
        return np.asarray((found[self.nodes] * self.along).sum(axis=1))

    def size_by_x(self) -> np.ndarray:
        """Return the derivative (count,) of the volume by x, m2."""
        vectors = area_vectors(Surface(self.mesh.points, self.mesh.boundary))
        return self.by_x(self.mesh, vectors[None])[0]

    @property
    def is_valid(self) -> bool:
        """Whether its cells are sound and its surface does not cross itself."""
        return not len(self.bad(SPOILT))

    def bad(self, least: float) -> np.ndarray:
        """Return places (k, 3) of bad cells, and of triangles that others pass through, m.

        Args:
            least: shape of a cell over that of the worst one when the mesh was made.
        """
        points, made = self.mesh.points, replace(self.mesh, points=self.frame.places)
        cells = self.mesh.cells[self.mesh.quality < least * made.quality.min()]
        surface = Surface(points, self.mesh.boundary)
        crossed = surface.corners[crossings(surface).ravel()]
        return np.vstack([points[cells].mean(axis=1), crossed.mean(axis=1)])

    def is_worn(self, mesh: Tetrahedra) -> bool:
        """Whether the worst cell of a mesh is much worse than when it was made."""
        return self._worst(mesh) < WORN

    def _worst(self, mesh: Tetrahedra) -> float:
        made = replace(self.mesh, points=self.frame.places)
        return float(mesh.quality.min() / made.quality.min())

    def room(self) -> tuple[np.ndarray, np.ndarray]:
        """Return how far (count,) nodes may move inwards and outwards in a step, m.

        Members and gaps get no narrower than the scene asks; material stays within the arm.
        """
        domain, points = self.part.domain, self.mesh.points
        vectors = area_vectors(Surface(points, self.mesh.boundary))
        rim = np.flatnonzero(np.linalg.norm(vectors, axis=1) > 0.0)
        inward = -vectors[rim] / np.linalg.norm(vectors[rim], axis=1)[:, None]
        into = -self.along / np.linalg.norm(self.along, axis=1)[:, None]
        every, normal = np.vstack([points[self.nodes], points[rim]]), np.vstack([into, inward])
        near = cKDTree(every).query(every[: self.count], k=min(NEAREST, len(every)))[1]
        least = (
            domain.minimum_member or LEAST_MEMBER * domain.cell,
            domain.minimum_gap or LEAST_GAP * domain.cell,
        )
        inwards, outwards = (
            np.minimum(ROOM_SHARE * np.maximum(wide - narrowest, 0.0), WIDTH_SHARE * wide)
            for wide, narrowest in zip(
                (facing(every, normal, near, side) for side in (1.0, -1.0)), least, strict=True
            )
        )
        outwards = np.minimum(outwards, EDGE_SHARE * self._to_walls())
        if len(domain.kept):
            gap = distance_to_faces(points[self.nodes], domain.kept)
            inwards = np.minimum(inwards, EDGE_SHARE * gap)
        return inwards, outwards

    def _to_walls(self) -> np.ndarray:
        """Return how far (count,) nodes are from the arm's own faces along their ways, m."""
        domain = self.part.domain
        centre, normal = domain.own.mean(axis=1), domain.outward
        places = self.mesh.points[self.nodes]
        near = cKDTree(centre).query(places, k=min(WALLS, len(centre)))[1]
        depth = ((centre[near] - places[:, None]) * normal[near]).sum(axis=2)
        towards = (self.along[:, None] * normal[near]).sum(axis=2)
        away = np.where(towards > 0.05, np.maximum(depth, 0.0) / np.maximum(towards, 0.05), np.inf)
        return np.asarray(away.min(axis=1))


@dataclass(frozen=True, eq=False)
class Follower:
    """One component of the moves: which nodes follow, and how.

    Attributes:
        inner: (n,) True of nodes that follow.
        coupling: Laplacian between them and the others.
        solver: of the Laplacian among them.
    """

    inner: np.ndarray
    coupling: sp.csr_matrix
    solver: Any

    def followed(self, step: np.ndarray) -> np.ndarray:
        """Return the moves (n,) of those that follow, 0 of the others."""
        found = np.zeros_like(step)
        found[self.inner] = -self.solver.solve(self.coupling @ step[~self.inner])
        return found

    def transposed(self, by_nodes: np.ndarray) -> np.ndarray:
        """Return derivatives (n,) by the moves of the others, through those that follow."""
        found = np.zeros_like(by_nodes)
        found[~self.inner] = -self.coupling.T @ self.solver.solve(by_nodes[self.inner], "T")
        return found


@dataclass(frozen=True, eq=False)
class Frame:
    """What is the same for all moves of one mesh.

    Attributes:
        areas: (n,) of the surface that belong to the nodes that move, m2.
        filter: solver of M + r^2 K.
        followers: of x, y and z.
        places: (n, 3) of all nodes when the mesh was made, m.
        carried: from moves of the nodes to those of the points of the part's surface.
    """

    areas: np.ndarray
    filter: Any
    followers: tuple[Follower, Follower, Follower]
    places: np.ndarray
    carried: sp.csr_matrix


def free_surface(part: SolidPart, mesh: Tetrahedra) -> FreeSurface:
    """Return the free surface of a part with a mesh of it."""
    domain = part.domain
    facets, points = mesh.boundary, mesh.points
    near = NEAR * domain.cell
    a, b, c = points[facets].swapaxes(0, 1)
    vectors = 0.5 * np.cross(b - a, c - a)
    normal = vectors / np.linalg.norm(vectors, axis=1)[:, None]
    own = distance_to_faces(np.vstack([a, b, c, (a + b + c) / 3.0]), domain.own) < near
    own = np.asarray(own.reshape(4, -1).all(axis=0))
    free = ~own
    held, across = _held(mesh, facets[own], normal[own])
    if len(domain.kept):
        kept = distance_to_faces(points, domain.kept) < near
        held |= kept
    along = np.zeros_like(points)
    np.add.at(along, facets[free].ravel(), np.repeat(vectors[free], 3, axis=0))
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
    # In the plane of a flat face as far as the surface moves along its normal.
    flat = across.any(axis=1) & ~held
    inplane = np.where(across, 0.0, along)
    square = np.square(inplane).sum(axis=1)
    moves = np.zeros(len(points), dtype=bool)
    moves[facets[free]] = True
    moves &= ~held & (~flat | (square > STEEP**2))
    along = np.where(flat[:, None], inplane / np.maximum(square, 1e-300)[:, None], along)
    nodes = np.flatnonzero(moves)
    surface = np.zeros(len(points), dtype=bool)
    surface[facets] = True
    followers = []
    graph = _graph(mesh)
    for axis in range(3):
        # On a flat face across the axis nodes stay in it, on others they follow along it.
        inner = ~surface | (across.any(axis=1) & ~across[:, axis] & ~held)
        inner[facets[free]] = False
        solver = splu(graph[inner][:, inner].tocsc())
        followers.append(Follower(inner, graph[inner][:, ~inner], solver))
    areas, solver = _filter(points, facets[free], nodes, REACH * domain.cell)
    carried = _carried(part.surface.points, domain, near, points, facets, own)
    frame = Frame(areas, solver, (followers[0], followers[1], followers[2]), points, carried)
    return FreeSurface(part, mesh, nodes, along[nodes], frame)


def _held(
    mesh: Tetrahedra, facets: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which nodes (n,) stay, and across which axes (n, 3) those on flat faces do."""
    # Nodes of one face across an axis may slide in it; those of edges, of other faces and of
    # interfaces stay. `facets` (k, 3) are those on the arm's own faces, with a normal (k, 3) each.
    count = len(mesh.points)
    axis = np.abs(normal).argmax(axis=1)
    straight = np.abs(normal).max(axis=1) > 1.0 - FLAT
    across = np.zeros((count, 3), dtype=bool)
    for k in range(3):
        across[facets[straight & (axis == k)], k] = True
    held = across.sum(axis=1) > 1
    held[facets[~straight]] = True
    for own in (mesh.inboard, mesh.outboard, *mesh.further.values()):
        held[own] = True
    return held, across


def _carried(
    surface: np.ndarray,
    domain: SolidDomain,
    near: float,
    points: np.ndarray,
    facets: np.ndarray,
    own: np.ndarray,
) -> sp.csr_matrix:
    """Return the weights (n, m) of mesh nodes in the moves of a surface's points."""
    # Those of the nearest facet; on the arm's own faces of the nearest one there.
    on_own = distance_to_faces(surface, domain.own) < near
    weights = sp.lil_matrix((len(surface), len(points)))
    for some, among in ((on_own, facets[own]), (~on_own, facets)):
        if some.any():
            which, shares = nearest_facets(surface[some], points, among)
            rows = np.flatnonzero(some)
            for corner in range(3):
                weights[rows, among[which, corner]] = shares[:, corner]
    return weights.tocsr()


def _graph(mesh: Tetrahedra) -> sp.csr_matrix:
    """Return the Laplacian (n, n) by which nodes follow; short edges are stiff."""
    pairs = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
    ends = np.unique(np.sort(mesh.cells[:, pairs].reshape(-1, 2), axis=1), axis=0)
    weight = 1.0 / np.square(mesh.points[ends[:, 0]] - mesh.points[ends[:, 1]]).sum(axis=1)
    graph = sp.coo_matrix((weight, ends.T), (len(mesh.points),) * 2).tocsr()
    graph = graph + graph.T
    return (sp.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph).tocsr()


def _filter(
    points: np.ndarray, facets: np.ndarray, nodes: np.ndarray, reach: float
) -> tuple[np.ndarray, Any]:
    """Return the areas (n,) that belong to the nodes, and a solver of M + r^2 K."""
    place = np.full(len(points), -1)
    place[nodes] = np.arange(len(nodes))
    corners = points[facets]
    opposite = np.stack([corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3] for k in range(3)], 1)
    area = 0.5 * np.linalg.norm(np.cross(opposite[:, 0], opposite[:, 1]), axis=1)
    stiff = np.einsum("nia,nja->nij", opposite, opposite) / (4.0 * area[:, None, None])
    rows = np.repeat(place[facets], 3, axis=1).ravel()
    columns = np.tile(place[facets], (1, 3)).ravel()
    both = (rows >= 0) & (columns >= 0)
    K = sp.coo_matrix((stiff.ravel()[both], (rows[both], columns[both])), (len(nodes),) * 2)
    areas = np.bincount(facets.ravel(), np.repeat(area / 3.0, 3), len(points))[nodes]
    return areas, splu((sp.diags(areas) + reach**2 * K).tocsc())
