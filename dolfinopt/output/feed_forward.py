"""feed_forward.csv: joints that carry the bending arms' tip along its path; its summary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.disk import write_table
from dolfinopt.dynamics.feed_forward import FeedForward, internal_rates
from dolfinopt.scene.csv_table import BESIDE_JOINTS
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.dynamics.build import Trajectory

FILE = "feed_forward.csv"


def write_feed_forward(folder: Path, trajectory: Trajectory) -> None:
    """Write the corrected joints every `simulation.sample`: as `motion.file` it repeats the run.

    Columns: t, s; every driven coordinate by its name, rad or m, of joints with gears that give way
    the motor's angle over the gear ratio; its rate; the force of its drive, N m or N.
    """
    seen, scene = trajectory.sampled, trajectory.scene
    if seen.feed_forward is None:
        return
    joints = np.arange(scene.num_rigid)[scene.driven_columns]
    rate, drive = BESIDE_JOINTS
    columns = [seen.t, seen.commanded.q[:, joints], seen.commanded.qd[:, joints]]
    header = ["t", *scene.driven, *(f"{rate}{name}" for name in scene.driven)]
    columns.append(seen.joint_forces[:, joints])
    header += [f"{drive}{name}" for name in scene.driven]
    write_table(folder / FILE, header, columns, 15)


def summary_of_feed_forward(scene: Scene, found: FeedForward | None) -> dict[str, Any] | None:
    """Return what summary.json tells of a feed-forward; None without."""
    if found is None:
        return None
    names, units = list(scene.rigid_units), list(scene.rigid_units.values())
    joints, splines = found.corrections.joints, found.corrections.splines
    largest = np.abs(found.corrections.at(np.linspace(0.0, scene.horizon, 2001))[0]).max(axis=0)
    return {
        "joints": [names[k] for k in joints],
        "lead": scene.lead,
        "knots": len(splines.knots),
        "regularity": found.regularity,
        "deviation_without": found.before,
        "deviation_left": found.left,
        "corrections": {names[k]: float(x) for k, x in zip(joints, largest, strict=True)},
        "slowest_unstable_rate": slowest_unstable_rate(found),
        "units": {
            "lead": "s",
            "knots": "-",
            "regularity": "-",
            "deviation_without": "m",
            "deviation_left": "m",
            "corrections": ", ".join(units[k] for k in joints),
            "slowest_unstable_rate": "1/s",
        },
    }


def slowest_unstable_rate(found: FeedForward) -> float | None:
    """Return that of the internal dynamics, 1/s; None where there is none, or it is not known."""
    rates = internal_rates(found)
    unstable = rates.real[rates.real > 0.0] if rates is not None else np.zeros(0)
    return float(unstable.min()) if len(unstable) else None


def lead_warnings(trajectory: Trajectory | None, grey: bool) -> list[str]:
    """Return that corrections would begin earlier than the lead lets them, and what to do."""
    if trajectory is None or trajectory.feed_forward is None:
        return []
    rate, lead = slowest_unstable_rate(trajectory.feed_forward), trajectory.scene.lead
    if rate is None or not 0.0 < lead < 3.0 / rate:
        return []
    cells = "nearly void cells of a grey design vibrate slowly: set design.projection, or "
    return [
        f"feed-forward: the corrections would begin about {3e3 / rate:.2g} ms before the motion, "
        f"which feed_forward.lead = {lead:g} [s] cuts off; {cells if grey else ''}raise it"
    ]
