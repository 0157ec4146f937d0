"""First natural frequency of every flexible arm with what it carries."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.arms.arm import fixed_body
from dolfinopt.arms.design_state import DesignState
from dolfinopt.arms.modes import Chain, LoadedModes, RigidIntegrals, rigid_integrals
from dolfinopt.motion.build import rigid_motion
from dolfinopt.multibody.build import build_mechanism
from dolfinopt.parallel import on_all_ranks, on_root, together
from dolfinopt.responses.products import Products
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    by_owner,
    p_norm,
    response,
)
from dolfinopt.responses.sensitivity import period_gradient, rigid_gradient
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.joints import joint_parts

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


@response("eigenfrequency")
class Eigenfrequency(Response):
    """Squared longest period of every flexible arm, s2; its true value is the frequency, Hz.

    With `objective.follow` that of the followed mode as objective; a limit is for all modes.
    """

    def _squared_period(self, modes: LoadedModes) -> tuple[float, np.ndarray]:
        follow = self.options.follow and not self.limited
        return squared_period(modes, self.options.exponent, follow)

    def measure(self, analysis: Analysis) -> Measured:
        """Return squared period and first frequency of every flexible arm (collective)."""
        scene, partition, designs = analysis.scene, analysis.partition, analysis.designs
        chain = _frozen(analysis)
        with together(partition.world):
            mine = {
                place: (self._squared_period(one)[0], one.frequency)
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
                _, by_values = self._squared_period(one)
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
