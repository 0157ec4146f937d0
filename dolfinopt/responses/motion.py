"""Responses of a simulated motion, drives' forces included, and their exact gradients."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from dolfinopt.dynamics.build import Trajectory
from dolfinopt.dynamics.trajectory import ByMotion, Followed
from dolfinopt.motion.build import CART
from dolfinopt.multibody.shape_integrals import add_integrals, integrals_of
from dolfinopt.parallel import on_root, together
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    by_owner,
    combined,
    cotangents_of_scene,
    factors,
    find,
    p_norm_of_lengths,
    response,
    sums,
    worst_of,
)
from dolfinopt.responses.sensitivity import esl_gradient, exact_gradient
from dolfinopt.scene.law_variables import LAW
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.objective import Objective


@dataclass(frozen=True, eq=False)
class LoadCases:
    """Instants that make up a response, and how much each counts.

    Attributes:
        indices: (n,) of the trajectory's instants.
        weights: (n,) 1 for equivalent static loads, s for an integral over the horizon.
    """

    indices: np.ndarray
    weights: np.ndarray


def worst_instants(trajectory: Trajectory, count: int) -> np.ndarray:
    """Return the worst instant of each of `count` intervals: of the largest compliance of all arms.

    (0, horizon] is cut into equal intervals, open below, closed above; intervals that hold no
    instant give none. Instants of the largest deviation give designs whose compliance and deviation
    are the same to 0.7 % (demos/two_arm.toml, three_arm.toml; frozen and exact gradient).
    Source: Seifried, Moghadasi & Held (2015), text below eq. (9).
    """
    scene, compliance = trajectory.scene, trajectory.compliance.sum(axis=1)
    share = (trajectory.t - scene.lead) / (scene.horizon - scene.lead)
    # The tolerance keeps an instant on an interval's end in that interval, whatever the rounding.
    interval = np.ceil(share * count - 1e-9).astype(int) - 1
    order = np.lexsort((-compliance, interval))
    order = order[interval[order] >= 0]
    first = np.unique(interval[order], return_index=True)[1]
    return np.sort(order[first])


def all_instants(trajectory: Trajectory) -> LoadCases:
    """Return all instants with the weights of the trapezoidal rule, s."""
    steps = np.diff(trajectory.t)
    weights = 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
    return LoadCases(np.arange(len(weights)), weights)


class MotionResponse(Response):
    """A function of a quantity over time: one value of the machine, of all scenarios together.

    As objective scenarios count as `objective.scenarios` says; a limit holds for every one of
    them: the p-norm of their values, whose true one is the largest. Of those that equivalent static
    loads say nothing of (`Declaration.exact`) the gradient is exact.
    """

    def parts(self, scene: Scene) -> Sequence[tuple[str, MotionResponse]]:
        """Return the values that it has, as responses of one value each, by their names.

        By default itself, without a name; a response with a value for every drive has several.
        """
        return [("", self)]

    def seen(self, trajectory: Trajectory) -> Trajectory:
        """Return a motion at the instants of which some make it up; by default its own."""
        return trajectory

    def load_cases(self, trajectory: Trajectory) -> LoadCases:
        """Return these of what is `seen`; by default all."""
        return all_instants(trajectory)

    @abstractmethod
    def quantity(self, trajectory: Trajectory) -> np.ndarray:
        """Return what it is a function of, at all instants (n, k)."""

    @abstractmethod
    def value(self, y: np.ndarray, weights: np.ndarray) -> float:
        """Return the value.

        Args:
            y: (n, k) the quantity at the instants that count.
            weights: (n,) of these, see `LoadCases`.
        """

    @abstractmethod
    def gradient(self, y: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the derivative of `value` by y (n, k)."""

    @abstractmethod
    def followed(self, trajectory: Trajectory, cases: LoadCases, by_y: np.ndarray) -> ByMotion:
        """Follow derivatives by the quantity at held instants (n, k) to the motion and the bodies.

        Returns:
            By the system's coordinates at the instants (n, S), or by them, their rates and their
            accelerations (3, n, S); and of every body by the fields of its `ShapeIntegrals` on
            which the quantity depends directly.
        """

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the true value of one motion, where `value` is a smooth stand-in."""
        return self.of_motion(trajectory)

    def value_at(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the value of one motion at given instants."""
        return self.value(self.quantity(trajectory)[cases.indices], cases.weights)

    def derivatives(self, trajectory: Trajectory, cases: LoadCases) -> ByMotion:
        """Return the derivatives of `value` at held instants, see `followed`."""
        y = self.quantity(trajectory)[cases.indices]
        return self.followed(trajectory, cases, self.gradient(y, cases.weights))

    def cotangents(self, trajectory: Trajectory) -> Followed:
        """Return the exact derivatives by the shape integrals of every body, of one motion.

        Its own, with the coordinates held, and the trajectory's, whose coordinates follow. The
        choice of instants is held: where two of an interval are equally bad there is a kink.
        """
        seen = self.seen(trajectory)
        cases = self.load_cases(seen)
        by = self.derivatives(seen, cases)

        def value(moved: Trajectory) -> float:
            there = self.seen(moved)
            own = self.load_cases(there)
            same = np.array_equal(own.indices, cases.indices)
            return self.value_at(there, own if same else cases)

        result = trajectory.followed(seen.t[cases.indices], by.unknowns, by.motion, value)
        return replace(result, bodies=list(map(add_integrals, result.bodies, by.bodies)))

    def load_case_moments(self, trajectory: Trajectory) -> list[np.ndarray]:
        """Return A = sum_j lambda_j q_j' (q, q) of every arm, for a gradient with frozen loads.

        With the equivalent static loads K q_j held, a change of stiffness gives
        dJ = -lambda_j . dK q_j with K lambda_j = dJ/dq_j, which joints of a loop follow.
        """
        cases = self.load_cases(trajectory)
        by = self.derivatives(trajectory, cases).unknowns
        by_q = trajectory.by_elastic(cases.indices, by)
        mechanism, q = trajectory.mechanism, trajectory.q_e[cases.indices]
        return [
            np.linalg.solve(body.K, by_q[:, part].T) @ q[:, part]
            for body, part in zip(mechanism.bodies, mechanism.slices, strict=True)
        ]

    def of_motion(self, trajectory: Trajectory) -> float:
        """Return the value of one motion, at the instants that it chooses (root only)."""
        seen = self.seen(trajectory)
        return self.value_at(seen, self.load_cases(seen))

    def combine(self, scene: Scene, values: Sequence[float]) -> tuple[float, np.ndarray]:
        """Return the value of all scenarios from their own, and its derivatives by them."""
        if self.limited:
            return worst_of(values, self.options.exponent)
        return combined(scene, values, self.turned)

    def of_trajectory(self, trajectory: Trajectory) -> tuple[float, float]:
        """Return true and smooth value of a motion, or of its scenarios together (root only)."""
        scene, motions = trajectory.scene, motions_of(trajectory)
        smooth = self.combine(scene, [self.of_motion(motion) for motion in motions])[0]
        true = [self.extreme(motion) for motion in motions]
        if not self.limited and scene.objective.scenarios == "sum":
            return combined(scene, true)[0], smooth
        lower = self.turned
        if self.limited:
            lower = self.declared.lower
        else:
            true = [s.weight * f for s, f in zip(scene.scenarios, true, strict=False)] or true
        return min(true) if lower else max(true), smooth

    def measure(self, analysis: Analysis) -> Measured:
        """Return the values of the analysis's motion (collective)."""
        parts = self.parts(analysis.scene)

        def values() -> list[tuple[float, float]]:
            return [item.of_trajectory(analysis.motion) for _, item in parts]

        true, smooth = zip(*on_root(analysis.partition.world, values), strict=True)
        return Measured(self.name, tuple(name for name, _ in parts), true, smooth)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every value by the physical densities (collective)."""
        return [item._of_part(analysis) for _, item in self.parts(analysis.scene)]

    def _of_part(self, analysis: Analysis) -> CellGradient:
        """Return the gradient of the one value of this response (collective)."""
        world, designs = analysis.partition.world, analysis.designs
        if self.options.gradient == "esl" and not self.declared.exact:
            moments = on_root(world, lambda: self._frozen_moments(analysis.motion))
            with together(world):
                return {
                    k: esl_gradient(design, moments[k], analysis.by)
                    for k, design in designs.items()
                }

        def followed() -> dict[int, Any]:
            weights = self._weights_of_scenarios(analysis.motion)
            return over_motions(analysis, lambda _, response: self.cotangents(response), weights)

        by = on_root(world, followed)
        with together(world):
            own = {
                k: exact_gradient(design, by[k], by=analysis.by) for k, design in designs.items()
            }
        return own | {LAW: by[LAW]} if LAW in by else own

    def _weights_of_scenarios(self, trajectory: Trajectory) -> np.ndarray:
        """Return the derivatives of the value by those of `motions_of`."""
        values = [self.of_motion(item) for item in motions_of(trajectory)]
        return self.combine(trajectory.scene, values)[1]

    def _frozen_moments(self, trajectory: Trajectory) -> dict[int, np.ndarray]:
        """Return `load_case_moments` of every design, of all scenarios together."""
        scene, result = trajectory.scene, list[tuple[int, np.ndarray]]()
        weights = self._weights_of_scenarios(trajectory)
        for weight, item in zip(weights, motions_of(trajectory), strict=True):
            moments = self.load_case_moments(item)[: len(scene.arms)]
            scales = [weight * factors(scene, item.scene, k).stiffness for k in range(len(moments))]
            result += by_owner(scene, list(map(np.multiply, scales, moments))).items()
        return sums(result)


def motions_of(trajectory: Trajectory) -> tuple[Trajectory, ...]:
    """Return what a limit holds for: the scenarios, or the motion where there are none."""
    return trajectory.scenarios or (trajectory,)


def over_motions(
    analysis: Analysis,
    of_motion: Callable[[int, Trajectory], Followed | None],
    weights: np.ndarray | None = None,
) -> dict[int, Any]:
    """Differentiate a weighted sum over all motions by the bodies of every design (on the root).

    Args:
        analysis: with the motions.
        of_motion: returns the derivatives of one of `motions_of` with its number by its own bodies;
            None where it does not count.
        weights: of the motions; all 1 by default.

    Returns:
        By the bodies of the scene, by the index of the arm that owns the design; under `LAW` by the
        variables of the motion's law (n,), where there are any.
    """
    scene, nominal, profile = analysis.scene, analysis.motion.feed_forward, analysis.profile
    parts: list[tuple[int, Any]] = []
    by_coefficients: list[np.ndarray] = []
    for number, item in enumerate(motions_of(analysis.motion)):
        with profile.phase("adjoint"):
            result = of_motion(number, item)
        if result is None:
            continue
        profile.counts.adjoints += 1
        weight = 1.0 if weights is None else weights[number]
        if item.feed_forward is not nominal:
            result = Followed(result.through(item.feed_forward))
        if result.by_coefficients is not None:
            by_coefficients.append(weight * result.by_coefficients)
        if result.by_law is not None:
            parts.append((LAW, weight * result.by_law))
        bodies = result.bodies[: len(scene.arms)]
        if item.scene is not scene:
            bodies = [
                cotangents_of_scene(by, factors(scene, item.scene, k), weight)
                for k, by in enumerate(bodies)
            ]
        parts += by_owner(scene, bodies).items()
    if nominal is not None and by_coefficients:
        parts += by_owner(scene, nominal.gradient(np.sum(by_coefficients, axis=0))).items()
    return sums(parts)


class ComplianceResponse(MotionResponse):
    """A weighted sum of q' K q of all arms over instants."""

    def quantity(self, trajectory: Trajectory) -> np.ndarray:
        """Return q' K q of every arm."""
        return trajectory.compliance

    def value(self, y: np.ndarray, weights: np.ndarray) -> float:
        """Return sum_j w_j q_j' K q_j."""
        return float(weights @ y.sum(axis=1))

    def gradient(self, y: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the weights."""
        return np.broadcast_to(weights[:, None], y.shape)

    def followed(self, trajectory: Trajectory, cases: LoadCases, by_y: np.ndarray) -> ByMotion:
        """Return 2 w_j K q_j, and the second moments of q by K."""
        q = trajectory.q_e[cases.indices]
        by_q = 2.0 * cases.weights[:, None] * (q @ trajectory.mechanism.stiffness())
        by_q[:, trajectory.mechanism.bearing_columns] = 0.0
        own = [{"K": Q} for Q in second_moments(trajectory, cases)]
        return ByMotion(trajectory.by_unknowns(by_q), own)

    def load_case_moments(self, trajectory: Trajectory) -> list[np.ndarray]:
        """Return the second moments: lambda_j = w_j q_j with the loads frozen."""
        return second_moments(trajectory, self.load_cases(trajectory))


def second_moments(trajectory: Trajectory, cases: LoadCases) -> list[np.ndarray]:
    """Return Q = sum_j weight_j q_j q_j' (q, q) of every arm."""
    moments = []
    for part in trajectory.mechanism.slices:
        q = trajectory.q_e[cases.indices, part]
        moments.append(q.T @ (cases.weights[:, None] * q))
    return moments


def motion_objective(trajectory: Trajectory) -> MotionResponse | None:
    """Return the objective of the trajectory's scene; None where it is no motion's."""
    options = trajectory.scene.objective
    response = find(options.kind)(options)
    return response if isinstance(response, MotionResponse) else None


class PMean(MotionResponse):
    """(1/T int |y|^p dt)^(1/p) of the length of a quantity: close to the largest, and smooth."""

    def value(self, y: np.ndarray, weights: np.ndarray) -> float:
        """Return the p-mean."""
        return p_norm_of_lengths(y, self.options.exponent, weights / weights.sum())[0]

    def gradient(self, y: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return that of the p-mean."""
        return p_norm_of_lengths(y, self.options.exponent, weights / weights.sum())[1]


# -- deviation of the end-effector from its rigid path -------------------------------------------


@response("deviation")
class Deviation(PMean):
    """(1/T int |e|^p dt)^(1/p), m: close to the largest deviation, and smooth.

    With e from eq. (6) of Seifried, Moghadasi & Held (2015), doi:10.1016/j.piutam.2015.01.018.
    """

    def quantity(self, trajectory: Trajectory) -> np.ndarray:
        """Return e, m."""
        return trajectory.deviation

    def followed(self, trajectory: Trajectory, cases: LoadCases, by_y: np.ndarray) -> ByMotion:
        """Return the derivatives through the outboard interfaces' modes."""
        return trajectory.by_end_effector(cases.indices, by_y)

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest deviation of all instants, m."""
        return trajectory.max_deviation[0]


@response("settling")
class Settling(Deviation):
    """The p-mean of the deviation in all rests together, m; its true value the largest.

    Rests are after the motion and in its dwells.
    """

    def load_cases(self, trajectory: Trajectory) -> LoadCases:
        """Return the instants of the vibration that is left."""
        indices = np.flatnonzero(trajectory.at_rest)
        return LoadCases(indices, all_instants(trajectory).weights[indices])

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest of these deviations, m."""
        return trajectory.settling


@response("orientation")
class Orientation(Deviation):
    """(1/T int |theta|^p dt)^(1/p), rad: close to the end-effector's largest rotation, and smooth.

    theta = log(R R_0') takes its orientation with rigid links to the one that it has.
    """

    def quantity(self, trajectory: Trajectory) -> np.ndarray:
        """Return theta, rad."""
        return trajectory.rotation

    def followed(self, trajectory: Trajectory, cases: LoadCases, by_y: np.ndarray) -> ByMotion:
        """Return its derivatives; they are along theta, where a spin changes theta by itself."""
        no_force = np.zeros_like(trajectory.deviation[cases.indices])
        return trajectory.by_end_effector(cases.indices, no_force, by_y)

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest rotation of all instants, rad."""
        return trajectory.max_rotation


# -- compliance ------------------------------------------------------------------------------


@response("integral_compliance")
class IntegralCompliance(ComplianceResponse):
    """Integral of q' K q over the horizon, trapezoidal rule, N m s."""


@response("esl")
class EquivalentStaticLoads(ComplianceResponse):
    """Sum of q' K q over the worst instant of each of `objective.load_cases` intervals, N m.

    Source: Seifried, Moghadasi & Held (2015), eq. (9), doi:10.1016/j.piutam.2015.01.018.
    """

    def load_cases(self, trajectory: Trajectory) -> LoadCases:
        """Return the worst instant of each interval."""
        indices = worst_instants(trajectory, self.options.load_cases)
        return LoadCases(indices, np.ones(len(indices)))


# -- forces of the drives over the horizon -------------------------------------------------


class DriveResponse(MotionResponse):
    """A function of the forces of drives: of the cart, N, and of the joints, N m.

    Equivalent static loads are held while the stiffness changes, and drives carry the mass, which
    these loads leave out.

    Attributes:
        drives: numbers of those of the scene's drives that count; None: all.
        weighs_limits: whether a limit, too, is of the weighted forces.
    """

    weighs_limits: ClassVar[bool] = True

    def __init__(
        self, options: Objective, limited: bool = False, drives: tuple[int, ...] | None = None
    ):
        """Take the options, and which drives count."""
        super().__init__(options, limited)
        self.drives = drives

    def quantity(self, trajectory: Trajectory) -> np.ndarray:
        """Return the forces of the drives that count, N and N m, times their weights."""
        columns, weights = self._counted(trajectory.scene)
        return trajectory.joint_forces[:, columns] * weights

    def followed(self, trajectory: Trajectory, cases: LoadCases, by_y: np.ndarray) -> ByMotion:
        """Return the derivatives through coordinates, rates and accelerations, and by bodies."""
        columns, weights = self._counted(trajectory.scene)
        by = np.zeros_like(trajectory.joint_forces)
        by[np.ix_(cases.indices, columns)] = by_y * weights
        by_rates, by_motion, bodies = trajectory.drive_forces.gradient(by)
        own = [integrals_of(body) for body in bodies]
        return ByMotion(by_rates[:, cases.indices], own, by_motion[:, cases.indices])

    def counted(self, scene: Scene) -> tuple[int, ...]:
        """Return the numbers of the drives that count."""
        return tuple(range(len(scene.driven))) if self.drives is None else self.drives

    def _counted(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        """Return their columns among all rigid coordinates, and weights, 1/N and 1/(N m).

        These are 1 by default.
        """
        drives, given = list(self.counted(scene)), self.options.effort_weights
        columns = np.arange(len(scene.rigid_units))[scene.driven_columns][drives]
        if given is None or (self.limited and not self.weighs_limits):
            return columns, np.ones(len(drives))
        return columns, np.array(given)[drives]


@response("effort")
class Effort(DriveResponse):
    """sqrt(1/T int sum_k (w_k F_k)^2 dt) of the weighted forces F_k of all drives, no unit.

    The root mean square of the forces, `drive_rms` of the summary, drives together; with the
    reciprocals of their rated continuous forces as weights w_k, 1 is one drive at its rating: what
    motors' heat, and with it their size, follow from.
    """

    def value(self, y: np.ndarray, weights: np.ndarray) -> float:
        """Return the weighted root mean square."""
        return float(np.sqrt(weights @ (y**2).sum(axis=1) / weights.sum()))

    def gradient(self, y: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return its derivatives; 0 where no drive does anything."""
        effort = self.value(y, weights) or 1.0
        return (weights / weights.sum())[:, None] * y / effort


@response("peak_force")
class PeakForce(PMean, DriveResponse):
    """(1/T int |F_k|^p dt)^(1/p) of every drive k, N and N m; its true value the largest |F_k|.

    What drives must be able to give. As objective the sum over the drives, each times its weight of
    `objective.effort_weights`.
    """

    weighs_limits = False

    def restricted(self, limits: Sequence[float | None]) -> tuple[Response, tuple[float, ...]]:
        """Return the response of those drives that have a limit, and these limits."""
        drives = tuple(k for k, limit in enumerate(limits) if limit is not None)
        return PeakForce(self.options, self.limited, drives), super().restricted(limits)[1]

    def parts(self, scene: Scene) -> Sequence[tuple[str, MotionResponse]]:
        """Return one response for every drive that counts, by the name of its coordinate."""
        return [
            (scene.driven[k], PeakForce(self.options, self.limited, (k,)))
            for k in self.counted(scene)
        ]

    @classmethod
    def unit_of(cls, value: str) -> str:
        """Return N for the cart's drive, N m for a joint's."""
        return "N" if value == CART else "N m"

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest force of all instants."""
        return float(np.abs(self.quantity(trajectory)).max())
