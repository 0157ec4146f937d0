"""design.vtu and design.xdmf: density, arm and largest stress by cell, for ParaView."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.disk import write_atomically
from dolfinopt.output.views import ArmView, designed

# Cells by dimension and corners: triangle, quadrilateral, tetrahedron, hexahedron.
VTK_CELLS = {(2, 3): 5, (2, 4): 9, (3, 4): 10, (3, 8): 12}
XDMF_CELLS = {(2, 3): 4, (2, 4): 5, (3, 4): 6, (3, 8): 9}
XDMF_NAMES = {
    (2, 3): "Triangle",
    (2, 4): "Quadrilateral",
    (3, 4): "Tetrahedron",
    (3, 8): "Hexahedron",
}


def write_fields(folder: Path, views: Sequence[ArmView]) -> None:
    """Write design.vtu and design.xdmf: density, arm and, if known, stress by cell, see `_Sheet`.

    One grid, because few programs read collections. ParaView and PyVista read both, meshio the
    former: it takes no XDMF with the instant without which PyVista takes none.
    """
    sheet = _sheet(views)
    _write_vtu(folder / "design.vtu", sheet)
    _write_xdmf(folder / "design.xdmf", sheet)


@dataclass(frozen=True, eq=False)
class _Sheet:
    """All designed arms as one grid, one below the other, in m.

    Attributes:
        points: (n_points, 3).
        cells: (n_cells, corners) points around each cell, an array an arm.
        dimension: of the cells, 2 or 3.
        density: (all cells,).
        arm: (all cells,) number of the arm, from 0 in the scene's order.
        stress: (all cells,) largest von Mises stress along the motion, Pa, or None.
    """

    points: np.ndarray
    cells: list[np.ndarray]
    density: np.ndarray
    arm: np.ndarray
    stress: np.ndarray | None = None
    dimension: int = 2

    @property
    def fields(self) -> dict[str, np.ndarray]:
        """What every cell has, by name."""
        found = {"density": self.density, "arm": self.arm}
        return found if self.stress is None else found | {"stress": self.stress}


def _sheet(views: Sequence[ArmView]) -> _Sheet:
    points, cells, arm = [], [], []
    offset, count = 0.0, 0
    for index, view in enumerate(views):
        if view.designed:
            own, corners = _merge_corners(view.corners)
            depth = own[:, 2] if own.shape[1] == 3 else np.zeros(len(own))
            points.append(np.column_stack([own[:, 0], own[:, 1] + offset, depth]))
            cells.append(corners + count)
            arm.append(np.full(len(corners), index))
            offset -= 2.0 * np.ptp(own[:, 1])
            count += len(own)
    density = np.concatenate([view.density for view in designed(views)])
    stresses = [view.stress for view in designed(views) if view.stress is not None]
    whole = np.concatenate(stresses) if len(stresses) == len(cells) else None
    dimension = designed(views)[0].corners.shape[2]
    return _Sheet(np.vstack(points), cells, density, np.concatenate(arm), whole, dimension)


def _write_vtu(path: Path, sheet: _Sheet) -> None:
    from xml.etree import ElementTree as Xml

    root = Xml.Element("VTKFile", type="UnstructuredGrid", version="0.1")
    piece = Xml.SubElement(Xml.SubElement(root, "UnstructuredGrid"), "Piece")
    piece.set("NumberOfPoints", str(len(sheet.points)))
    piece.set("NumberOfCells", str(len(sheet.density)))

    def add(parent: Any, name: str, values: np.ndarray) -> None:
        whole = values.dtype.kind == "i"
        item = Xml.SubElement(parent, "DataArray", Name=name, format="ascii")
        item.set("type", "Int64" if whole else "Float64")
        if values.ndim == 2:
            item.set("NumberOfComponents", str(values.shape[1]))
        item.text = _text_of(values, "%d" if whole else "%.10g")

    corners = np.concatenate([np.full(len(part), part.shape[1]) for part in sheet.cells])
    add(Xml.SubElement(piece, "Points"), "Points", sheet.points)
    cells = Xml.SubElement(piece, "Cells")
    add(cells, "connectivity", np.concatenate([part.ravel() for part in sheet.cells]))
    add(cells, "offsets", np.cumsum(corners))
    types = [np.full(len(part), VTK_CELLS[sheet.dimension, part.shape[1]]) for part in sheet.cells]
    add(cells, "types", np.concatenate(types))
    data = Xml.SubElement(piece, "CellData", Scalars="density")
    for name, values in sheet.fields.items():
        add(data, name, values)
    write_atomically(path, lambda stream: Xml.ElementTree(root).write(stream))


def _write_xdmf(path: Path, sheet: _Sheet) -> None:
    from xml.etree import ElementTree as Xml

    root = Xml.Element("Xdmf", Version="3.0")
    grid = Xml.SubElement(Xml.SubElement(root, "Domain"), "Grid", Name="arms", GridType="Uniform")
    Xml.SubElement(grid, "Time", Value="0")
    topology = Xml.SubElement(grid, "Topology")
    topology.set("NumberOfElements", str(len(sheet.density)))
    shapes = {(sheet.dimension, part.shape[1]) for part in sheet.cells}
    if len(shapes) == 1:
        topology.set("TopologyType", XDMF_NAMES[next(iter(shapes))])
        _data_item(topology, np.vstack(sheet.cells), "Int")
    else:
        topology.set("TopologyType", "Mixed")
        numbers = [XDMF_CELLS[sheet.dimension, part.shape[1]] for part in sheet.cells]
        parts = [np.insert(c, 0, k, axis=1) for c, k in zip(sheet.cells, numbers, strict=True)]
        _data_item(topology, np.concatenate([part.ravel() for part in parts]), "Int")
    geometry = Xml.SubElement(grid, "Geometry", GeometryType="XYZ")
    _data_item(geometry, sheet.points, "Float")
    for name, values in sheet.fields.items():
        kind = "Int" if values.dtype.kind == "i" else "Float"
        attribute = Xml.SubElement(grid, "Attribute", Name=name, Center="Cell")
        attribute.set("AttributeType", "Scalar")
        _data_item(attribute, values, kind)
    write_atomically(path, lambda stream: Xml.ElementTree(root).write(stream))


def _data_item(parent: Any, values: np.ndarray, number_type: str) -> None:
    from xml.etree import ElementTree as Xml

    item = Xml.SubElement(parent, "DataItem", Format="XML", NumberType=number_type)
    item.set("Dimensions", " ".join(map(str, values.shape)))
    if number_type == "Float":
        item.set("Precision", "8")
    item.text = _text_of(values, "%d" if number_type == "Int" else "%.10g")


def _text_of(values: np.ndarray, form: str) -> str:
    """Return numbers as text, a line a row."""
    rows = values if values.ndim == 2 else values[:, None]
    line = " ".join([form] * rows.shape[1]) + "\n"
    return "\n" + line * len(rows) % tuple(rows.ravel().tolist())


def _merge_corners(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, d) and cells (n_cells, corners) of cells that share their corners."""
    flat = corners.reshape(-1, corners.shape[2])
    rounded = np.round(flat / (1e-9 * np.ptp(flat, axis=0).max()))
    _, kept, place = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return flat[kept], place.reshape(corners.shape[:2])
