"""history.csv: a line an iteration, written as it happens and read back."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from dolfinopt.disk import append_text, open_input, write_text
from dolfinopt.optimization.history import HistoryRow


class HistoryWriter:
    """history.csv, a line an iteration as it happens."""

    def __init__(self, path: Path, rows: Sequence[HistoryRow]):
        """Begin the file anew with the rows known so far."""
        self.path = path
        self.begun = bool(rows)
        write_text(path, _csv_lines(rows[0].columns, [row.values for row in rows]) if rows else "")

    def append(self, row: HistoryRow) -> None:
        """Add one line; the first row brings the header, too."""
        line = _csv_lines([] if self.begun else row.columns, [row.values]).lstrip("\n")
        self.begun = True
        append_text(self.path, line)


def read_history(path: Path) -> list[HistoryRow]:
    """Read history.csv back."""
    with open_input(path) as stream:
        rows = list(csv.reader(stream.read().decode().splitlines()))
        return [HistoryRow.from_values(rows[0], list(map(float, row))) for row in rows[1:]]


def _csv_lines(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = [",".join(header)]
    lines += [",".join(str(v) if isinstance(v, int) else f"{v:.10g}" for v in row) for row in rows]
    return "\n".join(lines) + "\n"
