"""What a machine does with a design beside what it did before, from the summaries of two runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from dolfinopt.errors import InputError
from dolfinopt.study.tables import Table

Summary = Mapping[str, Any]
MM = 1e3  # of a metre


def before_after(before: Summary, after: Summary) -> Table:
    """Return mass, deflection, frequencies and drive forces of two runs of one machine.

    Args:
        before, after: content of their summary.json.

    Raises:
        InputError: they have other arms or drives.
    """
    for key, what in (("mass", "arms"), ("drive_peak", "drives")):
        names = [list(one.get(key) or {}) for one in (before, after)]
        if names[0] != names[1]:
            raise InputError(
                f"the runs have other {what}: {', '.join(names[0]) or 'none'} before, "
                f"{', '.join(names[1]) or 'none'} after; name runs of the same machine"
            )
    rows = [
        (name, _number(a), _number(b), unit)
        for (name, a, unit), (_, b, _) in zip(_figures(before), _figures(after), strict=True)
    ]
    frame = pd.DataFrame(rows, columns=["figure", "before", "after", "unit"])
    ratio = frame["after"] / frame["before"]
    frame.insert(3, "change [%]", (100.0 * (ratio - 1.0)).round(2) + 0.0)
    return Table("before_after", f"{after['name']}: before and after", frame)


def _figures(summary: Summary) -> Iterator[tuple[str, float | None, str]]:
    """Yield name, value and unit."""
    yield "mass of all arms", sum(summary["mass"].values()), "kg"
    links = summary["first_frequency"]
    for link in links:
        yield f"mass of {link}", summary["mass"][link], "kg"
    deflection = summary.get("max_deviation")
    yield "largest tool deflection", None if deflection is None else MM * deflection, "mm"
    settling = summary.get("settling")
    yield "deflection after the motion", None if settling is None else MM * settling, "mm"
    for link, frequency in links.items():
        yield f"first frequency of {link}", frequency, "Hz"
    for key, word in (("drive_peak", "peak"), ("drive_rms", "root mean square")):
        for drive, value in (summary.get(key) or {}).items():
            yield f"{word} of drive {drive}", value, _unit(summary, drive)


def _unit(summary: Summary, drive: str) -> str:
    """Return the unit of a drive's force: of the cart and of slides N, else N m."""
    joints = {one["name"]: one["type"] for one in summary["scene"].get("joints", ())}
    return "N" if joints.get(drive) == "prismatic" or (not joints and drive == "cart") else "N m"


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
