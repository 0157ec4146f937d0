"""`[material]`, its catalogue, and what a scene knows of every kind of material law.

What a law computes stands in `dolfinopt.fem.laws`; see docs/pages/develop/own-form.md.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, WithJsonSchema

from dolfinopt.data import tables_of
from dolfinopt.scene.tables.base import (
    Refusal,
    Table,
    Three,
    TwoOrThree,
    shown,
)

YoungModulus = Annotated[float, Field(ge=1.0, le=1e15)]  # Pa
# Of a direction across to one along the fibres: bounded by the ratio of their moduli alone.
AnyRatio = Annotated[float, Field(ge=-100, le=100)]
FibreAngle = Annotated[float, Field(ge=-6.3, le=6.3)]  # rad
Quantity = Annotated[float, Field(ge=-1e15, le=1e15)]  # a key of a law of one's own


# Of materials by name: keys of [material] and their values; standards and data sheets.
CATALOGUE: Mapping[str, dict[str, Any]] = tables_of("scene/materials.toml")
SOURCES = {name: str(values.pop("source")) for name, values in CATALOGUE.items()}


def check_material(name: str) -> str:
    """Return `name` if the catalogue has it; else tell the nearest ones, or where all stand."""
    if name in CATALOGUE:
        return name
    lower = {known.casefold(): known for known in CATALOGUE}
    wanted = name.casefold()
    parts = [known for key, known in lower.items() if wanted and wanted in key]
    near = parts or [lower[key] for key in difflib.get_close_matches(wanted, lower, 2, 0.5)]
    quoted = " or ".join(f'"{item}"' for item in near[:4])
    hint = f"did you mean {quoted}? " if near else ""
    raise Refusal(
        f"expected a material of the catalogue; {hint}"
        "dolfinopt keys material lists all of them; or give its values in a table [material]"
    )


CatalogueName = Annotated[
    str,
    AfterValidator(check_material),
    WithJsonSchema(
        {"enum": list(CATALOGUE), "description": "the name of a material of the catalogue"}
    ),
]


@dataclass(frozen=True)
class LawDeclaration:
    """What a scene says by a kind of material law.

    Attributes:
        kind: the word of material.kind.
        keys: of [material] that it needs beside young_modulus, poisson_ratio and density.
        directed: whether it has directions, which `angle` turns.
        has_strength: whether von Mises's stress tells when it yields.
        scales: whether all of its stiffness is proportional to young_modulus alone.
    """

    kind: str
    keys: tuple[str, ...] = ()
    directed: bool = False
    has_strength: bool = False
    scales: bool = False

    @property
    def used(self) -> tuple[str, ...]:
        """Keys that not every kind has and this one has."""
        directions = ("angle",) if self.directed else ()
        return self.keys + directions + (("yield_strength",) if self.has_strength else ())


# Keys of every kind.
OF_ALL = "kind", "young_modulus", "poisson_ratio", "density"
LAWS: dict[str, LawDeclaration] = {
    item.kind: item
    for item in (
        LawDeclaration("isotropic", has_strength=True, scales=True),
        LawDeclaration("orthotropic", ("shear_modulus",), directed=True),
    )
}


class Material(Table):
    """The solid material, linear elastic; in plane stress or in space.

    `material = "NAME"` in place of the table takes all values from the catalogue; so does
    `name = "NAME"` in it, for those that are not stated.
    """

    name: CatalogueName | None = None
    kind: Literal["isotropic", "orthotropic"] = "isotropic"
    young_modulus: YoungModulus | TwoOrThree[YoungModulus]
    poisson_ratio: Annotated[float, Field(ge=-0.99, lt=0.5)] | AnyRatio | Three[AnyRatio]
    shear_modulus: YoungModulus | Three[YoungModulus] | None = None
    angle: FibreAngle | Three[FibreAngle] | None = None
    density: float = Field(ge=1e-12, le=1e6)  # kg/m3; 2.7e-9 t/mm3, too
    yield_strength: float | None = Field(default=None, ge=1e-3, le=1e15)

    @property
    def law(self) -> LawDeclaration:
        """What its kind says."""
        return LAWS[self.kind]

    @property
    def modulus(self) -> float:
        """Young's modulus, or E1: what the law is relative to, Pa."""
        young = self.young_modulus
        return young[0] if isinstance(young, tuple) else young

    @property
    def ratio(self) -> float:
        """Poisson's ratio, or nu12."""
        ratio = self.poisson_ratio
        return ratio[0] if isinstance(ratio, tuple) else ratio

    def check_table(self) -> None:
        self.check_law()

    def check_law(self, dim: int | None = None) -> None:
        """Refuse keys that the kind does not have, or lacks, and values that no material has.

        Args:
            dim: of the arm; None: not known.
        """
        kind = f"with kind = {shown(self.kind)}"
        for key in material_keys():
            given, optional = getattr(self, key, None) is not None, key not in OF_ALL
            if given and optional and key not in self.law.used:
                raise Refusal(f"expected none {kind}", key, "kind")
            if not optional or key in self.law.keys:
                self.need(key, "kind")
        if self.kind == "orthotropic":
            check_orthotropic(self, dim)
            return
        if isinstance(self.young_modulus, tuple):
            raise Refusal(f"expected a number {kind}", "young_modulus", "kind")
        if isinstance(nu := self.poisson_ratio, tuple) or not -0.99 <= nu < 0.5:
            raise Refusal(f"expected a number >= -0.99 and < 0.5 {kind}", "poisson_ratio")


def material_keys() -> list[str]:
    """Return the keys of [material] that state the material itself, not its name."""
    return [key for key in Material.model_fields if key != "name"]


# -- orthotropic materials -----------------------------------------------------------------------

PAIRS = (0, 1), (1, 2), (0, 2)  # of directions, in the order of three ratios or shear moduli


def check_orthotropic(solid: Material, dim: int | None) -> None:
    """Refuse constants of which some deformation would release energy."""
    young, ratio = solid.young_modulus, solid.poisson_ratio
    if not isinstance(young, tuple):
        raise Refusal('expected [E1, E2] with kind = "orthotropic"', "young_modulus", "kind")
    for key, most in (
        ("young_modulus", 2),
        ("poisson_ratio", 1),
        ("shear_modulus", 1),
        ("angle", 1),
    ):
        value = getattr(solid, key)
        if dim == 2 and isinstance(value, tuple) and len(value) > most:
            raise Refusal(f"expected {most} of an arm in plane stress, not 3", key)
    E = young[0], young[1], young[-1]
    in_space = dim == 3 or isinstance(ratio, tuple)
    ratios = ratio if isinstance(ratio, tuple) else (ratio,) * 3
    scaled = [nu * (E[j] / E[i]) ** 0.5 for (i, j), nu in zip(PAIRS, ratios, strict=True)]
    for (i, j), item in zip(PAIRS, scaled[: 3 if in_space else 1], strict=False):
        if abs(item) >= 1.0:
            raise Refusal(
                f"expected |nu{i + 1}{j + 1}| < sqrt(E{i + 1}/E{j + 1}) = "
                f"{(E[i] / E[j]) ** 0.5:.4g}: otherwise a deformation would release energy",
                "poisson_ratio",
                "young_modulus",
            )
    a, b, c = scaled
    if in_space and a * a + b * b + c * c + 2.0 * a * b * c >= 1.0:
        raise Refusal(
            "expected smaller ratios: with all three a deformation would release energy",
            "poisson_ratio",
            "young_modulus",
        )
