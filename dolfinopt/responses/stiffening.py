"""Whether the arms' bodies get geometric stiffness: as the scene says, or by an estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.arms.arm import chain_of
from dolfinopt.dynamics.build import build_mechanism, closure_of
from dolfinopt.multibody.motion import rigid_motion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, shape_integrals
from dolfinopt.multibody.stiffening import SWITCH_ON, Stiffening, largest_change
from dolfinopt.parallel import Partition, gather_arms, on_root, together
from dolfinopt.reduction import Basis
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

INSTANTS = 201  # of the horizon, at which loads are looked at


def decide_stiffening(
    scenes: Sequence[Scene], partition: Partition, arms: Mapping[int, Arm]
) -> None:
    """Let the arms' bodies have geometric stiffness from now on, or not (collective).

    Decided once, by the design that the arms have, and estimated with rigid arms on the desired
    motion: `Stiffening.estimate` says by how much the loads change an arm's stiffness. With
    `simulation.stiffening = false` machines in space have no estimate.

    Args:
        scenes: of the same arms; the first one says true, false or "auto".
        partition: which ranks do which arm.
        arms: this rank's, with a design.
    """
    asked = scenes[0].simulation.stiffening
    if asked is False and scenes[0].is_spatial:
        return  # the estimate takes more memory than all the rest of a solid arm
    if partition.world.allreduce(all(arm.stiffening is not None for arm in arms.values()), min):
        return
    with together(partition.world):
        mine = {k: _static_body(arm) for k, arm in arms.items()}
    owned = gather_arms(partition, mine)
    estimate: float = on_root(partition.world, _estimate, scenes, owned)
    on = estimate >= SWITCH_ON if asked == "auto" else asked is True
    for arm in arms.values():
        arm.set_stiffening(Stiffening(estimate, on))


def _static_body(arm: Arm) -> ShapeIntegrals:
    """Return the body in the static modes of its outboard interface: they need no eigenproblem."""
    state = arm.current
    elastic, static = state.elastic, state.elastic.constraint_modes()
    none = np.empty((len(static.interior), 0))
    weighted = elastic.mass_times(static.field)
    basis = Basis(static.field, weighted, static.stiffness, np.eye(static.field.shape[2]), none)
    return shape_integrals(elastic, basis, 0.0, state.unit_loads)


def _estimate(scenes: Sequence[Scene], owned: Mapping[int, ShapeIntegrals]) -> float:
    largest = 0.0
    for scene in scenes:
        if scene.is_spatial:
            largest = max(largest, _spatial_change(scene, chain_of(scene, owned)))
            continue
        mechanism = build_mechanism(scene, chain_of(scene, owned))
        motion = rigid_motion(np.linspace(0.0, scene.motion.horizon, INSTANTS), scene)
        largest = max(largest, largest_change(mechanism, motion, closure_of(scene)))
    return largest


def _spatial_change(scene: Scene, bodies: list[ShapeIntegrals]) -> float:
    """Return the largest change of a link's stiffness in space."""
    from dolfinopt.multibody.spatial.links import build_spatial_mechanism
    from dolfinopt.multibody.spatial.motion import joint_motion
    from dolfinopt.multibody.spatial.stiffening import largest_change as change

    motion = joint_motion(np.linspace(0.0, scene.motion.horizon, INSTANTS), scene)
    return change(build_spatial_mechanism(scene, bodies), motion)
