"""SI units of what a run's files hold; responses state theirs themselves."""

from __future__ import annotations

NOT_MET = "; not met: "  # before the constraints in a stop reason

# Of summary.json's figures; those without a unit are "-". Constraints state theirs themselves.
SUMMARY = {
    "compliance": "N m",
    "max_deviation": "m",
    "max_deviation_time": "s",
    "max_rotation": "rad",
    "settling": "m",
    "deflection_budget": "m, shares -",
    "stress": "Pa",
    "mass": "kg",
    "designed_mass": "kg",
    "grayness": "-",
    "volume_fraction": "-",
    "connected": "-",
    "contacts": "-",
    "minimum_member_measured": "m",
    "minimum_gap_measured": "m",
    "too_narrow": "m",
    "first_frequency": "Hz",
    "first_frequency_error": "-",
    "loaded_frequency": "Hz",
    "simulation_error_estimate": "-",
    "kkt": "-",
    "seconds": "s",
    "peak_memory_mb": "MB",
}

CERTIFICATE = {
    "kkt": "-",
    "gradient_angle": "degree",
    "gradient_ratio": "-",
    "excess": "-",
    "seconds": "s",
}

HISTORY = {
    "max_deviation": "m",
    "grayness": "-",
    "volume_fraction": "-",
    "change": "-",
    "seconds": "s",
    "kkt": "-",
}


def with_unit(value: str, unit: str) -> str:
    """Return a number with its unit, "-" of none left out."""
    return value if unit == "-" else f"{value} {unit}"
