"""Seconds and memory of a design iteration of one solid link, beside plain DOLFINx."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.bench.diagram import Diagram, Frame, Panel, Plan, Rows, Steps
from dolfinopt.bench.measure import in_processes, mpirun
from dolfinopt.bench.programs import PlainStatics
from dolfinopt.fem import interior
from dolfinopt.fem.interior import ITERATIVE
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.mesh.budget import free_memory, solid_bytes
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
OURS, PLAIN = "dolfinopt, q = 6", "plain DOLFINx, one load"
# Who is measured: the solver that is chosen, either of both, or plain DOLFINx.
WHO = {"ours": OURS, "factor": "factor", "iterative": ITERATIVE, "plain": PLAIN}

Found = dict[str, Any]  # "dofs" of all ranks, "solver" and "phases", seconds of `PHASES` by design


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


class _Clock:
    """CPU seconds of parts; those of the slowest rank."""

    def __init__(self, comm: MPI.Comm):
        self.comm, self.seconds = comm, dict.fromkeys(PHASES, 0.0)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a block (collective)."""
        self.comm.Barrier()
        begun = time.process_time()
        yield
        self.seconds[name] += self.comm.allreduce(time.process_time() - begun, op=MPI.MAX)


def iterate_link(comm: MPI.Comm, scene: Scene, cells: tuple[int, int, int], who: str) -> Found:
    """Return an iteration of this package: a first design and one nearby (collective)."""
    from dolfinopt.arms.arm import Arm
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.sensitivity import esl_gradient

    if who != "ours":
        interior.WIDEST = 0 if who == "iterative" else sys.maxsize
    arm = Arm(link_scene(scene, cells), 0, comm, Profile())
    x, found = box_beam(arm.mesh.centroid), []
    for _ in range(2):
        clock = _Clock(comm)
        with clock("filter"):
            x_phys = arm.physical(x)
        state = arm.state(x_phys)
        with clock("assembly"):
            _ = state.elastic.K.matrix
        with clock("factorisation"):
            state.elastic.factorise()
        with clock("solves"):
            state.elastic.constraint_modes()
        with clock("body"):
            _ = state.body
        with clock("gradient"):
            gradient = esl_gradient(state, np.eye(6))
        with clock("filter"):
            arm.backward(gradient)
        found.append(list(clock.seconds.values()))
        x = np.clip(x + MOVE * np.sin(60.0 * arm.mesh.centroid @ [1.0, 2.0, 3.0]), 1e-3, 1.0)
    solver = arm.substructure.interior.solver_name
    return {"dofs": arm.substructure.T.num_dofs, "solver": solver, "phases": found}


def plain_link(comm: MPI.Comm, scene: Scene, cells: tuple[int, int, int], who: str) -> Found:
    """Return a static iteration in plain DOLFINx: trilinear hexahedra, one load (collective)."""
    from dolfinopt.arms.arm import field_tolerance

    arm, material, clock = box_arm(comm, "link", SIZE, cells), scene.material_of(0), _Clock(comm)
    plain = PlainStatics(
        arm, material.young_modulus, material.poisson_ratio, HEIGHT * THICKNESS,
        field_tolerance(scene),
    )  # fmt: skip
    x = box_beam(arm.centroid)
    with clock("assembly"):
        plain.assemble(x)
    plain.add_rigid_motions()
    with clock("factorisation"):
        plain.factorise()
    with clock("solves"):
        plain.solve()
    with clock("gradient"):
        plain.gradient()
    dofs = plain.load.getSize()
    return {"dofs": dofs, "solver": ITERATIVE, "phases": [list(clock.seconds.values())]}


def _steps(plan: Plan) -> Steps:
    def rows(who: str, cells: tuple[int, int, int], ranks: int) -> Rows:
        function = plain_link if who == "plain" else iterate_link
        found, memory = in_processes(function, plan.scene, cells, who, ranks=ranks)
        names = [PLAIN] if who == "plain" else [f"{WHO[who]}, {COLD}", f"{WHO[who]}, {WARM}"]
        for name, phases in zip(names, found["phases"], strict=True):
            rest = found["dofs"], sum(phases), *phases, memory * 2**20 / 1e9, found["solver"]
            yield name, ranks, *rest

    sizes, compared = (QUICK, QUICK[:1]) if plan.quick else (CELLS, COMPARED)
    asked = [
        (who, cells, ranks)
        for ranks in ((1, 2) if mpirun() else (1,))
        for cells in sizes
        for who in ("ours", "plain")
    ]
    asked += [(who, cells, 1) for cells in compared for who in ("factor", "iterative")]
    free = free_memory()
    large = [one for one in asked if solid_bytes(math.prod(one[1]), one[2]) > free]
    if large:
        yield f"{len(large)} measurements need more memory than is free: left out", list
    for who, cells, ranks in (one for one in asked if one not in large):
        size = f"{' x '.join(map(str, cells))} cells, {ranks} rank{'s' * (ranks > 1)}"
        yield f"{WHO[who]}, {size}", partial(rows, who, cells, ranks)


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
        Panel("dofs", "iteration [s]", "what", "one rank", rows=_of("factor", ITERATIVE)),
        Panel("dofs", "memory [GB]", "what", "peak", each=("ranks",), rows=_of(OURS, PLAIN)),
        Panel("dofs", "seconds [s]", "phase", f"phases, {COLD}", each=("ranks",), rows=_phases),
    ),
    "CPU seconds of the slowest rank; a box beam with a core of nearly void. The first design "
    f"makes the factor or hierarchy, a nearby one (densities moved by up to {MOVE:g}) starts from "
    "its fields: filter, K, six interface fields, body, energies. Plain DOLFINx: K, one load by "
    "conjugate gradients with GAMG to the same tolerance, energies. Factors are made up to a "
    f"bandwidth of {interior.WIDEST}, where memory allows.",
)
