"""One measurement of a solid link: a design iteration, or plain DOLFINx's static one.

`python -m dolfinopt.bench.solid_link WHO NX NY NZ SCENE.json`, also under mpirun, measures one of
`WHO` and prints one line of JSON; memory is then that of its own processes.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.fem import interior
from dolfinopt.fem.interior import ITERATIVE
from dolfinopt.scene.load import Scene, scene_from_dict

LENGTH, HEIGHT, THICKNESS = 0.5, 0.04, 0.02  # m
PHASES = ("filter", "assembly", "factorisation", "solves", "body", "gradient")
MOVE = 0.05  # of densities from one design to the next
# Who is measured: the solver that is chosen, either of both, or plain DOLFINx.
WHO = "ours", "factor", "iterative", "plain"


def link_scene(scene: Scene, cells: tuple[int, int, int]) -> Scene:
    """Return the scene with one solid link, whatever its motion would be."""
    size = {"length": LENGTH, "height": HEIGHT, "thickness": THICKNESS, "cells": cells}
    arm = scene.arms[0].model_copy(update={**size, "element": "incompatible", "passive": 0.02})
    reduction = scene.reduction.model_copy(update={"method": "craig-bampton", "coordinates": 6})
    radius = 1.5 * LENGTH / cells[0]
    design = scene.design.model_copy(update={"filter_radius": radius})
    return scene.model_copy(update={"arms": (arm,), "reduction": reduction, "design": design})


def box_beam(centroid: np.ndarray) -> np.ndarray:
    """Return design variables (n,): solid around a core of nearly void."""
    y, z = centroid[:, 1] / HEIGHT, centroid[:, 2] / THICKNESS
    return np.where((np.abs(y) < 0.3) & (np.abs(z) < 0.25), 0.02, 0.9)


def moved(x: np.ndarray, centroid: np.ndarray) -> np.ndarray:
    """Return the design variables of the next iteration."""
    return np.clip(x + MOVE * np.sin(60.0 * centroid @ [1.0, 2.0, 3.0]), 1e-3, 1.0)


class _Clock:
    """CPU seconds of parts; those of the slowest rank."""

    def __init__(self, comm: MPI.Comm):
        self.comm, self.seconds = comm, dict.fromkeys(PHASES, 0.0)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Time a block (collective)."""
        self.comm.Barrier()
        begun = time.process_time()
        yield
        self.seconds[name] += self.comm.allreduce(time.process_time() - begun, op=MPI.MAX)


@dataclass(frozen=True)
class Found:
    """What one measurement found.

    Attributes:
        dofs: of all ranks.
        solver: its name.
        phases: seconds of `PHASES`, of the first design and of one nearby.
    """

    dofs: int
    solver: str
    phases: list[list[float]]


def ours(scene: Scene, cells: tuple[int, int, int], comm: MPI.Comm) -> Found:
    """Return the seconds of an iteration of this package."""
    from dolfinopt.arms.arm import Arm
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.sensitivity import esl_gradient

    arm = Arm(link_scene(scene, cells), 0, comm, Profile())
    x, found = box_beam(arm.mesh.centroid), []
    for _ in range(2):
        clock = _Clock(comm)
        with clock.phase("filter"):
            x_phys = arm.physical(x)
        state = arm.state(x_phys)
        with clock.phase("assembly"):
            _ = state.elastic.K.matrix
        with clock.phase("factorisation"):
            state.elastic.factorise()
        with clock.phase("solves"):
            state.elastic.constraint_modes()
        with clock.phase("body"):
            _ = state.body
        with clock.phase("gradient"):
            gradient = esl_gradient(state, np.eye(6))
        with clock.phase("filter"):
            arm.backward(gradient)
        found.append(list(clock.seconds.values()))
        x = moved(x, arm.mesh.centroid)
    return Found(arm.substructure.T.num_dofs, arm.substructure.interior.solver_name, found)


def plain(scene: Scene, cells: tuple[int, int, int], comm: MPI.Comm) -> Found:
    """Return the seconds of a static iteration as DOLFINx's own demos would do it.

    Trilinear hexahedra, one load at the end, conjugate gradients with GAMG from zero to the same
    tolerance, the derivative of the compliance by every cell; no filter.
    """
    import ufl
    from dolfinx import fem
    from dolfinx.fem import petsc as assembly
    from petsc4py import PETSc

    from dolfinopt.arms.arm import field_tolerance
    from dolfinopt.fem.multigrid import with_rigid_motions
    from dolfinopt.mesh import compat
    from dolfinopt.mesh.arm_mesh import box_arm

    arm = box_arm(comm, "link", (LENGTH, HEIGHT, THICKNESS), cells)
    V, material = compat.lagrange_space(arm.mesh, 1, components=3), scene.material_of(0)
    nu, modulus = material.poisson_ratio, material.young_modulus
    W = (fem.FunctionSpace if compat.VERSION < (0, 7) else fem.functionspace)(arm.mesh, ("DG", 0))
    young, u = fem.Function(W), fem.Function(V)
    young.x.array[: arm.num_cells] = modulus * (1e-6 + box_beam(arm.centroid) ** 3)
    compat.scatter_forward(young)

    def strain(v: Any) -> Any:
        return ufl.sym(ufl.grad(v))

    def stress(v: Any) -> Any:
        shear = 1.0 / (2.0 * (1.0 + nu))
        first = nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
        return 2.0 * shear * strain(v) + first * ufl.tr(strain(v)) * ufl.Identity(3)

    a, b = ufl.TrialFunction(V), ufl.TestFunction(V)
    end = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(arm.mesh)[0], 0.999 * LENGTH), 1.0, 0.0)
    forms = [
        compat.compile_form(form)
        for form in (
            young * ufl.inner(stress(a), strain(b)) * ufl.dx,
            end * b[1] * ufl.ds,
            ufl.inner(stress(u), strain(u)) * ufl.TestFunction(W) * ufl.dx,
        )
    ]
    dofs = fem.locate_dofs_topological(V, 2, arm.inboard_facets)
    clamp = fem.dirichletbc(np.zeros(3), dofs, V)
    clock = _Clock(comm)
    with clock.phase("assembly"):
        K = assembly.assemble_matrix(forms[0], bcs=[clamp])
        K.assemble()
    with_rigid_motions(K, V.tabulate_dof_coordinates()[: K.getLocalSize()[0] // 3])
    right = assembly.assemble_vector(forms[1])
    right.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    assembly.set_bc(right, [clamp])
    ksp = PETSc.KSP().create(comm)
    ksp.setOperators(K)
    ksp.setType("cg")
    ksp.getPC().setType("gamg")
    ksp.setTolerances(rtol=field_tolerance(scene))
    with clock.phase("factorisation"):
        ksp.setUp()
    solution = K.createVecRight()
    with clock.phase("solves"):
        ksp.solve(right, solution)
    u.x.array[: len(solution.array)] = solution.array
    compat.scatter_forward(u)
    with clock.phase("gradient"):
        assembly.assemble_vector(forms[2])
    return Found(K.getSize()[0], ITERATIVE, [list(clock.seconds.values())])


def _main(words: Sequence[str]) -> None:
    comm, who = MPI.COMM_WORLD, words[0]
    cells = int(words[1]), int(words[2]), int(words[3])
    scene = scene_from_dict(json.loads(Path(words[4]).read_text(encoding="utf-8")))
    if who in ("factor", "iterative"):
        interior.WIDEST = 0 if who == "iterative" else sys.maxsize
    found = (plain if who == "plain" else ours)(scene, cells, comm)
    memory = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9)
    if comm.rank == 0:
        print(json.dumps({**asdict(found), "memory": memory}), flush=True)


if __name__ == "__main__":
    _main(sys.argv[1:])
