"""The interface transformation T of an arm: interior dofs and the outboard coordinates.

Nodal fields are arrays (n_nodes, d, columns) over this rank's nodes, ghosts included; d directions.
There are b = 3 outboard coordinates in the plane, in space 6 of every outboard interface.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from dolfinx import fem
from mpi4py import MPI
from scipy.sparse.csgraph import reverse_cuthill_mckee

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.fem.frames import by_rigid_motions, rigid_motions
from dolfinopt.fem.measured import (
    ENERGY_TOLERANCE,
    HARMLESS_CONTRAST,
    ROUNDING_ERROR_LIMIT,
)
from dolfinopt.fem.tensors import ElementTensors
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.mesh.measured import GRID_ROUNDING_SHARE
from dolfinopt.parallel import on_root, total

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm


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

    def __init__(self, mesh: ArmMesh, operators: ElementTensors, graph: sp.csr_matrix):
        """Find the interfaces and number the interior dofs (collective).

        Args:
            mesh: the arm.
            operators: the tensors of its cells.
            graph: (n_nodes, n_nodes) with an entry where two nodes share a cell.

        Raises:
            InputError: the mesh lacks an interface, or two share a node.
        """
        self.comm = mesh.comm
        self._space = operators.space
        self.points = operators.points
        self.dim = self.points.shape[1]
        self._ghosted = fem.Function(operators.space)
        sides = {"inboard": mesh.inboard_facets, "outboard": mesh.outboard_facets}
        sides |= {item.name: item.facets for item in mesh.further}
        masks = {name: self._nodes_of(mesh, facets, name) for name, facets in sides.items()}
        for item, other in combinations(masks, 2):
            if self.comm.allreduce(int((masks[item] & masks[other]).sum())):
                raise InputError(
                    f"arm {mesh.name!r}: interfaces {item!r} and {other!r} share nodes; "
                    "each is rigid: leave a cell between them"
                )
        self.inboard, *self.ends = masks.values()
        self.outboard = np.any(self.ends, axis=0)
        self.places = np.array([mesh.outboard_point, *mesh.further_points])
        self.rigid = self._rigid_field()
        self.num_coordinates = self.rigid.shape[2]
        self._number_interior(graph)

    def moved(self, points: np.ndarray) -> InterfaceTransformation:
        """Return that of the same interfaces with the nodes at other points (n_nodes, d), m."""
        other = copy(self)
        for name in ("_fit", "_rigid"):
            other.__dict__.pop(name, None)
        other.points = points
        other.rigid = other._rigid_field()
        return other

    def _rigid_field(self) -> np.ndarray:
        """Return the rigid motions (n_nodes, d, b) of each interface about its point."""
        parts = [
            rigid_motions(self.points - x) * at[:, None, None]
            for at, x in zip(self.ends, self.places, strict=True)
        ]
        return np.concatenate(parts, axis=2)

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
            self._ghosted.x.scatter_forward()
            out[:, k] = work[0 :: self.dim]
        return out

    def expand(self, interior: np.ndarray, outboard: np.ndarray) -> np.ndarray:
        """Return the nodal field (n_nodes, d, k) = T [interior; outboard].

        Args:
            interior: (num_interior, k) owned interior dofs, m.
            outboard: (b, k) coordinates of the outboard interface, m and rad.
        """
        columns = interior.shape[1]
        rows, others = self._rows
        shape = len(self.interior_nodes), self.dim * columns
        # To be taken is ten times as fast as to be put; a rank may have no rows.
        some = interior.reshape(shape) if shape[0] else np.zeros((1, shape[1]))
        field = some.take(rows, axis=0, mode="clip")
        field[others] = 0.0
        field = self._from_owners(field).reshape(-1, self.dim, columns)
        rigid, motions = self._rigid
        field[rigid] = motions @ outboard
        return field

    def restrict(self, field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return T' field, the transpose of `expand`, summed over the ranks.

        Args:
            field: (n_nodes, d, k) contributions of this rank's cells.

        Returns:
            Owned interior rows (num_interior, k) and the outboard rows (b, k).
        """
        columns = field.shape[2]
        rigid, motions = self._rigid
        outboard = np.tensordot(motions, field[rigid], ((0, 1), (0, 1)))
        if self.comm.size > 1:
            outboard = self.comm.allreduce(outboard)
            field = self._to_owners(field)
        interior = field.take(self.interior_nodes, axis=0, mode="clip")
        return interior.reshape(-1, columns), outboard

    @cached_property
    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Of every node its place among the owned interior ones, and the nodes that are none."""
        rows = np.full(len(self.points), -1)
        rows[self.interior_nodes] = np.arange(len(self.interior_nodes))
        return rows, np.flatnonzero(rows < 0)

    @cached_property
    def _rigid(self) -> tuple[np.ndarray, np.ndarray]:
        """The outboard interfaces' nodes, and their rows of `rigid`."""
        nodes = np.flatnonzero(self.outboard)
        return nodes, self.rigid[nodes]

    @cached_property
    def _fit(self) -> np.ndarray:
        """The field (n_nodes, d, b) whose products with fields are their coordinates, summed."""
        rows = self.rigid[self.outboard].reshape(-1, self.num_coordinates)
        return self.rigid @ np.linalg.inv(self.comm.allreduce(rows.T @ rows))

    def coordinates(self, field: np.ndarray) -> np.ndarray:
        """Return the outboard coordinates (b, k) of fields that `expand` returned (collective).

        Of others those of the nearest rigid motion.
        """
        result = np.tensordot(self._fit, field, ((0, 1), (0, 1)))
        return np.asarray(self.comm.allreduce(result))

    def by_coordinates(self, by: np.ndarray) -> np.ndarray:
        """Return the derivatives by a field (n_nodes, d, k), given those by `coordinates`."""
        return self._fit @ by

    def by_points(self, by_rigid: np.ndarray) -> np.ndarray:
        """Return the derivatives (n_nodes, d) by the nodes, given those by `rigid`."""
        result = np.zeros_like(self.points)
        for at, by in zip(self.ends, np.split(by_rigid, len(self.ends), axis=2), strict=True):
            result[at] += by_rigid_motions(by[at])
        return result

    def _to_owners(self, field: np.ndarray) -> np.ndarray:
        """Add the ghosts' rows of a nodal field to their owners' rows."""
        out = np.empty_like(field)
        for k in range(field.shape[2]):
            self._ghosted.x.array[:] = field[:, :, k].ravel()
            compat.scatter_reverse_add(self._ghosted)
            out[:, :, k] = self._ghosted.x.array.reshape(-1, self.dim)
        return out


def _narrow_order(graph: sp.csr_matrix, points: np.ndarray) -> tuple[np.ndarray, int]:
    """Return an order of nodes and its bandwidth: along the arm, or Cuthill and McKee's."""
    # The narrower one; on the grid of a slender arm the first, row by row across it, which is half
    # as wide as the other one, which begins at a corner.
    nearest = GRID_ROUNDING_SHARE * np.ptp(points[:, 0])
    along, *across = (_places(each, nearest) for each in points.T)
    rows, columns = graph.nonzero()
    number = np.empty(len(points), dtype=np.int64)

    def bandwidth(order: np.ndarray) -> int:
        number[order] = np.arange(len(order))
        return int(np.abs(number[rows] - number[columns]).max(initial=0))

    orders = np.lexsort((*across, along)), reverse_cuthill_mckee(graph, symmetric_mode=True)
    best = min(orders, key=bandwidth)
    return best, bandwidth(best)


def _places(values: np.ndarray, nearest: float) -> np.ndarray:
    """Number values in ascending order, those as one that differ from the next by rounding only."""
    order = np.argsort(values)
    number = np.empty(len(values), dtype=np.int64)
    number[order] = np.cumsum(np.diff(values[order], prepend=values[order[0]]) > nearest)
    return number


# -- static fields of the outboard interface, by displacement and load; what rounding does there


@dataclass(frozen=True, eq=False)
class ConstraintModes:
    """One arm under unit displacements of its outboard interface: b of them, 3 or 6 in space.

    Attributes:
        interior: (num_interior, b) owned interior rows.
        field: (n_nodes, d, b) nodal field.
        stiffness: (b, b) S, force and moment at the interface by its displacement.
    """

    interior: np.ndarray
    field: np.ndarray
    stiffness: np.ndarray


def static_modes(arm: ElasticArm) -> ConstraintModes:
    """Return Psi = [-K_II^-1 K_Ib; I] and S = Psi' K Psi: b solves with the factor at hand.

    Collective on the arm's ranks.

    Raises:
        ConvergenceError: the contrast between solid and void is too large for this design.
    """
    coupling, corner = arm.restrict(arm.substructure.rigid_forces(arm.young))
    # With the interior at rest the interface's motion has up to 1e5 of the modes' energy.
    interior = arm.solve(-coupling, held=np.diag(corner))
    field = arm.expand(interior, np.eye(len(corner)))
    modes = ConstraintModes(interior, field, arm.energy_matrix(field))
    if not _is_stiffness(modes.stiffness) or (
        is_soft(arm) and rounding_error(arm, modes) > ROUNDING_ERROR_LIMIT
    ):
        raise _lost_in_rounding(arm)
    return modes


@dataclass(frozen=True, eq=False)
class StaticFields:
    """m static fields of one arm, which span those of the loads that were asked for.

    Of the fields U a, with the tip's displacement T a, that of a load f has the least energy
    a' U'KU a / 2 - a' T'f: errors of U make one of second order in the displacement under it.

    Attributes:
        directions: (b, m) orthonormal, of the loads; b of them need no more fields.
        field: (n_nodes, d, m) U.
        tip: (b, m) T, displacements and rotations of the outboard interfaces.
        stiffness: (m, m) U'KU.
    """

    directions: np.ndarray
    field: np.ndarray
    tip: np.ndarray
    stiffness: np.ndarray

    def amplitudes(self, loads: np.ndarray) -> np.ndarray:
        """Return a (m, k) of loads (b, k)."""
        return np.linalg.solve(self.stiffness, self.tip.T @ loads)


def static_fields(arm: ElasticArm, loads: np.ndarray, known: StaticFields | None) -> StaticFields:
    """Return the static fields of loads (b, k): one solve for each that others do not make up.

    Constraint modes where these are known, or take no longer.
    Collective on the arm's ranks.

    Args:
        arm: of the design.
        loads: forces and moments at its outboard interfaces, N, N m.
        known: of earlier loads, which are kept.

    Raises:
        ConvergenceError: as of `static_modes`.
    """
    b = len(loads)
    if known is None:
        known = StaticFields(*(np.empty((*n, 0)) for n in ((b,), arm.points.shape, (b,), (0,))))
    extended = arm.substructure.extended
    # What a symmetric design's deflection has across the load is an error of the fields.
    error = extended.solver.tolerance if extended else 0.0
    new = on_root(arm.comm, _new_directions, known.directions, loads, error or ENERGY_TOLERANCE)
    if new.shape[1] == 0:
        return known
    if "constraint_modes" in vars(arm) or extended is None or is_soft(arm):
        modes = arm.constraint_modes
        return StaticFields(np.eye(b), modes.field, np.eye(b), modes.stiffness)
    interior, tip = arm.solve_loads(new)
    field = np.concatenate([known.field, arm.expand(interior, tip)], axis=2)
    result = StaticFields(
        np.hstack([known.directions, new]),
        field,
        np.hstack([known.tip, tip]),
        arm.energy_matrix(field),
    )
    if not _is_stiffness(result.stiffness):
        raise _lost_in_rounding(arm)
    return result


def _new_directions(known: np.ndarray, loads: np.ndarray, tolerance: float) -> np.ndarray:
    """Return an orthonormal basis (b, j) of what loads (b, k) have beside that of known ones."""
    # In the order of the loads, so that unit loads stay what they are. Less than the tolerance of a
    # load is nothing.
    basis = known
    for load in loads.T:
        rest = load
        for _ in range(2):  # once leaves rounding of the part that is taken off
            rest = rest - basis @ (basis.T @ rest)
        length = np.linalg.norm(rest)
        if length > tolerance * np.linalg.norm(load):
            basis = np.column_stack([basis, rest / length])
    return basis[:, known.shape[1] :]


def is_soft(arm: ElasticArm) -> bool:
    """Return whether rounding of the solid may hide what void holds (collective)."""
    low, high = extremes(arm.comm, arm.young)
    return low * HARMLESS_CONTRAST < high


def rounding_error(arm: ElasticArm, modes: ConstraintModes) -> float:
    """Return a bound of the relative error of S by rounding (collective).

    Matrices are known to eps times their diagonal D: eps u'Du / u'Ku, at most, of the constraint
    modes u. Solids that float in void, as islands do, move without strain: K does not see it, D
    does. Errors against long double are 0.0001 to 0.003 of it, with DOLFINx 0.9 up to 0.01. Where
    rounding holds such solids, they do not move, and are not in equilibrium: the work of forces in
    the interior, as if it moved with the interface, over that of the interface's own, if that is
    more.
    """
    cells, dim = arm.substructure.cells, arm.mesh.dim
    diagonal = np.einsum("eii->ie", cells.stiffness) * arm.young
    D = cells.sum_at_nodes(diagonal.reshape(-1, dim, 1, cells.count)).reshape(-1, 1)
    u, S = modes.field.reshape(len(D), -1), modes.stiffness
    bound = np.linalg.solve(S, total(arm.comm, u.T @ (D * u)))
    bound = np.finfo(float).eps * np.abs(np.linalg.eigvals(bound)).max()
    T = arm.substructure.T
    forces, _ = arm.restrict(cells.forces(modes.field, arm.young))
    inner = arm.points[arm.interior_nodes]
    motions = np.concatenate([rigid_motions(inner - x) for x in T.places], axis=2)
    works = total(arm.comm, np.abs(forces * motions.reshape(forces.shape)).sum(axis=0))
    return float(max(bound, (works / np.diag(S)).max()))


def _lost_in_rounding(arm: ElasticArm) -> ConvergenceError:
    low, high = extremes(arm.comm, arm.young)
    return ConvergenceError(
        f"arm {arm.mesh.name!r}: solid parts of the design are connected by void alone, "
        f"{low / high:.1g} times as stiff: too soft for double precision; raise "
        "interpolation.floor or design.minimum, or connect the design to both interfaces"
    )


def _is_stiffness(matrix: np.ndarray) -> bool:
    """Return whether a symmetric matrix is finite and positive definite."""
    if not np.isfinite(matrix).all():
        return False
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def extremes(comm: MPI.Comm, values: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest of positive values on all ranks."""
    low = comm.allreduce(values.min(initial=np.inf), op=MPI.MIN)
    return low, comm.allreduce(values.max(initial=0.0), op=MPI.MAX)
