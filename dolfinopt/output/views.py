"""Whole arms on the root: what pictures, ParaView and design files need of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.arms.arm import fixed_body
from dolfinopt.mesh import compat
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.parallel import Partition, gather_cells, together
from dolfinopt.scene.load import Arm as SceneArm
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.responses.stress_report import ArmStress


CIRCLE = 48  # corners that stand for a circle in pictures


# DOLFINx numbers corners of quadrilaterals and hexahedra as a tensor product; here they go around.
AROUND: dict[tuple[int, ...], list[int]] = {
    (3, 2): [0, 1, 2],
    (4, 2): [0, 1, 3, 2],
    (4, 3): [0, 1, 2, 3],
    (8, 3): [0, 1, 3, 2, 4, 5, 7, 6],
}


@dataclass(frozen=True, eq=False)
class ArmView:
    """One whole arm on the root, cells in the order of their centroids.

    Attributes:
        name: the arm's.
        corners: (n_cells, 3 or 4, 2) m, around each cell; of solids (n_cells, 4 or 8, 3), as VTK
            orders them.
        centroid: (n_cells, d) m.
        density: (n_cells,) physical densities.
        modes: (n_cells, corners, d, q) the reduced basis at the corners; q = 0 if not reduced.
        designed: False for arms without a design: rigid ones and those from a file.
        length: from joint axis to joint axis, m; None if not known.
        regions: what the scene keeps solid or void: kind and outline (n, 2), m, of every region.
        stress: (n_cells,) largest von Mises stress along the motion, Pa; None if not known.
        stress_instant: (n_cells,) when it is reached, s; likewise.
        filtered: (n_cells,) densities before the projection, smooth from cell to cell; likewise.
        wall: (n_cells,) thickness of a hollow arm's wall, m, which the density stands for; None of
            others.
    """

    name: str
    corners: np.ndarray
    centroid: np.ndarray
    density: np.ndarray
    modes: np.ndarray
    designed: bool = True
    length: float | None = None
    regions: tuple[tuple[str, np.ndarray], ...] = ()
    stress: np.ndarray | None = None
    stress_instant: np.ndarray | None = None
    filtered: np.ndarray | None = None
    wall: np.ndarray | None = None

    @property
    def solid(self) -> np.ndarray:
        """How much of every cell is solid (n_cells,): the density, but of a wall all of it."""
        return self.density if self.wall is None else np.ones_like(self.density)


def gather_views(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
    stress: Mapping[int, ArmStress] | None = None,
    x_filtered: Mapping[int, np.ndarray] | None = None,
) -> list[ArmView]:
    """Collect every arm on the root (collective); empty list elsewhere.

    Args:
        scene, partition, arms, x_phys: the designs.
        stress: what `stress_report` returned of their motion, if it is known.
        x_filtered: what the designs were projected from, if it is known; on all ranks or none.
    """

    def collect(values: Any) -> dict[int, np.ndarray]:
        with together(partition.world):
            mine = {index: values(index, arm) for index, arm in arms.items()}
        return gather_cells(partition, mine)

    def corner_nodes(arm: Arm) -> np.ndarray:
        operators = arm.substructure.operators  # also of arms that no design was set for
        return operators.cells[:, : compat.cell_corner_count(arm.mesh.mesh)]

    def modes(index: int, arm: Arm) -> np.ndarray:
        cells = corner_nodes(arm)
        if arm.basis is None:
            return np.zeros((*cells.shape, arm.mesh.dim, 0))
        return arm.basis.V[cells]

    def points(index: int, arm: Arm) -> np.ndarray:
        return arm.kind.points(x_phys[index])[corner_nodes(arm)]

    corners = collect(points)
    centroids = collect(lambda _, arm: arm.mesh.centroid)
    densities = collect(lambda index, _: x_phys[index])
    smooth = collect(lambda index, _: x_filtered[index]) if x_filtered is not None else {}
    shapes = collect(modes)
    with together(partition.world):
        if partition.world.rank == 0:
            return _views(scene, corners, centroids, densities, smooth, shapes, stress or {})
        return []


def _views(
    scene: Scene,
    corners: Mapping[int, np.ndarray],
    centroids: Mapping[int, np.ndarray],
    densities: Mapping[int, np.ndarray],
    smooth: Mapping[int, np.ndarray],
    shapes: Mapping[int, np.ndarray],
    stress: Mapping[int, ArmStress],
) -> list[ArmView]:
    """Return the views of all arms in the chain, given those with a design (root only)."""
    views = []
    for index, owner in enumerate(scene.owners):
        name = scene.arms[index].name
        if owner is None:
            views.append(FIXED_VIEWS[scene.dimension](scene.arms[index], fixed_body(scene, index)))
            continue
        order = canonical_order(centroids[owner])
        around = AROUND[corners[owner].shape[1:]]
        known = stress.get(index)
        views.append(
            ArmView(
                name,
                corners[owner][order][:, around],
                centroids[owner][order],
                densities[owner][order],
                shapes[owner][order][:, around],
                length=scene.arms[index].length,
                regions=_outlines(scene, index),
                stress=None if known is None else known.by_cell[order],
                stress_instant=None if known is None else known.when[order],
                filtered=smooth[owner][order] if owner in smooth else None,
                wall=scene.arms[owner].wall_at(densities[owner][order]),
            )
        )
    return views


def _outlines(scene: Scene, index: int) -> tuple[tuple[str, np.ndarray], ...]:
    """Return kind and outline of the regions of an arm, mirror images included."""
    arm = scene.arms[index]
    pattern = scene.arms[scene.patterns.get(index, index)]
    scale = np.array([arm.length / pattern.length, arm.height / pattern.height])
    found = []
    for region in pattern.regions:
        x0, y0, x1, y1 = region.bounds
        if region.box is not None:
            points = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        else:
            turn = np.exp(2j * np.pi * np.arange(CIRCLE) / CIRCLE)
            radius = 0.5 * (x1 - x0)
            points = np.column_stack([x0 + radius * (1 + turn.real), y0 + radius * (1 + turn.imag)])
        found.append((region.kind, points * scale))
        if pattern.symmetric:
            found.append((region.kind, points * scale * [1.0, -1.0]))
    return tuple(found)


def _box_view(arm: SceneArm, body: ShapeIntegrals) -> ArmView:
    """Return a rigid box from inboard to outboard."""
    side = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])  # of y and z
    faces = [
        np.column_stack([np.full(4, x), side * [arm.height, arm.thickness]])
        for x in (0.0, arm.length)
    ]
    corners = np.concatenate(faces)[None]
    modes = np.zeros((*corners.shape, 0))
    return ArmView(arm.name, corners, corners.mean(axis=1), np.ones(1), modes, False, arm.length)


def _bar_view(arm: SceneArm, body: ShapeIntegrals) -> ArmView:
    """Return a body whose shape is not known as a bar from joint to joint."""
    # Between them it bends like a beam without loads: cubic polynomials that fit the outboard
    # interface's displacement and rotation.
    length = float(np.hypot(*body.outboard_point))
    axis = np.array([*body.outboard_point]) / length
    across = np.array([-axis[1], axis[0]])
    s = np.linspace(0.0, 1.0, 21)
    station = np.stack([s[:-1], s[1:], s[1:], s[:-1]], axis=1)  # (n_cells, 4)
    side = 0.5 * arm.height * np.array([-1.0, -1.0, 1.0, 1.0])
    corners = length * station[..., None] * axis + side[:, None] * across
    u, v = axis @ body.outboard[:2], across @ body.outboard[:2]
    bend, turn = 3.0 * station**2 - 2.0 * station**3, length * (station**3 - station**2)
    slope = (6.0 * station - 6.0 * station**2) / length, 3.0 * station**2 - 2.0 * station
    deflection = bend[..., None] * v + turn[..., None] * body.outboard[2]
    rotation = slope[0][..., None] * v + slope[1][..., None] * body.outboard[2]
    along = station[..., None] * u - side[:, None] * rotation
    modes = along[:, :, None] * axis[:, None] + deflection[:, :, None] * across[:, None]
    density = np.ones(len(corners))
    return ArmView(arm.name, corners, corners.mean(axis=1), density, modes, False, length)


FIXED_VIEWS = {2: _bar_view, 3: _box_view}


def canonical_order(points: np.ndarray) -> np.ndarray:
    """Sort points by x, then y (then z), equal to 1e-9 of their extent: alike on any partition."""
    size = np.ptp(points, axis=0).max() or 1.0
    rounded = np.round(points / (1e-9 * size))
    return np.lexsort(rounded.T[::-1])


def designed(views: Sequence[ArmView]) -> list[ArmView]:
    """Return the arms that have a design."""
    return [view for view in views if view.designed]
