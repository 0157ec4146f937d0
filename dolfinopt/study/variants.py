"""Variants of a scene: other values, objectives and reductions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from dolfinopt.data import tables_of
from dolfinopt.errors import InputError
from dolfinopt.loading import load_scene
from dolfinopt.scene.load import Scene, scene_from_dict
from dolfinopt.scene.messages import model_at, unit_of
from dolfinopt.scene.old_words import in_new_words
from dolfinopt.scene.schema import flattened
from dolfinopt.scene.tables.responses import DECLARED, unused_options

# Labels; kind and settings of each: the paper's, and those that a comparison adds to them.
OBJECTIVES, RESPONSES = (
    list(group.items()) for group in tables_of("study/objectives.toml").values()
)
# Craig-Bampton with this many coordinates stands for the unreduced arm.
REFERENCE_METHOD, REFERENCE = "craig-bampton", 48
COORDINATES = "reduction.coordinates"
METHODS = ("craig-bampton", "modal", "krylov", "balanced")
# The Gramian's responses span few directions; more coordinates have nothing to describe.
MOST = {"balanced": 12}


# -- values ----------------------------------------------------------------------------------


class Vary(NamedTuple):
    """One scene value by its path, the numbers it takes, and the text that asks for it."""

    key: str
    values: tuple[float, ...]
    text: str

    def setting(self, value: float) -> str:
        """Return "key=value" of one of them; whole numbers as such: a key may be an integer."""
        return f"{self.key}={value!r}".removesuffix(".0")

    @property
    def whole_numbers(self) -> list[int]:
        """The values as whole numbers; InputError where one is none."""
        for value in self.values:
            if value % 1.0:
                raise InputError(f"--vary {self.text}: expected whole numbers, found {value:g}")
        return list(map(int, self.values))

    @property
    def axis(self) -> str:
        """Key with its unit, for axes and columns."""
        return axis_of(self.key)


def axis_of(key: str) -> str:
    """Return a key with its unit, "[-]" where it has none; "key*" is a factor."""
    table, *_, name = in_new_words(key).split(".")
    model = model_at((table,))
    field = model.model_fields.get(name) if model else None
    return f"{key} [{unit_of(field) if field and not name.endswith('*') else '-'}]"


def parse_vary(text: str) -> Vary:
    """Return what "key.path=start:stop:count" or "key.path=a,b,c" asks for, else InputError."""
    key, _, values = text.partition("=")
    is_range = ":" in values
    parts = values.split(":" if is_range else ",")
    try:
        numbers = list(map(float, parts))
        if is_range:
            start, stop, _ = numbers
            count = int(parts[2])
    except ValueError:
        numbers = [math.nan]
    if not key.strip() or not np.isfinite(numbers).all():
        raise InputError(
            f"--vary {text}: expected key.path=start:stop:count or key.path=a,b,c with numbers, "
            "for example payload.mass=4:8:9"
        )
    if is_range:
        if count < 2 or start == stop:
            raise InputError(f"--vary {text}: expected at least two values between two ends")
        numbers = list(map(float, np.linspace(start, stop, count)))
    return Vary(key.strip(), tuple(dict.fromkeys(numbers)), text)


def changed(scene: Scene, *overrides: str) -> Scene:
    """Return the scene with some values changed, each "key.path=value".

    InputError where there is no such key, or it does not allow the value.
    """
    return load_scene(scene, overrides)


@contextmanager
def asked_by(words: str) -> Iterator[None]:
    """Let every InputError of the block begin with what asked for it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{words}: {error}") from None


def differences(scene: Scene, other: Scene) -> dict[str, tuple[Any, Any]]:
    """Return by its key every value in which scenes differ, here and there; None: not set."""
    here, there = (dict(flattened(item.to_dict())) for item in (scene, other))
    pairs = {key: (here.get(key), there.get(key)) for key in [*here, *there]}
    return {key: (a, b) for key, (a, b) in pairs.items() if a != b}


# -- objectives ------------------------------------------------------------------------------


def with_objective(scene: Scene, kind: str, *settings: str) -> Scene:
    """Return the scene with another objective and options of it, each "key=value".

    Options that nothing uses any more are left out; InputError where the scene cannot have it.
    """
    tree = scene.to_tree()
    tree["objective"] |= {"kind": kind}
    _drop_unused(tree)
    return scene_from_dict(tree, scene.source, [f"objective.{setting}" for setting in settings])


def posed(scene: Scene, kind: str) -> Scene:
    """Return the scene with another objective, for designs that can be compared with each other.

    What falls with the mass needs the scene's limits and takes as much material as they ask for;
    what falls with stiffness has the volume for its limit, by default half of it, and no other.
    InputError where the scene cannot have that objective.
    """
    tree = scene.to_tree()
    tree["objective"] |= {"kind": kind, "direction": None}
    if kind not in DECLARED:
        return scene_from_dict(tree, scene.source)  # which refuses it
    if not DECLARED[kind].lighter:
        tree["constraints"] = {"settling_after": scene.constraints.settling_after}
    elif not scene.objective.response.lighter or "volume_fraction" not in tree["design"]:
        tree["design"]["volume_fraction"] = None if kind == "mass" else 1.0
        if kind == "mass":
            tree["design"]["shared_volume"] = False
    _drop_unused(tree)
    return scene_from_dict(tree, scene.source)


def _drop_unused(tree: dict[str, Any]) -> None:
    """Take out of a scene's data what its objective and its limits do not use."""
    keys = {response.key for response in DECLARED.values()}
    limited = [k for k, limit in tree["constraints"].items() if limit is not None and k in keys]
    for key in unused_options(list(tree["objective"]), tree["objective"]["kind"], limited):
        tree["objective"].pop(key, None)


# -- reductions ------------------------------------------------------------------------------


def reduced(scene: Scene, method: str, coordinates: int) -> Scene:
    """Return the scene with another reduction; options of its own method are kept.

    InputError where the arms have fewer degrees of freedom, or the method needs more coordinates.
    """
    tree = scene.to_tree()
    same = scene.reduction.method == method
    kept = {"frequencies": scene.reduction.frequencies} if same else {}
    tree["reduction"] = kept | {"method": method, "coordinates": coordinates}
    return scene_from_dict(tree, scene.source)


def reference_scene(scene: Scene) -> Scene:
    """Return the scene with so many coordinates that more make no difference."""
    most = [arm.n_reducible for arm in scene.arms if arm.n_reducible is not None]
    return reduced(scene, REFERENCE_METHOD, min([REFERENCE, *most]))


def reductions(scene: Scene, counts: Sequence[int] | None, usual: Sequence[int]) -> list[Scene]:
    """Return the scene with every method and number of coordinates that it can have.

    InputError where one that was asked for, `counts`, is possible with no method.
    """
    scenes: list[Scene] = []
    refusals: dict[int, InputError] = {}
    for method in METHODS:
        for count in usual if counts is None else counts:
            if counts is not None or count <= MOST.get(method, count):
                try:
                    scenes.append(reduced(scene, method, count))
                except InputError as error:
                    refusals.setdefault(count, error)
    possible = {item.reduction.coordinates for item in scenes}
    for count in counts or ():
        if count not in possible:
            raise refusals[count]
    if not scenes:
        raise refusals[usual[0]]
    return scenes


def reduction_name(scene: Scene) -> str:
    """Return method and number of coordinates."""
    return f"{scene.reduction.method} {scene.reduction.coordinates}"
