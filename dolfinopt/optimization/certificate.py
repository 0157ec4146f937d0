"""How far an optimised design is from an optimum of the problem as it was posed.

Equivalent static loads leave out that the loads follow the design: where their iterations come to
rest need not be an optimum. Source: Stolpe, Verbart & Rojas-Labanda (2018),
doi:10.1007/s00158-017-1884-0.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.measured import ROOM_SHARE
from dolfinopt.optimization.problem import EvaluatedDesign, Problem, problem_of
from dolfinopt.optimization.residual import kkt_residual
from dolfinopt.parallel import on_root
from dolfinopt.reduction import METHODS
from dolfinopt.responses.constraints import violated
from dolfinopt.responses.response import needs
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.responses import freezes


@dataclass(frozen=True)
class Certificate:
    """What the exact gradient says of a design.

    Attributes:
        kkt: Karush-Kuhn-Tucker residual under it, see `residual.kkt_residual`; nan if unknown.
        gradient_angle, gradient_ratio: of the objective's gradient with frozen loads beside the
            exact one, over the variables that no bound holds: degrees, and length over length. nan
            where nothing is frozen, or no variable is free.
        missing: why there is no exact gradient, "" if there is one.
        violated: the constraints that the design does not keep, "" if it keeps all.
        stationary: whether the residual is at most `optimizer.kkt_tolerance`.
        seconds: that the exact gradient took, s; the root's.
    """

    kkt: float = np.nan
    gradient_angle: float = np.nan
    gradient_ratio: float = np.nan
    missing: str = ""
    violated: str = ""
    seconds: float = 0.0
    stationary: bool = False

    @property
    def sentence(self) -> str:
        """All of it in one line."""
        if self.missing:
            return f"no exact gradient to judge the design by: {self.missing}"
        kept = " of a design that does not keep all constraints" if self.violated else ""
        parts = [f"optimality check with the exact gradient{kept}: residual {self.kkt:.2g}"]
        if np.isfinite(angle := self.gradient_angle):
            parts.append(f"the frozen-load gradient differs from it by {angle:.3g} degrees")
        return "; ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Return its entry of summary.json."""
        return asdict(self) | {"feasible": not self.violated, "sentence": self.sentence}


def judge(
    x: np.ndarray, xmin: np.ndarray, xmax: np.ndarray, exact: Problem, frozen: np.ndarray | None
) -> Certificate:
    """Return the certificate of x from gradients.

    Args:
        x, xmin, xmax: (n,) variables and bounds.
        exact: the problem at x with its exact gradients.
        frozen: (n,) the objective's gradient with frozen loads; None where nothing is frozen.
    """
    residual = kkt_residual(x, exact.df0dx, exact.f, exact.dfdx, xmin, xmax).rms
    angle = ratio = np.nan
    if frozen is not None:
        width = xmax - xmin
        scale = width * (np.minimum(x - xmin, xmax - x) > ROOM_SHARE * width)
        angle, ratio = compared(exact.df0dx * scale, frozen * scale)
    return Certificate(residual, angle, ratio, violated=violated(exact.limits))


def compared(exact: np.ndarray, frozen: np.ndarray) -> tuple[float, float]:
    """Return the angle between two gradients, degrees, and the ratio of their lengths, or nan."""
    size, other = np.linalg.norm(exact), np.linalg.norm(frozen)
    if size == 0.0 or other == 0.0:
        return np.nan, np.nan
    # From the diagonals of the rhombus: a cosine would lose angles below 1e-6 degrees to rounding.
    a, b = exact / size, frozen / other
    angle = 2.0 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))
    return float(np.degrees(angle)), float(other / size)


def without_exact_gradient(scene: Scene) -> str:
    """Return why the scene has no exact gradient, in words; "" if it has one."""
    method = scene.reduction.method
    known = METHODS[method].adjoint is not None or not needs(scene, "motion")
    return "" if known else f'reduction.method = "{method}" has no adjoint'


def certify(
    evaluator: Evaluator,
    x: np.ndarray,
    nominal: EvaluatedDesign,
    problem: Problem,
) -> Certificate:
    """Return the certificate of the design that was evaluated last (collective).

    The exact gradient of a motion is one adjoint integration more; robust designs, three at a
    time, are evaluated again, in the same bits. Afterwards the arms have the same design.

    Args:
        evaluator: of the iterations.
        x: (n,) design variables.
        nominal, problem: at x.
    """
    scene = evaluator.scene
    if missing := without_exact_gradient(scene):
        return Certificate(missing=missing, violated=violated(problem.limits))
    begun = time.perf_counter()
    exact, frozen = problem, None
    if freezes(scene):
        used = scene.objective.gradient
        try:
            other = _problem_by(evaluator, x, nominal, "exact" if used == "esl" else "esl")
        except ConvergenceError as error:  # on all ranks; the design is not lost for it
            return Certificate(missing=str(error), violated=violated(problem.limits))
        exact, with_frozen_loads = (other, problem) if used == "esl" else (problem, other)
        if scene.objective.has_esl_gradient:
            frozen = with_frozen_loads.df0dx
    variables = evaluator.variables

    def judged() -> Certificate:
        result = judge(x, variables.xmin, variables.xmax, exact, frozen)
        stationary = bool(result.kkt <= scene.optimizer.kkt_tolerance)
        return replace(result, seconds=time.perf_counter() - begun, stationary=stationary)

    return on_root(evaluator.partition.world, judged)


def _problem_by(
    evaluator: Evaluator, x: np.ndarray, nominal: EvaluatedDesign, gradient: str
) -> Problem:
    """Return the problem at x with the other gradient (collective)."""
    other = evaluator.with_gradient(gradient)
    if evaluator.scene.design.is_robust:
        designs = other.evaluate_again(x)
    else:
        designs = [other.differentiated(nominal.physical, nominal.evaluation)]
    return problem_of(other.scene, designs)
