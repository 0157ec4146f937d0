"""Element operators from UFL forms; K(x), M(x) and the factorised interior of one arm.

Nodal fields are arrays (n_nodes, 2, columns) over this rank's nodes, ghosts included. Products
with K and M hold the contributions of this rank's cells only, so that u . (K v), summed over the
ranks, needs no further communication; `restrict` adds the contributions of all ranks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse.csgraph import reverse_cuthill_mckee

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.fem.floating import HARMLESS, Connectivity, extremes
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import direct_solver, obeying_options, together
from dolfinopt.profiling import Ledger

OPTIONS = "dolfinopt_stiffness_"  # prefix of the solver's PETSc options
# Largest error that rounding may make in the stiffness of a design in which solids float, relative.
# Against long double errors are 0.03 to 0.35 of the estimate.
ROUNDED = 1e-3
# Share of a cell's displacement as a rigid translation in that estimate. The energy does not know
# translations, the assembled matrix does: where they are lost in it, refinement fails.
TRANSLATION = 0.03
POWER_STEPS = 6  # of the estimate; four give two digits


@dataclass(frozen=True, eq=False)
class ElementOperators:
    """Element matrices of one arm, for unit Young's modulus and unit mass density.

    Attributes:
        space: vector-valued Lagrange space, its block dofs number the nodes.
        cells: (n_cells, n) local nodes of the owned cells.
        points: (n_nodes, 2) reference positions, m.
        stiffness: (n_cells, 2n, 2n) plane stress, m (thickness included); times E0 gives N/m.
        mass: (n_cells, n, n) of one displacement component, m3; times rho0 gives kg.
    """

    space: Any
    cells: np.ndarray
    points: np.ndarray
    stiffness: np.ndarray
    mass: np.ndarray


def element_operators(
    mesh: ArmMesh, thickness: float, poisson_ratio: float, degree: int = 1
) -> ElementOperators:
    """Tabulate the element matrices of plane stress once, with FFCx's own kernels.

    k_e = int B' C B t dA with E = 1,  m_e = int N' N t dA.

    Args:
        mesh: the arm.
        thickness: t, m.
        poisson_ratio: nu.
        degree: polynomial degree of the displacement.
    """
    vector = compat.lagrange_space(mesh.mesh, degree, components=2)
    scalar = compat.lagrange_space(mesh.mesh, degree)
    u, v = ufl.TrialFunction(vector), ufl.TestFunction(vector)
    p, w = ufl.TrialFunction(scalar), ufl.TestFunction(scalar)
    t, nu = fem.Constant(mesh.mesh, 1.0), fem.Constant(mesh.mesh, 0.0)

    def strain(a: object) -> object:
        return ufl.sym(ufl.grad(a))

    stress = t / (1 - nu**2) * ((1 - nu) * strain(u) + nu * ufl.tr(strain(u)) * ufl.Identity(2))
    k_form = compat.compile_form(ufl.inner(stress, strain(v)) * ufl.dx)
    m_form = compat.compile_form(t * ufl.inner(p, w) * ufl.dx)
    with together(mesh.comm):
        coordinates = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
        return ElementOperators(
            space=vector,
            cells=compat.cell_nodes(vector, mesh.num_cells),
            points=vector.tabulate_dof_coordinates()[:, :2].copy(),
            stiffness=compat.tabulate_cells(k_form, [thickness, poisson_ratio], coordinates),
            mass=compat.tabulate_cells(m_form, [thickness], coordinates),
        )


class AffineMatrix:
    """sum_e s_e A_e as a SciPy CSR matrix over local dofs, assembled by one sparse product.

    `values = P @ s`: column e of P holds the entries of A_e at their places in the pattern.
    Measured at 9 600 quadrilaterals: 1 ms against 8 to 20 ms for reassembling the form.
    """

    def __init__(self, dofs: np.ndarray, elements: np.ndarray, size: int):
        """Set up the pattern from element dofs (n_cells, n) and matrices (n_cells, n, n)."""
        count, width = dofs.shape
        rows = np.repeat(dofs, width, axis=1).ravel().astype(np.int64)
        keys = rows * size + np.tile(dofs, (1, width)).ravel()
        unique, place = np.unique(keys, return_inverse=True)
        cell = np.repeat(np.arange(count), width * width)
        self._assembly = sp.csr_matrix(
            (elements.ravel(), (place, cell)), shape=(len(unique), count)
        )
        row_of = unique // size
        indptr = np.searchsorted(row_of, np.arange(size + 1))
        self.matrix = sp.csr_matrix(
            (np.zeros(len(unique)), (unique % size).astype(np.int32), indptr.astype(np.int32)),
            shape=(size, size),
        )

    def assemble(self, scale: np.ndarray) -> sp.csr_matrix:
        """Fill in `scale` (n_cells,) and return the matrix (the same object every time)."""
        self.matrix.data[:] = self._assembly @ scale
        return self.matrix


class InteriorMatrix:
    """The interior rows and columns of a local CSR matrix as a PETSc matrix."""

    def __init__(
        self,
        comm: MPI.Comm,
        local: sp.csr_matrix,
        components: int,
        numbers: np.ndarray,
        owned: int,
    ):
        """Select the pattern.

        Args:
            comm: the arm's ranks.
            local: matrix over local dofs, or over local nodes when `components` is 2 and the
                matrix acts on both displacement components alike; only its pattern is used.
            components: 1 or 2, see `local`.
            numbers: (n_local_dofs,) global interior number of each local dof, -1 for others.
            owned: number of interior dofs this rank owns.
        """
        rows = np.repeat(np.arange(local.shape[0]), np.diff(local.indptr))
        spread = [components * rows + c for c in range(components)]
        rows = numbers[np.concatenate(spread)]
        cols = numbers[np.concatenate([components * local.indices + c for c in range(components)])]
        source = np.tile(np.arange(local.nnz), components)
        keep = np.flatnonzero((rows >= 0) & (cols >= 0))
        keep = keep[np.lexsort((cols[keep], rows[keep]))]
        rows, cols, self._source = rows[keep], cols[keep].astype(PETSc.IntType), source[keep]
        self._serial = comm.size == 1
        if self._serial:
            indptr = np.searchsorted(rows, np.arange(owned + 1)).astype(PETSc.IntType)
            self._values = np.zeros(len(rows))
            # The matrix shares this array: no copy an assembly (2 ms at 9 600 quadrilaterals).
            self._kept = (indptr, cols, self._values)
            self.mat = PETSc.Mat().createAIJWithArrays((owned, owned), self._kept, comm=comm)
        else:
            # Local rows of all ranks; PETSc ships what belongs to others at assembly.
            row_ids, starts = np.unique(rows, return_index=True)
            self._kept = (
                np.append(starts, len(rows)).astype(PETSc.IntType),
                cols,
                row_ids.astype(PETSc.IntType),
            )
            self.mat = PETSc.Mat().createAIJ(((owned, None), (owned, None)), nnz=40, comm=comm)
            self.mat.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)

    def update(self, data: np.ndarray) -> None:
        """Take the values from the local matrix's data array."""
        if self._serial:
            np.take(data, self._source, out=self._values)
            self.mat.stateIncrease()
        else:
            indptr, cols, row_ids = self._kept
            self.mat.zeroEntries()
            self.mat.setValuesIJV(
                indptr, cols, data[self._source], addv=PETSc.InsertMode.ADD_VALUES, rowmap=row_ids
            )
        self.mat.assemble()
        # Forgotten whenever values change; without them MUMPS pivots.
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self.mat.setOption(PETSc.Mat.Option.SPD, True)


@dataclass(frozen=True, eq=False)
class ConstraintModes:
    """One arm under unit displacements (u_x, u_y, theta) of its outboard interface.

    Attributes:
        interior: (num_interior, 3) owned interior rows.
        field: (n_nodes, 2, 3) nodal field.
        stiffness: (3, 3) S, force and moment at the interface by its displacement.
        coupling: (num_interior, 3) K_Ib.
        corner: (3, 3) K_bb.
    """

    interior: np.ndarray
    field: np.ndarray
    stiffness: np.ndarray
    coupling: np.ndarray
    corner: np.ndarray


class ElasticArm:
    """One arm's stiffness and mass for the current design, with one factorisation a design.

    The inboard interface is clamped in the tangent frame; the outboard interface is rigid with
    three coordinates (u_x, u_y, theta) about its reference point. "Interior" are all other dofs.
    """

    def __init__(self, mesh: ArmMesh, operators: ElementOperators, ledger: Ledger):
        """Number the interior dofs and lay down the sparsity patterns.

        Raises:
            InputError: the mesh lacks an interface.
        """
        self.mesh = mesh
        self.operators = operators
        self.ledger = ledger
        self.comm = mesh.comm
        self.points = operators.points
        self._find_interfaces()
        size = len(self.points)
        dofs = np.repeat(2 * operators.cells, 2, axis=1)
        dofs[:, 1::2] += 1
        with together(self.comm):
            self._stiffness = AffineMatrix(dofs, operators.stiffness, 2 * size)
            self._mass = AffineMatrix(operators.cells, operators.mass, size)
        self._number_interior()
        self._K_II: InteriorMatrix | None = None
        self._M_II: InteriorMatrix | None = None
        self._ksp: PETSc.KSP | None = None
        self._mass_ready = self._factor_ready = self._mass_matrix_ready = False
        self._young = self._density = np.empty(0)
        self._constraint_modes: ConstraintModes | None = None

    # -- set-up ------------------------------------------------------------------------------

    def _find_interfaces(self) -> None:
        """Mark the nodes of both interfaces and the rigid motion of the outboard one."""
        space = self.operators.space
        facet_dim = self.mesh.mesh.topology.dim - 1
        size = len(self.points)
        self._ghosted = fem.Function(space)
        self.inboard = np.zeros(size, dtype=bool)
        self.outboard = np.zeros(size, dtype=bool)
        for mask, facets, side in (
            (self.inboard, self.mesh.inboard_facets, "inboard"),
            (self.outboard, self.mesh.outboard_facets, "outboard"),
        ):
            mask[fem.locate_dofs_topological(space, facet_dim, facets.astype(np.int32))] = True
            # A rank may see a node of the interface without seeing a facet of it.
            mask[:] = self._from_owners(mask[:, None].astype(float))[:, 0] > 0.5
            if self.comm.allreduce(int(mask.sum())) == 0:
                raise InputError(
                    f"arm {self.mesh.name!r}: the mesh has no facets of physical group {side!r}; "
                    "name the interface's curves so in the geometry"
                )
        self.rigid = np.zeros((size, 2, 3))  # nodal field of a unit u_x, u_y, theta
        nodes = np.flatnonzero(self.outboard)
        arm = self.points[nodes] - self.mesh.outboard_point
        self.rigid[nodes, 0, 0] = 1.0
        self.rigid[nodes, 1, 1] = 1.0
        self.rigid[nodes, 0, 2] = -arm[:, 1]
        self.rigid[nodes, 1, 2] = arm[:, 0]

    def _number_interior(self) -> None:
        """Number interior nodes: Cuthill-McKee on one rank, owners' ranges on several.

        Across the short side of a slender arm this keeps the band narrow: at 400 x 24 PETSc's
        Cholesky takes 14 ms so numbered, 20 ms with nested dissection.
        """
        owned = self.operators.space.dofmap.index_map.size_local
        nodes = np.flatnonzero(~(self.inboard | self.outboard)[:owned])
        pattern = self._mass.matrix
        if len(nodes):
            sub = sp.csr_matrix(
                (np.ones(len(pattern.data)), pattern.indices, pattern.indptr), pattern.shape
            )[nodes][:, nodes]
            nodes = nodes[reverse_cuthill_mckee(sub, symmetric_mode=True)]
        self.interior_nodes = nodes
        self.num_interior = 2 * len(nodes)  # owned by this rank
        first = self.comm.exscan(len(nodes)) or 0
        number = np.full((len(self.points), 1), -1.0)
        number[nodes, 0] = first + np.arange(len(nodes))
        node_number = self._from_owners(number)[:, 0].astype(np.int64)
        number2 = 2 * node_number[:, None] + np.arange(2)
        self._numbers = np.where(node_number[:, None] >= 0, number2, -1).ravel()
        self.num_dofs = 2 * self.comm.allreduce(len(nodes)) + 3

    # -- fields ------------------------------------------------------------------------------

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

    # -- design ------------------------------------------------------------------------------

    def set_design(self, young: np.ndarray, density: np.ndarray) -> None:
        """Take Young's modulus (Pa) and mass density (kg/m3) of the owned cells.

        Nothing is assembled before it is asked for, and nothing twice for the same design.
        """
        if not np.array_equal(young, self._young):
            self._young = young.copy()
            with self.ledger.phase("assembly"):
                self._stiffness.assemble(young)
            self.ledger.counts.assemblies += 1
            self._factor_ready = False
            self._constraint_modes = None
        if not np.array_equal(density, self._density):
            self._density = density.copy()
            self._mass_ready = self._mass_matrix_ready = False

    def _mass_local(self) -> sp.csr_matrix:
        if not self._mass_ready:
            with self.ledger.phase("assembly"):
                self._mass.assemble(self._density)
            self.ledger.counts.assemblies += 1
            self._mass_ready = True
        return self._mass.matrix

    def stiffness_times(self, field: np.ndarray) -> np.ndarray:
        """Return K u (n_nodes, 2, k) of this rank's cells; N for u in m."""
        columns = field.shape[2]
        return (self._stiffness.matrix @ field.reshape(-1, columns)).reshape(field.shape)

    def mass_times(self, field: np.ndarray) -> np.ndarray:
        """Return M u (n_nodes, 2, k) of this rank's cells; kg m for u in m."""
        flat = field.reshape(len(field), 2 * field.shape[2])
        return (self._mass_local() @ flat).reshape(field.shape)

    def interior_stiffness(self) -> PETSc.Mat:
        """Return K_II as a PETSc matrix, owned by this object."""
        self.factorise()
        assert self._K_II is not None
        return self._K_II.mat

    def interior_mass(self) -> PETSc.Mat:
        """Return M_II as a PETSc matrix, owned by this object."""
        mass = self._mass_local()
        if self._M_II is None:
            self._M_II = InteriorMatrix(self.comm, mass, 2, self._numbers, self.num_interior)
        if not self._mass_matrix_ready:
            self._M_II.update(mass.data)
            self._mass_matrix_ready = True
        return self._M_II.mat

    def factorise(self) -> PETSc.KSP:
        """Return the solver of K_II with the current design factorised; once a design.

        Ordering and symbolic factor are kept for the whole run.
        """
        if self._factor_ready:
            assert self._ksp is not None
            return self._ksp
        local = self._stiffness.matrix
        if self._K_II is None:
            self._K_II = InteriorMatrix(self.comm, local, 1, self._numbers, self.num_interior)
        if self._ksp is None:
            self._ksp = direct_solver(self._K_II.mat, "natural", OPTIONS)  # numbered for it
        with self.ledger.phase("factorisation"):
            self._K_II.update(local.data)
            self._ksp.setOperators(self._K_II.mat)
            with obeying_options(OPTIONS):
                self._ksp.setUp()
        self.ledger.counts.factorisations += 1
        self._factor_ready = True
        return self._ksp

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve K_II U = right for (num_interior, k) owned rows.

        Raises:
            ConvergenceError: K_II is singular but for rounding.
        """
        b, x = self.factorise().getOperators()[0].createVecs()
        out = np.empty_like(right)
        failed = False
        with self.ledger.phase("solves"):
            for k in range(right.shape[1]):
                b.array = right[:, k]
                self.solve_vector(b, x)
                out[:, k] = x.array_r
                failed = failed or self.factorise().getConvergedReason() < 0
        if failed:  # the same on all ranks
            raise ConvergenceError(
                f"arm {self.mesh.name!r}: the stiffness matrix cannot be factorised: void is lost "
                "in the rounding of solid; raise interpolation.floor or design.minimum"
            )
        return out

    def solve_vector(self, right: PETSc.Vec, solution: PETSc.Vec) -> None:
        """Solve K_II u = right for PETSc vectors of owned interior dofs."""
        self.factorise().solve(right, solution)
        self.ledger.counts.solves += 1

    def constraint_modes(self) -> ConstraintModes:
        """Return the static fields of unit displacements of the outboard interface; once a design.

        Psi = [-K_II^-1 K_Ib; I],  S = Psi' K Psi: three solves with the factor at hand.

        Raises:
            ConvergenceError: the contrast between solid and void is too large for this design.
        """
        if self._constraint_modes is None:
            coupling, corner = self.restrict(self.stiffness_times(self.rigid))
            modes = self._energies(self.solve(-coupling), coupling, corner)
            if self._floats():
                modes = self._refined(modes)
            if not _is_stiffness(modes.stiffness):
                raise self._lost_in_rounding()
            self._constraint_modes = modes
        return self._constraint_modes

    def _energies(
        self, interior: np.ndarray, coupling: np.ndarray, corner: np.ndarray
    ) -> ConstraintModes:
        field = self.expand(interior, np.eye(3))
        return ConstraintModes(interior, field, self.energy_matrix(field), coupling, corner)

    @cached_property
    def connectivity(self) -> Connectivity:
        """Which cells share a facet, and which lie at the interfaces."""
        cells, space = self.operators.cells, self.operators.space
        return Connectivity(self.comm, space, cells, self.inboard, self.outboard)

    def _floats(self) -> bool:
        """Return whether void that is softer by orders of magnitude holds solid cells."""
        low, high = extremes(self.comm, self._young)
        return low < 0.1 / HARMLESS * high and self.connectivity.floats(self._young)

    def _lost_in_rounding(self) -> ConvergenceError:
        low, high = extremes(self.comm, self._young)
        return ConvergenceError(
            f"arm {self.mesh.name!r}: solid parts of the design float in a void "
            f"{low / high:.1g} times as stiff, lost in their rounding; raise "
            "interpolation.floor or design.minimum, or connect the design to both interfaces"
        )

    def _refined(self, modes: ConstraintModes) -> ConstraintModes:
        """Return constraint modes after one step of iterative refinement, if rounding allows.

        Solids that float in void, as checkerboards and islands do, rest on stiffnesses far below
        the rounding of their own. The residual is summed cell by cell without rigid motion, which
        knows them better than the assembled matrix.

        Raises:
            ConvergenceError: the void's stiffness is lost in the rounding of the solid's.
        """
        if not _is_stiffness(modes.stiffness):
            raise self._lost_in_rounding()
        values = self._on_cells(modes.field)
        forces = (self.operators.stiffness @ values) * self._young[:, None, None]
        forces = forces.reshape(*self.operators.cells.shape, 2, 3)
        better = modes.interior - self.solve(self.restrict(self._add_up(forces))[0])
        refined = self._energies(better, modes.coupling, modes.corner)
        if not (_is_stiffness(refined.stiffness) and self._rounding(refined) <= ROUNDED):
            raise self._lost_in_rounding()
        return refined

    def _rounding(self, modes: ConstraintModes) -> float:
        """Return an estimate of the relative error of S by rounding.

        An element matrix is known to eps times its diagonal D_e, so the energy of any field is to
        eps u' D u, and relative to it to eps times the largest eigenvalue of D u = mu T'KT u.
        Inverse iteration finds it from a start of random numbers: void that holds solids sets it
        orders of magnitude apart from all others. What it returns is too small only where mu
        exceeds 1 / eps, far beyond `ROUNDED`, because the factorised matrix is off by then.
        """
        diagonal = np.einsum("eii->ei", self.operators.stiffness) * self._young[:, None]
        diagonal = diagonal.reshape(*self.operators.cells.shape, 2, 1)

        def weighted(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Return T' D T u."""
            values = field[self.operators.cells]
            forces = diagonal * (values - kept * values.mean(axis=1, keepdims=True))
            forces -= kept * forces.mean(axis=1, keepdims=True)
            return self.restrict(self._add_up(forces))

        kept = 1.0 - TRANSLATION
        x, y = self.points.T / self.mesh.outboard_point[0]
        # By place, so that numbers are random and yet the same on any number of ranks.
        noise = np.sin(np.outer(1e4 * x + 7e4 * y + 1.0, [12.9898, 78.233])) * 43758.5453
        start = (np.modf(np.abs(noise))[0] - 0.5)[:, :, None]
        loads, outboard = weighted(
            self.expand(start[self.interior_nodes].reshape(-1, 1), np.full((3, 1), 0.5))
        )
        ratio = np.inf
        for _ in range(POWER_STEPS):
            lift = self.comm.allreduce(modes.interior.T @ loads)
            tip = np.linalg.solve(modes.stiffness, outboard + lift)
            interior = self.solve(loads) + modes.interior @ tip
            work = self.comm.allreduce(np.sum(interior * loads)) + np.sum(tip * outboard)
            loads, outboard = weighted(self.expand(interior, tip))
            energy = self.comm.allreduce(np.sum(interior * loads)) + np.sum(tip * outboard)
            ratio = abs(float(energy / work))
            scale = max(energy, np.finfo(float).tiny) ** -0.5
            loads, outboard = scale * loads, scale * outboard
        return ratio * float(np.finfo(float).eps)

    # -- cells -------------------------------------------------------------------------------

    def cell_stiffness_products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return sum_k left_k' k_e right_k (n_cells,) for nodal fields (n_nodes, 2, k).

        The derivative of left . K right with respect to Young's modulus of each owned cell.
        """
        self.ledger.counts.energy_fields += left.shape[2]
        return _cell_products(self.operators.stiffness, self._on_cells(left), self._on_cells(right))

    def cell_mass_products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return sum_k left_k' m_e right_k (n_cells,) for nodal fields (n_nodes, 2, k).

        The derivative of left . M right with respect to the mass density of each owned cell.
        """
        self.ledger.counts.energy_fields += left.shape[2]
        cells, mass = self.operators.cells, self.operators.mass
        shape = (*cells.shape, -1)  # both components and all columns alike
        return _cell_products(mass, left[cells].reshape(shape), right[cells].reshape(shape))

    def energy_matrix(self, field: np.ndarray) -> np.ndarray:
        """Return field' K field (k, k), summed over the ranks.

        Summed cell by cell: near a static equilibrium the error is then of second order in that
        of the field, and nothing cancels. K_bb + K_bI Psi, its algebraic equal for constraint
        modes, loses (length / cell)^3 in digits: 1e-9 at 200 cells along, against 1e-12 here.
        """
        values = self._on_cells(field)
        columns = field.shape[2]
        products = (self.operators.stiffness @ values) * self._young[:, None, None]
        energy = self.comm.allreduce(values.reshape(-1, columns).T @ products.reshape(-1, columns))
        return 0.5 * (energy + energy.T)

    def _add_up(self, forces: np.ndarray) -> np.ndarray:
        """Return the nodal field (n_nodes, 2, k) of the cells' forces (n_cells, n, 2, k)."""
        field = np.zeros((len(self.points), *forces.shape[2:]))
        np.add.at(field, self.operators.cells, forces)
        return field

    def _on_cells(self, field: np.ndarray) -> np.ndarray:
        """Return the cells' nodal values (n_cells, 2n, k) less their mean, which has no energy.

        Rounding is then relative to the differences within a cell, not to its displacement.
        """
        cells = self.operators.cells
        values = field[cells]
        values -= values.mean(axis=1, keepdims=True)
        return values.reshape(len(cells), 2 * cells.shape[1], field.shape[2])


def _is_stiffness(matrix: np.ndarray) -> bool:
    """Return whether a symmetric matrix is finite and positive definite."""
    if not np.isfinite(matrix).all():
        return False
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def _cell_products(elements: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return sum_k left' A_e right (n_cells,) for (n_cells, n, n) and (n_cells, n, k)."""
    return np.einsum("eik,eik->e", left, elements @ right)
