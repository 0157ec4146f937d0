"""Pictures of curves: history of an optimisation, deviation, drives, parts beside densities."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.motion.build import rests
from dolfinopt.multibody.kinematics import lengths
from dolfinopt.output.trajectory import drive_units, free_drives
from dolfinopt.plots.panels import Limit as Bound
from dolfinopt.plots.panels import Line, Panel, panel_figure
from dolfinopt.plots.style import INITIAL, MILLI, OPTIMISED, look, looks
from dolfinopt.progress import SHOWN
from dolfinopt.scene.duration import path_length, time_law

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolfinopt.dynamics.build import Trajectory
    from dolfinopt.optimization.result import Result
    from dolfinopt.part.check import Check
    from dolfinopt.responses.constraints import Limit
    from dolfinopt.scene.load import Scene

DEVIATION = "Deviation of the end-effector from the rigid path"
WIDE = 9.0  # inches, of a single column
TIME, MILLIMETRES = "time [s]", "deviation [mm]"


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


def history_figure(result: Result) -> Figure:
    """Return the picture of what history.csv holds against the iteration.

    Down the first column, then down the second; what is nowhere known is left out.

    Args:
        result: of an optimisation, with at least one row.
    """
    rows, limits, minimised = result.rows, _limits_told(result), result.scene.objective.response
    iteration = np.array([row.iteration for row in rows])

    def panel(
        label: str, values: Sequence[float], factor: float = 1.0, limit: float = np.nan
    ) -> Panel:
        y, is_share = factor * np.array(values), label.startswith(SHARES)
        if not is_share:  # nothing has changed yet at the first row
            y = np.where((y > 0.0) | ~(y > 0.0).any(), y, np.nan)
        shown = y[np.isfinite(y)]
        ends = " → ".join(f"{value:.4g}" for value in shown[[0, -1][: len(shown)]])
        bounds = ((factor * limit, iteration[0], iteration[-1]),) if limit == limit else ()
        line = Line("", iteration, y)
        return Panel(label, "iteration", "", (line,), y_log=not is_share, note=ends, limits=bounds)

    label = f"{minimised.label} [{minimised.unit}]"
    panels = [panel(label, [row.objective for row in rows])]
    for name, (label, factor) in HISTORY.items():
        if name != "max_deviation" or "deviation" not in rows[0].constraints:  # the same values
            panels.append(panel(label, [getattr(row, name) for row in rows], factor))
    for limit in limits:
        unit, factor = SHOWN.get(limit.unit, (limit.unit, 1.0))
        values = [row.constraints[limit.name] for row in rows]
        panels.append(panel(f"{limit.words} [{unit}]", values, factor, limit.limit))
    known = [item for item in panels if item.note]
    half = -(-len(known) // 2)
    pairs = zip_longest(known[:half], known[half:])
    return panel_figure("History of the optimisation", list(pairs), height=2.1)


def limits_figure(result: Result) -> Figure | None:
    """Return the picture of how far limits are used, and what they cost.

    Above, the share of every limit that is used over the iterations: of a lower limit it is the
    limit over the value. Below, by how many per cent the objective would be better for each per
    cent by which the limit is eased: the multiplier over the objective. None where the material
    alone is limited.

    Args:
        result: of an optimisation, with at least one row.
    """
    rows, limits = result.rows, _limits_told(result)
    if all(limit.of_mass for limit in limits):
        return None
    iteration = np.array([row.iteration for row in rows])
    objective = np.array([abs(row.objective) or 1.0 for row in rows])
    used, eased = [], []
    for limit in limits:
        value = np.array([row.constraints[limit.name] for row in rows])
        share = 100.0 * (limit.limit / value if limit.least else value / limit.limit)
        used.append(Line(limit.words, iteration, share))
        gained = np.array([row.multipliers.get(limit.name, np.nan) for row in rows]) / objective
        eased.append(Line("", iteration, gained))
    above = Panel("share of the limit that is used [%]", "iteration", "", used, y_log=True,
                  note="limit: 100 %", limits=((100.0, iteration[0], iteration[-1]),))  # fmt: skip
    words = "objective gained for 1 % of the limit [%]"
    below = Panel(words, "iteration", "", eased, y_log=False)
    return panel_figure("Limits of the design", [[above], [below]], width=WIDE)


def _limits_told(result: Result) -> list[Limit]:
    """Return the limits that the history tells of: not that of earlier versions."""
    return [limit for limit in result.limits if limit.name in result.rows[0].constraints]


# -- deviation -------------------------------------------------------------------------------


def deviation_title(trajectory: Trajectory) -> str:
    """Return what of a motion deviates from what."""
    if trajectory.closure is not None:
        return "Deviation of the slider from that of rigid arms"
    controlled = trajectory.is_machine and (trajectory.scene.control or not trajectory.loops)
    return "Deviation of the end-effector from the desired path" if controlled else DEVIATION


def deviation_figure(trajectory: Trajectory, initial: np.ndarray | None = None) -> Figure:
    """Return the picture of the end-effector's distance from its rigid or desired path.

    Args:
        trajectory: the motion.
        initial: (m, d) m, of the initial design, evenly over the same time, or None.
    """
    t = trajectory.t
    lines = [_distance("", t, trajectory.distance)]
    if initial is not None and len(initial):
        even = np.linspace(t[0], t[-1], len(initial))
        before = _distance(INITIAL, even, lengths(initial))
        lines = [before, _distance(OPTIMISED, t, trajectory.distance)]
    # The only curve looks as that of the optimised design.
    styles = {line.label: look(len(lines) - 1 - k) for k, line in enumerate(lines)}
    panel = _deviations(lines, trajectory.scene)
    return panel_figure(deviation_title(trajectory), [[panel]], styles, 4.5, WIDE)


def _distance(name: str, t: np.ndarray, distance: np.ndarray) -> Line:
    """Return a distance (n,), m, over time, its largest value marked and told with its name."""
    worst = int(np.argmax(distance))
    note = f"largest {MILLI * distance[worst]:.4g} mm at {t[worst]:.3f} s"
    return Line(": ".join(filter(None, (name, note))), t, MILLI * distance, worst)


def _deviations(lines: Sequence[Line], scene: Scene) -> Panel:
    """Return the panel of distances, mm, and of the scene's limits of them."""
    limits = deviation_limits(scene)
    return Panel("", TIME, MILLIMETRES, lines, y_log=False, limits=limits)


def check_figure(check: Check, scene: Scene) -> Figure:
    """Return the picture of the deviation over time with every form of the arms, mm.

    Below, by how much that of other forms differs from that of the densities.
    """
    first, known = check.density.trajectory, looks([list(check.columns)])
    distances, differences, styles = [], [], {}
    for name, column in check.columns.items():
        own = column.trajectory
        distances.append(_distance(name, own.t, own.distance))
        styles[distances[-1].label] = known[name]
        if column is not check.density:
            base = first if np.array_equal(first.t, own.t) else first.at(own.t)
            less = Line(f"{name} less density", own.t, MILLI * (own.distance - base.distance))
            styles[less.label] = known[name]
            differences.append(less)
    upper = _deviations(distances, scene)
    lower = Panel("", TIME, "difference [mm]", differences, y_log=False)
    return panel_figure(deviation_title(first), [[upper], [lower]], styles, width=WIDE)


# -- drives ----------------------------------------------------------------------------------

LAW_INSTANTS = 401


def drives_figure(trajectory: Trajectory) -> Figure:
    """Return the picture of a machine's drives over time, and of what holds a closed loop.

    A row a drive, its error and its force; then the closures. Errors are q_r - q_r_desired; forces
    stand alone where no drive can have one.
    """
    rows = list(_drive_rows(trajectory))
    columns = max(map(len, rows))
    title = "Drives" if trajectory.loops is None else "Drives and what holds the loop"
    return panel_figure(title, [[*[None] * (columns - len(row)), *row] for row in rows])


def _drive_rows(trajectory: Trajectory) -> Iterator[list[Panel]]:
    """Yield the panels of every drive's error and force, and of what holds every closed loop."""

    def panel(label: str, unit: str, values: np.ndarray) -> Panel:
        shown, factor = SHOWN.get(unit, (unit, 1.0))
        return _over_time(f"{label} [{shown}]", Line("", trajectory.t, factor * values))

    scene, words = trajectory.scene, {"N": "force", "N m": "moment"}
    error, free = trajectory.q_r - trajectory.desired.q, free_drives(scene)
    for (name, unit), k in zip(drive_units(scene).items(), scene.driven_columns, strict=True):
        row = [panel(f"{name}: {words[unit]}", unit, trajectory.joint_forces[:, k])]
        if name in free:
            row.insert(0, panel(f"{name}: error", scene.rigid_units[name], error[:, k]))
        yield row
    for name, sizes in trajectory.closure_sizes.items():
        if name not in scene.driven:  # a driven rod's is its drive's
            yield [panel(f"{name}: {words[unit]}", unit, size) for unit, size in sizes.items()]


def _over_time(label: str, *lines: Line) -> Panel:
    """Return curves over time under a label, with the largest value of the first one."""
    note = f"largest {np.abs(lines[0].y).max():.3g}"
    return Panel(label, TIME, "", lines, y_log=False, note=note)


# -- the law of the motion -----------------------------------------------------------------------


def law_figure(scene: Scene) -> Figure:
    """Return the picture of a designed law: way, speed and acceleration, with those before."""
    motion = scene.motion
    t = np.linspace(0.0, motion.duration, LAW_INSTANTS)
    length = 1.0 if motion.path == "rotation" else path_length(motion)
    units = ("-", "1/s", "1/s2") if motion.path == "rotation" else ("m", "m/s", "m/s2")
    plain = time_law(motion.unchecked_copy({"shape": 0}))(t, motion.duration)
    designed = time_law(motion)(t, motion.duration)
    rows = []
    for k, word in enumerate(("way", "speed", "acceleration")):
        pairs = ("designed", length * designed[k]), (motion.law, length * plain[k])
        lines = (Line(name * (k == 0), t, values) for name, values in pairs)
        rows.append([_over_time(f"{word} [{units[k]}]", *lines)])
    return panel_figure("Law along the path", rows, width=WIDE)


# -- limits over time ---------------------------------------------------------------------------


def deviation_limits(scene: Scene) -> list[Bound]:
    """Return the limits of the deviation, mm, with first and last instant of each, s."""
    limits = []
    if (deviation := scene.constraints.limit("deviation")) is not None:
        limits.append((MILLI * deviation, scene.lead, scene.horizon))
    if (settling := scene.constraints.limit("settling")) is not None:
        lead = scene.lead
        limits += [(MILLI * settling, lead + begin, lead + end) for begin, end in rests(scene)]
    return limits
