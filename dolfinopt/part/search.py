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
# Relative fall of the objective, on new meshes, in so many steps as two of them follow, that ends
# the search. By meshes alone it ended by chance where trust regions collapsed: a light arm at 1.08
# or 1.14 kg, as the last digits would have it. With 1e-2 a SCARA's parts end at 0.505 kg, with this
# at 0.503.
SETTLED = 5e-3
MOST, OLD = 6, 5  # places that are differentiated in a step; steps that their rows hold
ATTEMPTS, ENOUGH = 3, 0.3  # at a step of one radius; of the promised fall, that ends them
PRICE, LEAST_PRICE, OVER = 1.5, 0.1, 3.0  # of limits over the objective: first; least; multiplier
# Price of limits that shall be met above all; steps to that, at most; trust region of the first,
# and of the first on a new mesh after no step bettered the parts.
DEAR, RESTORING, NEARBY = 50.0, 3, 0.1
FALLS = 0.95  # what is left of a missed limit after a step, above which its price doubles
# Of the promised fall: what a step must bring, and what makes the next one shorter, or longer.
ACCEPTED, POOR, GOOD = 0.05, 0.25, 0.6
# Of the radius, after a step that is refused. With a half the lightest arms end at 1.016 or, of
# gradients that differ in the last digits, 1.042 kg, with this at 1.007.
REFUSED = 0.25
SIMPLER, WORSE = 3, 3e-3  # meshes after which sides go; relative merit that one may cost

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
        self.radius, self.price = FIRST_RADIUS, PRICE
        self.H = np.zeros((0, 0))
        self.curvature: BFGS | None = None
        self.rows: dict[Place, tuple[np.ndarray, int]] = {}
        self.before: tuple[Step, Linear] | None = None

    def run(self, iterations: int, tell: Tell) -> str:
        """Take steps, so many in all at most; return why the search ended."""
        while True:
            if self.since >= FOLLOWED or self.steps >= iterations:
                self._mesh_anew()
                if self._settled() and not self._simplified():
                    return "settled"
            if self.steps >= iterations:
                return f"{iterations} iterations"
            if self._step():
                tell(self._line())
            elif self.since > 0:
                self.since, self.radius = FOLLOWED, max(self.radius, NEARBY)
            elif not self._simplified():
                return "no step betters the parts"

    def restore(self, tell: Tell, enough: Callable[[], bool]) -> None:
        """Take a few steps that meet the limits above all, until they do or are `enough`."""
        self._mesh_anew()
        self.radius = NEARBY  # what the finer mesh says holds nearby
        for _ in range(RESTORING):
            self.price = DEAR
            if self.state.excess <= EXCESS or not self._step():
                break
            tell(self._line())
            if enough():
                break

    def _mesh_anew(self) -> None:
        """Go on with new meshes."""
        if self.falls and len(self.falls) % SIMPLER == 0:
            self._simplified()
        try:
            self.problem, self.state = self.problem.calibrated(self.state)
        except (ConvergenceError, InputError):  # sides that all but touch
            before = replace(self.state, outlines=self.meshed)
            self.problem, self.state = self.problem.calibrated(before)
            self.radius *= 0.5
        self.since, self.before, self.meshed = 0, None, self.state.outlines
        value = self.state.values[0]
        self.falls.append((self.steps, value + abs(value) * self.state.excess))

    def _simplified(self) -> bool:
        """Go on without sides that have vanished and holes that close, if that costs little."""
        before = self.state
        for k, outline in before.outlines.items():
            simpler, count = outline.simplified()
            if not count:
                continue
            plain = replace(self.problem, local={})
            try:
                outlines = {**self.state.outlines, k: simpler}
                result = plain.evaluated(outlines, {}, self.state.solutions)
            except (ConvergenceError, InputError):
                continue
            cost = self._merit(result, result) - self._merit(self.state, self.state)
            if cost < WORSE * np.sqrt(count) * abs(self.state.values[0]):
                self.problem, self.state, self.before = plain, result, None
        return self.state is not before

    def _settled(self) -> bool:
        now = self.falls[-1][1]
        before = [merit for step, merit in self.falls if step <= self.steps - 2 * FOLLOWED]
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
            if share < ACCEPTED:
                self.radius *= REFUSED
            elif share < POOR or share > GOOD:
                self.radius = min(LARGEST_RADIUS, self.radius * (0.5 if share < POOR else 2.0))
            if share >= ACCEPTED:
                self._take(state, tried, linear)
                return True
        return False

    def _take(self, state: State, step: Step, linear: Linear) -> None:
        dual = max([*step.multipliers, sum(step.places.values())], default=0.0)
        dual /= abs(state.values[0])
        if dual < 0.5 * self.price:  # a price far above the multipliers makes steps short
            self.price = min(self.price, max(OVER * dual, 0.7 * self.price, LEAST_PRICE))
        if step.state.excess > max(5.0 * EXCESS, FALLS * state.excess):  # limits cost too little
            self.price *= 2.0
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
            least = 0.05 * np.linalg.norm(s) * np.linalg.norm(y)
            scale = max(float(s @ y), float(least)) / float(s @ s)
            self.curvature = BFGS("damp_update", init_scale=scale)
            self.curvature.initialize(len(s), "hess")
        self.curvature.update(s, y)
        self.H = self.curvature.get_matrix()

    def _linear(self, state: State, slopes: np.ndarray) -> Linear:
        """Return the limits that a step of this radius can meet."""
        reach, far, A, b = self.radius * FAR, [], [], []
        for outline in state.outlines.values():
            g, own = outline.rows()
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
            missed = max(EXCESS, 0.4 * max(after.values(), default=0.0))
            unknown = [
                key
                for key in sorted(after, key=lambda k: -after[k])
                if key in state.places
                and (key not in linear.stress or self.rows[key][1] < self.steps)
                and after[key] > missed
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
        price = self.price * abs(base[0])
        slack = np.append(np.arange(m), np.full(len(keys), m)).astype(int)
        H = far[:, None] * self.H * far + 1e-6 * abs(base[0]) * np.eye(len(far))
        g = linear.slopes[0] * far
        solved = solve(H, g, F, f, np.full(m + 1, price), slack, linear.A * far, linear.b)
        led = None if solved is None else self._led_to(state, solved[0] * far)
        if solved is None or led is None:
            return None
        (x, dual), (after, total, anew) = solved, led

        def missed(values: np.ndarray) -> float:
            return float(np.maximum(values[:m], 0.0).sum() + values[m:].max(initial=0.0))

        promised = float(-g @ x - 0.5 * x @ H @ x + price * (missed(f) - missed(f + F @ x)))
        fall = self._merit(state, state) - self._merit(after, state)
        places = dict(zip(keys, dual[m:], strict=True))
        return Step(promised, dual[:m], places, after, total, anew, fall)

    def _merit(self, state: State, held: State) -> float:
        v, price = state.against(held.held), self.price * abs(held.values[0])
        return float(v[0] + price * np.maximum(np.append(v[1:], state.worst), 0.0).sum())

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
