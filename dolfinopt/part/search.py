"""Sequential quadratic programming over the sides of all arms.

A step minimises the objective, linear, plus the curvature of the Lagrangian (damped BFGS) and the
price of missed limits, all limits and the limits of the geometry linear, within a box; then the
nearest outlines are taken that keep the geometry's limits. Stress has a row for every fillet or
side that comes near its limit. A step is judged by the exact penalty; one that is spoilt by the
stress of a place that was not differentiated is computed again with it.
Source: Nocedal & Wright, Numerical Optimization (2006), doi:10.1007/978-0-387-40065-5, 18.5.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import BFGS

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.part.plane.free_sides import FreeSides
from dolfinopt.part.plane.limits import FAR
from dolfinopt.part.plane.sides import BrokenError
from dolfinopt.part.problem import NEAR, Place, Problem, State
from dolfinopt.part.program import solve
from dolfinopt.responses.constraints import EXCESS

FIRST_RADIUS, LARGEST_RADIUS, LEAST_RADIUS = 0.5, 2.0, 0.001  # of the trust region, of FAR
FOLLOWED = 6  # steps that a mesh follows
# Relative fall of the objective with what is missed of limits, as on the mesh of the steps, in so
# many steps as two meshes follow, that ends the search. The next mesh shows stress 1 to 3 % over
# its limit, which a step mends: by that mesh lightest arms ended after 18 steps at 1.036 kg, by
# this one after 48 at 1.030. With 1e-2 a SCARA's parts end at 0.505 kg, with this at 0.503.
SETTLED = 5e-3
# A row takes a tenth of an evaluation; of feed_forward.toml's parts 38 places come within 5 % of
# their stress, and with 6 rows most steps are refused. A rod ends at 0.1166 kg, with 6 at 0.1183.
MOST, OLD = 20, 5  # places that are differentiated in a step; steps that their rows hold
ATTEMPTS, ENOUGH = 3, 0.3  # at a step of one radius; of the promised fall, that ends them
# Of each limit over the objective: first; least; over the multiplier. One price for all refuses
# steps for the stress that cost the deviation alone: lightest arms after 18 steps 1.048 kg for
# 1.043, and 1.042 with the violation up to which limits count as met free of charge.
PRICE, LEAST_PRICE, OVER = 1.5, 0.5, 3.0
# Price of limits that shall be met above all; steps to that, at most; trust region of the first,
# and of the first on a new mesh after no step bettered the parts.
DEAR, RESTORING, NEARBY = 50.0, 6, 0.1
FALLS = 0.95  # what is left of a missed limit after a step, above which its price doubles
# Of the promised fall: what a step must bring, and what makes the next one shorter, or longer.
ACCEPTED, POOR, GOOD = 0.05, 0.25, 0.6
WORSE = 3e-3  # relative merit that one side or hole less may cost, of n the root of n times that

Tell = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Linear:
    """All limits at one state, linear, and the size of its step.

    Attributes:
        slopes: (1 + m, n) of the objective and of the limits but for the stress.
        stress: derivatives (n,) of the stress of places.
        A, b: of the geometry's limits, A x <= b.
        far: (n,) largest step, m.
    """

    slopes: np.ndarray
    stress: Mapping[Place, np.ndarray]
    A: np.ndarray
    b: np.ndarray
    far: np.ndarray


@dataclass(frozen=True, eq=False)
class Step:
    """A trial step.

    Attributes:
        promised: fall of the merit.
        multipliers: (m,) of limits; places: those of places.
        state, total: what it leads to, and the whole step (n,) with the way to a valid outline.
        anew: whether meshes were made anew.
        fall: of the merit.
    """

    promised: float
    multipliers: np.ndarray
    places: Mapping[Place, float]
    state: State
    total: np.ndarray
    anew: bool
    fall: float


class Search:
    """Steps within a trust region from one state on.

    Attributes:
        state: now.
        meshed: outlines of the last meshes that were made anew.
        steps: taken.
    """

    def __init__(self, problem: Problem, state: State, steps: int = 0):
        """Begin at a state, after some steps."""
        self.problem, self.state, self.meshed = problem, state, state.outlines
        self.since, self.falls, self.steps = FOLLOWED, list[tuple[int, float]](), steps
        self.radius = FIRST_RADIUS
        self.prices: np.ndarray = np.full(len(state.values) - 1, PRICE)
        self.H = np.zeros((0, 0))
        self.curvature: BFGS | None = None
        self.rows: dict[Place, tuple[np.ndarray, int]] = {}
        self.before: tuple[Step, Linear] | None = None

    def run(self, iterations: int, tell: Tell) -> str:
        """Take steps, so many in all at most; return why the search ended."""
        while True:
            if self.steps >= iterations:
                return f"{iterations} iterations"
            if self.since >= FOLLOWED:
                settled = self._settled()
                self._simplified()
                if settled and not self._tied():
                    return "settled"
                self._mesh_anew()
            if self._step():
                tell(self._line())
            elif self.since > 0 or self._tied():
                self.since, self.radius = FOLLOWED, max(self.radius, NEARBY)
            else:
                return "no step betters the parts"

    def restore(self, tell: Tell, enough: Callable[[], bool]) -> None:
        """Take a few steps that meet the limits above all, until they do or are `enough`."""
        self._mesh_anew()
        self.radius = NEARBY  # what the finer mesh says holds nearby
        for _ in range(RESTORING):
            self.prices[:] = DEAR
            if self.state.excess <= EXCESS or not self._step():
                break
            tell(self._line())
            if enough():
                break

    def _mesh_anew(self) -> None:
        """Go on with new meshes."""
        try:
            self.problem, self.state = self.problem.calibrated(self.state)
        except (ConvergenceError, InputError):  # sides that all but touch
            before = replace(self.state, outlines=self.meshed)
            self.problem, self.state = self.problem.calibrated(before)
            self.radius *= 0.5
        self.since, self.before, self.meshed = 0, None, self.state.outlines

    def _tied(self) -> bool:
        """Tie the sides of struts that have come to be; return whether there are any."""
        tied = {k: item.tied() for k, item in self.state.outlines.items()}
        before, self.state = self.state, replace(self.state, outlines=tied)
        return tied != before.outlines

    def _simplified(self) -> None:
        """Go on without sides that have vanished and holes that close, if that costs little."""
        plain = replace(self.problem, local={})
        for k, outline in self.state.outlines.items():
            simpler = outline.simpler()
            while simpler:
                with suppress(ConvergenceError, InputError):
                    outlines = {**self.state.outlines, k: simpler[-1]}
                    result = plain.evaluated(outlines, {}, self.state.solutions)
                    cost = self._merit(result, result) - self._merit(self.state, self.state)
                    if cost < WORSE * np.sqrt(len(simpler)) * abs(self.state.values[0]):
                        self.problem, self.state = plain, result
                        break
                simpler = simpler[: len(simpler) // 2]

    def _settled(self) -> bool:
        """Note how far the search is; return whether it brings little."""
        value = self.state.values[0]
        now = value + abs(value) * self.state.excess
        before = [merit for step, merit in self.falls if step <= self.steps - 2 * FOLLOWED]
        self.falls.append((self.steps, now))
        return bool(before) and before[-1] - now < SETTLED * abs(now)

    def _line(self) -> str:
        state = self.state
        missed = f"{100.0 * state.excess:.2g} % over a limit"
        words = "limits met" if state.excess <= EXCESS else missed
        return (
            f"{self.steps} objective {state.simulated.evaluation.objective:.5g}, "
            f"mass {state.mass:.4g} kg, {words}, trust region {self.radius:.2g}"
        )

    # -- a step -----------------------------------------------------------------------------------

    def _step(self) -> bool:
        """Take a step that lowers the merit; return whether there is one."""
        state = self.state
        slopes = self.problem.slopes(state)
        places = state.places
        self.rows = {
            key: row
            for key, row in self.rows.items()
            if key in places and len(row[0]) == slopes.shape[1] and self.steps - row[1] <= OLD
        }
        hottest = sorted((k for k in places if places[k] > NEAR), key=lambda k: -places[k])
        self._learn(state, [k for k in hottest if k not in self.rows][:MOST])
        self._curved(slopes)
        while self.radius > LEAST_RADIUS:
            linear = self._linear(state, slopes)
            tried = self._tried(state, linear)
            if tried is None:
                self.radius *= 0.5
                continue
            share = tried.fall / tried.promised
            if share < POOR or share > GOOD:
                self.radius = min(LARGEST_RADIUS, self.radius * (0.5 if share < POOR else 2.0))
            if share >= ACCEPTED:
                self._take(state, tried, linear)
                return True
        return False

    def _take(self, state: State, step: Step, linear: Linear) -> None:
        dual = np.append(step.multipliers, sum(step.places.values())) / abs(state.values[0])
        # A price far above the multiplier makes steps short.
        lower = np.maximum(OVER * dual, 0.7 * self.prices)
        self.prices = np.clip(lower, LEAST_PRICE, self.prices)
        low = step.state.values[1:] > np.maximum(5.0 * EXCESS, FALLS * state.values[1:])
        self.prices[low] *= 2.0
        self.before = None if step.anew else (step, linear)
        self.since, self.steps, self.state = self.since + 1, self.steps + 1, step.state

    def _learn(self, state: State, keys: list[Place]) -> None:
        """Find the derivatives of the stress at places."""
        for key, row in zip(keys, self.problem.stress_slopes(state, keys), strict=True):
            self.rows[key] = row, self.steps

    def _curved(self, slopes: np.ndarray) -> None:
        """Update the curvature of the Lagrangian by the step before."""
        if len(self.H) != slopes.shape[1]:
            self.H, self.curvature, self.before = np.zeros((slopes.shape[1],) * 2), None, None
        if self.before is None or not self.before[0].total.any():
            return
        step, old = self.before
        change = slopes - old.slopes
        y = change[0] + step.multipliers @ change[1:]
        for key, price in step.places.items():
            if key in self.rows and self.rows[key][1] == self.steps and key in old.stress:
                y = y + price * (self.rows[key][0] - old.stress[key])
        s = step.total
        if self.curvature is None:  # at first a multiple of one
            scale = float(np.linalg.norm(y) / np.linalg.norm(s))
            self.curvature = BFGS("damp_update", init_scale=scale)
            self.curvature.initialize(len(s), "hess")
        self.curvature.update(s, y)
        self.H = self.curvature.get_matrix()

    def _linear(self, state: State, slopes: np.ndarray) -> Linear:
        """Return the limits that a step of this radius can meet."""
        reach, far, A, b = self.radius * FAR, [], [], []
        for outline in state.outlines.values():
            g, own = outline.limits.rows(outline.sides)
            near = g > -reach * outline.cell * np.abs(own).sum(axis=1) - 0.1 * outline.cell
            A.append(own[near] / outline.cell)
            b.append(np.maximum(-g[near] / outline.cell, 0.0))
            far.append(np.full(outline.count, reach * outline.cell))
        stress = {key: row for key, (row, _) in self.rows.items()}
        return Linear(slopes, stress, block_diag(*A), np.concatenate(b), np.concatenate(far))

    def _tried(self, state: State, linear: Linear) -> Step | None:
        """Return the best of the trial steps of one radius; None: none makes parts."""
        tries: list[Step] = []
        for _ in range(ATTEMPTS):
            step = self._trial(state, linear)
            if step is None:
                break
            tries.append(step)
            after = step.state.places
            unknown = [
                key
                for key in sorted(after, key=lambda k: -after[k])
                if key in state.places
                and (key not in linear.stress or self.rows[key][1] < self.steps)
                and after[key] > EXCESS
            ]
            if step.fall >= ENOUGH * step.promised or not unknown:
                break
            self._learn(state, unknown[:MOST])
            linear = replace(linear, stress={key: row for key, (row, _) in self.rows.items()})
        return max(tries, key=lambda item: item.fall, default=None)

    def _trial(self, state: State, linear: Linear) -> Step | None:
        """Return the step that the linear limits allow, and what it leads to; None: no parts."""
        keys, base, far = list(linear.stress), state.against(state.held), linear.far
        m = len(base) - 1
        f = np.append(base[1:], [state.places[k] for k in keys])
        F = np.vstack([linear.slopes[1:], *linear.stress.values()]) * far
        prices = self.prices * abs(base[0])
        slack = np.append(np.arange(m), np.full(len(keys), m)).astype(int)
        H = far[:, None] * self.H * far + 1e-6 * abs(base[0]) * np.eye(len(far))
        g = linear.slopes[0] * far
        solved = solve(H, g, F, f, prices, slack, linear.A * far, linear.b)
        led = None if solved is None else self._led_to(state, solved[0] * far)
        if solved is None or led is None:
            return None
        (x, dual), (after, total, anew) = solved, led

        def missed(values: np.ndarray) -> float:
            worst = np.append(values[:m], values[m:].max(initial=0.0))
            return float(prices @ np.maximum(worst - EXCESS, 0.0))

        promised = float(-g @ x - 0.5 * x @ H @ x + missed(f) - missed(f + F @ x))
        fall = self._merit(state, state) - self._merit(after, state)
        places = dict(zip(keys, dual[m:], strict=True))
        return Step(promised, dual[:m], places, after, total, anew, fall)

    def _merit(self, state: State, held: State) -> float:
        value, *limits = state.against(held.held)
        missed = np.maximum(np.append(limits, state.worst) - EXCESS, 0.0)
        return float(value + abs(held.values[0]) * self.prices @ missed)

    def _led_to(self, state: State, x: np.ndarray) -> tuple[State, np.ndarray, bool] | None:
        """Return the state after a step, the whole step, and whether its meshes are new."""
        after, total = dict[int, FreeSides](), []
        ends = np.cumsum([outline.count for outline in state.outlines.values()])
        try:
            for (k, outline), part in zip(state.outlines.items(), np.split(x, ends[:-1])):
                near = outline.moved(part).nearest()
                if near is None:
                    return None
                after[k] = near[0]
                total.append(part + near[1])
            every = self.problem.every(after)
            bodies = {k: item.followed(state.bodies[k]) for k, item in every.items()}
            followed = {k: body for k, body in bodies.items() if body is not None}
            anew = len(followed) < len(bodies)
            result = self.problem.evaluated(after, {} if anew else followed, state.solutions)
        except (BrokenError, ConvergenceError, InputError):
            return None
        return result, np.concatenate(total), anew
