"""trajectory.npz and trajectory.csv: the sampled motion, and the units of its columns."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.disk import read_arrays, write_arrays, write_table
from dolfinopt.multibody.tree import moves
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.joints import joint_parts

BEHIND = "; behind them the bearings', m and rad"
FORCE_OF = {"m": "N", "rad": "N m"}  # what drives a coordinate of this unit

if TYPE_CHECKING:
    from dolfinopt.dynamics.build import Trajectory


def write_trajectory(
    folder: Path, trajectory: Trajectory, initial: np.ndarray | None = None
) -> None:
    """Write trajectory.npz and trajectory.csv; their units stand in `trajectory_units`.

    Args:
        folder: where.
        trajectory: what.
        initial: (n, d) deviation of the initial design evenly over the horizon, m, kept for the
            picture.
    """
    trajectory = trajectory.sampled
    arrays = {
        "t": trajectory.t,
        "q_r": trajectory.q_r,
        "q_e": trajectory.q_e,
        "deviation": trajectory.deviation,
        "compliance": trajectory.compliance,
        "joint_forces": trajectory.joint_forces,
        "rotation": _rotation(trajectory),
    } | _of_machine(trajectory)
    scene = trajectory.scene
    if initial is not None and len(initial):
        even = np.linspace(scene.lead, scene.horizon, len(initial))
        arrays["initial_deviation"] = _between(even, initial, trajectory.t)
    rigid, bearings = ", ".join(scene.rigid_units.values()), trajectory.mechanism.bearings
    units = {
        "t": "s",
        "q_r": rigid,
        "q_r_desired": rigid,
        "q_motors": ", ".join(_motor_units(trajectory).values()),
        "q_e": "m or rad: times V is a displacement in m" + BEHIND * bool(bearings),
        "deviation": "m",
        "compliance": "N m",
        "joint_forces": ", ".join(FORCE_OF[unit] for unit in scene.rigid_units.values()),
        "closure_force": ", ".join(_closure_units(scene).values()),
        "slider_position": "m, from closures.point along closures.axis",
        "rotation": "rad",
        "initial_deviation": "m",
    }
    arrays["units"] = np.array([f"{name}: {units[name]}" for name in arrays])
    write_arrays(folder / "trajectory.npz", arrays)
    header = list(trajectory_units(trajectory))
    write_table(folder / "trajectory.csv", header, _columns(trajectory), 10)


def _of_machine(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return what there is beside a prescribed motion: desired coordinates, the closure's force."""
    arrays = {}
    if trajectory.is_machine:
        arrays["q_r_desired"] = trajectory.desired.q
    if trajectory.motors is not None:
        arrays["q_motors"] = trajectory.motors
    if trajectory.closure_force is not None:
        arrays["closure_force"] = trajectory.closure_force
    if trajectory.slider_position is not None:
        arrays["slider_position"] = trajectory.slider_position
    return arrays


def _rotation(trajectory: Trajectory) -> np.ndarray:
    """Return the end-effector's rotation: of the plane an angle (n,), of space vectors (n, 3)."""
    rotation = trajectory.rotation
    return rotation[:, 0] if rotation.shape[1] == 1 else rotation


def _columns(trajectory: Trajectory) -> list[np.ndarray]:
    """Return the columns of trajectory.csv, see `trajectory_units`."""
    arrays = _of_machine(trajectory)
    return [
        trajectory.t,
        trajectory.deviation,
        trajectory.distance,
        trajectory.compliance.sum(axis=1),
        trajectory.q_r,
        trajectory.q_e,
        trajectory.compliance,
        trajectory.joint_forces[:, trajectory.scene.driven_columns],
        *arrays.values(),
        *([arrays["closure_force"]] if trajectory.closure is not None else []),
        trajectory.rotation,
    ]


def drive_units(scene: Scene) -> dict[str, str]:
    """Return the unit of every drive by the name of its coordinate, see `Scene.driven`."""
    units = scene.rigid_units
    return {name: FORCE_OF[units[name]] for name in scene.driven}


def free_drives(scene: Scene) -> tuple[str, ...]:
    """Return the driven coordinates that may leave the desired motion: control, or soft joints."""
    if scene.control is not None:
        return scene.driven
    pairs = zip(scene.joint_columns, joint_parts(scene), strict=True)
    names = list(scene.rigid_units)
    soft = {names[k] for k, item in pairs if k is not None and item.stiffness > 0.0}
    soft |= {rod.name for rod in scene.rods if rod.is_spring}
    return tuple(name for name in scene.driven if name in soft)


def _motor_units(trajectory: Trajectory) -> dict[str, str]:
    """Return the unit of every motor's coordinate behind a gear by its joint's name."""
    units = list(trajectory.scene.rigid_units.items())
    return dict(units[k] for k in trajectory.problem.motor_joints)


def trajectory_units(trajectory: Trajectory) -> dict[str, str]:
    """Return the unit of every column of trajectory.csv, in their order."""
    scene, slices = trajectory.scene, trajectory.mechanism.slices
    axes = "xyz"[: scene.dimension]
    units = {"t": "s", **{f"deviation_{axis}": "m" for axis in axes}, "deviation": "m"}
    units |= {"compliance": "N m"}
    units |= {f"q_r_{name}": unit for name, unit in scene.rigid_units.items()}
    for arm, part in zip(scene.arms, slices):
        # Of normalised modes: a unit of their own, which times the mode is a displacement.
        units |= {f"q_e_{arm.name}_{k + 1}": "modal" for k in range(part.stop - part.start)}
    mechanism = trajectory.mechanism
    for place, body in zip(mechanism.bearings, mechanism.bodies[mechanism.num_arms :], strict=True):
        name = scene.joint_names[place]
        units |= {f"q_bearing_{name}_{along}": unit for along, unit in moves(body)}
    units |= {f"compliance_{arm.name}": "N m" for arm in scene.arms}
    units |= {f"joint_force_{name}": unit for name, unit in drive_units(scene).items()}
    if trajectory.is_machine:
        units |= {f"q_r_desired_{name}": unit for name, unit in scene.rigid_units.items()}
        units |= {f"q_motor_{name}": unit for name, unit in _motor_units(trajectory).items()}
    if trajectory.closure is not None:
        parts = scene.closures[0].parts(scene.dimension)
        units |= {f"closure_force_{part}": unit for part, unit in parts}
        units |= {} if trajectory.slider_position is None else {"slider_position": "m"}
    units |= _closure_units(scene)
    ends = [""] if trajectory.mechanism.dim.r == 1 else [f"_{axis}" for axis in axes]
    return units | {f"rotation{end}": "rad" for end in ends}


def _closure_units(scene: Scene) -> dict[str, str]:
    """Return the unit of every force and moment of closures by its column, `closure_NAME_PART`."""
    return {
        "_".join(filter(None, ("closure", closure.name, part))): unit
        for closure in scene.closures
        for part, unit in closure.parts(scene.dimension)
    }


def read_initial_deviation(path: Path, even: np.ndarray) -> np.ndarray | None:
    """Return the initial design's deviation (n, d), m, if trajectory.npz holds it.

    Args:
        path: of the file.
        even: (n,) instants at which it is wanted, s.
    """
    if not path.is_file():
        return None
    arrays = read_arrays(path, "name the folder of a finished run")
    if "initial_deviation" not in arrays:
        return None
    return _between(arrays["t"], arrays["initial_deviation"], even)


def _between(t: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return values (n, d) at other instants, straight between those at t."""
    return np.stack([np.interp(wanted, t, column) for column in values.T], axis=1)
