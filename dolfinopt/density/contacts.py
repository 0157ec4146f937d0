"""What holds a crisp design together: pieces whose cells share faces, and contacts without a face.

Finite elements pass forces on in every node that cells share. Members that meet in corners alone
(in space in edges or corners) are stiff in the model; nobody can make such a joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from dolfinopt.mesh.checks import edge_corners

WORST = 3  # contacts whose places are told
ROUNDS = 20  # of opening contacts: a cell that is taken away may leave another contact
MANY = 1000  # contacts, of a chequerboard say, beyond which none is opened


@dataclass(frozen=True, eq=False)
class Contacts:
    """How the solid cells of an arm hang together.

    Attributes:
        pieces: number of pieces whose cells share faces (sides in the plane).
        corners, edges: number of corners, and of edges in space, in which alone cells meet.
        places: (k, d) of the worst of them, m: first those that join the largest pieces.
        kept: (n_cells,) the solid cells without what hangs on the interfaces by contacts alone, and
            without single cells at contacts which the rest does not need to hang together.
        left_out: share of the solid volume that is not kept.
        remaining: number of contacts of what is kept.
        joins: whether what is kept leads from the first interface to all others.
    """

    pieces: int
    corners: int
    edges: int
    places: np.ndarray
    kept: np.ndarray
    left_out: float
    remaining: int
    joins: bool

    @property
    def count(self) -> int:
        """Corners and edges together."""
        return self.corners + self.edges


def contacts_of(
    corners: np.ndarray, solid: np.ndarray, held: np.ndarray, volume: np.ndarray
) -> Contacts:
    """Return pieces and contacts of the solid cells of an arm, the same in any order of the cells.

    At a corner (an edge) the cells that have it fall into groups that share faces with it. With
    more than one group it is a contact, unless it lies on an interface, which is rigid.

    Args:
        corners: (n_cells, k, d) m; those that cells have in common are the same to the last bit.
        solid: (n_cells,) True where the cell is solid.
        held: (n_cells, k) 0, or the number of the interface on which the corner lies, from 1.
        volume: (n_cells,) m3, or m2 in the plane.
    """
    at = np.flatnonzero(solid)
    if not at.size:
        none = np.zeros((0, corners.shape[2]))
        return Contacts(0, 0, 0, none, np.zeros_like(solid), 0.0, 0, False)
    points, nodes = np.unique(
        corners[at].reshape(-1, corners.shape[2]), axis=0, return_inverse=True
    )
    nodes = nodes.reshape(at.size, -1)
    at, nodes = (item[np.lexsort(np.sort(nodes, axis=1).T)] for item in (at, nodes))
    mesh = _Solid(points, nodes, held[at], volume[at])
    corner, edge = mesh.contacts(mesh.every)
    kept, joins = mesh.opened()
    result = np.zeros_like(solid)
    result[at[kept]] = True
    return Contacts(
        pieces=len(np.unique(mesh.pieces(mesh.every))),
        corners=len(corner),
        edges=len(edge),
        places=mesh.worst([*edge, *corner]),
        kept=result,
        left_out=1.0 - float(mesh.volume[kept].sum() / mesh.volume.sum()),
        remaining=sum(map(len, mesh.contacts(kept))),
        joins=joins,
    )


class _Solid:
    """The solid cells, sorted by their nodes, and which of them share faces."""

    def __init__(self, points: np.ndarray, nodes: np.ndarray, held: np.ndarray, volume: np.ndarray):
        """Take points (p, d), nodes and interfaces (n, k), volumes (n,)."""
        self.points, self.nodes, self.volume = points, nodes, volume
        (n, k), d = nodes.shape, points.shape[1]
        self.every = np.ones(n, dtype=bool)
        incidence = sp.csr_matrix(
            (np.ones(n * k), nodes.ravel(), np.arange(0, n * k + 1, k)), (n, len(points))
        )
        shared = sp.triu(incidence @ incidence.T, k=1).tocoo()
        # On any mesh no two cells share as many nodes as directions but by a face.
        pairs = np.stack([shared.row, shared.col], axis=1)
        self.faces, self.by_edge = pairs[shared.data >= d], pairs[shared.data >= 2]
        self.near = (incidence @ incidence.T).tocsr()
        ones = np.ones(2 * len(self.faces), dtype=bool)
        both = np.concatenate([self.faces, self.faces[:, ::-1]]).T
        self.by_face = sp.csr_matrix((ones, tuple(both)), (n, n))
        self.ends = np.array(
            [(held == i).sum(axis=1) >= d for i in range(1, int(held.max(initial=0)) + 1)]
        ).reshape(-1, n)
        self.rigid = np.zeros(len(points), dtype=bool)
        self.rigid[nodes[held > 0]] = True
        self.edges = np.zeros((n, 0), dtype=int)
        if d == 3:
            first, second = nodes[:, edge_corners(d, k)].transpose(2, 0, 1)
            self.edges = np.minimum(first, second) * len(points) + np.maximum(first, second)

    def pieces(self, kept: np.ndarray) -> np.ndarray:
        """Return the number of every cell's piece by faces (n,); each cell not kept is its own."""
        return _components(len(kept), self.faces[kept[self.faces].all(axis=1)])

    def contacts(self, kept: np.ndarray) -> tuple[list[list[np.ndarray]], list[list[np.ndarray]]]:
        """Return the groups of cells at every corner, and at every edge, that is a contact."""
        faces = self.faces[kept[self.faces].all(axis=1)]
        edge = _split(self.edges, kept, faces) if self.edges.size else {}
        ends = {key: np.array(divmod(key, len(self.points))) for key in edge}
        if self.edges.size:  # corners are contacts where cells do not share an edge, either
            faces = self.by_edge[kept[self.by_edge].all(axis=1)]
        corner = _split(self.nodes, kept, faces)
        return (
            [groups for key, groups in corner.items() if not self.rigid[key]],
            [groups for key, groups in edge.items() if not self.rigid[ends[key]].all()],
        )

    def opened(self) -> tuple[np.ndarray, bool]:
        """Return the cells (n,) that are kept, and whether they join all interfaces."""
        kept, joins = self._joined(self.every)
        for _ in range(ROUNDS):
            before, result = kept.copy(), [item for kind in self.contacts(kept) for item in kind]
            for groups in result if len(result) <= MANY else ():
                groups = [group[kept[group]] for group in groups]
                # The largest group stays; of groups of one size the one that the rest needs.
                order = sorted(groups, key=lambda group: (len(group), -self._free(group, kept)))
                for group in order[:-1]:
                    if self._free(group, kept):
                        kept[group] = False
            kept, joins = self._joined(kept)
            if np.array_equal(kept, before):
                break
        return kept, joins

    def _free(self, group: np.ndarray, kept: np.ndarray) -> bool:
        """Return whether what is beside a group, interfaces too, hangs together without it."""
        around = np.setdiff1d(self.near[group].indices, group)
        around = around[kept[around]]
        piece = connected_components(self.by_face[around][:, around], directed=False)[1]
        adjacent = np.isin(around, self.by_face[group].indices)
        lone = 0
        for end in self.ends:  # an interface joins what is on it
            on, held = end[around], bool(end[group].any())
            piece[np.isin(piece, piece[on])] = piece[on].min(initial=len(around))
            adjacent |= on & held
            lone += held and not on.any()
        return len(np.unique(piece[adjacent])) + lone <= 1

    def _joined(self, kept: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return those of the cells that hang on the first interface, and whether all others do."""
        n, ends = len(kept), len(self.ends)
        links = [self.faces[kept[self.faces].all(axis=1)]]
        for i, end in enumerate(self.ends):
            cells = np.flatnonzero(end & kept)
            links.append(np.stack([cells, np.full(len(cells), n + i)], axis=1))
        number = _components(n + ends, np.concatenate(links))
        first = number[n] if ends else -1
        return kept & (number[:n] == first), bool(ends and (number[n:] == first).all())

    def worst(self, contacts: Sequence[list[np.ndarray]]) -> np.ndarray:
        """Return the places (k, d) of those contacts that join the largest pieces, m."""
        number = self.pieces(self.every)
        volume = np.bincount(number, self.volume)
        rank = []
        for groups in contacts:
            joined = np.unique(number[np.concatenate(groups)])
            second = np.sort(volume[joined])[-2] if len(joined) > 1 else 0.0
            common = self.nodes[groups[0][0]]
            for group in groups:
                for cell in group:
                    common = np.intersect1d(common, self.nodes[cell])
            rank.append((-second, tuple(self.points[common].mean(axis=0))))
        places = [place for _, place in sorted(rank)[:WORST]]
        return np.reshape(places, (-1, self.points.shape[1]))


def _components(count: int, pairs: np.ndarray) -> np.ndarray:
    """Return the component (count,) of every node of a graph."""
    ones = np.ones(len(pairs), dtype=bool)
    graph = sp.coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _split(keys: np.ndarray, kept: np.ndarray, pairs: np.ndarray) -> dict[int, list[np.ndarray]]:
    """Return the cells at every key, in groups that pairs join, where there is more than one."""
    # keys (n, k) are corners or edges of the cells; those of `kept` (n,) count, and pairs (p, 2) of
    # them are joined at all keys that they have in common.
    n, k = keys.shape
    first, second = pairs.T
    which, i, j = np.nonzero(keys[first][:, :, None] == keys[second][:, None, :])
    number = _components(n * k, np.stack([first[which] * k + i, second[which] * k + j], axis=1))
    cells = np.repeat(np.flatnonzero(kept), k)
    values, groups = keys[kept].ravel(), number.reshape(n, k)[kept].ravel()
    order = np.lexsort((groups, values))
    cells, values, groups = cells[order], values[order], groups[order]
    starts = np.flatnonzero(np.diff(values, prepend=-1))
    bounds = np.append(starts, len(values))
    result: dict[int, list[np.ndarray]] = {}
    jumps = (np.diff(groups) != 0) & (np.diff(values) == 0)
    for key in np.unique(values[1:][jumps]):
        at = np.searchsorted(values[starts], key)
        part = slice(bounds[at], bounds[at + 1])
        cuts = np.flatnonzero(np.diff(groups[part])) + 1
        result[int(key)] = np.split(cells[part], cuts)
    return result
