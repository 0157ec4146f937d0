"""What is known of a finished design: its certificate, further iterations, its assessment."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import uniform_design
from dolfinopt.dynamics.trajectory import Trajectory
from dolfinopt.dynamics.work import counted
from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.iterate import Iterate
from dolfinopt.optimization.measured import (
    AT_BOUND_SHARE,
    COORDINATE_RESERVE_FACTOR,
    CRISP_NEWTON_ITERATIONS,
)
from dolfinopt.optimization.problem import EvaluatedDesign, Evaluator, Problem, problem_of
from dolfinopt.optimization.state import FurtherMemory, FurtherRow, fields_of
from dolfinopt.optimization.stopping import Sum, kkt_residual
from dolfinopt.parallel import sum_over_arms, together
from dolfinopt.reduction import METHODS
from dolfinopt.responses.constraints import violated
from dolfinopt.responses.evaluation import Evaluation
from dolfinopt.responses.order_selection import OrderSelection, choose_coordinates, estimated_error
from dolfinopt.responses.response import needs, objective_of
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.objective import freezes


@dataclass(frozen=True)
class Attempt:
    """One design: its objective, and whether it keeps all constraints."""

    objective: float
    feasible: bool


@dataclass(frozen=True)
class Further:
    """What iterations with the exact gradient made of a design, and what they started from.

    Attributes:
        iterations: how many there were; fewer than asked for where a motion could not be simulated.
        begun: objective of the design.
        objective: the best of those designs, this one included, that keep all constraints; if
            none does, that of the last one.
        feasible: whether it keeps them.
        maximised: whether the greatest objective is the best.
    """

    iterations: int
    begun: float
    objective: float
    feasible: bool
    maximised: bool = False

    @property
    def excess(self) -> float:
        """By how much the design is worse than the best one found, relative to that."""
        worse = self.begun - self.objective
        return (-worse if self.maximised else worse) / abs(self.objective) if worse else 0.0

    @property
    def sentence(self) -> str:
        """E.g. "5.1 % above the best of 20 further iterations with the exact gradient"."""
        how = f"{self.iterations} further iterations with the exact gradient"
        if not self.feasible:
            return f"{how} found no design that keeps all constraints"
        if self.excess == 0.0:
            return f"{how} found nothing better"
        percent = 100.0 * abs(self.excess)
        size = f"{percent:.2g}" if percent < 99.5 else f"{percent:.0f}"
        where = "above" if (self.excess > 0.0) != self.maximised else "below"
        return f"{size} % {where} the best of {how}"


def best_of(first: Attempt, others: Iterable[Attempt], *, maximised: bool = False) -> Further:
    """Return the best of a row of designs that keeps all constraints.

    A simulation that fails ends the row.
    """

    def rank(one: Attempt) -> tuple[bool, float]:
        """Return what is smaller for a better design: feasible ones come first."""
        return not one.feasible, -one.objective if maximised else one.objective

    best, count, last = first, 0, first
    try:
        for last in others:
            count += 1
            best = min(best, last, key=rank)
    except ConvergenceError:  # of a design on the way; on all ranks
        pass
    if not best.feasible:
        best = last
    return Further(count, first.objective, best.objective, best.feasible, maximised)


def attempt(problem: Problem) -> Attempt:
    """Return what counts of a problem at its design."""
    return Attempt(problem.f0, not violated(problem.limits))


class FurtherRun:
    """A run of its own from a finished design, which stays as it is.

    Attributes:
        memory: of what has been done; None before the first iteration.
        row: of the last iteration; None where an interrupted run has made it.
    """

    def __init__(
        self, evaluator: Evaluator, x: np.ndarray, begun: int, memory: FurtherMemory | None
    ):
        """Take the design, and what may have been done from it.

        Args:
            evaluator: of the iterations that led to the design.
            x: (n,) this rank's variables.
            begun: how many there were.
            memory: of an interrupted run; one that set out from another design does not count.
        """
        self.evaluator, self.x, self.begun = evaluator, x, begun
        self.memory = memory if memory is not None and memory.begun == begun else None
        self.row: FurtherRow | None = None

    def iterations(self, problem: Problem, count: int) -> Iterator[Attempt]:
        """Go on from x until converged; yield what it comes to (collective).

        Args:
            problem: at x, with exact gradients.
            count: of iterations, at most.
        """
        other = Iterate(self.evaluator.with_gradient("exact"), self.x)
        done: list[Attempt] = []
        try:
            if self.memory is not None:
                done = list(map(Attempt, self.memory.objectives, self.memory.feasible))[:count]
                yield from done
                if len(done) < count:
                    other.restore(self.memory)
                    other.evaluate_again()
            if len(done) < count and not done:
                other.take(other.evaluator.evaluate_again(self.x))
            while len(done) < count:
                if done and other.ending() not in ("", "limit"):
                    return
                other.step()
                if other.stuck:
                    return
                problem, row = other.problem, other.measure()
                done.append(attempt(problem))
                self.memory = FurtherMemory(
                    **fields_of(other.memory()),
                    begun=self.begun,
                    objectives=tuple(one.objective for one in done),
                    feasible=tuple(one.feasible for one in done),
                )
                self.row = FurtherRow(**fields_of(row), of=count)
                yield done[-1]
        finally:
            self.evaluator.evaluate_again(self.x)


# -- how far an optimised design is from an optimum of the problem as it was posed ---------------
#
# Equivalent static loads leave out that the loads follow the design: where their iterations come to
# rest need not be an optimum. Source: Stolpe, Verbart & Rojas-Labanda (2018),
# doi:10.1007/s00158-017-1884-0.


@dataclass(frozen=True)
class Certificate:
    """What the exact gradient says of a design.

    Attributes:
        kkt: Karush-Kuhn-Tucker residual under it, see `stopping.kkt_residual`; nan if unknown.
        angle, ratio: of the objective's gradient with frozen loads beside the exact one, over the
            variables that no bound holds: degrees, and length over length. nan where nothing is
            frozen, or no variable is free.
        missing: why there is no exact gradient, "" if there is one.
        violated: the constraints that the design does not keep, "" if it keeps all.
        further: of more iterations, where they were asked for.
        seconds: that the exact gradient took, without further iterations, s; the root's.
    """

    kkt: float = np.nan
    angle: float = np.nan
    ratio: float = np.nan
    missing: str = ""
    violated: str = ""
    further: Further | None = None
    seconds: float = 0.0

    @property
    def sentence(self) -> str:
        """All of it in one line."""
        if self.missing:
            return f"no exact gradient to judge the design by: {self.missing}"
        kept = " of a design that does not keep all constraints" if self.violated else ""
        parts = [f"residual {self.kkt:.2g} under the exact gradient{kept}"]
        if np.isfinite(self.angle):
            parts.append(f"that with frozen loads points {self.angle:.3g} degrees off it")
        if self.further is not None:
            parts.append(self.further.sentence)
        return "; ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Return its entry of summary.json; what is unknown is None."""
        further = self.further
        return {
            "kkt": _known(self.kkt),
            "gradient_angle": _known(self.angle),
            "gradient_ratio": _known(self.ratio),
            "feasible": not self.violated,
            "missing": self.missing,
            "exact_iterations": 0 if further is None else further.iterations,
            "exact_objective": None if further is None else further.objective,
            "exact_feasible": None if further is None else further.feasible,
            "excess": None if further is None else further.excess,
            "seconds": self.seconds,
            "sentence": self.sentence,
        }


def judge(
    x: np.ndarray,
    xmin: np.ndarray,
    xmax: np.ndarray,
    exact: Problem,
    frozen: np.ndarray | None,
    parts: Mapping[int, slice],
    total: Sum,
) -> Certificate:
    """Return the certificate of x from gradients (collective).

    Args:
        x, xmin, xmax: (n,) this rank's variables.
        exact: the problem at x with its exact gradients.
        frozen: (n,) the objective's gradient with frozen loads; None where nothing is frozen.
        parts, total: as for `kkt_residual`.
    """
    where = x, xmin, xmax
    residual = kkt_residual(*where, exact.df0dx, exact.f, exact.dfdx, parts, total).rms
    angle = ratio = np.nan
    if frozen is not None:
        angle, ratio = _compared(*where, exact.df0dx, frozen, parts, total)
    return Certificate(residual, angle, ratio, violated=violated(exact.limits))


def _compared(
    x: np.ndarray,
    xmin: np.ndarray,
    xmax: np.ndarray,
    exact: np.ndarray,
    frozen: np.ndarray,
    parts: Mapping[int, slice],
    total: Sum,
) -> tuple[float, float]:
    """Return angle, degrees, and ratio of lengths over the free variables; nan if there is none."""
    width = xmax - xmin
    room = np.minimum(x - xmin, xmax - x)
    free = (width > 0.0) & (room > AT_BOUND_SHARE * width)
    g, h = np.where(free, exact * width, 0.0), np.where(free, frozen * width, 0.0)
    gg, hh = total({k: np.array([g[p] @ g[p], h[p] @ h[p]]) for k, p in parts.items()})
    if not (gg > 0.0 and hh > 0.0):
        return np.nan, np.nan
    # From the diagonals of the rhombus: a cosine would lose angles below 1e-6 degrees to rounding.
    g, h = g / np.sqrt(gg), h / np.sqrt(hh)
    across, along = total(
        {k: np.array([np.sum((g - h)[p] ** 2), np.sum((g + h)[p] ** 2)]) for k, p in parts.items()}
    )
    angle = 2.0 * np.arctan2(np.sqrt(across), np.sqrt(along))
    return float(np.degrees(angle)), float(np.sqrt(hh / gg))


def without_exact_gradient(scene: Scene) -> str:
    """Return why the scene has no exact gradient, in words; "" if it has one."""
    if not needs(scene, "motion"):
        return ""
    method = scene.reduction.method
    if METHODS[method].adjoint is None:
        return f'reduction.method = "{method}" has no adjoint'
    return ""


def certify(
    evaluator: Evaluator,
    x: np.ndarray,
    nominal: EvaluatedDesign,
    problem: Problem,
    further: Callable[[Problem, int], Iterable[Attempt]],
) -> Certificate:
    """Return the certificate of the design that was evaluated last (collective).

    The exact gradient of a motion is one adjoint integration more; robust designs, three at a
    time, are evaluated again, in the same bits. Afterwards the arms have the same design.

    Args:
        evaluator: of the iterations.
        x: (n,) this rank's design variables.
        nominal, problem: at x.
        further: iterates from x with the exact problem given first, and yields what follows; the
            arms are to end with x.
    """
    scene, comm = evaluator.scene, evaluator.partition.world
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
    variables, total = evaluator.variables, partial(sum_over_arms, evaluator.partition)
    bounds = variables.xmin, variables.xmax
    found = judge(x, *bounds, exact, frozen, variables.slices, total)
    found = replace(found, seconds=comm.bcast(time.perf_counter() - begun, root=0))
    if not (count := scene.optimizer.exact_iterations):
        return found
    turned = objective_of(scene).turned
    return replace(found, further=best_of(attempt(exact), further(exact, count), maximised=turned))


def _problem_by(
    evaluator: Evaluator, x: np.ndarray, nominal: EvaluatedDesign, gradient: str
) -> Problem:
    """Return the problem at x with the other gradient (collective)."""
    other = evaluator.with_gradient(gradient)
    if evaluator.scene.design.projection == "robust":
        designs = other.evaluate_again(x)
    else:
        designs = [other.differentiated(nominal.physical, nominal.evaluation)]
    return problem_of(other.scene, designs)


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


# -- what is still to be known of an optimised design when the iterations have ended -------------


@dataclass(frozen=True, eq=False)
class Assessment:
    """The final design with its motion, as `Result` has it.

    Attributes:
        evaluation: of the design, with the motion.
        crisp: of the design cut at x_phys = 1/2 without what hangs on it by contacts alone, see
            `Contacts.kept`; None without a projection, or where the interfaces do not hang together
            or the motion of what is left cannot be simulated.
        initial: trajectory of the uniform initial design where the iterations had no motion.
        selection: of the coordinates, with the error that they make of this design's motion.
    """

    evaluation: Evaluation
    crisp: Evaluation | None
    initial: Trajectory | None
    selection: OrderSelection | None


def initial_selection(
    evaluator: Evaluator, x_phys: Mapping[int, np.ndarray]
) -> OrderSelection | None:
    """Choose the coordinates by the initial design, where the scene says "auto" (collective)."""
    return _choose(evaluator, x_phys, COORDINATE_RESERVE_FACTOR)


def assess(
    evaluator: Evaluator,
    x_phys: Mapping[int, np.ndarray],
    evaluation: Evaluation,
    selection: OrderSelection | None,
) -> Assessment:
    """Evaluate what the iterations left out: motions not simulated, and the crisp design.

    Collective; the arms, and `evaluator.trajectory`, are those of the design afterwards.

    Args:
        evaluator: of the iterations.
        x_phys, evaluation: of the final design.
        selection: of the coordinates so far.
    """
    scene, arms = evaluator.scene, evaluator.arms
    moves = needs(scene, "motion")
    if not moves:
        selection = _choose(evaluator, x_phys, 1.0)
    elif selection is not None:
        selection = replace(selection, error=_selection_error(evaluator, x_phys, selection))
    # A followed mode is known by those before it: the initial and the crisp design's are not.
    vectors = {k: arm.initial_vectors for k, arm in arms.items()}
    initial = crisp = None
    if not moves:
        uniform = uniform_design(scene, evaluator.partition, arms)
        evaluator.evaluate_densities(uniform, simulated=True)
        initial = evaluator.trajectory
    if scene.design.projection:
        crisp = _crisp(evaluator, x_phys)
    if scene.design.projection or not moves:
        for k, arm in arms.items():
            arm.initial_vectors = vectors[k]
        evaluation = evaluator.evaluate_densities(x_phys, simulated=True)
    return Assessment(evaluation, crisp, initial, selection)


def _crisp(evaluator: Evaluator, x_phys: Mapping[int, np.ndarray]) -> Evaluation | None:
    """Return the evaluation of the design cut at 1/2, contacts opened; None if it falls apart."""
    # The same on all ranks.
    arms, trajectory = evaluator.arms, evaluator.trajectory
    with together(evaluator.partition.world):
        found = {k: arms[k].contacts(x > 0.5) for k, x in x_phys.items()}
    whole = all(one.joins for one in found.values())
    if not evaluator.partition.world.allreduce(whole, MPI.MIN):
        return None
    cut = {k: np.where(one.kept, 1.0, 0.0) for k, one in found.items()}
    steps = sum(len(one.a) for one in trajectory.solutions) if trajectory else np.inf
    with suppress(ConvergenceError), counted(CRISP_NEWTON_ITERATIONS * steps):
        return evaluator.evaluate_densities(cut, simulated=True)
    return None


def _choose(
    evaluator: Evaluator, x_phys: Mapping[int, np.ndarray], reserve: float
) -> OrderSelection | None:
    one = evaluator
    return choose_coordinates(
        one.scene, one.partition, one.arms, x_phys, one.profile, reserve=reserve
    )


def _selection_error(
    evaluator: Evaluator, x_phys: Mapping[int, np.ndarray], selection: OrderSelection
) -> float:
    place = evaluator.scene, evaluator.partition, evaluator.arms
    try:
        return estimated_error(*place, x_phys, selection.coordinates, evaluator.profile)
    except ConvergenceError:  # of the richer motion; the design is not lost for it
        return np.inf
