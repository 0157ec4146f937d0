"""The text file of standard input data: writing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dolfinopt.disk import write_atomically
from dolfinopt.exchange.sid.data import (
    BODY,
    GENERAL,
    HEADER,
    NODE,
    SYMMETRIC,
    UNIT,
    ZERO,
    StandardInputData,
    Taylor,
)


def write_sid(path: Path, data: StandardInputData) -> None:
    """Write the text file; `read_sid` gets the same bits back."""
    write_atomically(path, lambda stream: stream.write(sid_text(data).encode()))


def sid_text(data: StandardInputData) -> str:
    """Return the content of the text file, numbers with 17 digits and Fortran's exponent."""
    nq = data.num_modes
    comment = " ".join(data.comment.split())
    lines = [
        f"{len(data.nodes):5d}{nq:5d}    :No. nodes, No. modes:{comment}",
        " part",
        _entry(6, "new modal", ""),
        " " * 11 + "refmod",
        _entry(16, "mass", _number(data.mass)),
        _entry(16, "nelastq", f"{nq:5d}"),
    ]
    for k, name in enumerate(data.names, 1):
        lines.append(_entry(16, f"ielastq ({k:4d})", name))
    lines += [" " * 11 + "end refmod", " " * 11 + "frame"]
    for node in data.nodes:
        lines.append(_entry(16, "new node", f"{node.name:>8}"))
        lines.append(_entry(21, "rframe", node.rframe))
        for name in NODE:
            matrix = getattr(node, name)
            if matrix is not None:
                lines += _matrix_lines(21, name, matrix)
        lines.append(" " * 16 + "end node")
    lines.append(" " * 11 + "end frame")
    for name in BODY:
        lines += _matrix_lines(11, name, getattr(data, name))
    lines += [" " * 6 + "end modal", " end part"]
    return "\n".join(lines) + "\n"


def _entry(indent: int, key: str, value: str) -> str:
    return f"{' ' * indent + key:<48}= {value}".rstrip()


def _number(value: float) -> str:
    return f"{value: .16E}".replace("E", "D")


def _matrix_lines(indent: int, name: str, matrix: Taylor) -> list[str]:
    """Write what a reader would not guess from a missing entry."""
    (nrow, ncol), nq, structure = matrix.M0.shape, matrix.M1.shape[1], matrix.structure
    entries = _filled(matrix.M0)
    if structure == SYMMETRIC and nrow == ncol:
        entries |= entries.T  # a half left out would be taken from the other
    if structure == UNIT and np.array_equal(matrix.M0, np.eye(nrow, ncol)):
        entries[:] = False
    elif structure in (ZERO, UNIT):
        structure = GENERAL if entries.any() else ZERO
    header = (matrix.order, nrow, ncol, nq, matrix.nqn, structure)
    lines = [" " * indent + name]
    lines += [_entry(26, key, f"{value:4d}") for key, value in zip(HEADER, header, strict=True)]
    for row, col in np.argwhere(entries):
        lines.append(_entry(26, f"m0( {row + 1}, {col + 1})", _number(matrix.M0[row, col])))
    for row, k, col in np.argwhere(_filled(matrix.M1)) if matrix.order else ():
        value = _number(matrix.M1[row, k, col])
        lines.append(_entry(26, f"m1( {row + 1}, {k + 1}, {col + 1})", value))
    return [*lines, " " * indent + f"end {name}"]


def _filled(values: np.ndarray) -> np.ndarray:
    """Return True for everything but +0, which is what a missing entry means."""
    return (values != 0.0) | np.signbit(values)
