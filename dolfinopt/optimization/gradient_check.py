"""Taylor test of the exact gradient along the complete chain, and how far frozen loads are off."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.arms.arm import Arm
from dolfinopt.dynamics.build import Trajectory
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.errors import InputError
from dolfinopt.optimization.certificate import compared, without_exact_gradient
from dolfinopt.optimization.evaluator import Evaluator, densities
from dolfinopt.optimization.measured import INSIDE_MARGIN, PASSING_RATE, ROUNDING_SHARE
from dolfinopt.parallel import on_root
from dolfinopt.reduction import METHODS
from dolfinopt.responses.motion import MotionResponse, motions_of
from dolfinopt.responses.response import needs, objective_of
from dolfinopt.scene.law_variables import LAW
from dolfinopt.scene.load import Scene

# Of the design variable, from one to the next a quarter as long: remainders of second order fall
# by 16.
STEPS = tuple(0.01 / 4.0**k for k in range(5))


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


def taylor_test(evaluator: Evaluator, x: Mapping[int, np.ndarray]) -> TaylorTest:
    """Test the gradient by the design variables x: filter, reduction, simulation, objective.

    The instants of the objective and the time steps are those of x throughout; with them the
    objective is smooth. Variables are moved `INSIDE_MARGIN` inside their bounds first; a
    projection is as gentle as a run begins with, and of robust designs the nominal one is tested.

    Args:
        evaluator: of the scene's arms.
        x: (n_cells,) design variables of this rank's arms, in [0, 1]; arms that repeat another's
            design have none, and what is given for them is not read.

    Raises:
        InputError: the scene's objective has no exact gradient.
    """
    scene, chain = evaluator.scene, evaluator.with_gradient("exact")
    check_exact(scene)
    begun = chain.variables.split(chain.variables.initial)
    given = chain.variables.join(begun | {k: x[k] for k in chain.variables.arms})
    inside = INSIDE_MARGIN + (1.0 - 2.0 * INSIDE_MARGIN) * given
    design = chain.physical_designs(inside)[-1]
    chain.evaluate_densities(densities(design))
    chain.solutions = held_steps(chain.trajectory)
    chain.evaluate_densities(densities(design))
    slope, frozen = chain.objective_gradient(design), None
    if needs(scene, "motion") and scene.objective.has_esl_gradient:
        frozen = chain.with_gradient("esl").objective_gradient(design)
    value = _fixed_objective(chain)
    here, rows = value(inside), []
    for name, parts in _directions(chain.variables.arms).items():
        d = chain.variables.join({LAW: np.ones(len(given) - chain.variables.size)} | parts)
        along = float(slope @ d)
        remainders = tuple(abs(value(inside + h * d) - here - h * along) for h in STEPS)
        rate = _rate(remainders, ROUNDING_SHARE * abs(here))
        frozen_slope = np.nan if frozen is None else float(frozen @ d)
        rows.append(TaylorRow(name, along, frozen_slope, remainders, rate))
    angle, ratio = (np.nan, np.nan) if frozen is None else compared(slope, frozen)
    return TaylorTest(tuple(rows), angle, ratio)


def held_steps(motion: Trajectory | None) -> tuple[Solution, ...]:
    """Return what motions begin with that are to have the time steps of this one."""
    return (
        ()
        if motion is None
        else tuple(replace(solution, held=True) for solution in motion.solutions)
    )


def check_exact(scene: Scene) -> None:
    """Raise InputError, of one line, where the objective has no exact gradient to test."""
    if missing := without_exact_gradient(scene):
        known = " | ".join(
            f'"{name}"' for name, item in METHODS.items() if item.adjoint is not None
        )
        raise InputError(
            f"{scene.source}: {missing}: --check tests the exact gradient; expected {known}"
        )


def _fixed_objective(chain: Evaluator) -> Callable[[np.ndarray], float]:
    """Return J(x), of a motion with the load cases and time steps of the one evaluated last."""
    base, response = chain.trajectory, objective_of(chain.scene)

    def value(x: np.ndarray) -> float:
        evaluation = chain.evaluate_densities(densities(chain.physical_designs(x)[-1]))
        if not isinstance(response, MotionResponse):
            return evaluation.objective
        parts, moved = response.parts(chain.scene), chain.trajectory

        def at_base_instants() -> float:
            assert moved is not None and base is not None
            return sum(_at(base, moved, part) for _, part in parts)

        return on_root(chain.partition.world, at_base_instants)

    return value


def _at(base: Trajectory, trajectory: Trajectory, part: MotionResponse) -> float:
    """Return one value of a motion, or of its scenarios, at the instants that `base` chooses."""
    values = []
    for item, own in zip(motions_of(trajectory), motions_of(base), strict=True):
        seen = part.seen(own)
        values.append(part.value_at(item.at(seen.t), part.load_cases(seen)))
    return part.combine(trajectory.scene, values)[0]


def _directions(arms: Mapping[int, Arm]) -> dict[str, dict[int, np.ndarray]]:
    """Return a random and a smooth direction of largest entry 1."""
    # They are functions of the place, the same on any partition.

    def noise(k: int) -> np.ndarray:
        place = 1e3 * arms[k].mesh.centroid
        angle = place @ np.array([12.9898, 78.233, 37.719])[: place.shape[1]]
        return 2.0 * np.modf(np.abs(np.sin(angle + k) * 43758.5453))[0] - 1.0

    def smooth(k: int) -> np.ndarray:
        mesh = arms[k].mesh
        return np.sin(3.0 * np.pi * mesh.centroid[:, 0] / mesh.outboard_point[0] + k)

    return {
        name: {k: np.where(arm.mesh.fixed, 0.0, field(k)) for k, arm in arms.items()}
        for name, field in {"random": noise, "smooth": smooth}.items()
    }


def _rate(remainders: tuple[float, ...], rounding: float) -> float:
    """Return the order of the finest remainders in h; those at rounding level say nothing."""
    known = [r for r in remainders if r > rounding]
    return float(np.log(known[-2] / known[-1]) / np.log(4.0)) if len(known) > 1 else np.inf
