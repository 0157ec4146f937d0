"""Seconds and memory of a design iteration of one solid link, beside DOLFINx."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import chain, product
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm, field_tolerance
from dolfinopt.bench.measure import Plan, in_processes, mpirun, program, timed
from dolfinopt.bench.panel import Diagram, Rows, Steps
from dolfinopt.fem.multigrid import MultigridSolver
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.mesh.budget import free_memory, solid_bytes
from dolfinopt.profiling import Profile
from dolfinopt.responses.sensitivity import esl_gradient, static_response, tip_gradient
from dolfinopt.scene.load import Scene

SIZE = LENGTH, HEIGHT, THICKNESS = 0.5, 0.04, 0.02  # m
MOVE = 0.05  # of densities from one design to the next
# Links from 2e4 to 1e6 dofs.
CELLS = (90, 9, 6), (120, 12, 8), (180, 18, 12), (260, 26, 17), (310, 31, 20), (362, 36, 24)
QUICK = (40, 4, 3), (60, 6, 4)
DYNAMIC, STATIC, PLAIN = "dolfinopt", "dolfinopt, one load", "plain DOLFINx, one load"
DESIGNS = "first design", "nearby design"
STATIC_CELLS = (64, 8, 8), (112, 16, 12), (156, 20, 16)  # under one load: three grids divide them
LOAD = 0.0, 1.0, 0.0, 0.0, 0.0, 0.0  # N across the end
Cells = tuple[int, int, int]
Found = tuple[int, str, list[float]]  # dofs of all ranks, solver, CPU seconds by design


def link_scene(scene: Scene, cells: Cells, static: bool = False) -> Scene:
    """Return the scene with one solid link, whatever its motion would be."""
    size = {"length": LENGTH, "height": HEIGHT, "thickness": THICKNESS, "cells": cells}
    arm = scene.arms[0].unchecked_copy({**size, "element": "incompatible", "passive": 0.02})
    tables = {
        "reduction": {"method": "craig-bampton", "coordinates": 6},
        "design": {"filter_radius": 1.5 * LENGTH / cells[0]},
        "objective": {"kind": "static"} if static else {},
    }
    changed = {key: getattr(scene, key).unchecked_copy(new) for key, new in tables.items()}
    return scene.unchecked_copy({"arms": (arm,), **changed})


def box_beam(centroid: np.ndarray) -> np.ndarray:
    """Return design variables (n,): solid around a core of nearly void."""
    y, z = centroid[:, 1] / HEIGHT, centroid[:, 2] / THICKNESS
    return np.where((np.abs(y) < 0.3) & (np.abs(z) < 0.25), 0.02, 0.9)


def _seconds(comm: MPI.Comm, action: Callable[[np.ndarray], Any], x: np.ndarray) -> float:
    """Return the CPU seconds of action(x), those of the slowest rank (collective)."""
    comm.Barrier()
    return float(comm.allreduce(timed(partial(action, x))[0], op=MPI.MAX))


def iterate_link(comm: MPI.Comm, scene: Scene, cells: Cells, static: bool = False) -> Found:
    """Return an iteration of this package: a first design and one nearby (collective).

    With its constraint modes and loads of the motion; if static, under one load.
    """
    arm = Arm(link_scene(scene, cells, static), 0, comm, Profile())

    def dynamic(x: np.ndarray) -> None:
        state = arm.state(arm.physical(x))
        _ = state.elastic.constraint_modes
        _ = state.body
        arm.backward(esl_gradient(state, np.eye(6)))

    def loaded(x: np.ndarray) -> None:
        state = arm.state(x)
        loads = static_response(state.elastic, np.array([LOAD])).loads
        tip_gradient(state, loads, loads)

    iterate = loaded if static else dynamic
    seconds = [_seconds(comm, iterate, x) for x in two_designs(arm.mesh.centroid)]
    parts = arm.substructure
    system = (parts.extended if static else None) or parts.interior
    return parts.T.num_dofs, system.solver.name, seconds


def plain_link(comm: MPI.Comm, scene: Scene, cells: Cells) -> Found:
    """Return a static iteration in plain DOLFINx: trilinear hexahedra, one load (collective)."""
    arm, solid = box_arm(comm, "link", SIZE, cells), scene.material_of(0)
    tolerance, area = field_tolerance(scene), HEIGHT * THICKNESS
    given = arm, solid.modulus, solid.ratio, area, tolerance
    plain = program("plain_dolfinx").plain_statics(*given)
    return nodal_dofs(cells), MultigridSolver.name, [_seconds(comm, plain, box_beam(arm.centroid))]


def nodal_dofs(cells: Cells) -> int:
    """Return the degrees of freedom of all nodes."""
    return 3 * math.prod(n + 1 for n in cells)


def two_designs(centroid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the box beam and a design nearby, (n,) each."""
    first = box_beam(centroid)
    moved = first + MOVE * np.sin(60.0 * centroid @ [1.0, 2.0, 3.0])
    return first, np.clip(moved, 1e-3, 1.0)


def _links(plan: Plan) -> Steps:
    def rows(who: str, cells: Cells, ranks: int) -> Rows:
        link = plain_link if who == PLAIN else iterate_link
        static = [True] * (who == STATIC)
        result, memory = in_processes(link, plan.scene, cells, *static, ranks=ranks)
        dofs, solver, by_design = result
        for design, seconds in zip(DESIGNS, by_design):  # of plain DOLFINx the first alone
            yield f"{who}, {design}", ranks, dofs, seconds, memory * 2**20 / 1e9, solver

    both = (QUICK, STATIC_CELLS[:1]) if plan.quick else (CELLS, STATIC_CELLS)
    for ranks, cells in product((1, 2) if mpirun() else (1,), chain(*both)):
        size = f"{' x '.join(map(str, cells))} cells, {ranks} rank{'s' * (ranks > 1)}"
        if solid_bytes(math.prod(cells), ranks) > free_memory():
            yield f"{size} need more memory than is free: left out", list
            continue
        for who in (STATIC,) if cells in STATIC_CELLS else (DYNAMIC, PLAIN):
            yield f"{who}, {size}", partial(rows, who, cells, ranks)


SOLID = Diagram(
    "solid",
    "One solid link: a design iteration against degrees of freedom",
    "what | ranks | dofs | iteration [s] | memory [GB] | solver",
    _links,
    "dofs",
    ("iteration [s]", "memory [GB]"),
    "what",
    "CPU seconds of the slowest rank; a box beam. The first design makes the factor or hierarchy, "
    f"a nearby one (densities moved by up to {MOVE:g}) starts from its fields; with loads of the "
    "motion, or of compliance under one load and its gradient. Plain DOLFINx: K, "
    "one load by conjugate gradients with GAMG to the same tolerance, energies.",
    each=("ranks",),
)
