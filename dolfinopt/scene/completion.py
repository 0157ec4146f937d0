"""What a scene's data leave out: from arms before, from bodies in files, from other values.

The tree is the scene as read, before it is validated: values of any type may stand in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dolfinopt.errors import InputError
from dolfinopt.scene.tables.arms import (
    JOINT_KEYS,
    MESH_KEYS,
    OF_OTHER_MESHES,
    OWN_KEYS,
    PATTERN_KEYS,
    SIZE_PARAMETER,
    SOLID_SHAPES,
    WALL_KEYS,
    is_sid,
)
from dolfinopt.scene.tables.base import Loc, rows
from dolfinopt.scene.tables.design import Design
from dolfinopt.scene.tables.joints import DRIVE_KEYS, INBOARD, OF_BEARINGS, OUTBOARD
from dolfinopt.scene.tables.material import material_keys
from dolfinopt.scene.tables.motion import LIMITS, Motion, Reduction
from dolfinopt.scene.tables.objective import Objective
from dolfinopt.scene.tables.responses import DECLARED

Tree = dict[str, Any]
DRAWN = 0.01  # m, height and thickness of a rigid arm of no length


def copied(value: Any) -> Any:
    """Return a table, an array of tables or a plain value, with tables of its own."""
    if isinstance(value, Mapping):
        return {key: copied(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)) and any(isinstance(item, Mapping) for item in value):
        return [copied(item) for item in value]
    return value


# -- from the arm before -------------------------------------------------------------------------


def inherit(tree: Tree, keys: Iterable[str]) -> set[Loc]:
    """Fill each arm's missing `keys` from the arm before; return their paths."""
    inherited: set[Loc] = set()
    fixed = [row.get("child") for row in rows(tree, "joints") if row.get("type") == "fixed"]
    before: dict[str, Any] = {}
    for i, arm in enumerate(rows(tree, "arms")):
        taken = {*arm, *OWN_KEYS, *chain.from_iterable(_replaced(arm))}
        if arm.get("name") in fixed:
            taken.update(key for key in DRIVE_KEYS if key not in OF_BEARINGS)
        for key in keys:
            if key not in taken and before.get(key) is not None:
                arm[key] = copied(before[key])
                inherited.add(("arms", i, key))
        if ("arms", i, "mesh") in inherited:
            _take_bores(before, arm)
        mesh, before = before.get("mesh"), dict(arm)
        if is_sid(arm.get("mesh")):  # a body is no mesh for the arms behind it
            before["mesh"] = mesh
    return inherited


def _take_bores(before: Mapping[str, Any], arm: dict[str, Any]) -> None:
    """Give an arm with the mesh of the arm before the bores at its ends, too."""
    ends, own = list(filter(_is_end, rows(before, "interfaces"))), rows(arm, "interfaces")
    if ends and not any(map(_is_end, own)):
        arm["interfaces"] = [*copied(ends), *own]


def _is_end(row: Mapping[str, Any]) -> bool:
    return str(row.get("name")).strip().casefold() in (INBOARD, OUTBOARD)


def _replaced(arm: Mapping[str, Any]) -> Iterator[Sequence[str]]:
    """Yield the keys that what an arm states takes the place of."""
    if "cells" in arm:
        yield MESH_KEYS
    if "mesh" in arm and not is_sid(arm["mesh"]):
        yield OF_OTHER_MESHES
    if "material" in arm:
        yield material_keys()
    if "kind" in arm:
        yield ["material", *material_keys()]
    if arm.get("rigid") is True or is_sid(arm.get("mesh")):
        yield ("regions",)
    if arm.get("hollow") is False:
        yield WALL_KEYS


def drop_sizes(tree: Tree, sizes: set[Loc]) -> None:
    """Leave out sizes and shapes of cells of the arm before that an arm's own file cannot have."""
    # A .msh file has its cells; a .geo file in the plane a size only where it has the parameter.
    for table, i, key in sizes:
        arm = tree[table][i]
        if not isinstance(mesh := arm.get("mesh"), str):
            continue
        kind, solid = Path(mesh).suffix.lower(), arm.get("cell_shape") in SOLID_SHAPES
        meshed = kind in (".msh", ".inp") and not (solid and key == "cell_shape")
        if kind == ".geo" and key == "mesh_size" and not solid:
            meshed = f'{SIZE_PARAMETER}"' not in Path(mesh).read_text("utf-8", errors="replace")
        if meshed:
            arm.pop(key, None)


# -- from the arm whose design it has ------------------------------------------------------------


def take_from_owners(tree: Tree, inherited: set[Loc]) -> None:
    """Give arms with another's design its interfaces, which are part of the mesh.

    Where it is scaled they leave out what they took over and have from there.
    """
    arms = rows(tree, "arms")
    for i, arm in enumerate(arms):
        for owner in [other for other in arms if other.get("name") == arm.get("design", "")]:
            keys = (*OWN_KEYS, *JOINT_KEYS)
            both = [{k: x for k, x in row.items() if k not in keys} for row in (arm, owner)]
            for key in PATTERN_KEYS if both[0] != both[1] else ():
                if ("arms", i, key) in inherited:
                    arm.pop(key, None)
            if "interfaces" in owner:
                arm.setdefault("interfaces", copied(owner["interfaces"]))


# -- sizes of rigid arms and of bodies from files ------------------------------------------------


def size_rigid(tree: Tree) -> None:
    """Give rigid arms in space that state their inertia a size to be drawn with."""
    # A point has no inertia to state; of other arms mass and inertia would follow from the size.
    for arm in rows(tree, "arms") if tree.get("joints") else ():
        length = arm.get("length")
        point = length in (0, 0.0) and not arm.get("mass")
        if arm.get("rigid") is True and (point or ("mass" in arm and "inertia" in arm)):
            size = length / 20.0 if isinstance(length, (int, float)) and length > 0 else DRAWN
            for key in ("height", "thickness"):
                arm.setdefault(key, size)


def measure_bodies(tree: Tree, inherited: set[Loc]) -> None:
    """Take the length of arms with a body from a file from that, unless it is stated.

    What they took over and only a mesh has is left out.
    """
    # Height and thickness are only drawn then: a twentieth of the length unless stated.
    for i, arm in enumerate(rows(tree, "arms")):
        if not is_sid(file := arm.get("mesh")):
            continue
        from dolfinopt.scene.sid import read_sid  # NumPy, which other scenes do not need

        for key in (*PATTERN_KEYS, *MESH_KEYS):
            if ("arms", i, key) in inherited:
                arm.pop(key, None)
        nodes = read_sid(Path(file)).nodes
        if not nodes:
            raise InputError(
                f"{file}: no nodes; an arm needs an inboard node at the origin and an outboard node"
            )
        length = math.hypot(*nodes[-1].origin.M0.ravel())
        if ("arms", i, "length") in inherited or "length" not in arm:
            arm["length"] = length
        for key in ("height", "thickness"):
            arm.setdefault(key, length / 20.0)


# -- lengths, times, numbers and the gradient, by other values -----------------------------------

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
