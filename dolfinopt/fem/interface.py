"""The interface transformation T of an arm: interior dofs and the outboard coordinates.

Nodal fields are arrays (n_nodes, d, columns) over this rank's nodes, ghosts included; d directions.
There are b = 3 outboard coordinates in the plane, in space 6 of every outboard interface.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
from dolfinx import fem
from mpi4py import MPI
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.fem.measured import (
    ENERGY_TOLERANCE,
    HARMLESS_CONTRAST,
    ROUNDING_ITERATIONS,
    ROUNDING_TRANSLATION_SHARE,
    STIFFNESS_ROUNDING_LIMIT,
)
from dolfinopt.fem.tensors import ElementTensors
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.mesh.measured import GRID_ROUNDING_SHARE
from dolfinopt.parallel import on_root

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

    def moved(self, points: np.ndarray) -> InterfaceTransformation:
        """Return that of the same interfaces with the nodes at other points (n_nodes, d), m."""
        other = copy(self)
        for name in ("_fit", "_rigid"):
            other.__dict__.pop(name, None)
        other.points = points
        fields = [other._rigid_field(at, x) for at, x in zip(self.ends, self.places, strict=True)]
        other.rigid = np.concatenate(fields, axis=2)
        return other

    def _rigid_field(self, at: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Return the rigid motions (n_nodes, d, 3 or 6) about a point of the nodes `at`."""
        nodes = np.flatnonzero(at)
        motions = rigid_motions(self.points[nodes] - point)
        field = np.zeros((len(self.points), *motions.shape[1:]))
        field[nodes] = motions
        return field

    def _add_further(self, mesh: ArmMesh) -> None:
        """Add the further outboard interfaces; two that share a node, rigid both, are refused."""
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
        found = np.tensordot(self._fit, field, ((0, 1), (0, 1)))
        return np.asarray(self.comm.allreduce(found))

    def by_coordinates(self, by: np.ndarray) -> np.ndarray:
        """Return the derivatives by a field (n_nodes, d, k), given those by `coordinates`."""
        return self._fit @ by

    def by_points(self, by_rigid: np.ndarray) -> np.ndarray:
        """Return the derivatives (n_nodes, d) by the nodes, given those by `rigid`."""
        found = np.zeros_like(self.points)
        for at, by in zip(self.ends, np.split(by_rigid, len(self.ends), axis=2), strict=True):
            found[at] += by_rigid_motions(by[at])
        return found

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


def by_rigid_motions(by: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, d) by the points, given those by their `rigid_motions`."""
    if by.shape[1] == 2:
        return np.stack([by[:, 1, 2], -by[:, 0, 2]], axis=1)
    # e_k x X . b = X . (b x e_k)
    return np.sum([np.cross(by[:, :, 3 + k], np.eye(3)[k]) for k in range(3)], axis=0)


def _narrow_order(graph: sp.csr_matrix, points: np.ndarray) -> tuple[np.ndarray, int]:
    """Return an order of nodes and its bandwidth: along the arm, or Cuthill and McKee's."""
    # The narrower one; on the grid of a slender arm the first, row by row across it, which is half
    # as wide as the other one, which begins at a corner.
    nearest = GRID_ROUNDING_SHARE * np.ptp(points[:, 0])
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


# -- static fields of the outboard interface, by displacement and load; what rounding does there


@dataclass(frozen=True, eq=False)
class ConstraintModes:
    """One arm under unit displacements of its outboard interface: b of them, 3 or 6 in space.

    Attributes:
        interior: (num_interior, b) owned interior rows.
        field: (n_nodes, d, b) nodal field.
        stiffness: (b, b) S, force and moment at the interface by its displacement.
        coupling: (num_interior, b) K_Ib.
        corner: (b, b) K_bb.
    """

    interior: np.ndarray
    field: np.ndarray
    stiffness: np.ndarray
    coupling: np.ndarray
    corner: np.ndarray


def static_modes(arm: ElasticArm) -> ConstraintModes:
    """Return Psi = [-K_II^-1 K_Ib; I] and S = Psi' K Psi: b solves with the factor at hand.

    Collective on the arm's ranks.

    Raises:
        ConvergenceError: the contrast between solid and void is too large for this design.
    """
    floating = floats(arm)
    coupling, corner = arm.restrict(arm.substructure.rigid_forces(arm.young))
    # With the interior at rest the interface's motion has up to 1e5 of the modes' energy.
    interior = arm.solve(-coupling, held=np.diag(corner))
    modes = _with_energies(arm, interior, coupling, corner)
    if floating:
        modes = _refined(arm, modes)
    if not _is_stiffness(modes.stiffness):
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
    if arm.has_constraint_modes or extended is None or floats(arm):
        modes = arm.constraint_modes()
        return StaticFields(np.eye(b), modes.field, np.eye(b), modes.stiffness)
    interior, tip = arm.solve_loads(new)
    field = np.concatenate([known.field, arm.expand(interior, tip)], axis=2)
    found = StaticFields(
        np.hstack([known.directions, new]),
        field,
        np.hstack([known.tip, tip]),
        arm.energy_matrix(field),
    )
    if not _is_stiffness(found.stiffness):
        raise _lost_in_rounding(arm)
    return found


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


def floats(arm: ElasticArm) -> bool:
    """Return whether void that is softer by orders of magnitude holds solid cells (collective)."""
    low, high = extremes(arm.comm, arm.young)
    return low < 0.1 / HARMLESS_CONTRAST * high and arm.connectivity.floats(arm.young)


def _with_energies(
    arm: ElasticArm, interior: np.ndarray, coupling: np.ndarray, corner: np.ndarray
) -> ConstraintModes:
    field = arm.expand(interior, np.eye(len(corner)))
    return ConstraintModes(interior, field, arm.energy_matrix(field), coupling, corner)


def _refined(arm: ElasticArm, modes: ConstraintModes) -> ConstraintModes:
    """Return constraint modes after one step of iterative refinement, if rounding allows."""
    # Solids that float in void, as checkerboards and islands do, rest on stiffnesses far below the
    # rounding of their own. The residual is summed cell by cell without rigid motion, which knows
    # them better than the assembled matrix.
    if not _is_stiffness(modes.stiffness):
        raise _lost_in_rounding(arm)
    cells = arm.substructure.cells
    forces = cells.stiffness_times(cells.centred(modes.field)) * arm.young
    residual, _ = arm.restrict(cells.sum_at_nodes(forces))
    better = modes.interior - arm.solve(residual)
    refined = _with_energies(arm, better, modes.coupling, modes.corner)
    if not (
        _is_stiffness(refined.stiffness)
        and rounding_error(arm, refined) <= STIFFNESS_ROUNDING_LIMIT
    ):
        raise _lost_in_rounding(arm)
    return refined


def rounding_error(arm: ElasticArm, modes: ConstraintModes) -> float:
    """Return an estimate of the relative error of S by rounding.

    An element matrix is known to eps times its diagonal D_e, so the energy of any field is to
    eps u' D u, and relative to it to eps times the largest eigenvalue of D u = mu T'KT u.
    Inverse iteration finds it from random numbers: void that holds solids sets it
    orders of magnitude apart from all others. What it returns is too small only where mu
    exceeds 1 / eps, far beyond `STIFFNESS_ROUNDING_LIMIT`, because the factorised matrix is
    off by then.
    """
    cells = arm.substructure.cells
    diagonal = np.einsum("eii->ie", cells.stiffness) * arm.young
    diagonal = diagonal.reshape(-1, arm.mesh.dim, 1, len(arm.young))

    def weighted(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return T' D T u."""
        values = cells.values(field)
        forces = diagonal * (values - kept * values.mean(axis=0))
        forces -= kept * forces.mean(axis=0)
        return arm.restrict(cells.sum_at_nodes(forces))

    kept = 1.0 - ROUNDING_TRANSLATION_SHARE
    places = arm.points.T / arm.mesh.outboard_point[0]
    # By place, so that numbers are random and yet the same on any number of ranks.
    line = sum(factor * x for factor, x in zip((1e4, 7e4, 3e4), places, strict=False)) + 1.0
    noise = np.sin(np.outer(line, [12.9898, 78.233, 37.719][: len(places)])) * 43758.5453
    guess = (np.modf(np.abs(noise))[0] - 0.5)[:, :, None]
    loads, outboard = weighted(
        arm.expand(guess[arm.interior_nodes].reshape(-1, 1), np.full((len(modes.corner), 1), 0.5))
    )
    ratio = np.inf
    for _ in range(ROUNDING_ITERATIONS):
        lift = arm.comm.allreduce(modes.interior.T @ loads)
        tip = np.linalg.solve(modes.stiffness, outboard + lift)
        interior = arm.solve(loads) + modes.interior @ tip
        work = arm.comm.allreduce(np.sum(interior * loads)) + np.sum(tip * outboard)
        loads, outboard = weighted(arm.expand(interior, tip))
        energy = arm.comm.allreduce(np.sum(interior * loads)) + np.sum(tip * outboard)
        ratio = abs(float(energy / work))
        scale = max(energy, np.finfo(float).tiny) ** -0.5
        loads, outboard = scale * loads, scale * outboard
    return ratio * float(np.finfo(float).eps)


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


# -- solid cells that only far softer ones connect to an arm's interfaces ------------------------


def extremes(comm: MPI.Comm, values: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest of positive values on all ranks."""
    low = comm.allreduce(values.min(initial=np.inf), op=MPI.MIN)
    return low, comm.allreduce(values.max(initial=0.0), op=MPI.MAX)


class Connectivity:
    """Which cells share a facet, and which of them lie at the interfaces (collective on `comm`).

    Cells that touch at a corner or an edge alone are not connected: such a hinge does not stop
    rotation.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        space: Any,
        cells: np.ndarray,
        interfaces: list[np.ndarray],
    ):
        """Connect the cells of all ranks.

        Args:
            comm: the arm's ranks.
            space: its `dofmap.index_map` numbers the nodes.
            cells: (n_cells, n) local nodes of the owned cells, corners alone in space.
            interfaces: (n_nodes,) True for the nodes of each, the inboard one first.
        """
        self.comm = comm
        nodes = space.dofmap.index_map.local_to_global(cells.ravel().astype(np.int32))
        everywhere = np.concatenate(comm.allgather(nodes.reshape(cells.shape)))
        # A facet has at least so many nodes on any mesh, and no two cells share as many but by one.
        least = space.mesh.topology.dim
        ends = [
            np.concatenate(comm.allgather(mask[cells].sum(axis=1) >= least)) for mask in interfaces
        ]
        count, width = everywhere.shape
        incidence = sp.csr_matrix(
            (np.ones(everywhere.size), everywhere.ravel(), np.arange(0, count * width + 1, width)),
            shape=(count, space.dofmap.index_map.size_global),
        )
        shared = sp.triu(incidence @ incidence.T, k=1).tocoo()
        facets = shared.data >= least
        # More nodes of the graph stand for the interfaces. The outboard ones are rigid: they
        # connect the cells at them with each other, but do not hold them.
        pairs = [(shared.row[facets], shared.col[facets])]
        pairs += [
            (np.flatnonzero(end), np.full(end.sum(), count + k)) for k, end in enumerate(ends)
        ]
        self._count, self._ends = count, len(ends)
        self._first, self._second = (np.concatenate(side) for side in zip(*pairs, strict=True))

    def floats(self, young: np.ndarray) -> bool:
        """Return whether cells hang on others that are softer by more than `HARMLESS_CONTRAST`.

        True whenever, on every path from a cell to the inboard interface, there is one
        softer by more than ten times `HARMLESS_CONTRAST`; never where there is a path that keeps
        above it. Collective; the same on all ranks.

        Args:
            young: (n_cells,) Young's moduli of the owned cells, Pa.
        """
        low, high = extremes(self.comm, young)
        moduli = np.concatenate([*self.comm.allgather(young), [np.inf] * self._ends])
        weakest = np.minimum(moduli[self._first], moduli[self._second])
        moduli[-self._ends :] = 0.0  # an interface does not float itself
        level = high / HARMLESS_CONTRAST
        while level > low:
            kept = weakest >= level
            links = (np.ones(kept.sum()), (self._first[kept], self._second[kept]))
            _, group = connected_components(
                sp.coo_matrix(links, shape=(len(moduli), len(moduli))), directed=False
            )
            if (
                moduli[group != group[self._count]] > HARMLESS_CONTRAST * level * (1.0 - 1e-9)
            ).any():
                return True
            level *= 0.1
        return False


def joins(
    comm: MPI.Comm,
    space: Any,
    cells: np.ndarray,
    interfaces: list[np.ndarray],
    solid: np.ndarray,
) -> bool:
    """Return whether solid cells that share nodes lead from the first interface to all others.

    Collective on `comm`, the same on all ranks.

    Args:
        comm, space, cells, interfaces: as of `Connectivity`.
        solid: (n_cells,) True for the owned cells that count.
    """
    number = space.dofmap.index_map.local_to_global
    nodes = number(cells[solid].ravel().astype(np.int32)).reshape(-1, cells.shape[1])
    nodes = np.concatenate(comm.allgather(nodes))
    ends = [
        np.concatenate(comm.allgather(number(np.flatnonzero(mask).astype(np.int32))))
        for mask in interfaces
    ]
    first, second = np.repeat(nodes[:, 0], nodes.shape[1]), nodes.ravel()
    size = space.dofmap.index_map.size_global
    graph = sp.coo_matrix((np.ones(first.size), (first, second)), shape=(size, size))
    _, group = connected_components(graph, directed=False)
    at = [group[np.intersect1d(end, second)] for end in ends]
    return all(np.intersect1d(at[0], other).size for other in at[1:])
