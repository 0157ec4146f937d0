"""From physical densities to bodies, the motion, and the responses that the scene asks for.

Only what is asked for is done: a static objective needs neither simulation nor mass matrix, an
eigenfrequency no simulation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.arms.arm import chain_of
from dolfinopt.dynamics.simulation import Trajectory, simulate_batch
from dolfinopt.dynamics.solution import Solution
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.parallel import Partition, gather_arms, on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.motion import motion_objective, worst_instants
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    asked_of,
    constraints_of,
    needs,
    objective_of,
)
from dolfinopt.responses.scenarios import bodies_in
from dolfinopt.responses.stiffening import decide_stiffening, stiffening_of_each
from dolfinopt.scene.load import Scene, pose_scenarios

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

Cells = Mapping[int, np.ndarray]


@dataclass(frozen=True)
class Motion:
    """What the simulated motion does to one design.

    Attributes:
        objective: of the motion, nan where it is another; N m, N m s or m.
        compliance: sum of the load cases' compliance, N m.
        max_deviation, max_deviation_time: m, s.
        error: estimated relative error of the elastic coordinates.
        deflections, turns: largest outboard deflection of every arm over its length, and rotation
            in rad.
        scenarios: the same of every scenario.
    """

    objective: float = np.nan
    compliance: float = np.nan
    max_deviation: float = np.nan
    max_deviation_time: float = np.nan
    error: float = np.nan
    deflections: tuple[float, ...] = ()
    turns: tuple[float, ...] = ()
    scenarios: tuple[Motion, ...] = ()


@dataclass(frozen=True)
class Evaluation(Motion):
    """What one design does; the same on all ranks. What the scene did not ask for is nan.

    Attributes:
        objective: sum of its response's values, of all scenarios if there are any.
        constraints: (k,) of everything that the scene limits, relative, kept where <= 0.
        responses: the objective's values, then those of every constraint, see `constraints_of`.
    """

    constraints: tuple[float, ...] = ()
    responses: tuple[Measured, ...] = ()

    def values_of(self, *names: str) -> tuple[float, ...]:
        """Return the true values of the first of these responses that was asked for, or none."""
        return next((one.values for one in self.responses if one.response in names), ())

    @property
    def loaded_frequencies(self) -> tuple[float, ...]:
        """Of every flexible arm with what it carries, Hz; empty unless asked for."""
        return self.values_of("eigenfrequency", "first_frequency")

    @property
    def tip_deflections(self) -> tuple[float, ...]:
        """Largest static one of every designed arm, m; empty unless asked for."""
        return self.values_of("tip_deflection")


def evaluate(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Cells,
    profile: Profile,
    start: Sequence[Solution] = (),
    *,
    simulated: bool = True,
) -> tuple[Evaluation, Trajectory | None]:
    """Reduce every arm, simulate on the root, measure the scene's responses (collective).

    Args:
        scene: what is simulated and minimised.
        partition: which ranks do which arm.
        arms: this rank's.
        x_phys: their physical densities (n_cells,).
        profile: of this rank.
        start: `Trajectory.solutions` of a nearby design; read on the root only.
        simulated: False leaves out the motion where no response needs it.

    Returns:
        The evaluation, and on the root the trajectory, if there is one.

    Raises:
        InputError: densities that are none, see `Arm.refusal`; on all ranks.
        ConvergenceError: on all ranks alike.
    """
    _check_densities(partition, arms, x_phys)
    with together(partition.world):
        for index, arm in arms.items():
            arm.set_design(x_phys[index])
    motion, trajectory = Motion(), None
    if simulated or needs(scene, "motion"):
        decide_stiffening([scene, *pose_scenarios(scene)], partition, arms)
        owned = _reduced(partition, arms, x_phys)
        [(found, trajectory)] = _simulated([scene], partition, owned, profile, [start])
        if isinstance(found, ConvergenceError):
            raise found
        motion = found
    analysis = _analysis(scene, partition, arms, trajectory, profile)
    return _measured(analysis, motion), trajectory


def evaluate_batch(
    scenes: Sequence[Scene],
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Cells,
    profile: Profile,
) -> list[tuple[Evaluation, Trajectory | None] | ConvergenceError]:
    """Evaluate one design in many scenes, whose motions are simulated in one batch (collective).

    Args:
        scenes: of one reduction, in which the arms are the same, see `Arm.under`; or, if nothing
            but their motion is asked for, scaled, see `scenarios.factors`.
        partition: which ranks do which arm.
        arms: this rank's, in the first scene.
        x_phys: their physical densities (n_cells,).
        profile: of this rank.

    Returns:
        What `evaluate` does of every scene, or the error that it would raise.

    Raises:
        InputError: as `evaluate` does.
    """
    _check_densities(partition, arms, x_phys)
    try:
        with together(partition.world):
            for k, arm in arms.items():
                arm.set_design(x_phys[k])
        decided = stiffening_of_each(
            [(one, *pose_scenarios(one)) for one in scenes], partition, arms
        )
    except ConvergenceError as error:
        return [error] * len(scenes)
    found: dict[int, tuple[Evaluation, Trajectory | None] | ConvergenceError] = {}
    for on in (False, True):  # bodies differ
        if chosen := [i for i, one in enumerate(decided) if one.on == on]:
            for arm in arms.values():
                arm.set_stiffening(decided[chosen[0]])
            some = _evaluate_alike([scenes[i] for i in chosen], partition, arms, x_phys, profile)
            found.update(zip(chosen, some, strict=True))
    return [found[i] for i in range(len(scenes))]


def _evaluate_alike(
    scenes: Sequence[Scene],
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Cells,
    profile: Profile,
) -> list[tuple[Evaluation, Trajectory | None] | ConvergenceError]:
    """Return `evaluate_batch` of scenes whose bodies all have geometric stiffness, or none."""
    try:
        owned = _reduced(partition, arms, x_phys)
    except ConvergenceError as error:
        return [error] * len(scenes)
    found: list[tuple[Evaluation, Trajectory | None] | ConvergenceError] = []
    moved = _simulated(scenes, partition, owned, profile, [()] * len(scenes))
    for scene, (motion, trajectory) in zip(scenes, moved, strict=True):
        try:
            if isinstance(motion, ConvergenceError):
                raise motion
            under = arms
            if any(one.needs and "motion" not in one.needs for one in asked_of(scene)):
                with together(partition.world):
                    under = {k: arm.under(scene) for k, arm in arms.items()}
            analysis = _analysis(scene, partition, under, trajectory, profile)
            found.append((_measured(analysis, motion), trajectory))
        except ConvergenceError as error:
            found.append(error)
    return found


def _analysis(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    trajectory: Trajectory | None,
    profile: Profile,
) -> Analysis:
    """Return what the scene's responses are computed from: the designs that the arms have."""
    designs = {k: arm.current for k, arm in arms.items()}
    return Analysis(scene, partition, designs, trajectory, profile)


def _check_densities(partition: Partition, arms: Mapping[int, Arm], x_phys: Cells) -> None:
    """Raise InputError on all ranks where densities of one cannot be those of a design."""
    with together(partition.world):
        for k, arm in arms.items():
            missing = "" if k in x_phys else f"arm {arm.mesh.name!r}: expected densities"
            if reason := missing or arm.refusal(x_phys[k]):
                raise InputError(reason)


def _measured(analysis: Analysis, motion: Motion) -> Evaluation:
    """Add the responses that the scene asks for (collective)."""
    measured = [objective_of(analysis.scene).measure(analysis)]
    constraints: list[float] = []
    for bound in constraints_of(analysis.scene):
        found = bound.response.measure(analysis)
        limits = bound.smooth_limits(analysis, found)
        constraints += [float(x) for x in np.array(found.smooth) / limits - 1.0]
        measured.append(found)
    return Evaluation(
        **vars(replace(motion, objective=measured[0].total)),
        constraints=tuple(constraints),
        responses=tuple(measured),
    )


def gradient(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    trajectory: Trajectory | None,
    profile: Profile,
) -> dict[int, np.ndarray]:
    """Return the objective's gradient by the physical densities of this rank's arms (collective).

    Args:
        scene: says which gradient: "esl" freezes the loads, "exact" follows everything.
        partition, arms: as for `evaluate`, with the design reduced.
        trajectory: what `evaluate` returned.
        profile: of this rank.
    """
    rows = objective_of(scene).gradients(_analysis(scene, partition, arms, trajectory, profile))
    if len(rows) == 1:
        return rows[0]
    return {k: np.sum([row[k] for row in rows if k in row], axis=0) for k in arms}


@dataclass(frozen=True, eq=False)
class ConstraintGradient:
    """One entry of `Evaluation.constraints`, smooth value / smooth limit - 1, differentiated.

    The limit is held: its scale follows the design, see `response`.

    Attributes:
        response: whose value it is.
        smooth: derivative of the smooth value by the physical densities (n_cells,) of every arm
            that it depends on.
        limit: in the unit of the smooth value.
    """

    response: Response
    smooth: CellGradient
    limit: float

    @property
    def cells(self) -> CellGradient:
        """Derivative of the constraint by the physical densities of every arm."""
        return {k: g / self.limit for k, g in self.smooth.items()}


def constraint_gradients(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    trajectory: Trajectory | None = None,
    profile: Profile | None = None,
    measured: Sequence[Measured] = (),
) -> list[ConstraintGradient]:
    """Return the gradients of `Evaluation.constraints` (collective).

    Args:
        scene, partition, arms, trajectory, profile: as for `gradient`; the last two are for
            constraints of the motion alone.
        measured: `Evaluation.responses` of the design; measured anew if not given.
    """
    analysis = _analysis(scene, partition, arms, trajectory, profile or Profile())
    found = []
    for k, bound in enumerate(constraints_of(scene), 1):
        rows = bound.response.gradients(analysis)
        values = measured[k] if measured else bound.response.measure(analysis)
        limits = bound.smooth_limits(analysis, values)
        found += [
            ConstraintGradient(bound.response, row, float(limit))
            for row, limit in zip(rows, limits, strict=True)
        ]
    return found


# -- the motion ------------------------------------------------------------------------------


def _reduced(
    partition: Partition, arms: Mapping[int, Arm], x_phys: Cells
) -> Mapping[int, ShapeIntegrals]:
    """Return the bodies of the arms with a design of their own, on the root (collective)."""
    with together(partition.world):
        bodies = {index: arm.reduce(x_phys[index]) for index, arm in arms.items()}
    return gather_arms(partition, bodies)


def _simulated(
    scenes: Sequence[Scene],
    partition: Partition,
    owned: Mapping[int, ShapeIntegrals],
    profile: Profile,
    starts: Sequence[Sequence[Solution]],
) -> list[tuple[Motion | ConvergenceError, Trajectory | None]]:
    """Simulate the scenes and their scenarios in one batch (collective).

    Args:
        scenes: the bodies are those of the first one.
        partition, owned, profile: as elsewhere.
        starts: of every scene, see `evaluate`.

    Returns:
        What became of every scene, on all ranks, and on the root its trajectory.
    """
    kept: list[Trajectory | ConvergenceError] = []

    def run() -> list[Motion | ConvergenceError]:
        kept.extend(_simulate(scenes, owned, profile, starts))
        with profile.phase("objective"):
            return [one if isinstance(one, ConvergenceError) else _motion(one) for one in kept]

    motions = on_root(partition.world, run)
    trajectories = [one if isinstance(one, Trajectory) else None for one in kept]
    return list(zip(motions, trajectories or [None] * len(motions), strict=True))


def _simulate(
    scenes: Sequence[Scene],
    owned: Mapping[int, ShapeIntegrals],
    profile: Profile,
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
    every = simulate_batch(posed, bodies, profile, begun, differentiated=alone)
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
    return replace(motion, scenarios=tuple(_figures(one) for one in trajectory.scenarios))


def _figures(trajectory: Trajectory) -> Motion:
    scene, response = trajectory.scene, motion_objective(trajectory)
    parts = [] if response is None else response.parts(scene)
    worst = worst_instants(trajectory, scene.objective.load_cases)
    distance, when = trajectory.max_deviation
    return Motion(
        objective=sum(one.of_motion(trajectory) for _, one in parts) if parts else np.nan,
        compliance=float(trajectory.compliance[worst].sum()),
        max_deviation=distance,
        max_deviation_time=when,
        error=trajectory.solution.error,
        deflections=tuple(map(float, trajectory.deflections)),
        turns=tuple(map(float, trajectory.interface_rotations)),
    )
