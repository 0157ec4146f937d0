"""Values of a scene that are not stated and follow from others.

The tree is the scene as read, before it is validated: values of any type may stand in it.
"""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from dolfinopt.errors import InputError
from dolfinopt.scene.messages import Override, blamed
from dolfinopt.scene.spelling import input_error, shown
from dolfinopt.scene.tables.arms import SOLID_SHAPES
from dolfinopt.scene.tables.motion import Motion
from dolfinopt.scene.tables.objective import Objective
from dolfinopt.scene.tables.reduction import Reduction
from dolfinopt.scene.tables.responses import NEEDS

Keys = tuple[tuple[str, str], ...]


def complete(tree: dict[str, Any], source: str, changes: list[Override]) -> Keys:
    """Complete times of the motion, number of coordinates, limit of the volume and gradient.

    Returns:
        The keys that follow from others, as (table, key).

    Raises:
        InputError: a stated duration is too short for the limits.
    """
    timed = _time_motion(tree, source, changes)
    return *timed, *_count_coordinates(tree), *_limit_volume(tree), *_freeze_loads(tree)


def _count_coordinates(tree: dict[str, Any]) -> Keys:
    """Give solid arms as many elastic coordinates as their interfaces need, six each.

    Returns:
        Its key, as (table, key), where it is not stated.
    """
    reduction, arms = tree.get("reduction", {}), tree.get("arms")
    if not (isinstance(reduction, dict) and isinstance(arms, list)):
        return ()
    usual = Reduction.model_fields["method"].default
    if "coordinates" in reduction or reduction.get("method", usual) != usual:
        return ()
    counts = [6 * (1 + _length(arm.get("interfaces"))) for arm in arms if _is_solid(arm)]
    if not counts:
        return ()
    tree["reduction"] = {**reduction, "coordinates": max(counts)}
    return (("reduction", "coordinates"),)


def _is_solid(arm: Any) -> bool:
    if not isinstance(arm, dict) or arm.get("rigid") is True or arm.get("sid") is not None:
        return False
    return _length(arm.get("cells")) == 3 or arm.get("cell_shape") in SOLID_SHAPES


def _length(value: Any) -> int:
    return len(value) if isinstance(value, list | tuple) else 0


def _time_motion(tree: dict[str, Any], source: str, changes: list[Override]) -> Keys:
    """Complete duration and horizon of the motion where they follow from other values.

    Returns:
        The keys that do, as (table, key).

    Raises:
        InputError: a stated duration is too short for the limits.
    """
    motion = tree.get("motion")
    if not isinstance(motion, dict):
        return ()
    asked = ("file", "max_speed", "max_acceleration", "max_jerk")
    derived: list[tuple[str, str]] = []
    if any(motion.get(key) is not None for key in asked):
        from dolfinopt.scene.duration import (  # NumPy, which others do not need
            SAME_TIME,
            least_duration,
        )

        rest = {key: motion[key] for key in motion if key not in ("duration", "horizon")}
        try:
            least, limited = least_duration(Motion.model_validate({**rest, "horizon": 1e5}))
        except (ValidationError, InputError):  # told where the scene is checked, or its motion
            least, limited = None, False
        stated = motion.get("duration")
        if stated is None and least:  # of a table with one row the motion tells
            motion["duration"] = least
            derived.append(("motion", "duration"))
        if not (limited and isinstance(stated, (int, float)) and least is not None):
            pass  # what the duration is, validation will say
        elif stated < least * (1.0 - SAME_TIME):
            where = blamed(source, changes, (("motion", "duration"),))
            keys = ", ".join(f"motion.{k}" for k in asked[1:] if motion.get(k) is not None)
            raise input_error(
                where,
                f"motion.duration = {shown(stated)}: expected at least {least:.6g} [s] by the "
                f"limits ({keys}); leave it out to use this value, or raise the limits",
            )
    duration = motion.get("duration")
    default = Motion.model_fields["horizon"].default
    if "horizon" not in motion and isinstance(duration, (int, float)) and duration > default:
        motion["horizon"] = duration
        derived.append(("motion", "horizon"))
    return tuple(derived)


def _limit_volume(tree: dict[str, Any]) -> Keys:
    """Leave out the limit of the volume where mass is asked for and none is stated.

    Returns:
        Its key, as (table, key), where it is not stated.
    """
    tables = {key: tree.get(key) for key in ("design", "objective", "constraints")}
    design, objective, limits = (one if isinstance(one, dict) else {} for one in tables.values())
    if design.get("volume_fraction") is not None:
        return ()
    design.pop("volume_fraction", None)
    if objective.get("kind") == "mass" or limits.get("mass") is not None:
        if tables["design"] is None:
            tree["design"] = design
        design["volume_fraction"] = None
    return (("design", "volume_fraction"),)


def _freeze_loads(tree: dict[str, Any]) -> Keys:
    """Hold the loads in the gradient of `kind = "esl"`, unless a limit follows the motion.

    Returns:
        Its key, as (table, key), where it is not stated.
    """
    objective, limits = tree.get("objective", {}), tree.get("constraints", {})
    if not (isinstance(objective, dict) and isinstance(limits, dict)) or "gradient" in objective:
        return ()
    limited = [key for key, limit in limits.items() if limit is not None]
    if objective.get("kind", Objective.model_fields["kind"].default) != "esl" or any(
        "motion" in NEEDS.get(key, ()) for key in limited
    ):
        return ()
    tree["objective"] = {**objective, "gradient": "esl"}
    return (("objective", "gradient"),)
