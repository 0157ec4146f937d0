"""Responses of a simulated motion, drives' forces included, and their exact gradients.

Values and cotangents of one trajectory, and of scenarios.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from dolfinopt.dynamics.trajectory import Trajectory
from dolfinopt.motion.build import CART
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals, integrals_of
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
    p_norm,
    p_norm_of_lengths,
    register,
    worst_of,
)
from dolfinopt.responses.sensitivity import esl_gradient, exact_gradient
from dolfinopt.scene.load import Scene, WorstBy
from dolfinopt.scene.tables.objective import EXACT_ONLY, MOTION, Need, Objective


@dataclass(frozen=True, eq=False)
class LoadCases:
    """Instants that make up a response, and how much each counts.

    Attributes:
        indices: (n,) of the trajectory's instants.
        weights: (n,) 1 for equivalent static loads, s for an integral over the horizon.
    """

    indices: np.ndarray
    weights: np.ndarray


def worst_instants(trajectory: Trajectory, count: int, worst: WorstBy = "compliance") -> np.ndarray:
    """Return the worst instant of each of `count` intervals.

    The worst has the largest compliance, arms together, or the largest deviation. (0, horizon] is
    cut into equal intervals, open below, closed above; intervals that hold no instant give none.
    Source: Seifried, Moghadasi & Held (2015), text below eq. (9).
    """
    if worst == "compliance":
        badness = trajectory.compliance.sum(axis=1)
    else:
        badness = trajectory.distance
    horizon = trajectory.scene.motion.horizon
    # The tolerance keeps an instant on an interval's end in that interval, whatever the rounding.
    interval = np.ceil(trajectory.t / horizon * count - 1e-9).astype(int) - 1
    order = np.lexsort((-badness, interval))
    order = order[interval[order] >= 0]
    first = np.unique(interval[order], return_index=True)[1]
    return np.sort(order[first])


def all_instants(trajectory: Trajectory) -> LoadCases:
    """Return all instants with the weights of the trapezoidal rule, s."""
    steps = np.diff(trajectory.t)
    weights = 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
    return LoadCases(np.arange(len(weights)), weights)


class MotionResponse(Response):
    """A response of the motion: one value of the machine, of all scenarios together.

    As objective scenarios count as `objective.scenarios` says; a limit holds for every one of
    them: the p-norm of their values, whose true one is the largest.
    Of those that equivalent static loads say nothing of (`EXACT_ONLY`) the gradient is exact.
    """

    needs: ClassVar[frozenset[Need]] = MOTION

    def parts(self, scene: Scene) -> Sequence[tuple[str, MotionResponse]]:
        """Return the values that it has, as responses of one value each, by their names.

        By default itself, without a name; a response with a value for every drive has several.
        """
        return [("", self)]

    def load_cases(self, trajectory: Trajectory) -> LoadCases:
        """Return the instants that make it up; by default all."""
        return all_instants(trajectory)

    @abstractmethod
    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the value of one motion at given instants."""

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the true value of one motion, where `value` is a smooth stand-in."""
        return self.of_motion(trajectory)

    @abstractmethod
    def derivatives(
        self, trajectory: Trajectory, cases: LoadCases
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return the derivatives of `value` at held instants.

        Returns:
            By the system's coordinates at the instants (n, S), or by them, their rates and their
            accelerations (3, n, S); and of every body by the fields of its `ShapeIntegrals` on
            which it depends directly.
        """

    def cotangents(self, trajectory: Trajectory) -> list[ShapeIntegrals]:
        """Return the exact derivatives by the shape integrals of every body, of one motion.

        Its own, with the coordinates held, and the trajectory's, whose coordinates follow. The
        choice of instants is held: where two of an interval are equally bad there is a kink.
        """
        cases = self.load_cases(trajectory)
        by_q, own = self.derivatives(trajectory, cases)
        followed = trajectory.adjoint.gradient(trajectory.t[cases.indices], by_q)
        return [add_integrals(a, fields) for a, fields in zip(followed, own, strict=True)]

    def load_case_moments(self, trajectory: Trajectory) -> list[np.ndarray]:
        """Return A = sum_j lambda_j q_j' (q, q) of every arm, for a gradient with frozen loads.

        With the equivalent static loads K q_j held, a change of stiffness gives
        dJ = -lambda_j . dK q_j with K lambda_j = dJ/dq_j, which joints of a loop follow.
        """
        cases = self.load_cases(trajectory)
        by_q = trajectory.by_elastic(cases.indices, self.derivatives(trajectory, cases)[0])
        mechanism, q = trajectory.mechanism, trajectory.q_e[cases.indices]
        return [
            np.linalg.solve(body.K, by_q[:, part].T) @ q[:, part]
            for body, part in zip(mechanism.bodies, mechanism.slices, strict=True)
        ]

    def of_motion(self, trajectory: Trajectory) -> float:
        """Return the value of one motion, at the instants that it chooses (root only)."""
        return self.value(trajectory, self.load_cases(trajectory))

    def combine(self, scene: Scene, values: Sequence[float]) -> tuple[float, list[float]]:
        """Return the value of all scenarios from their own, and its derivatives by them."""
        if self.limited:
            return worst_of(values, self.options.exponent)
        return combined(scene, values, self.turned)

    def of_trajectory(self, trajectory: Trajectory) -> tuple[float, float]:
        """Return true and smooth value of a motion, or of its scenarios together (root only)."""
        scenarios = trajectory.scenarios
        if not scenarios:
            return self.extreme(trajectory), self.of_motion(trajectory)
        smooth = self.combine(trajectory.scene, self._of_scenarios(scenarios))[0]
        true = [self.extreme(one) for one in scenarios]
        if self.limited:
            return max(true), smooth
        if trajectory.scene.objective.scenarios == "sum":
            return combined(trajectory.scene, true)[0], smooth
        weighted = [s.weight * f for s, f in zip(trajectory.scene.scenarios, true, strict=True)]
        return min(weighted) if self.turned else max(weighted), smooth

    def _of_scenarios(self, scenarios: Sequence[Trajectory]) -> list[float]:
        return [self.of_motion(one) for one in scenarios]

    def measure(self, analysis: Analysis) -> Measured:
        """Return the values of the analysis's motion (collective)."""
        parts = self.parts(analysis.scene)

        def values() -> list[tuple[float, float]]:
            assert analysis.trajectory is not None
            return [one.of_trajectory(analysis.trajectory) for _, one in parts]

        true, smooth = zip(*on_root(analysis.partition.world, values), strict=True)
        return Measured(self.name, tuple(name for name, _ in parts), true, smooth)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every value by the physical densities (collective).

        See `objective.gradient`.
        """
        return [one.gradient(analysis) for _, one in self.parts(analysis.scene)]

    def gradient(self, analysis: Analysis) -> CellGradient:
        """Return the gradient of the one value of this response (collective)."""
        scene, partition, designs = analysis.scene, analysis.partition, analysis.designs
        profile, trajectory = analysis.profile, analysis.trajectory

        def moments() -> dict[int, np.ndarray]:
            assert trajectory is not None
            return by_owner(scene, _load_case_moments(self, trajectory))

        def cotangents() -> dict[int, ShapeIntegrals]:
            assert trajectory is not None
            profile.counts.adjoints += max(1, len(trajectory.scenarios))
            with profile.phase("adjoint"):
                return by_owner(scene, _cotangents(self, trajectory))

        if self.options.gradient == "esl" and self.name not in EXACT_ONLY:
            A = on_root(partition.world, moments)
            with together(partition.world):
                return {k: esl_gradient(one, A[k], analysis.by) for k, one in designs.items()}
        by_body = on_root(partition.world, cotangents)
        with together(partition.world):
            return {
                k: exact_gradient(one, by_body[k], by=analysis.by) for k, one in designs.items()
            }


class ComplianceResponse(MotionResponse):
    """A weighted sum of q' K q of all arms over instants."""

    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return sum_j w_j q_j' K q_j."""
        return float(cases.weights @ trajectory.compliance[cases.indices].sum(axis=1))

    def derivatives(
        self, trajectory: Trajectory, cases: LoadCases
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return 2 w_j K q_j, and the second moments of q by K."""
        q = trajectory.q_e[cases.indices]
        by_q = 2.0 * cases.weights[:, None] * (q @ trajectory.mechanism.stiffness())
        by_q[:, trajectory.mechanism.bearing_columns] = 0.0
        return trajectory.by_unknowns(by_q), [{"K": Q} for Q in second_moments(trajectory, cases)]

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


def _load_case_moments(response: MotionResponse, trajectory: Trajectory) -> list[np.ndarray]:
    """Return `load_case_moments`, of all scenarios together where there are any."""
    scene, others = trajectory.scene, trajectory.scenarios
    if not others:
        return response.load_case_moments(trajectory)
    _, weights = response.combine(scene, response._of_scenarios(others))
    total: list[np.ndarray] = []
    for weight, one in zip(weights, others, strict=True):
        parts = [
            # Of its stiffness; rigid arms and bodies from files have no gradient.
            weight * factors(scene, one.scene, index).stiffness * part
            for index, part in enumerate(response.load_case_moments(one)[: len(scene.arms)])
        ]
        total = [a + b for a, b in zip(total, parts, strict=True)] if total else parts
    return total


def _cotangents(response: MotionResponse, trajectory: Trajectory) -> list[ShapeIntegrals]:
    """Return `cotangents` by the scene's bodies, of all scenarios together if there are any."""
    scene, others = trajectory.scene, trajectory.scenarios
    if not others:
        return response.cotangents(trajectory)
    _, weights = response.combine(scene, response._of_scenarios(others))
    total: list[ShapeIntegrals] = []
    for weight, one in zip(weights, others, strict=True):
        parts = [
            cotangents_of_scene(by_body, factors(scene, one.scene, index), weight)
            for index, by_body in enumerate(response.cotangents(one)[: len(scene.arms)])
        ]
        total = [a + b for a, b in zip(total, parts, strict=True)] if total else parts
    return total


def motion_objective(trajectory: Trajectory) -> MotionResponse | None:
    """Return the objective of the trajectory's scene; None where it is no motion's."""
    options = trajectory.scene.objective
    response = find(options.kind)(options)
    return response if isinstance(response, MotionResponse) else None


# -- deviation of the end-effector from its rigid path -------------------------------------------


@register
class Deviation(MotionResponse):
    """(1/T int |e|^p dt)^(1/p), m: close to the largest deviation, and smooth.

    With e from eq. (6) of Seifried, Moghadasi & Held (2015), doi:10.1016/j.piutam.2015.01.018.
    """

    name, label, unit = "deviation", "p-mean of the deviation", "m"

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest deviation of all instants, m."""
        return trajectory.max_deviation[0]

    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the p-mean."""
        return self._mean(trajectory, cases)[0]

    def derivatives(
        self, trajectory: Trajectory, cases: LoadCases
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return its derivatives through the outboard interfaces' modes."""
        _, by_deviation = self._mean(trajectory, cases)
        return trajectory.by_end_effector(cases.indices, by_deviation)

    def _mean(self, trajectory: Trajectory, cases: LoadCases) -> tuple[float, np.ndarray]:
        weights = cases.weights / cases.weights.sum()
        vectors = self._vectors(trajectory)[cases.indices]
        return p_norm_of_lengths(vectors, self.options.exponent, weights)

    def _vectors(self, trajectory: Trajectory) -> np.ndarray:
        return trajectory.deviation


# -- deviation of the end-effector at rest: after the motion and in its dwells --------------------


@register
class Settling(Deviation):
    """The p-mean of the deviation in all rests together, m; its true value the largest."""

    name, label = "settling", "p-mean of the deviation at rest"

    def load_cases(self, trajectory: Trajectory) -> LoadCases:
        """Return the instants of the vibration that is left."""
        indices = np.flatnonzero(trajectory.at_rest)
        weights = all_instants(trajectory).weights[indices]
        return LoadCases(indices, weights)

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest of these deviations, m."""
        return trajectory.settling


# -- rotation of the end-effector against that of rigid links ------------------------------------


@register
class Orientation(Deviation):
    """(1/T int |theta|^p dt)^(1/p), rad: close to the end-effector's largest rotation, and smooth.

    theta = log(R R_0') takes its orientation with rigid links to the one that it has.
    """

    name, label, unit = "orientation", "p-mean of the end-effector's rotation", "rad"

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest rotation of all instants, rad."""
        return trajectory.max_rotation

    def derivatives(
        self, trajectory: Trajectory, cases: LoadCases
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return its derivatives; they are along theta, where a spin changes theta by itself."""
        _, by_rotation = self._mean(trajectory, cases)
        no_force = np.zeros_like(trajectory.deviation[cases.indices])
        return trajectory.by_end_effector(cases.indices, no_force, by_rotation)

    def _vectors(self, trajectory: Trajectory) -> np.ndarray:
        return trajectory.rotation


# -- compliance over the whole horizon -----------------------------------------------------------


@register
class IntegralCompliance(ComplianceResponse):
    """Integral of q' K q over the horizon, trapezoidal rule, N m s."""

    name, label, unit = "compliance", "integral of the compliance", "N m s"


# -- compliance under the equivalent static loads of the worst instants: the paper's objective ---


@register
class EquivalentStaticLoads(ComplianceResponse):
    """Sum of q' K q over the worst instant of each of `objective.load_cases` intervals, N m.

    Source: Seifried, Moghadasi & Held (2015), eq. (9), doi:10.1016/j.piutam.2015.01.018.
    """

    name, label, unit = "esl", "compliance of the load cases", "N m"

    def load_cases(self, trajectory: Trajectory) -> LoadCases:
        """Return the worst instant of each interval."""
        indices = worst_instants(trajectory, self.options.load_cases, self.worst)
        return LoadCases(indices, np.ones(len(indices)))

    @property
    def worst(self) -> WorstBy:
        """What decides which instant is the worst."""
        return self.options.worst


# -- compliance of the load cases, as every summary has it ---------------------------------------


@register
class LoadCaseCompliance(EquivalentStaticLoads):
    """The instants are the worst by compliance whatever `objective.worst`: a limit's, N m."""

    name = "load_case_compliance"

    @property
    def worst(self) -> WorstBy:
        """The compliance decides."""
        return "compliance"


# -- forces of the drives over the horizon -------------------------------------------------


class DriveResponse(MotionResponse):
    """A function of the forces of all drives: of the cart, N, and of the joints, N m.

    Its gradient is exact, whatever `objective.gradient`: equivalent static loads are held while
    the stiffness changes, and drives carry the mass, which these loads leave out.
    """

    @abstractmethod
    def by_forces(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        """Return the derivatives of `value` by the forces (n, drives) at the instants."""

    def derivatives(
        self, trajectory: Trajectory, cases: LoadCases
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return the derivatives through coordinates, rates and accelerations, and by bodies."""
        weights = np.zeros_like(trajectory.joint_forces)
        by_forces = self.by_forces(trajectory, cases)
        weights[_at_drives(trajectory, cases)] = by_forces
        by_rates, bodies = trajectory.drive_forces.gradient(weights)
        return by_rates[:, cases.indices], [integrals_of(one) for one in bodies]

    def weights(self, scene: Scene) -> np.ndarray:
        """Return the weight of every drive (drives,), 1/N and 1/(N m): 1 of each by default."""
        given = self.options.effort_weights
        return np.ones(len(scene.driven)) if given is None else np.array(given)


def _at_drives(trajectory: Trajectory, cases: LoadCases) -> Any:
    """Return the places of the drives' forces at the instants among all."""
    columns = trajectory.scene.driven_columns
    if isinstance(columns, slice):
        return cases.indices, columns
    return np.ix_(cases.indices, np.array(columns))


# -- effort of the drives: what their motors' heat, and with it their size, follow from ----------


@register
class Effort(DriveResponse):
    """sqrt(1/T int sum_k (w_k F_k)^2 dt) of the weighted forces F_k of all drives, no unit.

    The root mean square of the forces, `drive_rms` of the summary, drives together; with the
    reciprocals of their rated continuous forces as weights w_k, 1 is one drive at its rating.
    """

    name, label, unit = "effort", "effort of the drives", "-"

    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the weighted root mean square."""
        return float(np.sqrt(np.sum(self._weighted(trajectory, cases) ** 2)))

    def by_forces(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        """Return its derivatives by the forces (n, drives); 0 where no drive does anything."""
        weighted, effort = self._weighted(trajectory, cases), self.value(trajectory, cases)
        if effort == 0.0:
            return weighted
        return weighted * self._factors(trajectory, cases) / effort

    def _weighted(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        """Return the terms (n, drives) whose squares add up to the effort's."""
        forces = trajectory.joint_forces[_at_drives(trajectory, cases)]
        return self._factors(trajectory, cases) * forces

    def _factors(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        share = np.sqrt(cases.weights / cases.weights.sum())
        return share[:, None] * self.weights(trajectory.scene)


# -- largest force of every drive over the horizon: what drives must be able to give -------------


@register
class PeakForce(DriveResponse):
    """(1/T int |F_k|^p dt)^(1/p) of every drive k, N and N m; its true value the largest |F_k|.

    As objective the sum over the drives, each times its weight of `objective.effort_weights`.
    """

    name, label, unit = "peak_force", "weighted sum of the drives' peak forces", "-"

    def __init__(
        self,
        options: Objective,
        limited: bool = False,
        drive: int = 0,
        drives: tuple[int, ...] | None = None,
    ):
        """Take the options, which of the scene's drives this is, and of which it has parts."""
        super().__init__(options, limited)
        self.drive, self.drives = drive, drives

    def restricted(self, limits: Sequence[float | None]) -> tuple[Response, tuple[float, ...]]:
        """Return the response of those drives that have a limit, and these limits."""
        drives = tuple(k for k, one in enumerate(limits) if one is not None)
        kept = tuple(one for one in limits if one is not None)
        return PeakForce(self.options, self.limited, drives=drives), kept

    def parts(self, scene: Scene) -> Sequence[tuple[str, MotionResponse]]:
        """Return one response for every drive that counts, by the name of its coordinate."""
        every = range(len(scene.driven)) if self.drives is None else self.drives
        return [(scene.driven[k], PeakForce(self.options, self.limited, k)) for k in every]

    @classmethod
    def unit_of(cls, value: str) -> str:
        """Return N for the cart's drive, N m for a joint's."""
        return "N" if value == CART else "N m"

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest force of all instants."""
        return float(np.abs(self._force(trajectory)).max())

    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the p-mean."""
        return self._mean(trajectory, cases)[0]

    def by_forces(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        """Return its derivatives by the forces (n, drives)."""
        by = np.zeros((len(cases.indices), len(trajectory.scene.driven)))
        by[:, self.drive] = self._mean(trajectory, cases)[1]
        return by

    def _force(self, trajectory: Trajectory) -> np.ndarray:
        """Return the drive's force over time (n,); of an objective times its weight."""
        scene = trajectory.scene
        force = trajectory.joint_forces[:, scene.driven_columns][:, self.drive]
        return force if self.limited else self.weights(scene)[self.drive] * force

    def _mean(self, trajectory: Trajectory, cases: LoadCases) -> tuple[float, np.ndarray]:
        force = self._force(trajectory)[cases.indices]
        weights = cases.weights / cases.weights.sum()
        mean, by_size = p_norm(np.abs(force), self.options.exponent, weights)
        scale = 1.0 if self.limited else self.weights(trajectory.scene)[self.drive]
        return mean, scale * np.sign(force) * by_size
