"""trajectory.npz and trajectory.csv: the sampled motion, its units, and limits of its joints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dolfinopt.data import tables_of
from dolfinopt.disk import read_arrays, write_arrays, write_table
from dolfinopt.dynamics.build import Trajectory
from dolfinopt.dynamics.measured import FILE_ROUNDING
from dolfinopt.multibody.tree import moves
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.joints import joint_drives

# Units of summary.json and history.csv by what they are in.
UNITS = tables_of("output/units.toml")
FORCE_OF = {"m": "N", "rad": "N m"}  # what drives a coordinate of this unit


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
    scene, blocks = trajectory.scene, list(_blocks(trajectory))
    arrays = {name: values for name, values, _ in blocks if name}
    units = {name: list(own.values()) for name, _, own in blocks if name}
    arrays["joint_forces"] = trajectory.joint_forces
    units["joint_forces"] = [FORCE_OF[unit] for unit in scene.rigid_units.values()]
    if initial is not None and len(initial):
        even = np.linspace(scene.lead, scene.horizon, len(initial))
        arrays["initial_deviation"] = _between(even, initial, trajectory.t)
        units["initial_deviation"] = ["m"]
    # One unit where all columns have the same.
    stated = {name: ", ".join(own if len(set(own)) > 1 else own[:1]) for name, own in units.items()}
    arrays["units"] = np.array([f"{name}: {unit}" for name, unit in stated.items()])
    write_arrays(folder / "trajectory.npz", arrays)
    header = [column for _, _, own in blocks for column in own]
    write_table(folder / "trajectory.csv", header, [values for _, values, _ in blocks], 10)


Block = tuple[str, np.ndarray, dict[str, str]]


def _blocks(trajectory: Trajectory) -> Iterator[Block]:
    """Yield the columns of trajectory.csv in their order.

    Blocks of them: the name in trajectory.npz, "" where they are not there as they are; values (n,)
    or (n, k); units by column.
    """
    scene, rigid, axes = trajectory.scene, trajectory.scene.rigid_units, "xyz"
    places = list(rigid.items())

    def named(prefix: str, units: Mapping[str, str]) -> dict[str, str]:
        return {f"{prefix}_{name}": unit for name, unit in units.items()}

    yield "t", trajectory.t, {"t": "s"}
    along = dict.fromkeys(axes[: scene.dimension], "m")
    yield "deviation", trajectory.deviation, named("deviation", along)
    yield "", trajectory.distance, {"deviation": "m"}
    yield "", trajectory.compliance.sum(axis=1), {"compliance": "N m"}
    yield "q_r", trajectory.q_r, named("q_r", rigid)
    yield "q_e", trajectory.q_e, _elastic_units(trajectory)
    by_arm = dict.fromkeys((arm.name for arm in scene.arms), "N m")
    yield "compliance", trajectory.compliance, named("compliance", by_arm)
    driven = trajectory.joint_forces[:, scene.driven_columns]
    yield "", driven, named("joint_force", drive_units(scene))
    if trajectory.is_machine:
        yield "q_r_desired", trajectory.desired.q, named("q_r_desired", rigid)
    if trajectory.motors is not None:
        motors = dict(places[k] for k in trajectory.problem.motor_joints)
        yield "q_motors", trajectory.motors, named("q_motor", motors)
    if (force := trajectory.closure_force) is not None:
        name = "closure_force"
        if trajectory.closure is not None:  # also under its own name
            parts = dict(scene.closures[0].parts(scene.dimension))
            yield name, force, named(name, parts)
            name = ""
        if trajectory.slider_position is not None:
            yield "slider_position", trajectory.slider_position, {"slider_position": "m"}
        yield name, force, _closure_units(scene)
    rotation = trajectory.rotation
    if rotation.shape[1] == 1:  # in the plane
        yield "rotation", rotation[:, 0], {"rotation": "rad"}
    else:
        yield "rotation", rotation, named("rotation", dict.fromkeys(axes, "rad"))


def trajectory_units(trajectory: Trajectory) -> dict[str, str]:
    """Return the unit of every column of trajectory.csv, in their order."""
    return {column: unit for _, _, units in _blocks(trajectory) for column, unit in units.items()}


def _elastic_units(trajectory: Trajectory) -> dict[str, str]:
    """Return the unit of every elastic coordinate by its column, and of every bearing's."""
    scene, mechanism = trajectory.scene, trajectory.mechanism
    units: dict[str, str] = {}
    for arm, part in zip(scene.arms, mechanism.slices):
        # Of normalised modes: a unit of their own, which times the mode is a displacement.
        units |= {f"q_e_{arm.name}_{k + 1}": "modal" for k in range(part.stop - part.start)}
    for place, body in zip(mechanism.bearings, mechanism.bodies[mechanism.num_arms :], strict=True):
        name = scene.joint_names[place]
        units |= {f"q_bearing_{name}_{along}": unit for along, unit in moves(body)}
    return units


def drive_units(scene: Scene) -> dict[str, str]:
    """Return the unit of every drive by the name of its coordinate, see `Scene.driven`."""
    units = scene.rigid_units
    return {name: FORCE_OF[units[name]] for name in scene.driven}


def by_drive(scene: Scene, values: np.ndarray) -> dict[str, float]:
    """Return those of the drives among values (n,) of all rigid coordinates, by their names."""
    return dict(zip(scene.driven, map(float, values[scene.driven_columns]), strict=True))


def free_drives(scene: Scene) -> Sequence[str]:
    """Return the driven coordinates that may leave the desired motion: control, or soft joints."""
    if scene.control is not None:
        return scene.driven
    pairs = zip(scene.joint_columns, joint_drives(scene), strict=True)
    names = list(scene.rigid_units)
    soft = {names[k] for k, item in pairs if k is not None and item.gear_stiffness > 0.0}
    soft |= {rod.name for rod in scene.rods if rod.is_spring}
    return [name for name in scene.driven if name in soft]


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


# -- how near a motion comes to the limits that a scene states of its joints ---------------------


@dataclass(frozen=True)
class JointLimit:
    """How near a motion comes to one of a joint's limits.

    Attributes:
        joint: its name.
        quantity: "position", "velocity" or "effort".
        limit: of the coordinate, or of the absolute value.
        value: where it is nearest to the limit or farthest beyond it.
        instant: of that, s.
        unit: of limit and value.
        met: whether it stays within the limit.
    """

    joint: str
    quantity: str
    limit: float
    value: float
    instant: float
    unit: str
    met: bool

    @property
    def sentence(self) -> str:
        """E.g. "elbow 3.2 of 3.1416 rad at 1.2 s"."""
        used = f"{self.joint} {self.value:.4g} of {self.limit:.4g} {self.unit}"
        return f"{used} at {self.instant:.3g} s"


def joint_limits(trajectory: Trajectory) -> Iterator[JointLimit]:
    """Yield how a motion stands to every limit of position, velocity and effort."""
    motion, forces = trajectory.motion, trajectory.joint_forces
    for k, joint in enumerate(trajectory.scene.movable):
        unit = trajectory.scene.rigid_units[joint.name]
        for quantity, bounds, values, of in (
            ("position", joint.position_limits, motion.q, unit),
            ("velocity", joint.velocity_limit, motion.qd, f"{unit}/s"),
            ("effort", joint.effort_limit, forces, FORCE_OF[unit]),
        ):
            if bounds is None:
                continue
            lower, upper = bounds if isinstance(bounds, tuple) else (-bounds, bounds)
            x = values[:, k]
            over = np.maximum(lower - x, x - upper)
            worst = int(np.argmax(over))
            value = float(x[worst])
            limit = lower if value - lower < upper - value else upper
            scale = max(upper - lower, abs(limit)) if quantity == "position" else upper
            if quantity != "position":  # of the absolute value
                value, limit = abs(value), upper
            met = bool(over[worst] <= FILE_ROUNDING * (scale or 1.0))
            at = float(trajectory.t[worst])
            yield JointLimit(joint.name, quantity, limit, value, at, of, met)
