"""A machine linearised with as many coordinates as its poles need.

The error of a number of coordinates is that of the poles against those of the same machine with
twice as many Craig-Bampton coordinates, each about its own motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np

from dolfinopt.arms.arm import Arm, chain_of
from dolfinopt.dynamics.build import check_instant, simulate, state_space
from dolfinopt.dynamics.state_space import StateSpace
from dolfinopt.errors import ConvergenceError
from dolfinopt.parallel import Partition, on_root
from dolfinopt.profiling import Profile
from dolfinopt.responses.measured import COORDINATES_LIMIT, POLE_ERROR
from dolfinopt.responses.order_selection import RICHER_METHOD, Reductions, fewest
from dolfinopt.scene.load import Scene


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
        below: frequency below which all poles are to hold `POLE_ERROR`, Hz; the arms take the
            fewest coordinates, no less than the scene's, with which they do. None: the scene's.

    Raises:
        InputError: the instant is not within the motion, or a coordinate has no mass.
        ConvergenceError: no number of coordinates holds the poles; or of the simulation.
    """
    check_instant(scene, t)
    reductions = Reductions(scene, partition, arms, x_phys, profile)

    @cache
    def machine(method: str, count: int) -> StateSpace:
        owned = reductions.bodies(reductions.reduced(method, count))
        return on_root(
            partition.world,
            lambda: state_space(simulate(scene, chain_of(scene, owned), profile), t),
        )

    @cache
    def judged(count: int) -> StateSpace:
        result = machine(scene.reduction.method, count)
        exact = machine(RICHER_METHOD, min(2 * count, reductions.limit))
        held = accurate_below(result.poles, exact.poles, 1.0 / scene.motion.horizon)
        return replace(result, accurate_below=held)

    own = max((arm.coordinates or 0 for arm in arms.values()), default=0)
    count: int = partition.world.allreduce(own, max)
    if not scene.cell_counts:
        return replace(machine(RICHER_METHOD, 0), accurate_below=np.inf)
    if below is None or judged(count).accurate_below >= below:
        return judged(count)
    limit = max(count, min(COORDINATES_LIMIT, reductions.limit))
    enough = fewest(count, limit, lambda n: judged(n).accurate_below >= below)
    if enough is None:
        raise ConvergenceError(
            f"--below {below:g}: with {limit} coordinates of an arm the poles hold "
            f"{100.0 * POLE_ERROR:g} % below {judged(limit).accurate_below:.4g} Hz, and no more "
            "are tried; ask for a lower frequency"
        )
    return judged(enough)


def accurate_below(poles: np.ndarray, exact: np.ndarray, slowest: float) -> float:
    """Return the frequency below which poles and exact ones are pairs, Hz; inf: all of them.

    A pair differs by at most half of `POLE_ERROR`: the exact ones are taken with twice as many
    coordinates, whose own error may be as large as this difference.

    Args:
        poles, exact: (n,) and (m,), 1/s.
        slowest: what poles nearer to zero are measured by, 1/s: they do not change the motion.
    """
    apart = np.abs(poles[:, None] - exact)
    nearest = np.concatenate([apart.min(axis=1), apart.min(axis=0)])
    size = np.abs(np.concatenate([poles, exact]))
    poor = nearest > 0.5 * POLE_ERROR * np.maximum(size, slowest)
    return float(size[poor].min(initial=np.inf) * (1.0 - POLE_ERROR) / (2.0 * np.pi))
