"""Thirteen problems from three starts each: what the optimiser makes of them, and what it takes.

Small meshes, so that all of them take minutes. A rod at speed stands beside the lightest straight
rod of uniform width that keeps the same limit.
"""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path
from typing import Any

from mpi4py import MPI
from scipy.optimize import brentq

from dolfinopt.arms.arm import uniform_design
from dolfinopt.bench.measure import Plan, arms_of, timed
from dolfinopt.bench.panel import Diagram, Frame, Rows, Steps
from dolfinopt.data import template_folder
from dolfinopt.output.run_folder import optimize
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import EXCESS
from dolfinopt.responses.evaluation import evaluate
from dolfinopt.scene.load import Scene, scene_from_dict, tomllib

Table = dict[str, Any]


@cache
def problems() -> dict[str, Table]:
    """Return the tables of every problem's scene, by its name."""
    with Path(__file__).with_suffix(".toml").open("rb") as file:
        machines = tomllib.load(file)
    given = machines.pop("problems")
    motion = machines["pick_and_place"]["motion"]
    motion["file"] = str(template_folder() / motion["file"])
    return {name: machines[one.pop("machine")] | one for name, one in given.items()}


ROD, BY_HAND = "lightest rod", "drawn by hand"
OVER = "objective over the best [-]"
STARTS = {"half": 0.5, "thin": 0.3, "thick": 0.8}  # initial densities, at most the volume's limit
ITERATIONS, FEW = 120, 3
HEIGHTS = 0.004, 0.02  # m, between which the straight rod keeps its limit


def posed(tables: Table, start: str, iterations: int) -> Scene:
    """Return the scene of a problem from one of the `STARTS`."""
    design = tables["design"]
    initial = min(STARTS[start], design.get("volume_fraction", 1.0))
    given = tables | {"optimizer": {"max_iterations": iterations}}
    # Without a limit of the volume none is stated: mass is the objective.
    return scene_from_dict(given | {"design": design | {"initial": initial}})


def solved(name: str, start: str, iterations: int) -> Rows:
    """Measure one problem from one start."""
    scene = posed(problems()[name], start, iterations)
    seconds, _, result = timed(partial(optimize, scene, world=MPI.COMM_SELF))
    excess = max((one.excess for one in result.limits), default=0.0)
    asked = result.iterations, result.counts.simulations, result.counts.adjoints
    found = result.evaluation.objective, excess, result.best_iteration
    yield name, start, *asked, *found, seconds, result.stop_reason.partition(":")[0]


def straight_rod() -> Rows:
    """Yield the lightest straight solid rod of uniform width that keeps the rod's limit."""
    tables = problems()[ROD]
    limit = tables["constraints"]["stress"]

    def looked_at(height: float) -> tuple[float, float]:
        """Return largest stress over its limit less 1, and mass, kg."""
        crank, rod = tables["arms"]
        straight = rod | {"height": height, "cells": [200, 8]}
        scene = posed(tables | {"arms": [crank, straight]}, "half", 0)
        arms, partition = arms_of(scene), partition_arms(MPI.COMM_SELF, scene.cell_counts)
        solid = uniform_design(scene, partition, arms, 1.0)
        found, _ = evaluate(scene, partition, arms, solid, Profile())
        (stress,) = found.values_of("stress")
        return stress / limit - 1.0, found.objective

    seconds, _, height = timed(lambda: brentq(lambda h: looked_at(h)[0], *HEIGHTS, xtol=1e-6))
    excess, mass = looked_at(height)
    yield ROD, BY_HAND, 0, 0, 0, mass, excess, 0, seconds, f"straight, {1e3 * height:.2f} mm high"


def _steps(plan: Plan) -> Steps:
    count = FEW if plan.quick else ITERATIONS
    yield "straight rod", straight_rod
    for start in list(STARTS)[: 1 if plan.quick else None]:
        for name in problems():
            yield f"{name}, {start}", partial(solved, name, start, count)


def compared(frame: Frame) -> Frame:
    """Return every objective over the best feasible one of its problem."""
    kept = frame[frame["largest excess [-]"] <= EXCESS]
    best = kept.groupby("problem")["objective"].min()
    return kept.assign(**{OVER: kept["objective"] / kept["problem"].map(best)})


DIAGRAM = Diagram(
    "optimiser",
    "Thirteen problems from three starts",
    "problem | start | iterations | evaluations | adjoints | objective | largest excess [-] | "
    "best iteration | CPU [s] | ending",
    _steps,
    "evaluations",
    (OVER,),
    "problem",
    "Objectives are of the design that is returned, kg, N m or m; the excess is the largest "
    f"relative violation of a limit, met up to 1e-3. At most {ITERATIONS} iterations from uniform "
    f"densities of {', '.join(map(str, STARTS.values()))}, less where the volume is limited.",
    drawn=compared,
)
