"""Older words of a scene: each is read as what it is now, and told in one line.

The tree is the scene as read, before it is validated: values of any type may stand in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from dolfinopt.errors import InputError
from dolfinopt.scene.tables import closures
from dolfinopt.scene.tables.base import rows
from dolfinopt.scene.tables.joints import INBOARD, OUTBOARD, site_of
from dolfinopt.scene.tables.responses import OLD_KINDS, OLD_LIMITS

Tree = dict[str, Any]
Row = dict[str, Any]


# Tree, row of the older key, key of now and the older value; returns that of now, None: none.
Translation = Callable[[Tree, Row, str, Any], Any]


def _same(tree: Tree, row: Row, key: str, value: Any) -> Any:
    return value


@dataclass(frozen=True)
class OldWord:
    """An older key.

    Attributes:
        old: dotted key.
        new: dotted key of now; "": it has no effect.
        value: what that has.
        words: what it is now, for people, where `new` does not say it.
        default: value that it had where it was not stated, which is not told.
    """

    old: str
    new: str
    value: Translation = _same
    words: str = ""
    default: Any = None

    @property
    def told(self) -> str:
        """What it is now, for people."""
        return self.words or self.new

    @property
    def is_renamed(self) -> bool:
        """Whether it is another name of a key of the same table."""
        return not self.words and self.new.partition(".")[0] == self.old.partition(".")[0]

    def put(self, tree: Tree, row: Row, value: Any) -> None:
        """Put the value of a row of its table in the place of now."""
        table, key = self.new.split(".")
        result = self.value(tree, row, key, value)
        target = row if table == self.old.partition(".")[0] else tree.setdefault(table, {})
        if result is not None:
            target[key] = result


def scaled(value: Any, factor: Any) -> Any:
    """Return a number, or an array of them, times a factor; what is neither as it is."""
    if isinstance(value, list | tuple):
        return [scaled(item, factor) for item in value]
    numbers = (int, float)
    is_number = isinstance(value, numbers) and isinstance(factor, numbers)
    return float(value) * factor if is_number and not isinstance(value, bool) else value


def _scaled(tree: Tree, row: Row, key: str, value: Any) -> Any:
    return scaled(row.get(key), value)


def _site(tree: Tree, row: Row, key: str, value: Any) -> str:
    """Return "arm.interface" of the arm that a row states, else of the last one."""
    arm = row.get(key)
    if arm is None:
        arm = next((item.get("name") for item in reversed(rows(tree, "arms"))), "")
    name = site_of(str(arm))[0]
    return name if str(value).casefold() == OUTBOARD else f"{name}.{value}"


def _symmetric_z(tree: Tree, row: Row, key: str, value: Any) -> Any:
    arms = rows(tree, "arms")
    before = arms[max(0, arms.index(row) - 1)] if key not in row else row
    about_y = before.get(key) in (True, "yz")
    return ("yz" if about_y else "z") if value else about_y


def _only_with(key: str, *values: Any) -> Translation:
    """Return the translation of a key that has an effect with some values of another one alone."""
    return lambda tree, row, _, value: value if row.get(key) in values else None


def _bore(name: str) -> Translation:
    def interfaces(tree: Tree, row: Row, key: str, value: Any) -> list[Row]:
        given = value if isinstance(value, Mapping) else {}
        others = row.get(key) or []
        known: Row = next((other for other in others if other.get("name") == name), {})
        first = {"name": name, **known, **given}
        return [first, *(other for other in others if other.get("name") != name)]

    return interfaces


def _way(tree: Tree, row: Row, key: str, value: Any) -> Any:
    return None if tree.get("joints") else value


def _eroded(tree: Tree, row: Row, key: str, value: Any) -> str | None:
    return f"robust-{value}" if row.get(key) == "robust" and value != "nominal" else None


def _first_mode(tree: Tree, row: Row, key: str, value: Any) -> Any:
    return "first" if value is True else value or None


def _first_joint(tree: Tree, row: Row, key: str, value: Any) -> list[Any]:
    return [value, *(row.get(key) or [])[1:]]


def _exact(tree: Tree, row: Row, key: str, value: Any) -> str | None:
    return "exact" if value else None


BY_RADAU = "every motion is integrated by Radau IIA"
CURVES = "parts have lines, arcs and circles"
OLD_WORDS = (
    OldWord("arms.joint_stiffness", "arms.gear_stiffness", default=0.0),
    OldWord("arms.joint_damping", "arms.gear_damping", default=0.0),
    OldWord("arms.symmetric_z", "arms.symmetric", _symmetric_z,
            'arms.symmetric = "z", "yz" about both planes', False),
    OldWord("arms.pattern", "arms.design"),
    OldWord("arms.hull", "arms.hollow", words="arms.hollow = its file"),
    OldWord("arms.section", "arms.hollow", words="arms.hollow = the section"),
    OldWord("arms.inboard_bore", "arms.interfaces", _bore(INBOARD),
            'an entry "inboard" of [[arms.interfaces]]'),
    OldWord("arms.outboard_bore", "arms.interfaces", _bore(OUTBOARD),
            'an entry "outboard" of [[arms.interfaces]]'),
    OldWord("joints.parent_interface", "joints.parent", _site,
            'joints.parent = "arm.interface"', OUTBOARD),
    OldWord("payload.interface", "payload.arm", _site, 'payload.arm = "arm.interface"', OUTBOARD),
    OldWord("forces.interface", "forces.arm", _site, 'forces.arm = "arm.interface"', OUTBOARD),
    OldWord("closures.direction", "closures.axis"),
    OldWord("reduction.shifts", "reduction.frequencies", _only_with("method", "krylov"),
            default=[0.0]),
    OldWord("reduction.band", "reduction.frequencies", _only_with("method", "balanced"),
            default=[0.0, 50.0]),
    OldWord("control.stiffness_factor", "control.stiffness", _scaled,
            "control.stiffness times it", 1.0),
    OldWord("control.damping_factor", "control.damping", _scaled, "control.damping times it", 1.0),
    OldWord("optimizer.exact_iterations", "objective.gradient", _exact,
            'objective.gradient = "exact"', 0),
    OldWord("simulation.integrator", "", words=BY_RADAU, default="radau"),
    OldWord("design.limits_on", "design.projection", _eroded,
            'design.projection = "robust-eroded"', "nominal"),
    OldWord("objective.follow", "objective.modes", _first_mode, 'objective.modes = "first"', False),
    OldWord("closures.side", "motion.elbow", _way),
    OldWord("motion.base_position", "motion.base", _only_with("base", "fixed"),
            "motion.base = the number", 0.0),
    OldWord("motion.start_angle", "motion.initial_joints", _first_joint,
            "motion.initial_joints = [it]", 0.0),
    OldWord("constraints.path_speed", "motion.max_speed"),
    OldWord("constraints.path_acceleration", "motion.max_acceleration"),
    OldWord("constraints.path_jerk", "motion.max_jerk"),
    OldWord("part.iterations", "part.optimize", _only_with("optimize", True),
            "part.optimize = the number", 80),
    OldWord("simulation.stages", "", words="steps have four stages", default=4),
    OldWord("part.curves", "", words=CURVES, default="splines"),
    OldWord("part.simplify", "", words=CURVES, default=False),
    OldWord("simulation.rho_inf", "", words=BY_RADAU, default=0.8),
    *(OldWord(f"constraints.{old}", f"constraints.{key}") for old, key in OLD_LIMITS.items()),
)  # fmt: skip
OLD_KEYS = {word.old for word in OLD_WORDS}


def in_new_words(key: str) -> str:
    """Return a dotted key in the words of now, as --set takes it; one of now as it is."""
    key = closures.in_new_words(key)
    place, _, name = key.rpartition(".")
    table = place.partition(".")[0]
    word = next((item for item in OLD_WORDS if item.old == f"{table}.{name}"), None)
    if word is not None and word.value is _scaled:
        return f"{place}.{word.new.rpartition('.')[2]}*"
    if word is None or word.words:
        return key
    return f"{place}.{word.new.rpartition('.')[2]}" if word.is_renamed else word.new


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
            if word.new and value is not None:
                if not anew and not unset:
                    _refuse_both(row, word, source)
                # A stated default counts where else another value would: the arm before's, or
                # that of a guess.
                known = word.new.rpartition(".")[2]
                guessed = word.value is _first_joint and row.get(known) is not None
                stated = known not in row if table == "arms" else guessed
                if anew or not unset or stated:
                    word.put(tree, row, value)
            if not unset or (anew and word.new):
                told.append(f"{word.old} is read as {word.told}")
    for row in rows(tree, "objective"):
        kind = row.get("kind")
        if isinstance(kind, str) and kind in OLD_KINDS:
            row["kind"] = OLD_KINDS[kind]
            told.append(f'objective.kind = "{kind}" is read as "{OLD_KINDS[kind]}"')
    return list(dict.fromkeys(told))


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _refuse_both(row: Row, word: OldWord, source: str) -> None:
    """Refuse a scene that states a value by the newer word, too."""
    key = word.new.rpartition(".")[2]
    if word.is_renamed and row.get(key) not in (None, 0.0):
        raise InputError(
            f"{source}: {word.old}: expected only one of it and {word.new}: they are the same"
        )
