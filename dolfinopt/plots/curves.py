"""Pictures of curves: the history of an optimisation, and the deviation against time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.multibody.end_effector import lengths
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.plots.style import (
    BLUE,
    INITIAL,
    LINE_WIDTH,
    OPTIMISED,
    PathLike,
    log_scale,
    look,
    look_numbers,
    new_figure,
    save,
    spread,
)
from dolfinopt.responses.constraints import constraint_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.dynamics.simulation import Trajectory

DEVIATION = "Deviation of the end-effector from the rigid path"
OF_CONTROL = "Deviation of the end-effector from the desired path"
OF_SLIDER = "Deviation of the slider from that of rigid arms"
LIMIT = "0.35"  # colour of limits
FEW = 40  # points a line that get markers


def draw_history(
    path: PathLike,
    rows: Sequence[HistoryRow],
    objective_label: str,
    limits: Mapping[str, float] | None = None,
) -> Path:
    """Draw what history.csv holds against the iteration (PNG).

    Args:
        path: of the picture.
        rows: at least one.
        objective_label: name and unit of the objective.
        limits: of constraints by their column, see `constraints.limits_by_column`.

    Returns:
        The path.
    """
    return save(history_figure(rows, objective_label, limits), path)


def history_figure(
    rows: Sequence[HistoryRow], objective_label: str, limits: Mapping[str, float] | None = None
) -> Figure:
    """Return the figure of `draw_history`: panels in two columns that share the iteration."""
    from matplotlib.ticker import MaxNLocator

    panels = history_panels(rows, objective_label)
    height = -(-len(panels) // 2)
    total = 0.9 + 2.2 * height
    figure = new_figure(10.0, total, 110, laid_out=False)
    grid = figure.subplots(height, 2, sharex=True, squeeze=False)
    # Fixed margins, inches: there is nothing to be found out by drawing twice.
    figure.subplots_adjust(left=0.075, right=0.985, wspace=0.17, hspace=0.32,
                           bottom=0.5 / total, top=1.0 - 0.75 / total)  # fmt: skip
    iteration = np.array([row.iteration for row in rows])
    bounds = {}
    for name, limit in (limits or {}).items():
        label, factor = _drawn(name)
        bounds[label] = factor * limit
    ordered = grid.T.ravel()  # down the first column, then down the second
    for axes, (label, values) in zip(ordered, panels.items()):
        _draw_history_panel(axes, iteration, values, label, bounds.get(label))
    for axes in ordered[len(panels) :]:
        axes.set_visible(False)
    for column in (grid[:, 0], grid[:, 1]):
        last = [axes for axes in column if axes.get_visible()][-1]
        last.set_xlabel("iteration")
        last.tick_params(labelbottom=True)
    grid[0, 0].set_xlim(iteration[0], max(iteration[-1], iteration[0] + 1))
    grid[0, 0].xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    figure.suptitle("History of the optimisation", x=0.01, y=1.0 - 0.12 / total, va="top",
                    ha="left", fontsize=12)  # fmt: skip
    return figure


# Columns of the history in the order of their panels: label, factor.
HISTORY = {
    "max_deviation": ("maximal deviation [mm]", 1e3),
    "grayness": ("grayness [-]", 1.0),
    "volume_fraction": ("volume fraction [-]", 1.0),
    "change": ("largest change of the design [-]", 1.0),
    "kkt": ("Karush-Kuhn-Tucker residual [-]", 1.0),
}
SHARES = ("grayness", "volume fraction")  # from 0 to 1, on one linear scale, also arm by arm
# Units of constraints in pictures: ending of the label, its replacement, factor.
DRAWN = ((" [m]", " [mm]", 1e3), (" [Pa]", " [MPa]", 1e-6))


def _drawn(constraint: str) -> tuple[str, float]:
    """Return label and factor of a constraint's panel."""
    label = constraint_label(constraint)
    for unit, drawn, factor in DRAWN:
        if label.endswith(unit):
            return label.removesuffix(unit) + drawn, factor
    return label, 1.0


def history_panels(rows: Sequence[HistoryRow], objective_label: str) -> dict[str, np.ndarray]:
    """Return label and values (n,) of every panel; what the rows do not have is left out.

    A mapping of numbers in a row (constraints by name) gives a panel for each of its keys.
    """
    known = {"iteration", "objective", "seconds", *HISTORY}
    panels = {objective_label: np.array([row.objective for row in rows])}
    for name, (label, factor) in HISTORY.items():
        limited = name == "max_deviation" and "deviation" in getattr(rows[0], "constraints", {})
        if hasattr(rows[0], name) and not limited:  # its limit has a panel of the same values
            panels[label] = factor * _numbers([getattr(row, name) for row in rows])
    for name, value in vars(rows[0]).items():
        if isinstance(value, Mapping):
            for key in value:
                label, factor = _drawn(str(key))
                panels[label] = factor * _numbers([getattr(row, name).get(key) for row in rows])
        elif name not in known and isinstance(value, (int, float)):
            panels[name.replace("_", " ")] = _numbers([getattr(row, name) for row in rows])
    return {label: v for label, v in panels.items() if np.isfinite(v).any()}


def _numbers(values: Sequence[float | None]) -> np.ndarray:
    return np.array([np.nan if value is None else float(value) for value in values])


def _draw_history_panel(
    axes: Axes, iteration: np.ndarray, values: np.ndarray, label: str, limit: float | None = None
) -> None:
    """Draw one quantity, and its limit as a broken line; first and last value stand above it."""
    linear = label.startswith(SHARES)
    positive = values > 0.0
    if not linear:  # nothing has changed yet at the first row; zero has no logarithm
        values = np.where(positive, values, np.nan) if positive.any() else values
    marker = "o" if len(values) <= FEW else ""
    axes.plot(iteration, values, color=BLUE, marker=marker, ms=3, lw=LINE_WIDTH, clip_on=False)
    axes.set_title(label, loc="left", y=1.0, fontsize=10, parse_math=False)
    finite = values[np.isfinite(values)]
    if limit is not None:
        axes.axhline(limit, color=LIMIT, ls="--", lw=1.0)
    if len(finite):
        ends = f"{finite[0]:.4g}" if len(finite) == 1 else f"{finite[0]:.4g} → {finite[-1]:.4g}"
        axes.set_title(ends, loc="right", y=1.0, fontsize=10)
    axes.grid(True, alpha=0.3)
    if limit is not None and len(finite):
        finite = np.append(finite, limit)
    if linear:
        axes.set_ylim(0.0, 1.05 * max(1e-3, *finite))
    elif len(finite) and finite.min() > 0.0:
        log_scale(axes, finite)
        if finite.max() <= 1.02 * finite.min():  # nothing but digits that do not matter
            middle = float(np.sqrt(finite.min() * finite.max()))
            axes.set_ylim(0.5 * middle, 2.0 * middle)


def draw_deviation(
    path: PathLike,
    t: np.ndarray,
    deviation: np.ndarray,
    initial_deviation: np.ndarray | None = None,
    title: str = DEVIATION,
    limits: Sequence[tuple[float, float]] = (),
) -> Path:
    """Draw the end-effector's distance from its rigid or desired path against time (PNG).

    Args:
        path: of the picture.
        t: (n,) s.
        deviation: (n, 2) m.
        initial_deviation: (m, 2) m, of the initial design, evenly over the same time, or None.
        title: above the picture, of what from what.
        limits: m, and the instant from which each holds, s.

    Returns:
        The path.
    """
    return save(deviation_figure(t, deviation, initial_deviation, title, limits), path)


def deviation_title(trajectory: Trajectory) -> str:
    """Return what of a motion deviates from what."""
    if trajectory.closure is not None:
        return OF_SLIDER
    return OF_CONTROL if trajectory.is_machine else DEVIATION


def deviation_figure(
    t: np.ndarray,
    deviation: np.ndarray,
    initial_deviation: np.ndarray | None,
    title: str = DEVIATION,
    limits: Sequence[tuple[float, float]] = (),
) -> Figure:
    """Return the figure of `draw_deviation`; what a curve is stands at its peak."""
    figure = new_figure(9.0, 5.0, 120, laid_out=False)
    axes = figure.add_axes((0.1, 0.11, 0.88, 0.81))  # room for ticks such as 0.00025
    curves = [("", t, deviation)]
    if initial_deviation is not None:
        times = np.linspace(t[0], t[-1], len(initial_deviation))
        curves = [(INITIAL, times, initial_deviation), (OPTIMISED, t, deviation)]
    distances = [1e3 * lengths(vectors) for _, _, vectors in curves]
    largest = [float(d.max()) for d in distances] + [1e3 * limit for limit, _ in limits]
    top = 1.1 * max(largest) or 1.0
    heights = spread([float(d.max()) / top for d in distances], 0.07)
    # A curve alone looks like the optimised design's.
    numbers = look_numbers([[label for label, _, _ in curves]]) if len(curves) > 1 else {"": 0}
    for (label, times, _), distance, height in zip(curves, distances, heights, strict=True):
        worst = int(np.argmax(distance))
        style = look(numbers[label]) | {"marker": "o", "markevery": [worst], "clip_on": False}
        axes.plot(times, distance, label=label, **style)
        when = float(times[worst])
        late = when > 0.5 * (t[0] + t[-1])
        note = f"{label}: largest" if label else "largest"
        axes.annotate(
            f"{note} {distance[worst]:.3g} mm at {when:.3f} s",
            xy=(when, distance[worst]),
            xytext=((when - t[0]) / (t[-1] - t[0]) + (-0.02 if late else 0.02), height + 0.02),
            textcoords="axes fraction",
            ha="right" if late else "left",
            fontsize=10,
            color=style["color"],
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
        )
    for limit, since in limits:
        axes.hlines(1e3 * limit, since, t[-1], color=LIMIT, ls="--", lw=1.0)
    axes.set(xlim=(t[0], t[-1]), ylim=(0.0, top), xlabel="time [s]")
    axes.set_ylabel("deviation [mm]")
    axes.set_title(title, loc="left", fontsize=12)
    axes.grid(True, alpha=0.3)
    return figure
