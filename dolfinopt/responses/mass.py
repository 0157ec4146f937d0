"""Mass of all arms, and volume fractions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dolfinopt.arms.arm import fixed_body
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import on_root, sum_over_arms, together
from dolfinopt.responses.products import Products
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    occurrences,
    register,
)
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.objective import NEEDS


@register
class Mass(Response):
    """sum_e rho_e V_e of all arms, kg; rigid ones and those from files add what they have.

    rho_e by the interpolation law. Motors and payload, which no design changes, are left out.
    """

    name, label, unit = "mass", "mass of the arms", "kg"
    of_nominal = True
    needs = NEEDS[name]

    def measure(self, analysis: Analysis) -> Measured:
        """Return the mass of all arms (collective)."""
        scene, partition = analysis.scene, analysis.partition
        parts = {}
        with together(partition.world):
            meshes = {k: one.mesh for k, one in analysis.designs.items()}
            for k, volume in cell_volumes(scene, meshes).items():
                one = analysis.designs[k]
                parts[k] = np.array(one.solid.density * volume @ one.material.mass)
        fixed = [place for place, owner in enumerate(scene.owners) if owner is None]
        rest: float = on_root(
            partition.world, lambda: sum(float(fixed_body(scene, k).mass) for k in fixed)
        )
        value = (float(sum_over_arms(partition, parts)) + rest,)
        return Measured(self.name, ("",), value, value)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the derivative rho'_e V_e by the densities, rho_e by the cells' volumes."""
        designs, depth, row = analysis.designs, _depths(analysis.scene), {}
        with together(analysis.partition.world):
            for k, volume in _of_cells(analysis).items():
                one = designs[k]
                by_volume = one.solid.density * depth[k] * one.material.mass
                products = Products(densities=one.density_slope * volume, volumes=by_volume)
                row[k] = analysis.by(one, products)
        return [row]


# -- volume of every design, or of all together --------------------------------------------------


@register
class VolumeFraction(Response):
    """sum_e V_e x_e of every design times the arms that have it, m3; its true value over sum V_e.

    With `design.shared_volume` one value, of all designs together.
    """

    name, label, unit = "volume_fraction", "volume", "m3"
    limit_unit = "-"
    of_nominal = True

    def measure(self, analysis: Analysis) -> Measured:
        """Return volumes and their fractions (collective)."""
        filled, full = self._volumes(analysis).T
        scene = analysis.scene
        designed = tuple(scene.arms[k].name for k in scene.designed)
        names = ("",) if scene.design.shared_volume else designed
        return Measured(self.name, names, tuple((filled / full).tolist()), tuple(filled.tolist()))

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the volumes of the cells that belong to each value, or x_e by their volumes."""
        rows, depth, found = _rows(analysis), _depths(analysis.scene), {}
        with together(analysis.partition.world):
            for k, volume in _of_cells(analysis).items():
                one = analysis.designs[k]
                products = Products(densities=volume, volumes=depth[k] * one.share)
                found[k] = analysis.by(one, products)
        return [
            {k: one for k, one in found.items() if rows[k] == row}
            for row in range(1 + max(rows.values()))
        ]

    def smooth_limits(
        self, analysis: Analysis, measured: Measured, limits: np.ndarray
    ) -> np.ndarray:
        """Return the volumes of designs filled to the limits, m3 (collective)."""
        return limits * self._volumes(analysis)[:, 1]

    def _volumes(self, analysis: Analysis) -> np.ndarray:
        """Return the volume of the design and of its solid arms (values, 2), m3 (collective)."""
        rows, depth, parts = _rows(analysis), _depths(analysis.scene), {}
        with together(analysis.partition.world):
            for k, volume in _of_cells(analysis).items():
                one = analysis.designs[k]
                parts[k] = np.zeros((1 + max(rows.values()), 2))
                parts[k][rows[k]] = volume @ one.share, depth[k] * one.kind.volume.sum()
        return sum_over_arms(analysis.partition, parts)


def cell_volumes(scene: Scene, meshes: Mapping[int, ArmMesh]) -> dict[int, np.ndarray]:
    """Return the volume (n_cells,) of every arm's cells times the arms that have them, m3."""
    depth = _depths(scene)
    return {k: depth[k] * mesh.area for k, mesh in meshes.items()}


def _depths(scene: Scene) -> dict[int, float]:
    """Return what an area of a design's mesh counts in all arms that have it, m; in space 1's."""
    return {k: count * scene.arms[k].depth for k, count in occurrences(scene).items()}


def _of_cells(analysis: Analysis) -> dict[int, np.ndarray]:
    return cell_volumes(analysis.scene, {k: one.mesh for k, one in analysis.designs.items()})


def _rows(analysis: Analysis) -> dict[int, int]:
    """Return to which value every arm's cells belong: that of the arm whose design it has."""
    scene = analysis.scene
    row = {k: 0 if scene.design.shared_volume else row for row, k in enumerate(scene.designed)}
    return {k: row[scene.patterns.get(k, k)] for k in scene.cell_counts}
