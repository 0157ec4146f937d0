"""Seconds and memory of a design iteration of one solid link, beside plain DOLFINx."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from functools import partial
from itertools import compress
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm, field_tolerance
from dolfinopt.bench.measure import Plan, in_processes, mpirun
from dolfinopt.bench.panel import Diagram, Frame, Panel, Rows, Steps
from dolfinopt.bench.programs import PlainStatics
from dolfinopt.fem import interior
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.mesh.budget import free_memory, solid_bytes
from dolfinopt.profiling import Profile
from dolfinopt.responses.sensitivity import esl_gradient
from dolfinopt.scene.load import Scene

SIZE = LENGTH, HEIGHT, THICKNESS = 0.5, 0.04, 0.02  # m
PHASES = "filter", "assembly", "factorisation", "solves", "body", "gradient"
MOVE = 0.05  # of densities from one design to the next
# Links from 2e4 to 1e6 dofs.
CELLS = (90, 9, 6), (120, 12, 8), (180, 18, 12), (260, 26, 17), (362, 36, 24)
QUICK = (40, 4, 3), (60, 6, 4)
# Both solvers beside each other where the choice between them is made.
COMPARED = (90, 9, 6), (120, 12, 8), (150, 15, 10), (180, 18, 12), (220, 22, 14)
COLD, WARM = "first design", "nearby design"
# Who is measured: the solver that is chosen, plain DOLFINx, or one of both solvers.
OURS, PLAIN, FACTOR = "dolfinopt, q = 6", "plain DOLFINx, one load", "factor"
ITERATIVE = interior.ITERATIVE

Cells = tuple[int, int, int]
Found = dict[str, Any]  # "dofs" of all ranks, "solver" and "phases", seconds of `PHASES` by design


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


class _Clock:
    """CPU seconds of parts; those of the slowest rank."""

    def __init__(self, comm: MPI.Comm):
        self.comm, self.seconds = comm, dict.fromkeys(PHASES, 0.0)

    def __call__(self, phase: str, step: Callable[..., Any], *given: Any) -> Any:
        """Return what step(*given) does (collective)."""
        self.comm.Barrier()
        begun = time.process_time()
        found = step(*given)
        self.seconds[phase] += self.comm.allreduce(time.process_time() - begun, op=MPI.MAX)
        return found


def iterate_link(comm: MPI.Comm, scene: Scene, cells: Cells, who: str) -> Found:
    """Return an iteration of this package: a first design and one nearby (collective)."""
    if who != OURS:
        interior.WIDEST = 0 if who == ITERATIVE else sys.maxsize
    arm = Arm(link_scene(scene, cells), 0, comm, Profile())
    x, found = box_beam(arm.mesh.centroid), []
    for _ in range(2):
        clock = _Clock(comm)
        state = arm.state(clock("filter", arm.physical, x))
        clock("assembly", lambda state: state.elastic.K.matrix, state)
        clock("factorisation", state.elastic.factorise)
        clock("solves", state.elastic.constraint_modes)
        clock("body", lambda state: state.body, state)
        gradient = clock("gradient", esl_gradient, state, np.eye(6))
        clock("filter", arm.backward, gradient)
        found.append(list(clock.seconds.values()))
        x = np.clip(x + MOVE * np.sin(60.0 * arm.mesh.centroid @ [1.0, 2.0, 3.0]), 1e-3, 1.0)
    solver = arm.substructure.interior.solver_name
    return {"dofs": arm.substructure.T.num_dofs, "solver": solver, "phases": found}


def plain_link(comm: MPI.Comm, scene: Scene, cells: Cells, who: str) -> Found:
    """Return a static iteration in plain DOLFINx: trilinear hexahedra, one load (collective)."""
    arm, solid, clock = box_arm(comm, "link", SIZE, cells), scene.material_of(0), _Clock(comm)
    elastic = solid.young_modulus, solid.poisson_ratio
    plain = PlainStatics(arm, *elastic, HEIGHT * THICKNESS, field_tolerance(scene))
    clock("assembly", plain.assemble, box_beam(arm.centroid))
    plain.add_rigid_motions()
    clock("factorisation", plain.factorise)
    clock("solves", plain.solve)
    clock("gradient", plain.gradient)
    phases = [list(clock.seconds.values())]
    return {"dofs": plain.load.getSize(), "solver": ITERATIVE, "phases": phases}


def _steps(plan: Plan) -> Steps:
    def rows(who: str, cells: Cells, ranks: int) -> Rows:
        function = plain_link if who == PLAIN else iterate_link
        found, memory = in_processes(function, plan.scene, cells, who, ranks=ranks)
        names = [PLAIN] if who == PLAIN else [f"{who}, {COLD}", f"{who}, {WARM}"]
        for name, phases in zip(names, found["phases"], strict=True):
            rest = found["dofs"], sum(phases), *phases, memory * 2**20 / 1e9, found["solver"]
            yield name, ranks, *rest

    sizes, compared = (QUICK, QUICK[:1]) if plan.quick else (CELLS, COMPARED)
    every = (1, 2) if mpirun() else (1,)
    asked = [(who, cells, n) for n in every for cells in sizes for who in (OURS, PLAIN)]
    asked += [(who, cells, 1) for cells in compared for who in (FACTOR, ITERATIVE)]
    fits = [solid_bytes(math.prod(cells), ranks) <= free_memory() for _, cells, ranks in asked]
    if large := fits.count(False):
        yield f"{large} measurements need more memory than is free: left out", list
    for who, cells, ranks in compress(asked, fits):
        size = f"{' x '.join(map(str, cells))} cells, {ranks} rank{'s' * (ranks > 1)}"
        yield f"{who}, {size}", partial(rows, who, cells, ranks)


def _of(*who: str) -> Callable[[Frame], Frame]:
    return lambda frame: frame[frame["what"].str.startswith(who)]


def _phases(frame: Frame) -> Frame:
    """Return the phases of first designs, a row each."""
    first = frame[frame["what"] == f"{OURS}, {COLD}"]
    names = [f"{phase} [s]" for phase in PHASES]
    return first.melt(["ranks", "dofs"], names, var_name="phase", value_name="seconds [s]")


DIAGRAM = Diagram(
    "solid",
    "One solid link: a design iteration against degrees of freedom",
    f"what | ranks | dofs | iteration [s] | {' | '.join(f'{p} [s]' for p in PHASES)} | "
    "memory [GB] | solver",
    _steps,
    (
        Panel("dofs", "iteration [s]", "what", each=("ranks",), rows=_of(OURS, PLAIN), powers=True),
        Panel("dofs", "iteration [s]", "what", "one rank", rows=_of(FACTOR, ITERATIVE)),
        Panel("dofs", "memory [GB]", "what", "peak", each=("ranks",), rows=_of(OURS, PLAIN)),
        Panel("dofs", "seconds [s]", "phase", f"phases, {COLD}", each=("ranks",), rows=_phases),
    ),
    "CPU seconds of the slowest rank; a box beam. The first design makes the factor or hierarchy, "
    f"a nearby one (densities moved by up to {MOVE:g}) starts from its fields. Plain DOLFINx: K, "
    "one load by conjugate gradients with GAMG to the same tolerance, energies. Factors are made "
    f"up to a bandwidth of {interior.WIDEST}, where memory allows.",
)
