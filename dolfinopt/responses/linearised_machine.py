"""A machine linearised with as many coordinates as its poles need.

The error of a number of coordinates is that of the poles against those of the same machine with
twice as many Craig-Bampton coordinates. For it the motion is simulated once, with the scene's
coordinates: others move as the nearest in energy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.arms.arm import chain_of
from dolfinopt.dynamics.build import build_system
from dolfinopt.dynamics.simulation import simulate
from dolfinopt.dynamics.state_space import StateSpace, check_instant, linear_model, state_space
from dolfinopt.dynamics.trajectory import Trajectory
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.parallel import Partition, gather_arms, on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.reduction import Basis
from dolfinopt.responses.evaluation import decide_stiffening
from dolfinopt.responses.measured import (
    POLE_COORDINATES_LIMIT,
    POLE_ERROR,
    POLE_ERROR_SHARE,
    RICHER_RATIO,
)
from dolfinopt.responses.reductions import RICHER_METHOD, Reductions
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
        below: frequency below which all poles are to hold `POLE_ERROR`, Hz; the arms take the
            fewest coordinates, no less than the scene's, with which they do. None: the scene's.

    Raises:
        InputError: the instant is not within the motion, or a coordinate has no mass.
        ConvergenceError: no number of coordinates holds the poles; or of the simulation.
    """
    check_instant(scene, t)
    with together(partition.world):
        for k, arm in arms.items():
            arm.set_design(x_phys[k])
    decide_stiffening([scene, *pose_scenarios(scene)], partition, arms)
    machines = _Machines(scene, partition, arms, t, profile)
    own = max((arm.coordinates or 0 for arm in arms.values()), default=0)
    least = partition.world.allreduce(own, max)
    if not scene.cell_counts:
        return replace(machines.linearised(RICHER_METHOD, least), accurate_below=np.inf)
    found = machines.judged(least)
    if below is None or found.accurate_below >= below:
        return found
    limit = min(POLE_COORDINATES_LIMIT, machines.reductions.limit)
    low = high = least
    while found.accurate_below < below:
        if high >= limit:
            raise ConvergenceError(
                f"--below {below:g}: with {high} coordinates of an arm the poles hold "
                f"{100.0 * POLE_ERROR:g} % below {found.accurate_below:.4g} Hz, and no more are "
                "tried; ask for a lower frequency"
            )
        low, high = high, min(2 * high, limit)
        found = machines.judged(high)
    while high - low > 1:
        middle = (low + high) // 2
        tried = machines.judged(middle)
        if tried.accurate_below >= below:
            high, found = middle, tried
        else:
            low = middle
    exact = machines.simulated(high)
    return replace(exact, accurate_below=found.accurate_below)


class _Machines:
    """Owns the motion of a scene's machine, and gives it other coordinates at an instant."""

    def __init__(
        self,
        scene: Scene,
        partition: Partition,
        arms: Mapping[int, Arm],
        t: float,
        profile: Profile,
    ) -> None:
        """Simulate it with the scene's coordinates (collective)."""
        self.scene, self.partition, self.t, self.profile = scene, partition, t, profile
        self.reductions = Reductions(scene, partition, arms, profile)
        with together(partition.world):
            self.bases = {k: arm.current.basis for k, arm in arms.items()}
            bodies = {k: arm.current.body for k, arm in arms.items()}
        self.motion: list[Trajectory] = []  # on the root
        on_root(partition.world, self._move, gather_arms(partition, bodies))
        self.known: dict[tuple[str, int], StateSpace] = {}

    def _move(self, owned: Mapping[int, ShapeIntegrals]) -> StateSpace:
        """Simulate the machine of these bodies, and linearise it (root only)."""
        trajectory = simulate(self.scene, chain_of(self.scene, owned), self.profile)
        self.motion.append(trajectory.at(np.array([self.t])))
        return state_space(trajectory, self.t)

    def simulated(self, count: int) -> StateSpace:
        """Return the machine about its motion with so many coordinates (collective)."""
        bases = self.reductions.reduced(self.scene.reduction.method, count)
        bodies = gather_arms(self.partition, self.reductions.bodies(bases))
        found: StateSpace = on_root(self.partition.world, self._move, bodies)
        return found

    def judged(self, count: int) -> StateSpace:
        """Return the machine with so many coordinates, and how far they hold (collective)."""
        richer = min(RICHER_RATIO * count, self.reductions.limit)
        exact = self.linearised(RICHER_METHOD, richer).poles
        found = self.linearised(self.scene.reduction.method, count)
        held = accurate_below(found.poles, exact, 1.0 / self.scene.motion.horizon)
        return replace(found, accurate_below=held)

    def linearised(self, method: str, count: int) -> StateSpace:
        """Return the machine with so many coordinates (collective)."""
        if (method, count) not in self.known:
            bases = self.reductions.reduced(method, count)
            bodies = gather_arms(self.partition, self.reductions.bodies(bases))
            with together(self.partition.world):
                mine = {k: self._change(k, basis) for k, basis in bases.items()}
            changes = gather_arms(self.partition, mine)
            found = on_root(self.partition.world, self._changed, bodies, changes)
            self.known[method, count] = found
        return self.known[method, count]

    def _change(self, k: int, new: Basis) -> np.ndarray:
        """Return C (q', q), which makes of an arm's coordinates the nearest in another basis.

        Nearest in energy; collective on the arm.
        """
        elastic, count = self.reductions.arms[k].elastic, new.V.shape[2]
        energy = elastic.energy_matrix(np.concatenate([new.V, self.bases[k].V], axis=2))
        return np.linalg.solve(energy[:count, :count], energy[:count, count:])

    def _changed(
        self, owned: Mapping[int, ShapeIntegrals], changes: Mapping[int, np.ndarray]
    ) -> StateSpace:
        """Return the machine of other bodies, bent as in the motion (root only)."""
        seen = self.motion[0]
        known, system = seen.problem, build_system(self.scene, chain_of(self.scene, owned))
        old, owners = np.stack(seen.unknowns), self.scene.owners
        new = np.zeros((3, 1, system.num_coordinates))
        new[:, :, : system.ends[0]] = old[:, :, : known.ends[0]]
        new[:, :, system.ends[1] :] = old[:, :, known.ends[1] :]
        parts = zip(known.body_columns, system.body_columns, strict=True)
        for place, (before, after) in enumerate(parts):
            owner = owners[place] if place < len(owners) else None  # of bearings, rigid arms
            own = old[:, :, before]
            new[:, :, after] = own if owner is None else own @ changes[owner].T
        return linear_model(self.scene, system, self.t, (new[0], new[1], new[2]))


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
