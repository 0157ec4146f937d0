"""K(x) and M(x) of one arm: what lasts for the run (`Substructure`), and one design of it.

Nodal fields are arrays (n_nodes, d, columns) over this rank's nodes, ghosts included, with d = 2
directions in plane stress and 3 in space; b = 3 or 6 outboard coordinates. Products
with K and M hold the contributions of this rank's cells only, so that u . (K v), summed over the
ranks, needs no further communication; `restrict` adds the contributions of all ranks.
"""

from __future__ import annotations

from copy import copy
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dolfinopt.fem.assembly import (
    AssembledMatrix,
    CellMatrix,
    Cells,
    InteriorMatrix,
    NodePairs,
    of_cells,
    of_directions,
)
from dolfinopt.fem.interface import (
    ConstraintModes,
    InterfaceTransformation,
    StaticFields,
    static_fields,
    static_modes,
)
from dolfinopt.fem.interior import (
    ExtendedStiffness,
    LinearSystem,
    extended_layout,
    interior_layout,
)
from dolfinopt.fem.measured import ENERGY_TOLERANCE, STATICS_TOLERANCE
from dolfinopt.fem.multigrid import Columns, box_of
from dolfinopt.fem.shape_derivative import ShapeDerivative
from dolfinopt.fem.stress import stress_operator
from dolfinopt.fem.tensors import ElementTensors, element_centre
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import together, total

Rows = tuple[np.ndarray, np.ndarray]  # (num_interior, k) owned interior rows, (b, k) outboard rows


class Substructure:
    """One arm whatever its design: element operators, sparsity patterns, interfaces, solver.

    Attributes:
        mesh: the arm.
        operators: the tensors of its cells.
        cells: those of this rank, with one element matrix where all are alike, as in a grid.
        profile: of this rank.
        T: the interface transformation.
        interior: system of the interior; one factorisation, of the design that asked last.
        extended: that with the interfaces' rows, of solids of which statics alone are asked: a load
            of the outboard interfaces takes one solution; None of others.
    """

    def __init__(
        self,
        operators: ElementTensors,
        tolerance: float = ENERGY_TOLERANCE,
        statics_alone: bool = False,
    ):
        """Number the interior dofs and lay down the sparsity patterns (collective).

        Args:
            operators: see above.
            tolerance: of iterative solutions in energy, relative.
            statics_alone: whether nothing is asked of its designs but what static loads do.

        Raises:
            InputError: the mesh lacks an interface.
        """
        self.mesh, self.profile = mesh, profile = operators.mesh, operators.profile
        self.operators, self.cells = operators, Cells(operators)
        with together(mesh.comm):
            self._pairs = NodePairs(operators.cells, len(operators.points))
            self._stiffness = CellMatrix(self._pairs, operators.stiffness)
            self._mass = CellMatrix(self._pairs, operators.mass)
        self.T = InterfaceTransformation(mesh, operators, self._mass.pattern)
        solid = mesh.dim == 3 and mesh.wall is None
        box = box_of(self.T, self.cells, mesh.centroid) if solid else None
        simplices = operators.cell.is_simplex
        layout = interior_layout(mesh.name, self.T, self._pairs.pattern, simplices, box)
        self.interior = LinearSystem(layout, profile, tolerance)
        self.extended = self._extended() if statics_alone and mesh.dim == 3 else None
        self._interior_mass_of: AssembledMatrix | None = None

    def moved(self, mesh: ArmMesh, points: np.ndarray) -> Substructure:
        """Return a solid arm's with its nodes elsewhere (collective).

        Numbering, patterns and the one solver are shared: an arm of either that asks for the
        factor has its own from then on.

        Args:
            mesh: `ArmMesh.moved`.
            points: (n_nodes, 3) of the elements' nodes, m.
        """
        other = copy(self)
        for name, value in vars(Substructure).items():
            if isinstance(value, cached_property):
                other.__dict__.pop(name, None)
        other.mesh = mesh
        other.operators = self.operators.moved(mesh, points)
        other.cells = Cells(other.operators)
        other._stiffness = CellMatrix(self._pairs, other.cells.stiffness)
        other._mass = CellMatrix(self._pairs, other.cells.mass)
        other.T = self.T.moved(points)
        other._interior_mass_of = None
        return other

    def _extended(self) -> LinearSystem:
        touched = np.zeros((*self.operators.points.shape, 1))
        touched[self.operators.cells[self._rigid_forces[0]]] = 1.0
        self._near = np.flatnonzero(self.T.restrict(touched)[0])
        entries = self.T.dim**2 * self._pairs.pattern.nnz
        layout = extended_layout(self.interior.layout, self.T, entries, self._near)
        return LinearSystem(layout, self.profile, min(self.interior.tolerance, STATICS_TOLERANCE))

    def interior_mass(self, M: AssembledMatrix) -> InteriorMatrix:
        """Return M_II of a design, until that of another one is asked for (collective)."""
        matrix = self._interior_mass
        if self._interior_mass_of is not M:
            self._interior_mass_of = M
            matrix.update(M.data)
        return matrix

    @cached_property
    def _interior_mass(self) -> InteriorMatrix:
        layout = self.interior.layout
        entries = of_directions(layout.entries(), self.T.dim)
        return InteriorMatrix(layout.comm, entries, layout.rows)

    def joins(self, solid: np.ndarray) -> bool:
        """Return whether solid ones (n_cells,) of its cells join all interfaces (collective).

        They do where cells that share nodes lead from one to the other.
        """
        T, numbering = self.T, self.operators.space.dofmap.index_map

        def everywhere(nodes: np.ndarray) -> np.ndarray:
            own = numbering.local_to_global(nodes.ravel().astype(np.int32))
            return np.concatenate(T.comm.allgather(own))

        nodes = self.operators.cells[solid]
        first, second = map(everywhere, (np.broadcast_to(nodes[:, :1], nodes.shape), nodes))
        graph = sp.coo_matrix((np.ones(first.size), (first, second)), 2 * (numbering.size_global,))
        _, group = connected_components(graph, directed=False)
        ends = [everywhere(np.flatnonzero(mask)) for mask in (T.inboard, *T.ends)]
        at = [group[np.intersect1d(end, second)] for end in ends]
        return all(np.intersect1d(at[0], other).size for other in at[1:])

    @cached_property
    def _rigid_forces(self) -> tuple[np.ndarray, np.ndarray]:
        """Cells at the outboard interface, and k_e times its unit motions there (cells, dn, b)."""
        cells = self.operators.cells
        near = np.flatnonzero(self.T.outboard[cells].any(axis=1))
        b = self.T.num_coordinates
        values = self.T.rigid[cells[near]].reshape(len(near), self.T.dim * cells.shape[1], b)
        return near, of_cells(self.operators.stiffness, near) @ values

    def rigid_forces(self, young: np.ndarray) -> np.ndarray:
        """Return K times unit motions of the outboard interface (n_nodes, d, b), of these cells.

        Only the cells at the interface contribute.
        """
        near, forces = self._rigid_forces
        shape = self.T.rigid.shape
        forces = (forces * young[near, None, None]).reshape(-1, *shape[1:])
        field = np.zeros(shape)
        np.add.at(field, self.operators.cells[near].ravel(), forces)
        return field

    @cached_property
    def shape_derivative(self) -> ShapeDerivative:
        """Derivatives of what cells add to, by the places of their corners."""
        return ShapeDerivative(self.operators)

    @cached_property
    def stress_operator(self) -> sp.csr_matrix:
        """That of `fem.stress` at the element centres (s n_cells, d n_nodes), 1/m."""
        return stress_operator(self.operators, element_centre(self.operators.cell))

    @cached_property
    def interface_distance(self) -> np.ndarray:
        """Distance (n_cells,) of every centroid to the nearest node of an interface, m.

        Collective on the arm's ranks.
        """
        T = self.T
        nodes = np.concatenate(T.comm.allgather(T.points[T.inboard | T.outboard]))
        return cKDTree(nodes).query(self.mesh.centroid)[0]

    def extend(self, K: AssembledMatrix) -> ExtendedStiffness:
        """Return what `extended` takes of K of a design (collective)."""
        coupling, corner = self.T.restrict(self.rigid_forces(K.scale))
        return ExtendedStiffness(K, np.append(coupling[self._near].ravel(), corner))

    def at(self, young: np.ndarray, density: np.ndarray) -> ElasticArm:
        """Return the arm with these materials; nothing is assembled before it is asked for.

        Args:
            young: (n_cells,) Young's modulus of the owned cells, Pa.
            density: (n_cells,) their mass density, kg/m3.
        """
        K = AssembledMatrix(self._stiffness, young, self.profile)
        return ElasticArm(self, K, AssembledMatrix(self._mass, density, self.profile))


class ElasticArm:
    """One arm with given materials: immutable, its parts computed when they are first asked for.

    Attributes:
        substructure: what it shares with other designs of the same arm.
        K, M: assembled stiffness (dofs) and mass (nodes) of this rank's cells.
        mesh, operators, profile: of the substructure.
        comm, inboard, outboard, rigid, interior_nodes, num_interior, num_dofs, expand, restrict,
            coordinates: of its `InterfaceTransformation`.
        points: (n_nodes, d) reference positions, m.
    """

    def __init__(self, substructure: Substructure, K: AssembledMatrix, M: AssembledMatrix):
        self.substructure = substructure
        self.K, self.M = K, M
        self.mesh, self.operators = substructure.mesh, substructure.operators
        self.profile = substructure.profile
        self.points = self.operators.points
        T = substructure.T
        self.comm = T.comm
        self.inboard, self.outboard, self.rigid = T.inboard, T.outboard, T.rigid
        self.interior_nodes = T.interior_nodes
        self.num_interior, self.num_dofs = T.num_interior, T.num_dofs
        self.expand, self.restrict, self.coordinates = T.expand, T.restrict, T.coordinates
        self._static_fields: StaticFields | None = None

    @property
    def young(self) -> np.ndarray:
        """Young's modulus (n_cells,) of the owned cells, Pa."""
        return self.K.scale

    @property
    def density(self) -> np.ndarray:
        """Mass density (n_cells,) of the owned cells, kg/m3."""
        return self.M.scale

    # -- products ----------------------------------------------------------------------------

    def stiffness_times(self, field: np.ndarray) -> np.ndarray:
        """Return K u (n_nodes, d, k) of this rank's cells; N for u in m."""
        flat = field.reshape(field.shape[0] * field.shape[1], field.shape[2])
        return (self.K.matrix @ flat).reshape(field.shape)

    def mass_times(self, field: np.ndarray) -> np.ndarray:
        """Return M u (n_nodes, d, k) of this rank's cells; kg m for u in m."""
        flat = field.reshape(len(field), field.shape[1] * field.shape[2])
        return (self.M.matrix @ flat).reshape(field.shape)

    @property
    def interior_mass(self) -> InteriorMatrix:
        """M_II."""
        return self.substructure.interior_mass(self.M)

    @cached_property
    def rigid_inertia(self) -> np.ndarray:
        """M [1, X] (n_nodes, d, 2), component by component, of this rank's cells; kg, kg m."""
        return self.mass_times(np.stack([np.ones_like(self.points), self.points], axis=2))

    def energy_matrix(self, field: np.ndarray) -> np.ndarray:
        """Return field' K field (k, k), summed over the ranks.

        Summed cell by cell: near a static equilibrium the error is then of second order in that
        of the field, and nothing cancels. K_bb + K_bI Psi, its algebraic equal for constraint
        modes, loses (length / cell)^3 in digits.
        """
        part = self.substructure.cells.energy_matrix(field, self.young)
        energy = total(self.comm, part)
        return 0.5 * (energy + energy.T)

    def cell_stiffness_products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return sum_k left_k' k_e right_k (n_cells,) for nodal fields (n_nodes, d, k).

        The derivative of left . K right with respect to Young's modulus of each owned cell.
        """
        self.profile.counts.energy_fields += left.shape[2]
        return self.substructure.cells.stiffness_products(left, right)

    def cell_mass_products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return sum_k left_k' m_e right_k (n_cells,) for nodal fields (n_nodes, d, k).

        The derivative of left . M right with respect to the mass density of each owned cell.
        """
        self.profile.counts.energy_fields += left.shape[2]
        return self.substructure.cells.mass_products(left, right)

    # -- the interior ------------------------------------------------------------------------

    @property
    def is_iterative(self) -> bool:
        """Whether systems of the interior are solved to a tolerance only (collective)."""
        return self.substructure.interior.is_iterative

    def solve(
        self, right: np.ndarray, tolerance: float | None = None, held: np.ndarray | None = None
    ) -> np.ndarray:
        """Solve K_II U = right for (num_interior, k) owned rows; columns of zeros cost nothing.

        Args:
            right: right sides.
            tolerance, held: see `interior.Solver`.

        Raises:
            ConvergenceError: K_II is singular but for rounding.
        """
        loaded = total(self.comm, right.any(axis=0).astype(int)) > 0
        interior = self.substructure.interior
        if loaded.all():
            return interior.solve(self.K, right, tolerance, held)
        out = np.zeros_like(right)
        if loaded.any():
            held = None if held is None else held[loaded]
            out[:, loaded] = interior.solve(self.K, right[:, loaded], tolerance, held)
        return out

    def precondition(self, right: np.ndarray) -> np.ndarray:
        """Return K_II^-1 right, or an approximation of it where solutions are iterative."""
        return self.substructure.interior.precondition(self.K, right)

    def solve_free(
        self, interior: np.ndarray, outboard: np.ndarray, inverse: Columns | None = None
    ) -> Rows:
        """Return (T'KT)^-1 of loads, the outboard interfaces free, by block elimination.

        With constraint modes Psi and their stiffness S,
        z_b = S^-1 (f_b + Psi' f_I),  z_I = K_II^-1 f_I + Psi z_b.

        Args:
            interior: (num_interior, k) f_I, owned rows, N.
            outboard: (b, k) f_b, N, N m.
            inverse: in place of `solve`.
        """
        modes = self.constraint_modes
        lift = total(self.comm, modes.interior.T @ interior)
        tip = np.linalg.solve(modes.stiffness, outboard + lift)
        return (inverse or self.solve)(interior) + modes.interior @ tip, tip

    def static_response(self, interior: np.ndarray, outboard: np.ndarray) -> np.ndarray:
        """Return the displacements (n_nodes, d, k) of static loads, see `solve_free`."""
        return self.expand(*self.solve_free(interior, outboard))

    @cached_property
    def _extended(self) -> ExtendedStiffness:
        return self.substructure.extend(self.K)

    def solve_loads(self, loads: np.ndarray) -> Rows:
        """Return what loads (b, k) of the outboard interfaces do, by the `extended` system.

        Raises:
            ConvergenceError: K is singular but for rounding.
        """
        extended, size = self.substructure.extended, self.num_interior
        assert extended is not None
        right = np.zeros((extended.layout.rows, loads.shape[1]))
        right[size:] = loads[: extended.layout.rows - size]  # of the last rank
        out = extended.solve(self._extended, right)
        return out[:size], self.comm.bcast(out[size:], root=self.comm.size - 1)

    @cached_property
    def constraint_modes(self) -> ConstraintModes:
        """The static fields of unit displacements of the outboard interface.

        Raises:
            ConvergenceError: the contrast between solid and void is too large for this design.
        """
        return static_modes(self)

    def static_fields(self, loads: np.ndarray) -> StaticFields:
        """Return the static fields that such loads (b, k) of the outboard interfaces need.

        Those of earlier loads are kept.

        Raises:
            ConvergenceError: as of `constraint_modes`.
        """
        self._static_fields = static_fields(self, loads, self._static_fields)
        return self._static_fields
