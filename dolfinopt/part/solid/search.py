"""Steps over the nodes of free surfaces, by moving asymptotes within a trust region.

A step minimises the method of moving asymptotes' approximation of the merit
f0 + c sum_i max(0, f_i), and is taken if the merit falls as promised, see `optimization.mma`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

import numpy as np

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.optimization.measured import LIMIT_PRICE
from dolfinopt.optimization.mma import MMAState, initial_state, mma_step
from dolfinopt.part.merit import judge_step, merit
from dolfinopt.part.problem import Problem, State
from dolfinopt.part.solid.free_surface import FreeSurface
from dolfinopt.responses.constraints import EXCESS

FARTHEST = 0.2  # cells that a node moves in a step, at most
LEAST_RADIUS = 0.02  # of the trust region, of FARTHEST, below which no step is looked for
SETTLED, PATIENCE = 1e-3, 6  # relative fall of the objective in so many steps that ends a round
FIRST, WIDEST = 0.5, 1.0  # first and largest distance of the asymptotes, ranges of a variable

Tell = Callable[[str], None]


def surfaces_of(state: State) -> Mapping[int, FreeSurface]:
    """Return the forms of a state, all of which are surfaces."""
    return cast(Mapping[int, FreeSurface], state.outlines)


class SurfaceSearch:
    """Steps within a trust region from one state on, by moving asymptotes.

    Attributes:
        best: the best state so far: of the feasible ones that with the least objective.
        meshed: the last one whose mesh was made anew.
        passed: outlines of that one and of those since then.
        steps: taken.
    """

    def __init__(self, problem: Problem, state: State):
        """Begin at a state."""
        self.problem, self.state = problem, state
        self.best = self.meshed = state.released
        self.passed = [dict(state.outlines)]
        self.steps, self.radius, self.morphed = 0, 1.0, 0
        self.x = np.zeros(0)
        self.mma: MMAState = initial_state(self.x)
        self.falls: list[float] = []
        self.spent = False  # whether no more iterations were allowed
        self.met: State | None = None  # the best one meets its limits if one does
        self._begin()

    def _begin(self) -> None:
        """Begin the approximation anew where the variables are others."""
        count = sum(one.count for one in self.state.outlines.values())
        if len(self.x) != count:
            self.x = np.zeros(count)
            self.mma = initial_state(self.x)

    def run(self, iterations: int, tell: Tell, first: int) -> str:
        """Take so many steps at most; return why the search ended."""
        self.spent = False
        while self.steps < iterations:
            if not self._step():
                return "no step betters the parts"
            self.steps += 1
            self._keep()
            tell(self._line(first + self.steps))
            if self._settled():
                return "settled"
        self.spent = True
        return f"{first + iterations} iterations"

    def _keep(self) -> None:
        if self.state.rank < self.best.rank:
            self.best = self.state.released
        self.falls.append(self.best.values[0])

    def _settled(self) -> bool:
        if len(self.falls) <= PATIENCE or self.best.values[1:].max(initial=0.0) > EXCESS:
            return False
        fall = self.falls[-1 - PATIENCE] - self.falls[-1]
        return bool(fall < SETTLED * abs(self.falls[-1]))

    def _line(self, number: int) -> str:
        one = self.state
        worst = one.values[1:].max(initial=0.0)
        words = "limits met" if worst <= EXCESS else f"{100.0 * worst:.2g} % over a limit"
        return (
            f"{number} objective {one.simulated.evaluation.objective:.5g}, "
            f"mass {one.mass:.4g} kg, {words}, trust region {self.radius:.2g}"
        )

    def _step(self) -> bool:
        """Take a step that lowers the merit; return whether there is one."""
        if self._is_worn():
            if not self._mesh_anew():
                return False
            self._begin()
        slopes = self.problem.slopes(self.state)
        self.state = self.state.released  # for the matrices of those that are tried
        before = self.state
        price = LIMIT_PRICE * (abs(before.values[0]) or 1.0)
        room = {k: one.room() for k, one in surfaces_of(before).items()}
        while self.radius >= LEAST_RADIUS:
            x, after = self._proposed(slopes, price, room)
            tried = self._tried(x, room)
            if tried is None:
                self.radius *= 0.5
                continue
            promised = before.values + slopes @ (x - self.x)
            values = before.values, tried.against(before.held), promised
            accepted, factor = judge_step(*(merit(one, price) for one in values))
            self.radius = min(1.0, factor * self.radius)
            if accepted:
                self.x, self.mma, self.state = x, after, tried
                self.passed.append(dict(tried.outlines))
                self.morphed += 1
                return True
        return False

    def _mesh_anew(self) -> bool:
        """Go on with new meshes, of an earlier state where the last one has none; else end."""
        self.state = self.state.released
        for number, outlines in enumerate(reversed(self.passed)):
            try:
                self.state = self.problem.evaluated(outlines, {}, self.state.solutions)
            except (ConvergenceError, InputError):  # curves, or walls, that all but touch
                self.radius *= 0.5
                continue
            if number:  # those passed over cannot be parts
                self.best = min(self.meshed, self.state.released, key=lambda one: one.rank)
            self.meshed, self.morphed = self.state.released, 0
            self.passed = [dict(self.state.outlines)]
            return True
        self.best = self.meshed
        return False

    def _proposed(
        self,
        slopes: np.ndarray,
        price: float,
        room: Mapping[int, tuple[np.ndarray, np.ndarray]],
    ) -> tuple[np.ndarray, MMAState]:
        low, high = [], []
        for k, one in self.state.outlines.items():
            far = self.radius * FARTHEST * one.part.domain.cell
            low.append(-np.minimum(room[k][0], far))
            high.append(np.minimum(room[k][1], far))
        values = self.state.values
        return mma_step(
            self.x,
            slopes[0],
            values[1:],
            slopes[1:],
            self.x + np.concatenate(low),
            self.x + np.concatenate(high),
            self.mma,
            move=1.0,
            first=FIRST,
            widest=WIDEST,
            prices=np.full(len(values) - 1, price),
        )

    def _tried(
        self, x: np.ndarray, room: Mapping[int, tuple[np.ndarray, np.ndarray]]
    ) -> State | None:
        """Return what a step leads to; None where its outlines cannot be parts."""
        outlines, first = {}, 0
        for k, one in surfaces_of(self.state).items():
            s = one.filtered(x[first : first + one.count] - self.x[first : first + one.count])
            first += one.count
            outlines[k] = one.moved(np.clip(s, -room[k][0], room[k][1]))
            if not outlines[k].is_valid:
                return None
        try:
            every = self.problem.every(outlines)
            after = {k: one.followed(self.state.bodies[k]) for k, one in every.items()}
            bodies = {k: body for k, body in after.items() if body is not None}
            anew = len(bodies) < len(after)
            return self.problem.evaluated(outlines, {} if anew else bodies, self.state.solutions)
        except (ConvergenceError, InputError):
            return None

    def _is_worn(self) -> bool:
        """Whether meshes have followed too many steps."""
        forms, bodies = surfaces_of(self.state), self.state.bodies
        return any(self.morphed >= o.STEPS or o.is_worn(bodies[k]) for k, o in forms.items())
