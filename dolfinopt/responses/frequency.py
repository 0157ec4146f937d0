"""First natural frequency of every flexible arm with what it carries."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dolfinopt.arms.arm import chain_of
from dolfinopt.arms.design_state import DesignState
from dolfinopt.arms.modes import FrozenTree, LoadedModes
from dolfinopt.motion.build import build_mechanism, rigid_motion
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.parallel import on_all_ranks, on_root, together
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


@response("eigenfrequency")
class Eigenfrequency(Response):
    """Squared longest period of every flexible arm, s2; its true value is the frequency, Hz.

    As objective with `objective.modes = "first"` that of the followed mode.
    """

    def squared_period(self, modes: LoadedModes) -> tuple[float, np.ndarray]:
        """Return (sum_k T_k^(2 p))^(1/p) in s2, and its derivative by the eigenvalues (k,).

        At least the longest period squared, and smooth: a symmetric function of the eigenvalues has
        a gradient where they cross or coincide. With `follow` the followed mode's alone.
        """
        squared = 4.0 * np.pi**2 / modes.values
        if self.options.follow and not self.limited:
            value, by_squared = squared[modes.followed], np.eye(len(squared))[modes.followed]
        else:
            value, by_squared = p_norm(squared, self.options.exponent)
        return float(value), -by_squared * squared / modes.values

    def measure(self, analysis: Analysis) -> Measured:
        """Return squared period and first frequency of every flexible arm (collective)."""
        scene, partition, designs = analysis.scene, analysis.partition, analysis.designs
        chain = _frozen(analysis)
        with together(partition.world):
            mine = {
                place: (self.squared_period(mode)[0], mode.frequency)
                for place, mode in _modes(_by_place(scene, designs), chain).items()
            }
        result = on_all_ranks(partition, mine)
        periods, frequencies = zip(*result.values(), strict=True)
        names = tuple(scene.arms[place].name for place in result)
        return Measured(self.name, names, frequencies, periods)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every flexible arm's squared period (collective).

        What an arm carries depends on the designs outboard of it.
        """
        scene, partition, designs = analysis.scene, analysis.partition, analysis.designs
        chain = _frozen(analysis)
        with together(partition.world):
            by_place = _by_place(scene, designs)
            own = {
                place: period_gradient(
                    by_place[place], mode, self.squared_period(mode)[1], analysis.by
                )
                for place, mode in _modes(by_place, chain).items()
            }
        by_carried = on_all_ranks(partition, {place: item[1] for place, item in own.items()})
        rows = []
        zero = list(map(np.zeros_like, chain.carried()))
        with together(partition.world):
            for place, matrix in by_carried.items():
                carried = [*zero[:place], matrix, *zero[place + 1 :]]
                by_body = by_owner(scene, chain.cotangents(carried))
                row = {
                    k: rigid_gradient(each, by_body[k], analysis.by) for k, each in designs.items()
                }
                owner = scene.owners[place]
                if owner in row:
                    row[owner] = row[owner] + own[place][0]
                rows.append(row)
        return rows

    def smooth_of(self, values: np.ndarray) -> np.ndarray:
        """Return the squared periods of frequencies, s2."""
        return values**-2.0


def _frozen(analysis: Analysis) -> FrozenTree:
    """Freeze the machine at the elbow angle, or in the middle of its motion (collective)."""
    scene, partition = analysis.scene, analysis.partition
    with together(partition.world):
        mine = {k: state.rigid_body for k, state in analysis.designs.items()}
    owned = on_all_ranks(partition, mine)

    def freeze() -> FrozenTree:
        rigid = build_mechanism(scene, chain_of(scene, owned)).rigid  # its bearings, too
        if scene.objective.elbow_angle is None:
            motion = rigid_motion(np.array([0.5 * scene.motion.duration]), scene)
        else:
            angles = np.full((1, rigid.num_rigid), scene.objective.elbow_angle)
            motion = RigidMotion(angles, 0.0 * angles, 0.0 * angles)
        return FrozenTree(replace(rigid, forces=()), motion, scene.objective.attached)

    return on_root(partition.world, freeze)


def _by_place(scene: Scene, designs: Mapping[int, DesignState]) -> dict[int, DesignState]:
    """Return the design of every arm of the chain that has one of this rank's."""
    return {
        place: designs[owner]
        for place, owner in enumerate(scene.owners)
        if owner is not None and owner in designs
    }


def _modes(designs: Mapping[int, DesignState], chain: FrozenTree) -> dict[int, LoadedModes]:
    """Return the loaded modes of arms by their place in the chain; within `together`."""
    carried = chain.carried()
    return {place: design.loaded_modes(place, carried[place]) for place, design in designs.items()}
