"""One pass down the street: physical densities -> bodies -> simulation -> objective."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.body import first_frequency
from dolfinopt.integrators.problem import Solution
from dolfinopt.ledger import Ledger
from dolfinopt.mechanism import BodySlopes
from dolfinopt.objective import (
    body_slopes_of,
    load_cases,
    objective,
    second_moments,
    worst_instants,
)
from dolfinopt.parallel import ArmShare, gather_bodies, on_root
from dolfinopt.scene import Scene
from dolfinopt.sensitivity import esl_gradient, exact_gradient
from dolfinopt.simulation import Trajectory, simulate

if TYPE_CHECKING:
    from dolfinopt.arm import Arm


@dataclass(frozen=True)
class Evaluation:
    """What one design does; the same on all ranks.

    Attributes:
        objective: see `objective.objective`; N m, N m s or m.
        compliance: sum of the load cases' compliance, whatever the objective, N m.
        max_deviation, max_deviation_time: m, s.
        first_frequencies: of every arm, clamped-free, Hz.
        error: estimated relative error of the elastic coordinates.
    """

    objective: float
    compliance: float
    max_deviation: float
    max_deviation_time: float
    first_frequencies: tuple[float, ...]
    error: float


def evaluate(
    scene: Scene,
    share: ArmShare,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
    ledger: Ledger,
    start: Solution | None = None,
) -> tuple[Evaluation, Trajectory | None]:
    """Reduce every arm, simulate on the root, evaluate the objective (collective).

    Args:
        scene: what is simulated and minimised.
        share: which ranks do which arm.
        arms: this rank's.
        x_phys: their physical densities (n_cells,).
        ledger: of this rank.
        start: solution of a nearby design; read on the root only.

    Returns:
        The evaluation, and on the root the trajectory.

    Raises:
        ConvergenceError: on all ranks alike.
    """
    mine = {index: arm.reduce(x_phys[index]) for index, arm in arms.items()}
    bodies = gather_bodies(share, mine)
    kept: list[Trajectory] = []

    def run() -> Evaluation:
        trajectory = simulate(scene, bodies, ledger, start)
        kept.append(trajectory)
        with ledger.phase("objective"):
            worst = worst_instants(trajectory, scene.objective.load_cases)
            distance, when = trajectory.max_deviation
            return Evaluation(
                objective=objective(trajectory, scene),
                compliance=float(trajectory.compliance[worst].sum()),
                max_deviation=distance,
                max_deviation_time=when,
                first_frequencies=tuple(first_frequency(body) for body in bodies),
                error=trajectory.solution.error,
            )

    evaluation = on_root(share.world, run)
    return evaluation, kept[0] if kept else None


def gradient(
    scene: Scene,
    share: ArmShare,
    arms: Mapping[int, Arm],
    trajectory: Trajectory | None,
    ledger: Ledger,
) -> dict[int, np.ndarray]:
    """Return the objective's gradient by the physical densities of this rank's arms (collective).

    Args:
        scene: says which gradient: "esl" freezes the loads, "exact" follows everything.
        share, arms: as for `evaluate`, with the design reduced.
        trajectory: what `evaluate` returned.
        ledger: of this rank.
    """

    def moments() -> list[np.ndarray]:
        assert trajectory is not None
        return second_moments(trajectory, load_cases(trajectory, scene))

    def slopes() -> list[BodySlopes]:
        assert trajectory is not None
        with ledger.phase("adjoint"):
            return body_slopes_of(trajectory, scene)

    if scene.objective.gradient == "esl":
        Q = on_root(share.world, moments)
        return {index: esl_gradient(arm, Q[index]) for index, arm in arms.items()}
    by_body = on_root(share.world, slopes)
    return {index: exact_gradient(arm, by_body[index]) for index, arm in arms.items()}
