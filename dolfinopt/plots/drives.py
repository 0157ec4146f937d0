"""Picture of what moves a machine: errors and forces of its drives, force of its closure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.output.trajectory import drive_units, free_drives, rigid_units
from dolfinopt.plots.style import BLUE, LINE_WIDTH, ORANGE, PathLike, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.dynamics.simulation import Trajectory

# Unit of a quantity, its factors in the order of their size: largest value below which each serves.
SCALES = {
    "m": ((1e-3, 1e6, "µm"), (1.0, 1e3, "mm"), (np.inf, 1.0, "m")),
    "rad": ((0.1, 1e3, "mrad"), (np.inf, 1.0, "rad")),
    "N": ((1e4, 1.0, "N"), (np.inf, 1e-3, "kN")),
    "N m": ((1e4, 1.0, "N m"), (np.inf, 1e-3, "kN m")),
}


def draw_drives(path: PathLike, trajectory: Trajectory) -> Path:
    """Draw what the drives do, and what holds a closed loop, against time (PNG).

    Args:
        path: of the picture.
        trajectory: of a machine.

    Returns:
        The path.
    """
    return save(drives_figure(trajectory), path)


def drives_figure(trajectory: Trajectory) -> Figure:
    """Return the figure of `draw_drives`: a row a drive, its error and its force; then the ground.

    Errors are q_r - q_r_desired; where no drive can have one, forces stand alone.
    """
    panels = drive_panels(trajectory)
    columns = 2 if any(len(row) > 1 for row in panels) else 1
    total = 0.9 + 2.0 * len(panels)
    figure = new_figure(10.0 if columns == 2 else 9.0, total, 110, laid_out=False)
    grid = figure.subplots(len(panels), columns, sharex=True, squeeze=False)
    figure.subplots_adjust(left=0.085, right=0.965, wspace=0.22, hspace=0.32,
                           bottom=0.5 / total, top=1.0 - 0.75 / total)  # fmt: skip
    for row, quantities in zip(grid, panels, strict=True):
        # Forces stand in the last column.
        for axes, (label, unit, curves) in zip(row[::-1], quantities[::-1], strict=False):
            _draw_panel(axes, trajectory.t, label, unit, curves)
        for axes in row[: len(row) - len(quantities)]:
            axes.set_visible(False)
    for column in grid.T:
        last = [axes for axes in column if axes.get_visible()][-1]
        last.set_xlabel("time [s]")
        last.tick_params(labelbottom=True)
    title = "Drives" if trajectory.closure is None else "Drives and what holds the loop"
    figure.suptitle(title, x=0.01, y=1.0 - 0.12 / total, va="top", ha="left", fontsize=12)
    return figure


Panel = tuple[str, str, dict[str, np.ndarray]]  # label, SI unit, curves (n,) by name


def drive_panels(trajectory: Trajectory) -> list[list[Panel]]:
    """Return the rows of the figure: of every drive error and force, of the ground its force."""
    scene, rows = trajectory.scene, []
    places = range(*scene.driven_columns.indices(trajectory.q_r.shape[1]))
    error, free = trajectory.q_r - trajectory.desired.q, free_drives(scene)
    lengths, loads = rigid_units(scene), drive_units(scene)
    for name, k in zip(scene.driven, places, strict=True):
        word = "force" if loads[name] == "N" else "moment"
        row: list[Panel] = [(f"{name}: {word}", loads[name], {"": trajectory.joint_forces[:, k]})]
        if name in free:
            row.insert(0, (f"{name}: error", lengths[name], {"": error[:, k]}))
        rows.append(row)
    forces = trajectory.closure_force
    if forces is not None:
        names = ("",) if forces.shape[1] == 1 else ("x", "y")
        what = "normal force on the slider" if len(names) == 1 else "force of the pin on the arm"
        rows.append([(what, "N", dict(zip(names, forces.T, strict=True)))])
    return rows


def _draw_panel(
    axes: Axes, t: np.ndarray, label: str, unit: str, curves: dict[str, np.ndarray]
) -> None:
    """Draw one quantity against time; its largest value stands above it."""
    largest = max(float(np.abs(values).max()) for values in curves.values())
    factor, shown = next((f, name) for limit, f, name in SCALES[unit] if largest < limit)
    for (name, values), colour in zip(curves.items(), (BLUE, ORANGE), strict=False):
        axes.plot(t, factor * values, color=colour, lw=LINE_WIDTH, label=name)
    if len(curves) > 1:
        axes.legend(loc="best", frameon=False, fontsize=9, ncols=len(curves))
    axes.set_title(f"{label} [{shown}]", loc="left", y=1.0, fontsize=10, parse_math=False)
    axes.set_title(f"largest {factor * largest:.3g}", loc="right", y=1.0, fontsize=10)
    axes.axhline(0.0, color="black", lw=0.6, zorder=1.0)
    axes.set_xlim(t[0], t[-1])
    axes.grid(True, alpha=0.3)
