"""What studies wrote, and designs for them."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
from runs import by_root

from dolfinopt.study.tables import Table

# Of studies, coarse in space and time.
COARSE = ("arms.cells=[12,3]", "simulation.sample=0.01", "motion.horizon=2.2")


def rows_of(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file by column."""
    with open(path, newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def cells_of(table: Table) -> list[tuple[Any, ...]]:
    """Return the rows of a table."""
    return list(table.frame.itertuples(index=False, name=None))


def column(rows: list[dict[str, str]], name: str) -> np.ndarray:
    """Return a column of numbers."""
    return np.array([float(row[name]) for row in rows])


def write_uniform(path: Path, cells: tuple[int, int], density: float) -> Path:
    """Write a design.npz of two arms, 1 x 0.06 m, with one density (collective)."""
    along, across = ((np.arange(n) + 0.5) / n for n in cells)
    x, y = np.meshgrid(along, 0.06 * (across - 0.5))
    centroid = np.stack([x.ravel(), y.ravel()], axis=1)
    arms = {f"arm{k}/centroid": centroid for k in (1, 2)}
    arms |= {f"arm{k}/density": np.full(x.size, density) for k in (1, 2)}
    by_root(lambda: np.savez(path, **arms))
    return path
