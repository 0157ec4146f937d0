"""Designs of arms: whole on the root for pictures and ParaView; design.npz and gradient.npz."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI

from dolfinopt.disk import (
    append_text,
    open_input,
    read_arrays,
    write_arrays,
    write_text,
)
from dolfinopt.errors import InputError
from dolfinopt.mesh import compat
from dolfinopt.mesh.solid_cells import TENSOR
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.parallel import (
    Partition,
    gather_arms,
    gather_tables,
    on_root,
    partition_arms,
    together,
)
from dolfinopt.profiling import Profile
from dolfinopt.scene.law_variables import LAW, law_names, law_values, with_law
from dolfinopt.scene.load import Arm as ArmKeys
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.mesh.arm_mesh import ArmMesh
    from dolfinopt.multibody.shape_integrals import ShapeIntegrals
    from dolfinopt.responses.stress_report import ArmStress


@dataclass(frozen=True, eq=False)
class ArmView:
    """One whole arm on the root, cells in the order of their centroids.

    Arms without a design, rigid ones and those from a file, have no cells.

    Attributes:
        name: the arm's.
        corners: (n_cells, 3 or 4, 2) m, around each cell; of solids (n_cells, 4 or 8, 3), as VTK
            orders them.
        centroid: (n_cells, d) m.
        density: (n_cells,) physical densities.
        modes: (n_cells, corners, d, q) the reduced basis at the corners; q = 0 if not reduced.
        length: from joint axis to joint axis, m; None if not known.
        regions: what the scene keeps solid or void: kind and outline (n, 2), m, of every region.
        stress: (n_cells,) largest von Mises stress along the motion, Pa; None if not known.
        stress_instant: (n_cells,) when it is reached, s; likewise.
        filtered: (n_cells,) densities before the projection, smooth from cell to cell; likewise.
        wall: (n_cells,) thickness of a hollow arm's wall, m, which the density stands for; None of
            others.
    """

    name: str
    corners: np.ndarray
    centroid: np.ndarray
    density: np.ndarray
    modes: np.ndarray
    length: float | None = None
    regions: tuple[tuple[str, np.ndarray], ...] = ()
    stress: np.ndarray | None = None
    stress_instant: np.ndarray | None = None
    filtered: np.ndarray | None = None
    wall: np.ndarray | None = None

    @property
    def designed(self) -> bool:
        """Whether it has a design."""
        return len(self.density) > 0

    @property
    def solid(self) -> np.ndarray:
        """How much of every cell is solid (n_cells,): the density, but of a wall all of it."""
        return self.density if self.wall is None else np.ones_like(self.density)


def gather_views(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
    stress: Mapping[int, ArmStress] | None = None,
    x_filtered: Mapping[int, np.ndarray] | None = None,
) -> list[ArmView]:
    """Collect every arm on the root (collective); empty list elsewhere.

    Args:
        scene, partition, arms, x_phys: the designs.
        stress: what `stress_report` returned of their motion, if it is known.
        x_filtered: what the designs were projected from, if it is known; on all ranks or none.
    """

    def of_arm(index: int, arm: Arm) -> dict[str, np.ndarray]:
        operators = arm.substructure.operators  # also of arms that no design was set for
        nodes = operators.cells[:, : compat.cell_corner_count(arm.mesh.mesh)]
        shape = (*nodes.shape, arm.mesh.dim, 0)
        own = {
            "centroid": arm.mesh.centroid,
            "density": x_phys[index],
            "corners": arm.kind.points(x_phys[index])[nodes],
            "modes": np.zeros(shape) if arm.basis is None else arm.basis.V[nodes],
        }
        return own if x_filtered is None else own | {"filtered": x_filtered[index]}

    with together(partition.world):
        mine = {index: of_arm(index, arm) for index, arm in arms.items()}
    cells = gather_tables(partition, mine)
    with together(partition.world):
        if partition.world.rank == 0:
            return _views(scene, cells, stress or {})
        return []


def _views(
    scene: Scene, cells: Mapping[int, Mapping[str, np.ndarray]], stress: Mapping[int, ArmStress]
) -> list[ArmView]:
    """Return the views of all arms in the chain, given cells of those with a design (root only)."""
    views = []
    for index, owner in enumerate(scene.owners):
        keys = scene.arms[index]
        if owner is None:
            none = np.zeros((0, 2**scene.dimension, scene.dimension))
            views.append(ArmView(keys.name, none, none[:, 0], none[:, 0, 0], none[..., None]))
            continue
        order = canonical_order(cells[owner]["centroid"])
        own = {name: values[order] for name, values in cells[owner].items()}
        around, known = TENSOR[own["corners"].shape[1:]], stress.get(index)
        own |= {name: own[name][:, around] for name in ("corners", "modes")}
        views.append(
            ArmView(
                name=keys.name,
                **own,
                length=keys.length,
                regions=_outlines(scene, index),
                stress=None if known is None else known.by_cell[order],
                stress_instant=None if known is None else known.when[order],
                wall=scene.arms[owner].wall_at(own["density"]),
            )
        )
    return views


def _outlines(scene: Scene, index: int) -> tuple[tuple[str, np.ndarray], ...]:
    """Return kind and outline of the regions of an arm, mirror images included."""
    arm = scene.arms[index]
    pattern = scene.arms[scene.patterns.get(index, index)]
    scale = np.array([arm.length / pattern.length, arm.height / pattern.height])
    outlines = []
    for region in pattern.regions:
        import shapely

        shape = shapely.box(*region.bounds)
        if region.circle is not None:
            *centre, radius = region.circle
            shape = shapely.Point(centre).buffer(radius)
        for mirror in (1.0, -1.0) if pattern.symmetric_about[0] else (1.0,):
            points = np.array(shape.exterior.coords) * scale * [1.0, mirror]
            outlines.append((region.kind, points))
    return tuple(outlines)


def canonical_order(points: np.ndarray) -> np.ndarray:
    """Sort points by x, then y (then z), equal to 1e-9 of their extent: alike on any partition."""
    size = np.ptp(points, axis=0).max() or 1.0
    rounded = np.round(points / (1e-9 * size))
    return np.lexsort(rounded.T[::-1])


def designed(views: Sequence[ArmView]) -> list[ArmView]:
    """Return the arms that have a design."""
    return [view for view in views if view.designed]


# -- design.npz and gradient.npz: values of the cells by centroid, and reading a design back ------

# Of the arrays of design.npz.
UNITS = {"centroid": "m", "density": "-", "filtered": "-", "shape": "-", "duration": "s"}
ROUNDING = 1e-9  # of densities that other programs have computed


def write_design(folder: Path, views: Sequence[ArmView], scene: Scene) -> None:
    """Write design.npz: centroids and physical densities of every arm, and a designed law.

    Of projected designs what they were projected from, too: outlines are drawn by it.
    """
    arrays = by_law_name(scene, law_values(scene))
    for view in designed(views):
        arrays[f"{view.name}/centroid"] = view.centroid
        arrays[f"{view.name}/density"] = view.density
        if view.filtered is not None:
            arrays[f"{view.name}/filtered"] = view.filtered
    held = {key.rpartition("/")[2] for key in arrays}
    arrays["units"] = np.array([f"{name}: {unit}" for name, unit in UNITS.items() if name in held])
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

    Of a shared design once, under the name of the arm it belongs to; of arms that repeat another's
    design each arm's own, which add up cell by cell.
    """
    mine = {
        k: {
            "centroid": arm.mesh.centroid,
            "gradient": by_cell.get(k, np.zeros(arm.mesh.num_cells)),
        }
        for k, arm in arms.items()
    }
    tables = gather_tables(partition, mine)
    by_law = by_law_name(scene, by_cell.get(LAW, np.zeros(0)))
    with together(partition.world):
        if partition.world.rank != 0:
            return
        arrays: dict[str, Any] = {"objective": objective, **by_law}
        for index, table in tables.items():
            order, name = canonical_order(table["centroid"]), scene.arms[index].name
            arrays |= {f"{name}/{key}": values[order] for key, values in table.items()}
        unit = scene.objective.response.unit  # per physical density, which has none
        arrays["units"] = [f"objective: {unit}", "centroid: m", f"gradient: {unit}"]
        write_arrays(path, arrays)


def by_law_name(scene: Scene, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return values (n,) of the law's variables under their names in files."""
    count = len(scene.motion.coefficients)
    result = {"motion/shape": values[:count], "motion/duration": values[count:]}
    return {name: item for name, item in result.items() if len(item)}


def under_law_of(scene: Scene, design: Path | None) -> Scene:
    """Return a scene with the law of a design.npz, where the scene's law has variables."""
    if design is None or not law_names(scene):
        return scene
    arrays, here = _load_design(design), by_law_name(scene, law_values(scene))
    values = [np.ravel(arrays.get(name, item)) for name, item in here.items()]
    if [len(value) for value in values] != [len(item) for item in here.values()]:
        raise InputError(
            f"{design}: motion/shape: {len(values[0])} coefficients, and motion.shape has "
            f"{len(scene.motion.coefficients)} in {scene.source}; state as many"
        )
    return with_law(scene, np.concatenate(values))


def read_views(scene: Scene, path: Path) -> list[ArmView]:
    """Return the arms of a design file, on this rank alone.

    Raises:
        InputError: the file cannot be read, or does not fit the scene's arms.
    """
    return gather_views(*arms_with_design(MPI.COMM_SELF, scene, path))


class Designed(NamedTuple):
    """A scene's arms with a design, in the order in which functions of both take them.

    Attributes:
        scene: whose arms they are.
        partition: which ranks do which arm.
        arms: this rank's, by their places.
        x_phys: (n_cells,) physical densities of each.
    """

    scene: Scene
    partition: Partition
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]

    def bodies(self) -> dict[int, ShapeIntegrals]:
        """Return the arms reduced under the scene, on the root (collective).

        The arms keep what they have.
        """
        with together(self.partition.world):
            own = {k: arm.under(self.scene).reduce(self.x_phys[k]) for k, arm in self.arms.items()}
        return gather_arms(self.partition, own)


def arms_with_design(
    world: MPI.Comm, scene: Scene, design: Path | None, profile: Profile | None = None
) -> Designed:
    """Build the arms; return them with the physical densities of a file, or the initial ones.

    The scene is under the law of the file's design. Without a profile nobody counts what is done.

    Raises:
        InputError: the design does not fit the arms.
    """
    from dolfinopt.arms.arm import build_arms, uniform_design

    scene = on_root(world, under_law_of, scene, design)
    partition = partition_arms(world, scene.cell_counts, undivided=scene.dimension == 2)
    arms = build_arms(scene, partition, profile or Profile())
    if design is None:
        x_phys = uniform_design(scene, partition, arms)
    else:
        x_phys = read_design(design, partition, arms)
    return Designed(scene, partition, arms, x_phys)


def read_design(path: Path, partition: Partition, arms: Mapping[int, Arm]) -> dict[int, np.ndarray]:
    """Return the physical densities of a design.npz on this rank's cells (collective).

    Cells take the value of the nearest centroid in the file. An arm with a pattern that the file
    does not hold takes those of its pattern, scaled.

    Raises:
        InputError: the file is missing, damaged, or made for other arms.
    """
    arrays = on_root(partition.world, _load_design, path)
    with together(partition.world):
        return {k: _fit(path, arm.scene, k, arm.mesh, arrays)[0] for k, arm in arms.items()}


def read_smooth_design(
    path: Path, scene: Scene, partition: Partition, meshes: Mapping[int, ArmMesh]
) -> dict[int, tuple[np.ndarray, np.ndarray | None]]:
    """Return physical densities as `read_design` does, and what they were projected from.

    Collective. The latter is None where the file does not hold it.
    """
    arrays = on_root(partition.world, _load_design, path)
    with together(partition.world):
        return {k: _fit(path, scene, k, mesh, arrays) for k, mesh in meshes.items()}


def _repeat(arm: ArmKeys, pattern: ArmKeys, arrays: dict[str, np.ndarray]) -> None:
    """Add an arm that repeats another's design to the arrays of a file that has the latter."""
    if f"{arm.name}/density" in arrays:
        return
    for key in ("centroid", "density", "filtered"):
        values = arrays.get(f"{pattern.name}/{key}")
        if values is not None and values.ndim == 2:
            values = values[:, :2] * [arm.length / pattern.length, arm.height / pattern.height]
        if values is not None:
            arrays[f"{arm.name}/{key}"] = values


def _load_design(path: Path) -> dict[str, np.ndarray]:
    return read_arrays(path, "give a design.npz that dolfinopt wrote")


def physical(where: str, density: np.ndarray) -> np.ndarray:
    """Return densities as numbers in [0, 1].

    Args:
        where: what the message begins with.
        density: (n,) as the user has it; rounding beyond 0 and 1 does no harm.

    Raises:
        InputError: they are no numbers, or lie outside.
    """
    if density.dtype.kind not in "fiub":
        raise InputError(f"{where} holds {density.dtype}, not real numbers")
    outside = ~((density >= -ROUNDING) & (density <= 1.0 + ROUNDING))  # catches NaN
    if outside.any():
        raise InputError(
            f"{where} = {density[outside][0]:g} at cell {np.flatnonzero(outside)[0]}: "
            "physical densities lie in [0, 1]"
        )
    return np.clip(density.astype(float), 0.0, 1.0)


def _fit(
    path: Path, scene: Scene, index: int, mesh: ArmMesh, arrays: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the file's densities, and the filtered ones if any, of a mesh by nearest centroid."""
    if index in scene.patterns:
        _repeat(scene.arms[index], scene.arms[scene.patterns[index]], arrays)
    keys = [f"{mesh.name}/{key}" for key in ("centroid", "density", "filtered")]
    for key in keys[:2]:
        if key not in arrays:
            names = sorted({key.split("/")[0] for key in arrays if "/" in key})
            raise InputError(
                f"{path}: missing key {key!r} for arm {mesh.name!r}; the file holds "
                f"{', '.join(map(repr, names)) or 'nothing'}; give a design made for these arms"
            )
    centroid, density, filtered = arrays[keys[0]], arrays[keys[1]], arrays.get(keys[2])
    shape, fits = density.shape, centroid.ndim == 2 and centroid.shape[1] >= mesh.dim
    if len(shape) != 1 or not fits or centroid.shape[:1] != shape:
        raise InputError(
            f"{path}: {keys[1]} has shape {shape} beside centroids of shape {centroid.shape}; "
            f"expected (n,) and (n, {mesh.dim})"
        )
    for key, values in zip(keys[::2], (centroid, filtered), strict=True):
        if values is None:
            continue
        numbers = len(values) and values.dtype.kind in "fiu" and np.isfinite(values).all()
        if values.shape[:1] != shape or not numbers:
            raise InputError(
                f"{path}: {key}: expected {len(density)} finite numbers or rows of them, one a "
                "cell; give a complete design"
            )
    density = physical(f"{path}: {keys[1]}", density)
    place = _nearest(path, mesh, centroid[:, : mesh.dim].astype(float))
    return density[place], None if filtered is None else filtered.astype(float)[place]


def _nearest(path: Path, mesh: ArmMesh, centroid: np.ndarray) -> np.ndarray:
    """Return the nearest design point of each cell; both must cover the same region."""
    from scipy.spatial import cKDTree

    cells, comm = mesh.centroid, mesh.comm
    low = np.min(comm.allgather(cells.min(axis=0)), axis=0)
    high = np.max(comm.allgather(cells.max(axis=0)), axis=0)
    size = comm.allreduce(mesh.area.max(), op=max) ** (1.0 / mesh.dim)
    points, a, b = cKDTree(centroid), centroid.min(axis=0), centroid.max(axis=0)
    spacing = points.query(centroid, k=2)[0][:, 1].max()  # inf of a single point
    reach = 2.0 * (size + min(spacing, (b - a).max()))
    distance, place = points.query(cells)
    if max(np.abs(a - low).max(), np.abs(b - high).max(), distance.max()) > reach:
        raise InputError(
            f"{path}: the design of arm {mesh.name!r} covers {_box(a, b)}, "
            f"its mesh {_box(low, high)}; give a design made for these arms"
        )
    return place


def _box(low: np.ndarray, high: np.ndarray) -> str:
    return ", ".join(f"{axis} {a:.4g}..{b:.4g} m" for axis, a, b in zip("xyz", low, high))


# -- design.vtu: density, arm and largest stress by cell, for ParaView -----------

# Cells by dimension and corners: triangle, quadrilateral, tetrahedron, hexahedron.
VTK_CELLS = {(2, 3): 5, (2, 4): 9, (3, 4): 10, (3, 8): 12}


def write_fields(folder: Path, views: Sequence[ArmView]) -> None:
    """Write design.vtu: density, arm and, if known, stress and thickness of the wall by cell.

    All designed arms are one grid, as few programs read collections, one below the other, in m;
    without one it is not written.
    """
    import pyvista
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    grids, below = pyvista.MultiBlock(), 0.0
    for number, view in enumerate(views):
        if not view.designed:
            continue
        cells, corners, dim = view.corners.shape
        points = np.zeros((cells * corners, 3))
        points[:, :dim] = view.corners.reshape(-1, dim)
        points[:, 1] -= below
        below += 2.0 * np.ptp(view.corners[:, :, 1])
        nodes = np.arange(len(points)).reshape(cells, corners)
        grid = pyvista.UnstructuredGrid({VTK_CELLS[dim, corners]: nodes}, points).clean()
        fields = {"density": view.density, "arm": np.full(cells, number), "stress": view.stress,
                  "wall": view.wall}  # fmt: skip
        grid.cell_data.update({name: item for name, item in fields.items() if item is not None})
        grids.append(grid)
    if not len(grids):
        return
    every = grids.combine()  # with the fields that all arms have
    every.set_active_scalars("density")
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetInputData(every)
    writer.SetDataModeToBinary()
    writer.WriteToOutputStringOn()  # a full disk is told
    writer.Write()
    write_text(folder / "design.vtu", writer.GetOutputString())


# -- history.csv: a line an iteration, written as it happens and read back -----------------------


def write_history(path: Path, rows: Sequence[HistoryRow]) -> None:
    """Begin the file anew with the rows known so far."""
    header = [",".join(row.figures) + "\n" for row in rows[:1]]
    write_text(path, "".join([*header, *map(_line, rows)]))


def append_history(path: Path, row: HistoryRow) -> None:
    """Add one line; the first row brings the header, too."""
    if path.stat().st_size:
        append_text(path, _line(row))
    else:
        write_history(path, [row])


def _line(row: HistoryRow) -> str:
    return ",".join(f"{value:.10g}" for value in row.figures.values()) + "\n"


def read_history(path: Path) -> list[HistoryRow]:
    """Read history.csv back."""
    with open_input(path) as stream:
        header, *rows = csv.reader(stream.read().decode().splitlines())
        return [HistoryRow.from_figures(dict(zip(header, map(float, row)))) for row in rows]
