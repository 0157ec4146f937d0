"""How many coordinates an arm needs: the fewest whose estimated error meets a tolerance.

The error of a number of coordinates is that of the motion simulated with it against the motion
with a richer basis, at least twice as many Craig-Bampton coordinates: vibrations near resonance
count as they are, and so does what a basis without constraint modes misses of the statics.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from sys import maxsize

import numpy as np

from dolfinopt.arms.arm import Arm
from dolfinopt.arms.design_state import options
from dolfinopt.dynamics.build import Trajectory
from dolfinopt.dynamics.measured import RESTING_GROUP_SHARE
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, shape_integrals
from dolfinopt.parallel import Partition, gather_arms, on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.reduction import METHODS, Basis
from dolfinopt.responses.evaluation import decide_stiffening, simulated_together
from dolfinopt.responses.measured import COORDINATES_LIMIT, RICHER_COORDINATES, TIME_ERROR_SHARE
from dolfinopt.responses.response import factors
from dolfinopt.scene.load import Scene, pose_scenarios

RICHER_METHOD = "craig-bampton"  # of what motions and poles are compared with


@dataclass(frozen=True)
class OrderSelection:
    """What was chosen by the error of the reduction.

    Attributes:
        coordinates: of every arm.
        error: estimated relative error that they make: of the displacements, energy norm, largest
            in time over the largest value, of the worst arm and scenario.
        tried: numbers of coordinates and their errors, ascending; inf where one is not possible.
    """

    coordinates: int
    error: float
    tried: tuple[tuple[int, float], ...]


def choose_coordinates(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
    profile: Profile,
    *,
    reserve: float = 1.0,
) -> OrderSelection | None:
    """Let the arms reduce to the fewest coordinates that meet the scene's error (collective).

    Numbers are tried upwards in growing steps, then bisected: the one below the chosen one does
    not meet the tolerance. Where the scene states a number nothing is done.

    Args:
        scene, partition, arms, profile: as for `evaluate`.
        x_phys: the design that decides.
        reserve: how many times less than the tolerance the estimate must be.

    Returns:
        The choice; None where the scene states a number, or no arm is flexible.

    Raises:
        ConvergenceError: no number up to `COORDINATES_LIMIT` meets the tolerance; on all
            ranks alike.
    """
    if scene.reduction.count or not scene.cell_counts:
        return None
    comparison = Comparison(Reductions(scene, partition, arms, x_phys, profile))
    least = max(scene.reduction.fewest_of(arm) for arm in scene.arms)
    goal = scene.reduction.tolerance / reserve
    most = min(max(COORDINATES_LIMIT, least), comparison.reductions.limit)
    tried: dict[int, float] = {}

    def holds(count: int) -> bool:
        tried[count] = comparison.error(count)
        return tried[count] <= goal  # not a number does not

    result = fewest(least, most, holds)
    if result is None:
        raise _none_found(scene, tried, goal)
    for arm in arms.values():
        arm.set_order(result)
    return OrderSelection(result, tried[result], tuple(sorted(tried.items())))


def _none_found(scene: Scene, tried: Mapping[int, float], goal: float) -> ConvergenceError:
    method = scene.reduction.method
    other = "" if method == RICHER_METHOD else f', reduction.method = "{RICHER_METHOD}"'
    above = f"above {goal:.2g}"
    if goal < scene.reduction.tolerance:
        above += f", asked of an initial design for {scene.reduction.tolerance:g}"
    return ConvergenceError(
        f"{scene.source}: reduction.coordinates: with up to {max(tried)} coordinates the "
        f"estimated error is {min(tried.values()):.2g} at best, {above}; give a larger "
        f"error{other}, or an integer"
    )


class Comparison:
    """Owns the richer motion of a design that others are compared with.

    The arms keep what they have.
    """

    def __init__(self, reductions: Reductions):
        """Take the arms with their design."""
        self.reductions, scene = reductions, reductions.scene
        self.scenes = [_timed(item) for item in (scene, *pose_scenarios(scene))]
        self.richer = 0  # coordinates
        self.bases: dict[int, Basis] = {}
        self.motion: Trajectory | None = None

    def error(self, count: int) -> float:
        """Return the error that `count` coordinates make, see `OrderSelection` (collective).

        Infinite where so few are not possible.

        Raises:
            ConvergenceError: the motion cannot be simulated with the richer basis; on all ranks.
        """
        richer = min(max(RICHER_COORDINATES, 2 * count), self.reductions.limit)
        if richer > self.richer:
            self.bases = self.reductions.reduced(RICHER_METHOD, richer)
            self.motion, self.richer = self._moved(self.bases), richer
        try:
            bases = self.reductions.reduced(self.scenes[0].reduction.method, count)
            motion = self._moved(bases)
        except ConvergenceError:
            return np.inf  # further ones may do
        partition = self.reductions.partition
        energy = gather_arms(partition, self.reductions.energies(bases, self.bases))

        def largest() -> float:
            assert motion is not None and self.motion is not None
            few, many = [motion, *motion.scenarios], [self.motion, *self.motion.scenarios]
            return max(_distance(self.scenes[0], *item, energy) for item in zip(few, many))

        return on_root(partition.world, largest)

    def _moved(self, bases: Mapping[int, Basis]) -> Trajectory | None:
        """Return the root's motion of the scene with its scenarios (collective)."""
        given, owned = self.reductions, self.reductions.bodies(bases)
        return simulated_together(self.scenes, given.partition, owned, given.profile)


def _timed(scene: Scene) -> Scene:
    """Return the scene simulated so well that time steps do not matter to the comparison."""
    tolerance = min(scene.simulation.tolerance, TIME_ERROR_SHARE * scene.reduction.tolerance)
    simulation = scene.simulation.unchecked_copy({"tolerance": tolerance})
    return scene.unchecked_copy({"simulation": simulation})


def _distance(
    scene: Scene, few: Trajectory, many: Trajectory, energy: Mapping[int, np.ndarray]
) -> float:
    """Return max_t |u_few - u_many| / max_t |u_many| of the worst arm, |u|^2 = u' K u.

    By the energies V' K V of both bases, one behind the other.
    """
    errors, sizes = [], []
    t = max(few.t, many.t, key=len)  # the faster of the two motions may be looked at more closely
    few, many = few.at(t), many.at(t)
    parts = zip(few.mechanism.slices, many.mechanism.slices, strict=True)
    for place, (a, b) in enumerate(parts):
        q, richer = few.q_e[:, a], many.q_e[:, b]
        owner = scene.owners[place] if place < len(scene.owners) else None
        if owner is None:  # rigid, from a file, or a bearing: the same body in both
            K = np.tile(many.mechanism.bodies[place].K, (2, 2))
        else:  # a scenario's material scales both
            K = factors(scene, many.scene, owner).stiffness * energy[owner]
        errors.append(_norm(K, np.hstack([q, -richer])))
        sizes.append(_norm(K, np.hstack([np.zeros_like(q), richer])))
    size = np.maximum(sizes, RESTING_GROUP_SHARE * max(sizes))
    if not size.any():
        return 0.0
    return float((np.array(errors) / size).max())


def _norm(K: np.ndarray, q: np.ndarray) -> float:
    """Return the largest sqrt(q' K q) over the instants; q is (n, k)."""
    return float(np.sqrt(np.einsum("nk,nk->n", q @ K, q).max(initial=0.0)))


# -- bases of any number of coordinates


class Reductions:
    """Bases of the arms' present designs.

    Attributes:
        limit: of coordinates that all arms can have.
    """

    def __init__(
        self,
        scene: Scene,
        partition: Partition,
        arms: Mapping[int, Arm],
        x_phys: Mapping[int, np.ndarray],
        profile: Profile,
    ) -> None:
        """Take what `evaluate` does (collective)."""
        self.scene, self.partition, self.arms, self.profile = scene, partition, arms, profile
        with together(partition.world):
            for k, arm in arms.items():
                arm.state(x_phys[k])
        decide_stiffening(scene, partition, arms)
        own = min((arm.elastic.num_dofs for arm in arms.values()), default=maxsize)
        self.limit: int = partition.world.allreduce(own, min)

    def reduced(self, method: str, count: int) -> dict[int, Basis]:
        """Return this rank's bases of so many coordinates (collective)."""
        reduce = METHODS[method].reduce
        with self.profile.phase("choice of coordinates"), together(self.partition.world):
            return {
                k: reduce(arm.elastic, options(arm.scene, count), None)
                for k, arm in self.arms.items()
            }

    def bodies(self, bases: Mapping[int, Basis]) -> dict[int, ShapeIntegrals]:
        """Return the bodies of all arms with these bases, on the root (collective)."""
        result, damping = {}, self.scene.damping.stiffness_proportional
        with together(self.partition.world):
            for k, basis in bases.items():
                arm, loads = self.arms[k], None
                if arm.stiffened:
                    loads = arm.current.unit_loads.with_modes(basis.V, basis.MV)
                result[k] = shape_integrals(arm.elastic, basis, damping, loads)
        return gather_arms(self.partition, result)

    def energies(
        self, bases: Mapping[int, Basis], others: Mapping[int, Basis]
    ) -> dict[int, np.ndarray]:
        """Return V' K V of the modes V of two bases, one behind the other (collective)."""
        with together(self.partition.world):
            return {
                k: self.arms[k].elastic.energy_matrix(np.concatenate([a.V, others[k].V], axis=2))
                for k, a in bases.items()
            }


def fewest(first: int, most: int, holds: Callable[[int], bool]) -> int | None:
    """Return the fewest coordinates from `first` to `most` that hold, None if none do.

    In growing steps upwards, then by bisection.
    """
    low, high = first - 1, first
    while not holds(high):
        if high >= most:
            return None
        low, high = high, min(high + max(1, high - first), most)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
