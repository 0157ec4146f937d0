"""Older words of a scene: each is read as what it is now, and told in one line.

The tree is the scene as read, before it is validated: values of any type may stand in it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from dolfinopt.errors import InputError
from dolfinopt.scene.tables import closures
from dolfinopt.scene.tables.joints import INBOARD, OUTBOARD, site_of
from dolfinopt.scene.tables.responses import OLD_KINDS, OLD_LIMITS

Tree = dict[str, Any]
Row = dict[str, Any]


@dataclass(frozen=True)
class OldWord:
    """An older key.

    Attributes:
        old: dotted key.
        new: what it is now, for people.
        translate: takes tree, row and value and puts the value in its place; None: no effect.
        default: value that it had where it was not stated, which is not told.
    """

    old: str
    new: str
    translate: Callable[[Tree, Row, Any], None] | None = None
    default: Any = None


def _renamed(key: str) -> Callable[[Tree, Row, Any], None]:
    def translate(tree: Tree, row: Row, value: Any) -> None:
        row[key] = value

    return translate


def _scaled(key: str) -> Callable[[Tree, Row, Any], None]:
    """Multiply the numbers of an array."""

    def translate(tree: Tree, row: Row, value: Any) -> None:
        row[key] = scaled(row.get(key), value)

    return translate


def scaled(value: Any, factor: Any) -> Any:
    """Return a number, or an array of them, times a factor; what is neither as it is."""
    if isinstance(value, list | tuple):
        return [scaled(item, factor) for item in value]
    numbers = (int, float)
    is_number = isinstance(value, numbers) and isinstance(factor, numbers)
    return float(value) * factor if is_number and not isinstance(value, bool) else value


def _of_site(key: str) -> Callable[[Tree, Row, Any], None]:
    """Add an interface to the name of its arm: "arm.interface"."""

    def translate(tree: Tree, row: Row, value: Any) -> None:
        arm = row.get(key)
        if arm is None:
            arm = next((item.get("name") for item in reversed(rows(tree, "arms"))), "")
        row[key] = site_of(str(arm))[0]
        if str(value).casefold() != OUTBOARD:
            row[key] += f".{value}"

    return translate


def _symmetric_z(tree: Tree, row: Row, value: Any) -> None:
    arms = rows(tree, "arms")
    before = arms[max(0, arms.index(row) - 1)] if "symmetric" not in row else row
    about_y = before.get("symmetric") in (True, "yz")
    row["symmetric"] = ("yz" if about_y else "z") if value else about_y


def _frequencies(method: str) -> Callable[[Tree, Row, Any], None]:
    def translate(tree: Tree, row: Row, value: Any) -> None:
        if row.get("method") == method:
            row["frequencies"] = value

    return translate


def _bore(name: str) -> Callable[[Tree, Row, Any], None]:
    def translate(tree: Tree, row: Row, value: Any) -> None:
        given = value if isinstance(value, Mapping) else {}
        others = row.get("interfaces") or []
        known: Row = next((other for other in others if other.get("name") == name), {})
        row["interfaces"] = [{"name": name, **known, **given}]
        row["interfaces"] += [other for other in others if other.get("name") != name]

    return translate


def _fixed_at(tree: Tree, row: Row, value: Any) -> None:
    if row.get("base") == "fixed":
        row["base"] = value


def _steps(tree: Tree, row: Row, value: Any) -> None:
    if row.get("optimize") is True:
        row["optimize"] = value


def _of_motion(key: str) -> Callable[[Tree, Row, Any], None]:
    def translate(tree: Tree, row: Row, value: Any) -> None:
        tree.setdefault("motion", {})[key] = value

    return translate


def _way(tree: Tree, row: Row, value: Any) -> None:
    if not tree.get("joints"):
        tree.setdefault("motion", {})["elbow"] = value


def _eroded(tree: Tree, row: Row, value: Any) -> None:
    if row.get("projection") == "robust" and value != "nominal":
        row["projection"] = f"robust-{value}"


def _first_mode(tree: Tree, row: Row, value: Any) -> None:
    if value:
        row["modes"] = "first" if value is True else value


def _exact(tree: Tree, row: Row, value: Any) -> None:
    if value:
        tree.setdefault("objective", {})
        for objective in rows(tree, "objective"):
            objective["gradient"] = "exact"


OLD_WORDS = (
    OldWord("arms.joint_stiffness", "arms.gear_stiffness", _renamed("gear_stiffness"), 0.0),
    OldWord("arms.joint_damping", "arms.gear_damping", _renamed("gear_damping"), 0.0),
    OldWord(
        "arms.symmetric_z", 'arms.symmetric = "z", "yz" about both planes', _symmetric_z, False
    ),
    OldWord("arms.pattern", "arms.design", _renamed("design")),
    OldWord("arms.hull", "arms.hollow = its file", _renamed("hollow")),
    OldWord("arms.section", "arms.hollow = the section", _renamed("hollow")),
    OldWord("arms.inboard_bore", 'an entry "inboard" of [[arms.interfaces]]', _bore(INBOARD)),
    OldWord("arms.outboard_bore", 'an entry "outboard" of [[arms.interfaces]]', _bore(OUTBOARD)),
    OldWord(
        "joints.parent_interface", 'joints.parent = "arm.interface"', _of_site("parent"), OUTBOARD
    ),
    OldWord("payload.interface", 'payload.arm = "arm.interface"', _of_site("arm"), OUTBOARD),
    OldWord("forces.interface", 'forces.arm = "arm.interface"', _of_site("arm"), OUTBOARD),
    OldWord("closures.direction", "closures.axis", _renamed("axis")),
    OldWord("reduction.shifts", "reduction.frequencies", _frequencies("krylov"), [0.0]),
    OldWord("reduction.band", "reduction.frequencies", _frequencies("balanced"), [0.0, 50.0]),
    OldWord("control.stiffness_factor", "control.stiffness times it", _scaled("stiffness"), 1.0),
    OldWord("control.damping_factor", "control.damping times it", _scaled("damping"), 1.0),
    OldWord("optimizer.exact_iterations", 'objective.gradient = "exact"', _exact, 0),
    OldWord("simulation.integrator", "every motion is integrated by Radau IIA", None, "radau"),
    OldWord("design.limits_on", 'design.projection = "robust-eroded"', _eroded, "nominal"),
    OldWord("objective.follow", 'objective.modes = "first"', _first_mode, False),
    OldWord("closures.side", "motion.elbow", _way),
    OldWord("motion.base_position", "motion.base = the number", _fixed_at, 0.0),
    OldWord("constraints.path_speed", "motion.max_speed", _of_motion("max_speed")),
    OldWord(
        "constraints.path_acceleration", "motion.max_acceleration", _of_motion("max_acceleration")
    ),
    OldWord("constraints.path_jerk", "motion.max_jerk", _of_motion("max_jerk")),
    OldWord("part.iterations", "part.optimize = the number", _steps, 80),
    OldWord("simulation.stages", "steps have four stages", None, 4),
    OldWord("part.curves", "parts have lines, arcs and circles", None, "splines"),
    OldWord("part.simplify", "parts have lines, arcs and circles", None, False),
    OldWord("simulation.rho_inf", "every motion is integrated by Radau IIA", None, 0.8),
    *(OldWord(f"constraints.{old}", f"constraints.{key}", _renamed(key))
      for old, key in OLD_LIMITS.items()),
)  # fmt: skip
OLD_KEYS = {word.old for word in OLD_WORDS}


def in_new_words(key: str) -> str:
    """Return a dotted key in the words of now, as --set takes it; one of now as it is."""
    key = closures.in_new_words(key)
    place, dot, name = key.rpartition(".")
    table = place.partition(".")[0]
    word = next((item for item in OLD_WORDS if item.old == f"{table}.{name}"), None)
    if word is not None and (result := re.fullmatch(r"[a-z]+\.([a-z_]+)( times it)?", word.new)):
        name = result[1] + ("*" if result[2] else "")
    return place + dot + name


def rows(tree: Mapping[str, Any], key: str) -> list[Row]:
    """Return the tables of an array of tables, or the only one."""
    node = tree.get(key)
    return [row for row in (node if isinstance(node, list) else [node]) if isinstance(row, dict)]


def read_old_words(tree: Tree, source: str, anew: bool = False) -> list[str]:
    """Put older words of a scene's data in their places; return "older is read as newer" of each.

    Args:
        tree: the scene's data, changed.
        source: file, for messages.
        anew: whether they change what the scene stated, as overrides do.

    Raises:
        InputError: a scene states older and newer word of the same.
    """
    told = []
    for word in OLD_WORDS:
        table, key = word.old.split(".")
        for row in rows(tree, table):
            if key not in row:
                continue
            value = row.pop(key)
            unset = value is None or _plain(value) == word.default
            if value is not None and word.translate is not None and (anew or not unset):
                if not anew:
                    _refuse_both(row, word, source)
                word.translate(tree, row, value)
            elif value is not None and word.translate is not None and table == "arms":
                _keep(tree, row, word, value)
            if not unset or (anew and word.translate is not None):
                told.append(f"{word.old} is read as {word.new}")
    for row in rows(tree, "objective"):
        kind = row.get("kind")
        if isinstance(kind, str) and kind in OLD_KINDS:
            row["kind"] = OLD_KINDS[kind]
            told.append(f'objective.kind = "{kind}" is read as "{OLD_KINDS[kind]}"')
    return list(dict.fromkeys(told))


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _keep(tree: Tree, row: Row, word: OldWord, value: Any) -> None:
    """Put a stated default in its place, which the arm before may not have: it is taken over."""
    key = word.new.partition(".")[2].partition(" ")[0]
    if key not in row and word.translate is not None:
        word.translate(tree, row, value)


def _refuse_both(row: Row, word: OldWord, source: str) -> None:
    """Refuse a scene that states a value by the newer word, too."""
    table, _, key = word.new.partition(".")
    if table in word.old and row.get(key) not in (None, 0.0):
        raise InputError(
            f"{source}: {word.old}: expected only one of it and {word.new}: they are the same"
        )
