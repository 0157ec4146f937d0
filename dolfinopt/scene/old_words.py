"""Older words of a scene: each is read as what it is now, and told in one line.

The tree is the scene as read, before it is validated: values of any type may stand in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

from dolfinopt.data import tables_of
from dolfinopt.errors import InputError
from dolfinopt.scene.tables.base import input_error, rows
from dolfinopt.scene.tables.joints import GROUND, INBOARD, OUTBOARD, site_of

Tree = dict[str, Any]
Row = dict[str, Any]
CLOSURE = "closure"  # an older table, and the name of what it states in others
OLD_CLOSURE = (
    "[closure] is read as one of [[closures]], closure.direction as its axis, closure.force as the "
    'factor of the force "closure" among [[forces]]; state those'
)
OLD_KINDS = {"compliance": "integral_compliance", "first_frequency": "eigenfrequency"}


class OldWord(NamedTuple):
    """An older key, see old_words.toml.

    Attributes:
        old: dotted key.
        new: dotted key of now; "": it has no effect.
        words: what it is now, for people, where `new` does not say it.
        default: value that it had where it was not stated, which is not told.
        only_with: another key of its table, and the value of that with which it has an effect.
    """

    old: str
    new: str = ""
    words: str = ""
    default: Any = None
    only_with: tuple[str, Any] | None = None

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
        if self.only_with and row.get(self.only_with[0]) != self.only_with[1]:
            return
        table, key = self.new.split(".")
        if translation := TRANSLATIONS.get(self.old):
            value = translation(value, row.get(key), row, tree)
        target = row if table == self.old.partition(".")[0] else tree.setdefault(table, {})
        if value is not None:
            target[key] = value


# -- values that are other ones now --------------------------------------------------------------

# The older value, that of the key of now in the same row, row and tree; returns the value of now,
# None: none.
Translation = Callable[[Any, Any, Row, Tree], Any]


def scaled(value: Any, factor: Any) -> Any:
    """Return a number, or an array of them, times a factor; what is neither as it is."""
    if isinstance(value, list | tuple):
        return [scaled(item, factor) for item in value]
    numbers = (int, float)
    is_number = isinstance(value, numbers) and isinstance(factor, numbers)
    return float(value) * factor if is_number and not isinstance(value, bool) else value


def _scaled(factor: Any, value: Any, row: Row, tree: Tree) -> Any:
    return scaled(value, factor)


def _last_arm(tree: Tree) -> Any:
    return next((arm.get("name") for arm in reversed(rows(tree, "arms"))), "")


def _site(interface: Any, arm: Any, row: Row, tree: Tree) -> str:
    """Return "arm.interface" of the arm that a row states, else of the last one."""
    if arm is None:
        arm = _last_arm(tree)
    name = site_of(str(arm))[0]
    return name if str(interface).casefold() == OUTBOARD else f"{name}.{interface}"


def _symmetric(words: Mapping[bool, Any], value: Any, known: Any, row: Row, tree: Tree) -> Any:
    """Return `symmetric` of one more symmetry: by whether the arm has that about y = 0."""
    arms = rows(tree, "arms")
    if "symmetric" not in row:
        known = arms[max(0, arms.index(row) - 1)].get("symmetric")
    about_y = known in (True, "yz", "y-extruded")
    return words[about_y] if value else about_y


def _bore(name: str, value: Any, interfaces: Any, row: Row, tree: Tree) -> list[Row]:
    given = value if isinstance(value, Mapping) else {}
    others = interfaces or []
    known: Row = next((other for other in others if other.get("name") == name), {})
    first = {"name": name, **known, **given}
    return [first, *(other for other in others if other.get("name") != name)]


def _body(value: Any, mesh: Any, row: Row, tree: Tree) -> Any:
    row.pop("cells", None)
    return value


def _turned(axis: Any, angle: Any, row: Row, tree: Tree) -> Any:
    """Return roll, pitch and yaw of a turn about an axis; give them to arms that state no axis."""
    if not tree.get("joints"):
        return None  # in the plane there is one axis
    arms, material = rows(tree, "arms"), tree.get("material")
    for arm in arms if row is material else arms[arms.index(row) + 1 :]:
        if "angle_axis" in arm:
            break
        if "angle" in arm:
            arm["angle"] = _roll_pitch_yaw(axis, arm["angle"])
    usual = material.get("angle") if isinstance(material, dict) else None
    return _roll_pitch_yaw(axis, angle if "angle" in row else usual)


def _roll_pitch_yaw(axis: Any, angle: Any) -> Any:
    from scipy.spatial.transform import Rotation  # which newer scenes do not need

    try:
        size = math.hypot(*axis)
        turn = Rotation.from_rotvec([angle * x / size for x in axis])
        return turn.as_euler("xyz").tolist()
    except (TypeError, ValueError, ZeroDivisionError):
        return angle  # as it is, which may be refused


TRANSLATIONS: Mapping[str, Translation] = {
    "arms.symmetric_z": partial(_symmetric, {True: "yz", False: "z"}),
    "arms.extruded": partial(_symmetric, {True: "y-extruded", False: "extruded"}),
    "arms.sid": _body,
    "arms.inboard_bore": partial(_bore, INBOARD),
    "arms.outboard_bore": partial(_bore, OUTBOARD),
    "arms.angle_axis": _turned,
    "material.angle_axis": _turned,
    "joints.parent_interface": _site,
    "payload.interface": _site,
    "forces.interface": _site,
    "closures.side": lambda side, _, row, tree: None if tree.get("joints") else side,
    "reduction.tolerance": lambda error, count, *_: (
        error if isinstance(count, str | float) else None
    ),
    "control.stiffness_factor": _scaled,
    "control.damping_factor": _scaled,
    "optimizer.exact_iterations": lambda count, *_: "exact" if count else None,
    "design.limits_on": lambda word, *_: None if word == "nominal" else f"robust-{word}",
    "objective.follow": lambda value, *_: "first" if value is True else value or None,
    "motion.start_angle": lambda angle, joints, *_: [angle, *(joints or [])[1:]],
}

OLD_WORDS = {old: OldWord(old, **entry) for old, entry in tables_of("scene/old_words.toml").items()}


def is_old(path: tuple[Any, ...]) -> bool:
    """Return whether a path of a scene is that of an older key, or lies below one."""
    keys = [str(part) for part in path if not isinstance(part, int)]
    return keys[0] == CLOSURE or ".".join(keys[:2]) in OLD_WORDS


def in_new_words(key: str) -> str:
    """Return a dotted key in the words of now, as --set takes it; one of now as it is."""
    place, _, name = key.rpartition(".")
    table = place.partition(".")[0]
    word = OLD_WORDS.get(f"{table}.{name}")
    if word is None:
        return f"closures.0.{name}" if place == CLOSURE else key
    if TRANSLATIONS.get(word.old) is _scaled:
        return f"{place}.{word.new.rpartition('.')[2]}*"
    if word.words:
        return key
    return f"{place}.{word.new.rpartition('.')[2]}" if word.is_renamed else word.new


# -- a scene's data ------------------------------------------------------------------------------


def read_old_words(tree: Tree, source: str, anew: bool = False) -> list[str]:
    """Put older words of a scene's data in their places; return "older is read as newer" of each.

    Args:
        tree: the scene's data, changed.
        source: file, for messages.
        anew: whether they change what the scene stated, as overrides do.

    Raises:
        InputError: a scene states older and newer word of the same.
    """
    told = _read_closure(tree, source, anew)
    for word in OLD_WORDS.values():
        table, key = word.old.split(".")
        for row in rows(tree, table):
            if key not in row:
                continue
            value = row.pop(key)
            plain = list(value) if isinstance(value, tuple) else value
            unset = value is None or plain == word.default
            if word.new and value is not None:
                if not anew and not unset:
                    _refuse_both(row, word, source)
                # A stated default counts where else another value would: the arm before's, or
                # that of a guess.
                known = word.new.rpartition(".")[2]
                guessed = key == "start_angle" and row.get(known) is not None
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


def _refuse_both(row: Row, word: OldWord, source: str) -> None:
    """Refuse a scene that states a value by the newer word, too."""
    key = word.new.rpartition(".")[2]
    if word.is_renamed and row.get(key) not in (None, 0.0):
        raise InputError(
            f"{source}: {word.old}: expected only one of it and {word.new}: they are the same"
        )


def _read_closure(tree: Tree, source: str, anew: bool) -> list[str]:
    """Put [closure] in its places: [[closures]], and `force` in [[forces]]."""
    if (table := tree.pop(CLOSURE, None)) is None:
        return []
    others = not anew and (tree.get("closures") or tree.get("joints"))
    if others or not isinstance(table, dict):
        raise input_error(source, "closure: expected [[closures]], of which it is an older word")
    arm, load = _last_arm(tree), table.pop("force", None)
    tree["closures"] = tree.get("closures") or [{"name": CLOSURE, "between": [arm, GROUND]}]
    row = tree["closures"][0]
    row.update(table)
    axis = row["axis"] = row.pop("direction", row.get("axis", [1.0, 0.0]))
    if row.get("kind") != "slider" and axis == [1.0, 0.0]:
        del row["axis"]  # the default of a line
    forces = [force for force in rows(tree, "forces") if force.get("name") == CLOSURE]
    if load and not forces:
        forces = [{"name": CLOSURE, "arm": arm}]
        tree["forces"] = [*(tree.get("forces") or []), *forces]
    for force in forces:
        if load is not None:
            force["factor"] = load
        if load is not None or "direction" in table:
            force["force"] = _unit(axis)
    return [OLD_CLOSURE]


def _unit(axis: Any) -> list[float]:
    """Return an axis of the plane of length 1; along x where it is none, which is refused."""
    try:
        return [x / math.hypot(*axis[:2]) for x in axis[:2]]
    except (TypeError, ZeroDivisionError):
        return [1.0, 0.0]
