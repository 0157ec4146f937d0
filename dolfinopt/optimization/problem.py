"""The problem at one design, as the method of moving asymptotes takes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dolfinopt.arms.arm import PhysicalDesign
from dolfinopt.optimization.measured import ERODED_LIMIT_FACTOR, LIMIT_PRICE
from dolfinopt.responses.constraints import Limit, limits_of, worst_limits
from dolfinopt.responses.evaluation import Evaluation
from dolfinopt.responses.response import find, objective_of, worst_of
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.responses import limited_by


@dataclass(frozen=True, eq=False)
class EvaluatedDesign:
    """One design that x stands for, what it does, and the gradients of that by x.

    Attributes:
        physical: of this rank's arms.
        evaluation: values.
        objective: (n,) gradient of the objective; empty of one that is only tried.
        constraints: (k, n) gradients of `Evaluation.constraints`, likewise.
    """

    physical: Mapping[int, PhysicalDesign]
    evaluation: Evaluation
    objective: np.ndarray = field(default_factory=lambda: np.empty(0))
    constraints: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def differentiated(self) -> bool:
        """Whether the gradients are known."""
        return len(self.objective) > 0

    @property
    def limited(self) -> list[str]:
        """Names (k,) of the responses of all constraints."""
        return [item.response for item in self.evaluation.responses[1:] for _ in item.values]

    @property
    def x_phys(self) -> dict[int, np.ndarray]:
        """Physical densities of this rank's arms."""
        return {k: item.x_phys for k, item in self.physical.items()}


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
    """

    f0: float
    df0dx: np.ndarray
    f: np.ndarray
    dfdx: np.ndarray
    limits: tuple[Limit, ...]
    rows: np.ndarray
    turned: bool = False

    @property
    def values(self) -> np.ndarray:
        """What is minimised, and the relative constraints (1 + m,)."""
        return np.append(-self.f0 if self.turned else self.f0, self.f)

    @property
    def excess(self) -> float:
        """Largest relative violation of a limit by its true value; 0 where all are met."""
        return max((0.0 if limit.met else limit.excess for limit in self.limits), default=0.0)

    def by_limit(self, of_rows: np.ndarray) -> dict[str, float]:
        """Return sums of (m,) numbers of the rows by the names of the limits that they share."""
        sums = np.bincount(self.rows, of_rows, minlength=len(self.limits))
        return {limit.name: float(x) for limit, x in zip(self.limits, sums, strict=True)}

    def merit(self, size: float) -> float:
        """Return f0 / size + 10 sum of excesses, of the limits' true values."""
        over = sum(limit.excess for limit in self.limits if not limit.met)
        return float(self.values[0] / size + LIMIT_PRICE * over)


def variants_of(scene: Scene) -> list[int]:
    """Return of which of `Arm.physical_designs` the problem is made, the nominal one last.

    The dilated one, 1, where it is the worst of three, keeps limits, or gives members their width.
    Without its motion the lightest arms take two thirds of the time.
    """
    if not scene.design.is_robust:
        return [0]
    design, of_nominal = scene.design, objective_of(scene).declared.of_nominal
    spared = of_nominal and design.limits_nominal and not design.controls_widths
    return [0, 2] if spared else [0, 1, 2]


def binds(scene: Scene, variant: int, response: str) -> bool:
    """Return whether the limit of a response, and so its gradient, counts of one of `variants_of`.

    Where limits are the nominal one's the eroded one keeps them, too, but for what depends on the
    phase of a vibration and so pulls either at random: with a limit on settling alone there is no
    other. With a sharpness of 128 `scara.toml` ends at 0.512 kg, with that row of the eroded one at
    0.531 to 0.543. That of the volume is the nominal one's, with the gradient of the dilated one
    where members have widths.
    """
    design, declared = scene.design, find(response).declared
    if variant == variants_of(scene)[-1]:
        return True
    if declared.of_nominal:
        return variant == 1 and design.controls_widths
    limited = [limited_by(key) for key in scene.limits]
    others = [item for item in limited if not (item.of_nominal or item.of_phase)]
    return not design.limits_nominal or (variant == 0 and not (declared.of_phase and others))


def limits_at(scene: Scene, designs: Sequence[EvaluatedDesign]) -> tuple[np.ndarray, ...]:
    """Return the smooth limits of every design, as a step from here holds them.

    Smooth limit = limit times smooth over true value. Where the limits bind the nominal one of
    robust designs alone, those of the eroded one are scaled so that it meets them as the nominal
    one does, up to `ERODED_LIMIT_FACTOR`: its gradients keep members from getting thin, and it does
    not fall apart.
    """
    result = [np.array(design.evaluation.smooth_limits) for design in designs]
    if len(designs) > 1 and scene.design.limits_nominal:
        eroded, nominal = (1.0 + np.array(designs[i].evaluation.constraints) for i in (0, -1))
        known = (eroded > 0.0) & (nominal > 0.0)  # what nothing loads has no share
        ratio = np.divide(eroded, nominal, out=np.ones_like(eroded), where=known)
        result[0] = result[0] * np.minimum(ratio, ERODED_LIMIT_FACTOR)
    return tuple(result)


def problem_of(
    scene: Scene, designs: Sequence[EvaluatedDesign], held: Sequence[np.ndarray] | None = None
) -> Problem:
    """Return the problem of one design; or of the eroded, dilated and nominal one together.

    Their worst objective is minimised. Limits of volume and mass are the nominal one's. With a
    minimum member their gradient is that of the dilated one, scaled to the nominal volume:
    f = V_dilated / V* - 1 with V* = V_dilated / V_nominal times the limit, chosen anew in every
    step and held in the gradient. Other limits are kept by all three; where they bind the nominal
    one alone, by that, and by the eroded one with the limits of `limits_at`, see `binds`.
    Source: Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y.

    Args:
        scene: that is asked.
        designs: at x; of designs without gradients the problem has none either.
        held: smooth limits of every design; by default those of these designs.
    """
    held = held or limits_at(scene, designs)
    nominal, robust = designs[-1], len(designs) > 1
    scales = [
        np.array(design.evaluation.smooth_limits) / limits
        for design, limits in zip(designs, held, strict=True)
    ]
    f = [
        (1.0 + np.array(design.evaluation.constraints)) * scale - 1.0
        for design, scale in zip(designs, scales, strict=True)
    ]
    limited = nominal.limited
    own = np.array([find(name).declared.of_nominal for name in limited], dtype=bool)
    kept = [
        ~own & np.array([binds(scene, variant, name) for name in limited], dtype=bool)
        for variant in variants_of(scene)
    ]
    dfdx = np.empty((0, 0))
    if nominal.differentiated:
        by_nominal = nominal.constraints[own]
        if robust and scene.design.controls_widths:
            ratio = (1.0 + f[-1][own]) / (1.0 + f[1][own])
            by_nominal = ratio[:, None] * designs[1].constraints[own]
        by_all = [
            (design.constraints * scale[:, None])[rows]
            for design, scale, rows in zip(designs, scales, kept, strict=True)
        ]
        dfdx = np.vstack([by_nominal, *by_all])
    f0, df0dx = _objective(scene, designs)
    variants = [limits_of(scene, design.evaluation) for design in designs]
    limits = variants[-1] if scene.design.limits_nominal else worst_limits(variants)
    rows = np.concatenate(list(map(np.flatnonzero, [own, *kept])))
    values = np.concatenate([f[-1][own], *map(np.compress, kept, f)])
    return Problem(f0, df0dx, values, dfdx, limits, rows, objective_of(scene).turned)


def _objective(scene: Scene, designs: Sequence[EvaluatedDesign]) -> tuple[float, np.ndarray]:
    """Return the objective's value, and the gradient of what is minimised."""
    response, nominal = objective_of(scene), designs[-1]
    turned = -1.0 if response.turned else 1.0
    if response.declared.of_nominal and len(designs) > 1:
        value, by_x = nominal.evaluation.objective, nominal.objective
        if scene.design.controls_widths and nominal.differentiated:
            dilated = designs[1]
            by_x = value / dilated.evaluation.objective * dilated.objective
        return value, turned * by_x
    values = [design.evaluation.objective for design in designs]
    f0, weights = worst_of(values, scene.objective.exponent, response.turned)
    if not nominal.differentiated:
        return f0, np.empty(0)
    parts = [w * design.objective for w, design in zip(weights, designs, strict=True)]
    return f0, turned * np.sum(parts, axis=0)
