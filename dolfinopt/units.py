"""How numbers are told with their SI units; files and responses state theirs themselves."""

from __future__ import annotations

NOT_MET = "; not met: "  # before the constraints in a stop reason


def with_unit(value: str, unit: str) -> str:
    """Return a number with its unit, "-" of none left out."""
    return value if unit == "-" else f"{value} {unit}"
