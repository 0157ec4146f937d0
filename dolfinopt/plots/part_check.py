"""Pictures of what parts do in the moving machine, beside the densities they were made of."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.output.views import designed
from dolfinopt.part.check import DENSITY
from dolfinopt.plots.curves import LIMIT, deviation_title
from dolfinopt.plots.stress import draw_stress
from dolfinopt.plots.style import looks, new_figure, save
from dolfinopt.responses.constraints import deviation_limits

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.part.check import Check
    from dolfinopt.scene.load import Scene


def draw_check(folder: Path, check: Check, scene: Scene) -> None:
    """Draw deviation.png and stress.png of parts into a folder."""
    save(deviation_figure(check, scene), folder / "deviation.png")
    title = f"{scene.name}: stress of the parts"
    if scene.is_spatial:
        from dolfinopt.plots.solid_stress import solid_stress_figure

        save(solid_stress_figure(designed(check.views), title), folder / "stress.png")
    else:
        draw_stress(folder / "stress.png", designed(check.views), title)


def deviation_figure(check: Check, scene: Scene) -> Figure:
    """Return the picture of the deviation over time with every form of the arms, mm.

    Below, by how much that of other forms differs from that of the densities.
    """
    figure = new_figure(9.0, 6.4, 120, laid_out=False)
    upper = figure.add_axes((0.1, 0.42, 0.88, 0.51))
    lower = figure.add_axes((0.1, 0.09, 0.88, 0.24))
    first = check.density.trajectory
    t = first.t
    styles = looks([list(check.columns)])
    for name, column in check.columns.items():
        style = styles[name] | {"marker": ""}
        own = column.trajectory
        distance = _distance(own)
        worst = int(np.argmax(distance))
        note = f"{name}: largest {distance[worst]:.4g} mm at {own.t[worst]:.3f} s"
        upper.plot(own.t, distance, label=note, **style)
        if name != DENSITY:
            base = first if np.array_equal(first.t, own.t) else first.at(own.t)
            lower.plot(own.t, distance - _distance(base), label=f"{name} less density", **style)
    for limit, since in deviation_limits(scene):
        upper.hlines(1e3 * limit, since, t[-1], color=LIMIT, ls="--", lw=1.0)
    upper.set_title(deviation_title(first), loc="left", fontsize=12)
    upper.set_ylabel("deviation [mm]")
    upper.set_ylim(0.0, None)
    lower.set_ylabel("difference [mm]")
    lower.set_xlabel("time [s]")
    for axes in (upper, lower):
        axes.set_xlim(t[0], t[-1])
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize=9, frameon=True, framealpha=0.8, edgecolor="none")
    figure.align_ylabels([upper, lower])
    return figure


def _distance(trajectory: Trajectory) -> np.ndarray:
    return 1e3 * np.asarray(np.linalg.norm(trajectory.deviation, axis=1))
