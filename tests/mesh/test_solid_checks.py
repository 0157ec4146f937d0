"""Cells of mesh files in space that cannot be a solid."""

from __future__ import annotations

import numpy as np
import pytest
from runs import refusal

from dolfinopt.mesh.checks import check_cells

pytestmark = pytest.mark.serial
# Five tetrahedra in a hexahedron whose corners are numbered as a tensor product.
FIVE = np.array([[0, 1, 2, 4], [3, 1, 2, 7], [5, 1, 4, 7], [6, 2, 4, 7], [1, 2, 4, 7]])


def row(count: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return points and cells of cubes in a row along z."""
    grid = np.stack(np.meshgrid(np.arange(count + 1), [0, 1], [0, 1], indexing="ij"), axis=3)
    points = grid.reshape(-1, 3)[:, ::-1].astype(float)
    return points, np.arange(8) + 4 * np.arange(count)[:, None]


# Three tetrahedra at one facet, the second one on its other side.
FAN = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.1, 0.1, 1], [0.1, 0.1, -1], [0.3, 0.3, 1.0]])
THREE = np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]])


def changed(place: int, *value: float) -> np.ndarray:
    points = row()[0]
    points[place] = value
    return points


def test_sound_cells():
    """Whichever way round their corners are numbered."""
    points, cells = row()
    check_cells(points, cells)
    check_cells(points * [1.0, 1.0, -1.0], cells)
    turned = cells.copy()
    turned[1] = cells[1][[1, 0, 3, 2, 5, 4, 7, 6]]
    check_cells(points, turned)
    check_cells(points[:8], FIVE)


@pytest.mark.parametrize(
    ("points", "cells", "words"),
    [
        (changed(5, np.nan, 0.0, 0.0), row()[1], ["2 cells", "no numbers"]),
        (row()[0] * [1.0, 1.0, 0.0], row()[1], ["3 cells", "flat"]),
        (changed(5, 1.0, 0.0, 2.5), row()[1], ["1 cells", "folded", "(0.5, 0.5, "]),
        (row()[0], np.concatenate([row()[1], row()[1][:1]]), ["2 cells", "overlap"]),
        (row()[0], np.repeat(row()[1][:1], 3, axis=0), ["3 cells", "overlap"]),
        (FAN, THREE, ["cells overlap"]),
        (changed(7, 0.2, 0.2, 0.2)[:8], FIVE, ["overlap", "inverted"]),
        (row()[0], row()[1][[0, 2]], ["2 separate parts"]),
    ],
)
def test_cells_that_are_no_solid(points, cells, words):
    refusal(lambda: check_cells(points, cells), *words)
