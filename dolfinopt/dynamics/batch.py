"""Several systems of the same bodies at once: other payloads, motions, gravity, materials.

Their steps are as many, and lie one system after the other in every array, so that a call of NumPy
serves them all. All are solved in the vibrations of the first one's arms: the change of coordinates
is exact, only how well they uncouple is not. What does not converge here, undamped and with the
simplified Newton matrix, is left to `radau.integrate`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.collocation import (
    GivenUp,
    Solution,
    Stages,
    even_steps,
    first_num_steps,
    steps_between_breakpoints,
)
from dolfinopt.dynamics.elastic_system import (
    ElasticInstants,
    ElasticSystem,
    Modes,
    modes_of,
    proportion,
    static_equilibrium,
)
from dolfinopt.dynamics.measured import (
    BATCH_GRIDS_LIMIT,
    BATCH_NEWTON_SHARE,
    BATCH_SIZE_LIMIT,
    MEAN_MASS_INSTANTS,
    PILOT_NEWTON_SHARE,
    PILOTS_LIMIT,
    RADAU_ESTIMATE_SHARE,
    SPEED_EXPONENT,
)
from dolfinopt.dynamics.newton import Iterate, Tuning, newton_batch
from dolfinopt.dynamics.system import State
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.body_motion import Constants, Scale
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
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
    matrices=6,
)


def integrate(
    systems: Sequence[ElasticSystem],
    tolerance: float,
    stages: int,
    profile: Profile,
    guesses: Sequence[Solution | None],
    goal: float = BATCH_NEWTON_SHARE,
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
    payload = _payload(system)
    speed = system.breakpoints[-1] ** 2 * stiffness / (payload[0] + 1e-300)
    motion = system.motion(np.array(system.breakpoints) * 0.37)
    return (
        -float(speed),
        *payload,
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
    """Return the solutions of a batch; None where it takes `radau.integrate`."""
    # From cold a middle one is solved roughly first: it gives the steps and first guess of all.
    modes = batch.preconditioner()
    found: list[Solution | None] = [None] * batch.runs
    rest, starts = static_equilibrium(batch)
    left, guesses, more = np.flatnonzero(starts), list(known), 1.0
    if any(guesses[i] is None for i in left):
        pilot, more = _pilot(modes, left, rest, tolerance, stages, profile)
        guesses = [pilot if one is None else one for one in guesses]
        if pilot is None:
            left = np.array([i for i in left if guesses[i] is not None], dtype=int)
    own = [one is not None for one in known]  # whether a guess is of the system itself
    tuning = replace(RUNS, goal=goal)
    for _ in range(BATCH_GRIDS_LIMIT):
        missing = []
        for steps, group in _groups(batch, left, guesses, own, more, tolerance, stages).items():
            most = max(1, BATCH_SIZE_LIMIT // (rest.shape[1] * sum(steps)))
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
                    if solution.error <= RADAU_ESTIMATE_SHARE * tolerance:
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
    """Return the systems that are solved together, by their steps between the breakpoints."""
    # Those whose own guesses are on as many steps keep them, if the worst allows; those without one
    # take `more` steps than the pilot.
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
    """Solve the middle one of the systems, or one beside it, on a first grid; None if it fails."""
    # The second value is how many times more steps the fastest one may need.
    batch, tuning = modes.system, replace(RUNS, goal=PILOT_NEWTON_SHARE)
    horizons = np.array([batch.members[i].breakpoints[-1] for i in members])
    speeds = horizons * modes.frequencies[members].min(axis=1)
    for k in range(len(members) // 2, len(members))[:PILOTS_LIMIT]:
        own = members[k : k + 1]
        system = batch.members[own[0]]
        grid = even_steps(system, first_num_steps(system))[None]
        chosen = modes.chosen(own)
        (solution,) = _on_grid(chosen, grid, stages, rest[own], [None], tolerance, tuning)
        if solution is not None:
            profile.counts.newton_iterations += solution.iterations
            return solution, max(1.0, float(speeds.max() / speeds[k]) ** SPEED_EXPONENT)
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
        return newton_batch(steps, state, first, tolerance, tuning)

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


# -- systems of the same bodies as one: other payloads, motions, gravity, materials side by side


@dataclass(frozen=True, eq=False)
class BatchSystem:
    """R systems whose mechanisms differ by numbers alone, in the vibrations of the first's arms.

    Attributes:
        members: as given.
        modes: of the first; its bodies' D is the damping's shape, see `scales`.
        payload: (R, 4) mass and inertia at the end-effector, g_x, g_y.
        scales: (R, bodies, 3) of mass, stiffness and damping.
    """

    members: tuple[ElasticSystem, ...]
    modes: Modes
    payload: np.ndarray
    scales: np.ndarray

    @property
    def num_coordinates(self) -> int:
        """Number N of elastic coordinates of each."""
        return self.modes.system.num_coordinates

    @property
    def runs(self) -> int:
        """Number R of systems."""
        return len(self.members)

    @property
    def breakpoints(self) -> tuple[float, ...]:
        """Those of the first; the others have as many."""
        return self.members[0].breakpoints

    def chosen(self, runs: np.ndarray) -> BatchSystem:
        """Return some of them, by index."""
        members = tuple(self.members[i] for i in runs)
        return replace(self, members=members, payload=self.payload[runs], scales=self.scales[runs])

    def at(self, t: np.ndarray) -> ElasticInstants:
        """Return all at instants t (R n,), one system after the other, s.

        Those that share motion and instants are asked once.
        """
        known: dict[tuple[int, bytes], RigidMotion] = {}
        motions = []
        for member, own in zip(self.members, t.reshape(self.runs, -1), strict=True):
            key = (id(member.motion), own.tobytes())
            if key not in known:
                known[key] = member.motion(own)
            motions.append(known[key])
        return ElasticInstants(self._mechanism(len(t) // self.runs), _joined(motions))

    def _mechanism(self, times: int) -> Mechanism:
        """Return that of all systems at `times` instants each, one system after the other."""
        mechanism = self.modes.system.mechanism
        payload = np.repeat(self.payload, times, axis=0).T.copy()
        scales = np.repeat(self.scales, times, axis=0).transpose(1, 2, 0).copy()
        return replace(
            mechanism,
            loads={**mechanism.loads, mechanism.end: Constants.of_point(*payload[:2])},
            gravity=payload[2:],
            scales=tuple(Scale(*one) for one in scales),
        )

    def initial_state(self) -> State:
        """Return the static equilibria (R, N) at t = 0.

        Raises:
            ConvergenceError: one of them has none.
        """
        q, found = static_equilibrium(self)
        if not found.all():
            raise ConvergenceError("no static equilibrium")
        return q, np.zeros_like(q)

    def norm(self, q: np.ndarray) -> np.ndarray:
        """Return the largest norms of every arm; the stiffness is one here."""
        return self.modes.system.norm(q)

    def slowest_frequency(self) -> float:
        """Return that of the first system, rad/s."""
        return self.members[0].slowest_frequency()

    def prescribed(self, t: np.ndarray) -> None:
        """Return nothing: members that fewer steps do for are solved first by themselves."""

    def describe(self, q: np.ndarray) -> str:
        """Say how far the first system's arms' ends turn in a motion q (n, N) of it."""
        return self.members[0].describe(q)

    def deflection(self, q: np.ndarray) -> float:
        """Return the largest deflection of an arm in a motion q (n, N) of the first system."""
        return self.members[0].deflection(q)

    def preconditioner(self) -> BatchModes:
        """Return its own coordinates: they are vibrations."""
        size = self.num_coordinates
        shares = np.linspace(0.0, 1.0, MEAN_MASS_INSTANTS)
        t = np.array([member.breakpoints[-1] * shares for member in self.members])
        rest = np.zeros((t.size, size))
        derivative = self.at(t.ravel()).linearise(rest, rest, rest).dense()
        own = np.arange(size)
        mass = derivative[:, own, 2 * size + own].reshape(*t.shape, size).mean(axis=1)
        k, d = np.empty_like(mass), np.empty_like(mass)
        mechanism = self.modes.system.mechanism
        for i, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies, strict=True)):
            k[:, part] = self.scales[:, i, 1:2] * np.diag(body.K)
            d[:, part] = self.scales[:, i, 2:] * np.diag(body.D)
        return BatchModes(self, (k, d, mass))


@dataclass(frozen=True, eq=False)
class BatchModes:
    """Preconditioner of a batch, whose coordinates are vibrations already."""

    system: BatchSystem
    uncoupled: tuple[np.ndarray, np.ndarray, np.ndarray]
    definite = guided = True

    @property
    def frequencies(self) -> np.ndarray:
        """Those of every system's coordinates (R, N), rad/s."""
        k, _, m = self.uncoupled
        return np.sqrt(k / m)

    def to_modes(self, q: np.ndarray) -> np.ndarray:
        """Return z (..., N) of the first system's coordinates q."""
        return self.system.modes.to_modes(q)

    def from_modes(self, z: np.ndarray) -> np.ndarray:
        """Return the first system's coordinates q (..., N)."""
        return self.system.modes.from_modes(z)

    def chosen(self, runs: np.ndarray) -> BatchModes:
        """Return that of some of the systems, by index."""
        k, d, m = (x[runs] for x in self.uncoupled)
        return BatchModes(self.system.chosen(runs), (k, d, m))


def _joined(motions: Sequence[RigidMotion]) -> RigidMotion:
    """Return several motions one after the other."""
    q, qd, qdd = (np.concatenate(x) for x in zip(*((m.q, m.qd, m.qdd) for m in motions)))
    applied = [m.applied for m in motions if m.applied is not None]
    return RigidMotion(q, qd, qdd, np.concatenate(applied) if applied else None)


def related(systems: Sequence[ElasticSystem]) -> list[np.ndarray | None]:
    """Return every system's `BatchSystem.scales` (bodies, 3) of the first one's bodies, or None.

    None of those with other masses and inertias at their joints, too.

    The damping's shape is the stiffness where it is proportional to it.
    """
    reference = systems[0].mechanism.bodies
    dampers = [_shape_of_damping(body) for body in reference]
    found: list[np.ndarray | None] = []
    for system in systems:
        bodies = system.mechanism.bodies
        scales = None
        if _same_hardware(system, systems[0]) and len(bodies) == len(reference):
            rows = [_scale(a, b, c) for a, b, c in zip(reference, bodies, dampers, strict=True)]
            scales = None if any(row is None for row in rows) else np.array(rows)
        found.append(scales)
    return found


def _same_hardware(system: ElasticSystem, other: ElasticSystem) -> bool:
    """Return whether all is equal that a `BatchSystem` takes from its first system alone."""
    one, two = system.mechanism, other.mechanism
    return (
        np.array_equal(one.rotors, two.rotors)
        and np.array_equal(one.origin, two.origin)
        and one.loads.keys() == two.loads.keys()
        and one.forces == two.forces
        and all(
            _point(load) == _point(two.loads[site])
            for site, load in one.loads.items()
            if site != one.end
        )
        and len(system.breakpoints) == len(other.breakpoints)
    )


def _point(load: Constants) -> tuple[float, float]:
    """Return mass and inertia of what is carried at an interface in the plane, kg, kg m2."""
    return float(load.mass), float(load.W_rest[0, 0])


def _payload(system: ElasticSystem) -> tuple[float, ...]:
    """Return what differs between scenarios: mass and inertia at the end-effector, gravity."""
    mechanism = system.mechanism
    return *_point(mechanism.loads[mechanism.end]), *map(float, mechanism.gravity[:, 0])


def _shape_of_damping(body: ShapeIntegrals) -> np.ndarray:
    return body.K if proportion([body.K], [body.D]) is not None else body.D


def _scale(
    body: ShapeIntegrals, other: ShapeIntegrals, damper: np.ndarray
) -> tuple[float, float, float] | None:
    """Return what makes one body the other: of its mass, stiffness, damping; None if nothing."""
    if not body.is_shaped_like(other):
        return None
    mass, stiffness = (
        proportion(body.scaled_by(kind), other.scaled_by(kind)) for kind in ("mass", "stiffness")
    )
    damping = proportion([damper], [other.D])
    if mass is None or stiffness is None or damping is None:
        return None
    return mass, stiffness, damping


def batch_of(systems: Sequence[ElasticSystem], scales: Sequence[np.ndarray]) -> BatchSystem:
    """Return systems that are `related`."""
    first = systems[0]
    bodies = tuple(replace(b, D=_shape_of_damping(b)) for b in first.mechanism.bodies)
    modes = modes_of(replace(first, mechanism=replace(first.mechanism, bodies=bodies)))
    payload = np.array([_payload(system) for system in systems])
    return BatchSystem(tuple(systems), modes, payload, np.array(scales))
