"""From a TOML file, or plain data, and overrides to a scene.

`read_scene` reads a file, `scene_from_dict` plain data; both return a `Scene` or raise one
`InputError` of one line that names file, key, value and remedy. The keys themselves stand in
`schema.py` and `tables/`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, get_origin

from pydantic import ValidationError

from dolfinopt.data import mesh_folder
from dolfinopt.errors import InputError
from dolfinopt.scene.materials import CATALOGUE, unknown_material
from dolfinopt.scene.messages import (
    Override,
    allowed_words,
    arm_name,
    blamed,
    describe_keys,
    dotted,
    field_at,
    first_problem,
    misplaced,
    model_at,
    unknown_key,
    value_at,
    wrong_value,
)
from dolfinopt.scene.old_words import OLD_KEYS, read_old_words, scaled
from dolfinopt.scene.schema import FILE_KEYS, Scene, check_scene_name, named_files
from dolfinopt.scene.tables.arms import (
    JOINT_KEYS,
    MAX_ARMS,
    MAX_CELLS,
    MESH_KEYS,
    OF_OTHER_MESHES,
    OWN_KEYS,
    PATTERN_KEYS,
    SIZE_KEYS,
    SIZE_PARAMETER,
    SOLID_SHAPES,
    WALL_KEYS,
    Arm,
)
from dolfinopt.scene.tables.base import (
    Loc,
    Refusal,
    cut,
    input_error,
    loc_of,
    rows,
    shown,
    without_none,
)
from dolfinopt.scene.tables.closures import (
    OLD,
    OLD_CLOSURE,
    read_old_closure,
    take_old_keys,
)
from dolfinopt.scene.tables.design import Law
from dolfinopt.scene.tables.joints import DRIVE_KEYS, INBOARD, OF_BEARINGS, OUTBOARD
from dolfinopt.scene.tables.material import material_keys
from dolfinopt.scene.tables.motion import LIMITS, Motion, Reduction
from dolfinopt.scene.tables.objective import Objective, WorstBy
from dolfinopt.scene.tables.responses import DECLARED
from dolfinopt.scene.toml import read_toml, tomllib

__all__ = [
    "FILE_KEYS",
    "MAX_CELLS",
    "Arm",
    "Law",
    "Motion",
    "Reduction",
    "Scene",
    "WorstBy",
    "describe_keys",
    "pose_scenarios",
    "read_scene",
    "resolve_file",
    "scene_from_dict",
    "tomllib",
]

DRAWN = 0.01  # m, height and thickness of a rigid arm of no length


def read_scene(path: str | os.PathLike[str], overrides: Iterable[str] = ()) -> Scene:
    """Read, complete and validate the scene file `path` (TOML, UTF-8).

    `overrides` are strings "key.path=value" as given to --set. The value is read as TOML, or else
    taken as a bare string. `arms.length` means all arms, `arms.0.length` and `arms.arm2.length`
    one of them, `joints.elbow.axis` a joint's. They apply after arms have taken missing keys from
    the arm before, so that an override changes what it names and nothing else.

    Raises:
        InputError: one line that names file, key, value and what is allowed.
    """
    source = os.fspath(path)
    return _build(read_toml(source), source, overrides, _default_name(source))


def scene_from_dict(
    data: Mapping[str, Any], source: str = "<scene>", overrides: Iterable[str] = ()
) -> Scene:
    """Complete and validate a scene given as nested dictionaries and lists, left unchanged.

    `source` stands for the file in messages; `overrides` as in `read_scene`.

    Raises:
        InputError: one line that names source, key, value and what is allowed.
    """
    if not isinstance(data, Mapping):
        raise input_error(source, f"expected a table of scene keys, found {shown(data)}")
    return _build(data, source, overrides, _default_name(source))


def _default_name(source: str) -> str:
    """Return the file's name without extension, "scene" where it cannot be a title."""
    try:
        return check_scene_name(Path(source).stem.strip("<>"))
    except Refusal:
        return "scene"


def _build(data: Mapping[str, Any], source: str, overrides: Iterable[str], name: str) -> Scene:
    """Complete `data`, apply `overrides`, validate; `name` is the default of the scene's name."""
    tree = _copy_tables(data)
    tree.setdefault("name", name)
    tree.setdefault("material", {})  # so that the message names the first key missing in it
    read_old_closure(tree, source)
    _check_tables(tree, source)
    if (count := len(tree.get("arms") or ())) > MAX_ARMS:
        raise input_error(source, f"arms: {count} of them, expected at most {MAX_ARMS}")
    told = read_old_words(tree, source)
    inherited = _inherit(tree, [key for key in Arm.model_fields if key not in OWN_KEYS])
    sizes = {loc for loc in inherited if loc[2] in SIZE_KEYS}
    changes = [_override(tree, text, source) for text in overrides]
    for change in changes:
        sizes.difference_update(change.locs)
        inherited.difference_update(change.locs[:1])
        inherited.update(change.locs[1:])
    _check_tables(tree, source, changes)
    told += read_old_words(tree, source, anew=True)
    # An override may have supplied what the first arm lacked; otherwise it changes what it names.
    required = [key for key, field in Arm.model_fields.items() if field.is_required()]
    inherited |= _inherit(tree, [key for key in required if key not in OWN_KEYS])
    _size_rigid(tree)
    _drop_scaled(tree, inherited)
    _share_interfaces(tree)
    _fill_material(tree, source, changes)
    _resolve_files(tree, source, changes)
    _drop_sizes(tree, sizes)
    _measure_bodies(tree, inherited)
    derived = complete(tree)
    try:
        scene = Scene.model_validate({key: tree[key] for key in tree if key != OLD})
    except ValidationError as error:
        message = first_problem(error, tree, source, changes)
        raise InputError(message) from None
    scene._source = source
    scene._derived = derived
    scene._old_words = (*dict.fromkeys(told), *[OLD_CLOSURE] * (data.get(OLD) is not None))
    pose_scenarios(scene)
    return scene


@lru_cache(maxsize=16)
def pose_scenarios(scene: Scene) -> tuple[Scene, ...]:
    """Return the scene as each of its scenarios changes it.

    Raises:
        InputError: a change names no key, or a value that it cannot have.
    """
    if not scene.scenarios:
        return ()
    plain = scene.to_tree() | {"scenarios": []}
    del plain["objective"]["scenarios"]  # there is nothing to combine
    return tuple(
        scene_from_dict(plain, scene.source, scenario.changes) for scenario in scene.scenarios
    )


def _check_tables(tree: dict[str, Any], source: str, changes: Sequence[Override] = ()) -> None:
    """Refuse what is no table where a scene has one; a name is one in place of [material]."""
    if isinstance(tree.get("material"), str):
        tree["material"] = {"name": tree["material"]}
    for loc in misplaced(tree):
        raise input_error(blamed(source, changes, (loc,)), wrong_value(loc, tree))


def _fill_material(tree: dict[str, Any], source: str, changes: list[Override]) -> None:
    """Complete [material] by the catalogue where it names one."""
    material = tree["material"]
    if not isinstance(name := material.get("name"), str):
        return
    if name not in CATALOGUE:
        where = blamed(source, changes, (("material", "name"),))
        raise input_error(where, f"material = {shown(name)}: {unknown_material(name)}")
    tree["material"] = CATALOGUE[name].values | material


def _resolve_files(tree: dict[str, Any], source: str, changes: list[Override]) -> None:
    """Put absolute paths in place of the files that `tree` names."""
    for name, row, key in named_files(tree):
        loc = loc_of(name)
        where = blamed(source, changes, (loc,))
        row[key] = resolve_file(source, row[key], dotted(loc, tree), where)


def _drop_sizes(tree: dict[str, Any], sizes: set[Loc]) -> None:
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


def _measure_bodies(tree: dict[str, Any], inherited: set[Loc]) -> None:
    """Take the length of arms with standard input data from their files, unless it is stated."""
    # Height and thickness are only drawn then: a twentieth of the length unless stated.
    for i, arm in enumerate(rows(tree, "arms")):
        if not isinstance(arm.get("sid"), str):
            continue
        from dolfinopt.scene.sid import read_sid  # NumPy, which other scenes do not need

        nodes = read_sid(Path(arm["sid"])).nodes
        if not nodes:
            raise InputError(
                f"{arm['sid']}: no nodes; an arm needs an inboard node at the origin and an "
                "outboard node"
            )
        length = math.hypot(*nodes[-1].origin.M0.ravel())
        if ("arms", i, "length") in inherited or "length" not in arm:
            arm["length"] = length
        for key in ("height", "thickness"):
            arm.setdefault(key, length / 20.0)
        # What a mesh would need says nothing about a body from a file.
        for loc in [loc for loc in inherited if loc[:2] == ("arms", i)]:
            if loc[2] in (*PATTERN_KEYS, *MESH_KEYS):
                arm.pop(loc[2], None)


def _drop_scaled(tree: dict[str, Any], inherited: set[Loc]) -> None:
    """Take out of arms with another's design, scaled, what they took over and have from there."""
    arms = rows(tree, "arms")
    for i, arm in enumerate(arms):
        for owner in [other for other in arms[:i] if other.get("name") == arm.get("design", "")]:
            keys = (*OWN_KEYS, *JOINT_KEYS)
            both = [{k: x for k, x in row.items() if k not in keys} for row in (arm, owner)]
            for key in PATTERN_KEYS if both[0] != both[1] else ():
                if ("arms", i, key) in inherited:
                    arm.pop(key, None)


def _share_interfaces(tree: dict[str, Any]) -> None:
    """Give arms that share another's design its interfaces, which are part of the mesh."""
    arms = rows(tree, "arms")
    for arm in arms:
        for other in arms if "design" in arm and "interfaces" not in arm else ():
            if other.get("name") == arm["design"] and "interfaces" in other:
                arm["interfaces"] = _copied(other["interfaces"])


def _size_rigid(tree: dict[str, Any]) -> None:
    """Give rigid arms in space that state their inertia a size to be drawn with."""
    # A point has no inertia to state; of other arms mass and inertia would follow from the size.
    for arm in rows(tree, "arms") if tree.get("joints") else ():
        if arm.get("rigid") is not True:
            continue
        length = arm.get("length")
        point = length in (0, 0.0) and not arm.get("mass")
        if point or ("mass" in arm and "inertia" in arm):
            size = length / 20.0 if isinstance(length, (int, float)) and length > 0 else DRAWN
            arm.setdefault("height", size)
            arm.setdefault("thickness", size)


def resolve_file(source: str, value: str, key: str, where: str = "") -> str:
    """Return the absolute path of the file that the scene `source` names as `value`.

    A relative path is looked for from the scene's folder, then from the working directory, and
    "meshes/..." at last among the package's own. `key` and `where` (default `source`) stand in
    the message.

    Raises:
        InputError: there is no such file; names the key and all places.
    """
    folders = [Path(source).parent, Path()]
    if Path(value).parts[:1] == (mesh_folder().name,):
        folders.append(mesh_folder().parent)
    paths = list(dict.fromkeys(os.path.abspath(folder / value) for folder in folders))
    for path in paths:
        if os.path.isfile(path):
            return path
    tried = "neither " if len(paths) > 1 else "not "
    tried += " nor ".join(paths)
    raise input_error(
        where or source,
        f"{key} = {shown(value)}: expected the path of a file, from the scene's folder or the "
        f"working directory; found {tried}",
    )


def _copy_tables(data: Mapping[str, Any]) -> dict[str, Any]:
    """Copy the scene's tables, which completion changes; values are shared with `data`."""
    return {key: _copied(value) for key, value in data.items()}


def _copied(value: Any) -> Any:
    """Return a table, an array of tables or a plain value, with tables of its own."""
    if isinstance(value, Mapping):
        return _copy_tables(value)
    if isinstance(value, (list, tuple)) and any(isinstance(item, Mapping) for item in value):
        return [_copied(item) for item in value]
    return value


def _inherit(tree: dict[str, Any], keys: Iterable[str]) -> set[Loc]:
    """Fill each arm's missing `keys` from the arm before; return their paths."""
    inherited: set[Loc] = set()
    fixed = [row.get("child") for row in rows(tree, "joints") if row.get("type") == "fixed"]
    for i, (before, arm) in enumerate(pairwise(rows(tree, "arms")), start=1):
        taken = {key for keys in _replaced(arm) for key in keys}
        if arm.get("name") in fixed:
            taken.update(key for key in DRIVE_KEYS if key not in OF_BEARINGS)
        for key in keys:
            if key in before and key not in arm and key not in taken:
                arm[key] = _copied(before[key])
                inherited.add(("arms", i, key))
        if ("arms", i, "mesh") in inherited:
            _take_bores(before, arm)
    return inherited


def _take_bores(before: Mapping[str, Any], arm: dict[str, Any]) -> None:
    """Give an arm with the mesh of the arm before the bores at its ends, too."""
    ends, own = list(filter(_is_end, rows(before, "interfaces"))), rows(arm, "interfaces")
    if ends and not any(map(_is_end, own)):
        arm["interfaces"] = [*_copied(ends), *own]


def _is_end(row: Mapping[str, Any]) -> bool:
    return str(row.get("name")).strip().casefold() in (INBOARD, OUTBOARD)


def _replaced(arm: Mapping[str, Any]) -> Iterator[Sequence[str]]:
    """Yield the keys that what an arm states takes the place of."""
    if "cells" in arm:
        yield MESH_KEYS
    if "mesh" in arm:
        yield OF_OTHER_MESHES
    if "material" in arm:
        yield material_keys()
    if "kind" in arm:
        yield ["material", *material_keys()]
    if arm.get("rigid") is True or "sid" in arm:
        yield ("regions",)
    if arm.get("hollow") is False:
        yield WALL_KEYS


# --- overrides -------------------------------------------------------------------------------


def _override(tree: dict[str, Any], text: str, source: str) -> Override:
    """Apply one "key.path=value" to `tree`; raise InputError if there is no such key."""
    where = f"{source} with --set {cut(text)}"
    path, equals, value = text.partition("=")
    path, times = path.rstrip().removesuffix("*"), path.rstrip().endswith("*")
    parts = tuple(part.strip() for part in path.split("."))
    if not equals or not all(parts):
        raise input_error(where, "expected key.path=value, for example payload.mass=4.0")
    if parts[0] == OLD:
        given = _parse_value(value.strip())
        take_old_keys(tree, given if len(parts) == 1 else {parts[1]: given}, where)
        return Override(text, (parts,))
    locs = _override_locs(tree, parts, where)
    for loc in locs:
        _check_tables(tree, source)
        if loc[0] == "arms" and loc[2:] in (("cells",), ("mesh",)):
            _drop_mesh(tree, loc)
        if loc == ("material", "name") or (loc[0] == "arms" and loc[2:] == ("material",)):
            _drop_values(tree, loc)
        given = _parse_value(value.strip())
        _store(tree, loc, scaled(value_at(loc, tree)[0], given) if times else given)
    return Override(text, tuple(loc[:2] if _is_old(loc) else loc for loc in locs))


def _is_old(loc: Loc) -> bool:
    """Tell whether `loc` is the path of an older key, or lies below one."""
    keys = [part for part in loc if not isinstance(part, int)]
    return ".".join(map(str, keys[:2])) in OLD_KEYS


def _drop_mesh(tree: dict[str, Any], loc: Loc) -> None:
    """Let `cells` or `mesh` at `loc` take the place of what the arm is meshed from so far."""
    for key in MESH_KEYS if loc[2] == "cells" else ("cells",):
        tree["arms"][loc[1]].pop(key, None)


def _drop_values(tree: dict[str, Any], loc: Loc) -> None:
    """Let the name of a material at `loc` take the place of the values stated so far."""
    table = tree["arms"][loc[1]] if loc[0] == "arms" else tree["material"]
    for key in material_keys():
        table.pop(key, None)


def _parse_value(text: str) -> Any:
    """Read `text` as a TOML value; what is none is a bare string."""
    try:
        data = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return data["value"] if set(data) == {"value"} else text


def _override_locs(tree: dict[str, Any], parts: tuple[str, ...], where: str) -> tuple[Loc, ...]:
    """Return the paths that the dotted key `parts` means; raise InputError if there are none."""
    locs: tuple[Loc, ...] = (parts,)
    table, fields = parts[0], getattr(model_at(parts[:1]), "model_fields", {})
    if "name" in fields and _is_array(parts[:1]) and len(parts) > 1 and table in {*tree, "arms"}:
        members = rows(tree, table)
        if len(parts) == 2 and (parts[1] in fields or _is_old(parts)):
            locs = tuple((table, i, parts[1]) for i in range(len(members)))
        else:
            numbers = {str(i): i for i in range(len(members))}
            names = {arm_name(tree, i, table): i for i in numbers.values()}
            index = numbers.get(parts[1], names.get(parts[1]))
            if index is None:
                known = [*numbers, *filter(None, names)]
                known += fields if len(parts) == 2 else []
                raise input_error(where, unknown_key((table,), parts[1], known, tree))
            locs = ((table, index, *parts[2:]),)
    for loc in locs[:1]:
        _check_known(tree, loc, where)
    return locs


def _check_known(tree: dict[str, Any], loc: Loc, where: str) -> None:
    """Raise InputError unless `loc` is the path of a key or a table of a scene."""
    for depth in range(1, 1 if _is_old(loc) else len(loc) + 1):
        above, key = loc[: depth - 1], loc[depth - 1]
        parent = model_at(above)
        if isinstance(key, int):
            continue
        if parent is None or _is_array(above):
            remedy = f"set {dotted(above, tree)} as a whole: {allowed_words(field_at(above))}"
            raise input_error(where, f"unknown key {dotted(loc, tree)}; {remedy}")
        if key not in parent.model_fields:
            raise input_error(where, unknown_key(above, key, parent.model_fields, tree))


def _is_array(loc: Loc) -> bool:
    """Tell whether `loc` is the path of an array of tables."""
    if not loc or isinstance(loc[-1], int):
        return False
    return get_origin(without_none(field_at(loc).annotation)) is tuple


def _store(tree: dict[str, Any], loc: Loc, value: Any) -> None:
    """Set the value at `loc`, in tables that are made where there are none."""
    node: Any = tree
    for part in loc[:-1]:
        node = node.setdefault(part, {}) if isinstance(node, dict) else node[part]
    node[loc[-1]] = value


# -- values of a scene that are not stated and follow from others --------------------------------
#
# The tree is the scene as read, before it is validated: values of any type may stand in it.

Keys = Iterator[tuple[str, str]]  # table and key of what has been completed


def complete(tree: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    """Complete lengths, times of the motion, number of coordinates, volume's limit and gradient.

    Returns:
        The keys that follow from others, as (table, key).
    """
    # Lengths first, by which the path's least duration is known.
    steps = _measure_path, _time_motion, _count_coordinates, _limit_volume, _freeze_loads
    return tuple(key for step in steps for key in step(tree))


FILTERED = 1.0 / 8.0  # radius of the filter over the height of the lowest arm
SHOULDER, ARC = -0.25, 0.5  # place of the shoulder and radius of the arc over the arms' length


def _measure_path(tree: dict[str, Any]) -> Keys:
    """Complete lengths of path and filter, and the way of a loop."""
    lengths, heights = (_sizes(rows(tree, "arms"), key) for key in ("length", "height"))
    motion, design = tree.get("motion"), tree.setdefault("design", {})
    result: dict[tuple[str, str], float] = {}
    if motion and tree.get("closures") and not tree.get("joints"):
        result["motion", "elbow"] = 1
    if motion and lengths and not tree.get("joints"):
        result["motion", "joint_height"] = SHOULDER * sum(lengths)
        if motion.get("path") == "arc":
            result["motion", "radius"] = ARC * sum(lengths)
    if heights and not (design.get("minimum_member") or design.get("minimum_gap")):
        result["design", "filter_radius"] = FILTERED * min(heights)
    for (table, key), value in result.items():
        if key not in tree[table]:
            tree[table][key] = value
            yield table, key


def _sizes(arms: Iterable[Mapping[str, Any]], key: str) -> list[float]:
    """Return the sizes of arms that are numbers above 0; validation tells of others."""
    values = (arm.get(key) for arm in arms)
    return [x for x in values if isinstance(x, (int, float)) and x > 0.0]


def _count_coordinates(tree: dict[str, Any]) -> Keys:
    """Give solid arms six coordinates an interface."""
    reduction, usual = tree.get("reduction", {}), Reduction.model_fields["method"].default
    if "coordinates" in reduction or reduction.get("method", usual) != usual:
        return
    solids = filter(_is_solid, rows(tree, "arms"))
    if counts := [6 * (1 + len(rows(arm, "interfaces"))) for arm in solids]:
        tree["reduction"] = {**reduction, "coordinates": max(counts)}
        yield "reduction", "coordinates"


def _is_solid(arm: Mapping[str, Any]) -> bool:
    if arm.get("rigid") is True or arm.get("sid") is not None:
        return False
    cells = arm.get("cells")
    in_three = isinstance(cells, list | tuple) and len(cells) == 3
    return in_three or arm.get("cell_shape") in SOLID_SHAPES


def _time_motion(tree: dict[str, Any]) -> Keys:
    """Complete duration and horizon where they follow from others."""
    motion = tree.get("motion") or {}
    limited = any(motion.get(key) is not None for key in ("file", *LIMITS))
    if limited and motion.get("duration") is None:
        from dolfinopt.scene.duration import least_duration  # NumPy, only needed here

        rest = {key: motion[key] for key in motion if key not in ("duration", "horizon")}
        try:
            least, _ = least_duration(Motion.model_validate({**rest, "horizon": 1e5}))
        except (ValidationError, InputError):  # told where the scene is checked, or its motion
            least = None
        if least:  # of a table with one row the motion tells
            motion["duration"] = least
            yield "motion", "duration"
    duration = motion.get("duration")
    if "horizon" in motion or not isinstance(duration, (int, float)):
        return
    moving = motion.get("table_ends") == "moving"
    if duration > Motion.model_fields["horizon"].default or moving:
        motion["horizon"] = duration
        yield "motion", "horizon"


def _limit_volume(tree: dict[str, Any]) -> Keys:
    """Leave out the volume's limit where mass is asked for."""
    design, limits = tree["design"], tree.get("constraints", {})
    if design.get("volume_fraction") is not None:
        return
    design.pop("volume_fraction", None)
    if tree.get("objective", {}).get("kind") == "mass" or limits.get("mass") is not None:
        design["volume_fraction"] = None
    yield "design", "volume_fraction"


def _freeze_loads(tree: dict[str, Any]) -> Keys:
    """Hold the loads in the gradient of "esl" without limits of the motion."""
    objective, limits = tree.get("objective", {}), tree.get("constraints", {})
    limited = [key for key, limit in limits.items() if limit is not None]
    kind = objective.get("kind", Objective.model_fields["kind"].default)
    followed = (item.key for item in DECLARED.values() if "motion" in item.needs)
    if "gradient" not in objective and kind == "esl" and not {*followed}.intersection(limited):
        tree["objective"] = {**objective, "gradient": "esl"}
        yield "objective", "gradient"
