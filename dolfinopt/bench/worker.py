"""A few design iterations in a process of its own: CPU seconds by phase, and peak memory.

`python -m dolfinopt.bench.worker SCENE.json`, also under mpirun; prints one line of JSON.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from mpi4py import MPI

from dolfinopt.optimization.history import HistoryRow
from dolfinopt.output.run import optimize
from dolfinopt.scene.load import Scene, scene_from_dict

# Phases of the profile that stand for themselves; the others are parts of `bodies`.
BODIES = "assembly", "reduction", "inertia integrals"
GRADIENT = "objective", "gradient", "adjoint"


@dataclass(frozen=True)
class Iteration:
    """CPU seconds of one design iteration on the root.

    Attributes:
        iterations: that were done.
        wall: median of the iterations by the clock on the wall, s.
        elapsed: from the first to the last moment of `optimize`, by that clock, s.
        total: median of the iterations.
        bodies, simulation, gradient, filter, mma: parts of it, means.
        memory: peak of all ranks together, MB.
    """

    iterations: int
    wall: float
    elapsed: float
    total: float
    bodies: float
    simulation: float
    gradient: float
    filter: float
    mma: float
    memory: float


def iterate(scene: Scene, world: MPI.Comm) -> Iteration:
    """Optimise for the scene's iterations, at least two (collective on `world`)."""
    cpu: list[float] = []
    wall: list[float] = []

    def report(row: HistoryRow) -> None:
        cpu.append(time.process_time())
        wall.append(time.perf_counter())

    begun = time.perf_counter()
    result = optimize(scene, world=world, report=report)
    elapsed = time.perf_counter() - begun
    memory = world.allreduce(_peak())
    if world.rank > 0:
        return Iteration(result.iterations, *(0.0,) * 8, memory)
    total = float(np.median(np.diff(cpu)))
    # Phases are kept in wall-clock seconds: others on the machine lengthen them all alike.
    share = (cpu[-1] - cpu[0]) / (wall[-1] - wall[0]) / (result.iterations + 1)

    def seconds(*phases: str) -> float:
        return share * sum(result.profile.seconds.get(phase, 0.0) for phase in phases)

    return Iteration(
        iterations=result.iterations,
        wall=float(np.median(np.diff(wall))),
        elapsed=elapsed,
        total=total,
        bodies=seconds(*BODIES),
        simulation=seconds("simulation"),
        gradient=seconds(*GRADIENT),
        filter=seconds("filter"),
        mma=seconds("mma"),
        memory=memory,
    )


def _peak() -> float:
    """Return this process's peak memory, MB; not that of its parent, which getrusage inherits."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    lines = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
    return float(lines["VmHWM"].split()[0]) / 1024.0


def main() -> None:
    """Read a scene, iterate, print."""
    scene = scene_from_dict(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    done = iterate(scene, MPI.COMM_WORLD)
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(asdict(done)))


if __name__ == "__main__":
    main()
