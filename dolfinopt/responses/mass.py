"""Mass of all arms."""

from __future__ import annotations

import numpy as np

from dolfinopt.arms.arm import fixed_body
from dolfinopt.parallel import on_root, sum_over_arms, together
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    register,
)
from dolfinopt.responses.volume_fraction import cell_volumes
from dolfinopt.scene.tables.responses import NEEDS


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
        """Return the derivative rho'_e V_e."""
        designs = analysis.designs
        volumes = cell_volumes(analysis.scene, {k: one.mesh for k, one in designs.items()})
        return [{k: designs[k].density_slope * volume for k, volume in volumes.items()}]
