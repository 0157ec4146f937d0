"""Responses without a motion: mass and volume, compliance, tip deflection and stiffness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dolfinopt.arms.arm import fixed_body
from dolfinopt.arms.design_state import DesignState
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import on_all_ranks, on_root, sum_over_arms, together
from dolfinopt.responses.products import Products
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    occurrences,
    register,
)
from dolfinopt.responses.sensitivity import (
    deflection_gradient,
    static_gradient,
    static_response,
    tip_gradient,
)
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.objective import NEEDS, Objective, StiffnessCase

# -- mass of all arms --------------------------------------------------------------------------


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


# -- compliance under given static loads -------------------------------------------------------


@register
class StaticCompliance(Response):
    """Compliance of every design under `objective.loads`, times the arms that have it, N m."""

    name, label, unit = "static", "compliance under static loads", "N m"
    needs = NEEDS[name]

    def measure(self, analysis: Analysis) -> Measured:
        """Return the compliance of every design (collective)."""
        scene, uses, loads = analysis.scene, occurrences(analysis.scene), self._loads(analysis)
        with together(analysis.partition.world):
            mine = {
                k: uses[k] * static_response(state.elastic, loads).compliance
                for k, state in analysis.designs.items()
            }
        found = on_all_ranks(analysis.partition, mine)
        values = tuple(found.values())
        return Measured(self.name, tuple(scene.arms[k].name for k in found), values, values)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every design's compliance (collective)."""
        uses, designs = occurrences(analysis.scene), analysis.designs
        rows = []
        with together(analysis.partition.world):
            for owner in analysis.scene.cell_counts:
                row: CellGradient = {k: analysis.by(one, Products()) for k, one in designs.items()}
                if owner in designs:
                    response = static_response(designs[owner].elastic, self._loads(analysis))
                    gradient = static_gradient(designs[owner], response, analysis.by)
                    row[owner] = gradient * uses[owner]
                rows.append(row)
        return rows

    def _loads(self, analysis: Analysis) -> np.ndarray:
        return np.array(self.options.static_loads(analysis.scene))


# -- static deflection of every design's outboard interface --------------------------------------


@register
class TipDeflection(Response):
    """Largest displacement of the outboard point under `objective.loads`, by its p-norm, m."""

    name, label, unit = "tip_deflection", "static deflection", "m"
    needs = NEEDS[name]

    def measure(self, analysis: Analysis) -> Measured:
        """Return the deflection of every design (collective)."""
        mine = {}
        with together(analysis.partition.world):
            for k, state in analysis.designs.items():
                response = static_response(state.elastic, self._loads(analysis))
                mine[k] = response.deflection(self.options.exponent), response.largest
        found = on_all_ranks(analysis.partition, mine)
        smooth, largest = zip(*found.values(), strict=True)
        names = tuple(analysis.scene.arms[k].name for k in found)
        return Measured(self.name, names, largest, smooth)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every design's deflection (collective)."""
        designs, rows = analysis.designs, []
        for owner in analysis.scene.cell_counts:
            with together(analysis.partition.world):
                row = {k: analysis.by(one, Products()) for k, one in designs.items()}
                if owner in designs:
                    response = static_response(designs[owner].elastic, self._loads(analysis))
                    row[owner] = deflection_gradient(
                        designs[owner], response, self.options.exponent, analysis.by
                    )
            rows.append(row)
        return rows

    def _loads(self, analysis: Analysis) -> np.ndarray:
        return np.array(self.options.static_loads(analysis.scene))


# -- stiffness of single arms under given loads --------------------------------------------------

ROTATION = "_rotation"  # how the names of those values end


@dataclass(frozen=True)
class _Moved:
    """One value of `Stiffness`: how far a load moves an arm's interface."""

    name: str  # of the arm and the case
    case: StiffnessCase  # the load
    turns: bool  # whether it is the rotation, rad, or else the displacement, m
    limit: float  # in this unit

    def vector(self, state: DesignState) -> tuple[np.ndarray, np.ndarray]:
        """Return the displacement or rotation, and the load on all outboard interfaces (b, 1)."""
        found = static_response(state.elastic, np.array([self.case.load]))
        return found.tip[self._rows, 0], found.loads

    def value(self, state: DesignState) -> float:
        """Return its length (collective on the arm's ranks)."""
        return float(np.linalg.norm(self.vector(state)[0]))

    def by_tip(self, state: DesignState) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative of the length by all displacements (b, 1), and the load (b, 1)."""
        vector, load = self.vector(state)
        by, length = np.zeros_like(load), np.linalg.norm(vector)
        if length > 0.0:
            by[self._rows, 0] = vector / length
        return by, load

    @property
    def _rows(self) -> slice:
        d = 2 if len(self.case.load) == 3 else 3
        return slice(d, len(self.case.load)) if self.turns else slice(d)


@register
class Stiffness(Response):
    """How far given static loads move the outboard interfaces of single arms, clamped inboard.

    The length of the displacement, m, or of the rotation, rad, of every case of
    `constraints.stiffness`: smooth where it is not zero.
    """

    name, label, unit = "stiffness", "static displacement", "m"
    needs = NEEDS[name]

    def __init__(
        self, options: Objective, limited: bool = False, cases: Sequence[StiffnessCase] = ()
    ):
        """Take the options and the load cases."""
        super().__init__(options, limited)
        self.moved = [
            _Moved(f"{case.arm}_case{k}{ending}", case, bool(ending), limit)
            for k, case in enumerate(cases, 1)
            for ending, limit in (("", case.displacement), (ROTATION, case.rotation))
            if limit is not None
        ]

    @classmethod
    def unit_of(cls, value: str) -> str:
        """Return rad for a rotation, m for a displacement."""
        return "rad" if value.endswith(ROTATION) else "m"

    def restricted(self, limits: Sequence[StiffnessCase]) -> tuple[Response, tuple[float, ...]]:
        """Return the response of these cases, and the limits of their values."""
        found = Stiffness(self.options, self.limited, limits)
        return found, tuple(one.limit for one in found.moved)

    def measure(self, analysis: Analysis) -> Measured:
        """Return every displacement and rotation (collective)."""
        with together(analysis.partition.world):
            mine = {
                k: one.value(analysis.designs[owner])
                for k, (one, owner) in enumerate(self._owned(analysis.scene))
                if owner in analysis.designs
            }
        values = tuple(on_all_ranks(analysis.partition, mine).values())
        return Measured(self.name, tuple(one.name for one in self.moved), values, values)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every one (collective)."""
        rows = []
        with together(analysis.partition.world):
            for one, owner in self._owned(analysis.scene):
                designs = analysis.designs
                row = {k: analysis.by(state, Products()) for k, state in designs.items()}
                if owner in designs:
                    state = designs[owner]
                    row[owner] = tip_gradient(state, *one.by_tip(state), analysis.by)
                rows.append(row)
        return rows

    def _owned(self, scene: Scene) -> list[tuple[_Moved, int]]:
        """Return every value with the index of the arm that owns the design."""
        owners = {arm.name: k for arm, k in zip(scene.arms, scene.owners, strict=True)}
        return [(one, owner) for one in self.moved if (owner := owners[one.case.arm]) is not None]
