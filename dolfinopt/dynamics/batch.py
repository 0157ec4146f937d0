"""Several problems of the same bodies at once: other payloads, motions, gravity, materials.

Their steps are as many, and lie one problem after the other in every array, so that a call of
NumPy serves them all; Newton's matrix holds the tangent over a step (`held`). All are solved in
the vibrations of the first one's arms: the change of coordinates is exact, only how well they
uncouple is not. What does not converge here is left to `radau.integrate`.

Nine payloads of 4 to 8 kg, 4 coordinates an arm, take 4.0 times as long as one from cold, 88 and
22 ms, initial design, 101 and 25 ms optimised; with 48 coordinates 7 times: the work is in large
arrays, not in calls. Single precision for the matrix, or parts of the batch that stay in the
processor's cache, were no faster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.collocation import (
    Collocation,
    Stages,
    at_stages,
    beginnings,
    motions,
    radau_iia,
    rows_at,
    stage_values,
)
from dolfinopt.dynamics.modal_coordinates import REFERENCES, Modes, modes_of, proportion
from dolfinopt.dynamics.newton_matrix import Factors
from dolfinopt.dynamics.problem import (
    ElasticProblem,
    Solution,
    even_steps,
    first_count,
    lagrange_integrals,
)
from dolfinopt.dynamics.simplified_newton import held_factors
from dolfinopt.dynamics.unresolved import unresolved
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.mechanism import Mechanism, Scale, elastic_rows, linearise
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, proportional, same_geometry
from dolfinopt.profiling import Ledger

State = tuple[np.ndarray, np.ndarray]  # q, qd

# Angle w h up to which coordinates are slow: with 40, as for one problem, nine take 145 instead of
# 110 ms with 4 coordinates an arm, optimised, and 315 instead of 365 ms with 48, initial design.
LIMIT = 20.0
MAX_NEWTON = 6  # factorisations: what needs more needs damping, and windows
MAX_GRIDS = 4
MAX_PILOTS = 3
# What Newton may leave, about, over the tolerance: of values, and of a first, rough solution.
GOAL, PILOT_GOAL = 1e-3, 0.1
# Steps grow with the speed of the slowest vibration to this power: lighter payloads vibrate
# faster, and less. Paper's example, 4 kg against 6 kg: 0.4 initial, 0.6 optimised.
GROWTH = 0.5
# Steps times coordinates of a batch: with more, arrays leave the processor's cache.
MAX_SIZE = 40_000
CHORD_RATE = 0.2  # contraction that keeps a matrix: a new one costs four iterations
LEAST_RATE = 0.2  # contraction that is believed: the first step may fall far better than later ones
# Of a matrix that was made so near that a new one would be no better.
NEAR, NEAR_RATE = 0.02, 0.6
# Contraction of Newton's iteration up to which one answer, with what it may leave, estimates the
# error; beyond it is corrected, which takes an eighth of the time of all.
TRUSTED = 0.2


# -- what is solved --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Family:
    """R problems whose mechanisms differ by numbers alone, in the vibrations of the first.

    Attributes:
        problems: as given.
        modes: of the first; its bodies' D is the damping's shape, see `scales`.
        payload: (R, 4) mass, inertia, g_x, g_y.
        scales: (R, bodies, 3) of mass, stiffness and damping.
    """

    problems: tuple[ElasticProblem, ...]
    modes: Modes
    payload: np.ndarray
    scales: np.ndarray

    def mechanism(self, members: np.ndarray, times: int) -> Mechanism:
        """Return that of some problems at `times` instants each, one problem after the other."""
        payload = np.repeat(self.payload[members], times, axis=0).T.copy()
        scales = np.repeat(self.scales[members], times, axis=0).transpose(1, 2, 0).copy()
        return replace(
            self.modes.problem.mechanism,
            payload_mass=payload[0],
            payload_inertia=payload[1],
            gravity=(payload[2], payload[3]),
            scales=tuple(Scale(*one) for one in scales),
        )

    def motions(
        self, members: np.ndarray, method: Collocation, edges: np.ndarray
    ) -> tuple[RigidMotion, RigidMotion]:
        """Return `collocation.motions` of some problems, one after the other, on edges (R, n + 1).

        Those that share motion and edges are asked once.
        """
        known: dict[tuple[int, bytes], tuple[RigidMotion, RigidMotion]] = {}
        keys = []
        for member, own in zip(members, edges, strict=True):
            motion = self.problems[member].motion
            keys.append((id(motion), own.tobytes()))
            if keys[-1] not in known:
                known[keys[-1]] = motions(motion, method, own)
        inner, middle = zip(*(known[key] for key in keys), strict=True)
        return _joined(inner), _joined(middle)

    def motion(self, shares: np.ndarray) -> RigidMotion:
        """Return that of all problems at some shares of their horizons, one after the other.

        Those that share motion and horizon are asked once.
        """
        known: dict[tuple[int, float], RigidMotion] = {}
        keys = []
        for problem in self.problems:
            keys.append((id(problem.motion), problem.breakpoints[-1]))
            if keys[-1] not in known:
                known[keys[-1]] = problem.motion(shares * problem.breakpoints[-1])
        return _joined([known[key] for key in keys])

    @cached_property
    def diagonal(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stiffness, damping and mass (R, N) of every coordinate alone, the latter averaged."""
        size = self.modes.problem.mechanism.coordinates
        members = np.arange(len(self.problems))
        motion = self.motion(np.linspace(0.0, 1.0, REFERENCES))
        rest = np.zeros((REFERENCES * len(members), size))
        slopes = linearise(self.mechanism(members, REFERENCES), motion, rest, rest, rest).dense()
        own = np.arange(size)
        mass = slopes[:, own, 2 * size + own].reshape(len(members), REFERENCES, size).mean(axis=1)
        parts = self.modes.problem.mechanism.slices
        bodies = self.modes.problem.mechanism.bodies
        k, d = np.empty_like(mass), np.empty_like(mass)
        for i, (part, body) in enumerate(zip(parts, bodies, strict=True)):
            k[:, part] = self.scales[:, i, 1:2] * np.diag(body.K)
            d[:, part] = self.scales[:, i, 2:] * np.diag(body.D)
        return k, d, mass


def _joined(motions: Sequence[RigidMotion]) -> RigidMotion:
    """Return several motions one after the other."""
    names = ("q", "qd", "qdd")
    return RigidMotion(*(np.concatenate([getattr(m, name) for m in motions]) for name in names))


def related(problems: Sequence[ElasticProblem]) -> list[np.ndarray | None]:
    """Return every problem's `Family.scales` (bodies, 3) of the first one's bodies, or None.

    The damping's shape is the stiffness where it is proportional to it.
    """
    reference = problems[0].mechanism.bodies
    dampers = [_shape_of_damping(body) for body in reference]
    found: list[np.ndarray | None] = []
    for problem in problems:
        bodies = problem.mechanism.bodies
        scales = None
        if len(bodies) == len(reference) and len(problem.breakpoints) == len(
            problems[0].breakpoints
        ):
            rows = [_scale(a, b, c) for a, b, c in zip(reference, bodies, dampers, strict=True)]
            scales = None if any(row is None for row in rows) else np.array(rows)
        found.append(scales)
    return found


def _shape_of_damping(body: ShapeIntegrals) -> np.ndarray:
    return body.K if proportion([body.K], [body.D]) is not None else body.D


def _scale(
    body: ShapeIntegrals, other: ShapeIntegrals, damper: np.ndarray
) -> tuple[float, float, float] | None:
    """Return what makes one body the other: of its mass, stiffness, damping; None if nothing."""
    if not same_geometry(body, other):
        return None
    mass = proportion(*proportional(body, other, "mass"))
    stiffness = proportion(*proportional(body, other, "stiffness"))
    damping = proportion([damper], [other.D])
    if mass is None or stiffness is None or damping is None:
        return None
    return mass, stiffness, damping


def family_of(problems: Sequence[ElasticProblem], scales: Sequence[np.ndarray]) -> Family:
    """Return problems that are `related`."""
    first = problems[0]
    bodies = tuple(replace(b, D=_shape_of_damping(b)) for b in first.mechanism.bodies)
    modes = modes_of(replace(first, mechanism=replace(first.mechanism, bodies=bodies)))
    payload = [
        (m.payload_mass, m.payload_inertia, *m.gravity) for m in (p.mechanism for p in problems)
    ]
    return Family(tuple(problems), modes, np.array(payload, dtype=float), np.array(scales))


# -- a grid ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Grid:
    """Some problems of a family on their steps.

    Attributes:
        family: of which.
        members: (R,) indices of the problems.
        edges: (R, n + 1) of each, s.
        stages: number of them.
        state: q, qd (R, N) that they start from.
    """

    family: Family
    members: np.ndarray
    edges: np.ndarray
    stages: int
    state: State

    def part(self, chosen: np.ndarray) -> Grid:
        """Return some of the problems."""
        state = (self.state[0][chosen], self.state[1][chosen])
        return replace(self, members=self.members[chosen], edges=self.edges[chosen], state=state)

    def collocated(self, stages: int) -> Stages:
        """Return all steps with so many stages."""
        method = radau_iia(stages)
        h = np.diff(self.edges, axis=1)
        mechanism = self.family.mechanism(self.members, h.shape[1] * stages)
        motion, middle = self.family.motions(self.members, method, self.edges)
        frequencies = self.family.modes.frequencies
        runs = len(self.members)
        return Stages(mechanism, frequencies, method, h.ravel(), motion, middle, runs)

    @cached_property
    def own(self) -> Stages:
        """Its steps with its own stages."""
        return self.collocated(self.stages)

    @cached_property
    def slow(self) -> np.ndarray:
        """Coordinates that are slow in one of the problems, ascending."""
        k, _, m = (x[self.members] for x in self.family.diagonal)
        angles = np.sqrt(k / m) * np.median(np.diff(self.edges, axis=1), axis=1)[:, None]
        return np.flatnonzero(angles.min(axis=0) <= max(LIMIT, angles.min()))

    def factors(self, stages: Stages, begin: State, a: np.ndarray) -> Factors:
        """Return Newton's matrix, the tangent taken in the middle of every step.

        Args:
            stages: of the steps.
            begin: q, qd (n, N) at the steps' beginnings.
            a: (n, s, N).
        """
        k, d, m = (np.repeat(x[self.members], stages.length, axis=0) for x in self.family.diagonal)
        return held_factors(stages, begin, a, self.slow, (k, d, m))

    def energies(self, q: np.ndarray) -> np.ndarray:
        """Return the largest norms (R, arms) of q (n, s, N); the stiffness is one here."""
        parts = self.family.modes.problem.mechanism.slices
        squares = np.square(q).reshape(len(self.members), -1, q.shape[2])
        return np.stack([np.sqrt(squares[:, :, p].sum(axis=2).max(axis=1)) for p in parts], axis=1)

    def relative(self, change: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return `problem.relative_error` of every problem (R,); inf where it is no number."""
        size = self.energies(q)
        largest = size.max(axis=1, keepdims=True)
        size = np.where(largest > 0.0, np.maximum(size, 1e-3 * largest), 1.0)
        moved = (self.energies(change) / size).max(axis=1)
        return np.where(np.isfinite(moved), moved, np.inf)


def _steps(problem: ElasticProblem, edges: np.ndarray) -> np.ndarray:
    """Return how many steps lie between the breakpoints."""
    return np.diff(np.searchsorted(edges, problem.breakpoints))


def _common_edges(problems: Sequence[ElasticProblem], steps: Sequence[int]) -> np.ndarray:
    """Return edges (R, n + 1) of so many even steps between the breakpoints."""
    ends = np.array([problem.breakpoints for problem in problems])
    pieces = [
        np.linspace(a, b, n, endpoint=False, axis=1)
        for a, b, n in zip(ends.T[:-1], ends.T[1:], steps, strict=True)
    ]
    return np.concatenate([*pieces, ends[:, -1:]], axis=1)


def _static_starts(family: Family) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates (R, N) at rest at t = 0, and whether they were found (R,)."""
    members = np.arange(len(family.problems))
    size = family.modes.problem.mechanism.coordinates
    mechanism = family.mechanism(members, 1)
    motion = family.motion(np.zeros(1))
    q = rest = np.zeros((len(members), size))
    before = np.full(len(members), np.inf)
    done = np.zeros(len(members), dtype=bool)
    for _ in range(50):
        rows = elastic_rows(mechanism, motion, q, rest, rest)
        done |= ~rows.any(axis=1)
        if done.all():
            break
        slopes = linearise(mechanism, motion, q, rest, rest).dense()[:, :, :size]
        try:
            step = np.linalg.solve(slopes, -rows[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            break
        q = np.where(done[:, None], q, q + step)
        largest = np.maximum(np.abs(q).max(axis=1), np.finfo(float).tiny)
        moved = np.abs(step).max(axis=1) / largest
        done |= (moved <= 1e-14) | ((moved <= 1e-8) & (moved >= 0.5 * before))
        before = moved
    return q, done


# -- Newton ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Found:
    """Accelerations (R, n, s, N), who converged, contractions, iterations (R,)."""

    a: np.ndarray
    converged: np.ndarray
    rate: np.ndarray
    iterations: np.ndarray


def _newton(grid: Grid, a: np.ndarray, goal: float) -> _Found:
    """Return what Newton's method makes of guesses a (R, n, s, N), until `goal` is left at most.

    As `radau`'s, undamped. Whoever has converged stays; whoever needs a new matrix gets one
    together with all others that have not converged.
    """
    a = a.copy()
    count = len(a)
    converged, left = np.zeros(count, dtype=bool), np.arange(count)
    rate, iterations = np.zeros(count), np.zeros(count, dtype=int)
    for _ in range(MAX_NEWTON):
        part = grid if len(left) == count else grid.part(left)
        found = _chord(part, a[left], goal)
        a[left], converged[left], rate[left] = found.a, found.converged, found.rate
        iterations[left] += found.iterations
        left = left[~found.converged & np.isfinite(found.rate)]
        if len(left) == 0:
            break
    return _Found(a, converged, rate, iterations)


@np.errstate(all="ignore")  # of what diverges
def _chord(grid: Grid, a: np.ndarray, goal: float) -> _Found:
    """Iterate with one matrix until all have converged, or one calls for another matrix.

    The rate of whoever is lost is inf.
    """
    runs, shape = len(a), a.shape
    stages, flat = grid.own, (-1, *a.shape[2:])
    a = a.reshape(flat)
    begin = beginnings(stages, grid.state, a)
    q, qd = stage_values(stages, *begin, a)
    rows = rows_at(stages, q, qd, a)
    factors = grid.factors(stages, begin, a)
    norm = norm_before = _largest(rows, runs)
    before, worst = np.full(runs, np.inf), np.zeros(runs)
    done, iterations = np.zeros(runs, dtype=bool), np.zeros(runs, dtype=int)
    rest = np.zeros((2, a.shape[2]))
    made: np.ndarray | None = None  # how far from where it is used the matrix was made
    while True:
        step, shift = factors.solve(rows, rest)
        moved = grid.relative(shift, q + shift)
        seen = np.maximum(moved / before, norm / norm_before)
        rate = np.clip(np.where(np.isfinite(seen), seen, 0.5), LEAST_RATE, 0.5)
        lost = ~done & ~np.isfinite(moved)
        going = ~done & ~lost
        if made is None:
            made = moved
        rate_kept = np.where(made <= NEAR, NEAR_RATE, CHORD_RATE)
        poor = going & ~(moved <= rate_kept * before)
        ends = going & (rate / (1.0 - rate) * moved <= goal)
        iterations += ~done
        a = a + step * np.repeat(going, stages.length)[:, None, None]
        worst = np.where(going & np.isfinite(before), np.maximum(worst, moved / before), worst)
        done |= ends
        worst[lost] = np.inf
        if (done | lost).all() or (poor & ~done).any():
            break
        q, qd = at_stages(stages, grid.state, a)
        rows = rows_at(stages, q, qd, a)
        shrinks = np.isfinite(before) & (moved <= CHORD_RATE * before)
        before, norm_before, norm = moved, norm, _largest(rows, runs)
        grown = ~done & ~shrinks & ~(norm <= 0.9 * norm_before)
        done |= grown & (moved <= radau.ROUNDING)
        grown &= ~done
        if grown.any():
            fresh = ~np.isfinite(worst) | (worst == 0.0)
            worst[grown & fresh] = np.inf  # damping would be needed
            break
    return _Found(a.reshape(shape), done, worst, iterations)


def _largest(rows: np.ndarray, runs: int) -> np.ndarray:
    return np.abs(rows).reshape(runs, -1).max(axis=1)


def _errors(grid: Grid, a: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return every problem's relative error (R,), see `radau._error`.

    Corrected where the iterations contracted slowly; else what a correction could add is added.
    """
    stages = grid.own
    finer = radau_iia(grid.stages + 1)
    richer = grid.collocated(grid.stages + 1)
    begin = beginnings(stages, grid.state, a)
    unseen = _unseen(grid, begin, a)
    a = lagrange_integrals(stages.method.c, finer.c)[0] @ a
    q, qd = stage_values(richer, *begin, a)
    factors = grid.factors(richer, begin, a)
    rest = np.zeros((2, a.shape[2]))
    step, shift = factors.solve(rows_at(richer, q, qd, a), rest)
    if rate.max(initial=0.0) > TRUSTED:
        there = at_stages(richer, grid.state, a + step)
        _, more = factors.solve(rows_at(richer, *there, a + step), rest)
        return grid.relative(shift + more, q) + unseen
    return grid.relative(shift, q) / (1.0 - rate) + unseen


def _unseen(grid: Grid, begin: State, a: np.ndarray) -> np.ndarray:
    """Return the relative error (R,) of vibrations that the steps do not resolve."""
    states = (*stage_values(grid.own, *begin, a), a)
    single = tuple(x[grid.members] for x in grid.family.diagonal)
    breakpoints = grid.family.problems[grid.members[0]].breakpoints
    kinks = np.searchsorted(grid.edges[0], breakpoints)[:-1]
    blind = unresolved(grid.own, single, states, grid.state[0], kinks)
    return grid.relative(blind[:, None], states[0])


# -- all of it -------------------------------------------------------------------------------


def integrate(
    problems: Sequence[ElasticProblem],
    tolerance: float,
    stages: int,
    ledger: Ledger,
    starts: Sequence[Solution | None],
    goal: float = GOAL,
) -> list[Solution | ConvergenceError]:
    """Solve every problem as `radau.integrate` does, related ones at once.

    Whatever the order of the problems, the answers are the same.

    Args:
        problems: what to solve.
        tolerance, stages, ledger: as there.
        starts: solution of a nearby problem for each, or None.
        goal: what Newton's method may leave, as a share of the tolerance.

    Returns:
        In the same order; a problem that cannot be solved has its error.
    """
    found: list[Solution | ConvergenceError | None] = [None] * len(problems)
    order = sorted(range(len(problems)), key=lambda i: _content(problems[i]))
    while order:
        scales = related([problems[i] for i in order])
        mine = [i for i, scale in zip(order, scales, strict=True) if scale is not None]
        if len(mine) > 1:
            family = family_of([problems[i] for i in mine], [s for s in scales if s is not None])
            given = [starts[i] for i in mine]
            solutions = _together(family, tolerance, stages, ledger, given, goal)
        else:
            solutions = [None]
        for i, solution in zip(mine, solutions, strict=True):
            found[i] = solution or _alone(problems[i], tolerance, stages, ledger, starts[i])
        order = [i for i, scale in zip(order, scales, strict=True) if scale is None]
    return [one for one in found if one is not None]


def _alone(
    problem: ElasticProblem, tolerance: float, stages: int, ledger: Ledger, start: Solution | None
) -> Solution | ConvergenceError:
    try:
        return radau.integrate(problem, tolerance, stages, ledger, start)
    except ConvergenceError as error:
        return error


def _content(problem: ElasticProblem) -> tuple[Any, ...]:
    """Return numbers to sort by: light payloads and stiff arms, which need most steps, first."""
    mechanism = problem.mechanism
    own = [(np.trace(b.K), np.trace(b.D), b.mass) for b in mechanism.bodies]
    stiffness = sum(k for k, _, _ in own)
    speed = problem.breakpoints[-1] ** 2 * stiffness / (mechanism.payload_mass + 1e-300)
    motion = problem.motion(np.array(problem.breakpoints) * 0.37)
    return (
        -float(speed),
        mechanism.payload_mass,
        mechanism.payload_inertia,
        *mechanism.gravity,
        *(float(x) for row in own for x in row),
        *problem.breakpoints,
        *(float(x) for x in motion.q.ravel()),
    )


def _together(
    family: Family,
    tolerance: float,
    stages: int,
    ledger: Ledger,
    starts: Sequence[Solution | None],
    goal: float,
) -> list[Solution | None]:
    """Return the solutions of a family; None where it takes `radau.integrate`.

    From cold a middle one is solved roughly first: it gives the steps and first guess of all.
    """
    problems = family.problems
    found: list[Solution | None] = [None] * len(problems)
    rest, able = _static_starts(family)
    left = np.flatnonzero(able)
    guesses, more = list(starts), 1.0
    if any(guesses[i] is None for i in left):
        pilot, more = _pilot(family, left, rest, tolerance, stages, ledger)
        guesses = [pilot if one is None else one for one in guesses]
        if pilot is None:
            left = np.array([i for i in left if guesses[i] is not None], dtype=int)
    again = [starts[i] is not None for i in range(len(problems))]
    for _ in range(MAX_GRIDS):
        wanted: dict[tuple[int, ...], list[int]] = {}
        for group in _alike(family, left, guesses, again):
            steps = _wanted_steps(family, group, guesses, tolerance, stages)
            if not again[group[0]]:
                steps = np.ceil(more * steps).astype(int)
            wanted.setdefault(tuple(steps), []).extend(group)
        missing = []
        for steps, group in wanted.items():
            most = max(1, MAX_SIZE // (rest.shape[1] * sum(steps)))
            for first in range(0, len(group), most):
                members = np.array(group[first : first + most])
                edges = _common_edges([problems[i] for i in members], steps)
                grid = Grid(family, members, edges, stages, _resting(rest[members]))
                for i, solution in zip(
                    members, _on_grid(grid, guesses, goal * tolerance), strict=True
                ):
                    if solution is None:
                        continue
                    ledger.counts.newton_iterations += solution.iterations
                    guesses[i], again[i] = solution, True
                    if solution.error <= radau.ACCEPT * tolerance:
                        found[i] = solution
                    else:
                        missing.append(i)
        left = np.array(sorted(missing), dtype=int)
    return found


def _alike(
    family: Family, members: np.ndarray, guesses: Sequence[Solution | None], known: Sequence[bool]
) -> list[list[int]]:
    """Return the problems whose guesses are on as many steps, and those without their own."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for i in members:
        guess = guesses[i]
        assert guess is not None
        steps = tuple(_steps(family.problems[i], guess.edges)) if known[i] else ()
        groups.setdefault(steps, []).append(int(i))
    return list(groups.values())


def _wanted_steps(
    family: Family,
    members: Sequence[int],
    guesses: Sequence[Solution | None],
    tolerance: float,
    stages: int,
) -> np.ndarray:
    """Return the steps between breakpoints that serve all: those they have, if the worst allows."""
    every = []
    for i in members:
        problem = family.problems[i]
        every.append(_steps(problem, radau.next_edges(problem, guesses[i], tolerance, stages)))
    return np.max(every, axis=0)


def _pilot(
    family: Family,
    members: np.ndarray,
    rest: np.ndarray,
    tolerance: float,
    stages: int,
    ledger: Ledger,
) -> tuple[Solution | None, float]:
    """Solve the middle one of the problems, or one beside it, on a first grid.

    Returns:
        The solution, if there is one, and how many times more steps the fastest one may need.
    """
    horizons = np.array([family.problems[i].breakpoints[-1] for i in members])
    speeds = horizons * np.sqrt((family.diagonal[0] / family.diagonal[2])[members].min(axis=1))
    for k in range(len(members) // 2, len(members))[:MAX_PILOTS]:
        own = members[k : k + 1]
        problem = family.problems[own[0]]
        edges = even_steps(problem, first_count(problem))[None]
        grid = Grid(family, own, edges, stages, _resting(rest[own]))
        (solution,) = _on_grid(grid, [None] * len(family.problems), PILOT_GOAL * tolerance)
        if solution is not None:
            ledger.counts.newton_iterations += solution.iterations
            return solution, max(1.0, float(speeds.max() / speeds[k]) ** GROWTH)
    return None, 1.0


def _resting(q: np.ndarray) -> State:
    return q, np.zeros_like(q)


def _on_grid(grid: Grid, guesses: Sequence[Solution | None], goal: float) -> list[Solution | None]:
    """Return every problem's solution on the grid, None where Newton's method fails."""
    modes, count = grid.family.modes, grid.edges.shape[1] - 1
    nodes = radau_iia(grid.stages).c
    a = np.stack([_guess(grid, i, guesses[m]) for i, m in enumerate(grid.members)])
    found = _newton(grid, modes.to_modes(a), goal)
    chosen = np.flatnonzero(found.converged)
    out: list[Solution | None] = [None] * len(a)
    if len(chosen) == 0:
        return out
    part = grid if len(chosen) == len(a) else grid.part(chosen)
    z = found.a[chosen].reshape(-1, *a.shape[2:])
    errors = _errors(part, z, found.rate[chosen])
    q, qd = (
        modes.from_modes(x).reshape(len(chosen), count, -1)
        for x in beginnings(part.own, part.state, z)
    )
    a = modes.from_modes(found.a[chosen])
    for k, i in enumerate(chosen):
        spent = int(found.iterations[i])
        out[i] = Solution(grid.edges[i], nodes, q[k], qd[k], a[k], float(errors[k]), spent)
    return out


def _guess(grid: Grid, i: int, start: Solution | None) -> np.ndarray:
    """Return accelerations (n, s, N) from a solution, its horizon stretched to this one."""
    nodes, edges = radau_iia(grid.stages).c, grid.edges[i]
    if start is None:
        size = grid.family.modes.problem.mechanism.coordinates
        return np.zeros((len(edges) - 1, len(nodes), size))
    if np.array_equal(start.edges, edges) and np.array_equal(start.nodes, nodes):
        return start.a
    times = edges[:-1, None] + np.diff(edges)[:, None] * nodes
    stretched = times.ravel() * (start.edges[-1] / edges[-1])
    return start.sample(stretched, 2).reshape(*times.shape, -1)
