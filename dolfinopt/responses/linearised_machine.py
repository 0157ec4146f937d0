"""A machine linearised with as many coordinates as its poles need.

The error of a number of coordinates is that of the poles against those of the same machine with
twice as many Craig-Bampton coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import ceil
from sys import maxsize
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.arms.arm import chain_of
from dolfinopt.dynamics.simulation import simulate
from dolfinopt.dynamics.state_space import StateSpace, check_instant, state_space
from dolfinopt.errors import ConvergenceError
from dolfinopt.parallel import Partition, gather_arms, on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.evaluation import decide_stiffening
from dolfinopt.responses.measured import (
    POLE_COORDINATES_GROWTH,
    POLE_COORDINATES_LIMIT,
    POLE_ERROR,
    POLE_ERROR_SHARE,
    RICHER_RATIO,
)
from dolfinopt.responses.order_selection import RICHER_METHOD
from dolfinopt.scene.load import Scene, pose_scenarios

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm


def linearised_machine(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
    t: float,
    profile: Profile,
    *,
    below: float | None = None,
) -> StateSpace:
    """Return a machine linearised at an instant of its motion (collective).

    Args:
        scene, partition, arms, x_phys, profile: as for `evaluate`; numbers of coordinates known.
        t: the instant, s.
        below: frequency below which all poles are to hold `POLE_ERROR`, Hz; more coordinates are
            taken until they do. None: those of the scene.

    Raises:
        InputError: the instant is not within the motion, or a coordinate has no mass.
        ConvergenceError: no number of coordinates holds the poles; or of the simulation.
    """
    check_instant(scene, t)
    with together(partition.world):
        for k, arm in arms.items():
            arm.set_design(x_phys[k])
    decide_stiffening([scene, *pose_scenarios(scene)], partition, arms)
    every = partition.world.allreduce(_fewest_dofs(arms), min)
    count = partition.world.allreduce(_largest(arms), max)

    def model(method: str, count: int) -> StateSpace:
        update = {"method": method, "coordinates": count}
        other = scene.model_copy(update={"reduction": scene.reduction.model_copy(update=update)})
        return _linearised(other, partition, arms, x_phys, t, profile)

    while True:
        found = model(scene.reduction.method, count)
        if not scene.cell_counts:
            return replace(found, accurate_below=np.inf)
        richer = model(RICHER_METHOD, min(RICHER_RATIO * count, every))
        held = accurate_below(found.poles, richer.poles, 1.0 / scene.motion.horizon)
        if below is None or held >= below:
            return replace(found, accurate_below=held)
        if count >= min(POLE_COORDINATES_LIMIT, every):
            raise ConvergenceError(
                f"--below {below:g}: with {count} coordinates of an arm the poles hold "
                f"{100.0 * POLE_ERROR:g} % below {held:.4g} Hz, and no more are tried; ask for a "
                "lower frequency"
            )
        count = min(ceil(POLE_COORDINATES_GROWTH * count), POLE_COORDINATES_LIMIT, every)


def _fewest_dofs(arms: Mapping[int, Arm]) -> int:
    """Return how many coordinates all of this rank's arms can have."""
    return min((arm.elastic.num_dofs for arm in arms.values()), default=maxsize)


def _largest(arms: Mapping[int, Arm]) -> int:
    """Return how many coordinates this rank's arms have at most."""
    return max([0, *(arm.coordinates or 0 for arm in arms.values())])


def _linearised(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
    t: float,
    profile: Profile,
) -> StateSpace:
    """Return the machine with the scene's coordinates (collective)."""
    with together(partition.world):
        bodies = {k: arm.under(scene).reduce(x_phys[k]) for k, arm in arms.items()}
    owned = gather_arms(partition, bodies)

    def find() -> StateSpace:
        return state_space(simulate(scene, chain_of(scene, owned), profile), t)

    found: StateSpace = on_root(partition.world, find)
    return found


def accurate_below(poles: np.ndarray, exact: np.ndarray, slowest: float) -> float:
    """Return the frequency below which poles and exact ones are pairs, Hz; inf: all of them.

    A pair differs by at most the part `POLE_ERROR_SHARE` of `POLE_ERROR`: the exact ones are taken
    with twice as many coordinates, whose own error may be as large as this difference.

    Args:
        poles, exact: (n,) and (m,), 1/s.
        slowest: what poles nearer to zero are measured by, 1/s: they do not change the motion.
    """
    apart = np.abs(poles[:, None] - exact)
    nearest = np.concatenate([apart.min(axis=1), apart.min(axis=0)])
    size = np.abs(np.concatenate([poles, exact]))
    poor = nearest > POLE_ERROR_SHARE * POLE_ERROR * np.maximum(size, slowest)
    return float(size[poor].min(initial=np.inf) * (1.0 - POLE_ERROR) / (2.0 * np.pi))
