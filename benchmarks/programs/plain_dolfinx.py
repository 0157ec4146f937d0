"""A static design iteration as DOLFINx's own demos would make it, to measure ours beside it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem import petsc
from petsc4py import PETSc

from dolfinopt.fem.interior import with_rigid_motions
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh

PENALTY, FLOOR = 3.0, 1e-6  # of the interpolation

# Densities (n_cells,) -> compliance under a force across the end, N m, and its gradient.
Iteration = Callable[[np.ndarray], tuple[float, np.ndarray]]


def plain_statics(
    arm: ArmMesh, modulus: float, nu: float, area: float, tolerance: float = 1e-7
) -> Iteration:
    """Return the compliance of a cantilever as DOLFINx's own demos would find it (collective).

    Clamped at its inboard facets, 1 N over its end. Linear elements, no filter. In the plane MUMPS'
    Cholesky factor, the modulus times the thickness, and the area the height; in space conjugate
    gradients with GAMG from 0 to the tolerance, and energies of cells in place of the gradient.
    """
    mesh, d, in_plane = arm.mesh, arm.dim, arm.dim == 2
    space = compat.lagrange_space(mesh, 1, components=d)
    cellwise = getattr(fem, "functionspace", fem.FunctionSpace)(mesh, ("DG", 0))
    density, displacement = fem.Function(cellwise), fem.Function(space)
    a, b, w = ufl.TrialFunction(space), ufl.TestFunction(space), ufl.TestFunction(cellwise)
    # In the plane the law stands in the form, as one writes it; that doubles what an iteration
    # takes: quadrature allows for x**3.0 as if x varied in a cell. In space x is E itself.
    young = modulus * (FLOOR + (1.0 - FLOOR) * density**PENALTY) if in_plane else density
    slope = -modulus * PENALTY * (1.0 - FLOOR) * density ** (PENALTY - 1.0) if in_plane else 1.0
    shear, rest = 1.0 / (1.0 + nu), 1.0 - nu if in_plane else 1.0 - 2.0 * nu

    def energy(u: Any, v: Any) -> Any:  # of unit stiffness; plane stress in the plane
        strain, other = ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))
        stress = shear * strain + shear * nu / rest * ufl.tr(strain) * ufl.Identity(d)
        return ufl.inner(stress, other)

    end = ufl.gt(ufl.SpatialCoordinate(mesh)[0], (1.0 - 1e-9) * arm.outboard_point[0])
    stiffness = compat.compile_form(young * energy(a, b) * ufl.dx)
    gradient = compat.compile_form(slope * energy(displacement, displacement) * w * ufl.dx)
    dofs = fem.locate_dofs_topological(space, d - 1, arm.inboard_facets)
    clamp = fem.dirichletbc(np.zeros(d), dofs, space)
    force = ufl.conditional(end, 1.0 / area, 0.0) * b[1] * ufl.ds
    load = petsc.assemble_vector(compat.compile_form(force))
    load.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    petsc.set_bc(load, [clamp])
    solution, K = load.duplicate(), petsc.create_matrix(stiffness)
    solver = PETSc.KSP().create(arm.comm)
    solver.setType("preonly" if in_plane else "cg")
    solver.getPC().setType("cholesky" if in_plane else "gamg")
    if in_plane:
        solver.getPC().setFactorSolverType("mumps")
    solver.setTolerances(rtol=tolerance)

    def iterate(x: np.ndarray) -> tuple[float, np.ndarray]:
        density.x.array[: len(x)] = x if in_plane else modulus * (FLOOR + x**PENALTY)
        density.x.scatter_forward()
        K.zeroEntries()
        petsc.assemble_matrix(K, stiffness, bcs=[clamp])
        K.assemble()
        if in_plane:
            K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            K.setOption(PETSc.Mat.Option.SPD, True)
        else:  # tell GAMG what K does not resist
            owned = K.getLocalSize()[0] // 3
            with_rigid_motions(K, space.tabulate_dof_coordinates()[:owned])
        solver.setOperators(K)
        solver.solve(load, solution)
        displacement.x.array[: len(solution.array)] = solution.array
        displacement.x.scatter_forward()
        slopes = petsc.assemble_vector(gradient).array_r.copy()
        return float(load.dot(solution)), slopes

    return iterate
