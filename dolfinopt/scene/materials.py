"""Materials by name: what standards and data sheets say of the solid material.

Values at room temperature. Yield strength is the least value that the standard guarantees for
plates and bars about 10 mm thick (of metals without a yield point the 0.2 % proof strength), or the
data sheet's typical value of a polymer. A batch or a printer may differ by several per cent: for a
part that is to be made, state the values of its own certificate.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any, NamedTuple


class CatalogueMaterial(NamedTuple):
    """One material and where its values are from.

    Attributes:
        young_modulus: Pa; of an orthotropic material E1 and E2.
        poisson_ratio: dimensionless; nu12.
        density: kg/m3.
        yield_strength: Pa; None where no single stress tells it.
        source: standards and data sheets.
        shear_modulus: G12 of an orthotropic material, Pa.
        kind: of its law.
    """

    young_modulus: float | tuple[float, float]
    poisson_ratio: float
    density: float
    yield_strength: float | None
    source: str
    shear_modulus: float | None = None
    kind: str = "isotropic"

    @property
    def values(self) -> dict[str, Any]:
        """The keys of [material] and their values."""
        known = self._asdict().items()
        return {key: value for key, value in known if key != "source" and value is not None}


_ASM2 = "ASM Handbook vol. 2 (1990)"
_PLATE = f"{_ASM2}; yield: EN 485-2, plate of 6 to 12.5 mm"
_STEEL = "EN 1993-1-1, EN 1991-1-1; yield: EN 10025-2, up to 16 mm"
CATALOGUE: Mapping[str, CatalogueMaterial] = {
    "aluminium 6061-T6": CatalogueMaterial(68.9e9, 0.33, 2700.0, 240e6, _PLATE),
    "aluminium 6082-T6": CatalogueMaterial(
        70e9, 0.33, 2700.0, 255e6, "EN 1999-1-1; yield: EN 485-2, plate of 6 to 12.5 mm"
    ),
    "aluminium 7075-T6": CatalogueMaterial(71.7e9, 0.33, 2810.0, 460e6, _PLATE),
    "aluminium 2024-T3": CatalogueMaterial(73.1e9, 0.33, 2780.0, 290e6, _PLATE),
    "steel S235": CatalogueMaterial(210e9, 0.3, 7850.0, 235e6, _STEEL),
    "steel S355": CatalogueMaterial(210e9, 0.3, 7850.0, 355e6, _STEEL),
    "steel 42CrMo4": CatalogueMaterial(
        210e9,
        0.3,
        7850.0,
        900e6,
        "EN 1993-1-1; yield: EN ISO 683-2, quenched and tempered, up to 16 mm",
    ),
    "stainless steel 1.4301": CatalogueMaterial(
        200e9, 0.3, 7900.0, 210e6, "EN 10088-1; yield: EN 10088-2, hot rolled plate"
    ),
    "titanium Ti-6Al-4V": CatalogueMaterial(
        113.8e9, 0.342, 4430.0, 828e6, f"{_ASM2}; yield: ASTM B265 grade 5, annealed"
    ),
    "magnesium AZ31B-H24": CatalogueMaterial(
        45e9, 0.35, 1770.0, 200e6, f"{_ASM2}; yield: ASTM B90, sheet up to 6.3 mm"
    ),
    "PLA printed": CatalogueMaterial(
        3.04e9,
        0.36,
        1264.0,
        45e6,
        "Stratasys PLA data sheet, XZ; Poisson's ratio: doi:10.1016/j.addr.2016.06.012",
    ),
    "ABS printed": CatalogueMaterial(
        2.23e9, 0.35, 1040.0, 31e6, "Stratasys ABS-M30 data sheet, XZ; Poisson's ratio: typical"
    ),
    "PA12 printed": CatalogueMaterial(
        1.65e9,
        0.4,
        930.0,
        48e6,
        "EOS PA 2200 data sheet, laser sintered, tensile strength; Poisson's ratio: typical",
    ),
    "POM": CatalogueMaterial(
        2.85e9, 0.37, 1410.0, 64e6, "Hostaform C 9021 data sheet; Poisson's ratio: typical"
    ),
    "PEEK": CatalogueMaterial(
        4.0e9, 0.4, 1300.0, 98e6, "Victrex 450G data sheet; Poisson's ratio: typical"
    ),
    "CFRP quasi-isotropic": CatalogueMaterial(
        69.7e9,
        0.296,
        1600.0,
        294e6,
        "T300/5208 in Tsai & Hahn, Introduction to Composite Materials (1980), [0/+-45/90] by "
        "laminate theory; in place of yield the first crack across fibres",
    ),
    "CFRP unidirectional": CatalogueMaterial(
        (181e9, 10.3e9),
        0.28,
        1600.0,
        None,
        "T300/5208 in Tsai & Hahn, Introduction to Composite Materials (1980)",
        7.17e9,
        "orthotropic",
    ),
}


def unknown_material(name: str) -> str:
    """Return what to say of a name that the catalogue does not have: the nearest ones, or all."""
    lower = {known.casefold(): known for known in CATALOGUE}
    wanted = name.casefold()
    parts = [known for key, known in lower.items() if wanted and wanted in key]
    near = parts or [lower[key] for key in difflib.get_close_matches(wanted, lower, 2, 0.5)]
    quoted = " or ".join(f'"{item}"' for item in near[:4])
    hint = f"did you mean {quoted}? " if near else ""
    return (
        f"expected a material of the catalogue; {hint}"
        "dolfinopt keys material lists all of them; or give its values in a table [material]"
    )
