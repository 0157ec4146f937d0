"""The files of a run: written whole or not at all, read with one clear line when they do not fit.

Everything here runs on the root unless it says "collective".
"""

from __future__ import annotations

import csv
import json
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from dolfinopt.arms.arm import fixed_body
from dolfinopt.disk import append_text, write_atomically
from dolfinopt.errors import InputError
from dolfinopt.multibody.motion import CART
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.parallel import Partition, gather_cells, on_root, together
from dolfinopt.responses.response import objective_of
from dolfinopt.scene.load import Scene
from dolfinopt.version import __version__

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.dynamics.simulation import Trajectory


VTK_TRIANGLE, VTK_QUAD = 5, 9
XDMF_CELLS = {3: 4, 4: 5}  # its numbers of triangles and quadrilaterals, by corners


# -- writing ---------------------------------------------------------------------------------


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write an .npz atomically."""
    write_atomically(path, lambda stream: np.savez(stream, **arrays))


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    write_atomically(path, lambda stream: stream.write(text.encode()))


def _csv_lines(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = [",".join(header)]
    lines += [",".join(str(v) if isinstance(v, int) else f"{v:.10g}" for v in row) for row in rows]
    return "\n".join(lines) + "\n"


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
    with _open(path) as stream:
        rows = list(csv.reader(stream.read().decode().splitlines()))
        return [HistoryRow.from_values(rows[0], list(map(float, row))) for row in rows[1:]]


def write_trajectory(
    folder: Path, trajectory: Trajectory, initial: np.ndarray | None = None
) -> None:
    """Write trajectory.npz and trajectory.csv; their units stand in `trajectory_units`.

    Args:
        folder: where.
        trajectory: what.
        initial: (n, 2) deviation of the initial design, m, kept for the picture.
    """
    arrays = {
        "t": trajectory.t,
        "q_r": trajectory.q_r,
        "q_e": trajectory.q_e,
        "deviation": trajectory.deviation,
        "compliance": trajectory.compliance,
        "joint_forces": trajectory.joint_forces,
    }
    if initial is not None:
        arrays["initial_deviation"] = initial
    scene = trajectory.scene
    units = {
        "t": "s",
        "q_r": ", ".join(("m", *["rad"] * len(scene.arms))),
        "q_e": "m or rad: times V is a displacement in m",
        "deviation": "m",
        "compliance": "N m",
        "joint_forces": ", ".join(drive_units(scene).values()),
        "initial_deviation": "m",
    }
    arrays["units"] = np.array([f"{name}: {units[name]}" for name in arrays])
    write_arrays(folder / "trajectory.npz", arrays)
    distance = np.hypot(*trajectory.deviation.T)
    table = np.column_stack(
        [
            trajectory.t,
            trajectory.deviation,
            distance,
            trajectory.compliance.sum(axis=1),
            trajectory.q_r,
            trajectory.q_e,
            trajectory.compliance,
            trajectory.joint_forces,
        ]
    )
    header = list(trajectory_units(trajectory))
    line = ",".join(["%.10g"] * len(header)) + "\n"
    text = line * len(table) % tuple(table.ravel().tolist())
    write_text(folder / "trajectory.csv", ",".join(header) + "\n" + text)


def drive_units(scene: Scene) -> dict[str, str]:
    """Return the unit of the drive of every rigid coordinate, by its name: cart, then the arms."""
    return {CART: "N", **{arm.name: "N m" for arm in scene.arms}}


def trajectory_units(trajectory: Trajectory) -> dict[str, str]:
    """Return the unit of every column of trajectory.csv, in their order."""
    scene, slices = trajectory.scene, trajectory.mechanism.slices
    units = {"t": "s", "deviation_x": "m", "deviation_y": "m", "deviation": "m"}
    units |= {"compliance": "N m", f"q_r_{CART}": "m"}
    units |= {f"q_r_{arm.name}": "rad" for arm in scene.arms}
    for arm, part in zip(scene.arms, slices, strict=True):
        # Of normalised modes: a unit of their own, which times the mode is a displacement.
        units |= {f"q_e_{arm.name}_{k + 1}": "modal" for k in range(part.stop - part.start)}
    units |= {f"compliance_{arm.name}": "N m" for arm in scene.arms}
    return units | {f"joint_force_{name}": unit for name, unit in drive_units(scene).items()}


def read_initial_deviation(path: Path) -> np.ndarray | None:
    """Return the initial design's deviation (n, 2), m, if trajectory.npz holds it."""
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as data:
        return data["initial_deviation"] if "initial_deviation" in data.files else None


def write_summary(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write summary.json."""
    write_text(folder / "summary.json", json.dumps(summary, indent=2, sort_keys=False) + "\n")


def versions() -> dict[str, str]:
    """Return the versions of everything a result depends on."""
    import scipy
    from petsc4py import PETSc
    from slepc4py import SLEPc

    from dolfinopt.mesh import compat

    return {
        "dolfinopt": __version__,
        "dolfinx": compat.dolfinx_version(),
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "slepc": ".".join(map(str, SLEPc.Sys.getVersion())),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }


# -- views: what pictures and ParaView need of an arm ----------------------------------------


@dataclass(frozen=True, eq=False)
class ArmView:
    """One whole arm on the root, cells in the order of their centroids.

    Attributes:
        name: the arm's.
        corners: (n_cells, 3 or 4, 2) m, around each cell.
        centroid: (n_cells, 2) m.
        density: (n_cells,) physical densities.
        modes: (n_cells, 3 or 4, 2, q) the reduced basis at the corners; q = 0 if not reduced.
        designed: False for arms without a design: rigid ones and those from a file.
        length: from joint axis to joint axis, m; None if not known.
    """

    name: str
    corners: np.ndarray
    centroid: np.ndarray
    density: np.ndarray
    modes: np.ndarray
    designed: bool = True
    length: float | None = None


def gather_views(
    scene: Scene, partition: Partition, arms: Mapping[int, Arm], x_phys: Mapping[int, np.ndarray]
) -> list[ArmView]:
    """Collect every arm on the root (collective); empty list elsewhere."""

    def collect(values: Any) -> dict[int, np.ndarray]:
        with together(partition.world):
            mine = {index: values(index, arm) for index, arm in arms.items()}
        return gather_cells(partition, mine)

    def modes(index: int, arm: Arm) -> np.ndarray:
        cells = arm.substructure.operators.cells
        if arm.basis is None:
            return np.zeros((*cells.shape, 2, 0))
        return arm.basis.V[cells]

    def points(index: int, arm: Arm) -> np.ndarray:
        operators = arm.substructure.operators  # also of arms that no design was set for
        return operators.points[operators.cells]

    corners = collect(points)
    centroids = collect(lambda _, arm: arm.mesh.centroid)
    densities = collect(lambda index, _: x_phys[index])
    shapes = collect(modes)
    with together(partition.world):
        if partition.world.rank == 0:
            return _views(scene, corners, centroids, densities, shapes)
        return []


def read_views(scene: Scene, path: Path) -> list[ArmView]:
    """Return the arms of a design file, on this rank alone.

    Raises:
        InputError: the file cannot be read, or does not fit the scene's arms.
    """
    from mpi4py import MPI

    from dolfinopt.arms.arm import build_arms
    from dolfinopt.parallel import partition_arms
    from dolfinopt.profiling import Profile

    partition = partition_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = build_arms(scene, partition, Profile())
    return gather_views(scene, partition, arms, read_design(path, partition, arms))


def _views(
    scene: Scene,
    corners: Mapping[int, np.ndarray],
    centroids: Mapping[int, np.ndarray],
    densities: Mapping[int, np.ndarray],
    shapes: Mapping[int, np.ndarray],
) -> list[ArmView]:
    """Return the views of all arms in the chain, given those with a design (root only)."""
    views = []
    for index, owner in enumerate(scene.owners):
        name = scene.arms[index].name
        if owner is None:
            views.append(_bar_view(name, scene.arms[index].height, fixed_body(scene, index)))
            continue
        order = canonical_order(centroids[owner])
        # DOLFINx numbers a quadrilateral's corners as a tensor product; here they go around.
        around = [0, 1, 3, 2] if corners[owner].shape[1] == 4 else [0, 1, 2]
        views.append(
            ArmView(
                name,
                corners[owner][order][:, around],
                centroids[owner][order],
                densities[owner][order],
                shapes[owner][order][:, around],
                length=scene.arms[index].length,
            )
        )
    return views


def _bar_view(name: str, height: float, body: ShapeIntegrals) -> ArmView:
    """Return a body whose shape is not known as a bar from joint to joint.

    Between them it bends like a beam without loads: cubic polynomials that fit the outboard
    interface's displacement and rotation.
    """
    length = float(np.hypot(*body.outboard_point))
    axis = np.array([*body.outboard_point]) / length
    across = np.array([-axis[1], axis[0]])
    s = np.linspace(0.0, 1.0, 21)
    station = np.stack([s[:-1], s[1:], s[1:], s[:-1]], axis=1)  # (n_cells, 4)
    side = 0.5 * height * np.array([-1.0, -1.0, 1.0, 1.0])
    corners = length * station[..., None] * axis + side[:, None] * across
    u, v = axis @ body.outboard[:2], across @ body.outboard[:2]
    bend, turn = 3.0 * station**2 - 2.0 * station**3, length * (station**3 - station**2)
    slope = (6.0 * station - 6.0 * station**2) / length, 3.0 * station**2 - 2.0 * station
    deflection = bend[..., None] * v + turn[..., None] * body.outboard[2]
    rotation = slope[0][..., None] * v + slope[1][..., None] * body.outboard[2]
    along = station[..., None] * u - side[:, None] * rotation
    modes = along[:, :, None] * axis[:, None] + deflection[:, :, None] * across[:, None]
    density = np.ones(len(corners))
    return ArmView(name, corners, corners.mean(axis=1), density, modes, False, length)


def canonical_order(points: np.ndarray) -> np.ndarray:
    """Sort points by x, then y, as equal to 1e-9 of their extent: the same on any partition."""
    size = np.ptp(points, axis=0).max() or 1.0
    rounded = np.round(points / (1e-9 * size))
    return np.lexsort((rounded[:, 1], rounded[:, 0]))


def designed(views: Sequence[ArmView]) -> list[ArmView]:
    """Return the arms that have a design."""
    return [view for view in views if view.designed]


def write_design(folder: Path, views: Sequence[ArmView]) -> None:
    """Write design.npz: centroids and physical densities of every arm."""
    arrays = {}
    for view in designed(views):
        arrays[f"{view.name}/centroid"] = view.centroid
        arrays[f"{view.name}/density"] = view.density
    arrays["units"] = np.array(["centroid: m", "density: -"])
    write_arrays(folder / "design.npz", arrays)


def write_gradient(
    path: Path,
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    by_cell: Mapping[int, np.ndarray],
    objective: float,
) -> None:
    """Write the gradient with respect to the physical densities (collective).

    Of a shared design once, under the name of the arm it belongs to.
    """
    centroids = gather_cells(partition, {k: arm.mesh.centroid for k, arm in arms.items()})
    gathered = gather_cells(partition, by_cell)
    with together(partition.world):
        if partition.world.rank != 0:
            return
        arrays: dict[str, Any] = {"objective": objective}
        for index, centroid in centroids.items():
            order, name = canonical_order(centroid), scene.arms[index].name
            arrays[f"{name}/centroid"] = centroid[order]
            arrays[f"{name}/gradient"] = gathered[index][order]
        unit = objective_of(scene).unit  # per physical density, which has none
        arrays["units"] = np.array([f"objective: {unit}", "centroid: m", f"gradient: {unit}"])
        write_arrays(path, arrays)


@dataclass(frozen=True, eq=False)
class _Sheet:
    """All designed arms as one grid, one below the other, in m.

    Attributes:
        points: (n_points, 3).
        cells: (n_cells, 3 or 4) points around each cell, an array an arm.
        density: (all cells,).
        arm: (all cells,) number of the arm, from 0 in the scene's order.
    """

    points: np.ndarray
    cells: list[np.ndarray]
    density: np.ndarray
    arm: np.ndarray


def _sheet(views: Sequence[ArmView]) -> _Sheet:
    points, cells, arm = [], [], []
    offset, count = 0.0, 0
    for index, view in enumerate(views):
        if view.designed:
            own, corners = _merge_corners(view.corners)
            points.append(np.column_stack([own[:, 0], own[:, 1] + offset, np.zeros(len(own))]))
            cells.append(corners + count)
            arm.append(np.full(len(corners), index))
            offset -= 2.0 * np.ptp(own[:, 1])
            count += len(own)
    density = np.concatenate([view.density for view in designed(views)])
    return _Sheet(np.vstack(points), cells, density, np.concatenate(arm))


def write_fields(folder: Path, views: Sequence[ArmView]) -> None:
    """Write design.vtu and design.xdmf: density and arm by cell, see `_Sheet`.

    One grid, because few programs read collections. ParaView and PyVista read both, meshio the
    former: it takes no XDMF with the instant without which PyVista takes none.
    """
    sheet = _sheet(views)
    _write_vtu(folder / "design.vtu", sheet)
    _write_xdmf(folder / "design.xdmf", sheet)


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
    add(cells, "types", np.where(corners == 4, VTK_QUAD, VTK_TRIANGLE))
    data = Xml.SubElement(piece, "CellData", Scalars="density")
    add(data, "density", sheet.density)
    add(data, "arm", sheet.arm)
    write_atomically(path, lambda stream: Xml.ElementTree(root).write(stream))


def _write_xdmf(path: Path, sheet: _Sheet) -> None:
    from xml.etree import ElementTree as Xml

    root = Xml.Element("Xdmf", Version="3.0")
    grid = Xml.SubElement(Xml.SubElement(root, "Domain"), "Grid", Name="arms", GridType="Uniform")
    Xml.SubElement(grid, "Time", Value="0")
    topology = Xml.SubElement(grid, "Topology")
    topology.set("NumberOfElements", str(len(sheet.density)))
    shapes = {part.shape[1] for part in sheet.cells}
    if len(shapes) == 1:
        topology.set("TopologyType", "Quadrilateral" if shapes == {4} else "Triangle")
        _data_item(topology, np.vstack(sheet.cells), "Int")
    else:
        topology.set("TopologyType", "Mixed")
        parts = [np.insert(part, 0, XDMF_CELLS[part.shape[1]], axis=1) for part in sheet.cells]
        _data_item(topology, np.concatenate([part.ravel() for part in parts]), "Int")
    geometry = Xml.SubElement(grid, "Geometry", GeometryType="XYZ")
    _data_item(geometry, sheet.points, "Float")
    for name, values, kind in (("density", sheet.density, "Float"), ("arm", sheet.arm, "Int")):
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
    """Return points (n, 2) and cells (n_cells, corners) of cells that share their corners."""
    flat = corners.reshape(-1, 2)
    rounded = np.round(flat / (1e-9 * np.ptp(flat, axis=0).max()))
    _, kept, place = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return flat[kept], place.reshape(corners.shape[:2])


# -- reading designs -------------------------------------------------------------------------


def read_design(path: Path, partition: Partition, arms: Mapping[int, Arm]) -> dict[int, np.ndarray]:
    """Return the physical densities of a design.npz on this rank's cells (collective).

    Cells take the value of the nearest centroid in the file.

    Raises:
        InputError: the file is missing, damaged, or made for other arms.
    """
    arrays = on_root(partition.world, _load_design, path)
    with together(partition.world):
        return {index: _fit(path, arm, arrays) for index, arm in arms.items()}


def _load_design(path: Path) -> dict[str, np.ndarray]:
    with _open(path) as stream:
        try:
            with np.load(stream, allow_pickle=False) as data:
                return {key: data[key] for key in data.files}
        except (ValueError, OSError, EOFError, KeyError, _zip_error()):
            raise InputError(
                f"{path}: --design is no readable .npz file; give a design.npz that dolfinopt wrote"
            ) from None


def _zip_error() -> type[Exception]:
    from zipfile import BadZipFile

    return BadZipFile


def _open(path: Path) -> IO[bytes]:
    try:
        return open(path, "rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def _fit(path: Path, arm: Arm, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the file's densities on the arm's cells by nearest centroid."""
    from scipy.spatial import cKDTree

    name = arm.mesh.name
    keys = (f"{name}/centroid", f"{name}/density")
    missing = [key for key in keys if key not in arrays]
    if missing:
        found = sorted({key.split("/")[0] for key in arrays if "/" in key})
        raise InputError(
            f"{path}: missing key {missing[0]!r} for arm {name!r}; the file holds "
            f"{', '.join(map(repr, found)) or 'nothing'}; give a design made for these arms"
        )
    centroid, density = (np.asarray(arrays[key]) for key in keys)
    if centroid.ndim != 2 or centroid.shape[1] < 2 or density.shape != centroid.shape[:1]:
        raise InputError(
            f"{path}: {keys[1]} has shape {density.shape} beside centroids of shape "
            f"{centroid.shape}; expected (n,) and (n, 2)"
        )
    try:
        centroid, density = centroid.astype(float)[:, :2], density.astype(float)
    except (TypeError, ValueError):
        raise InputError(f"{path}: {keys[1]} holds {density.dtype}, not numbers") from None
    if len(density) == 0 or not np.isfinite(centroid).all():
        raise InputError(f"{path}: {keys[0]} is empty or not finite; give a complete design")
    outside = ~((density >= 0.0) & (density <= 1.0))  # catches NaN
    if outside.any():
        raise InputError(
            f"{path}: {keys[1]} = {density[outside][0]:g} at cell {np.flatnonzero(outside)[0]}: "
            "physical densities lie in [0, 1]"
        )
    return density[_nearest(path, arm, centroid, cKDTree)]


def _nearest(path: Path, arm: Arm, centroid: np.ndarray, tree: Any) -> np.ndarray:
    """Return the nearest design point of each cell; both must cover the same region."""
    cells = arm.mesh.centroid
    comm = arm.mesh.comm
    low = np.min(comm.allgather(cells.min(axis=0)), axis=0)
    high = np.max(comm.allgather(cells.max(axis=0)), axis=0)
    size = np.sqrt(comm.allreduce(arm.mesh.area.max(), op=max))
    points = tree(centroid)
    spacing = points.query(centroid, k=2)[0][:, 1].max() if len(centroid) > 1 else np.inf
    reach = 2.0 * (size + min(spacing, np.ptp(centroid, axis=0).max()))
    edge = np.concatenate([centroid.min(axis=0) - low, centroid.max(axis=0) - high])
    distance, place = points.query(cells)
    if np.abs(edge).max() > reach or distance.max() > reach:
        a, b = centroid.min(axis=0), centroid.max(axis=0)
        raise InputError(
            f"{path}: the design of arm {arm.mesh.name!r} covers x {a[0]:.4g}..{b[0]:.4g} m, "
            f"y {a[1]:.4g}..{b[1]:.4g} m, its mesh x {low[0]:.4g}..{high[0]:.4g} m, "
            f"y {low[1]:.4g}..{high[1]:.4g} m; give a design made for these arms"
        )
    return place
