"""A scene as every command and every `Model` takes it: read, completed and checked as a whole."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any

from dolfinopt.arms.arm import fixed_body
from dolfinopt.dynamics.build import check_forces, check_motion
from dolfinopt.scene.load import Scene, pose_scenarios, read_scene, scene_from_dict
from dolfinopt.scene.messages import implausible


def load_scene(
    source: str | os.PathLike[str] | Mapping[str, Any] | Scene, overrides: Iterable[str] = ()
) -> Scene:
    """Return a scene of which everything is checked that can be told before meshes are made.

    Keys with their ranges and what they must agree on, files, the motion of the machine, tables of
    forces, bodies from files.

    Args:
        source: a scene's file, its data, or another scene, with `overrides` on it.
        overrides: "key.path=value" each, see `scene.load.read_scene`.

    Raises:
        InputError: one line that names file, key, value and what is allowed.
    """
    if isinstance(source, Scene):
        scene = scene_from_dict(source.to_tree(), source.source, overrides)
    elif isinstance(source, Mapping):
        scene = scene_from_dict(source, overrides=overrides)
    else:
        scene = read_scene(source, overrides)
    for item in (scene, *pose_scenarios(scene)):
        check_motion(item)
        check_forces(item)
    for index, arm in enumerate(scene.arms):
        if arm.sid is not None:
            fixed_body(scene, index)
    return scene


def doubts(scene: Scene) -> list[str]:
    """Return what in a valid scene is most likely a mistake, a sentence each."""
    return [*doubts_of_files(scene), *implausible(scene)]


def doubts_of_files(scene: Scene) -> list[str]:
    """Return what a body from a file lacks that its scene may need, a sentence each.

    Raises:
        InputError: a file holds no such body.
    """
    result = []
    for index, arm in enumerate(scene.arms):
        if arm.sid is None:
            continue
        body = fixed_body(scene, index)
        if scene.simulation.stiffening is True and not body.is_stiffened:
            result.append(
                f"{arm.sid} holds no geometric stiffness, which simulation.stiffening = true asks "
                f"for: arm {arm.name!r} is linear"
            )
        out_of_plane = body.outboard[2:-1]  # no rows of plane bodies
        if len(out_of_plane) and not out_of_plane.any():
            result.append(
                f"{arm.sid}: its outboard node moves in x and y and turns about z alone; out of "
                f"that plane arm {arm.name!r} is rigid"
            )
    return result
