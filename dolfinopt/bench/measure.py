"""The clock, and measurements in processes of their own: several ranks, a memory of their own.

`python -m dolfinopt.bench.measure MODULE FUNCTION FILE`, also under mpirun, calls a function of
MODULE with all ranks, the scene and the arguments in FILE; prints one line of JSON: what the root's
returned, and the peak memory of all ranks, MB.
"""

from __future__ import annotations

import gc
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm, build_arms, chain_of
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene, scene_from_dict

Arms: TypeAlias = dict[int, Arm]
Densities: TypeAlias = dict[int, np.ndarray]
Cells: TypeAlias = tuple[int, int]  # of an arm
# As dolfinopt.sh has it: containers run as root; more ranks than cores are fine; ranks are not
# bound to the cores of another run. Open MPI 4 (OMPI), then 5 (PRTE).
ENVIRONMENT = dict.fromkeys(("OMPI_ALLOW_RUN_AS_ROOT", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM"), "1")
ENVIRONMENT |= {
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
    "OMPI_MCA_hwloc_base_binding_policy": "none",
    "PRTE_MCA_hwloc_default_binding_policy": "none",
}


@dataclass(frozen=True, eq=False)
class Plan:
    """What is measured on: a scene; a quick plan has coarse settings and a single repeat."""

    scene: Scene
    quick: bool

    @property
    def repeats(self) -> int:
        """How often a short computation is timed; the fastest counts."""
        return 1 if self.quick else 5


def timed(
    action: Callable[[], Any], repeats: int = 1, short: float = math.inf
) -> tuple[float, float, Any]:
    """Call `repeats` times; return the least seconds of CPU and on the wall, and the last value.

    CPU time of this process leaves out others on the machine; whatever disturbs a call makes it
    longer. What takes more than `short` seconds is called once.
    """
    cpu = wall = math.inf
    for _ in range(repeats):
        gc.collect()
        begun, since = time.process_time(), time.perf_counter()
        value = action()
        cpu = min(cpu, time.process_time() - begun)
        wall = min(wall, time.perf_counter() - since)
        if cpu > short:
            break
    return cpu, wall, value


def arms_of(scene: Scene) -> Arms:
    """Return the scene's arms on this rank alone."""
    return build_arms(scene, partition_arms(MPI.COMM_SELF, scene.cell_counts), Profile())


def bodies_of(scene: Scene, arms: Arms, x_phys: Densities) -> list[ShapeIntegrals]:
    """Reduce the arms as `scene` asks for; return the bodies from the cart outwards."""
    return chain_of(scene, {k: arm.under(scene).reduce(x_phys[k]) for k, arm in arms.items()})


# -- processes -------------------------------------------------------------------------------


def mpirun() -> str | None:
    """Return the command that starts ranks, None where there is none."""
    return shutil.which("mpirun") or shutil.which("mpiexec")


def in_processes(
    function: Callable[..., Any], scene: Scene, *given: Any, ranks: int
) -> tuple[Any, float]:
    """Return what function(comm, scene, *given) does there, and the peak memory, MB.

    Raises:
        ConvergenceError: the processes failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "given.json"
        path.write_text(json.dumps([scene.to_dict(), *given]), encoding="utf-8")
        command = [sys.executable, "-m", __name__, function.__module__, function.__name__]
        command = [str(mpirun()), "-n", str(ranks)] * (ranks > 1) + [*command, str(path)]
        # os.environ is as Python found it: without what MPI added for this process alone.
        environment = {**ENVIRONMENT, **os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ConvergenceError(f"{' '.join(command)}: {done.stderr.strip()[-2000:]}")
    found, memory = json.loads(done.stdout.strip().splitlines()[-1])
    return found, memory


def _peak() -> float:
    """Return this process's peak memory, MB; not that of its parent, which getrusage inherits."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return float(status.partition("VmHWM:")[2].split()[0]) / 1024.0


def _main(module: str, name: str, file: str) -> None:
    comm = MPI.COMM_WORLD
    scene, *given = json.loads(Path(file).read_text(encoding="utf-8"))
    found = getattr(import_module(module), name)(comm, scene_from_dict(scene), *given)
    memory = comm.allreduce(_peak())
    if comm.rank == 0:
        print(json.dumps([found, memory]), flush=True)


if __name__ == "__main__":
    _main(*sys.argv[1:])
