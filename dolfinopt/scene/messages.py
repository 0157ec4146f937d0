"""What is wrong with a scene, in one line; what may stand in one, as documentation lists it."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import Annotated, Any, NamedTuple, get_origin

from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from dolfinopt.progress import with_unit
from dolfinopt.scene.schema import Scene, TomlSchema
from dolfinopt.scene.tables.arms import Arm, check_arm_name
from dolfinopt.scene.tables.base import (
    Loc,
    Refusal,
    Table,
    cut,
    input_error,
    key_text,
    one_line,
    shown,
    table_in,
    without_none,
)
from dolfinopt.scene.tables.joints import DRIVE_KEYS
from dolfinopt.scene.tables.material import Material, material_keys
from dolfinopt.scene.tables.responses import need_of

COUNTS = {2: "two", 3: "three", 4: "four", 6: "six"}


class Override(NamedTuple):
    """One --set: its text, and the paths of the keys it changed."""

    text: str
    locs: tuple[Loc, ...]


UNKNOWN = ("extra_forbidden", "invalid_key")  # pydantic's types of errors


def first_problem(
    error: ValidationError, tree: dict[str, Any], source: str, changes: list[Override]
) -> str:
    """Return the one-line message of the first problem."""
    # A misspelt key is also a missing one: the spelling is the message that helps.
    errors = error.errors(include_url=False)
    text, *locs = _problem(dict(min(errors, key=lambda item: item["type"] not in UNKNOWN)), tree)
    return one_line(f"{blamed(source, changes, locs)}: {text}")


def blamed(source: str, changes: Sequence[Override], locs: Sequence[Loc]) -> str:
    """Return the place to blame for the values at `locs`: the file, or the last --set of them."""
    where = source
    for change in changes:
        if any(loc[: len(changed)] == changed for loc in locs for changed in change.locs):
            where = f"{source} with --set {cut(change.text)}"
    return where


def _problem(item: dict[str, Any], tree: dict[str, Any]) -> tuple[Any, ...]:
    """Return what one of pydantic's errors means, and the paths of all keys involved."""
    raw: Loc = item["loc"]
    loc = _key_loc(raw)
    if item["type"] in UNKNOWN:
        model = model_at(loc[:-1])
        return unknown_key(loc[:-1], loc[-1], model.model_fields if model else (), tree), loc
    if item["type"] == "missing" and len(raw) == len(loc):
        field = field_at(loc)
        text = f"missing key {dotted(loc, tree)} ({_meaning(field)})"
        if field.examples:
            text = f"missing table [{loc[-1]}] ({_meaning(field)}); write {field.examples[0]}"
        return text, loc
    reason = item.get("ctx", {}).get("error")
    if isinstance(reason, Refusal):
        locs = [(*loc, *key) for key in reason.keys] or [loc]
        return f"{_found(locs[0], tree)}: {reason.reason}", *locs
    text = wrong_value(loc, tree)
    if item["type"] == "finite_number":
        text = text.replace(" number", " finite number")
    return text, loc


def wrong_value(loc: Loc, tree: dict[str, Any]) -> str:
    """Return the message for a value of another type or range than its key has."""
    field = field_at(loc)
    return f"{_found(loc, tree)}: expected {allowed_words(field)} ({_meaning(field)})"


def check_tables(tree: dict[str, Any], source: str, changes: Sequence[Override] = ()) -> None:
    """Refuse what is no table where a scene has one; a name is one in place of [material].

    Raises:
        InputError: there is such a value.
    """
    if isinstance(tree.get("material"), str):
        tree["material"] = {"name": tree["material"]}
    for key, value in tree.items():
        field = Scene.model_fields.get(key)
        if field is None or table_in(field.annotation) is None or value is field.default:
            continue  # None is no table, but for [control]
        array = is_array(field) and isinstance(value, list | tuple)
        for i, row in enumerate(value if array else [value]):
            if not isinstance(row, dict):
                loc = (key, i) if array else (key,)
                raise input_error(blamed(source, changes, (loc,)), wrong_value(loc, tree))


def _key_loc(raw: Loc) -> Loc:
    """Return the path of the key at or above `raw`."""
    # Below a key there are only the elements of its value, which messages show as a whole.
    for depth in range(1, len(raw)):
        if not isinstance(raw[depth - 1], int) and model_at(raw[:depth]) is None:
            return raw[:depth]
    return raw


def unknown_key(above: Loc, key: Any, known: Iterable[str], tree: dict[str, Any]) -> str:
    """Return the message for `key`, which the table at `above` does not have."""
    known = list(known)
    text = f"unknown key {dotted((*above, key), tree)}"
    closest = " or ".join(_closest(above, str(key), known))
    text += f"; did you mean {closest}?" if closest else ";"
    return f"{text} allowed: {', '.join(known)}"


def _closest(above: Loc, key: str, known: list[str]) -> list[str]:
    """Return the paths that an unknown `key` of the table at `above` may have meant."""
    paths = [info.key for info in describe_keys()]
    if elsewhere := [path for path in paths if path.endswith(f".{key}")]:
        return elsewhere  # the right key in the wrong table
    starts = [name for name in known if name.startswith(key) and key]
    if near := starts or difflib.get_close_matches(key, known, 1):
        return [".".join(map(key_text, (*above, name))) for name in near]
    names = {path.rpartition(".")[2]: path for path in paths}
    return [names[name] for name in difflib.get_close_matches(key, names, 1, 0.8)]


def model_at(loc: Loc) -> type[Table] | None:
    """Return the model of the table at `loc`, None if there is a plain value."""
    model: Any = Scene
    for part in loc:
        if isinstance(part, int):
            continue  # an arm: the model is that of the array's elements
        field = model.model_fields.get(part) if model else None
        model = table_in(field.annotation) if field else None
    return model


def is_array(field: FieldInfo) -> bool:
    """Return whether a key holds an array, of tables or of values."""
    return get_origin(without_none(field.annotation)) is tuple


def field_at(loc: Loc) -> FieldInfo:
    """Return the field at `loc`; an element of `arms` counts as a field of its own."""
    if isinstance(loc[-1], int):
        return FieldInfo(annotation=model_at(loc), description=f"one of {loc[-2]}")
    model = model_at(loc[:-1])
    assert model is not None, loc
    return model.model_fields[loc[-1]]


def _meaning(field: FieldInfo) -> str:
    """Return the field's description, with its unit if it has one."""
    return str(field.description).removesuffix(" [-]")


def unit_of(field: FieldInfo) -> str:
    """Return the unit at the end of a field's description, "-" where it has none."""
    result = re.search(r" \[([^\]]*)\]$", str(field.description))
    return result[1] if result else "-"


def allowed_words(field: FieldInfo) -> str:
    """Return in words what `field` accepts."""
    kind: Any = field.annotation
    schema = TypeAdapter(Annotated[(kind, *field.metadata)] if field.metadata else kind)
    node = schema.json_schema(schema_generator=TomlSchema)
    words = _words(node, node.get("$defs", {}))
    if kind is Material:
        return f"the name of a material, or {words}"
    return f"{words} [[arms]], at least one" if table_in(kind) is Arm else words


def _words(node: dict[str, Any], tables: dict[str, Any]) -> str:
    """Return in words what a part of a JSON schema accepts."""
    node = tables.get(node.get("$ref", "").rpartition("/")[2], node)
    if "properties" in node:
        return f"a table with the keys {', '.join(node['properties'])}"
    if "description" in node:
        return str(node["description"])
    if "anyOf" in node:
        return " | ".join(_words(item, tables) for item in node["anyOf"])
    if "enum" in node or "const" in node:
        return " | ".join(map(shown, node.get("enum", [node.get("const")])))
    if node["type"] == "array":
        return f"an array of {_elements(node['items'])}"
    noun = {"number": "a number", "integer": "an integer", "string": "a string"}
    return f"{noun.get(node['type'], 'true or false')}{_bounds(node)}"


def _elements(items: Any) -> str:
    """Return in words what stands in an array: elements in their order, or alike."""
    count = f"{COUNTS[len(items)]} " if isinstance(items, list) else ""
    first = items[0] if isinstance(items, list) else items
    if "$ref" in first:
        return "tables"
    for kind in first.get("anyOf", [first]):  # of a union the shortest
        if kind["type"] == "array":
            return f"{count}arrays of {COUNTS[len(kind['items'])]} numbers"
    return f"{count}{first['type']}s{_bounds(first)}"


def _bounds(node: dict[str, Any]) -> str:
    """Return the range of a number, e.g. " >= 0 and < 1"."""
    signs = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
    bounds = [f" {sign} {node[key]:.12g}" for key, sign in signs.items() if key in node]
    return " and".join(bounds)


def _found(loc: Loc, tree: dict[str, Any]) -> str:
    """Return "key.path = value" for the value at `loc`, or for its default."""
    value, stated = value_at(loc, tree)
    return f"{dotted(loc, tree)} = {shown(value)}" + " (default)" * (not stated)


def value_at(loc: Loc, tree: Any) -> tuple[Any, bool]:
    """Return what a scene's data state at `loc`, or else the key's default, and whether they do."""
    for part in loc:
        try:
            tree = tree[part]
        except (KeyError, IndexError, TypeError):
            return field_at(loc).default, False
    return tree, True


def dotted(loc: Loc, tree: dict[str, Any]) -> str:
    """Return the TOML spelling of a path, with the name of the arm it belongs to."""
    text = ".".join(map(key_text, loc))
    named = loc[0] in ("arms", "joints", "closures", "forces") and len(loc) > 1
    name = arm_name(tree, loc[1], loc[0]) if named else None
    return f"{text} ({name})" if name and loc[2:] != ("name",) else text


def arm_name(tree: dict[str, Any], index: Any, table: str = "arms") -> str | None:
    """Return the name of an arm, or a joint, if it has one that can stand in a message."""
    try:
        return check_arm_name(tree[table][index]["name"])
    except (KeyError, IndexError, TypeError, ValueError):
        return None


# --- documentation ---------------------------------------------------------------------------


class KeyInfo(NamedTuple):
    """One key of a scene as documentation lists it.

    Attributes:
        key: dotted.
        allowed: in words.
        default: "" where there is none.
        description: meaning and unit.
        also: other tables that take the key with the same meaning.
    """

    key: str
    allowed: str
    default: str
    description: str
    also: tuple[str, ...] = ()


def describe_keys() -> list[KeyInfo]:
    """List all keys of a scene in the order of the models, e.g. `arms.length`, `payload.mass`."""
    return list(_describe(Scene, ""))


def _describe(model: type[Table], prefix: str) -> Iterator[KeyInfo]:
    for key, field in model.model_fields.items():
        below, path = table_in(field.annotation), f"{prefix}{key}"
        if below is not None:
            yield from _describe(below, f"{path}.")
        elif not _explained_at(path):
            default = "" if field.is_required() else shown(field.default)
            default = "none" if default == "None" else default
            tables = ("arms", "joints", "closures")
            also = tuple(item for item in tables if _explained_at(f"{item}.{key}") == prefix[:-1])
            told = allowed_words(field), default, str(field.description)
            yield KeyInfo(path, *told, also)


def _explained_at(path: str) -> str:
    """Return the table at which a key is explained that means the same in another one.

    Arms state their own material, and [[joints]] the drives that arms state in the plane.
    """
    table, _, key = path.rpartition(".")
    same = {
        "arms": ("material", material_keys()),
        "joints": ("arms", DRIVE_KEYS),
        "closures": ("joints", ("name", "rpy")),
    }
    place, keys = same.get(table, ("", ()))
    return place if key in keys else ""


# -- what a scene does not state and its results depend on --------------------------------------

# Defaults that an engineer would want to know of.
PHYSICAL = (("motion", "gravity"), ("damping", "stiffness_proportional"), ("motion", "horizon"),
            ("design", "volume_fraction"))  # fmt: skip


def assumed(scene: Scene) -> str:
    """Return in one line what is not stated: lengths by the arms, times, gravity, damping."""
    physical = [loc for loc in PHYSICAL if loc[1] not in getattr(scene, loc[0]).model_fields_set]
    result = [_with_value(scene, loc) for loc in dict.fromkeys((*scene.derived, *physical))]
    ends = {
        f"arms.{arm.name}.passive = {arm.solid_ends:.4g} m"
        for arm in scene.arms
        if arm.designed and arm.passive is None and arm.solid_ends > 0.0
    }
    told = [item for item in (*result, *sorted(ends)) if item]
    return f"assumed: {', '.join(told)}" if told else ""


def _with_value(scene: Scene, loc: tuple[str, str]) -> str:
    value, unit = getattr(getattr(scene, loc[0]), loc[1]), unit_of(field_at(loc))
    if value is None or loc == ("objective", "gradient"):
        return ""
    text = f"{value:.4g}" if isinstance(value, float) else shown(value)
    return with_unit(f"{loc[0]}.{loc[1]} = {text}", unit)


# -- what is possible in a scene, but hardly meant: a sentence each, told before the run ---------
#
# The tables refuse what the arithmetic cannot do; these ranges hold every structural material
# and any machine, so that what lies outside is most likely a wrong unit or a slipped digit.

# From soft foam and rubber to beyond diamond (1.2e12 Pa); from aerogel to beyond osmium
# (2.26e4 kg/m3).
YOUNG_MODULUS = 1e6, 2e12  # Pa
DENSITY = 1.0, 3e4  # kg/m3
GRAVITY = 30.0  # m/s2: more than on Jupiter
SLENDER = 1e3  # length over height, thickness over height and the like
HEAVY = 1e4  # payload over the mass of all arms


def implausible(scene: Scene) -> list[str]:
    """Return what in a valid scene is most likely a mistake, a sentence each.

    Every sentence names key, value, what is usual, and what follows from it.
    """
    groups = (_materials(scene), _sizes(scene), _motion(scene), _others(scene))
    return list(dict.fromkeys(chain(*groups)))  # arms mostly have one material: no sentence twice


def _materials(scene: Scene) -> Iterator[str]:
    for index, arm in enumerate(scene.arms):
        for key, unit, (low, high) in (
            ("young_modulus", "Pa", YOUNG_MODULUS),
            ("density", "kg/m3", DENSITY),
        ):
            value = getattr(scene.material_of(index), key)
            where = f"arms.{arm.name}" if getattr(arm, key) is not None else "material"
            for item in value if isinstance(value, tuple) else (value,):
                if arm.sid is None and not low <= item <= high:
                    yield (
                        f"{where}.{key} = {item:g} {unit} is outside the range of structural "
                        f"materials, {low:g} to {high:g} {unit}; check the unit"
                    )


def _sizes(scene: Scene) -> Iterator[str]:
    for index, arm in enumerate(scene.arms):
        if not arm.own:
            continue
        if arm.height > arm.length and arm.interface_offset is None:
            yield (
                f"arms.{arm.name}: its height, {arm.height:g} m, exceeds its length, "
                f"{arm.length:g} m, which is measured from joint to joint; check both"
            )
        if arm.length > SLENDER * arm.height or arm.thickness > SLENDER * arm.height:
            yield (
                f"arms.{arm.name}: length {arm.length:g} m, height {arm.height:g} m and thickness "
                f"{arm.thickness:g} m differ by more than a factor of {SLENDER:g}; check the units"
            )
        if arm.designed and (radius := scene.filter_radius(index)) > arm.height:
            yield (
                f"design.filter_radius = {radius:g} m exceeds the height of arm {arm.name!r}, "
                f"{arm.height:g} m: its design cannot vary across the arm"
            )


def _motion(scene: Scene) -> Iterator[str]:
    damping, motion = scene.damping.stiffness_proportional, scene.motion
    if need_of(scene, "motion") and damping > motion.duration:
        yield (
            f"damping.stiffness_proportional = {damping:g} s: deflections relax in that time, "
            f"longer than motion.duration = {motion.duration:g} s, so that the arms hardly "
            "deflect; usual values are 1e-5 to 1e-2 s"
        )
    if max(map(abs, motion.gravity)) > GRAVITY:
        yield (
            f"motion.gravity = {list(motion.gravity)} m/s2 exceeds {GRAVITY:g} m/s2; that of the "
            "Earth is 9.81"
        )
    mass = sum(
        arm.length * arm.height * arm.thickness * scene.material_of(index).density
        for index, arm in enumerate(scene.arms)
    )
    if scene.payload.mass > HEAVY * mass:
        yield (
            f"payload.mass = {scene.payload.mass:g} kg is more than {HEAVY:g} times the mass of "
            f"all arms, {mass:.3g} kg"
        )


def _others(scene: Scene) -> Iterator[str]:
    """Yield where the default of solid ends comes to nothing, and older words, in one line."""
    for arm in scene.arms:
        ends = arm.designed and arm.cells is not None and arm.passive is None
        if ends and not arm.passive_columns:
            yield (
                f"arms.{arm.name}.cells = {list(arm.cells or ())}: too coarse for the solid ends "
                f"of {arm.solid_ends:.3g} m that are kept by default, so that the joint may end up "
                "in void; take more cells along the arm, or state arms.passive"
            )
    if scene.old_words:
        rewrite = f"dolfinopt keys --upgrade {scene.source} rewrites the scene"
        yield f"older words: {'; '.join(scene.old_words)}; {rewrite}"
