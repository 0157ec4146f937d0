"""What a scene's meshes cost in memory and time, told before anything is meshed."""

from __future__ import annotations

import math
import os
from collections import defaultdict
from pathlib import Path

from mpi4py import MPI

from dolfinopt.errors import InputError
from dolfinopt.mesh.measured import (
    BUDGET_CELLS,
    CELL_BYTES,
    CELL_SECONDS,
    CELL_SECONDS_EXPONENT,
    FILE_CELL_BYTES,
    FILL_BYTES,
    QUADRATIC_BYTES_RATIO,
    RANK_BYTES,
    SHARED_BYTES_RATIO,
    SMALL_MESH_CELLS,
    SOLID_BYTES_RATIO,
)
from dolfinopt.parallel import partition_arms
from dolfinopt.scene.load import Arm, Scene
from dolfinopt.scene.tables.arms import DEFAULT_ELEMENT

_CGROUP = Path("/sys/fs/cgroup")


def check_budget(world: MPI.Comm, scene: Scene) -> None:
    """Raise InputError, on all ranks, if the meshes need more memory than is free (collective).

    A mesh file without mesh_size says too little to be judged; cases that other processes compute
    at the same time are not seen.
    """
    cells = scene.cell_counts
    size = {k: count * _cells_for_one(scene.arms[k]) for k, count in cells.items()}
    least = {k: count * _least_bytes(scene, k) for k, count in cells.items()}
    small = SMALL_MESH_CELLS
    if sum(size.values()) <= small and sum(least.values()) <= small * CELL_BYTES:
        return
    partition = partition_arms(world, scene.cell_counts, whole=scene.dimension == 2)
    shared = {k: SHARED_BYTES_RATIO if scene.arms[k].is_solid else 1.0 for k in partition.arms}
    if partition.comm.size == 1:
        shared = dict.fromkeys(shared, 1.0)
    mine = (
        sum(shared[k] * max(_bytes(size[k]), least[k]) for k in shared) / partition.comm.size
        + RANK_BYTES
    )
    seconds = sum(_seconds(size[k]) for k in partition.arms) / partition.comm.size
    ranks = world.allgather((MPI.Get_processor_name(), mine, free_memory(), seconds))
    needed: dict[str, float] = defaultdict(float)
    free: dict[str, float] = {}
    for machine, need, found, _ in ranks:
        needed[machine] += need
        free[machine] = min(found, free.get(machine, math.inf))
    machine = max(needed, key=lambda name: needed[name] / max(free[name], 1.0))
    if needed[machine] <= free[machine]:
        return
    where = f" on {machine}" if len(needed) > 1 else ""
    raise InputError(
        f"{scene.source}: about {sum(cells.values()):.3g} cells need {_gigabytes(needed[machine])} "
        f"of memory{where}, where {_gigabytes(free[machine])} are free, and "
        f"{_spoken(max(row[-1] for row in ranks))} for every iteration; take fewer arms.cells or "
        "a larger arms.mesh_size"
    )


def _cells_for_one(arm: Arm) -> float:
    """Return how many bilinear quadrilaterals cost as much memory as a cell of the arm."""
    nodes = arm.nodes_per_cell
    if arm.is_solid:
        return SOLID_BYTES_RATIO * nodes
    return QUADRATIC_BYTES_RATIO * nodes if nodes > 1.0 else 1.0


def _least_bytes(scene: Scene, index: int) -> float:
    """Return the bytes a cell of a solid arm takes if its cells are not all alike; else 0."""
    arm = scene.arms[index]
    if not arm.is_solid or (arm.mesh is None and not arm.hollow):
        return 0.0
    stiffened = scene.simulation.stiffening is not False
    element = arm.element or DEFAULT_ELEMENT[arm.shape]
    if known := FILE_CELL_BYTES.get((arm.shape, element)):
        return known[stiffened]
    usual = arm.model_copy(update={"element": None})
    nodes = arm.nodes_per_cell / usual.nodes_per_cell
    return nodes * FILE_CELL_BYTES[arm.shape, DEFAULT_ELEMENT[arm.shape]][stiffened]


def free_memory(proc: Path = Path("/proc"), cgroup: Path = _CGROUP) -> float:
    """Return the bytes this process may still take, infinite where the system does not say.

    The least of what the machine has available and what every control group (version 1 or 2) above
    this process leaves. Files that the kernel only keeps in memory as long as nobody needs it
    count as free.
    """
    least = math.inf
    try:
        for line in (proc / "meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                least = 1024.0 * int(line.split()[1])
        groups = (proc / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return least
    for line in groups:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            names = cgroup, "memory.max", "memory.current", "inactive_file"
        elif "memory" in controllers.split(","):
            names = (
                cgroup / "memory",
                "memory.limit_in_bytes",
                "memory.usage_in_bytes",
                "total_inactive_file",
            )
        else:
            continue
        # In a container the path may be the host's, and the mount already the group's own.
        inner = Path(path.lstrip("/"))
        for folder in (inner, *inner.parents):
            least = min(least, _left(names[0] / folder, *names[1:]))
    return least


def ranks_here() -> int:
    """Return how many ranks run on this machine: all where the launcher does not say."""
    return max(1, int(os.environ.get("OMPI_COMM_WORLD_LOCAL_SIZE", MPI.COMM_WORLD.size)))


def _left(folder: Path, limit: str, usage: str, reclaimable: str) -> float:
    """Return what a control group leaves of its memory, infinite where it sets no limit."""
    try:
        total = (folder / limit).read_text().strip()
        if total == "max":
            return math.inf
        used = int((folder / usage).read_text())
        statistics = dict(
            line.split(maxsplit=1) for line in (folder / "memory.stat").read_text().splitlines()
        )
        return max(int(total) - used + int(statistics.get(reclaimable, 0)), 0)
    except (OSError, ValueError):
        return math.inf


def solid_bytes(cells: int, ranks: int) -> float:
    """Return the memory that a solid arm of hexahedra takes on all of its ranks."""
    shared = SHARED_BYTES_RATIO if ranks > 1 else 1.0
    return shared * _bytes(SOLID_BYTES_RATIO * cells) + ranks * RANK_BYTES


def _bytes(cells: float) -> float:
    return cells * (CELL_BYTES + FILL_BYTES * max(math.log2(max(cells, 1) / BUDGET_CELLS), 0.0))


def _seconds(cells: float) -> float:
    return CELL_SECONDS * cells * (cells / BUDGET_CELLS) ** CELL_SECONDS_EXPONENT


def _gigabytes(amount: float) -> str:
    return f"{amount / 1e9:.3g} GB"


def _spoken(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds > 2.0 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"
