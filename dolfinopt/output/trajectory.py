"""trajectory.npz and trajectory.csv: the sampled motion, and the units of its columns."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.disk import write_arrays, write_text
from dolfinopt.multibody.motion import CART
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.dynamics.simulation import Trajectory


def write_trajectory(
    folder: Path, trajectory: Trajectory, initial: np.ndarray | None = None
) -> None:
    """Write trajectory.npz and trajectory.csv; their units stand in `trajectory_units`.

    Args:
        folder: where.
        trajectory: what.
        initial: (n, 2) deviation of the initial design, m, kept for the picture.
    """
    arrays = {
        "t": trajectory.t,
        "q_r": trajectory.q_r,
        "q_e": trajectory.q_e,
        "deviation": trajectory.deviation,
        "compliance": trajectory.compliance,
        "joint_forces": trajectory.joint_forces,
    }
    if initial is not None:
        arrays["initial_deviation"] = initial
    scene = trajectory.scene
    units = {
        "t": "s",
        "q_r": ", ".join(("m", *["rad"] * len(scene.arms))),
        "q_e": "m or rad: times V is a displacement in m",
        "deviation": "m",
        "compliance": "N m",
        "joint_forces": ", ".join(drive_units(scene).values()),
        "initial_deviation": "m",
    }
    arrays["units"] = np.array([f"{name}: {units[name]}" for name in arrays])
    write_arrays(folder / "trajectory.npz", arrays)
    distance = np.hypot(*trajectory.deviation.T)
    table = np.column_stack(
        [
            trajectory.t,
            trajectory.deviation,
            distance,
            trajectory.compliance.sum(axis=1),
            trajectory.q_r,
            trajectory.q_e,
            trajectory.compliance,
            trajectory.joint_forces,
        ]
    )
    header = list(trajectory_units(trajectory))
    line = ",".join(["%.10g"] * len(header)) + "\n"
    text = line * len(table) % tuple(table.ravel().tolist())
    write_text(folder / "trajectory.csv", ",".join(header) + "\n" + text)


def drive_units(scene: Scene) -> dict[str, str]:
    """Return the unit of the drive of every rigid coordinate, by its name: cart, then the arms."""
    return {CART: "N", **{arm.name: "N m" for arm in scene.arms}}


def trajectory_units(trajectory: Trajectory) -> dict[str, str]:
    """Return the unit of every column of trajectory.csv, in their order."""
    scene, slices = trajectory.scene, trajectory.mechanism.slices
    units = {"t": "s", "deviation_x": "m", "deviation_y": "m", "deviation": "m"}
    units |= {"compliance": "N m", f"q_r_{CART}": "m"}
    units |= {f"q_r_{arm.name}": "rad" for arm in scene.arms}
    for arm, part in zip(scene.arms, slices, strict=True):
        # Of normalised modes: a unit of their own, which times the mode is a displacement.
        units |= {f"q_e_{arm.name}_{k + 1}": "modal" for k in range(part.stop - part.start)}
    units |= {f"compliance_{arm.name}": "N m" for arm in scene.arms}
    return units | {f"joint_force_{name}": unit for name, unit in drive_units(scene).items()}


def read_initial_deviation(path: Path) -> np.ndarray | None:
    """Return the initial design's deviation (n, 2), m, if trajectory.npz holds it."""
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as data:
        return data["initial_deviation"] if "initial_deviation" in data.files else None
