"""One static compliance iteration of one arm, as others do it: plain DOLFINx, and pyMOTO."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from dolfinopt.bench.mesh import grid_arm
from dolfinopt.mesh import compat

PENALTY, FLOOR = 3.0, 1e-6


@dataclass(frozen=True)
class StaticArm:
    """A cantilever of length, height, thickness (m), cells along and across, and its material."""

    length: float
    height: float
    thickness: float
    cells: tuple[int, int]
    young_modulus: float
    poisson_ratio: float


# Densities (n_cells,) -> compliance under a unit force across the end, spread over it, N m, and
# its gradient by every density.
Iteration = Callable[[np.ndarray], tuple[float, np.ndarray]]


def dolfinx_iteration(arm: StaticArm) -> Iteration:
    """Return an iteration in plain DOLFINx: reassembled form, MUMPS Cholesky through PETSc."""
    from dolfinx.fem import petsc

    grid = grid_arm(arm.length, arm.height, arm.cells)
    mesh = grid.mesh
    space = compat.lagrange_space(mesh, 1, components=2)
    cellwise = _cellwise(mesh)
    density, displacement = fem.Function(cellwise), fem.Function(space)
    u, v, w = ufl.TrialFunction(space), ufl.TestFunction(space), ufl.TestFunction(cellwise)
    nu = arm.poisson_ratio
    law = FLOOR + (1.0 - FLOOR) * density**PENALTY
    by_density = PENALTY * (1.0 - FLOOR) * density ** (PENALTY - 1.0)

    def strain(a: Any) -> Any:
        return ufl.sym(ufl.grad(a))

    def stress(a: Any) -> Any:
        trace = ufl.tr(strain(a)) * ufl.Identity(2)
        factor = arm.thickness * arm.young_modulus / (1 - nu**2)
        return factor * ((1 - nu) * strain(a) + nu * trace)

    bilinear = compat.compile_form(law * ufl.inner(stress(u), strain(v)) * ufl.dx)
    gradient = compat.compile_form(
        -by_density * ufl.inner(stress(displacement), strain(displacement)) * w * ufl.dx
    )
    x = ufl.SpatialCoordinate(mesh)
    end = ufl.conditional(ufl.gt(x[0], arm.length * (1 - 1e-9)), 1.0 / arm.height, 0.0)
    load = petsc.assemble_vector(compat.compile_form(end * v[1] * ufl.ds))
    fixed = fem.locate_dofs_topological(space, 1, grid.inboard_facets.astype(np.int32))
    clamp = fem.dirichletbc(np.zeros(2), fixed, space)
    load.array[(2 * fixed[:, None] + np.arange(2)).ravel()] = 0.0
    matrix = petsc.create_matrix(bilinear)
    ksp = PETSc.KSP().create(MPI.COMM_SELF)
    ksp.setType(PETSc.KSP.Type.PREONLY)
    ksp.getPC().setType(PETSc.PC.Type.CHOLESKY)
    ksp.getPC().setFactorSolverType("mumps")
    solution = load.duplicate()

    def iterate(densities: np.ndarray) -> tuple[float, np.ndarray]:
        density.x.array[:] = densities
        matrix.zeroEntries()
        petsc.assemble_matrix(matrix, bilinear, bcs=[clamp])
        matrix.assemble()
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        matrix.setOption(PETSc.Mat.Option.SPD, True)
        ksp.setOperators(matrix)
        ksp.solve(load, solution)
        displacement.x.array[:] = solution.array_r
        return float(load.dot(solution)), petsc.assemble_vector(gradient).array_r.copy()

    return iterate


def _cellwise(mesh: Any) -> Any:
    make = fem.functionspace if hasattr(fem, "functionspace") else fem.FunctionSpace
    return make(mesh, ("DG", 0))


def pymoto_iteration(arm: StaticArm) -> Iteration | None:
    """Return the same in pyMOTO's modules, with the solver it chooses; None without pyMOTO.

    Source: pyMOTO, https://github.com/aatmdelissen/pyMOTO, version 1.5.
    """
    try:
        import pymoto as pym
    except ImportError:
        return None
    along, across = arm.cells
    sizes = arm.length / along, arm.height / across
    domain = pym.DomainDefinition(
        along, across, unitx=sizes[0], unity=sizes[1], unitz=arm.thickness
    )
    rows = np.arange(across + 1)
    left, right = domain.get_nodenumber(0, rows), domain.get_nodenumber(along, rows)
    fixed = (2 * left[:, None] + np.arange(2)).ravel()
    force = np.zeros(2 * domain.nnodes)
    share = np.full(across + 1, 1.0 / across)
    share[[0, -1]] *= 0.5
    force[2 * right + 1] = share
    density, load = pym.Signal("x", np.ones(domain.nel)), pym.Signal("f", force)
    stiff, matrix = pym.Signal("s"), pym.Signal("K")
    displacement, compliance = pym.Signal("u"), pym.Signal("c")
    network = pym.Network(
        pym.MathGeneral(
            density, stiff, expression=f"{FLOOR} + {1.0 - FLOOR} * inp0^{PENALTY:g}"
        ),
        pym.AssembleStiffness(
            stiff, matrix, domain=domain, bc=fixed, plane="stress",
            e_modulus=arm.young_modulus, poisson_ratio=arm.poisson_ratio,
        ),
        pym.LinSolve([matrix, load], displacement),
        pym.EinSum([displacement, load], compliance, expression="i,i->"),
    )  # fmt: skip

    def iterate(densities: np.ndarray) -> tuple[float, np.ndarray]:
        network.reset()
        density.state = densities
        network.response()
        compliance.sensitivity = 1.0
        network.sensitivity()
        return float(compliance.state), np.asarray(density.sensitivity)

    return iterate
