"""The interface transformation T of an arm: interior dofs and three outboard coordinates.

Nodal fields are arrays (n_nodes, 2, columns) over this rank's nodes, ghosts included.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from dolfinx import fem
from scipy.sparse.csgraph import reverse_cuthill_mckee

from dolfinopt.errors import InputError
from dolfinopt.fem.elements import ElementOperators
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh

SAME_PLACE = 1e9  # places along an arm that are told apart


class InterfaceTransformation:
    """u = T [interior dofs; u_x, u_y, theta]: inboard clamped, outboard rigid.

    The inboard interface is clamped in the tangent frame; the outboard interface is rigid with
    three coordinates about its reference point. "Interior" are all other dofs.

    Attributes:
        comm: the arm's ranks.
        points: (n_nodes, 2) reference positions, m.
        inboard, outboard: (n_nodes,) True for the nodes of the interface.
        rigid: (n_nodes, 2, 3) nodal fields of unit u_x, u_y, theta, zero in the interior.
        interior_nodes: owned ones, in the order of the interior dofs.
        num_interior: interior dofs that this rank owns.
        num_dofs: of all ranks, the outboard coordinates included.
        numbers: (2 n_nodes,) global interior number of each dof, -1 for others.
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
        self._ghosted = fem.Function(operators.space)
        self.inboard = self._nodes_of(mesh, mesh.inboard_facets, "inboard")
        self.outboard = self._nodes_of(mesh, mesh.outboard_facets, "outboard")
        self.rigid = np.zeros((len(self.points), 2, 3))
        nodes = np.flatnonzero(self.outboard)
        arm = self.points[nodes] - mesh.outboard_point
        self.rigid[nodes, 0, 0] = 1.0
        self.rigid[nodes, 1, 1] = 1.0
        self.rigid[nodes, 0, 2] = -arm[:, 1]
        self.rigid[nodes, 1, 2] = arm[:, 0]
        self._number_interior(graph)

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
                "name the interface's curves so in the geometry"
            )
        return mask

    def _number_interior(self, graph: sp.csr_matrix) -> None:
        """Number interior nodes for a narrow band on one rank, in owners' ranges on several."""
        owned = self._space.dofmap.index_map.size_local
        nodes = np.flatnonzero(~(self.inboard | self.outboard)[:owned])
        if len(nodes):
            nodes = nodes[_narrow_order(graph[nodes][:, nodes], self.points[nodes])]
        self.interior_nodes = nodes
        self.num_interior = 2 * len(nodes)
        first = self.comm.exscan(len(nodes)) or 0
        number = np.full((len(self.points), 1), -1.0)
        number[nodes, 0] = first + np.arange(len(nodes))
        node_number = self._from_owners(number)[:, 0].astype(np.int64)
        both = 2 * node_number[:, None] + np.arange(2)
        self.numbers = np.where(node_number[:, None] >= 0, both, -1).ravel()
        self.num_dofs = 2 * self.comm.allreduce(len(nodes)) + 3

    def _from_owners(self, values: np.ndarray) -> np.ndarray:
        """Overwrite the ghosts' rows of nodal `values` (n_nodes, columns) by their owners'."""
        if self.comm.size == 1:
            return values
        out = np.empty_like(values)
        work = self._ghosted.x.array
        for k in range(values.shape[1]):
            work[0::2] = values[:, k]
            compat.scatter_forward(self._ghosted)
            out[:, k] = work[0::2]
        return out

    def expand(self, interior: np.ndarray, outboard: np.ndarray) -> np.ndarray:
        """Return the nodal field (n_nodes, 2, k) = T [interior; outboard].

        Args:
            interior: (num_interior, k) owned interior dofs, m.
            outboard: (3, k) coordinates (u_x m, u_y m, theta rad) of the outboard interface.
        """
        columns = interior.shape[1]
        field = np.zeros((len(self.points), 2, columns))
        field[self.interior_nodes] = interior.reshape(-1, 2, columns)
        if self.comm.size > 1:
            flat = self._from_owners(field.reshape(len(field), 2 * columns))
            field = flat.reshape(field.shape)
        rigid = np.flatnonzero(self.outboard)
        field[rigid] = self.rigid[rigid] @ outboard
        return field

    def restrict(self, field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return T' field, the transpose of `expand`, summed over the ranks.

        Args:
            field: (n_nodes, 2, k) contributions of this rank's cells.

        Returns:
            Owned interior rows (num_interior, k) and the outboard rows (3, k).
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
            out[:, :, k] = self._ghosted.x.array.reshape(-1, 2)
        return out


def _narrow_order(graph: sp.csr_matrix, points: np.ndarray) -> np.ndarray:
    """Return the order of nodes with the narrower band: along the arm, or Cuthill and McKee's.

    On the grid of a slender arm the first is row by row across it, half as wide as the other one,
    which begins at a corner.

    Args:
        graph: (n, n) with an entry where two nodes share a cell.
        points: (n, 2) m.
    """
    x = points[:, 0]
    along = np.round((x - x.min()) / max(np.ptp(x), np.finfo(float).tiny) * SAME_PLACE)
    orders = (
        np.lexsort((points[:, 1], along)),
        reverse_cuthill_mckee(graph, symmetric_mode=True),
    )
    rows, columns = graph.nonzero()

    def bandwidth(order: np.ndarray) -> int:
        number = np.empty(len(order), dtype=np.int64)
        number[order] = np.arange(len(order))
        return int(np.abs(number[rows] - number[columns]).max(initial=0))

    return min(orders, key=bandwidth)
