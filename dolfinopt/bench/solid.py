"""Seconds and memory of a design iteration of one solid link, beside plain DOLFINx."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm, field_tolerance
from dolfinopt.bench.measure import Plan, in_processes, mpirun
from dolfinopt.bench.panel import Diagram, Rows, Steps
from dolfinopt.bench.programs import PlainStatics
from dolfinopt.fem import interior
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.mesh.budget import free_memory, solid_bytes
from dolfinopt.profiling import Profile
from dolfinopt.responses.sensitivity import esl_gradient
from dolfinopt.scene.load import Scene

SIZE = LENGTH, HEIGHT, THICKNESS = 0.5, 0.04, 0.02  # m
MOVE = 0.05  # of densities from one design to the next
# Links from 2e4 to 1e6 dofs.
CELLS = (90, 9, 6), (120, 12, 8), (180, 18, 12), (260, 26, 17), (310, 31, 20), (362, 36, 24)
QUICK = (40, 4, 3), (60, 6, 4)
OURS = COLD, WARM = "dolfinopt, first design", "dolfinopt, nearby design"
PLAIN = "plain DOLFINx, one load"
ITERATIVE = interior.ITERATIVE

Cells = tuple[int, int, int]
Found = tuple[int, str, list[float]]  # dofs of all ranks, solver, CPU seconds by design


def link_scene(scene: Scene, cells: Cells) -> Scene:
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


def _seconds(comm: MPI.Comm, action: Callable[[np.ndarray], Any], x: np.ndarray) -> float:
    """Return the CPU seconds of action(x), those of the slowest rank (collective)."""
    comm.Barrier()
    begun = time.process_time()
    action(x)
    return float(comm.allreduce(time.process_time() - begun, op=MPI.MAX))


def iterate_link(comm: MPI.Comm, scene: Scene, cells: Cells) -> Found:
    """Return an iteration of this package: a first design and one nearby (collective)."""
    arm = Arm(link_scene(scene, cells), 0, comm, Profile())

    def iterate(x: np.ndarray) -> None:
        state = arm.state(arm.physical(x))
        state.elastic.constraint_modes()
        _ = state.body
        arm.backward(esl_gradient(state, np.eye(6)))

    first = box_beam(arm.mesh.centroid)
    moved = first + MOVE * np.sin(60.0 * arm.mesh.centroid @ [1.0, 2.0, 3.0])
    found = [_seconds(comm, iterate, x) for x in (first, np.clip(moved, 1e-3, 1.0))]
    return arm.substructure.T.num_dofs, arm.substructure.interior.solver_name, found


def plain_link(comm: MPI.Comm, scene: Scene, cells: Cells) -> Found:
    """Return a static iteration in plain DOLFINx: trilinear hexahedra, one load (collective)."""
    arm, solid = box_arm(comm, "link", SIZE, cells), scene.material_of(0)
    elastic = solid.young_modulus, solid.poisson_ratio
    plain = PlainStatics(arm, *elastic, HEIGHT * THICKNESS, field_tolerance(scene))
    return plain.load.getSize(), ITERATIVE, [_seconds(comm, plain, box_beam(arm.centroid))]


def _steps(plan: Plan) -> Steps:
    def rows(link: Callable[..., Found], cells: Cells, ranks: int) -> Rows:
        (dofs, solver, found), memory = in_processes(link, plan.scene, cells, ranks=ranks)
        for name, seconds in zip(OURS if link is iterate_link else [PLAIN], found, strict=True):
            yield name, ranks, dofs, seconds, memory * 2**20 / 1e9, solver

    for ranks, cells in product((1, 2) if mpirun() else (1,), QUICK if plan.quick else CELLS):
        size = f"{' x '.join(map(str, cells))} cells, {ranks} rank{'s' * (ranks > 1)}"
        if solid_bytes(math.prod(cells), ranks) > free_memory():
            yield f"{size} need more memory than is free: left out", list
            continue
        for who, link in (("dolfinopt", iterate_link), (PLAIN, plain_link)):
            yield f"{who}, {size}", partial(rows, link, cells, ranks)


DIAGRAM = Diagram(
    "solid",
    "One solid link: a design iteration against degrees of freedom",
    "what | ranks | dofs | iteration [s] | memory [GB] | solver",
    _steps,
    "dofs",
    ("iteration [s]", "memory [GB]"),
    "what",
    "CPU seconds of the slowest rank; a box beam. The first design makes the factor or hierarchy, "
    f"a nearby one (densities moved by up to {MOVE:g}) starts from its fields. Plain DOLFINx: K, "
    "one load by conjugate gradients with GAMG to the same tolerance, energies.",
    each=("ranks",),
)
