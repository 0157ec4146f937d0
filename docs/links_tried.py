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
from pathlib import Path

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.file import read_robot
from dolfinopt.exchange.urdf.robot import Robot, scene_bodies
from dolfinopt.exchange.urdf.scene import meshed


def outcome(robot: Robot, name: str) -> list[str]:
    """Return what is said of a link: what was done to its shape, or why it has none."""
    try:
        (body,) = (item for item in scene_bodies(robot, (name,), None) if item.is_solid)
    except InputError as error:
        return [str(error)]
    said: list[str] = []
    mesh = meshed(robot, body, said.extend).mesh
    return said if mesh is None else ["in its own shape", *(mesh.done or ("as it is",))]


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
