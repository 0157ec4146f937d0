"""From design variables to the designs that they stand for, what these do, and its gradients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from copy import copy
from functools import partial

import numpy as np

from dolfinopt.arms.arm import Arm, Patterns, PhysicalDesign
from dolfinopt.dynamics.build import Trajectory
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.work import Work, counted
from dolfinopt.optimization.measured import NEWTON_ITERATIONS
from dolfinopt.optimization.problem import EvaluatedDesign, binds, variants_of
from dolfinopt.optimization.projection import Projection
from dolfinopt.optimization.variables import Variables
from dolfinopt.parallel import Partition, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.evaluation import (
    Evaluation,
    analysis_of,
    constraint_gradients,
    evaluate,
    objective_gradient,
)
from dolfinopt.responses.response import Analysis, CellGradient
from dolfinopt.scene.law_variables import LAW, with_law
from dolfinopt.scene.load import Scene

# Solutions, and eigenvectors of every arm.
Start = tuple[tuple[Solution, ...], dict[int, list[np.ndarray]]]


class Evaluator:
    """Evaluates one x after the other, each with the last one's motion as its initial guess.

    Attributes:
        scene, partition, arms, profile: of the run; the scene with the law of the last x.
        stated: the scene as it was given.
        variables, projection, patterns: how x makes designs.
        trajectory: of the design evaluated last; None without a motion and off the root.
        solutions: its motions; the next evaluation sets out from them.
        start: from where that of the last x set out, so that it can be repeated in the same bits.
    """

    def __init__(
        self, scene: Scene, partition: Partition, arms: Mapping[int, Arm], profile: Profile
    ):
        self.scene, self.partition, self.arms, self.profile = scene, partition, arms, profile
        self.stated, self.variables = scene, Variables(scene, partition, arms)
        self.projection, self.patterns = Projection(scene), Patterns(scene, partition, arms)
        self.trajectory: Trajectory | None = None
        self.solutions: tuple[Solution, ...] = ()
        self.start: Start = (), {}

    def physical_designs(self, x: np.ndarray) -> list[dict[int, PhysicalDesign]]:
        """Return those designs of x of which the problem is made, the nominal one last.

        Collective; of this rank's arms. From now on the scene has the law of x.
        """
        parts, arms, beta = self.variables.split(x), self.variables.arms, self.projection.beta
        motion = with_law(self.stated, self.variables.law_of(x)).motion
        self.scene = self.scene.unchecked_copy({"motion": motion})
        with together(self.partition.world):
            designs = {k: arm.physical_designs(parts[k], beta) for k, arm in arms.items()}
        return [
            self._spread({k: design[variant] for k, design in designs.items()})
            for variant in variants_of(self.scene)
        ]

    def _spread(self, designs: dict[int, PhysicalDesign]) -> dict[int, PhysicalDesign]:
        """Add the arms that repeat another's design, with its densities (collective)."""
        every = self.patterns.spread(densities(designs))
        return {k: designs.get(k) or PhysicalDesign(x, None) for k, x in every.items()}

    def smoothed(self, x: np.ndarray) -> dict[int, np.ndarray]:
        """Return what is projected, of all arms of this rank (collective)."""
        parts, arms = self.variables.split(x), self.variables.arms
        with together(self.partition.world):
            smooth = {k: arm.smoothed(parts[k]) for k, arm in arms.items()}
        return self.patterns.spread(smooth)

    def evaluate(self, x: np.ndarray) -> list[EvaluatedDesign]:
        """Evaluate the designs that x stands for, the nominal one last (collective)."""
        return self.accepted(self.tried(x))

    def tried(self, x: np.ndarray) -> list[EvaluatedDesign]:
        """Evaluate the designs that x stands for; the last one without gradients (collective).

        `accepted` adds them, `undo` takes the whole back. Of robust designs the others have theirs
        at once, as long as their factors are at hand.
        """
        self.start = self.solutions, {k: arm.initial_vectors for k, arm in self.arms.items()}
        *others, nominal = self.physical_designs(x)
        result = [
            self.differentiated(other, self.evaluate_densities(densities(other)), variant)
            for variant, other in zip(variants_of(self.scene), others, strict=False)
        ]
        evaluation = self.evaluate_densities(densities(nominal))
        return [*result, EvaluatedDesign(nominal, evaluation)]

    def accepted(self, designs: list[EvaluatedDesign]) -> list[EvaluatedDesign]:
        """Add the gradients to designs that were `tried` last (collective)."""
        *others, last = designs
        return [*others, self.differentiated(last.physical, last.evaluation)]

    def bounded(self, designs: int = 1) -> AbstractContextManager[Work]:
        """Bound the work of so many designs by that of the last motion; without one it has none."""
        steps = sum(len(solution.a) for solution in self.solutions)  # none off the root
        return counted(NEWTON_ITERATIONS * designs * steps if steps else np.inf)

    def undo(self) -> None:
        """Set out from where the last evaluation did (collective)."""
        self.solutions, vectors = self.start
        for k, own in vectors.items():
            self.arms[k].initial_vectors = own

    def evaluate_again(self, x: np.ndarray) -> list[EvaluatedDesign]:
        """Evaluate the last x again, from the same initial guesses: in the same bits (collective).

        Args:
            x: (n,) the design variables of the last `evaluate`, whatever the arms have since.
        """
        self.undo()
        return self.evaluate(x)

    def use_gradient(self, kind: str) -> None:
        """Use another gradient from the next evaluation on."""
        objective = self.scene.objective.unchecked_copy({"gradient": kind})
        self.scene = self.scene.unchecked_copy({"objective": objective})

    def with_gradient(self, kind: str) -> Evaluator:
        """Return an evaluator of the same arms with another gradient.

        This one keeps its trajectory and initial guesses.
        """
        other = copy(self)
        other.use_gradient(kind)
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
        self,
        design: Mapping[int, PhysicalDesign],
        evaluation: Evaluation,
        variant: int | None = None,
    ) -> EvaluatedDesign:
        """Add the gradients by x of the design evaluated last (collective).

        Of the nominal one, or as far as they count of another one of `variants_of`.
        """
        if self.trajectory is not None:
            self.solutions = self.trajectory.solutions
        variant = variants_of(self.scene)[-1] if variant is None else variant
        analysis, asked = self._analysis, partial(binds, self.scene, variant)
        rows = constraint_gradients(analysis, evaluation.responses, asked)
        by_x = self._by_variables(design, [objective_gradient(analysis), *rows])
        return EvaluatedDesign(design, evaluation, by_x[0], by_x[1:])

    def objective_gradient(self, design: Mapping[int, PhysicalDesign]) -> np.ndarray:
        """Return the objective's gradient (n,) by x of the design evaluated last (collective)."""
        return self._by_variables(design, [objective_gradient(self._analysis)])[0]

    @property
    def _analysis(self) -> Analysis:
        place = self.scene, self.partition, self.arms
        return analysis_of(*place, self.trajectory, self.profile)

    def _by_variables(
        self, design: Mapping[int, PhysicalDesign], by_cells: Sequence[CellGradient]
    ) -> np.ndarray:
        """Return gradients (k, n) by x from those by the physical densities (collective)."""
        low, high = self.variables.law_bounds
        if self.scene.objective.gradient == "esl":  # frozen loads say nothing of the law: it stays
            high = low
        by_law = [(high - low) * cell.get(LAW, 0.0) for cell in by_cells]
        by_cells = [
            self.patterns.collect({k: x for k, x in cell.items() if k != LAW}) for cell in by_cells
        ]
        backward = {LAW: np.array(by_law).T}
        with together(self.partition.world):
            for k, arm in self.variables.arms.items():
                none = np.zeros(arm.mesh.num_cells)
                by = [arm.backward(cell[k], design[k]) if k in cell else none for cell in by_cells]
                backward[k] = np.stack(by, axis=1)
        return np.ascontiguousarray(self.variables.join(backward).T)


def densities(design: Mapping[int, PhysicalDesign]) -> dict[int, np.ndarray]:
    """Return the physical densities of every arm."""
    return {k: item.x_phys for k, item in design.items()}
