"""Thirteen problems from three starts each: what the optimiser makes of them, and what it takes.

Small meshes, so that all of them take minutes. A rod at speed stands beside the lightest straight
rod of uniform width that keeps the same limit.
"""

from __future__ import annotations

import time
from functools import cache, partial
from pathlib import Path
from typing import Any

import tomllib
from mpi4py import MPI
from scipy.optimize import brentq

from dolfinopt.arms.arm import uniform_design
from dolfinopt.bench.measure import Plan, arms_of
from dolfinopt.bench.panel import Diagram, Frame, Panel, Row, Rows, Steps
from dolfinopt.data import template_folder
from dolfinopt.output.run import optimize
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import EXCESS
from dolfinopt.responses.evaluation import evaluate
from dolfinopt.scene.load import Scene, scene_from_dict

CONTROL = {"feed_forward": "rigid", "stiffness": [2e5, 2e4, 2e4], "damping": [2e4, 600.0, 600.0]}

Table = dict[str, Any]


@cache
def _machines() -> Table:
    with Path(__file__).with_suffix(".toml").open("rb") as file:
        machines = tomllib.load(file)
    motion = machines["pick_and_place"]["motion"]
    motion["file"] = str(template_folder() / motion["file"])
    return machines


def _problem(
    machine: str, asked: tuple[Table, Table], limits: Table | None = None, **tables: Any
) -> Table:
    """Return a scene's tables; `asked` are those of the objective and of the design."""
    objective, design = asked
    given = _machines()[machine] | {"objective": objective, "design": design} | tables
    return given | ({"constraints": limits} if limits else {})


def _mass(radius: float, exponent: float | None = None) -> tuple[Table, Table]:
    more = {} if exponent is None else {"stress_exponent": exponent}
    return {"kind": "mass", "gradient": "exact", **more}, {"filter_radius": radius}


def _volume(
    kind: str, radius: float, share: float = 0.5, gradient: str = "exact", **more: Any
) -> tuple[Table, Table]:
    objective = {"kind": kind, "gradient": gradient}
    return objective, {"filter_radius": radius, "volume_fraction": share, **more}


def problems() -> dict[str, Table]:
    """Return the tables of every problem, by its name."""
    objective, design = _mass(0.015)
    # As crisp as 120 iterations allow.
    robust = objective, design | {"projection": "robust", "sharpness": 32.0}
    of_rod, widths = _mass(0.003)
    crisp_rod = of_rod, widths | {"projection": "heaviside"}  # grey edges weigh and do not carry
    settled = {"deviation": 8e-3, "settling": 1e-3, "stress": 60e6}
    rested = {"deviation": 5e-4, "settling": 5e-5, "stress": 60e6}
    crisp = {"deviation": 5e-4, "stress": 60e6}
    frozen = _volume("compliance", 0.02, gradient="esl")
    return {
        "frozen loads": _problem("two_arms", frozen),
        "deviation": _problem("two_arms", _volume("deviation", 0.02)),
        "controlled": _problem("two_arms", _volume("deviation", 0.02), control=CONTROL),
        "pick and place": _problem("pick_and_place", _volume("compliance", 0.017, 0.4)),
        "four-bar": _problem("four_bar", _volume("compliance", 0.008, shared_volume=True)),
        "lightest two arms": _problem("two_arms", _mass(0.02), settled),
        "lightest SCARA": _problem("scara", _mass(0.0075), rested),
        "lightest SCARA, robust": _problem("scara", robust, crisp),
        ROD: _problem("rod", crisp_rod, {"stress": 90e6}),
        "stress, p = 4": _problem("two_arms", _mass(0.02, 4.0), {"stress": 40e6}),
        "stress, p = 16": _problem("two_arms", _mass(0.02, 16.0), {"stress": 40e6}),
        "space": _problem("space", _volume("compliance", 0.025, 0.6)),
        "lightest in space": _problem("space", _mass(0.025), {"deviation": 8e-3}),
    }


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
    begun = time.process_time()
    result = optimize(posed(problems()[name], start, iterations), world=MPI.COMM_SELF)
    seconds = time.process_time() - begun
    excess = max((one.excess for one in result.limits), default=0.0)
    yield (
        name,
        start,
        result.iterations,
        result.counts.simulations,
        result.counts.adjoints,
        result.evaluation.objective,
        excess,
        result.best_iteration,
        seconds,
        result.stop_reason.partition(":")[0],
    )


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

    begun = time.process_time()
    height = brentq(lambda h: looked_at(h)[0], *HEIGHTS, xtol=1e-6)
    excess, mass = looked_at(height)
    seconds = time.process_time() - begun
    ending = f"straight, {1e3 * height:.2f} mm high"
    yield ROD, BY_HAND, 0, 0, 0, mass, excess, 0, seconds, ending


def _steps(plan: Plan) -> Steps:
    count = FEW if plan.quick else ITERATIONS
    yield "straight rod", straight_rod
    for start in list(STARTS)[: 1 if plan.quick else None]:
        for name in problems():
            yield f"{name}, {start}", partial(_one, name, start, count)


def _one(name: str, start: str, count: int) -> list[Row]:
    return list(solved(name, start, count))


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
    (Panel("evaluations", OVER, "problem", rows=compared),),
    "The objective is that of the design that is returned, in its unit: mass in kg, compliance in "
    "N m, deviation in m. The excess is the largest relative violation of a limit by its true "
    "value; up to 1e-3 a limit counts as met. Runs have at most "
    f"{ITERATIONS} iterations from uniform densities of {', '.join(map(str, STARTS.values()))}, "
    "less where the volume is limited. A straight rod of uniform width, the lightest that keeps "
    "the limit, stands beside the rod.",
)
