"""What becomes of every link of many robots: a table of what import says, in Markdown.

    python docs/links_tried.py FOLDER

Every link of the URDF files below FOLDER that a joint which moves holds is made a solid by itself,
as `dolfinopt import` does. Sentences are counted without their numbers and names.
"""

from __future__ import annotations

import os
import re
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.file import read_robot
from dolfinopt.exchange.urdf.geometry import NoSolid, cells_between_joints
from dolfinopt.exchange.urdf.robot import Robot, scene_bodies


def outcome(robot: Robot, name: str) -> list[str]:
    """Return what is said of a link: what was done to its shape, or why it has none."""
    try:
        (body,) = (item for item in scene_bodies(robot, (name,), None) if item.is_solid)
    except InputError as error:
        return [str(error)]
    link, said = robot.links[name], ""
    for shapes in (link.shapes, link.visual() if link.visual else None):
        try:
            mesh = cells_between_joints(shapes, body) if shapes is not None else None
        except NoSolid as error:
            said = said or f"box: {error}"
            continue
        if mesh is not None:
            own = replace(mesh, done=("visual geometry",) * bool(said) + mesh.done)
            return ["in its own shape", *(own.done or ("as it is",))]
    return [said]


def sentences(folder: Path) -> Iterator[str]:
    """Yield what is said of each link, and of files that are not read."""
    for file in sorted(folder.rglob("*.urdf")):
        try:
            robot = read_robot(file)
        except InputError as error:
            yield f"not read: {error}"
            continue
        yield "files read"
        for name in robot.links:
            if name in robot.holder and robot.holder[name].moves:
                yield from ["links held by a joint that moves", *outcome(robot, name)]
                print(".", end="", file=sys.stderr, flush=True)


def plain(sentence: str) -> str:
    """Return a sentence without its numbers, names and paths."""
    named = re.sub(r"\S*\.urdf: (link )?|'[^']*'(, )?", "", sentence)
    return re.sub(r"[-+]?\d[\d.e+-]*", "N", named)


if __name__ == "__main__":
    place = Path(sys.argv[1]).absolute()
    os.environ["ROS_PACKAGE_PATH"] = os.pathsep.join(map(str, place.rglob("robots")))
    print("| said | number |\n|---|---|")
    for words, count in Counter(map(plain, sentences(place))).most_common():
        print(f"| {words} | {count} |")
