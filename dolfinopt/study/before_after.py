"""What a machine does with a design beside what it did before: table and page of two runs."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dolfinopt.errors import InputError
from dolfinopt.multibody.kinematics import lengths
from dolfinopt.output.trajectory import drive_units
from dolfinopt.plots.panels import Line, Panel, panel_figure
from dolfinopt.plots.style import look
from dolfinopt.scene.load import Scene
from dolfinopt.study.tables import Table, html_page
from dolfinopt.study.variants import differences

Summary = Mapping[str, Any]  # content of summary.json
BEFORE, AFTER = "before", "after"
LOOKS = {BEFORE: look(1), AFTER: look(0)}  # as an initial and an optimised design


# -- table -----------------------------------------------------------------------------------


def before_after(before: Summary, after: Summary) -> Table:
    """Return mass, deflection, frequencies and drive forces of two runs of one machine.

    InputError where they have other arms or drives.
    """
    for key, what in (("mass", "arms"), ("drive_peak", "drives")):
        names = [", ".join(item.get(key) or {}) for item in (before, after)]
        if names[0] != names[1]:
            raise InputError(
                f"the runs have other {what}: {names[0] or 'none'} before, "
                f"{names[1] or 'none'} after; name runs of the same machine"
            )
    frame = pd.DataFrame(_figures(before), columns=["figure", BEFORE, "unit"])
    frame.insert(2, AFTER, [value for _, value, _ in _figures(after)])
    frame = frame.astype({BEFORE: float, AFTER: float})  # what a run does not have is nan
    change = 100.0 * (frame[AFTER] / frame[BEFORE] - 1.0)
    frame.insert(3, "change [%]", change.round(2) + 0.0)
    return Table("before_after", f"{after['name']}: before and after", frame)


def _figures(summary: Summary) -> Iterator[tuple[str, float | None, str]]:
    """Yield name, value and unit."""
    links = summary["first_frequency"]
    yield "mass of all arms", sum(summary["mass"].values()), "kg"
    for link in links:
        yield f"mass of {link}", summary["mass"][link], "kg"
    for name, key, unit in (
        ("largest tool deflection", "max_deviation", "mm"),
        ("largest tool rotation", "max_rotation", "mrad"),
        ("deflection at rest", "settling", "mm"),
    ):
        value = summary.get(key)
        yield name, None if value is None else 1e3 * value, unit
    for link, frequency in links.items():
        yield f"first frequency of {link}", frequency, "Hz"
    units = summary["units"]["drive_peak"]
    for key, word in (("drive_peak", "peak"), ("drive_rms", "root mean square")):
        for drive, value in (summary.get(key) or {}).items():
            yield f"{word} of drive {drive}", value, units[drive]


# -- page ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Side:
    """One of the two runs."""

    folder: Path  # as the user named it
    scene: Scene
    summary: Summary
    t: np.ndarray  # (n,) s
    deviation: np.ndarray  # (n,) of the tool from where rigid links carry it, m
    drive_forces: Mapping[str, np.ndarray]  # (n,) by the drive's name, N or N m


def read_side(folder: Path, scene: Scene) -> Side:
    """Return a finished run with its motion, see `Side`.

    InputError where it has no summary.json or trajectory.npz, or another machine's.
    """
    path = folder / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        path = folder / "trajectory.npz"
        with np.load(path, allow_pickle=False) as data:
            forces = data["joint_forces"][:, scene.driven_columns].T
            by_drive = dict(zip(scene.driven, forces, strict=True))
            return Side(folder, scene, summary, data["t"], lengths(data["deviation"]), by_drive)
    except Exception as error:  # whatever a foreign file may raise
        raise InputError(
            f"{path}: cannot be read ({type(error).__name__}); name a finished run"
        ) from None


def before_after_page(
    before: Side, after: Side, table: Table, sections: Table | None = None
) -> str:
    """Return the page of two runs of one machine, with the table of `before_after`.

    It shows the pictures of machine and links that the runs have drawn. `sections` are straight
    members beside the run after, see `sections.sections_of`.
    """
    sides, rows = {BEFORE: before, AFTER: after}, table.frame
    on_top = rows["figure"].str.startswith(("mass of", "largest tool", "first frequency"))
    on_top &= (rows["figure"] != "mass of all arms") & rows[[BEFORE, AFTER]].notna().all(axis=1)
    return html_page(
        "before_after.html",
        title=table.title,
        sides=sides,
        cards=[
            (row.figure, f"{row.before:.4g} → {row.after:.4g} {row.unit}")
            for row in rows[on_top].itertuples()
        ],
        machines=_drawn(sides, "machine.png"),
        links=_drawn(sides, "design.png"),
        curves=_curves(sides),
        table=table,
        sections=sections,
        differing=differences(before.scene, after.scene),
        scene=after.scene,
    )


def _drawn(sides: Mapping[str, Side], name: str) -> dict[str, bytes]:
    """Return the picture of this name by the run, as far as they have one."""
    files = {label: side.folder / name for label, side in sides.items()}
    return {label: file.read_bytes() for label, file in files.items() if file.is_file()}


def _curves(sides: Mapping[str, Side]) -> Iterator[tuple[str, bytes]]:
    """Yield title and picture of deflection and drive forces over time."""
    deflections = {label: 1e3 * side.deviation for label, side in sides.items()}
    yield _plot(sides, "deflection of the tool", "deflection of the tool [mm]", deflections)
    for drive, unit in drive_units(sides[AFTER].scene).items():
        forces = {label: side.drive_forces[drive] for label, side in sides.items()}
        what = "force" if unit == "N" else "torque"
        yield _plot(sides, f"drive {drive}", f"{what} [{unit}]", forces)


def _plot(
    sides: Mapping[str, Side], title: str, label: str, y: Mapping[str, np.ndarray]
) -> tuple[str, bytes]:
    """Return curves of both runs over time, and their title."""
    lines = [Line(name, side.t, y[name]) for name, side in sides.items()]
    panel = Panel(title, "time [s]", label, lines, y_log=False)
    stream = io.BytesIO()
    panel_figure("", [[panel]], LOOKS).savefig(stream, format="png")
    return title, stream.getvalue()
