"""Arms of small scenes whose nodes are moved: the whole program as reference for derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from mpi4py import MPI
from remainders import Built, built_of
from solids import tetrahedra

from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh, arm_mesh
from dolfinopt.mesh.checks import cell_sizes
from dolfinopt.optimization.gradient_check import _at, held_steps
from dolfinopt.parallel import on_root, sum_over_arms
from dolfinopt.responses.evaluation import analysis_of, evaluate
from dolfinopt.responses.motion import MotionResponse
from dolfinopt.responses.products import by_nodes
from dolfinopt.responses.response import Response, objective_of
from dolfinopt.scene.load import Arm, Scene

# From an arm's name and the places of its nodes (n, d), m, to their moves (n, d), m.
Moves = Callable[[str, np.ndarray], np.ndarray]


def with_moves(mesh: ArmMesh, moves: np.ndarray) -> ArmMesh:
    """Move the nodes of a mesh by (n, d), m."""
    mesh.mesh.geometry.x[:, : mesh.dim] += moves
    corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, : mesh.dim]
    area = cell_sizes(corners)
    return replace(mesh, centroid=corners.mean(axis=1), area=area)


def built_with(
    scene: Scene,
    moves: Moves,
    cut: bool = False,
    regular: dict[str, np.ndarray] | None = None,
) -> Built:
    """Build a scene's arms, nodes moved by place, boxes `cut` into tetrahedra (collective).

    `regular` gets the places (n, d) of every arm's nodes before.
    """

    def meshed(comm: MPI.Comm, arm: Arm, pattern: Arm | None = None) -> ArmMesh:
        if cut:
            size = arm.length, arm.height, arm.thickness
            mesh = tetrahedra(comm, arm.name, size, arm.cells)
        else:
            mesh = arm_mesh(comm, arm, pattern)
        places = mesh.mesh.geometry.x[:, : mesh.dim].copy()
        if regular is not None:
            regular[arm.name] = places
        return with_moves(mesh, moves(arm.name, places))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dolfinopt.arms.arm.arm_mesh", meshed)
        return built_of(scene)


@dataclass(frozen=True)
class NodeTest:
    """Taylor's test by the places of nodes: slope, remainders |J(h) - J(0) - h slope|, rate."""

    slope: float
    remainders: tuple[float, ...]
    rate: float


def noise(arm: str, points: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return moves in [-1, 1] without any symmetry, functions of the place."""
    scaled = 1e3 * points @ np.array([12.9898, 78.233, 37.719])[: points.shape[1]]
    seeds = seed + len(arm) + ord(arm[-1]) + np.arange(points.shape[1])
    return 2.0 * np.modf(np.abs(np.sin(scaled[:, None] + seeds) * 43758.5453))[0] - 1.0


def node_test(
    scene: Scene,
    design: Callable[[int, np.ndarray, np.ndarray], np.ndarray],
    size: float,
    steps: tuple[float, ...] = (4e-3, 1e-3),
    cut: bool = False,
    moves: Moves = noise,
    response: Response | None = None,
) -> NodeTest:
    """Test a response's gradient by nodes, by default the objective's; instants, steps are held.

    The largest move at a step of 1 is `size`, m, along `moves`, by default `noise` of all nodes;
    the last two steps tell the rate; boxes may be `cut` into tetrahedra.
    """
    response = response or objective_of(scene)

    def places(h: float) -> Moves:
        return lambda arm, x: size * (0.2 * noise(arm, x, 7) + h * moves(arm, x))

    regular: dict[str, np.ndarray] = {}
    built = built_with(scene, places(0.0), cut, regular)
    x = built.fields(design)
    start = held_steps(built.evaluate(x)[1])
    _, base = evaluate(*built.place, x, built.profile, start, simulated=False)
    rows = response.gradients(
        analysis_of(scene, built.partition, built.arms, base, built.profile, by_nodes)
    )
    found = {k: np.sum([row[k] for row in rows if k in row], axis=0) for k in built.arms}
    parts = {}
    for k, arm in built.arms.items():
        mesh = arm.mesh
        owned = mesh.mesh.geometry.index_map().size_local
        direction = moves(mesh.name, regular[mesh.name])
        parts[k] = np.array(size * np.sum(found[k][:owned] * direction[:owned]))
    slope = float(sum_over_arms(built.partition, parts))

    def value(h: float) -> float:
        step = built_with(scene, places(h), cut)
        place = scene, step.partition, step.arms
        _, trajectory = evaluate(*place, x, step.profile, start, simulated=False)
        if not isinstance(response, MotionResponse):
            return response.measure(analysis_of(*place, trajectory, step.profile)).total
        parts = response.parts(scene)
        world = built.partition.world
        return on_root(world, lambda: sum(_at(base, trajectory, part) for _, part in parts))

    here = value(0.0)
    remainders = tuple(abs(value(h) - here - h * slope) for h in steps)
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = np.log(remainders[-2] / remainders[-1]) / np.log(steps[-2] / steps[-1])
    return NodeTest(slope, remainders, float(rate))
