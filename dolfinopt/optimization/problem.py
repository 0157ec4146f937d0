"""The problem at one point x, as MMA takes it, from what the designs that x stands for do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.responses.constraints import Limit, limits_of, worst_limits
from dolfinopt.responses.evaluation import Evaluation
from dolfinopt.responses.response import constraints_of, objective_of, worst_of
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import PhysicalDesign


@dataclass(frozen=True, eq=False)
class EvaluatedDesign:
    """One design that x stands for, what it does, and the gradients of that by x.

    Attributes:
        physical: of this rank's arms.
        evaluation: values.
        objective: (n,) gradient of the objective.
        constraints: (k, n) gradients of `Evaluation.constraints`.
        of_nominal: (k,) True for constraints that the nominal one of robust designs carries alone.
    """

    physical: Mapping[int, PhysicalDesign]
    evaluation: Evaluation
    objective: np.ndarray
    constraints: np.ndarray
    of_nominal: np.ndarray

    @property
    def x_phys(self) -> dict[int, np.ndarray]:
        """Physical densities of this rank's arms."""
        return {k: one.x_phys for k, one in self.physical.items()}


@dataclass(frozen=True, eq=False)
class Problem:
    """min f0, f <= 0 at one x.

    Attributes:
        f0: value of the objective, as reports show it: where it is maximised, not turned round.
        df0dx: (n,) gradient by this rank's variables of what is minimised.
        f, dfdx: (m,) relative constraints and (m, n) their gradients.
        limits: the constraints by name, as reports show them.
        rows: (m,) index in `limits` of every constraint: robust designs share a limit.
        turned: whether the objective is maximised.
        guarded: (1 + m,) which of objective and constraints are guarded, see `Response.guarded`.
    """

    f0: float
    df0dx: np.ndarray
    f: np.ndarray
    dfdx: np.ndarray
    limits: tuple[Limit, ...]
    rows: np.ndarray
    turned: bool = False
    guarded: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))

    @property
    def values(self) -> np.ndarray:
        """What is minimised, and the relative constraints (1 + m,)."""
        return np.append(-self.f0 if self.turned else self.f0, self.f)


def problem_of(scene: Scene, designs: Sequence[EvaluatedDesign]) -> Problem:
    """Return the problem of one design; or of the eroded, dilated and nominal one together.

    Their worst objective is minimised. Every one keeps the limits, but for volume and mass: those
    are the nominal one's. With a minimum member their gradient is that of the dilated one, scaled
    to the nominal volume: f = V_dilated / V* - 1 with V* = V_dilated / V_nominal times the limit,
    chosen anew in every step and held in the gradient.
    Source: Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y.
    """
    nominal = designs[-1]
    own = nominal.of_nominal
    f = np.array(nominal.evaluation.constraints)[own]
    dfdx = nominal.constraints[own]
    if len(designs) > 1 and scene.design.controls_widths:
        dilated = designs[1]
        ratio = (1.0 + f) / (1.0 + np.array(dilated.evaluation.constraints)[own])
        dfdx = ratio[:, None] * dilated.constraints[own]
    everywhere = [np.array(one.evaluation.constraints)[~own] for one in designs]
    f0, df0dx = _objective(scene, designs)
    limits = worst_limits([limits_of(scene, one.evaluation) for one in designs])
    rows = np.concatenate([np.flatnonzero(own), *[np.flatnonzero(~own)] * len(designs)])
    objective = objective_of(scene)
    guards = {one.name: one.response.guarded for one in constraints_of(scene)}
    return Problem(
        f0,
        df0dx,
        np.concatenate([f, *everywhere]),
        np.vstack([dfdx, *(one.constraints[~own] for one in designs)]),
        limits,
        rows,
        objective.turned,
        np.array([objective.guarded, *(guards[limits[row].quantity] for row in rows)]),
    )


def _objective(scene: Scene, designs: Sequence[EvaluatedDesign]) -> tuple[float, np.ndarray]:
    """Return the objective's value, and the gradient of what is minimised."""
    response, nominal = objective_of(scene), designs[-1]
    turned = -1.0 if response.turned else 1.0
    if response.of_nominal and len(designs) > 1:
        value, by_x = nominal.evaluation.objective, nominal.objective
        if scene.design.controls_widths:
            dilated = designs[1]
            by_x = value / dilated.evaluation.objective * dilated.objective
        return value, turned * by_x
    values = [one.evaluation.objective for one in designs]
    f0, weights = worst_of(values, scene.objective.exponent, response.turned)
    parts = [w * one.objective for w, one in zip(weights, designs, strict=True)]
    return f0, turned * np.sum(parts, axis=0)
