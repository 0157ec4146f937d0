"""`[material]`."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, WithJsonSchema

from dolfinopt.scene.materials import CATALOGUE, unknown_material
from dolfinopt.scene.tables.base import Refusal, Table

YoungModulus = Annotated[float, Field(ge=1.0, le=1e15)]  # Pa
PoissonRatio = Annotated[float, Field(ge=-0.99, lt=0.5)]
MassDensity = Annotated[float, Field(ge=1e-12, le=1e6)]  # kg/m3; 2.7e-9 t/mm3, too
YieldStrength = Annotated[float, Field(ge=1e-3, le=1e15)]  # Pa


def check_material(name: str) -> str:
    """Return `name` if the catalogue has it."""
    if name not in CATALOGUE:
        raise Refusal(unknown_material(name))
    return name


CatalogueName = Annotated[
    str,
    AfterValidator(check_material),
    WithJsonSchema({"type": "string", "enum": list(CATALOGUE)}),
]


class Material(Table):
    """The solid material, linear elastic and isotropic, in plane stress.

    `material = "NAME"` in place of the table takes all values from the catalogue; so does
    `name = "NAME"` in it, for those that are not stated.
    """

    name: CatalogueName | None = Field(
        default=None,
        description='name in the catalogue, e.g. "aluminium 7075-T6", from which values not stated '
        'are taken; material = "NAME" in place of the table is short for it [-]',
    )
    young_modulus: YoungModulus = Field(description="Young's modulus of the solid material [Pa]")
    poisson_ratio: PoissonRatio = Field(description="Poisson's ratio [-]")
    density: MassDensity = Field(description="mass density of the solid material [kg/m3]")
    yield_strength: YieldStrength | None = Field(
        default=None,
        description="stress up to which the solid material is elastic; for reports alone [Pa]",
    )


# What a catalogue name stands for.
MATERIAL_VALUES = tuple(key for key in Material.model_fields if key != "name")
