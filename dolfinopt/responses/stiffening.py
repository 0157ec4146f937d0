"""Whether the arms' bodies get geometric stiffness: as the scene says, or by what it changes.

"auto" simulates the machine twice, with and without it, with arms that have the static modes of
their outboard interfaces alone, and leaves out what changes the deviation by less than `NEGLECTED`.
Where the loads change the stiffness of no arm by more than `SURELY_OFF`, nothing is simulated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.arms.arm import stiffening_of
from dolfinopt.dynamics.build import build_mechanism, closure_of
from dolfinopt.dynamics.simulation import Trajectory, simulate_batch
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.motion import rigid_motion
from dolfinopt.multibody.shape_integrals import (
    ShapeIntegrals,
    linear_part,
    rigid_part,
    shape_integrals,
)
from dolfinopt.multibody.stiffening import Stiffening, largest_change, stiffness_change
from dolfinopt.parallel import Partition, gather_arms, on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.reduction import Basis
from dolfinopt.responses.scenarios import bodies_in
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

INSTANTS = 201  # of the horizon, at which loads are looked at
# Share of the largest deviation that "auto" may leave out: 0.5 %, less what the static modes do not
# show of it (measured: a tenth).
NEGLECTED = 4e-3
# Largest change of an arm's stiffness with which it is left out, and that with which it is taken
# into account, without a simulation. Measured: the deviation changes by 0.3 to 3 times as much.
SURELY_OFF, SURELY_ON = 5e-4, 0.05
UNKNOWN = 2e-3  # the change from which it is taken into account where the comparison fails


def decide_stiffening(
    scenes: Sequence[Scene], partition: Partition, arms: Mapping[int, Arm]
) -> None:
    """Let the arms' bodies have geometric stiffness from now on, or not (collective).

    Decided once, by the design that the arms have, see `reconsider_stiffening`.

    Args:
        scenes: one and its scenarios, which are decided together; the first one says true, false or
            "auto".
        partition: which ranks do which arm.
        arms: this rank's, with a design.
    """
    if partition.world.allreduce(all(arm.stiffening is not None for arm in arms.values()), min):
        return
    [found] = stiffening_of_each([scenes], partition, arms)
    for arm in arms.values():
        arm.set_stiffening(found)


def reconsider_stiffening(
    scenes: Sequence[Scene], partition: Partition, arms: Mapping[int, Arm]
) -> bool:
    """Switch stiffening on where "auto" left it out and the arms' designs now call for it.

    Collective.

    Returns:
        Whether it was switched on.
    """
    known = partition.world.bcast(stiffening_of(arms), root=0)
    if scenes[0].simulation.stiffening != "auto" or known is None or known.on:
        return False
    [found] = stiffening_of_each([scenes], partition, arms)
    for arm in arms.values():
        arm.set_stiffening(found)
    return found.on


def stiffening_of_each(
    groups: Sequence[Sequence[Scene]], partition: Partition, arms: Mapping[int, Arm]
) -> list[Stiffening]:
    """Return what is decided for each group of scenes on its own (collective).

    Args:
        groups: scenes of the same arms; those of a group are decided together.
        partition: which ranks do which arm.
        arms: this rank's, with a design.
    """
    stated = not any(group[0].simulation.stiffening == "auto" for group in groups)
    if stated and groups[0][0].is_spatial:  # where it takes most of the memory of a solid arm
        return [Stiffening(None, group[0].simulation.stiffening is True) for group in groups]
    with together(partition.world):
        mine = {k: _static_body(arm, simulated=not stated) for k, arm in arms.items()}
    owned = gather_arms(partition, mine)
    found: list[Stiffening] = on_root(partition.world, _decided, groups, owned)
    return found


def _static_body(arm: Arm, simulated: bool) -> ShapeIntegrals:
    """Return the body in the static modes of its outboard interface: they need no eigenproblem.

    What the inertia of the modes stiffens is not needed for the estimate alone.
    """
    state = arm.current
    elastic, static = state.elastic, state.elastic.constraint_modes()
    none = np.empty((len(static.interior), 0))
    weighted = elastic.mass_times(static.field)
    basis = Basis(static.field, weighted, static.stiffness, np.eye(static.field.shape[2]), none)
    damping = state.scene.damping.stiffness_proportional
    loads = state.unit_loads
    if simulated:
        loads = loads.with_modes(static.field, weighted)
    return shape_integrals(elastic, basis, damping, loads)


def _decided(
    groups: Sequence[Sequence[Scene]], owned: Mapping[int, ShapeIntegrals]
) -> list[Stiffening]:
    """Return what is decided for each group."""
    first, found = groups[0][0], []
    for group in groups:
        asked = group[0].simulation.stiffening
        estimate = max(_change(one, bodies_in(first, one, owned)) for one in group)
        if asked != "auto":
            found.append(Stiffening(estimate, asked))
            continue
        if not SURELY_OFF < estimate < SURELY_ON:
            found.append(Stiffening(estimate, estimate >= SURELY_ON))
            continue
        bodies = [bodies_in(first, one, owned) for one in group]
        neglected = _neglected(group, bodies)
        on = estimate >= UNKNOWN if neglected is None else neglected > NEGLECTED
        found.append(Stiffening(estimate, on, neglected))
    return found


def _change(scene: Scene, bodies: list[ShapeIntegrals]) -> float:
    """Return the largest change of an arm's stiffness by the loads of the motion."""
    t = np.linspace(0.0, scene.motion.horizon, INSTANTS)
    if not scene.is_spatial:
        mechanism = build_mechanism(scene, bodies)
        return largest_change(mechanism, rigid_motion(t, scene), closure_of(scene))
    from dolfinopt.multibody.spatial import inverse_dynamics as space
    from dolfinopt.multibody.spatial.links import build_spatial_mechanism
    from dolfinopt.multibody.spatial.motion import joint_motion

    stiffened, motion = build_spatial_mechanism(scene, bodies), joint_motion(t, scene)
    rigid, none = replace(stiffened, bodies=tuple(map(rigid_part, bodies))), np.zeros((len(t), 0))
    links = space.outward_pass(rigid, motion, (none, none, none))
    loads = space.body_loads(links, space.inward_pass(rigid, links).outboard)
    pairs = zip(stiffened.bodies, loads, strict=True)
    return max((stiffness_change(body, p) for body, p in pairs), default=0.0)


def _neglected(group: Sequence[Scene], bodies: list[list[ShapeIntegrals]]) -> float | None:
    """Return the share of the largest deviation that linear bodies miss; None if one cannot move.

    Simulated beside the run: the comparison is none of its simulations.
    """
    profile = Profile()
    linear = [[linear_part(body) for body in chain] for chain in bodies]
    largest = 0.0
    pairs = zip(
        simulate_batch(group, bodies, profile), simulate_batch(group, linear, profile), strict=True
    )
    for stiffened, without in pairs:
        if isinstance(stiffened, ConvergenceError) or isinstance(without, ConvergenceError):
            return None
        moved, other = _displacements(stiffened), _displacements(without.at(stiffened.t))
        size = np.linalg.norm(moved, axis=-1).max(initial=0.0)
        if size > 0.0:
            apart = np.linalg.norm(moved - other, axis=-1).max()
            largest = max(largest, float(apart / size))
    return largest


def _displacements(trajectory: Trajectory) -> np.ndarray:
    """Return the deviation (n, 1, d); of closed loops the arms' outboard ends' (n, arms, d), m."""
    deviation = trajectory.deviation
    if trajectory.closure_force is None:
        return deviation[:, None]
    d, mechanism = deviation.shape[1], trajectory.mechanism
    parts = zip(mechanism.slices, mechanism.bodies, strict=True)
    ends = [trajectory.q_e[:, part] @ body.outboard[:d].T for part, body in parts]
    return np.stack(ends, axis=1)
