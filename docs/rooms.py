"""Draws the rooms of the package and who imports whom: `python docs/rooms.py` writes the picture.

Rooms stand in the order of the import contract in pyproject.toml. An arrow that follows from two
others is left out, so that the picture shows the way that data takes and no more.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "pages" / "assets" / "rooms.svg"
WIDTH, HEIGHT, GAP = 150, 34, 26  # of a box, and between two rows, px
LEFT = 300  # of the middle of a row, px


def layers() -> list[list[str]]:
    """Return the rooms that are packages or hold the public class, row by row from the top."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    contracts = settings["tool"]["importlinter"]["contracts"]
    (contract,) = (one for one in contracts if one["type"] == "layers")
    rows = [[name.strip() for name in row.split("|")] for row in contract["layers"]]
    rows = [[name for name in row if _files(name)] for row in rows]
    return [row for row in rows if row]


def _files(room: str) -> list[Path]:
    folder = ROOT / "dolfinopt" / room
    return sorted(folder.rglob("*.py")) if folder.is_dir() else []


def imports(rooms: set[str]) -> dict[str, set[str]]:
    """Return the rooms that every room imports."""
    found: dict[str, set[str]] = {room: set() for room in rooms}
    for room in rooms:
        for path in _files(room):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dolfinopt"):
                    names = [node.module or "", *(f"{node.module}.{a.name}" for a in node.names)]
                    found[room] |= {name.split(".")[1] for name in names if "." in name} & rooms
        found[room].discard(room)
    return found


def shortest(graph: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Return the arrows that do not follow from others."""

    def beyond(room: str) -> set[str]:
        return graph[room].union(*(beyond(other) for other in graph[room]))

    arrows = []
    for room, others in sorted(graph.items()):
        farther = set().union(*(beyond(other) for other in others)) if others else set()
        arrows += [(room, other) for other in sorted(others - farther)]
    return arrows


def svg() -> str:
    """Return the picture."""
    rows = layers()
    place = {}
    for y, row in enumerate(rows):
        for x, room in enumerate(row):
            middle = LEFT + (x - 0.5 * (len(row) - 1)) * (WIDTH + GAP)
            place[room] = (middle, 20 + y * (HEIGHT + GAP), y)
    lines = []
    for first, second in shortest(imports(set(place))):
        (x, y, row), (x2, y2, row2) = place[first], place[second]
        y += HEIGHT
        if row2 == row + 1:
            path = f"M {x} {y} L {x2} {y2 - 4}"
        else:  # around the rooms between
            side = 1 if (row + row2) % 2 else -1
            out = LEFT + side * (WIDTH + 40 + 12 * (row2 - row))
            edge, edge2 = x + side * WIDTH / 2, x2 + side * (WIDTH / 2 + 4)
            path = f"M {edge} {y - 10} C {out} {y - 10}, {out} {y2 + 10}, {edge2} {y2 + 10}"
        lines.append(f'<path d="{path}" class="arrow" marker-end="url(#head)"/>')
    for room, (x, y, _) in place.items():
        lines.append(
            f'<rect x="{x - WIDTH / 2}" y="{y}" width="{WIDTH}" height="{HEIGHT}" rx="5"/>'
            f'<text x="{x}" y="{y + 22}">{room}</text>'
        )
    height = 30 + len(rows) * (HEIGHT + GAP)
    style = (
        "rect{fill:#eceff1;stroke:#455a64}"
        "text{font:15px sans-serif;text-anchor:middle;fill:#263238}"
        ".arrow{fill:none;stroke:#78909c;stroke-width:1.4}"
    )
    head = (
        '<marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" '
        'orient="auto"><path d="M0 0 L8 4 L0 8 z" fill="#78909c"/></marker>'
    )
    body = "\n".join(lines)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * LEFT} {height}">\n'
        f"<style>{style}</style>\n"
        '<rect width="100%" height="100%" style="fill:#fff;stroke:none"/>\n'
        f"<defs>{head}</defs>\n{body}\n</svg>\n"
    )


if __name__ == "__main__":
    PICTURE.write_text(svg(), encoding="utf-8")
