"""What a scene's meshes cost in memory, told before anything is meshed."""

from __future__ import annotations

import math
import os
from collections import defaultdict
from pathlib import Path

from mpi4py import MPI

from dolfinopt.errors import InputError
from dolfinopt.mesh.measured import (
    CELL_BYTES,
    FILE_CELL_BYTES,
    RANK_BYTES,
    SHARED_BYTES_RATIO,
    SOLID_BYTES_RATIO,
)
from dolfinopt.parallel import partition_arms
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.arms import DEFAULT_ELEMENT

_CGROUP = Path("/sys/fs/cgroup")


def check_budget(world: MPI.Comm, scene: Scene) -> None:
    """Raise InputError, on all ranks, if the meshes need more memory than is free (collective).

    A mesh file without mesh_size says too little to be judged; cases that other processes compute
    at the same time are not seen.
    """
    cells = scene.cell_counts
    partition = partition_arms(world, cells, undivided=scene.dimension == 2)
    mine = RANK_BYTES
    for k in partition.arms:
        shared = SHARED_BYTES_RATIO if partition.comm.size > 1 and scene.arms[k].is_solid else 1.0
        mine += shared * cells[k] * _cell_bytes(scene, k) / partition.comm.size
    needed: dict[str, float] = defaultdict(float)
    free: dict[str, float] = {}
    for machine, need, result in world.allgather((MPI.Get_processor_name(), mine, free_memory())):
        needed[machine] += need
        free[machine] = min(result, free.get(machine, math.inf))
    machine = max(needed, key=lambda name: needed[name] / max(free[name], 1.0))
    if needed[machine] <= free[machine]:
        return
    where = f" on {machine}" if len(needed) > 1 else ""
    raise InputError(
        f"{scene.source}: about {sum(cells.values()):.3g} cells need {_gigabytes(needed[machine])} "
        f"of memory{where}, where {_gigabytes(free[machine])} are free; take fewer arms.cells or a "
        "larger arms.mesh_size"
    )


def _cell_bytes(scene: Scene, index: int) -> float:
    """Return the bytes that a cell of an arm takes."""
    arm = scene.arms[index]
    if not arm.is_solid:
        return CELL_BYTES * arm.nodes_per_cell
    usual = SOLID_BYTES_RATIO * CELL_BYTES * arm.nodes_per_cell
    if arm.mesh is None and not arm.hollow:
        return usual
    # Cells that are not all alike.
    stiffened = scene.simulation.stiffening is not False
    standard = DEFAULT_ELEMENT[arm.shape]
    element, nodes = arm.element or standard, 1.0
    if (arm.shape, element) not in FILE_CELL_BYTES:
        nodes = arm.nodes_per_cell / arm.unchecked_copy({"element": None}).nodes_per_cell
        element = standard
    return max(usual, nodes * FILE_CELL_BYTES[arm.shape, element][stiffened])


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
    return shared * SOLID_BYTES_RATIO * CELL_BYTES * cells + ranks * RANK_BYTES


def _gigabytes(amount: float) -> str:
    return f"{amount / 1e9:.3g} GB"
