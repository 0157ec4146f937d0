"""What a study finds: tables and the data of figures, as Markdown, CSV and HTML."""

from __future__ import annotations

import base64
import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from dolfinopt.data import filled
from dolfinopt.disk import write_text
from dolfinopt.plots.panels import Panel
from dolfinopt.scene.load import Scene

LONGEST = 120  # characters of a study's name, which file names begin with


# -- tables ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Table:
    """A data frame with a title, a sentence."""

    name: str  # of its file, "" for the study's main table
    title: str
    frame: pd.DataFrame  # columns with units; nan is left empty in files
    long: bool = False  # too long to be read, for a CSV file alone

    def markdown(self) -> str:
        """Return the table in Markdown, four digits a number."""
        cells = as_text(self.frame, 4).replace(r"\|", r"\\|", regex=True)
        return f"{self.title}\n\n{cells.to_markdown(index=False, disable_numparse=True)}\n"

    def csv(self) -> str:
        """Return the table as CSV, ten digits a number."""
        return str(as_text(self.frame, 10).to_csv(index=False, lineterminator="\n"))


def as_text(frame: pd.DataFrame, digits: int, missing: str = "") -> pd.DataFrame:
    """Return all cells as strings: floats with so many significant digits, `missing` for nan."""

    def text(cell: Any) -> str:
        if isinstance(cell, float):
            return missing if math.isnan(cell) else f"{cell:.{digits}g}"
        return str(cell)

    return frame.apply(lambda column: column.map(text))


# -- figures ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class LineFigure:
    """Panels below one another; the curves of a name look alike in all of them."""

    name: str
    title: str
    panels: Sequence[Panel]

    def csv(self) -> str:
        """Return all curves: a row a point."""
        points = [
            (panel.title, line.label, float(x), float(y))
            for panel in self.panels for line in panel.lines
            for x, y in zip(line.x, line.y, strict=True)
        ]  # fmt: skip
        labels = {(panel.x_label, panel.y_label) for panel in self.panels}
        axes = labels.pop() if len(labels) == 1 else ("x", "y")
        return Table("", "", pd.DataFrame(points, columns=["panel", "line", *axes])).csv()


@dataclass(frozen=True)
class DesignFigure:
    """Designs beside each other: labels, scenes and files."""

    name: str
    title: str
    designs: Sequence[tuple[str, Scene, Path]]


@dataclass(frozen=True, eq=False)
class FrameFigure:
    """A figure of a data frame; `figures` says which columns each kind needs."""

    name: str
    title: str
    kind: Literal["matrix", "histogram"]
    frame: pd.DataFrame


Figure = LineFigure | DesignFigure | FrameFigure


# -- files -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Study:
    """What a study found."""

    tables: Sequence[Table]  # the main one first
    figures: Sequence[Figure]
    failures: Sequence[str] = ()  # one line each

    def files(self, name: str) -> dict[str, Figure]:
        """Return the figures by their files' names, <name>[_<figure>]."""
        return {joined(name, figure.name): figure for figure in self.figures}

    def markdown(self) -> str:
        """Return all tables but the long ones."""
        return "\n".join(table.markdown() for table in self.tables if not table.long)


def write_study(study: Study, name: str, folder: Path) -> list[Path]:
    """Write all tables as CSV and Markdown, and the curves as CSV (root only); return the paths.

    `name` begins the names of all files.
    """
    texts = {f"{joined(name, table.name)}.csv": table.csv() for table in study.tables}
    for drawn, figure in study.files(name).items():
        if isinstance(figure, LineFigure):
            texts[f"{drawn}_curves.csv"] = figure.csv()
    texts[f"{name}.md"] = study.markdown()
    for file, text in texts.items():
        write_text(folder / file, text)
    return [folder / file for file in texts]


def file_name(*parts: str) -> str:
    """Return parts of a file's name with _ between them, cut to what file systems take."""
    name = re.sub(r"[^A-Za-z0-9_.-]", "-", joined(*parts))
    if len(name) <= LONGEST:
        return name
    return f"{name[: LONGEST - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def joined(*parts: str) -> str:
    """Return the parts of a file name that are not empty, with _ between them."""
    return "_".join(part for part in parts if part)


def html_page(template: str, **content: Any) -> str:
    """Return a page, see `data.filled`: one file, pictures inside, so that it opens anywhere."""
    filters = {"base64": lambda png: base64.b64encode(png).decode()}
    return filled(template, filters, as_text=as_text, **content).strip()
