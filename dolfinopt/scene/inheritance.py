"""What arms take from arms before them and leave out, and what bodies from files give them.

The tree is the scene as read, before it is validated: values of any type may stand in it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

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
from dolfinopt.scene.tables.joints import DRIVE_KEYS, INBOARD, OF_BEARINGS, OUTBOARD
from dolfinopt.scene.tables.material import material_keys

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
