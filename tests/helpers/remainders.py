"""Arms of small scenes, dense and built, and Taylor remainders of functions of their densities."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM
from solids import tensors_of

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.fem.elasticity import Substructure
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.optimization import gradient_check
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.gradient_check import TaylorTest, taylor_test
from dolfinopt.parallel import Partition, sum_over_arms
from dolfinopt.responses.evaluation import Evaluation, analysis_of, constraint_gradients
from dolfinopt.scene.load import Scene, read_scene

Cells = Mapping[int, np.ndarray]
Field = Callable[[int, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Built:
    """A scene with this rank's arms."""

    scene: Scene
    partition: Partition
    arms: dict[int, Arm]
    profile: do.Profile

    @property
    def place(self) -> tuple[Scene, Partition, dict[int, Arm]]:
        """What most functions of arms take first."""
        return self.scene, self.partition, self.arms

    def evaluate(self, x_phys: Cells, simulated: bool = False):
        """Evaluate physical densities."""
        return do.evaluate(*self.place, x_phys, self.profile, simulated=simulated)

    def gradient(self, trajectory=None):
        """Return the objective's gradient at the design evaluated last."""
        return do.gradient(*self.place, trajectory, self.profile)

    def constraint_gradients(self, trajectory=None) -> list[dict[int, np.ndarray]]:
        """Return the gradients of `beside_volume` at the design evaluated last."""
        rows = constraint_gradients(analysis_of(*self.place, trajectory, self.profile))
        design, count = self.scene.design, len(self.scene.designed)
        volumes = 1 if design.shared_volume else count
        return rows if design.volume_fraction is None else rows[volumes:]

    def dot(self, a: Cells, b: Cells) -> float:
        """Return the product over all cells of all arms, on all ranks."""
        return float(sum_over_arms(self.partition, {k: np.array(a[k] @ b[k]) for k in self.arms}))

    def uniform(self, density: float = 0.5) -> Cells:
        """Return every arm's own uniform design."""
        return {k: arm.uniform(density) for k, arm in self.arms.items()}

    def fields(self, function: Field) -> Cells:
        """Return function(arm, x, y) of the cells' centroids over the arm's length."""
        out = {}
        for k, arm in self.arms.items():
            x, y = arm.mesh.centroid.T[:2] / arm.mesh.outboard_point[0]
            out[k] = function(k, x, y)
        return out


def beside_volume(evaluation: Evaluation) -> tuple[float, ...]:
    """Return the values of [constraints], which follow the volume's."""
    return evaluation.constraints[len(evaluation.responses[1].values) :]


def build(*overrides: str, cells: tuple[int, int] = (24, 3)) -> Built:
    """Build the two-arm scene on few cells (collective)."""
    return built_of(do.load_scene(TWO_ARM, (f"arms.cells=[{cells[0]},{cells[1]}]", *overrides)))


def built_of(scene: Scene, world: MPI.Comm = MPI.COMM_WORLD) -> Built:
    """Build a scene's arms (collective)."""
    profile = do.Profile()
    partition = do.partition_arms(world, scene.cell_counts)
    return Built(scene, partition, do.build_arms(scene, partition, profile), profile)


def arm_of(
    cells: tuple[int, int], *overrides: str, comm: MPI.Comm = MPI.COMM_SELF, index: int = 0
) -> Arm:
    """Return one arm of the two-arm scene, solid, on its own ranks."""
    # Its motion may be out of reach.
    scene = read_scene(TWO_ARM, (f"arms.cells=[{cells[0]},{cells[1]}]", *overrides))
    arm = Arm(scene, index, comm, do.Profile())
    arm.state(np.ones(arm.mesh.num_cells))
    return arm


def substructure(
    size: tuple[float, float, float],
    cells: tuple[int, int],
    comm: MPI.Comm = MPI.COMM_SELF,
    element: str = "linear",
    poisson_ratio: float = 0.33,
    skew: bool = False,
) -> Substructure:
    """Return a rectangle of length, height and thickness, m; of cells that are none if `skew`."""
    mesh = box_arm(comm, "arm", size[:2], cells)
    if skew:
        mesh.mesh.geometry.x[:, :2] += bulge(mesh.mesh.geometry.x[:, :2], size[0], size[1])
    return Substructure(tensors_of(mesh, element, size[2], poisson_ratio))


def bulge(points: np.ndarray, length: float, height: float) -> np.ndarray:
    """Return displacements (n, 2) of interior points: the rectangle stays, its cells turn skew."""
    x, y = points.T
    inside = np.sin(np.pi * x / length) * np.cos(np.pi * y / height)
    return np.stack([0.04 * inside * np.cos(7.0 * x), 0.02 * inside * np.sin(9.0 * x + y)], axis=1)


def dense_matrices(elastic, young, density) -> tuple[np.ndarray, np.ndarray]:
    """Return T'KT and T'MT (n, n) of a plane arm, T the outboard edge's three coordinates last."""
    operators = elastic.operators
    points, size = operators.points, len(operators.points)
    K, M = np.zeros((2, 2 * size, 2 * size))
    stiffness, mass = (
        np.broadcast_to(one, (len(operators.cells), *one.shape[1:]))
        for one in (operators.stiffness, operators.mass)
    )
    for e, cell in enumerate(operators.cells):
        dofs = (2 * cell[:, None] + [0, 1]).ravel()
        K[np.ix_(dofs, dofs)] += young[e] * stiffness[e]
        for c in (0, 1):
            M[np.ix_(dofs[c::2], dofs[c::2])] += density[e] * mass[e]
    length = elastic.mesh.outboard_point[0]
    clamped, end = np.isclose(points[:, 0], 0.0), np.isclose(points[:, 0], length)
    inner = np.flatnonzero(~(clamped | end))
    T = np.zeros((2 * size, 2 * len(inner) + 3))
    T[(2 * inner[:, None] + [0, 1]).ravel(), np.arange(2 * len(inner))] = 1.0
    for node in np.flatnonzero(end):
        T[2 * node, -3], T[2 * node, -1] = 1.0, -points[node, 1]
        T[2 * node + 1, -2] = 1.0
    return T.T @ K @ T, T.T @ M @ T


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


def taylor(
    scene: Scene,
    design: Field,
    steps: Sequence[float],
    directions: Sequence[str] = (),
    world: MPI.Comm = MPI.COMM_WORLD,
) -> TaylorTest:
    """Return the Taylor test of a design, with these steps, along some or all directions."""
    built = built_of(scene, world)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gradient_check, "STEPS", tuple(steps))
        if directions:
            every = gradient_check._directions
            patch.setattr(
                gradient_check,
                "_directions",
                lambda *told: {name: every(*told)[name] for name in directions},
            )
        x = built.fields(design)
        return taylor_test(Evaluator(*built.place, built.profile), x)


def rates(
    function: Callable[[float], float], slope: float, steps: Sequence[float] = (4e-3, 1e-3)
) -> float:
    """Return the order in h of |f(h) - f(0) - h slope|: 2 when the slope is right, 1 when not."""
    here = function(0.0)
    coarse, fine = (abs(function(h) - here - h * slope) for h in steps)
    return float(np.log(coarse / fine) / np.log(steps[0] / steps[1]))


def limit_rates(built: Built, steps: Sequence[float]) -> list[float]:
    """Return the orders of the remainders of all limits but the volume's (collective).

    Limits hold for true values; what is differentiated are smooth ones, scaled to them.
    """
    x, d = built.fields(wave), built.fields(uneven)

    def smooth(h: float) -> np.ndarray:
        evaluation, _ = built.evaluate({k: x[k] + h * d[k] for k in x})
        return np.concatenate([one.smooth for one in evaluation.responses[2:]])

    evaluation, trajectory = built.evaluate(x)
    rows = built.constraint_gradients(trajectory)
    scale = (1.0 + np.array(beside_volume(evaluation))) / smooth(0.0)
    built.evaluate(x)
    slopes = [built.dot(row, d) for row in rows]
    assert len(slopes) == len(scale)
    return [
        rates(lambda h, k=k: (scale * smooth(h))[k], one, steps) for k, one in enumerate(slopes)
    ]


def hold_instants(patch: pytest.MonkeyPatch) -> None:
    """Let buckling look at the same instants: where a peak goes on to the next its slope steps."""

    def held(values: np.ndarray) -> list[int]:
        return [len(values) // 5, len(values) // 2, 4 * len(values) // 5]

    patch.setattr("dolfinopt.responses.buckling.worst_instants", held)
