"""design.npz and gradient.npz: values of the cells by centroid, and reading a design back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.disk import read_arrays, write_arrays
from dolfinopt.errors import InputError
from dolfinopt.output.views import ArmView, canonical_order, designed, gather_views
from dolfinopt.parallel import Partition, gather_cells, on_root, together
from dolfinopt.responses.response import objective_of
from dolfinopt.scene.load import Arm as ArmKeys
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.mesh.arm_mesh import ArmMesh


# Of the arrays of design.npz.
UNITS = {"centroid": "m", "density": "-", "filtered": "-"}
ROUNDING = 1e-9  # of densities that other programs have computed


def write_design(folder: Path, views: Sequence[ArmView]) -> None:
    """Write design.npz: centroids and physical densities of every arm.

    Of projected designs what they were projected from, too: outlines are drawn by it.
    """
    arrays = {}
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
    centroid, density = (f"{pattern.name}/{key}" for key in ("centroid", "density"))
    filtered = f"{pattern.name}/filtered"
    points = arrays.get(centroid, np.empty(0))
    if f"{arm.name}/density" in arrays or density not in arrays or points.ndim != 2:
        return
    scale = [arm.length / pattern.length, arm.height / pattern.height]
    arrays[f"{arm.name}/centroid"] = points[:, :2] * scale
    arrays[f"{arm.name}/density"] = arrays[density]
    if filtered in arrays:
        arrays[f"{arm.name}/filtered"] = arrays[filtered]


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
    from scipy.spatial import cKDTree

    if index in scene.patterns:
        _repeat(scene.arms[index], scene.arms[scene.patterns[index]], arrays)
    name = mesh.name
    keys = (f"{name}/centroid", f"{name}/density")
    missing = [key for key in keys if key not in arrays]
    if missing:
        found = sorted({key.split("/")[0] for key in arrays if "/" in key})
        raise InputError(
            f"{path}: missing key {missing[0]!r} for arm {name!r}; the file holds "
            f"{', '.join(map(repr, found)) or 'nothing'}; give a design made for these arms"
        )
    centroid, density = (np.asarray(arrays[key]) for key in keys)
    if centroid.ndim != 2 or centroid.shape[1] < mesh.dim or density.shape != centroid.shape[:1]:
        raise InputError(
            f"{path}: {keys[1]} has shape {density.shape} beside centroids of shape "
            f"{centroid.shape}; expected (n,) and (n, {mesh.dim})"
        )
    if centroid.dtype.kind not in "fiu":
        raise InputError(f"{path}: {keys[0]} holds {centroid.dtype}, not real numbers")
    centroid = centroid.astype(float)[:, : mesh.dim]
    if len(density) == 0 or not np.isfinite(centroid).all():
        raise InputError(f"{path}: {keys[0]} is empty or not finite; give a complete design")
    density = physical(f"{path}: {keys[1]}", density)
    place = _nearest(path, mesh, centroid, cKDTree)
    filtered = arrays.get(f"{name}/filtered")
    if filtered is None:
        return density[place], None
    if filtered.shape != density.shape or not _are_finite(filtered):
        raise InputError(
            f"{path}: '{name}/filtered' has shape {filtered.shape}: expected {len(density)} finite "
            "numbers, one a cell"
        )
    return density[place], filtered.astype(float)[place]


def _are_finite(values: np.ndarray) -> bool:
    return values.dtype.kind in "fiu" and bool(np.isfinite(values).all())


def _nearest(path: Path, mesh: ArmMesh, centroid: np.ndarray, tree: Any) -> np.ndarray:
    """Return the nearest design point of each cell; both must cover the same region."""
    cells, comm = mesh.centroid, mesh.comm
    low = np.min(comm.allgather(cells.min(axis=0)), axis=0)
    high = np.max(comm.allgather(cells.max(axis=0)), axis=0)
    size = comm.allreduce(mesh.area.max(), op=max) ** (1.0 / mesh.dim)
    points = tree(centroid)
    spacing = points.query(centroid, k=2)[0][:, 1].max() if len(centroid) > 1 else np.inf
    reach = 2.0 * (size + min(spacing, np.ptp(centroid, axis=0).max()))
    edge = np.concatenate([centroid.min(axis=0) - low, centroid.max(axis=0) - high])
    distance, place = points.query(cells)
    if np.abs(edge).max() > reach or distance.max() > reach:
        a, b = centroid.min(axis=0), centroid.max(axis=0)
        raise InputError(
            f"{path}: the design of arm {mesh.name!r} covers {_box(a, b)}, "
            f"its mesh {_box(low, high)}; give a design made for these arms"
        )
    return place


def _box(low: np.ndarray, high: np.ndarray) -> str:
    return ", ".join(f"{axis} {a:.4g}..{b:.4g} m" for axis, a, b in zip("xyz", low, high))
