"""A machine linearised with as many coordinates as its poles need.

The error of a number of coordinates is that of the poles against those of the same machine with
twice as many Craig-Bampton coordinates. A number is looked for about one motion, with twice as many
coordinates as the scene has: others move as the nearest in energy. Then its own is simulated.
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
    count = partition.world.allreduce(own, max)
    reference = machines.simulated(RICHER_METHOD, machines.richer(count))
    if not scene.cell_counts:
        return replace(reference, accurate_below=np.inf)
    found = machines.judged(count)
    while below is not None and found.accurate_below < below:
        limit = min(POLE_COORDINATES_LIMIT, machines.reductions.limit)
        if count >= limit:
            raise ConvergenceError(
                f"--below {below:g}: with {count} coordinates of an arm the poles hold "
                f"{100.0 * POLE_ERROR:g} % below {found.accurate_below:.4g} Hz, and no more are "
                "tried; ask for a lower frequency"
            )
        count = machines.fewest(count + 1, limit, below)
        found = machines.judged(count)
    return found


class _Machines:
    """Owns the motion of a scene's machine, and gives it other coordinates at an instant.

    Attributes:
        scene, partition, t, profile: as for `linearised_machine`.
        reductions: of the arms.
    """

    def __init__(
        self,
        scene: Scene,
        partition: Partition,
        arms: Mapping[int, Arm],
        t: float,
        profile: Profile,
    ) -> None:
        """Take the scene and its arms (collective)."""
        self.scene, self.partition, self.t, self.profile = scene, partition, t, profile
        self.reductions = Reductions(scene, partition, arms, profile)
        self._count = 0  # coordinates of the richest motion, its bases, itself (on the root)
        self._bases: dict[int, Basis] = {}
        self._motion: list[Trajectory] = []
        self._known: dict[tuple[str, int], StateSpace] = {}  # about it

    def richer(self, count: int) -> int:
        """Return the number of coordinates with which so many are compared."""
        return min(RICHER_RATIO * count, self.reductions.limit)

    def simulated(self, method: str, count: int) -> StateSpace:
        """Return the machine about its own motion with so many coordinates (collective)."""
        bases = self.reductions.reduced(method, count)
        owned = self.reductions.bodies(bases)
        if count > self._count:
            self._count, self._bases = count, bases
            self._motion.clear()
            self._known.clear()

        def run() -> StateSpace:
            trajectory = simulate(self.scene, chain_of(self.scene, owned), self.profile)
            if not self._motion:
                self._motion.append(trajectory.at(np.array([self.t])))
            return state_space(trajectory, self.t)

        found: StateSpace = on_root(self.partition.world, run)
        return found

    def judged(self, count: int) -> StateSpace:
        """Return that, and the frequency below which its poles hold (collective)."""
        found = self.simulated(self.scene.reduction.method, count)
        return replace(found, accurate_below=self._held(found, count))

    def fewest(self, low: int, high: int, below: float) -> int:
        """Return the fewest coordinates that seem to hold poles below a frequency (collective).

        Of numbers from `low`, which is doubled at first, to `high`; all about the richest motion.
        """

        def holds(count: int) -> bool:
            found = self._linearised(self.scene.reduction.method, count)
            return self._held(found, count) >= below

        last = low
        while last < high and not holds(last):
            low, last = last + 1, min(2 * last, high)
        while low < last:
            middle = (low + last) // 2
            low, last = (low, middle) if holds(middle) else (middle + 1, last)
        return last

    def _held(self, found: StateSpace, count: int) -> float:
        """Return the frequency below which poles are those of a richer machine, Hz (collective)."""
        exact = self._linearised(RICHER_METHOD, self.richer(count)).poles
        return accurate_below(found.poles, exact, 1.0 / self.scene.motion.horizon)

    def _linearised(self, method: str, count: int) -> StateSpace:
        """Return the machine with so many coordinates about the richest motion (collective)."""
        if (method, count) not in self._known:
            bases = self.reductions.reduced(method, count)
            bodies = self.reductions.bodies(bases)
            energies = gather_arms(self.partition, self.reductions.energies(bases, self._bases))
            found = on_root(self.partition.world, self._changed, bodies, energies)
            self._known[method, count] = found
        return self._known[method, count]

    def _changed(
        self, owned: Mapping[int, ShapeIntegrals], energies: Mapping[int, np.ndarray]
    ) -> StateSpace:
        """Return the machine of other bodies, bent as in the motion: nearest in energy (root)."""
        [seen] = self._motion
        known, system = seen.problem, build_system(self.scene, chain_of(self.scene, owned))
        old, owners = np.stack(seen.unknowns), self.scene.owners
        new = np.zeros((3, 1, system.num_coordinates))
        new[:, :, : system.ends[0]] = old[:, :, : known.ends[0]]
        new[:, :, system.ends[1] :] = old[:, :, known.ends[1] :]
        parts = zip(known.body_columns, system.body_columns, strict=True)
        for place, (before, after) in enumerate(parts):
            owner = owners[place] if place < len(owners) else None  # of bearings, rigid arms
            own = old[:, :, before]
            if owner is not None:
                count = owned[owner].num_modes
                few, both = np.split(energies[owner][:count], [count], axis=1)
                own = own @ np.linalg.solve(few, both).T
            new[:, :, after] = own
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
