"""Error of the reduced model against coordinates and CPU seconds, every reduction method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dolfinopt.arms.arm import Arm
from dolfinopt.bench.common import Diagram, Plan, Row, Tell, bodies_of, curves, designs, timed
from dolfinopt.dynamics.simulation import simulate
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.profiling import Profile
from dolfinopt.reduction import METHODS
from dolfinopt.scene.load import Scene
from dolfinopt.study.tables import Panel
from dolfinopt.study.variants import changed, reduced

COUNTS = 3, 4, 5, 6, 8, 12, 16, 24, 32, 48
# More coordinates than any method compared has, and of the kind that converges surely.
REFERENCE = 100
QUICK_COUNTS, QUICK_REFERENCE = (3, 4, 6, 12), 32
# Of every motion here. The steps come out alike, so that what they leave cancels in the
# differences: methods were seen to agree to 1e-10.
TOLERANCE, STAGES = 1e-7, 5


def diagram() -> Diagram:
    """Return the diagram of the reduction methods."""
    return Diagram(
        "reduction",
        "Reducing the arms: error against coordinates and time",
        (
            "design",
            "method",
            "coordinates per arm",
            "seconds [s]",
            "error of compliance [-]",
            "error of deviation [-]",
        ),
        _measure,
        _panels,
        _notes,
        abreast=3,
    )


@dataclass(frozen=True, eq=False)
class Response:
    """What a reduced mechanism does: compliance of all arms (n,) N m, deviation (n, 2) m."""

    compliance: np.ndarray
    deviation: np.ndarray


def _response(scene: Scene, arms: dict[int, Arm], x_phys: dict[int, np.ndarray]) -> Response:
    trajectory = simulate(scene, bodies_of(scene, arms, x_phys), Profile()).sampled
    return Response(trajectory.compliance.sum(axis=1), trajectory.deviation)


def _measure(plan: Plan, tell: Tell) -> list[Row]:
    rows: list[Row] = []
    counts, most = (QUICK_COUNTS, QUICK_REFERENCE) if plan.quick else (COUNTS, REFERENCE)
    base = changed(plan.scene, f"simulation.tolerance={TOLERANCE}", f"simulation.stages={STAGES}")
    for label, (arms, x_phys) in designs(plan, tell).items():
        right = _response(reduced(base, "craig-bampton", most), arms, x_phys)
        for method in METHODS:
            for count in counts:
                tell(f"{method}, q = {count}, {label}")
                try:
                    scene = reduced(base, method, count)
                    seconds = _seconds(scene, arms, x_phys, plan)
                    found = _response(scene, arms, x_phys)
                except (ConvergenceError, InputError):
                    continue  # not possible with so few or many
                rows.append((label, method, count, seconds, *errors(found, right)))
    return rows


def _seconds(
    scene: Scene, arms: dict[int, Arm], x_phys: dict[int, np.ndarray], plan: Plan
) -> float:
    """Return CPU seconds of reducing all arms, from cold, their factorisation included."""

    seconds = []
    for _ in range(plan.repeats):
        for arm in arms.values():
            arm.set_design(np.full(arm.mesh.num_cells, 0.25))  # what was factorised is forgotten
        seconds.append(timed(lambda: bodies_of(scene, arms, x_phys), 1)[0])
    return min(seconds)


def errors(found: Response, right: Response) -> tuple[float, float]:
    """Return relative errors of the largest compliance, and of the deviation in time."""
    compliance = abs(found.compliance.max() / right.compliance.max() - 1.0)
    difference = np.linalg.norm(found.deviation - right.deviation, axis=1).max()
    return float(compliance), float(difference / np.linalg.norm(right.deviation, axis=1).max())


def _panels(rows: Sequence[Row]) -> tuple[Panel, ...]:
    panels = []
    for design in dict.fromkeys(row[0] for row in rows):
        here = [row for row in rows if row[0] == design]
        panels += [
            Panel(str(design), x, y, curves(here, 1, at, column))
            for x, at, y, column in (
                ("coordinates per arm [-]", 2, "error of compliance [-]", 4),
                ("coordinates per arm [-]", 2, "error of deviation [-]", 5),
                ("CPU time of the reduction [s]", 3, "error of deviation [-]", 5),
            )
        ]
    return tuple(panels)


def _notes(rows: Sequence[Row]) -> list[str]:
    notes = [
        f"Reference: Craig-Bampton with {REFERENCE} coordinates per arm ({QUICK_REFERENCE} in a "
        f"quick bench), more than any method has here; every motion simulated to {TOLERANCE:g}. "
        "Errors of the largest compliance of both arms, and of the deviation, largest in time "
        "over the largest value.",
        "Seconds of both arms from cold: assembly, factorisation, basis, inertia integrals.",
    ]
    for design in dict.fromkeys(row[0] for row in rows):
        others = [row for row in rows if row[0] == design and row[1] != "craig-bampton"]
        if others:
            near = min(others, key=lambda row: float(row[5]))
            notes.append(
                f"{design}: an independent basis, {near[1]} with {near[2]} coordinates, agrees "
                f"with the reference to {float(near[5]):.1e} of the deviation."
            )
        for goal in (1e-2, 1e-3, 1e-4, 1e-6):
            met = [row for row in rows if row[0] == design and float(row[5]) <= goal]
            if met:
                best = min(met, key=lambda row: float(row[3]))
                notes.append(
                    f"{design}, deviation to {goal:g}: cheapest is {best[1]} with {best[2]} "
                    f"coordinates, {float(best[3]):.3g} s."
                )
    return notes
