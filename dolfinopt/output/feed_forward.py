"""feed_forward.csv: joints that carry the bending arms' tip along its path; its summary."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from sys import maxsize
from typing import Any

import numpy as np

from dolfinopt.arms.arm import chain_of
from dolfinopt.disk import write_table
from dolfinopt.dynamics.build import Trajectory, simulate
from dolfinopt.dynamics.feed_forward import FeedForward, internal_rates
from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.result import RankResult
from dolfinopt.output.design import Designed
from dolfinopt.output.trajectory import UNITS, by_drive, drive_units
from dolfinopt.parallel import together
from dolfinopt.profiling import Profile
from dolfinopt.scene.csv_table import BESIDE_JOINTS
from dolfinopt.scene.load import Scene, scene_from_dict

FILE = "feed_forward.csv"
ROUNDING = 1e-6  # of an eigenvalue's real part, over its size


# -- what it is compared with --------------------------------------------------------------------


def compared(run: RankResult) -> tuple[Trajectory | None, float | None]:
    """Simulate the design without its feed-forward, and in a finer model with it (collective).

    On the root the motion without corrections, and the deviation, m, in a finer model that moves
    with them; None where that is not solved, or the scene has no feed-forward, and elsewhere.
    """
    scene = run.scene
    if not scene.feed_forward.on:
        return None, None
    held = None if run.trajectory is None else run.trajectory.feed_forward
    place = Designed(scene, run.partition, run.arms, run.x_phys)
    with run.profile.phase("feed-forward beside"):
        plain = simulated_with(place._replace(scene=with_feed_forward(scene, "none")))
        return plain, finer_deviation(place, held)


def with_feed_forward(scene: Scene, kind: str) -> Scene:
    """Return the scene with feed-forward of a kind, of its control, too."""
    data = scene.to_tree()
    data["feed_forward"] = data["feed_forward"] | {"kind": kind} if kind != "none" else {}
    if scene.control is not None and scene.control.feed_forward in ("rigid", "tip"):
        data["control"]["feed_forward"] = "tip" if kind == "tip" else "rigid"
    return scene_from_dict(data, scene.source)


def finer_deviation(design: Designed, held: FeedForward | None) -> float | None:
    """Return the largest deviation in a finer model, m, on the root (collective).

    It has twice the elastic coordinates, and geometric stiffness. None elsewhere, and where it is
    not solved.

    Args:
        design: of the model, with the number of coordinates.
        held: the model's corrections, on the root, with which the finer one moves, too.
    """
    scene = design.scene
    sizes = [
        min(2 * (arm.coordinates or 0), arm.substructure.T.num_dofs) for arm in design.arms.values()
    ]
    count = design.partition.world.allreduce(min(sizes, default=maxsize), min)
    changes = {
        "reduction": scene.reduction.unchecked_copy({"coordinates": count}),
        "simulation": scene.simulation.unchecked_copy({"stiffening": True}),
    }
    moved = simulated_with(design._replace(scene=scene.unchecked_copy(changes)), held)
    return None if moved is None else moved.max_deviation[0]


def simulated_with(design: Designed, held: FeedForward | None = None) -> Trajectory | None:
    """Return the motion of a scene with other arms' designs, on the root (collective).

    None elsewhere, and where it is not solved. The arms keep what they have.
    """
    scene, world, bodies = design.scene, design.partition.world, design.bodies()
    with together(world), suppress(ConvergenceError):
        if world.rank == 0:
            return simulate(scene, chain_of(scene, bodies), Profile(), feed_forward=held)
    return None


# -- table and summary -----------------------------------------------------------------------


def write_feed_forward(folder: Path, trajectory: Trajectory) -> None:
    """Write the corrected joints every `simulation.sample`: as `motion.file` it repeats the run.

    Columns: t, s; every driven coordinate by its name, rad or m, of joints with gears that give way
    the motor's angle over the gear ratio; its rate; the force of its drive, N m or N.
    """
    seen, scene = trajectory.sampled, trajectory.scene
    if seen.feed_forward is None:
        return
    joints = scene.driven_columns
    quantities = seen.commanded.q, seen.commanded.qd, seen.joint_forces
    columns = [values[:, joints] for values in quantities]
    header = [f"{kind}{name}" for kind in ("", *BESIDE_JOINTS) for name in scene.driven]
    write_table(folder / FILE, ["t", *header], [seen.t, *columns], 15)


def summary_of_feed_forward(
    trajectory: Trajectory, plain: Trajectory | None, finer: float | None
) -> dict[str, Any] | None:
    """Return what summary.json tells of a feed-forward, with what `compared` has; or None."""
    scene, feed_forward = trajectory.scene, trajectory.feed_forward
    if feed_forward is None:
        return None
    names, units = list(scene.rigid_units), list(scene.rigid_units.values())
    joints, splines = feed_forward.corrections.joints, feed_forward.corrections.splines
    t = np.linspace(0.0, scene.horizon, 2001)
    largest = np.abs(feed_forward.corrections.at(t)[0]).max(axis=0)
    return {
        "joints": [names[k] for k in joints],
        "lead": scene.lead,
        "knots": len(splines.knots),
        "regularity": feed_forward.regularity,
        "deviation_without": None if plain is None else plain.max_deviation[0],
        "deviation_left": feed_forward.left,
        "deviation_left_finer": finer,
        "drive_peak_without": {} if plain is None else by_drive(scene, plain.drives[0]),
        "corrections": {names[k]: float(x) for k, x in zip(joints, largest, strict=True)},
        "slowest_unstable_rate": slowest_unstable_rate(feed_forward),
        "units": {
            **UNITS["feed_forward"],
            "drive_peak_without": drive_units(scene),
            "corrections": ", ".join(units[k] for k in joints),
        },
    }


def slowest_unstable_rate(feed_forward: FeedForward) -> float | None:
    """Return that of the internal dynamics, 1/s; None where there is none, or it is not known."""
    rates = internal_rates(feed_forward)
    if rates is None:
        return None
    unstable = rates.real[rates.real > ROUNDING * np.abs(rates)]  # undamped ones are beside zero
    return float(unstable.min()) if len(unstable) else None


def lead_warnings(trajectory: Trajectory, grey: bool) -> Iterator[str]:
    """Yield that corrections would begin earlier than the lead lets them, and what to do."""
    if trajectory.feed_forward is None:
        return
    rate, lead = slowest_unstable_rate(trajectory.feed_forward), trajectory.scene.lead
    if rate is not None and 0.0 < lead < 3.0 / rate:
        cells = "nearly void cells of a grey design vibrate slowly: set design.projection, or "
        yield (
            f"feed-forward: the corrections would begin about {3e3 / rate:.2g} ms before the "
            f"motion, which feed_forward.lead = {lead:g} [s] cuts off; "
            f"{cells if grey else ''}raise it"
        )
