"""The text file of standard input data: reading."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.sid.data import (
    BODY,
    HEADER,
    NODE,
    SYMMETRIC,
    UNIT,
    ZERO,
    Node,
    StandardInputData,
    Taylor,
)

T = TypeVar("T")
MOST = 500  # coordinates: every matrix is kept with its derivative by all of them

_END = re.compile(r"end\s+(?:of\s+)?(\w+)\s*$", re.IGNORECASE)
_ITEM = re.compile(
    r"(?:begin\s+of\s+|new\s+)?([a-z]\w*)\s*(?:\(([^()]*)\))?\s*(?:=(.*))?$", re.IGNORECASE
)


def read_sid(path: Path) -> StandardInputData:
    """Read the text file.

    Spacing and case do not matter, blocks may come in any order, zeros may be left out, as well
    as the half of a symmetric and the entries of a unit matrix; `begin of x` and `end of x` are
    as good as `x` and `end x`.

    Raises:
        InputError: one line with the file, the line, what was found and what was expected.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name an SID file") from None
    return _Reader(path, text).part()


class _Reader:
    """A file's lines, one looked at at a time."""

    def __init__(self, path: Path, text: str):
        self.path = path
        self.lines = text.splitlines()
        self.number = 0  # of the line looked at, from one
        self.text = ""
        self.end: str | None = None  # the block that ends here
        self.name = ""  # of the item that stands here, in lower case
        self.indices: str | None = None
        self.value: str | None = None

    def fail(self, expected: str) -> InputError:
        shown = self.text if len(self.text) <= 60 else self.text[:57] + "..."
        return InputError(f"{self.path}, line {self.number}: found {shown!r}, expected {expected}")

    def next(self, expected: str) -> None:
        """Go to the next line that is not empty."""
        while self.number < len(self.lines):
            self.text = self.lines[self.number].strip()
            self.number += 1
            if not self.text:
                continue
            end, item = _END.match(self.text), _ITEM.match(self.text)
            self.end = end[1].lower() if end else None
            self.name, self.indices, self.value = "", None, None
            if item and not end:
                self.name, self.indices = item[1].lower(), item[2]
                self.value = None if item[3] is None else item[3].strip()
            return
        raise InputError(f"{self.path}, line {len(self.lines)}: the file ends, expected {expected}")

    def block(self, name: str, items: Mapping[str, Callable[[], None]]) -> None:
        """Read the items of a block up to its end."""
        choices = ", ".join(map(repr, [*items, f"end {name}"]))
        known = {key.lower(): read for key, read in items.items()}
        while True:
            self.next(choices)
            if self.end == name.lower():
                return
            if self.name not in known:
                raise self.fail(choices)
            known[self.name]()

    # -- values ------------------------------------------------------------------------------

    def real(self) -> float:
        value = (self.value or "").lower().replace("d", "e")
        value = re.sub(r"(?<=[\d.])([+-]\d{3})$", r"e\1", value)  # Fortran prints 1.0-100
        try:
            number = float(value)
        except ValueError:
            raise self.fail("= and a number") from None
        if not np.isfinite(number) or "_" in value:
            raise self.fail("= and a finite number")
        return number

    def integer(self, low: int, high: int) -> int:
        value = self.value or ""
        if not re.fullmatch(r"[+-]?\d+", value) or not low <= int(value) <= high:
            raise self.fail(f"= and an integer from {low} to {high}")
        return int(value)

    def place(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the indices in parentheses, counted from zero."""
        allowed = ", ".join(f"1..{n}" for n in shape)
        parts = (self.indices or "").split(",")
        if not all(re.fullmatch(r"\s*\d+\s*", part) for part in parts):
            raise self.fail(f"indices ({allowed})")
        index = tuple(int(part) - 1 for part in parts)
        if len(index) != len(shape) or not all(0 <= i < n for i, n in zip(index, shape)):
            raise self.fail(f"indices ({allowed})")
        return index

    # -- blocks ------------------------------------------------------------------------------

    def part(self) -> StandardInputData:
        """Read the whole file: a comment, then the part."""
        while self.name != "part" or self.value is not None:
            self.next("'part'")
        comment = self.lines[0].split("modes:", 1)[-1].strip() if self.number > 1 else ""
        found: dict[str, StandardInputData] = {}
        self.block("part", {"modal": lambda: self.once(found, "modal", self.modal)})
        if not found:
            raise self.fail("'new modal' before")
        data = found["modal"]
        values = {field.name: getattr(data, field.name) for field in fields(data)}
        return StandardInputData(**{**values, "comment": comment})

    def once(self, found: dict[str, T], name: str, read: Callable[[], T]) -> None:
        if name in found:
            raise self.fail(f"{name!r} only once")
        found[name] = read()

    def modal(self) -> StandardInputData:
        head: list[tuple[float, tuple[str, ...]]] = []
        nodes: dict[str, Node] = {}
        matrices: dict[str, Any] = {}

        def refmod() -> None:
            if head:
                raise self.fail("'refmod' only once")
            head.append(self.refmod())

        def number() -> int:
            if not head:
                raise self.fail("'refmod' first, which has the number of coordinates")
            return len(head[0][1])

        def matrix(name: str) -> Callable[[], None]:
            shapes = BODY[name]
            return lambda: self.once(matrices, name, lambda: self.taylor(name, shapes, number()))

        items: dict[str, Callable[[], None]] = {"refmod": refmod}
        items["frame"] = lambda: self.frame(nodes, number())
        items.update({name: matrix(name) for name in BODY})
        self.block("modal", items)
        missing = ["refmod"] * (not head) + [name for name in BODY if name not in matrices]
        if missing:
            raise self.fail(f"{missing[0]!r} before")
        return StandardInputData(*head[0], tuple(nodes.values()), **matrices)

    def refmod(self) -> tuple[float, tuple[str, ...]]:
        """Return the mass and the names of the coordinates."""
        found: dict[str, float] = {}
        names: dict[int, str] = {}

        def name() -> None:
            if "nelastq" not in found:
                raise self.fail("'nelastq' before the names")
            (k,) = self.place((int(found["nelastq"]),))
            names[k] = self.value or ""

        self.block(
            "refmod",
            {
                "mass": lambda: self.once(found, "mass", self.real),
                "nelastq": lambda: self.once(found, "nelastq", lambda: self.integer(0, MOST)),
                "ielastq": name,
            },
        )
        missing = [key for key in ("mass", "nelastq") if key not in found]
        if missing:
            raise self.fail(f"{missing[0]!r} before")
        return found["mass"], tuple(names.get(k, "") for k in range(int(found["nelastq"])))

    def frame(self, nodes: dict[str, Node], nq: int) -> None:
        """Add the nodes of one frame block."""

        def node() -> None:
            name = self.value or ""
            if not name or name in nodes:
                raise self.fail("'new node =' and a name of its own")
            nodes[name] = self.node(name, nq)

        self.block("frame", {"node": node})

    def node(self, name: str, nq: int) -> Node:
        rframe: list[str] = []
        found: dict[str, Taylor] = {}

        def matrix(key: str) -> Callable[[], None]:
            return lambda: self.once(found, key, lambda: self.taylor(key, NODE[key], nq))

        items: dict[str, Callable[[], None]] = {"rframe": lambda: rframe.append(self.value or "")}
        items.update({key: matrix(key) for key in NODE})
        self.block("node", items)
        missing = [key for key in NODE if key not in found and key != "sigma"]
        if missing:
            raise self.fail(f"{missing[0]!r} of node {name} before")
        return Node(name, rframe[-1] if rframe else "", **found)

    def taylor(self, name: str, shapes: tuple[tuple[int | str, int | str], ...], nq: int) -> Taylor:
        """Read one matrix."""
        header: dict[str, int] = {}
        first: dict[tuple[int, ...], float] = {}
        second: dict[tuple[int, ...], float] = {}

        def put(entries: dict[tuple[int, ...], float], keys: tuple[str, ...]) -> None:
            missing = [key for key in HEADER if key not in header]
            if missing:
                raise self.fail(f"{missing[0]!r} before the entries")
            index = self.place(tuple(header[key] for key in keys))
            if index in entries:
                raise self.fail("every entry only once")
            entries[index] = self.real()

        limits = {"order": 1, "nqn": 0, "structure": UNIT}
        items: dict[str, Callable[[], None]] = {
            key: lambda key=key: self.once(  # type: ignore[misc]
                header, key, lambda: self.integer(0, limits.get(key, 10_000_000))
            )
            for key in HEADER
        }
        items["m0"] = lambda: put(first, ("nrow", "ncol"))
        items["m1"] = lambda: put(second, ("nrow", "nq", "ncol"))
        self.block(name, items)
        missing = [key for key in HEADER if key not in header]
        if missing:
            raise self.fail(f"{missing[0]!r} of {name} before")
        return self.assembled(name, shapes, nq, header, first, second)

    def assembled(
        self,
        name: str,
        shapes: tuple[tuple[int | str, int | str], ...],
        nq: int,
        header: Mapping[str, int],
        first: Mapping[tuple[int, ...], float],
        second: Mapping[tuple[int, ...], float],
    ) -> Taylor:
        """Check the dimensions and fill the matrices."""
        size = {"nq": nq, "3nq": 3 * nq}
        allowed = [tuple(size[n] if isinstance(n, str) else n for n in shape) for shape in shapes]
        shape = (header["nrow"], header["ncol"])
        if shape not in allowed:
            choices = " or ".join(f"{rows} x {cols}" for rows, cols in allowed)
            raise self.fail(f"{name} of {choices}, not {shape[0]} x {shape[1]}, for nelastq = {nq}")
        order, structure = header["order"], header["structure"]
        if header["nq"] != nq and (order > 0 or header["nq"] != 0):
            raise self.fail(f"nq = {nq} of {name}, not {header['nq']}")
        if second and order == 0:
            raise self.fail(f"no m1 in {name}, which is of order 0")
        if first and structure == ZERO:
            raise self.fail(f"no m0 in {name}, whose structure 0 says zero")
        M0 = np.eye(*shape) if structure == UNIT and not first else np.zeros(shape)
        M1 = np.zeros((shape[0], header["nq"], shape[1]))
        for (row, col), value in first.items():
            M0[row, col] = value
            if structure == SYMMETRIC and shape[0] == shape[1] and (col, row) not in first:
                M0[col, row] = value
        for index, value in second.items():
            M1[index] = value
        return Taylor(M0, M1, order, structure, header["nqn"])
