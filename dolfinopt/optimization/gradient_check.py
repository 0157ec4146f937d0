"""Taylor test of the exact gradient along the complete chain, and how far frozen loads are off."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.arms.arm import Patterns
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.trajectory import Trajectory
from dolfinopt.errors import InputError
from dolfinopt.optimization.certificate import compared
from dolfinopt.optimization.measured import (
    FORCE_ROUNDING,
    INSIDE_MARGIN,
    OBJECTIVE_ROUNDING,
    PASSING_RATE,
    STEP_RATIO,
)
from dolfinopt.optimization.variables import Variables
from dolfinopt.parallel import Partition, on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.reduction import METHODS
from dolfinopt.responses.evaluation import evaluate, gradient
from dolfinopt.responses.motion import MotionResponse, motions_of
from dolfinopt.responses.response import needs, objective_of
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

STEPS = tuple(0.01 / STEP_RATIO**k for k in range(5))  # of the design variable, down to 4e-5

Cells = Mapping[int, np.ndarray]


@dataclass(frozen=True)
class TaylorRow:
    """Remainders |J(x + h d) - J(x) - h g . d| along one direction d.

    Attributes:
        direction: its name.
        slope: g . d with the exact gradient; unit of the objective.
        slope_frozen: the same with the ESL gradient; nan where there is none.
        remainders: for every h of `STEPS`.
        rate: order in h of the two finest remainders above rounding; 2 when g is the gradient,
            inf when J is linear to rounding.
    """

    direction: str
    slope: float
    slope_frozen: float
    remainders: tuple[float, ...]
    rate: float


@dataclass(frozen=True)
class TaylorTest:
    """The rows, and the ESL gradient beside the exact one: angle in degrees, ratio of norms.

    The latter are nan where the objective has no loads to freeze.
    """

    rows: tuple[TaylorRow, ...]
    angle: float
    ratio: float

    @property
    def passed(self) -> bool:
        """True when every direction's rate says that the gradient is one."""
        return all(row.rate >= PASSING_RATE for row in self.rows)


def taylor_test(
    scene: Scene, partition: Partition, arms: Mapping[int, Arm], x: Cells, profile: Profile
) -> TaylorTest:
    """Test the gradient by the design variables x: filter, reduction, simulation, objective.

    The instants of the objective and the time steps are those of x throughout; with them the
    objective is smooth. Variables are moved `INSIDE_MARGIN` inside their bounds first.

    Args:
        scene, partition, arms, profile: as for `evaluate`.
        x: (n_cells,) design variables of this rank's arms, in [0, 1]; arms that repeat another's
            design have none, and what is given for them is not read.

    Raises:
        InputError: the scene's objective has no exact gradient.
    """
    check_exact(scene)
    exact, variables = _with(scene, "exact"), Variables(scene, partition, arms)
    given = variables.join({k: x[k] for k in variables.arms})
    inside = INSIDE_MARGIN + (1.0 - 2.0 * INSIDE_MARGIN) * given
    patterns = Patterns(scene, partition, arms)

    def slope_of(one: Scene) -> np.ndarray:
        """Return a gradient by x, of the scene's kind."""
        cells = patterns.collect(gradient(one, partition, arms, base, profile))
        with together(partition.world):
            parts = variables.split(inside).items()
            by = {k: arms[k].backward(cells[k], arms[k].filtered(x)) for k, x in parts}
        return variables.join(by)

    x_phys = _physical(variables, patterns, inside)
    start = held_steps(evaluate(exact, partition, arms, x_phys, profile, simulated=False)[1])
    _, base = evaluate(exact, partition, arms, x_phys, profile, start, simulated=False)
    slope, frozen = slope_of(exact), None
    if needs(scene, "motion"):
        if scene.objective.has_esl_gradient:
            frozen = slope_of(_with(scene, "esl"))
    value = _fixed_objective(exact, variables, arms, patterns, profile, base, start)
    here = value(inside)
    of_forces = "effort_weights" in scene.objective.response.options
    rounding = (FORCE_ROUNDING if of_forces else OBJECTIVE_ROUNDING) * abs(here)
    rows = []
    for name, parts in _directions(scene, variables.arms).items():
        d = variables.join(parts)
        along = float(slope @ d)
        remainders = tuple(abs(value(inside + h * d) - here - h * along) for h in STEPS)
        rate = _rate(remainders, rounding)
        beside = np.nan if frozen is None else float(frozen @ d)
        rows.append(TaylorRow(name, along, beside, remainders, rate))
    angle, ratio = (np.nan, np.nan) if frozen is None else compared(slope, frozen)
    return TaylorTest(tuple(rows), angle, ratio)


def held_steps(motion: Trajectory | None) -> list[Solution]:
    """Return what motions begin with that are to have the time steps of this one."""
    return [] if motion is None else [replace(one, held=True) for one in motion.solutions]


def check_exact(scene: Scene) -> None:
    """Raise InputError, of one line, where the objective has no exact gradient to test."""
    if not needs(scene, "motion"):
        return
    method = scene.reduction.method
    if METHODS[method].adjoint is None:
        known = " | ".join(f'"{name}"' for name, one in METHODS.items() if one.adjoint is not None)
        raise InputError(
            f'{scene.source}: reduction.method = "{method}": --check tests the exact gradient, '
            f"and this basis has no adjoint; expected {known}"
        )


def _with(scene: Scene, gradient: str) -> Scene:
    """Return the scene with another gradient."""
    objective = scene.objective.unchecked_copy({"gradient": gradient})
    return scene.unchecked_copy({"objective": objective})


def _physical(variables: Variables, patterns: Patterns, x: np.ndarray) -> dict[int, np.ndarray]:
    with together(variables.partition.world):
        mine = {k: variables.arms[k].physical(part) for k, part in variables.split(x).items()}
    return patterns.spread(mine)


def _fixed_objective(
    scene: Scene,
    variables: Variables,
    arms: Mapping[int, Arm],
    patterns: Patterns,
    profile: Profile,
    base: Trajectory | None,
    start: Sequence[Solution],
) -> Callable[[np.ndarray], float]:
    """Return J(x), of a motion with the load cases of `base` and the time steps of `start`."""
    partition, response = variables.partition, objective_of(scene)

    def value(x: np.ndarray) -> float:
        x_phys = _physical(variables, patterns, x)
        evaluation, trajectory = evaluate(
            scene, partition, arms, x_phys, profile, start, simulated=False
        )
        if not isinstance(response, MotionResponse):
            return evaluation.objective

        def at_base_instants() -> float:
            assert trajectory is not None and base is not None
            return sum(_at(base, trajectory, part) for _, part in response.parts(scene))

        return on_root(partition.world, at_base_instants)

    return value


def _at(base: Trajectory, trajectory: Trajectory, part: MotionResponse) -> float:
    """Return one value of a motion, or of its scenarios, at the instants that `base` chooses."""
    values = []
    for one, own in zip(motions_of(trajectory), motions_of(base), strict=True):
        seen = part.seen(own)
        values.append(part.value_at(one.at(seen.t), part.load_cases(seen)))
    return part.combine(trajectory.scene, values)[0]


def _directions(scene: Scene, arms: Mapping[int, Arm]) -> dict[str, dict[int, np.ndarray]]:
    """Return directions of largest entry 1: random, smooth, and boxes at both ends of the chain."""
    # They are functions of the place, the same on any partition. First and last are among the arms
    # with a design of their own.
    designed = scene.designed

    def along(k: int) -> np.ndarray:
        return arms[k].mesh.centroid[:, 0] / arms[k].mesh.outboard_point[0]

    def noise(k: int) -> np.ndarray:
        x, y, *z = arms[k].mesh.centroid.T * 1e3
        angle = 12.9898 * x + 78.233 * y + sum(37.719 * one for one in z)
        return 2.0 * np.modf(np.abs(np.sin(angle + k) * 43758.5453))[0] - 1.0

    chosen: dict[str, Callable[[int], np.ndarray]] = {
        "random": noise,
        "smooth": lambda k: np.sin(3.0 * np.pi * along(k) + k),
        "root of the first arm": lambda k: ((along(k) < 0.1) & (k == designed[0])).astype(float),
        "tip of the last arm": lambda k: ((along(k) > 0.9) & (k == designed[-1])).astype(float),
    }
    return {
        name: {k: np.where(arm.mesh.fixed, 0.0, field(k)) for k, arm in arms.items()}
        for name, field in chosen.items()
    }


def _rate(remainders: tuple[float, ...], rounding: float) -> float:
    """Return the order of the finest remainders in h; those at rounding level say nothing."""
    known = [r for r in remainders if r > rounding]
    return float(np.log(known[-2] / known[-1]) / np.log(STEP_RATIO)) if len(known) > 1 else np.inf
