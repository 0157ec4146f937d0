"""A robot's trajectory: columns for all its joints, checked against its limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.robot import Robot, RobotJoint

ROUNDING = 1e-6  # of a limit, which files round


def columns_of(robot: Robot, file: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of a table's columns that are joints with a coordinate of their own.

    Raises:
        InputError: there is no column t; a column is no joint, a fixed one or one that follows.
    """
    joints = {joint.name: joint for joint in robot.joints}
    own = [joint.name for joint in robot.movable if joint.mimic is None]
    allowed = f"expected t and any of {', '.join(own)}"
    found = tuple(name for name in names if name != "t")
    if "t" not in names:
        raise InputError(f"{file}: no column t, the instants in s; {allowed}")
    for name in found:
        if name in own:
            continue
        joint = joints.get(name)
        if joint is None:
            raise InputError(f"{file}: column {name!r}: the robot has no such joint; {allowed}")
        what = "is fixed" if not joint.moves else f"follows {joint.mimic.joint!r}"  # type: ignore
        raise InputError(f"{file}: column {name!r}: this joint {what}; {allowed}")
    return found


def complete(robot: Robot, names: Sequence[str], rows: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return values (n, joints) of all joints that move, and a sentence on those not in the table.

    A joint that is not in the table stands at zero, or at the limit nearest to it; one that
    follows another does so.
    """
    given = dict(zip(names, np.asarray(rows, dtype=float).T, strict=True))
    held = []
    for joint in robot.movable:
        if joint.mimic is None and joint.name not in given:
            value = min(max(0.0, joint.lower), joint.upper)
            given[joint.name] = np.full(len(rows), value)
            held.append(f"{joint.name} = {value:g}")
    for joint in robot.movable:
        if joint.mimic is not None:
            followed = given[joint.mimic.joint]
            given[joint.name] = joint.mimic.multiplier * followed + joint.mimic.offset
    said = [f"joints that the table does not name stand still: {', '.join(held)}"] if held else []
    return np.column_stack([given[joint.name] for joint in robot.movable]), said


def check_positions(robot: Robot, file: str, lines: Sequence[int], rows: np.ndarray) -> None:
    """Raise InputError for the first value beyond a joint's limits.

    Args:
        robot: the robot.
        file: of the table, for the message.
        lines: of the rows in the file.
        rows: (n, joints) of all joints that move, rad or m.
    """
    for joint, values in zip(robot.movable, np.asarray(rows).T, strict=True):
        width = joint.upper - joint.lower
        slack = ROUNDING * width if np.isfinite(width) else 0.0
        beyond = np.flatnonzero((values < joint.lower - slack) | (values > joint.upper + slack))
        if beyond.size:
            k = beyond[0]
            degrees = " (are these degrees?)" if _looks_like_degrees(joint, values) else ""
            raise InputError(
                f"{file}: line {lines[k]}, joint {joint.name} = {values[k]:g}: expected "
                f"{joint.lower:g} to {joint.upper:g} [{_unit(joint)}], its limits{degrees}"
            )


def too_fast(robot: Robot, file: str, rates: np.ndarray) -> list[str]:
    """Return a sentence for every joint whose rate (n, joints) exceeds its limit."""
    found = []
    for joint, values in zip(robot.movable, np.abs(rates).T, strict=True):
        fastest = float(values.max(initial=0.0))
        if fastest > (1.0 + ROUNDING) * joint.velocity:
            found.append(
                f"{file}: joint {joint.name} moves at up to {fastest:.4g} {_unit(joint)}/s, beyond "
                f"its limit of {joint.velocity:.4g} {_unit(joint)}/s"
            )
    return found


def trajectory_text(names: Sequence[str], t: np.ndarray, rows: np.ndarray) -> str:
    """Return a table, t in s and a column for each joint, as CSV."""
    lines = [",".join(["t", *names])]
    lines += [",".join(repr(float(x)) for x in (at, *row)) for at, row in zip(t, rows)]
    return "\n".join(lines) + "\n"


def _unit(joint: RobotJoint) -> str:
    return "m" if joint.kind == "prismatic" else "rad"


def _looks_like_degrees(joint: RobotJoint, values: np.ndarray) -> bool:
    return joint.kind != "prismatic" and float(np.abs(values).max()) > 4.0 * np.pi
