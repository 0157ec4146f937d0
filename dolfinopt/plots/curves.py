"""Pictures of curves: history of an optimisation, deviation, drives, parts beside densities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from dolfinopt.motion.build import rests
from dolfinopt.multibody.kinematics import lengths
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.output.trajectory import drive_units, free_drives
from dolfinopt.plots.style import (
    BLUE,
    FEW_POINTS,
    INITIAL,
    LEFT,
    MILLI,
    OPTIMISED,
    ORANGE,
    TITLE,
    headline,
    log_scale,
    look,
    looks,
    new_figure,
    shortened,
    styled,
)
from dolfinopt.progress import SHOWN
from dolfinopt.responses.constraints import Limit
from dolfinopt.responses.response import constraints_of
from dolfinopt.scene.duration import path_length, time_law

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.dynamics.build import Trajectory
    from dolfinopt.part.check import Check
    from dolfinopt.scene.load import Scene

DEVIATION = "Deviation of the end-effector from the rigid path"
LIMIT = "0.35"  # colour of limits


def panel_grid(used: np.ndarray, title: str, abscissa: str) -> tuple[Figure, np.ndarray]:
    """Return a figure with panels that share x, and their axes (rows, columns).

    Args:
        used: (rows, columns) which panels there are.
        title: above them.
        abscissa: label of x, below the last panel of every column.
    """
    rows, columns = used.shape
    width, height = 5.0 * columns if columns > 1 else 9.0, 0.9 + 2.1 * rows
    figure = new_figure(width, height)
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    # Fixed margins, inches: there is nothing to be found out by drawing twice.
    figure.subplots_adjust(left=LEFT / width, right=1.0 - 0.25 / width, wspace=0.2, hspace=0.32,
                           bottom=0.5 / height, top=1.0 - 0.75 / height)  # fmt: skip
    for axes, there in zip(grid.ravel(), used.ravel(), strict=True):
        axes.set_visible(there)
        axes.grid(True, alpha=0.3)
    for column, there in zip(grid.T, used.T, strict=True):
        for last in column[there][-1:]:
            last.set_xlabel(abscissa)
            last.tick_params(labelbottom=True)
    headline(figure, title, 0.15)
    return figure, grid


def _head(axes: Axes, label: str, note: str) -> None:
    """Write what a panel shows above it on the left, and its figures on the right."""
    axes.set_title(label)
    axes.set_title(note, loc="right")


# -- history ---------------------------------------------------------------------------------


# Columns of the history in the order of their panels: label, factor.
HISTORY = {
    "max_deviation": ("maximal deviation [mm]", MILLI),
    "grayness": ("grayness [-]", 1.0),
    "volume_fraction": ("volume fraction [-]", 1.0),
    "change": ("largest change of the design [-]", 1.0),
    "kkt": ("Karush-Kuhn-Tucker residual [-]", 1.0),
    "merit": ("merit: objective and excesses of limits [-]", 1.0),
}
SHARES = ("grayness", "volume fraction")  # from 0 to 1, on one linear scale, also arm by arm
Limits = Mapping[str, Limit]  # by their columns of history.csv, see `limits_by_column`


def history_of(scene: Scene, rows: Sequence[HistoryRow]) -> Figure:
    """Return the picture of `history_figure` of a scene's optimisation, with its limits."""
    minimised = scene.objective.response
    limits = limits_by_column(scene, rows[0].constraints)
    return history_figure(rows, f"{minimised.label} [{minimised.unit}]", limits)


@styled
def history_figure(rows: Sequence[HistoryRow], objective_label: str, limits: Limits) -> Figure:
    """Return the picture of what history.csv holds against the iteration.

    Args:
        rows: at least one.
        objective_label: name and unit of the objective.
        limits: of the constraints.
    """
    panels = history_panels(rows, objective_label, limits)
    used = np.arange(2 * (-(-len(panels) // 2))).reshape(2, -1).T < len(panels)
    figure, grid = panel_grid(used, "History of the optimisation", "iteration")
    iteration = np.array([row.iteration for row in rows])
    # Down the first column, then down the second.
    for axes, (label, panel) in zip(grid.T.ravel(), panels.items(), strict=False):
        _draw_history_panel(axes, iteration, label, *panel)
    grid[0, 0].set_xlim(iteration[0], max(iteration[-1], iteration[0] + 1))
    grid[0, 0].xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    return figure


def history_panels(
    rows: Sequence[HistoryRow], objective_label: str, limits: Limits
) -> dict[str, tuple[np.ndarray, float | None]]:
    """Return values (n,) and limit of every panel by its label; what is nowhere known is left out.

    Both are in the unit that the label tells.
    """
    panels: dict[str, tuple[np.ndarray, float | None]] = {}
    panels[objective_label] = np.array([row.objective for row in rows]), None
    for name, (label, factor) in HISTORY.items():
        if name != "max_deviation" or "deviation" not in limits:  # a panel of the same values
            panels[label] = factor * np.array([getattr(row, name) for row in rows]), None
    for name, limit in limits.items():
        unit, factor = SHOWN.get(limit.unit, (limit.unit, 1.0))
        values = factor * np.array([row.constraints.get(name, np.nan) for row in rows])
        panels[f"{limit.words} [{unit}]"] = values, factor * limit.limit
    return {label: panel for label, panel in panels.items() if np.isfinite(panel[0]).any()}


def _draw_history_panel(
    axes: Axes, iteration: np.ndarray, label: str, values: np.ndarray, limit: float | None
) -> None:
    """Draw one quantity, and its limit as a broken line; first and last value stand above it.

    Args:
        axes: the panel's.
        iteration: (n,).
        label: name and unit.
        values: (n,) in that unit; nan where it is not known.
        limit: in the same unit; None of what has no limit.
    """
    is_share, positive = label.startswith(SHARES), values > 0.0
    if not is_share and positive.any():  # nothing has changed yet at the first row
        values = np.where(positive, values, np.nan)
    marker = "o" if len(values) <= FEW_POINTS else ""
    axes.plot(iteration, values, color=BLUE, marker=marker, ms=3, clip_on=False)
    shown = values[np.isfinite(values)]
    _head(axes, label, " → ".join(f"{value:.4g}" for value in shown[[0, -1][: len(shown)]]))
    if limit is not None:
        axes.axhline(limit, color=LIMIT, ls="--", lw=1.0)
        shown = np.append(shown, limit)
    if is_share:
        axes.set_ylim(0.0, 1.05 * max(1e-3, *shown))
    elif shown.min() > 0.0:
        log_scale(axes, shown)
        if shown.max() <= 1.02 * shown.min():  # nothing but digits that do not matter
            middle = float(np.sqrt(shown.min() * shown.max()))
            axes.set_ylim(0.5 * middle, 2.0 * middle)


@styled
def limits_figure(scene: Scene, rows: Sequence[HistoryRow]) -> Figure | None:
    """Return the picture of how far limits are used, and what they cost.

    Above, the share of every limit that is used over the iterations: of a lower limit it is the
    limit over the value. Below, by how many per cent the objective would be better for each per
    cent by which the limit is eased: the multiplier over the objective. None where the material
    alone is limited.
    """
    limits = limits_by_column(scene, rows[0].constraints)
    if all(limit.of_mass for limit in limits.values()):
        return None
    figure, grid = panel_grid(np.ones((2, 1), dtype=bool), "Limits of the design", "iteration")
    above, below = grid[:, 0]
    iteration = [row.iteration for row in rows]
    objective = np.array([abs(row.objective) or 1.0 for row in rows])
    every = []
    for number, (name, limit) in enumerate(limits.items()):
        value = np.array([row.constraints[name] for row in rows])
        used = 100.0 * (limit.limit / value if limit.least else value / limit.limit)
        eased = np.array([row.multipliers.get(name, np.nan) for row in rows]) / objective
        style: Any = look(number) | {"markevery": max(1, len(rows) // 10)}
        above.plot(iteration, used, label=shortened(limit.words), **style)
        below.plot(iteration, eased, **style)
        every.append(used)
    log_scale(above, np.append(np.concatenate(every), 100.0))
    above.axhline(100.0, color=LIMIT, ls="--", lw=1.0)
    above.legend(ncols=3)
    _head(above, "share of the limit that is used [%]", "limit: 100 %")
    _head(below, "objective gained for 1 % of the limit [%]", "")
    below.set_ylim(bottom=0.0)
    above.set_xlim(iteration[0], max(iteration[-1], iteration[0] + 1))
    return figure


# -- deviation -------------------------------------------------------------------------------


def deviation_of(trajectory: Trajectory, initial: np.ndarray | None) -> Figure:
    """Return the picture of `deviation_figure` of a motion, with its scene's limits."""
    title, limits = deviation_title(trajectory), deviation_limits(trajectory.scene)
    return deviation_figure(trajectory.t, trajectory.deviation, initial, title, limits)


def deviation_title(trajectory: Trajectory) -> str:
    """Return what of a motion deviates from what."""
    if trajectory.closure is not None:
        return "Deviation of the slider from that of rigid arms"
    controlled = trajectory.is_machine and (trajectory.scene.control or not trajectory.loops)
    return "Deviation of the end-effector from the desired path" if controlled else DEVIATION


@styled
def deviation_figure(
    t: np.ndarray,
    deviation: np.ndarray,
    initial: np.ndarray | None = None,
    title: str = DEVIATION,
    limits: Sequence[tuple[float, float, float]] = (),
) -> Figure:
    """Return the picture of the end-effector's distance from its rigid or desired path.

    Args:
        t: (n,) s.
        deviation: (n, d) m.
        initial: (m, d) m, of the initial design, evenly over the same time, or None.
        title: above the picture, of what from what.
        limits: m, each with the first and the last instant at which it holds, s.
    """
    figure = new_figure(9.0, 5.0)
    axes = figure.add_axes((0.1, 0.11, 0.88, 0.81))  # room for ticks such as 0.00025
    curves = {"": (t, deviation)}
    if initial is not None and len(initial):
        even = np.linspace(t[0], t[-1], len(initial))
        curves = {INITIAL: (even, initial), OPTIMISED: (t, deviation)}
    styles = looks([list(curves)]) if len(curves) > 1 else {"": look(0)}  # as the optimised design
    for name, (times, vectors) in curves.items():
        _draw_distance(axes, name, times, MILLI * lengths(vectors), styles[name])
    _over_time(axes, t, "deviation [mm]", limits)
    axes.set(ylim=(0.0, 1.1 * axes.dataLim.y1 or 1.0), xlabel="time [s]")
    axes.set_title(title, fontsize=TITLE)
    axes.legend()
    return figure


def _draw_distance(
    axes: Axes, name: str, t: np.ndarray, distance: np.ndarray, style: Mapping[str, Any]
) -> None:
    """Draw a distance, its largest value marked and told in the legend.

    Args:
        axes: where.
        name: of the design or form; "" of a single one.
        t: (n,) s.
        distance: (n,) mm.
        style: of the curve, see `look`.
    """
    worst = int(np.argmax(distance))
    note = f"largest {distance[worst]:.4g} mm at {t[worst]:.3f} s"
    mark = {"marker": "o", "markevery": [worst], "clip_on": False}
    axes.plot(t, distance, label=": ".join(filter(None, (name, note))), **{**style, **mark})


@styled
def check_figure(check: Check, scene: Scene) -> Figure:
    """Return the picture of the deviation over time with every form of the arms, mm.

    Below, by how much that of other forms differs from that of the densities.
    """
    figure = new_figure(9.0, 6.4)
    upper = figure.add_axes((0.1, 0.42, 0.88, 0.51))
    lower = figure.add_axes((0.1, 0.09, 0.88, 0.24))
    first, styles = check.density.trajectory, looks([list(check.columns)])
    for name, column in check.columns.items():
        own = column.trajectory
        distance = MILLI * own.distance
        _draw_distance(upper, name, own.t, distance, styles[name])
        if column is not check.density:
            base = first if np.array_equal(first.t, own.t) else first.at(own.t)
            less, style = distance - MILLI * base.distance, styles[name] | {"marker": ""}
            lower.plot(own.t, less, label=f"{name} less density", **style)
    _over_time(upper, first.t, "deviation [mm]", deviation_limits(scene))
    _over_time(lower, first.t, "difference [mm]")
    upper.set_title(deviation_title(first), fontsize=TITLE)
    upper.set_ylim(0.0, None)
    lower.set_xlabel("time [s]")
    for axes in (upper, lower):
        axes.legend()
    figure.align_ylabels([upper, lower])
    return figure


def _over_time(
    axes: Axes, t: np.ndarray, label: str, limits: Sequence[tuple[float, float, float]] = ()
) -> None:
    """Label lengths over time, and draw their limits as broken lines.

    Args:
        axes: where.
        t: (n,) s.
        label: of y.
        limits: m, each with the first and the last instant at which it holds, s.
    """
    for limit, first, last in limits:
        axes.hlines(MILLI * limit, first, last, color=LIMIT, ls="--", lw=1.0)
    axes.set(xlim=(t[0], t[-1]), ylabel=label)
    axes.grid(True, alpha=0.3)


# -- drives ----------------------------------------------------------------------------------

# Unit of a quantity, its factors in the order of their size: largest value below which each serves.
LAW_INSTANTS = 401
SCALES = {
    "m": ((1e-3, 1e6, "µm"), (1.0, 1e3, "mm"), (np.inf, 1.0, "m")),
    "rad": ((0.1, 1e3, "mrad"), (np.inf, 1.0, "rad")),
    "N": ((1e4, 1.0, "N"), (np.inf, 1e-3, "kN")),
    "N m": ((1e4, 1.0, "N m"), (np.inf, 1e-3, "kN m")),
}


@styled
def drives_figure(trajectory: Trajectory) -> Figure:
    """Return the picture of a machine's drives over time, and of what holds a closed loop.

    A row a drive, its error and its force; then the ground. Errors are q_r - q_r_desired; where no
    drive can have one, forces stand alone.
    """
    panels = drive_panels(trajectory)
    columns = max(map(len, panels))
    used = np.array([[k >= columns - len(row) for k in range(columns)] for row in panels])
    title = "Drives" if trajectory.loops is None else "Drives and what holds the loop"
    figure, grid = panel_grid(used, title, "time [s]")
    t = trajectory.t
    quantities = [quantity for row in panels for quantity in row]
    for axes, (label, unit, curves) in zip(grid[used], quantities, strict=True):
        largest = max(float(np.abs(values).max()) for values in curves.values())
        factor, shown = next((f, name) for limit, f, name in SCALES[unit] if largest < limit)
        for (name, values), colour in zip(curves.items(), (BLUE, ORANGE), strict=False):
            axes.plot(t, factor * values, color=colour, label=name)
        if len(curves) > 1:
            axes.legend(ncols=len(curves))
        axes.axhline(0.0, color="black", lw=0.6, zorder=1.0)
        axes.set_xlim(t[0], t[-1])
        _head(axes, f"{label} [{shown}]", f"largest {factor * largest:.3g}")
    return figure


Panel = tuple[str, str, dict[str, np.ndarray]]  # label, SI unit, curves (n,) by name


def drive_panels(trajectory: Trajectory) -> list[list[Panel]]:
    """Return the rows of the figure: of every drive error and force, of the ground its force."""
    scene, rows = trajectory.scene, []
    places = map(int, np.arange(scene.num_rigid)[scene.driven_columns])
    error, free = trajectory.q_r - trajectory.desired.q, free_drives(scene)
    units, loads = scene.rigid_units, drive_units(scene)
    for name, k in zip(scene.driven, places, strict=True):
        word = "force" if loads[name] == "N" else "moment"
        row: list[Panel] = [(f"{name}: {word}", loads[name], {"": trajectory.joint_forces[:, k]})]
        if name in free:
            row.insert(0, (f"{name}: error", units[name], {"": error[:, k]}))
        rows.append(row)
    forces = trajectory.closure_force
    if forces is None:
        return rows
    if trajectory.closure is not None:
        names = ("",) if forces.shape[1] == 1 else ("x", "y")
        what = "normal force on the slider" if len(names) == 1 else "force of the pin on the arm"
        return [*rows, [(what, "N", dict(zip(names, forces.T, strict=True)))]]
    for name, sizes in trajectory.closure_sizes.items():
        words = {"N": "force", "N m": "moment"}
        row = [(f"{name}: {words[unit]}", unit, {"": size}) for unit, size in sizes.items()]
        rows += [row] if name not in scene.driven else []  # a driven rod's is its drive's
    return rows


# -- the law of the motion -----------------------------------------------------------------------


@styled
def law_figure(scene: Scene) -> Figure:
    """Return the picture of a designed law: way, speed and acceleration, with those before."""
    motion = scene.motion
    plain = motion.unchecked_copy({"shape": 0})
    figure, grid = panel_grid(np.ones((3, 1), dtype=bool), "Law along the path", "time [s]")
    t = np.linspace(0.0, motion.duration, LAW_INSTANTS)
    length = 1.0 if motion.path == "rotation" else path_length(motion)
    units = ("-", "1/s", "1/s2") if motion.path == "rotation" else ("m", "m/s", "m/s2")
    laws = {"designed": time_law(motion), motion.law: time_law(plain)}
    values = {name: law(t, motion.duration) for name, law in laws.items()}
    for k, word in enumerate(("way", "speed", "acceleration")):
        axes = grid[k, 0]
        for (name, value), colour in zip(values.items(), (BLUE, ORANGE), strict=False):
            axes.plot(t, length * value[k], color=colour, label=name)
        axes.set_xlim(t[0], t[-1])
        largest = length * np.abs(values["designed"][k]).max()
        _head(axes, f"{word} [{units[k]}]", f"largest {largest:.3g}")
    grid[0, 0].legend()
    return figure


# -- limits by the columns of the history, and over time ----------------------------------------


def limits_by_column(scene: Scene, values: Mapping[str, float]) -> dict[str, Limit]:
    """Return the limits of constraints whose values are given by their columns of history.csv."""
    result: dict[str, Limit] = {}
    for item in constraints_of(scene):
        key, lower = item.name, item.response.declared.lower
        own = [column for column in values if column == key or column.startswith(f"{key}_")]
        for column, limit in zip(own, np.broadcast_to(item.limit, len(own)), strict=True):
            arm = column[len(key) + 1 :]
            unit = item.response.unit_of(arm)
            result[column] = Limit(key, arm, values[column], float(limit), unit, lower)
    return result


def deviation_limits(scene: Scene) -> list[tuple[float, float, float]]:
    """Return the limits of the deviation, m, with first and last instant of each, s."""
    limits = []
    if (deviation := scene.constraints.limit("deviation")) is not None:
        limits.append((deviation, scene.lead, scene.horizon))
    if (settling := scene.constraints.limit("settling")) is not None:
        lead = scene.lead
        limits += [(settling, lead + begin, lead + end) for begin, end in rests(scene)]
    return limits
