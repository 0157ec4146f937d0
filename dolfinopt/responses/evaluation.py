"""One pass down the street: physical densities -> bodies -> what the scene asks of them.

Only what is asked for is done: a static objective needs neither simulation nor mass matrix, an
eigenfrequency no simulation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dolfinopt.arms.arm import chain_of, fixed_body
from dolfinopt.arms.vibration import (
    Chain,
    LoadedModes,
    RigidIntegrals,
    rigid_integrals,
    squared_period,
)
from dolfinopt.dynamics.problem import Solution
from dolfinopt.dynamics.simulation import Trajectory, simulate_batch
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.multibody.motion import rigid_motion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, first_frequency
from dolfinopt.parallel import ArmShare, gather_arms, on_root, together
from dolfinopt.profiling import Ledger
from dolfinopt.responses.objective import (
    body_slopes_of,
    frozen_moments,
    objective,
    worst_instants,
)
from dolfinopt.responses.scenarios import bodies_in, combined, factors, slopes_back
from dolfinopt.responses.sensitivity import (
    deflection_gradient,
    esl_gradient,
    exact_gradient,
    period_gradient,
    rigid_gradient,
    static_gradient,
)
from dolfinopt.responses.statics import static_response
from dolfinopt.scene.load import Scene, pose_scenarios

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

T = TypeVar("T")
Cells = Mapping[int, np.ndarray]
NOTHING = RigidIntegrals(0.0, 0j, 0.0)


@dataclass(frozen=True)
class Motion:
    """What the simulated motion does to one design.

    Attributes:
        objective: of the motion, nan where it is another; N m, N m s or m.
        compliance: sum of the load cases' compliance, N m.
        max_deviation, max_deviation_time: m, s.
        first_frequencies: of every arm, clamped-free, Hz; inf of a rigid one.
        error: estimated relative error of the elastic coordinates.
        deflections, turns: largest outboard deflection of every arm over its length, and rotation
            in rad.
        scenarios: the same of every scenario.
    """

    objective: float = np.nan
    compliance: float = np.nan
    max_deviation: float = np.nan
    max_deviation_time: float = np.nan
    first_frequencies: tuple[float, ...] = ()
    error: float = np.nan
    deflections: tuple[float, ...] = ()
    turns: tuple[float, ...] = ()
    scenarios: tuple[Motion, ...] = ()


@dataclass(frozen=True)
class Evaluation(Motion):
    """What one design does; the same on all ranks. What the scene did not ask for is nan.

    Attributes:
        objective: see `evaluate`; of all scenarios, if there are any; N m, N m s, m or s2.
        constraints: (k,) of the scene's [constraints], relative, kept where <= 0.
        loaded_frequencies: of every flexible arm with what it carries, Hz; empty unless asked for.
        tip_deflections: largest static one of every designed arm, m; empty unless asked for.
    """

    constraints: tuple[float, ...] = ()
    loaded_frequencies: tuple[float, ...] = ()
    tip_deflections: tuple[float, ...] = ()


def evaluate(
    scene: Scene,
    share: ArmShare,
    arms: Mapping[int, Arm],
    x_phys: Cells,
    ledger: Ledger,
    start: Sequence[Solution] = (),
    *,
    simulated: bool = True,
) -> tuple[Evaluation, Trajectory | None]:
    """Reduce every arm, simulate on the root, evaluate the objective (collective).

    The objective is that of `objective.objective`, or: "static", the sum of the arms' compliance
    under `objective.loads`; "eigenfrequency", the sum of the arms' `squared_period`.

    Args:
        scene: what is simulated and minimised.
        share: which ranks do which arm.
        arms: this rank's.
        x_phys: their physical densities (n_cells,).
        ledger: of this rank.
        start: `Trajectory.solutions` of a nearby design; read on the root only.
        simulated: False leaves out the motion where the objective does not need it.

    Returns:
        The evaluation, and on the root the trajectory, if there is one.

    Raises:
        InputError: densities that are none, see `Arm.refusal`; on all ranks.
        ConvergenceError: on all ranks alike.
    """
    _check_densities(share, arms, x_phys)
    with together(share.world):
        for index, arm in arms.items():
            arm.set_design(x_phys[index])
    motion, trajectory = Motion(), None
    if simulated or scene.objective.simulated:
        owned = _reduced(share, arms, x_phys)
        [(moved, trajectory)] = _moved([scene], share, owned, ledger, [start])
        if isinstance(moved, ConvergenceError):
            raise moved
        motion = moved
    return _judged(scene, share, arms, motion), trajectory


def evaluate_batch(
    scenes: Sequence[Scene],
    share: ArmShare,
    arms: Mapping[int, Arm],
    x_phys: Cells,
    ledger: Ledger,
) -> list[tuple[Evaluation, Trajectory | None] | ConvergenceError]:
    """Evaluate one design in many scenes, whose motions are simulated in one batch (collective).

    Args:
        scenes: of one reduction, in which the arms are the same, see `Arm.under`; or, if nothing
            but their motion is asked for, scaled, see `scenarios.factors`.
        share: which ranks do which arm.
        arms: this rank's, in the first scene.
        x_phys: their physical densities (n_cells,).
        ledger: of this rank.

    Returns:
        What `evaluate` does of every scene, or the error that it would raise.

    Raises:
        InputError: as `evaluate` does.
    """
    _check_densities(share, arms, x_phys)
    try:
        owned = _reduced(share, arms, x_phys)
    except ConvergenceError as error:
        return [error] * len(scenes)
    found: list[tuple[Evaluation, Trajectory | None] | ConvergenceError] = []
    moved = _moved(scenes, share, owned, ledger, [()] * len(scenes))
    for scene, (motion, trajectory) in zip(scenes, moved, strict=True):
        try:
            if isinstance(motion, ConvergenceError):
                raise motion
            under = arms
            if not scene.objective.simulated or any(vars(scene.constraints).values()):
                with together(share.world):
                    under = {k: arm.under(scene) for k, arm in arms.items()}
            found.append((_judged(scene, share, under, motion), trajectory))
        except ConvergenceError as error:
            found.append(error)
    return found


def _check_densities(share: ArmShare, arms: Mapping[int, Arm], x_phys: Cells) -> None:
    """Raise InputError on all ranks where densities of one cannot be those of a design."""
    with together(share.world):
        for k, arm in arms.items():
            missing = "" if k in x_phys else f"arm {arm.mesh.name!r}: expected densities"
            if reason := missing or arm.refusal(x_phys[k]):
                raise InputError(reason)


def _judged(scene: Scene, share: ArmShare, arms: Mapping[int, Arm], motion: Motion) -> Evaluation:
    """Add what the scene asks for beside the motion (collective)."""
    kind, value = scene.objective.kind, motion.objective
    if kind == "static":
        value = _static_compliance(scene, share, arms)
    constraints: list[float] = []
    frequencies: tuple[float, ...] = ()
    if kind == "eigenfrequency" or scene.constraints.first_frequency is not None:
        periods, longest, frequencies = _vibration(scene, share, arms)
        if kind == "eigenfrequency":
            value = float(periods.sum())
        if scene.constraints.first_frequency is not None:
            constraints += list(longest * scene.constraints.first_frequency**2 - 1.0)
    largest: tuple[float, ...] = ()
    if scene.constraints.tip_deflection is not None:
        tips, largest = _deflections(scene, share, arms)
        constraints += list(tips / scene.constraints.tip_deflection - 1.0)
    return Evaluation(
        **vars(replace(motion, objective=value)),
        constraints=tuple(map(float, constraints)),
        loaded_frequencies=frequencies,
        tip_deflections=largest,
    )


def gradient(
    scene: Scene,
    share: ArmShare,
    arms: Mapping[int, Arm],
    trajectory: Trajectory | None,
    ledger: Ledger,
) -> dict[int, np.ndarray]:
    """Return the objective's gradient by the physical densities of this rank's arms (collective).

    Args:
        scene: says which gradient: "esl" freezes the loads, "exact" follows everything.
        share, arms: as for `evaluate`, with the design reduced.
        trajectory: what `evaluate` returned.
        ledger: of this rank.
    """

    def moments() -> dict[int, np.ndarray]:
        assert trajectory is not None
        return _by_owner(scene, _frozen_moments(trajectory))

    def slopes() -> dict[int, ShapeIntegrals]:
        assert trajectory is not None
        ledger.counts.adjoints += max(1, len(trajectory.scenarios))
        with ledger.phase("adjoint"):
            return _by_owner(scene, _body_slopes(trajectory))

    if scene.objective.kind == "static":
        uses = _uses(scene)
        with together(share.world):
            response = {k: static_response(arm.elastic, _loads(scene)) for k, arm in arms.items()}
            return {k: uses[k] * static_gradient(arm, response[k]) for k, arm in arms.items()}
    if scene.objective.kind == "eigenfrequency":
        rows = _period_rows(scene, share, arms, scene.objective.follow)
        return {k: np.sum([row[k] for row in rows], axis=0) for k in arms}
    if scene.objective.gradient == "esl":
        A = on_root(share.world, moments)
        with together(share.world):
            return {index: esl_gradient(arm, A[index]) for index, arm in arms.items()}
    by_body = on_root(share.world, slopes)
    with together(share.world):
        return {index: exact_gradient(arm, by_body[index]) for index, arm in arms.items()}


def constraint_gradients(
    scene: Scene, share: ArmShare, arms: Mapping[int, Arm]
) -> list[dict[int, np.ndarray]]:
    """Return the gradients of `Evaluation.constraints` by the physical densities (collective).

    Args:
        scene, share, arms: as for `gradient`.
    """
    limits = scene.constraints
    rows: list[dict[int, np.ndarray]] = []
    if limits.first_frequency is not None:
        for row in _period_rows(scene, share, arms, follow=False):
            rows.append({k: limits.first_frequency**2 * slope for k, slope in row.items()})
    if limits.tip_deflection is not None:
        for owner in scene.cell_counts:
            slopes = {k: np.zeros(arm.mesh.num_cells) for k, arm in arms.items()}
            with together(share.world):
                if owner in arms:
                    arm, exponent = arms[owner], scene.objective.exponent
                    response = static_response(arm.elastic, _loads(scene))
                    slopes[owner] = deflection_gradient(arm, response, exponent)
                    slopes[owner] /= limits.tip_deflection
            rows.append(slopes)
    return rows


# -- the motion ------------------------------------------------------------------------------


def _reduced(
    share: ArmShare, arms: Mapping[int, Arm], x_phys: Cells
) -> Mapping[int, ShapeIntegrals]:
    """Return the bodies of the arms with a design of their own, on the root (collective)."""
    with together(share.world):
        bodies = {index: arm.reduce(x_phys[index]) for index, arm in arms.items()}
    return gather_arms(share, bodies)


def _moved(
    scenes: Sequence[Scene],
    share: ArmShare,
    owned: Mapping[int, ShapeIntegrals],
    ledger: Ledger,
    starts: Sequence[Sequence[Solution]],
) -> list[tuple[Motion | ConvergenceError, Trajectory | None]]:
    """Simulate the scenes and their scenarios in one batch (collective).

    Args:
        scenes: the bodies are those of the first one.
        share, owned, ledger: as elsewhere.
        starts: of every scene, see `evaluate`.

    Returns:
        What became of every scene, on all ranks, and on the root its trajectory.
    """
    kept: list[Trajectory | ConvergenceError] = []

    def run() -> list[Motion | ConvergenceError]:
        kept.extend(_simulate(scenes, owned, ledger, starts))
        with ledger.phase("objective"):
            return [one if isinstance(one, ConvergenceError) else _motion(one) for one in kept]

    motions = on_root(share.world, run)
    trajectories = [one if isinstance(one, Trajectory) else None for one in kept]
    return list(zip(motions, trajectories or [None] * len(motions), strict=True))


def _simulate(
    scenes: Sequence[Scene],
    owned: Mapping[int, ShapeIntegrals],
    ledger: Ledger,
    starts: Sequence[Sequence[Solution]],
) -> list[Trajectory | ConvergenceError]:
    """Simulate scenes, with all their scenarios."""
    posed: list[Scene] = []
    begun: list[Solution | None] = []
    sizes = []
    for scene, start in zip(scenes, starts, strict=True):
        group = [scene, *pose_scenarios(scene)]
        posed += group
        begun += [*start, *[None] * (len(group) - len(start))]
        sizes.append(len(group))
    nominal = chain_of(scenes[0], owned)
    bodies = [nominal, *(bodies_in(scenes[0], other, owned) for other in posed[1:])]
    # Slopes are asked of a single evaluation at most.
    alone = len(scenes) == 1
    every = simulate_batch(posed, bodies, ledger, begun, differentiated=alone)
    found: list[Trajectory | ConvergenceError] = []
    for size in sizes:
        parts, every = every[:size], every[size:]
        failed = [one for one in parts if isinstance(one, ConvergenceError)]
        if failed:
            found.append(failed[0])
            continue
        own, *rest = (one for one in parts if isinstance(one, Trajectory))
        found.append(replace(own, scenarios=tuple(rest)))
    return found


def _motion(trajectory: Trajectory) -> Motion:
    """Return what the motion does, of all scenarios together where there are any."""
    motion = _figures(trajectory)
    if not trajectory.scenarios:
        return motion
    others = tuple(_figures(one) for one in trajectory.scenarios)
    value, _ = combined(trajectory.scene, [one.objective for one in others])
    return replace(motion, objective=value, scenarios=others)


def _figures(trajectory: Trajectory) -> Motion:
    scene = trajectory.scene
    worst = worst_instants(trajectory, scene.objective.load_cases)
    distance, when = trajectory.max_deviation
    return Motion(
        objective=objective(trajectory, scene) if scene.objective.simulated else np.nan,
        compliance=float(trajectory.compliance[worst].sum()),
        max_deviation=distance,
        max_deviation_time=when,
        first_frequencies=tuple(map(first_frequency, trajectory.mechanism.bodies)),
        error=trajectory.solution.error,
        deflections=tuple(map(float, trajectory.deflections)),
        turns=tuple(map(float, trajectory.turns)),
    )


def _frozen_moments(trajectory: Trajectory) -> list[np.ndarray]:
    """Return `frozen_moments` of every body, of all scenarios together where there are any."""
    scene, others = trajectory.scene, trajectory.scenarios
    if not others:
        return frozen_moments(trajectory, scene)
    _, weights = combined(scene, [objective(one, one.scene) for one in others])
    total: list[np.ndarray] = []
    for weight, one in zip(weights, others, strict=True):
        parts = [
            # Of its stiffness; rigid arms and bodies from files have no slopes.
            weight * factors(scene, one.scene, index).stiffness * part
            for index, part in enumerate(frozen_moments(one, one.scene))
        ]
        total = [a + b for a, b in zip(total, parts, strict=True)] if total else parts
    return total


def _body_slopes(trajectory: Trajectory) -> list[ShapeIntegrals]:
    """Return `body_slopes_of` every body, of all scenarios together where there are any."""
    scene, others = trajectory.scene, trajectory.scenarios
    if not others:
        return body_slopes_of(trajectory, scene)
    _, weights = combined(scene, [objective(one, one.scene) for one in others])
    total: list[ShapeIntegrals] = []
    for weight, one in zip(weights, others, strict=True):
        parts = [
            slopes_back(slopes, factors(scene, one.scene, index), weight)
            for index, slopes in enumerate(body_slopes_of(one, one.scene))
        ]
        total = [a + b for a, b in zip(total, parts, strict=True)] if total else parts
    return total


def _by_owner(scene: Scene, parts: Sequence[T]) -> dict[int, T]:
    """Add up what belongs to the arms of one design; rigid arms and those from files have none."""
    total: dict[int, T] = {}
    for owner, part in zip(scene.owners, parts, strict=True):
        if owner is not None:
            total[owner] = total[owner] + part if owner in total else part  # type: ignore[operator]
    return total


def _uses(scene: Scene) -> dict[int, int]:
    """Return how many arms have each design."""
    return _by_owner(scene, [1] * len(scene.arms))


# -- statics ---------------------------------------------------------------------------------


def _loads(scene: Scene) -> np.ndarray:
    return np.array(scene.objective.loads)


def _static_compliance(scene: Scene, share: ArmShare, arms: Mapping[int, Arm]) -> float:
    """Return the sum over all arms of their compliance under the unit loads (collective)."""
    uses = _uses(scene)
    with together(share.world):
        values = {
            k: uses[k] * static_response(arm.elastic, _loads(scene)).compliance
            for k, arm in arms.items()
        }
    return float(sum(_everywhere(share, values).values()))


def _deflections(
    scene: Scene, share: ArmShare, arms: Mapping[int, Arm]
) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return every design's p-mean deflection under the loads and its largest, m (collective)."""
    values = {}
    with together(share.world):
        for k, arm in arms.items():
            response = static_response(arm.elastic, _loads(scene))
            values[k] = response.deflection(scene.objective.exponent), response.largest
    means, largest = zip(*_everywhere(share, values).values(), strict=True)
    return np.array(means), largest


def _everywhere(share: ArmShare, mine: Mapping[int, T]) -> dict[int, T]:
    """Return one object an arm on all ranks, in the arms' order (collective)."""
    return share.world.bcast(gather_arms(share, mine), root=0)


# -- vibration -------------------------------------------------------------------------------


def _chain(scene: Scene, share: ArmShare, arms: Mapping[int, Arm]) -> Chain:
    """Freeze the mechanism at the elbow angle at which its arms vibrate (collective)."""
    with together(share.world):
        mine = {k: rigid_integrals(arm.elastic) for k, arm in arms.items()}
    owned = _everywhere(share, mine)

    def freeze() -> Chain:
        bodies, reach = [], []
        for place, owner in enumerate(scene.owners):
            if owner is not None:
                bodies.append(owned[owner])
                reach.append(complex(scene.arms[place].length, 0.0))
            else:
                body = fixed_body(scene, place)
                bodies.append(RigidIntegrals(body.mass, complex(*body.moment), body.inertia))
                reach.append(complex(*body.outboard_point))
        angle = scene.objective.elbow_angle
        if angle is None:
            middle = np.array([0.5 * scene.motion.duration])
            angles = [float(value) for value in rigid_motion(middle, scene).q[0, 1:]]
        else:
            angles = [angle] * len(bodies)
        load = RigidIntegrals(scene.payload.mass, 0j, scene.payload.inertia)
        return Chain(bodies, reach, angles, load, scene.objective.attached)

    return on_root(share.world, freeze)


def _modes(arms: Mapping[int, Arm], chain: Chain) -> dict[int, LoadedModes]:
    """Return the loaded modes of every arm of the chain that has one of this rank's designs.

    Within `together`.
    """
    carried = chain.carried()
    return {
        place: arms[owner].loaded_modes(place, carried[place])
        for owner in arms
        for place in arms[owner].places
    }


def _vibration(
    scene: Scene, share: ArmShare, arms: Mapping[int, Arm]
) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
    """Return what all flexible arms' vibrations are judged by (collective).

    The objective's squared periods, those of the lowest modes whichever one it follows (s2), and
    the first frequencies (Hz).
    """
    chain, options = _chain(scene, share, arms), scene.objective
    with together(share.world):
        mine = {
            place: (
                squared_period(one, options.exponent, options.follow)[0],
                squared_period(one, options.exponent, False)[0],
                one.frequency,
            )
            for place, one in _modes(arms, chain).items()
        }
    periods, longest, frequencies = zip(*_everywhere(share, mine).values(), strict=True)
    return np.array(periods), np.array(longest), frequencies


def _period_rows(
    scene: Scene, share: ArmShare, arms: Mapping[int, Arm], follow: bool
) -> list[dict[int, np.ndarray]]:
    """Return every flexible arm's gradient of its squared period (collective).

    What an arm carries depends on the designs outboard of it.
    """
    chain = _chain(scene, share, arms)
    with together(share.world):
        modes = _modes(arms, chain)
        slopes = {
            place: period_gradient(arms[owner], modes[place], scene.objective.exponent, follow)
            for owner in arms
            for place in arms[owner].places
        }
    by_carried = _everywhere(share, {place: one.carried for place, one in slopes.items()})
    rows = []
    zero = [np.zeros((3, 3))] * len(scene.arms)
    with together(share.world):
        for place, matrix in by_carried.items():
            carried = [*zero[:place], matrix, *zero[place + 1 :]]
            by_body = _by_owner(scene, chain.body_slopes(carried))
            row = {
                k: np.zeros(arm.mesh.num_cells)  # it is not outboard of this place
                if by_body[k] == NOTHING
                else rigid_gradient(arm, by_body[k])
                for k, arm in arms.items()
            }
            owner = scene.owners[place]
            if owner in row:
                row[owner] = row[owner] + slopes[place].cells
            rows.append(row)
    return rows
