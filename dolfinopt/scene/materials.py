"""Materials by name: the catalogue of materials.toml."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any, NamedTuple

from dolfinopt.data import tables_of


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

    young_modulus: float | list[float]
    poisson_ratio: float
    density: float
    source: str
    yield_strength: float | None = None
    shear_modulus: float | None = None
    kind: str = "isotropic"

    @property
    def values(self) -> dict[str, Any]:
        """The keys of [material] and their values."""
        known = self._asdict().items()
        return {key: value for key, value in known if key != "source" and value is not None}


CATALOGUE: Mapping[str, CatalogueMaterial] = {
    name: CatalogueMaterial(**values) for name, values in tables_of("scene/materials.toml").items()
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
