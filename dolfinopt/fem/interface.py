"""The interface transformation T of an arm: interior dofs and the outboard coordinates.

Nodal fields are arrays (n_nodes, d, columns) over this rank's nodes, ghosts included; d directions.
There are b = 3 outboard coordinates in the plane, in space 6 of every outboard interface.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from dolfinx import fem
from mpi4py import MPI
from scipy.sparse.csgraph import reverse_cuthill_mckee

from dolfinopt.errors import InputError
from dolfinopt.fem.elements import ElementOperators
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh

SAME_PLACE = 1e-9  # of an arm's length: places no farther apart than this are one


class InterfaceTransformation:
    """u = T [interior dofs; u_x, u_y, theta]: inboard clamped, outboard rigid.

    The inboard interface is clamped in the tangent frame; the outboard interface is rigid with
    displacements and rotations of its reference point as coordinates: u_x, u_y, theta in the plane,
    u_x, u_y, u_z and a rotation vector in space. Of several outboard interfaces each moves by
    itself, its coordinates behind those of the one before. "Interior" are all other dofs.

    Attributes:
        comm: the arm's ranks.
        points: (n_nodes, d) reference positions, m.
        dim: d.
        num_coordinates: b, outboard.
        inboard, outboard: (n_nodes,) True for the nodes of the interface; of any outboard one.
        ends: those of every outboard interface by itself.
        places: (n_ends, d) their reference points, m.
        rigid: (n_nodes, d, b) nodal fields of unit outboard coordinates, zero in the interior.
        interior_nodes: owned ones, in the order of the interior dofs.
        num_interior: interior dofs that this rank owns.
        num_dofs: of all ranks, the outboard coordinates included.
        numbers: (d n_nodes,) global interior number of each dof, -1 for others.
        bandwidth: of the interior stiffness, the widest of all ranks' own parts: about the dofs of
            a cross-section.
    """

    def __init__(self, mesh: ArmMesh, operators: ElementOperators, graph: sp.csr_matrix):
        """Find the interfaces and number the interior dofs (collective).

        Args:
            mesh: the arm.
            operators: its element operators.
            graph: (n_nodes, n_nodes) with an entry where two nodes share a cell.

        Raises:
            InputError: the mesh lacks an interface.
        """
        self.comm = mesh.comm
        self._space = operators.space
        self.points = operators.points
        self.dim = self.points.shape[1]
        self._ghosted = fem.Function(operators.space)
        self.inboard = self._nodes_of(mesh, mesh.inboard_facets, "inboard")
        self.outboard = self._nodes_of(mesh, mesh.outboard_facets, "outboard")
        self.ends = [self.outboard]
        self.places = np.array([mesh.outboard_point, *mesh.further_points])
        self.rigid = self._rigid_field(self.outboard, mesh.outboard_point)
        if mesh.further:
            self._add_further(mesh)
        self.num_coordinates = self.rigid.shape[2]
        self._number_interior(graph)

    def _rigid_field(self, at: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Return the rigid motions (n_nodes, d, 3 or 6) about a point of the nodes `at`."""
        nodes = np.flatnonzero(at)
        motions = rigid_motions(self.points[nodes] - point)
        field = np.zeros((len(self.points), *motions.shape[1:]))
        field[nodes] = motions
        return field

    def _add_further(self, mesh: ArmMesh) -> None:
        """Add the further outboard interfaces.

        Raises:
            InputError: two interfaces share a node: rigid both, they could not move.
        """
        for one in mesh.further:
            self.ends.append(self._nodes_of(mesh, one.facets, one.name))
        names = ["inboard", "outboard", *(one.name for one in mesh.further)]
        masks = [self.inboard, *self.ends]
        for k, mask in enumerate(masks):
            for j in range(k):
                if self.comm.allreduce(int((mask & masks[j]).sum())):
                    raise InputError(
                        f"arm {mesh.name!r}: interfaces {names[j]!r} and {names[k]!r} share nodes; "
                        "each is rigid: leave a cell between them"
                    )
        fields = [self._rigid_field(at, x) for at, x in zip(self.ends, self.places, strict=True)]
        self.rigid = np.concatenate(fields, axis=2)
        self.outboard = np.any(self.ends, axis=0)

    def _nodes_of(self, mesh: ArmMesh, facets: np.ndarray, side: str) -> np.ndarray:
        """Return (n_nodes,) True for the nodes of the interface `side`."""
        mask = np.zeros(len(self.points), dtype=bool)
        facet_dim = mesh.mesh.topology.dim - 1
        mask[fem.locate_dofs_topological(self._space, facet_dim, facets.astype(np.int32))] = True
        # A rank may see a node of the interface without seeing a facet of it.
        mask[:] = self._from_owners(mask[:, None].astype(float))[:, 0] > 0.5
        if self.comm.allreduce(int(mask.sum())) == 0:
            raise InputError(
                f"arm {mesh.name!r}: the mesh has no facets of physical group {side!r}; "
                f"name the interface's {'curves' if mesh.dim == 2 else 'faces'} so in the geometry"
            )
        return mask

    def _number_interior(self, graph: sp.csr_matrix) -> None:
        """Number interior nodes for a narrow band on one rank, in owners' ranges on several."""
        owned = self._space.dofmap.index_map.size_local
        nodes = np.flatnonzero(~(self.inboard | self.outboard)[:owned])
        width = 0
        if len(nodes):
            order, width = _narrow_order(graph[nodes][:, nodes], self.points[nodes])
            nodes = nodes[order]
        self.bandwidth = self.dim * (self.comm.allreduce(width, op=MPI.MAX) + 1) - 1
        self.interior_nodes = nodes
        self.num_interior = self.dim * len(nodes)
        first = self.comm.exscan(len(nodes)) or 0
        number = np.full((len(self.points), 1), -1.0)
        number[nodes, 0] = first + np.arange(len(nodes))
        node_number = self._from_owners(number)[:, 0].astype(np.int64)
        each = self.dim * node_number[:, None] + np.arange(self.dim)
        self.numbers = np.where(node_number[:, None] >= 0, each, -1).ravel()
        self.num_dofs = self.dim * self.comm.allreduce(len(nodes)) + self.num_coordinates

    def _from_owners(self, values: np.ndarray) -> np.ndarray:
        """Overwrite the ghosts' rows of nodal `values` (n_nodes, columns) by their owners'."""
        if self.comm.size == 1:
            return values
        out = np.empty_like(values)
        work = self._ghosted.x.array
        for k in range(values.shape[1]):
            work[0 :: self.dim] = values[:, k]
            compat.scatter_forward(self._ghosted)
            out[:, k] = work[0 :: self.dim]
        return out

    def expand(self, interior: np.ndarray, outboard: np.ndarray) -> np.ndarray:
        """Return the nodal field (n_nodes, d, k) = T [interior; outboard].

        Args:
            interior: (num_interior, k) owned interior dofs, m.
            outboard: (b, k) coordinates of the outboard interface, m and rad.
        """
        columns = interior.shape[1]
        field = np.zeros((len(self.points), self.dim, columns))
        field[self.interior_nodes] = interior.reshape(-1, self.dim, columns)
        if self.comm.size > 1:
            flat = self._from_owners(field.reshape(len(field), self.dim * columns))
            field = flat.reshape(field.shape)
        rigid = np.flatnonzero(self.outboard)
        field[rigid] = self.rigid[rigid] @ outboard
        return field

    def restrict(self, field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return T' field, the transpose of `expand`, summed over the ranks.

        Args:
            field: (n_nodes, d, k) contributions of this rank's cells.

        Returns:
            Owned interior rows (num_interior, k) and the outboard rows (b, k).
        """
        columns = field.shape[2]
        rigid = np.flatnonzero(self.outboard)
        outboard = np.einsum("nic,nik->ck", self.rigid[rigid], field[rigid])
        if self.comm.size > 1:
            outboard = self.comm.allreduce(outboard)
            field = self._to_owners(field)
        return field[self.interior_nodes].reshape(-1, columns), outboard

    def _to_owners(self, field: np.ndarray) -> np.ndarray:
        """Add the ghosts' rows of a nodal field to their owners' rows."""
        out = np.empty_like(field)
        for k in range(field.shape[2]):
            self._ghosted.x.array[:] = field[:, :, k].ravel()
            compat.scatter_reverse_add(self._ghosted)
            out[:, :, k] = self._ghosted.x.array.reshape(-1, self.dim)
        return out


def rigid_motions(points: np.ndarray) -> np.ndarray:
    """Return rigid motions (n, d, b) of points (n, d): translations, then unit rotations.

    In the plane about z; in space about x, y, z: e_k x X. About the origin, m and m/rad.
    """
    dim = points.shape[1]
    motions = np.zeros((len(points), dim, 3 if dim == 2 else 6))
    motions[:, range(dim), range(dim)] = 1.0
    if dim == 2:
        motions[:, 0, 2], motions[:, 1, 2] = -points[:, 1], points[:, 0]
    else:
        for k in range(3):
            after, before = (k + 1) % 3, (k + 2) % 3
            motions[:, before, 3 + k], motions[:, after, 3 + k] = (
                points[:, after],
                -points[:, before],
            )
    return motions


def _narrow_order(graph: sp.csr_matrix, points: np.ndarray) -> tuple[np.ndarray, int]:
    """Return an order of nodes and its bandwidth: along the arm, or Cuthill and McKee's.

    The narrower one; on the grid of a slender arm the first, row by row across it, which is half as
    wide as the other one, which begins at a corner.

    Args:
        graph: (n, n) with an entry where two nodes share a cell.
        points: (n, d) m.
    """
    nearest = SAME_PLACE * np.ptp(points[:, 0])
    along, *across = (_places(each, nearest) for each in points.T)
    orders = (
        np.lexsort((*across, along)),
        reverse_cuthill_mckee(graph, symmetric_mode=True),
    )
    rows, columns = graph.nonzero()

    def bandwidth(order: np.ndarray) -> int:
        number = np.empty(len(order), dtype=np.int64)
        number[order] = np.arange(len(order))
        return int(np.abs(number[rows] - number[columns]).max(initial=0))

    widths = [bandwidth(order) for order in orders]
    best = int(np.argmin(widths))
    return orders[best], widths[best]


def _places(values: np.ndarray, nearest: float) -> np.ndarray:
    """Number values in ascending order, those as one that differ from the next by rounding only."""
    order = np.argsort(values)
    number = np.empty(len(values), dtype=np.int64)
    number[order] = np.cumsum(np.diff(values[order], prepend=values[order[0]]) > nearest)
    return number
