"""From physical densities to bodies, the motion, and the responses that the scene asks for.

Only what is asked for is done: a static objective needs neither simulation nor mass matrix, an
eigenfrequency no simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.arms.arm import Arm, chain_of, stiffening_of
from dolfinopt.dynamics.build import Trajectory, largest_stiffness_change, simulate
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.errors import InputError
from dolfinopt.multibody.loads import Stiffening
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.parallel import Partition, gather_arms, on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.measured import COARSE_INSTANTS, STIFFNESS_CHANGE
from dolfinopt.responses.motion import motion_objective, worst_instants
from dolfinopt.responses.products import By, by_design
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    bodies_in,
    constraints_of,
    needs,
    objective_of,
    sums,
)
from dolfinopt.scene.load import Scene, pose_scenarios


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
        smooth_limits: (k,) of the smooth values, as of this design.
        responses: the objective's values, then those of every constraint, see `constraints_of`.
    """

    constraints: tuple[float, ...] = ()
    smooth_limits: tuple[float, ...] = ()
    responses: tuple[Measured, ...] = ()

    def values_of(self, name: str) -> tuple[float, ...]:
        """Return the true values of a response, by its name; none where it was not asked for."""
        return next(
            (response.values for response in self.responses if response.response == name), ()
        )


def evaluate(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
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
    with together(partition.world):
        for index, arm in arms.items():
            if index not in x_phys:
                raise InputError(f"arm {arm.mesh.name!r}: expected densities")
            arm.state(x_phys[index])
    motion, trajectory = Motion(), None
    if simulated or needs(scene, "motion"):
        decide_stiffening(scene, partition, arms)
        with together(partition.world):
            bodies = {index: arm.reduce(x_phys[index]) for index, arm in arms.items()}
        owned = gather_arms(partition, bodies)
        trajectory = simulated_together(
            [scene, *pose_scenarios(scene)], partition, owned, profile, start
        )
        with profile.phase("objective"):
            motion = on_root(partition.world, _motion, trajectory)
    analysis = analysis_of(scene, partition, arms, trajectory, profile)
    return _measured(analysis, motion), trajectory


def analysis_of(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    trajectory: Trajectory | None,
    profile: Profile,
    by: By = by_design,
) -> Analysis:
    """Return what the scene's responses are computed from: the designs that the arms have."""
    designs = {k: arm.current for k, arm in arms.items()}
    return Analysis(scene, partition, designs, trajectory, profile, by)


def _measured(analysis: Analysis, motion: Motion) -> Evaluation:
    """Add the responses that the scene asks for (collective)."""
    measured = [objective_of(analysis.scene).measure(analysis)]
    constraints, smooth_limits = list[float](), list[float]()
    for bound in constraints_of(analysis.scene):
        result = bound.response.measure(analysis)
        limits = bound.smooth_limits(result)
        constraints += map(float, np.array(result.smooth) / limits - 1.0)
        smooth_limits += map(float, limits)
        measured.append(result)
    return Evaluation(
        **vars(replace(motion, objective=measured[0].total)),
        constraints=tuple(constraints),
        smooth_limits=tuple(smooth_limits),
        responses=tuple(measured),
    )


def gradient(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    trajectory: Trajectory | None,
    profile: Profile,
    by: By = by_design,
) -> CellGradient:
    """Return the objective's gradient by the physical densities of this rank's arms (collective).

    Args:
        scene: says which gradient: "esl" freezes the loads, "exact" follows everything.
        partition, arms: as for `evaluate`, with the design reduced.
        trajectory: what `evaluate` returned.
        profile: of this rank.
        by: `products.by_nodes` for the gradient by the places of the arms' nodes.
    """
    return objective_gradient(analysis_of(scene, partition, arms, trajectory, profile, by))


def objective_gradient(analysis: Analysis) -> CellGradient:
    """Return the objective's gradient by what the analysis says (collective)."""
    rows = objective_of(analysis.scene).gradients(analysis)
    return sums(item for row in rows for item in row.items())


def constraint_gradients(
    analysis: Analysis,
    measured: Sequence[Measured] = (),
    asked: Callable[[str], bool] = lambda _: True,
) -> list[CellGradient]:
    """Return the gradients of `Evaluation.constraints` (collective).

    Smooth value / smooth limit - 1, the limit held: its scale follows the design, see `response`.

    Args:
        analysis: of the design.
        measured: `Evaluation.responses` of the design; measured anew if not given.
        asked: whether the gradient of a response, by its name, is of any use; else it is left out.
    """
    result = list[CellGradient]()
    for k, bound in enumerate(constraints_of(analysis.scene), 1):
        values = measured[k] if measured else bound.response.measure(analysis)
        limits = bound.smooth_limits(values)
        rows: list[CellGradient] = [{} for _ in limits]
        if asked(bound.response.name):
            rows = bound.response.gradients(analysis)
        for row, limit in zip(rows, limits, strict=True):
            result.append({k: g / limit for k, g in row.items()})
    return result


# -- the motion ------------------------------------------------------------------------------


def simulated_together(
    scenes: Sequence[Scene],
    partition: Partition,
    owned: Mapping[int, ShapeIntegrals],
    profile: Profile,
    starts: Sequence[Solution] = (),
) -> Trajectory | None:
    """Simulate a scene with its scenarios on the root; there the trajectory is (collective).

    Args:
        scenes: it and them.
        partition: which ranks do which arm.
        owned: bodies of the arms with a design of their own.
        profile: counts and seconds.
        starts: solutions of a nearby design; scenarios begin with the scene's unless theirs is
            known.

    Raises:
        ConvergenceError: on all ranks.
    """
    scene, *others = scenes
    kept: list[Trajectory] = []

    def run() -> None:
        first = simulate(scene, chain_of(scene, owned), profile, starts[0] if starts else None)
        result = []
        for number, other in enumerate(others, 1):
            start = starts[number] if number < len(starts) else first.solution
            # The nominal machine's feed-forward is kept where the motion is the same.
            held = first.feed_forward if other.motion == scene.motion else None
            result.append(simulate(other, bodies_in(scene, other, owned), profile, start, held))
        kept.append(replace(first, scenarios=tuple(result)))

    on_root(partition.world, run)
    return kept[0] if kept else None


def _motion(trajectory: Trajectory) -> Motion:
    """Return what the motion does, of all scenarios together where there are any."""
    return replace(_figures(trajectory), scenarios=tuple(map(_figures, trajectory.scenarios)))


def _figures(trajectory: Trajectory) -> Motion:
    scene, response = trajectory.scene, motion_objective(trajectory)
    parts = [] if response is None else response.parts(scene)
    worst = worst_instants(trajectory, scene.objective.load_cases)
    distance, when = trajectory.max_deviation
    return Motion(
        objective=sum(item.of_motion(trajectory) for _, item in parts) if parts else np.nan,
        compliance=float(trajectory.compliance[worst].sum()),
        max_deviation=distance,
        max_deviation_time=when,
        error=trajectory.solution.error,
        deflections=tuple(map(float, trajectory.deflections)),
        turns=tuple(map(float, trajectory.interface_rotations)),
    )


# -- whether the arms' bodies get geometric stiffness: as the scene says; with "auto" where the
# loads change an arm's stiffness by more than `STIFFNESS_CHANGE`


def decide_stiffening(scene: Scene, partition: Partition, arms: Mapping[int, Arm]) -> None:
    """Let the arms' bodies have geometric stiffness from now on, or not (collective).

    Decided once, by the design that the arms have, see `reconsider_stiffening`.

    Args:
        scene: says true, false or "auto"; its scenarios are decided with it.
        partition: which ranks do which arm.
        arms: this rank's, with a design.
    """
    mine = all(arm.stiffening is not None for arm in arms.values())
    if not partition.world.allreduce(mine, min):
        _decide(scene, partition, arms)


def reconsider_stiffening(scene: Scene, partition: Partition, arms: Mapping[int, Arm]) -> bool:
    """Switch stiffening on where "auto" left it out and the arms' designs now call for it.

    Collective.

    Returns:
        Whether it was switched on.
    """
    known = partition.world.bcast(stiffening_of(arms), root=0)
    if scene.simulation.stiffening != "auto" or known is None or known.on:
        return False
    return _decide(scene, partition, arms)


def _decide(scene: Scene, partition: Partition, arms: Mapping[int, Arm]) -> bool:
    result = _stiffening(scene, partition, arms)
    for arm in arms.values():
        arm.set_stiffening(result)
    return result.on


def _stiffening(scene: Scene, partition: Partition, arms: Mapping[int, Arm]) -> Stiffening:
    """Return what is decided for a scene and its scenarios together (collective)."""
    stated = scene.simulation.stiffening
    if stated != "auto" and scene.is_spatial:  # most of a solid arm's memory would go
        return Stiffening(None, stated is True)
    with together(partition.world):
        mine = {k: arm.current.static_body for k, arm in arms.items()}
    owned = gather_arms(partition, mine)

    def largest(other: Scene) -> float:
        t = np.linspace(0.0, other.motion.horizon, COARSE_INSTANTS + 1)
        return largest_stiffness_change(other, bodies_in(scene, other, owned), t)

    every = scene, *pose_scenarios(scene)
    change = on_root(partition.world, lambda: max(map(largest, every)))
    return Stiffening(change, change > STIFFNESS_CHANGE if stated == "auto" else stated)
