"""Names and SI units of what a run minimises, and of what its files hold."""

from __future__ import annotations

# Name and unit by objective.kind.
OBJECTIVES = {
    "esl": ("compliance of the load cases", "N m"),
    "compliance": ("integral of the compliance", "N m s"),
    "deviation": ("p-mean of the deviation", "m"),
    "static": ("compliance under static loads", "N m"),
    "eigenfrequency": ("squared longest periods", "s2"),
}

CONSTRAINTS = {"volume_fraction": "-", "first_frequency": "Hz", "tip_deflection": "m"}
NOT_MET = "; not met: "  # before the constraints in a stop reason

# Of summary.json's figures; those without a unit are "-". Constraints state theirs themselves.
SUMMARY = {
    "compliance": "N m",
    "max_deviation": "m",
    "max_deviation_time": "s",
    "settling": "m",
    "mass": "kg",
    "grayness": "-",
    "volume_fraction": "-",
    "minimum_member_measured": "m",
    "minimum_gap_measured": "m",
    "first_frequency": "Hz",
    "first_frequency_error": "-",
    "loaded_frequency": "Hz",
    "simulation_error_estimate": "-",
    "kkt": "-",
    "seconds": "s",
    "peak_memory_mb": "MB",
}

HISTORY = {
    "max_deviation": "m",
    "grayness": "-",
    "volume_fraction": "-",
    "change": "-",
    "seconds": "s",
    "kkt": "-",
}


def constraint_label(name: str) -> str:
    """Return e.g. "first frequency of arm2 [Hz]" for the column first_frequency_arm2."""
    for quantity, unit in CONSTRAINTS.items():
        if name.startswith(quantity):
            arm = name[len(quantity) + 1 :]
            return quantity.replace("_", " ") + (f" of {arm}" if arm else "") + f" [{unit}]"
    return name
