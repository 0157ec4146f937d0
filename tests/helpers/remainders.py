"""Taylor remainders of functions of all arms' physical densities, for the tests of gradients."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.parallel import Partition, sum_over_arms
from dolfinopt.responses.evaluation import Evaluation, constraint_gradients
from dolfinopt.scene.load import Scene

Cells = Mapping[int, np.ndarray]
Named = dict[str, np.ndarray]


@dataclass(frozen=True)
class Built:
    """A scene with this rank's arms."""

    scene: Scene
    partition: Partition
    arms: dict[int, Arm]
    profile: do.Profile

    def evaluate(self, x_phys: Cells, simulated: bool = False):
        """Evaluate physical densities."""
        place = self.scene, self.partition, self.arms
        return do.evaluate(*place, x_phys, self.profile, simulated=simulated)

    def gradient(self, trajectory=None):
        """Return the objective's gradient at the design evaluated last."""
        return do.gradient(self.scene, self.partition, self.arms, trajectory, self.profile)

    def constraint_gradients(self, trajectory=None) -> list[dict[int, np.ndarray]]:
        """Return the gradients of `beside_volume` at the design evaluated last."""
        place = self.scene, self.partition, self.arms
        rows = constraint_gradients(*place, trajectory, self.profile)
        return [row.cells for row in rows if row.response.name != "volume_fraction"]

    def dot(self, a: Cells, b: Cells) -> float:
        """Return the product over all cells of all arms, on all ranks."""
        return float(sum_over_arms(self.partition, {k: np.array(a[k] @ b[k]) for k in self.arms}))

    def fields(self, function: Callable[[int, np.ndarray, np.ndarray], np.ndarray]) -> Cells:
        """Return function(arm, x, y) of the cells' centroids over the arm's length."""
        out = {}
        for k, arm in self.arms.items():
            x, y = arm.mesh.centroid.T / arm.mesh.outboard_point[0]
            out[k] = function(k, x, y)
        return out


def beside_volume(evaluation: Evaluation) -> tuple[float, ...]:
    """Return the values of [constraints], which follow the volume's."""
    return evaluation.constraints[len(evaluation.responses[1].values) :]


def build(*overrides: str, cells: tuple[int, int] = (24, 3)) -> Built:
    """Build the two-arm scene on few cells (collective)."""
    scene = do.load_scene(TWO_ARM, (f"arms.cells=[{cells[0]},{cells[1]}]", *overrides))
    profile = do.Profile()
    partition = do.partition_arms(MPI.COMM_WORLD, scene.cell_counts)
    return Built(scene, partition, do.build_arms(scene, partition, profile), profile)


def wave(k: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return densities within [0.1, 0.9] that vary along and across the arm."""
    return 0.5 + 0.3 * np.sin(7.0 * x + k) + 2.0 * y


def uneven(k: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a direction in [-1, 1] without any symmetry."""
    noise = np.sin(12.9898e3 * x + 78.233e3 * y + k) * 43758.5453
    return 2.0 * (noise - np.floor(noise)) - 1.0


def tip(k: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the direction that fills the outer fifth of the last of two arms."""
    return ((x > 0.8) & (k == 1)).astype(float)


def by_number(model: do.Model) -> tuple[Named, Named]:
    """Return a design in [0.2, 0.8] and a random direction in [-1, 1], by arm and cell number."""
    rng = np.random.default_rng(0)
    x = {
        name: 0.5 + 0.3 * np.sin(1.7 * np.arange(len(one)))
        for name, one in model.uniform(0.5).items()
    }
    return x, {name: rng.uniform(-1.0, 1.0, len(one)) for name, one in x.items()}


def product(a: Named, b: Named) -> float:
    """Return the product over all arms of one rank."""
    return float(sum(a[name] @ b[name] for name in a))


def objective_along(model: do.Model, x: Named, direction: Named) -> Callable[[float], float]:
    """Return h -> the objective at x + h direction."""
    return lambda h: model.simulate({name: x[name] + h * direction[name] for name in x}).objective


def rates(
    function: Callable[[float], float], slope: float, steps: Sequence[float] = (4e-3, 1e-3)
) -> float:
    """Return the order in h of |f(h) - f(0) - h slope|: 2 when the slope is right, 1 when not."""
    here = function(0.0)
    coarse, fine = (abs(function(h) - here - h * slope) for h in steps)
    return float(np.log(coarse / fine) / np.log(steps[0] / steps[1]))
