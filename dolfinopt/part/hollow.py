"""The part of a hollow arm: outer and inner surface, and its wall's mesh of hexahedra.

The design is its own part: nothing is rounded, cut or moved. Meshed is every cell of the wall cut
in four, which has the same surfaces; the design's own cells tell how much that changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.disk import write_bytes
from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import cell_sizes
from dolfinopt.mesh.hollow import Hull, Member
from dolfinopt.mesh.solid_cells import TENSOR, boundary, msh_bytes
from dolfinopt.part.part import DEFAULTS, Curves
from dolfinopt.part.plane.curves import MM
from dolfinopt.part.solid.surface import Surface, check_surface
from dolfinopt.part.stress import REENTRANT_SINE, CornerStress, clearance, mean_at_corners
from dolfinopt.part.workshop_files import three_mf_bytes, triangle_bytes
from dolfinopt.scene.tables.arms import WALL_KEYS

if TYPE_CHECKING:
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.mesh.arm_mesh import ArmMesh


CORNER_STEP = 1.2  # thickness of a wall over that of its corner, at most; from 1.25 cells fold
VERTICES = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])


@dataclass(frozen=True, eq=False)
class WallMesh(Member):
    """A wall's cells."""

    kind: ClassVar[str] = "hexahedra"

    def figures(self) -> dict[str, Any]:
        """Return its entry of part.json."""
        volume = cell_sizes(self.points[self.cells[:, TENSOR[8, 3]]]).sum()
        return {self.kind: len(self.cells), "volume": float(volume)}

    def write(self, path: Path) -> None:
        """Write it as `arms.mesh` reads it back (.msh)."""
        write_bytes(path, msh_bytes(self))


@dataclass(frozen=True, eq=False)
class HollowPart:
    """The part of one hollow arm, see `plane.part.PlanePart`.

    Attributes:
        name: the arm's.
        hull: its outer surface.
        thickness: (s, r) of its wall at the points of the hull, m.
        limits: least and largest thickness that the design may have, m.
    """

    name: str
    hull: Hull
    thickness: np.ndarray
    limits: tuple[float, float]

    COARSER: ClassVar[float] = 2.0  # sides of the design's cells
    REFINEMENTS: ClassVar[int] = 0  # of the mesh where stress is largest

    @cached_property
    def surface(self) -> Surface:
        """Outer and inner surface, and the rings between them at both ends, m."""
        mesh = self.hull.member(self.thickness)
        quads = boundary(mesh.cells)
        triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        return Surface(mesh.points, triangles)

    @property
    def facets(self) -> np.ndarray:
        """Corners (n, 3, 3) of the triangles of its surface, m."""
        return self.surface.corners

    @property
    def volume(self) -> float:
        """Within the surface, m3."""
        return self.surface.volume

    @property
    def warnings(self) -> list[str]:
        """None: the design is the part."""
        return []

    @property
    def sentence(self) -> str:
        """Its size in words."""
        rows = f"{len(self.surface.triangles)} triangles"
        return f"{1e9 * self.volume:.6g} mm3, {rows}, {', '.join(self.width_words)}"

    @property
    def width_words(self) -> list[str]:
        """How thick the wall is, in words."""
        thin, thick = MM * self.thickness.min(), MM * self.thickness.max()
        return [f"wall {thin:.3g} to {thick:.3g} mm"]

    def figures(self, density: float) -> dict[str, Any]:
        """Return the entry of part.json; `density` of the material in kg/m3."""
        return {
            "volume": self.volume,
            "mass": density * self.volume,
            "least_wall": float(self.thickness.min()),
            "largest_wall": float(self.thickness.max()),
            "min_wall": self.limits[0],
            "max_wall": self.limits[1],
            "triangles": len(self.surface.triangles),
            "warnings": self.warnings,
        }

    def keys(self) -> dict[str, Any]:
        """Return the keys of its arm in part.toml, but for the mesh."""
        _, height, thickness = map(float, np.ptp(self.hull.outer.reshape(-1, 3), axis=0))
        return {
            "height": height,
            "thickness": thickness,
            "cell_shape": "hexahedron",
            "element": "incompatible",
            "hollow": False,
            **dict.fromkeys(WALL_KEYS),
        }

    def files(self, name: str, title: str) -> Iterator[tuple[str, str | bytes]]:
        """Yield how the names of its files end, and what they hold; `name` and title of it."""
        yield ".stl", triangle_bytes(MM * self.facets, f"{title}, mm")
        yield ".3mf", three_mf_bytes(self.surface, name)

    def mesh(self, coarser: float = 1.0, finer: Sequence[np.ndarray] | None = None) -> WallMesh:
        """Return hexahedra: the design's, or a quarter of each, see `PlanePart.mesh`."""
        hull, thickness = self.hull, self.thickness
        if coarser < self.COARSER:
            grid = hull.points(thickness).reshape(2, *hull.outer.shape)
            outer, inner = map(_halved, grid)
            still = np.zeros_like(outer), np.arange(outer.shape[1])
            hull, thickness = Hull(outer, inner - outer, *still), np.ones(outer.shape[:2])
        result = hull.member(thickness)
        return WallMesh(result.points, result.cells, result.inboard, result.outboard)

    def regular(self, places: np.ndarray, margin: float) -> np.ndarray:
        """Return which places (n, 3) are away from where stress has no limit (n,).

        That is where the wall meets the rigid interfaces, and along inner edges.
        """
        x = self.hull.outer[:, 0, 0]
        far = max(margin, clearance(float(np.median(np.diff(x))), 3))
        result = (places[:, 0] >= x[0] + far) & (places[:, 0] <= x[-1] - far)
        # The mitre of a section that turns by 2 a is 1 / cos a.
        turn = 2.0 * np.arccos(1.0 / np.linalg.norm(self.hull.inward, axis=2).clip(1.0))
        edges = np.sin(turn) > REENTRANT_SINE
        if edges.any():
            inner = (self.hull.outer + self.thickness[:, :, None] * self.hull.inward)[edges]
            across = cKDTree(inner[:, 1:]).query(places[:, 1:])[0]
            result &= across > clearance(self.thickness.min(), 3)
        return np.asarray(result)

    def stress(self, state: DesignState) -> CornerStress:
        """Return the stress at the corners of the cells, on both surfaces of the wall."""
        count = len(state.mesh.mesh.geometry.x)
        every = np.ones((state.mesh.num_cells, 8), dtype=bool)
        return mean_at_corners(state, VERTICES, every, np.ones(count, dtype=bool))


def make_hollow_part(mesh: ArmMesh, x_phys: np.ndarray, curves: Curves = DEFAULTS) -> HollowPart:
    """Return the part of one hollow arm, whole on this rank, see `part.make_parts`.

    Raises:
        InputError: curves are asked for.
    """
    if curves != DEFAULTS:
        raise InputError(
            f"arm {mesh.name!r}: its wall's inner surface has no curves: leave out --tool-radius, "
            "--tolerance and --curves"
        )
    assert mesh.wall is not None
    wall = mesh.wall
    thickness = _unfolded(wall.hull, wall.thickness(mesh.comm, x_phys))
    result = HollowPart(mesh.name, wall.hull, thickness, (wall.least, wall.most))
    check_surface(mesh.name, result.surface)
    return result


def _unfolded(hull: Hull, thickness: np.ndarray) -> np.ndarray:
    """Return thickness (s, r), m, that is larger at corners beside which it is much larger.

    The short cells there are `CORNER_CELL_RATIO` times as long as the corner is thick, and folded
    where the wall beside it is thicker than that.
    """
    result = thickness.copy()
    for at, corner in enumerate(hull.lead):
        result[:, corner] = np.maximum(result[:, corner], thickness[:, at] / CORNER_STEP)
    return result


def _halved(grid: np.ndarray) -> np.ndarray:
    """Return points (s, r, d), round a section, with those halfway along and round them."""
    along = np.empty((2 * len(grid) - 1, *grid.shape[1:]))
    along[::2], along[1::2] = grid, 0.5 * (grid[1:] + grid[:-1])
    result = np.empty((len(along), 2 * grid.shape[1], grid.shape[2]))
    result[:, ::2], result[:, 1::2] = along, 0.5 * (along + np.roll(along, -1, axis=1))
    return result
