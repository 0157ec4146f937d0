"""Further iterations with the exact gradient: what a finished design could be bettered by."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.history import FurtherRow
from dolfinopt.optimization.iterate import Iterate
from dolfinopt.optimization.memory import FurtherMemory, fields_of
from dolfinopt.optimization.problem import Problem
from dolfinopt.responses.constraints import violated


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
