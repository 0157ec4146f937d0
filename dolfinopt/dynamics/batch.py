"""Several systems of the same bodies at once: other payloads, motions, gravity, materials.

Their steps are as many, and lie one system after the other in every array, so that a call of NumPy
serves them all. All are solved in the vibrations of the first one's arms: the change of coordinates
is exact, only how well they uncouple is not. What does not converge here, undamped and with the
simplified Newton matrix, is left to `radau.integrate`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.batch_system import BatchModes, BatchSystem, batch_of, related
from dolfinopt.dynamics.collocation import Stages
from dolfinopt.dynamics.elastic_system import ElasticSystem, static_equilibrium
from dolfinopt.dynamics.newton import Iterate, Tuning, newton
from dolfinopt.dynamics.patience import GivenUp
from dolfinopt.dynamics.solution import Solution
from dolfinopt.dynamics.system import State
from dolfinopt.dynamics.time_grid import (
    even_steps,
    first_num_steps,
    steps_between_breakpoints,
)
from dolfinopt.errors import ConvergenceError
from dolfinopt.profiling import Profile

# Of runs that share a matrix. Coordinates are slow up to an angle of 20: dense blocks of many runs
# cost more than an iteration. What needs more than 6 matrices needs damping, and windows. A new
# matrix costs four iterations: one is kept with a contraction of 0.2, or 0.6 where a new one would
# be no better.
RUNS = Tuning(
    limits=(20.0, np.inf),
    least_rate=0.2,  # the first step may fall far better than later ones
    keep=(0.2, 0.2),
    near=0.02,
    keep_near=0.6,
    shortest=1.0,
    matrices=6,
)
MAX_GRIDS = 4  # refinements until a system is left to `radau.integrate`
MAX_PILOTS = 3  # systems that are tried for a first, rough solution
# What Newton may leave, about, over the tolerance: of values, and of a first, rough solution.
GOAL, PILOT_GOAL = 1e-3, 0.1
# Steps grow with the speed of the slowest vibration to this power: lighter payloads vibrate
# faster, and less. Paper's example, 4 kg against 6 kg: 0.4 initial, 0.6 optimised.
GROWTH = 0.5
# Steps times coordinates of a batch: with more, arrays leave the processor's cache.
MAX_SIZE = 40_000


def integrate(
    systems: Sequence[ElasticSystem],
    tolerance: float,
    stages: int,
    profile: Profile,
    guesses: Sequence[Solution | None],
    goal: float = GOAL,
) -> list[Solution | ConvergenceError]:
    """Solve every system as `radau.integrate` does, related ones at once.

    Whatever the order of the systems, the answers are the same.

    Args:
        systems: what to solve.
        tolerance, stages, profile: as there.
        guesses: solution of a nearby system for each, or None.
        goal: what Newton's method may leave, as a share of the tolerance.

    Returns:
        In the same order; a system that cannot be solved has its error.
    """
    if len(systems) == 1:  # as a batch of one it takes 1.6 times as long from cold, q = 4
        return [attempted(radau.integrate, systems[0], tolerance, stages, profile, guesses[0])]
    found: list[Solution | ConvergenceError | None] = [None] * len(systems)
    order = sorted(range(len(systems)), key=lambda i: _content(systems[i]))
    while order:
        scales = related([systems[i] for i in order])
        mine = [i for i, scale in zip(order, scales, strict=True) if scale is not None]
        if len(mine) > 1:
            batch = batch_of([systems[i] for i in mine], [s for s in scales if s is not None])
            given = [guesses[i] for i in mine]
            solutions = _together(batch, tolerance, stages, profile, given, goal)
        else:
            solutions = [None]
        for i, solution in zip(mine, solutions, strict=True):
            found[i] = solution or attempted(
                radau.integrate, systems[i], tolerance, stages, profile, guesses[i]
            )
        order = [i for i, scale in zip(order, scales, strict=True) if scale is None]
    return [one for one in found if one is not None]


def attempted(solve: Callable[..., Solution], *arguments: Any) -> Solution | ConvergenceError:
    """Return what `solve` finds, or its error."""
    try:
        return solve(*arguments)
    except ConvergenceError as error:
        return error


def _content(system: ElasticSystem) -> tuple[Any, ...]:
    """Return numbers to sort by: light payloads and stiff arms, which need most steps, first."""
    mechanism = system.mechanism
    own = [(np.trace(b.K), np.trace(b.D), b.mass) for b in mechanism.bodies]
    stiffness = sum(k for k, _, _ in own)
    speed = system.breakpoints[-1] ** 2 * stiffness / (mechanism.payload_mass + 1e-300)
    motion = system.motion(np.array(system.breakpoints) * 0.37)
    return (
        -float(speed),
        mechanism.payload_mass,
        mechanism.payload_inertia,
        *mechanism.gravity,
        *(float(x) for row in own for x in row),
        *system.breakpoints,
        *(float(x) for x in motion.q.ravel()),
    )


def _together(
    batch: BatchSystem,
    tolerance: float,
    stages: int,
    profile: Profile,
    known: Sequence[Solution | None],
    goal: float,
) -> list[Solution | None]:
    """Return the solutions of a batch; None where it takes `radau.integrate`.

    From cold a middle one is solved roughly first: it gives the steps and first guess of all.
    """
    modes = batch.preconditioner()
    found: list[Solution | None] = [None] * batch.runs
    rest, able = static_equilibrium(batch)
    left, guesses, more = np.flatnonzero(able), list(known), 1.0
    if any(guesses[i] is None for i in left):
        pilot, more = _pilot(modes, left, rest, tolerance, stages, profile)
        guesses = [pilot if one is None else one for one in guesses]
        if pilot is None:
            left = np.array([i for i in left if guesses[i] is not None], dtype=int)
    own = [one is not None for one in known]  # whether a guess is of the system itself
    tuning = replace(RUNS, goal=goal)
    for _ in range(MAX_GRIDS):
        missing = []
        for steps, group in _groups(batch, left, guesses, own, more, tolerance, stages).items():
            most = max(1, MAX_SIZE // (rest.shape[1] * sum(steps)))
            for first in range(0, len(group), most):
                members = np.array(group[first : first + most])
                time_grids = _common_time_grids([batch.members[i] for i in members], steps)
                solutions = _on_grid(
                    modes.chosen(members),
                    time_grids,
                    stages,
                    rest[members],
                    [guesses[i] for i in members],
                    tolerance,
                    tuning,
                )
                for i, solution in zip(members, solutions, strict=True):
                    if solution is None:
                        continue
                    profile.counts.newton_iterations += solution.iterations
                    guesses[i], own[i] = solution, True
                    if solution.error <= radau.ACCEPT * tolerance:
                        found[i] = solution
                    else:
                        missing.append(i)
        left = np.array(sorted(missing), dtype=int)
    return found


def _groups(
    batch: BatchSystem,
    left: np.ndarray,
    guesses: Sequence[Solution | None],
    own: Sequence[bool],
    more: float,
    tolerance: float,
    stages: int,
) -> dict[tuple[int, ...], list[int]]:
    """Return the systems that are solved together, by their steps between the breakpoints.

    Those whose own guesses are on as many steps keep them, if the worst allows; those without one
    take `more` steps than the pilot.
    """
    alike: dict[tuple[int, ...], list[int]] = {}
    wanted: dict[int, np.ndarray] = {}
    for i in left:
        system, guess = batch.members[i], guesses[i]
        assert guess is not None
        try:
            grid = radau.next_time_grid(system, guess, tolerance, stages)
        except GivenUp:  # more steps than there is room for: left to whoever solves it by itself
            continue
        steps = tuple(steps_between_breakpoints(system, guess.time_grid)) if own[i] else ()
        alike.setdefault(steps, []).append(int(i))
        wanted[int(i)] = steps_between_breakpoints(system, grid)
    groups: dict[tuple[int, ...], list[int]] = {}
    for group in alike.values():
        most = np.max([wanted[i] for i in group], axis=0)
        if not own[group[0]]:
            most = np.ceil(more * most).astype(int)
        groups.setdefault(tuple(most), []).extend(group)
    return groups


def _pilot(
    modes: BatchModes,
    members: np.ndarray,
    rest: np.ndarray,
    tolerance: float,
    stages: int,
    profile: Profile,
) -> tuple[Solution | None, float]:
    """Solve the middle one of the systems, or one beside it, on a first grid.

    Returns:
        The solution, if there is one, and how many times more steps the fastest one may need.
    """
    batch, tuning = modes.system, replace(RUNS, goal=PILOT_GOAL)
    horizons = np.array([batch.members[i].breakpoints[-1] for i in members])
    speeds = horizons * modes.frequencies[members].min(axis=1)
    for k in range(len(members) // 2, len(members))[:MAX_PILOTS]:
        own = members[k : k + 1]
        system = batch.members[own[0]]
        grid = even_steps(system, first_num_steps(system))[None]
        chosen = modes.chosen(own)
        (solution,) = _on_grid(chosen, grid, stages, rest[own], [None], tolerance, tuning)
        if solution is not None:
            profile.counts.newton_iterations += solution.iterations
            return solution, max(1.0, float(speeds.max() / speeds[k]) ** GROWTH)
    return None, 1.0


def _on_grid(
    modes: BatchModes,
    time_grids: np.ndarray,
    stages: int,
    rest: np.ndarray,
    guesses: Sequence[Solution | None],
    tolerance: float,
    tuning: Tuning,
) -> list[Solution | None]:
    """Return every system's solution on its grid, see `radau.on_grids`, from rest (R, N)."""

    def solve(steps: Stages, state: State, first: np.ndarray) -> Iterate:
        return newton(steps, state, first, tolerance, tuning)

    state = (rest, np.zeros_like(rest))
    return radau.on_grids(modes, time_grids, state, guesses, stages, solve, tuning.limits)


def _common_time_grids(systems: Sequence[ElasticSystem], steps: Sequence[int]) -> np.ndarray:
    """Return time grids (R, n + 1) of so many even steps between the breakpoints."""
    ends = np.array([system.breakpoints for system in systems])
    pieces = [
        np.linspace(a, b, n, endpoint=False, axis=1)
        for a, b, n in zip(ends.T[:-1], ends.T[1:], steps, strict=True)
    ]
    return np.concatenate([*pieces, ends[:, -1:]], axis=1)
