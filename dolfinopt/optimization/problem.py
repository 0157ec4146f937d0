"""From design variables to the problem: what designs x stands for, and what they do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.arms.arm import Patterns, PhysicalDesign
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.trajectory import Trajectory
from dolfinopt.optimization.measured import (
    ERODED_LIMIT_FACTOR,
    GENTLE_SHARPNESS,
    LIMIT_PRICE,
    STRICT_SHARPENINGS,
    WAITING_EXCESS,
)
from dolfinopt.parallel import Partition, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import Limit, limits_of, worst_limits
from dolfinopt.responses.evaluation import Evaluation, constraint_gradients, evaluate, gradient
from dolfinopt.responses.response import constraints_of, objective_of, worst_of
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm


class Variables:
    """This rank's design variables as one vector, arms one behind the other.

    Arms that repeat another's design have none.

    Attributes:
        size: n, number of this rank's variables.
        xmin, xmax: (n,) bounds; equal where a cell stays solid or void.
        initial: (n,) of the design to begin with, whatever the bounds.
        slices: part of the vector that belongs to each arm.
        pieces: sizes of these parts by a number that is the same order on any number of ranks.
    """

    def __init__(self, scene: Scene, partition: Partition, arms: Mapping[int, Arm]):
        self.partition = partition
        arms = {k: arm for k, arm in arms.items() if k in scene.designed}
        sizes = [arm.mesh.num_cells for arm in arms.values()]
        ends = np.cumsum([0, *sizes])
        # Whole arms add up in the same order on any number of ranks; parts of one are numbered on.
        first = partition.comm.rank * len(scene.arms)
        self.pieces = {first + k: size for k, size in zip(arms, sizes, strict=True)}
        self.slices = {k: slice(a, b) for k, a, b in zip(arms, ends[:-1], ends[1:], strict=True)}
        self.arms = arms
        self.size = int(ends[-1])
        self.xmin = np.full(self.size, scene.design.minimum)
        self.xmax, self.initial = np.ones(self.size), np.empty(self.size)
        for k, part in self.slices.items():
            mesh = arms[k].mesh
            self.xmin[part] = mesh.keep(self.xmin[part])
            self.xmax[part] = mesh.keep(self.xmax[part])
            self.initial[part] = scene.initial(k)

    def split(self, x: np.ndarray) -> dict[int, np.ndarray]:
        """Return each arm's part."""
        return {k: x[part] for k, part in self.slices.items()}

    def join(self, parts: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return the parts as one vector."""
        return np.concatenate([parts[k] for k in self.slices] or [np.empty(0)])

    def by_x(
        self, by_cells: Mapping[int, np.ndarray], designs: Mapping[int, PhysicalDesign]
    ) -> np.ndarray:
        """Return a gradient by x (n,) from that by the physical densities.

        Of arms with variables; what others that repeat their designs add is in it already, see
        `Patterns.collect`.
        """
        found = np.zeros(self.size)
        for k, part in self.slices.items():
            if k in by_cells:
                found[part] = self.arms[k].backward(by_cells[k], designs[k])
        return found


# -- the projection's steepness and thresholds, as they change over the iterations ---------------


class Continuation:
    """Owns the projection's beta and thresholds; without a projection both stay as they are.

    Attributes:
        beta: steepness; grows from 1 to design.sharpness.
        age: updates of the design since it grew.
        held: whether beta stays as it is from here on.
        patterns: arms that repeat another's design.
        thresholds: eta of every arm of this rank with design variables. Held during a step: a
            threshold that followed x would be one more way to stay grey.
    """

    def __init__(self, scene: Scene, partition: Partition, arms: Mapping[int, Arm]):
        """Begin with the gentlest projection."""
        self.scene, self.partition, self.arms = scene, partition, arms
        self.beta, self.age = 1.0, 0
        self.held = False
        self.patterns = Patterns(scene, partition, arms)
        designed = [k for k in arms if k in scene.designed]
        self.thresholds: dict[int, float] = dict.fromkeys(designed, 0.5)

    @property
    def complete(self) -> bool:
        """Whether beta has reached its final value."""
        design = self.scene.design
        return self.held or not design.projection or self.beta >= design.sharpness

    @property
    def move(self) -> float:
        """Move limit, shorter where the projection is steep and x_phys would leap."""
        return self.scene.optimizer.move * min(1.0, (GENTLE_SHARPNESS / self.beta) ** 0.5)

    def as_it_is(self) -> Continuation:
        """Return one that stays as this one is now."""
        other = copy(self)
        other.held = True
        return other

    def physical_designs(
        self, x: Mapping[int, np.ndarray]
    ) -> dict[int, tuple[PhysicalDesign, ...]]:
        """Return the designs that x stands for, the nominal one last (collective).

        Of all arms of this rank; those that repeat another's design have its densities.
        """
        with together(self.partition.world):
            designs = {
                k: self.arms[k].physical_designs(x[k], self.beta, eta)
                for k, eta in self.thresholds.items()
            }
        if not self.patterns.repeats:
            return designs
        count = 3 if self.scene.design.projection == "robust" else 1
        spread = [
            self.patterns.spread({k: variants[i].x_phys for k, variants in designs.items()})
            for i in range(count)
        ]
        repeats = [k for k in self.arms if k in self.patterns.repeats]
        return designs | {k: tuple(PhysicalDesign(x[k], None) for x in spread) for k in repeats}

    def smoothed(self, x: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
        """Return what is projected, of all arms of this rank (collective)."""
        with together(self.partition.world):
            smooth = {k: self.arms[k].smoothed(x[k]) for k in self.thresholds}
        return self.patterns.spread(smooth)

    def is_due(self, excess: float, strict: bool) -> bool:
        """Return whether beta is to rise with the next update; not as long as limits are far.

        Args:
            excess: largest relative violation of a limit.
            strict: whether the update is to be compared with the design before.
        """
        return not self.complete and excess <= WAITING_EXCESS and self.age >= self._updates(strict)

    def _updates(self, strict: bool) -> int:
        return max(1, self.scene.design.continuation // STRICT_SHARPENINGS) if strict else 1

    def advance(self, x: Mapping[int, np.ndarray], strict: bool) -> None:
        """Raise beta, and move the thresholds so that the volume of x stays (collective).

        A little in every iteration: doubled at once, beta cuts members whose x is near the
        threshold, and what is grey then stays so.
        """
        design = self.scene.design
        growth = 2.0 ** (self._updates(strict) / design.continuation)
        self.beta, self.age = min(growth * self.beta, design.sharpness), 0
        with together(self.partition.world):
            self.thresholds = {
                k: self.arms[k].preserving_threshold(x[k], self.beta) for k in self.thresholds
            }


# -- the problem at one point x, as MMA takes it, from what the designs that x stands for do -----


@dataclass(frozen=True, eq=False)
class EvaluatedDesign:
    """One design that x stands for, what it does, and the gradients of that by x.


    Attributes:
        physical: of this rank's arms.
        evaluation: values.
        objective: (n,) gradient of the objective.
        constraints: (k, n) gradients of `Evaluation.constraints`.
        of_nominal: (k,) True for constraints that the nominal one of robust designs carries alone.
        differentiated: whether the gradients are known; they are empty of one that is only tried.
    """

    physical: Mapping[int, PhysicalDesign]
    evaluation: Evaluation
    objective: np.ndarray
    constraints: np.ndarray
    of_nominal: np.ndarray
    differentiated: bool = True

    @property
    def x_phys(self) -> dict[int, np.ndarray]:
        """Physical densities of this rank's arms."""
        return {k: one.x_phys for k, one in self.physical.items()}


@dataclass(frozen=True, eq=False)
class Stage:
    """What is held while designs are compared with each other, so that one function falls.

    Attributes:
        limits: smooth limit (k,) of every constraint of each design that x stands for.
        price: of a relative excess, in units of what is minimised.
    """

    limits: tuple[np.ndarray, ...]
    price: float

    def merit(self, values: np.ndarray) -> float:
        """Return phi = f0 + c sum_i max(0, f_i) of values (1 + m,)."""
        return float(values[0] + self.price * np.maximum(values[1:], 0.0).sum())


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
        return max((0.0 if one.met else one.excess for one in self.limits), default=0.0)

    def merit(self, size: float, weight: float) -> float:
        """Return the merit by the limits' true values, over the `size` of the objective."""
        over = sum(one.excess for one in self.limits if not one.met)
        return float(self.values[0] / size + weight * LIMIT_PRICE * over)


def limits_at(scene: Scene, designs: Sequence[EvaluatedDesign]) -> tuple[np.ndarray, ...]:
    """Return the smooth limits of every design, as a stage that begins here holds them.

    Smooth limit = limit times smooth over true value. Where the limits bind the nominal one of
    robust designs alone, those of the eroded one are scaled so that it meets them as the nominal
    one does, up to `ERODED_LIMIT_FACTOR`: its gradients keep members from getting thin, and it does
    not fall apart.
    """
    found = [np.array(one.evaluation.smooth_limits) for one in designs]
    if len(designs) > 1 and scene.design.limits_on == "nominal":
        eroded, nominal = (1.0 + np.array(designs[i].evaluation.constraints) for i in (0, -1))
        known = (eroded > 0.0) & (nominal > 0.0)  # what nothing loads has no share
        ratio = np.divide(eroded, nominal, out=np.ones_like(eroded), where=known)
        found[0] = found[0] * np.minimum(ratio, ERODED_LIMIT_FACTOR)
    return tuple(found)


def problem_of(
    scene: Scene, designs: Sequence[EvaluatedDesign], held: Sequence[np.ndarray] | None = None
) -> Problem:
    """Return the problem of one design; or of the eroded, dilated and nominal one together.

    Their worst objective is minimised. Limits of volume and mass are the nominal one's. With a
    minimum member their gradient is that of the dilated one, scaled to the nominal volume:
    f = V_dilated / V* - 1 with V* = V_dilated / V_nominal times the limit, chosen anew in every
    step and held in the gradient. Other limits are kept by all three; where they bind the nominal
    one alone, by that, and by the eroded one with the limits of `limits_at`.
    Source: Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y.

    Args:
        scene: that is asked.
        designs: at x; of designs without gradients the problem has none either.
        held: smooth limits of every design; by default those of these designs.
    """
    held = limits_at(scene, designs) if held is None else held
    nominal, robust = designs[-1], len(designs) > 1
    known = nominal.differentiated
    scales = [
        np.array(one.evaluation.smooth_limits) / limits
        for one, limits in zip(designs, held, strict=True)
    ]
    f = [
        (1.0 + np.array(one.evaluation.constraints)) * scale - 1.0
        for one, scale in zip(designs, scales, strict=True)
    ]
    own = nominal.of_nominal
    dfdx = nominal.constraints[own]
    if robust and known and scene.design.controls_widths:
        ratio = (1.0 + f[-1][own]) / (1.0 + f[1][own])
        dfdx = ratio[:, None] * designs[1].constraints[own]
    bound: Sequence[int] = range(len(designs))
    if robust and scene.design.limits_on == "nominal":
        bound = [0, len(designs) - 1]
    f0, df0dx = _objective(scene, designs)
    variants = [limits_of(scene, one.evaluation) for one in designs]
    limits = variants[-1] if scene.design.limits_on == "nominal" else worst_limits(variants)
    rows = [np.flatnonzero(own), *[np.flatnonzero(~own)] * len(bound)]
    return Problem(
        f0,
        df0dx,
        np.concatenate([f[-1][own], *(f[i][~own] for i in bound)]),
        np.vstack([dfdx, *(designs[i].constraints[~own] * scales[i][~own, None] for i in bound)])
        if known
        else np.empty((0, 0)),
        limits,
        np.concatenate(rows),
        objective_of(scene).turned,
    )


def _objective(scene: Scene, designs: Sequence[EvaluatedDesign]) -> tuple[float, np.ndarray]:
    """Return the objective's value, and the gradient of what is minimised."""
    response, nominal = objective_of(scene), designs[-1]
    turned = -1.0 if response.turned else 1.0
    if response.of_nominal and len(designs) > 1:
        value, by_x = nominal.evaluation.objective, nominal.objective
        if scene.design.controls_widths and nominal.differentiated:
            dilated = designs[1]
            by_x = value / dilated.evaluation.objective * dilated.objective
        return value, turned * by_x
    values = [one.evaluation.objective for one in designs]
    f0, weights = worst_of(values, scene.objective.exponent, response.turned)
    if not nominal.differentiated:
        return f0, np.empty(0)
    parts = [w * one.objective for w, one in zip(weights, designs, strict=True)]
    return f0, turned * np.sum(parts, axis=0)


# -- from x to the designs that it stands for, what they do, and the gradients of that by x ------


class Evaluator:
    """Evaluates one x after the other, each with the last one's motion as its initial guess.

    Attributes:
        scene, partition, arms, profile: of the run.
        variables, continuation: how x makes designs.
        trajectory: of the design evaluated last; None without a motion and off the root.
        solutions: its motions; the next evaluation sets out from them.
        initial_solutions, initial_vectors: from where that of the last x set out, so that it can be
            repeated in the same bits.
    """

    def __init__(
        self, scene: Scene, partition: Partition, arms: Mapping[int, Arm], profile: Profile
    ):
        self.scene, self.partition, self.arms, self.profile = scene, partition, arms, profile
        self.variables = Variables(scene, partition, arms)
        self.continuation = Continuation(scene, partition, arms)
        self.trajectory: Trajectory | None = None
        self.solutions: tuple[Solution, ...] = ()
        self.initial_solutions: tuple[Solution, ...] = ()
        self.initial_vectors: dict[int, list[np.ndarray]] = {}

    def physical_designs(self, x: np.ndarray) -> list[dict[int, PhysicalDesign]]:
        """Return what x stands for: eroded, dilated and nominal design, or the nominal one alone.

        Collective; of this rank's arms.
        """
        designs = self.continuation.physical_designs(self.variables.split(x))
        count = 3 if self.scene.design.projection == "robust" else 1
        return [{k: one[variant] for k, one in designs.items()} for variant in range(count)]

    def evaluate(self, x: np.ndarray) -> list[EvaluatedDesign]:
        """Evaluate the designs that x stands for, the nominal one last (collective)."""
        return self.accepted(self.tried(x))

    def tried(self, x: np.ndarray) -> list[EvaluatedDesign]:
        """Evaluate the designs that x stands for; the last one without gradients (collective).

        `accepted` adds them, `undo` takes the whole back. Of robust designs the others have theirs
        at once, as long as their factors are at hand.
        """
        self.initial_solutions = self.solutions
        self.initial_vectors = {k: arm.initial_vectors for k, arm in self.arms.items()}
        *others, nominal = self.physical_designs(x)
        found = []
        for design in others:
            found.append(self.differentiated(design, self.evaluate_densities(densities(design))))
        evaluation = self.evaluate_densities(densities(nominal))
        of_nominal = [
            one.response.of_nominal
            for one, measured in zip(
                constraints_of(self.scene), evaluation.responses[1:], strict=True
            )
            for _ in measured.values
        ]
        none = np.empty((len(of_nominal), 0))
        found.append(
            EvaluatedDesign(
                nominal, evaluation, np.empty(0), none, np.array(of_nominal, dtype=bool), False
            )
        )
        return found

    def accepted(self, designs: list[EvaluatedDesign]) -> list[EvaluatedDesign]:
        """Add the gradients to designs that were `tried` last (collective)."""
        *others, last = designs
        return [*others, self.differentiated(last.physical, last.evaluation)]

    def undo(self) -> None:
        """Set out from where the last evaluation did (collective)."""
        self.solutions = self.initial_solutions
        for k, vectors in self.initial_vectors.items():
            self.arms[k].initial_vectors = vectors

    def evaluate_again(self, x: np.ndarray) -> list[EvaluatedDesign]:
        """Evaluate the last x again, from the same initial guesses: in the same bits (collective).

        Args:
            x: (n,) the design variables of the last `evaluate`, whatever the arms have since.
        """
        self.undo()
        return self.evaluate(x)

    def with_gradient(self, kind: str) -> Evaluator:
        """Return an evaluator of the same arms for another `objective.gradient`.

        It goes its own way from here: this one keeps its trajectory and initial guesses, and the
        projection stays as it is.
        """
        other = copy(self)
        objective = self.scene.objective.model_copy(update={"gradient": kind})
        other.scene = self.scene.model_copy(update={"objective": objective})
        other.continuation = self.continuation.as_it_is()
        return other

    def evaluate_densities(
        self, x_phys: Mapping[int, np.ndarray], simulated: bool = False
    ) -> Evaluation:
        """Evaluate one design (collective); `simulated` even where no response needs a motion."""
        evaluation, self.trajectory = evaluate(
            self.scene,
            self.partition,
            self.arms,
            x_phys,
            self.profile,
            self.solutions,
            simulated=simulated,
        )
        return evaluation

    def differentiated(
        self, design: Mapping[int, PhysicalDesign], evaluation: Evaluation
    ) -> EvaluatedDesign:
        """Add the gradients by x of the design evaluated last (collective)."""
        if self.trajectory is not None:
            self.solutions = self.trajectory.solutions
        analysed = self.scene, self.partition, self.arms, self.trajectory, self.profile
        collect = self.continuation.patterns.collect
        objective = collect(gradient(*analysed))
        rows = constraint_gradients(*analysed, measured=evaluation.responses)
        smooth = [collect(row.smooth) for row in rows]
        with together(self.partition.world):
            by_x = [
                self.variables.by_x(by, design) / row.limit
                for by, row in zip(smooth, rows, strict=True)
            ]
            return EvaluatedDesign(
                design,
                evaluation,
                self.variables.by_x(objective, design),
                np.array(by_x).reshape(len(rows), self.variables.size),
                np.array([row.response.of_nominal for row in rows], dtype=bool),
            )


def densities(design: Mapping[int, PhysicalDesign]) -> dict[int, np.ndarray]:
    """Return the physical densities of every arm."""
    return {k: one.x_phys for k, one in design.items()}
