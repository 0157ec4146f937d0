"""`[material]`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from dolfinopt.scene.tables.base import Table

YoungModulus = Annotated[float, Field(ge=1.0, le=1e15)]  # Pa
PoissonRatio = Annotated[float, Field(ge=-0.99, lt=0.5)]
MassDensity = Annotated[float, Field(ge=1e-12, le=1e6)]  # kg/m3; 2.7e-9 t/mm3, too


class Material(Table):
    """The solid material, linear elastic and isotropic, in plane stress."""

    young_modulus: YoungModulus = Field(description="Young's modulus of the solid material [Pa]")
    poisson_ratio: PoissonRatio = Field(description="Poisson's ratio [-]")
    density: MassDensity = Field(description="mass density of the solid material [kg/m3]")
