"""Responses without a motion: mass and volume, compliance, tip deflection and stiffness."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dolfinopt.arms.arm import fixed_body
from dolfinopt.arms.design_state import DesignState
from dolfinopt.multibody.kinematics import lengths
from dolfinopt.parallel import on_all_ranks, on_root, sum_over_arms, together
from dolfinopt.responses.products import Products
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    occurrences,
    p_norm_of_lengths,
    response,
)
from dolfinopt.responses.sensitivity import static_response, tip_gradient
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.base import wrench
from dolfinopt.scene.tables.objective import Objective
from dolfinopt.scene.tables.responses import StiffnessCase

# -- mass of all arms, volume of every design or of all together --------------------------------


class MaterialResponse(Response):
    """Sums over cells of their volume, times the arms that have it, and a function of density."""

    @abstractmethod
    def per_volume(self, state: DesignState) -> tuple[np.ndarray, np.ndarray | float]:
        """Return that function of every cell, and its derivative by the physical density."""

    def rows(self, scene: Scene) -> dict[int, int]:
        """Return to which value the cells of every arm belong; by default there is one."""
        return dict.fromkeys(scene.cell_counts, 0)

    def sums(self, analysis: Analysis) -> np.ndarray:
        """Return the values, and beside each the volume of its solid arms (values, 2)."""
        rows, depth, parts = self.rows(analysis.scene), depths(analysis.scene), {}
        with together(analysis.partition.world):
            for k, design in analysis.designs.items():
                own = design.mesh.area @ self.per_volume(design)[0], design.kind.volume.sum()
                parts[k] = np.zeros((1 + max(rows.values()), 2))
                parts[k][rows[k]] = depth[k] * np.array(own)
        return sum_over_arms(analysis.partition, parts)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the derivatives by the densities, or by the cells' volumes (collective)."""
        rows, depth, result = self.rows(analysis.scene), depths(analysis.scene), {}
        with together(analysis.partition.world):
            for k, design in analysis.designs.items():
                amount, slope = self.per_volume(design)
                products = Products(
                    densities=depth[k] * slope * design.mesh.area, volumes=depth[k] * amount
                )
                result[k] = analysis.by(design, products)
        return [
            {k: item for k, item in result.items() if rows[k] == row}
            for row in range(1 + max(rows.values()))
        ]


@response("mass")
class Mass(MaterialResponse):
    """sum_e rho_e V_e, kg, rho_e by the interpolation law, without motors and payload.

    As objective of the arms that have a design. As limit of all arms: rigid ones and those from
    files add what they have.
    """

    def per_volume(self, state: DesignState) -> tuple[np.ndarray, np.ndarray | float]:
        """Return rho_e and its derivative."""
        return state.solid.density * state.material.mass, state.density_slope

    def measure(self, analysis: Analysis) -> Measured:
        """Return the mass (collective)."""
        scene = analysis.scene
        # Beside the rest of a robot what an optimisation gains would look like nothing.
        owners = scene.owners if self.limited else ()
        fixed = [place for place, owner in enumerate(owners) if owner is None]
        rest = on_root(
            analysis.partition.world, lambda: sum(float(fixed_body(scene, k).mass) for k in fixed)
        )
        value = (float(self.sums(analysis)[0, 0]) + rest,)
        return Measured(self.name, ("",), value, value)


@response("volume_fraction")
class VolumeFraction(MaterialResponse):
    """sum_e V_e x_e of every design times the arms that have it, m3; its true value over sum V_e.

    With `design.shared_volume` one value, of all designs together.
    """

    def per_volume(self, state: DesignState) -> tuple[np.ndarray, np.ndarray | float]:
        """Return x_e and 1."""
        return state.share, 1.0

    def rows(self, scene: Scene) -> dict[int, int]:
        """Return a value for every design, or the same for all."""
        if scene.design.shared_volume:
            return super().rows(scene)
        row = {k: row for row, k in enumerate(scene.designed)}
        return {k: row[scene.patterns.get(k, k)] for k in scene.cell_counts}

    def measure(self, analysis: Analysis) -> Measured:
        """Return volumes and their fractions (collective)."""
        filled, full = self.sums(analysis).T
        scene = analysis.scene
        designed = tuple(scene.arms[k].name for k in scene.designed)
        names = ("",) if scene.design.shared_volume else designed
        return Measured(self.name, names, tuple((filled / full).tolist()), tuple(filled.tolist()))


def depths(scene: Scene) -> dict[int, float]:
    """Return what an area of a design's mesh counts in all arms that have it, m; in space 1's."""
    return {k: count * scene.arms[k].depth for k, count in occurrences(scene).items()}


# -- what static loads do to single arms: compliance, deflection, stiffness ------------------------


@dataclass(frozen=True, eq=False)
class LoadedArm:
    """What has one value of static loads: one arm, clamped at its inboard interface.

    Attributes:
        name: of the value.
        owner: index of the arm.
        loads: (k, 3) force, N, and moment, N m, at its outboard interface; of solids (k, 6).
        rows: of the displacements (m) and rotations (rad) that count.
        factor: of the value: how many arms have this design.
    """

    name: str
    owner: int
    loads: np.ndarray
    rows: slice
    factor: int = 1


class StaticResponse(Response):
    """Functions of how static loads move the outboard interfaces of arms."""

    def cases(self, scene: Scene) -> Sequence[LoadedArm]:
        """Return what has a value; by default every design under `objective.loads`."""
        loads, uses = np.array(self.options.static_loads(scene)), occurrences(scene)
        rows = slice(scene.dimension)
        return [LoadedArm(scene.arms[k].name, k, loads, rows, uses[k]) for k in scene.cell_counts]

    @abstractmethod
    def value(self, case: LoadedArm, tip: np.ndarray) -> tuple[float, float]:
        """Return true and smooth value of displacements, m, and rotations, rad.

        Args:
            case: whose.
            tip: (3, k), of solids (6, k).
        """

    @abstractmethod
    def gradient(self, case: LoadedArm, tip: np.ndarray) -> np.ndarray:
        """Return the derivative of the smooth value by them, like `tip`."""

    def measure(self, analysis: Analysis) -> Measured:
        """Return every value (collective)."""
        cases, mine = self.cases(analysis.scene), {}
        with together(analysis.partition.world):
            for number, case in enumerate(cases):
                if case.owner in analysis.designs:
                    result = static_response(analysis.designs[case.owner].elastic, case.loads)
                    mine[number] = self.value(case, result.tip[: case.loads.shape[1]])
        true, smooth = zip(*on_all_ranks(analysis.partition, mine).values(), strict=True)
        return Measured(self.name, tuple(item.name for item in cases), true, smooth)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every value, by one adjoint load a load case (collective)."""
        rows, designs = [], analysis.designs
        with together(analysis.partition.world):
            for case in self.cases(analysis.scene):
                row = {k: analysis.by(state, Products()) for k, state in designs.items()}
                if case.owner in designs:
                    state, count = designs[case.owner], case.loads.shape[1]
                    result = static_response(state.elastic, case.loads)
                    by = np.zeros_like(result.tip)
                    by[:count] = self.gradient(case, result.tip[:count])
                    row[case.owner] = tip_gradient(state, by, result.loads, analysis.by)
                rows.append(row)
        return rows


@response("static")
class StaticCompliance(StaticResponse):
    """Compliance of every design under `objective.loads`, times the arms that have it, N m."""

    def value(self, case: LoadedArm, tip: np.ndarray) -> tuple[float, float]:
        """Return sum load . displacement over the load cases."""
        result = case.factor * float(np.sum(case.loads.T * tip))
        return result, result

    def gradient(self, case: LoadedArm, tip: np.ndarray) -> np.ndarray:
        """Return the loads."""
        return np.asarray(case.factor * case.loads.T)


@response("tip_deflection")
class TipDeflection(StaticResponse):
    """Largest displacement of the outboard point under `objective.loads`, by its p-norm, m."""

    def value(self, case: LoadedArm, tip: np.ndarray) -> tuple[float, float]:
        """Return the largest length of the load cases' displacements, and their p-norm."""
        vectors = tip[case.rows].T
        smooth, _ = p_norm_of_lengths(vectors, self.options.exponent)
        return float(lengths(vectors).max()), smooth

    def gradient(self, case: LoadedArm, tip: np.ndarray) -> np.ndarray:
        """Return that of the p-norm."""
        by = np.zeros_like(tip)
        by[case.rows] = p_norm_of_lengths(tip[case.rows].T, self.options.exponent)[1].T
        return by


ROTATION = "_rotation"  # how the names of those values end


@response("stiffness")
class Stiffness(TipDeflection):
    """How far given static loads move the outboard interfaces of single arms, clamped inboard.

    The length of the displacement, m, or of the rotation, rad, of every case of
    `constraints.stiffness`: smooth where it is not zero.
    """

    def __init__(
        self, options: Objective, limited: bool = False, limits: Sequence[StiffnessCase] = ()
    ):
        """Take the options and the load cases."""
        super().__init__(options, limited)
        self.limits = limits

    @classmethod
    def unit_of(cls, value: str) -> str:
        """Return rad for a rotation, m for a displacement."""
        return "rad" if value.endswith(ROTATION) else "m"

    def restricted(self, limits: Sequence[StiffnessCase]) -> tuple[Response, tuple[float, ...]]:
        """Return the response of these cases, and the limits of their values."""
        result = Stiffness(self.options, self.limited, limits)
        both = (limit for case in limits for limit in (case.displacement, case.rotation))
        return result, tuple(item for item in both if item is not None)

    def cases(self, scene: Scene) -> Sequence[LoadedArm]:
        """Return the displacement and the rotation of every case that limits them."""
        owners = {arm.name: k for arm, k in zip(scene.arms, scene.owners, strict=True)}
        result, d = [], scene.dimension
        for number, case in enumerate(self.limits, 1):
            name, owner = f"{case.arm}_case{number}", owners[case.arm]
            loads = np.array([wrench(case, d)])
            assert owner is not None  # the scene has checked that
            if case.displacement is not None:
                result.append(LoadedArm(name, owner, loads, slice(d)))
            if case.rotation is not None:
                turned = slice(d, loads.shape[1])
                result.append(LoadedArm(name + ROTATION, owner, loads, turned))
        return result
