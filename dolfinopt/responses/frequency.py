"""Natural frequencies of the arms, and poles of the controlled machine.

The first frequency of every arm is that with what it carries, as objective and as limit. Under
[control] the machine is linearised about its simulated motion at the instants of
`constraints.poles_at`: damping ratio and frequency of the closed loop's poles have exact gradients.
Poles move with the bodies and with the motion: `dynamics.poles` has both derivatives, the
adjoint of the trajectory the second part.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dolfinopt.arms.arm import fixed_body
from dolfinopt.arms.design_state import DesignState
from dolfinopt.arms.modes import Chain, LoadedModes, RigidIntegrals, rigid_integrals
from dolfinopt.dynamics.linearised import linearised
from dolfinopt.dynamics.poles import Poles, damping_ratios, poles_of
from dolfinopt.dynamics.trajectory import Trajectory
from dolfinopt.motion.build import rigid_motion
from dolfinopt.multibody.build import build_mechanism
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals, integrals_of
from dolfinopt.parallel import on_all_ranks, on_root, together
from dolfinopt.responses.measured import DAMPING_SHARPNESS, NEGLIGIBLE_POLE_SHARE
from dolfinopt.responses.motion import LoadCases, MotionResponse
from dolfinopt.responses.products import Products
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    by_owner,
    p_norm,
    register,
)
from dolfinopt.responses.sensitivity import period_gradient, rigid_gradient
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.joints import joint_parts
from dolfinopt.scene.tables.objective import NEEDS

if TYPE_CHECKING:
    from dolfinopt.arms.modes import FrozenTree

NOTHING = RigidIntegrals(0.0, 0j, 0.0)


def squared_period(modes: LoadedModes, exponent: float, follow: bool) -> tuple[float, np.ndarray]:
    """Return (sum_k T_k^(2 p))^(1/p) in s2, and its derivative by the eigenvalues (k,).

    At least the longest period squared, and smooth: a symmetric function of the eigenvalues has a
    gradient where they cross or coincide. With `follow` the followed mode's alone.
    """
    squared = 4.0 * np.pi**2 / modes.values
    if follow:
        weight = np.zeros(len(squared))
        weight[modes.followed] = 1.0
        return float(squared[modes.followed]), -weight * squared / modes.values
    value, by_squared = p_norm(squared, exponent)
    return value, -by_squared * squared / modes.values


@register
class Eigenfrequency(Response):
    """Squared longest period of every flexible arm, s2; its true value is the frequency, Hz."""

    name, label, unit = "eigenfrequency", "squared longest periods", "s2"
    limit_unit = "Hz"
    lower = True
    natural = "maximize"
    needs = NEEDS[name]
    stands_for = "first frequency"

    @property
    def follow(self) -> bool:
        """Whether it is the followed mode's period, whichever mode is lowest."""
        return self.options.follow

    def measure(self, analysis: Analysis) -> Measured:
        """Return squared period and first frequency of every flexible arm (collective)."""
        scene, partition, designs = analysis.scene, analysis.partition, analysis.designs
        chain = _frozen(analysis)
        with together(partition.world):
            mine = {
                place: (squared_period(one, self.options.exponent, self.follow)[0], one.frequency)
                for place, one in _modes(_by_place(scene, designs), chain).items()
            }
        found = on_all_ranks(partition, mine)
        periods, frequencies = zip(*found.values(), strict=True)
        names = tuple(scene.arms[place].name for place in found)
        return Measured(self.name, names, frequencies, periods)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every flexible arm's squared period (collective).

        What an arm carries depends on the designs outboard of it.
        """
        scene, partition, designs = analysis.scene, analysis.partition, analysis.designs
        chain = _frozen(analysis)
        with together(partition.world):
            by_place = _by_place(scene, designs)
            modes = _modes(by_place, chain)
            own = {}
            for place, one in modes.items():
                _, by_values = squared_period(one, self.options.exponent, self.follow)
                own[place] = period_gradient(by_place[place], one, by_values, analysis.by)
        by_carried = on_all_ranks(partition, {place: one.carried for place, one in own.items()})
        rows = []
        zero = [np.zeros_like(one.matrix()) for one in chain.carried()]
        with together(partition.world):
            for place, matrix in by_carried.items():
                carried = [*zero[:place], matrix, *zero[place + 1 :]]
                by_body: dict[int, Any] = by_owner(scene, chain.cotangents(carried))
                row = {
                    k: rigid_gradient(state, by_body[k], analysis.by)
                    if _counts(by_body[k])
                    else analysis.by(state, Products())  # it is not outboard of this place
                    for k, state in designs.items()
                }
                owner = scene.owners[place]
                if owner in row:
                    row[owner] = row[owner] + own[place].own
                rows.append(row)
        return rows

    def smooth_limits(
        self, analysis: Analysis, measured: Measured, limits: np.ndarray
    ) -> np.ndarray:
        """Return the squared periods of the least frequencies, scaled like the smooth ones, s2."""
        return np.array(measured.smooth) * (np.array(measured.values) / limits) ** 2


def _counts(by_body: Any) -> bool:
    """Return whether derivatives by a rigid body's integrals are more than zero."""
    if isinstance(by_body, RigidIntegrals):
        return by_body != NOTHING
    return bool(by_body.mass or by_body.w.any() or by_body.W.any())


def _frozen(analysis: Analysis) -> Chain | FrozenTree:
    """Freeze the mechanism in the pose in which its arms vibrate (collective)."""
    return FROZEN[analysis.scene.dimension](analysis)


def _chain(analysis: Analysis) -> Chain:
    """Freeze the arms of the plane at the elbow angle at which they vibrate (collective)."""
    scene, partition = analysis.scene, analysis.partition
    with together(partition.world):
        mine = {k: rigid_integrals(one.elastic) for k, one in analysis.designs.items()}
    owned = on_all_ranks(partition, mine)

    def freeze() -> Chain:
        bodies, outboard_points = [], []
        for place, owner in enumerate(scene.owners):
            if owner is not None:
                bodies.append(owned[owner])
                outboard_points.append(complex(scene.arms[place].length, 0.0))
            else:
                body = fixed_body(scene, place)
                moment, inertia = complex(*body.w[:, 0]), float(body.W[0, 0, 0])
                bodies.append(RigidIntegrals(body.mass, moment, inertia))
                outboard_points.append(complex(*body.outboard_point))
        angle = scene.objective.elbow_angle
        if angle is None:
            middle = np.array([0.5 * scene.motion.duration])
            angles = [float(value) for value in rigid_motion(middle, scene).q[0, 1:]]
        else:
            angles = [angle] * len(bodies)
        rotors = [*(one.rotor for one in joint_parts(scene)[1:]), 0.0]  # of the next arm's joint
        loads = [
            RigidIntegrals(arm.joint_mass, 0j, arm.joint_inertia + rotor)
            for arm, rotor in zip(scene.arms, rotors, strict=True)
        ]
        loads[-1] = loads[-1] + RigidIntegrals(scene.payload.mass, 0j, scene.payload.moment)
        return Chain(bodies, outboard_points, angles, loads, scene.objective.attached)

    return on_root(partition.world, freeze)


def _tree(analysis: Analysis) -> FrozenTree:
    """Freeze the machine in space in the pose at the middle of its motion (collective)."""
    from dolfinopt.arms.modes import FrozenTree, rigid_integrals_in_space

    scene, partition = analysis.scene, analysis.partition
    with together(partition.world):
        mine = {k: rigid_integrals_in_space(one.elastic) for k, one in analysis.designs.items()}
    owned = on_all_ranks(partition, mine)

    def freeze() -> FrozenTree:
        bodies = [
            fixed_body(scene, place) if owner is None else owned[owner]
            for place, owner in enumerate(scene.owners)
        ]
        motion = rigid_motion(np.array([0.5 * scene.motion.duration]), scene)
        rigid = build_mechanism(scene, bodies).rigid  # its bearings, too
        return FrozenTree(rigid, motion, scene.objective.attached)

    return on_root(partition.world, freeze)


FROZEN: dict[int, Callable[[Analysis], Chain | FrozenTree]] = {2: _chain, 3: _tree}


def _by_place(scene: Scene, designs: Mapping[int, DesignState]) -> dict[int, DesignState]:
    """Return the design of every arm of the chain that has one of this rank's."""
    return {
        place: designs[owner]
        for place, owner in enumerate(scene.owners)
        if owner is not None and owner in designs
    }


def _modes(designs: Mapping[int, DesignState], chain: Chain | FrozenTree) -> dict[int, LoadedModes]:
    """Return the loaded modes of arms by their place in the chain; within `together`."""
    carried = chain.carried()
    return {place: one.loaded_modes(place, carried[place]) for place, one in designs.items()}


# -- first natural frequency of every flexible arm, whichever mode it belongs to -----------------


@register
class FirstFrequency(Eigenfrequency):
    """The longest period even where `objective.follow` follows a mode: a limit is for all."""

    name = "first_frequency"

    @property
    def follow(self) -> bool:
        """False: the lowest mode counts."""
        return False


# -- poles of the closed loop --------------------------------------------------------------


class PoleResponse(MotionResponse):
    """The least of a function of the poles, of all instants together; limits are lower ones.

    Its smooth value grows as the true one falls.
    """

    lower = True
    natural = "maximize"
    of_none: ClassVar[float] = np.inf  # the value where no pole counts

    @abstractmethod
    def of_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return the value of every pole (P,)."""

    @abstractmethod
    def by_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return complex g (P,), the change of a pole's value being Re(g dlambda)."""

    @abstractmethod
    def smooth(self, values: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the smooth value of all poles' (P,), and its derivative by them."""

    @abstractmethod
    def badness(self, value: np.ndarray | float) -> np.ndarray | float:
        """Return what the smooth value is of a single pole."""

    def counts(self, poles: np.ndarray, scene: Scene) -> np.ndarray:
        """Return which poles count (P,): by default all."""
        return np.ones(len(poles), dtype=bool)

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the least value of all poles that count."""
        return float(np.min(self._values(_seen(trajectory))[1], initial=self.of_none))

    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the smooth value of the poles at the scene's instants, whatever the cases."""
        values = self._values(_seen(trajectory))[1]
        return self.smooth(values)[0] if len(values) else float(self.badness(self.of_none))

    def of_trajectory(self, trajectory: Trajectory) -> tuple[float, float]:
        """Return true and smooth value of a motion, or of its scenarios together (root only)."""
        if not trajectory.scenarios:
            return super().of_trajectory(trajectory)
        smooth = self.combine(trajectory.scene, self._of_scenarios(trajectory.scenarios))[0]
        return min(map(self.extreme, trajectory.scenarios)), smooth

    def smooth_limits(
        self, analysis: Analysis, measured: Measured, limits: np.ndarray
    ) -> np.ndarray:
        """Return the smooth limits, scaled like the smooth value of this design."""
        true, smooth = np.array(measured.values), np.array(measured.smooth)
        return np.asarray(self.badness(limits) * smooth / self.badness(true))

    def cotangents(self, trajectory: Trajectory) -> list[ShapeIntegrals]:
        """Return the exact derivatives by the shape integrals of every body, of one motion."""
        seen = _seen(trajectory)
        by_rates, own = self.derivatives(seen, self.load_cases(seen))
        followed = trajectory.adjoint.gradient(seen.t, by_rates)
        return [add_integrals(a, fields) for a, fields in zip(followed, own, strict=True)]

    def derivatives(
        self, trajectory: Trajectory, cases: LoadCases
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return those by coordinates, rates and accelerations at the scene's instants, and bodies.

        Whatever the cases are.
        """
        every, values = self._values(_seen(trajectory))
        by_values = self.smooth(values)[1] if len(values) else values
        # Poles far from the least one count for nothing, and cost as much.
        least = NEGLIGIBLE_POLE_SHARE * np.abs(by_values).max(initial=0.0)
        by_values = np.where(np.abs(by_values) > least, by_values, 0.0)
        ends = np.cumsum([counted.sum() for _, counted in every])[:-1]
        by_rates, bodies = [], []
        for (poles, counted), by in zip(every, np.split(by_values, ends), strict=True):
            weights = np.zeros(len(poles.values), dtype=complex)
            weights[counted] = by * self.by_poles(poles.values[counted])
            rates, own = poles.gradient(weights)
            by_rates.append(rates)
            bodies.append(own)
        total = bodies[0]
        for own in bodies[1:]:
            total = [a + b for a, b in zip(total, own, strict=True)]
        return np.concatenate(by_rates, axis=1), [integrals_of(one) for one in total]

    def _values(self, trajectory: Trajectory) -> tuple[list[tuple[Poles, np.ndarray]], np.ndarray]:
        """Return the poles at the instants with which of them count, and the values of these."""
        system = trajectory.problem
        every, values = [], []
        for t in map(float, trajectory.t):
            seen = trajectory.at(np.array([t]))
            poles = poles_of(linearised(system, t, seen.unknowns))
            counted = self.counts(poles.values, trajectory.scene)
            every.append((poles, counted))
            values.append(self.of_poles(poles.values[counted]))
        return every, np.concatenate(values)


def _seen(trajectory: Trajectory) -> Trajectory:
    """Return a motion seen at the instants at which the scene asks for poles."""
    scene = trajectory.scene
    return trajectory.at(np.array(scene.constraints.pole_instants(scene.motion)))


# -- damping ratio -------------------------------------------------------------------------------


@register
class DampingRatio(PoleResponse):
    """Least damping ratio -Re / |lambda| of the closed loop's poles, 1 where none is limited.

    Smooth: 1 less Kreisselmeier and Steinhauser's least, -1/k ln sum exp(-k ratio).
    """

    name, label, unit = "damping_ratio", "1 less the least damping ratio", "-"
    stands_for = "least damping ratio"
    of_none = 1.0

    def counts(self, poles: np.ndarray, scene: Scene) -> np.ndarray:
        """Return which poles are below `constraints.damping_below`."""
        limit = scene.constraints.damping_below
        if limit is None:
            return np.ones(len(poles), dtype=bool)
        return np.abs(poles) <= 2.0 * np.pi * limit

    def of_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return the damping ratios."""
        return damping_ratios(poles)

    def by_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return -(Im^2 + i Re Im) / |lambda|^3."""
        size = np.maximum(np.abs(poles), np.finfo(float).tiny) ** 3
        return -poles.imag * (poles.imag + 1j * poles.real) / size

    def smooth(self, values: np.ndarray) -> tuple[float, np.ndarray]:
        """Return 1 less the smooth least ratio."""
        least = float(values.min())
        powers = np.exp(-DAMPING_SHARPNESS * (values - least))
        total = float(powers.sum())
        return 1.0 - least + np.log(total) / DAMPING_SHARPNESS, -powers / total

    def badness(self, value: np.ndarray | float) -> np.ndarray | float:
        """Return what is missing to a ratio of 1."""
        return 1.0 - value


# -- frequency -----------------------------------------------------------------------------------


@register
class PoleFrequency(PoleResponse):
    """Least natural frequency |lambda| / 2 pi of the closed loop's poles, Hz.

    Smooth: the p-norm of the periods, s.
    """

    name, label, unit, limit_unit = "pole_frequency", "longest period", "s", "Hz"
    stands_for = "least frequency of the closed loop"

    def of_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return the frequencies, Hz."""
        return np.abs(poles) / (2.0 * np.pi)

    def by_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return conj(lambda) / (2 pi |lambda|)."""
        size = np.maximum(np.abs(poles), np.finfo(float).tiny)
        return np.conj(poles) / (2.0 * np.pi * size)

    def smooth(self, values: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the smooth longest period, s."""
        period, by_periods = p_norm(1.0 / values, self.options.exponent)
        return period, -by_periods / values**2

    def badness(self, value: np.ndarray | float) -> np.ndarray | float:
        """Return the period, s."""
        return 1.0 / value
