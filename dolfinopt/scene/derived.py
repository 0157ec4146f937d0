"""Values of a scene that are not stated and follow from others: lengths, times, numbers, gradient.

The tree is the scene as read, before it is validated: values of any type may stand in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from pydantic import ValidationError

from dolfinopt.errors import InputError
from dolfinopt.scene.tables.arms import SOLID_SHAPES, is_sid
from dolfinopt.scene.tables.base import rows
from dolfinopt.scene.tables.design import Design
from dolfinopt.scene.tables.motion import LIMITS, Motion, Reduction
from dolfinopt.scene.tables.objective import Objective
from dolfinopt.scene.tables.responses import DECLARED

Tree = dict[str, Any]
FILTERED = 1.0 / 8.0  # radius of the filter over the height of the lowest arm
SHOULDER, ARC = -0.25, 0.5  # place of the shoulder and radius of the arc over the arms' length
UNKNOWN = object()  # nothing to go by: the key's default, or what validation says of it


def complete(tree: Tree) -> tuple[tuple[str, str], ...]:
    """Complete a scene's data; return the keys that follow from others, as (table, key)."""
    if tree.get("design", {}).get("volume_fraction", 1.0) is None:
        del tree["design"]["volume_fraction"]  # a summary has it so of another scene
    derived = []
    for (table, key), rule in RULES.items():
        if table == "motion" and not tree.get(table):
            continue  # validation tells that it is missing
        row = tree.setdefault(table, {})
        if key in row or (value := rule(tree)) is UNKNOWN:
            continue
        row[key] = value
        derived.append((table, key))
    return tuple(derived)


def _elbow(tree: Tree) -> Any:
    return 1 if tree.get("closures") and not tree.get("joints") else UNKNOWN


def _by_reach(share: float, tree: Tree) -> Any:
    """Return a share of the length of all arms in the plane."""
    lengths = _sizes(tree, "length")
    return share * sum(lengths) if lengths and not tree.get("joints") else UNKNOWN


def _radius(tree: Tree) -> Any:
    return _by_reach(ARC, tree) if tree["motion"].get("path") == "arc" else UNKNOWN


def _filter_radius(tree: Tree) -> Any:
    design, heights = tree["design"], _sizes(tree, "height")
    widths = design.get("minimum_member") or design.get("minimum_gap")
    return FILTERED * min(heights) if heights and not widths else UNKNOWN


def _sizes(tree: Tree, key: str) -> list[float]:
    """Return the sizes of arms that are numbers above 0; validation tells of others."""
    values = (arm.get(key) for arm in rows(tree, "arms"))
    return [x for x in values if isinstance(x, (int, float)) and x > 0.0]


def _duration(tree: Tree) -> Any:
    """Return that of a table, or the least one by limits along the path."""
    motion = tree["motion"]
    if not any(motion.get(key) is not None for key in ("file", *LIMITS)):
        return UNKNOWN
    from dolfinopt.scene.duration import least_duration  # NumPy, only needed here

    stated = {key: motion[key] for key in motion if key != "horizon"}
    try:
        least, _ = least_duration(Motion.model_validate({**stated, "horizon": 1e5}))
    except (ValidationError, InputError):  # told where the scene is checked, or its motion
        return UNKNOWN
    return least or UNKNOWN  # of a table with one row the motion tells


def _horizon(tree: Tree) -> Any:
    duration, moving = tree["motion"].get("duration"), tree["motion"].get("table_ends") == "moving"
    if not isinstance(duration, (int, float)):
        return UNKNOWN
    return duration if moving or duration > Motion.model_fields["horizon"].default else UNKNOWN


def _coordinates(tree: Tree) -> Any:
    """Return six for every outboard interface of a solid arm."""
    usual = Reduction.model_fields["method"].default
    solids = filter(_is_solid, rows(tree, "arms"))
    counts = [6 * (1 + len(rows(arm, "interfaces"))) for arm in solids]
    return max(counts) if counts and tree["reduction"].get("method", usual) == usual else UNKNOWN


def _is_solid(arm: Mapping[str, Any]) -> bool:
    if arm.get("rigid") is True or is_sid(arm.get("mesh")):
        return False
    cells = arm.get("cells")
    in_three = isinstance(cells, list | tuple) and len(cells) == 3
    return in_three or arm.get("cell_shape") in SOLID_SHAPES


def _volume_fraction(tree: Tree) -> Any:
    """Return no limit where mass is asked for."""
    limited = tree.get("constraints", {}).get("mass") is not None
    mass = limited or tree.get("objective", {}).get("kind") == "mass"
    return None if mass else Design.model_fields["volume_fraction"].default


def _gradient(tree: Tree) -> Any:
    """Return frozen loads for "esl" without limits of the motion."""
    kind = tree["objective"].get("kind", Objective.model_fields["kind"].default)
    stated = tree.get("constraints", {}).items()
    limited = {key for key, limit in stated if limit is not None}
    follow = {response.key for response in DECLARED.values() if "motion" in response.needs}
    return "esl" if kind == "esl" and not limited & follow else UNKNOWN


# In this order: the least duration of a path is known by its lengths.
RULES: Mapping[tuple[str, str], Callable[[Tree], Any]] = {
    ("motion", "elbow"): _elbow,
    ("motion", "joint_height"): partial(_by_reach, SHOULDER),
    ("motion", "radius"): _radius,
    ("design", "filter_radius"): _filter_radius,
    ("motion", "duration"): _duration,
    ("motion", "horizon"): _horizon,
    ("reduction", "coordinates"): _coordinates,
    ("design", "volume_fraction"): _volume_fraction,
    ("objective", "gradient"): _gradient,
}
