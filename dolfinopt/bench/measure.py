"""The clock, and measurements in processes of their own: several ranks, a memory of their own.

`python -m dolfinopt.bench.measure MODULE FUNCTION GIVEN`, also under mpirun, calls a function of
MODULE with all ranks, the scene and the arguments in GIVEN, JSON; prints what the root's returned,
and the peak memory of all ranks, MB, as one line of JSON.
"""

from __future__ import annotations

import gc
import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm, build_arms
from dolfinopt.data import benchmark_folder
from dolfinopt.errors import ConvergenceError
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene, scene_from_dict

Arms: TypeAlias = dict[int, Arm]
Densities: TypeAlias = dict[int, np.ndarray]
Cells: TypeAlias = tuple[int, int]  # of an arm
# As dolfinopt.sh has it: containers run as root; more ranks than cores are fine; ranks are not
# bound to the cores of another run. Open MPI 4 (OMPI), then 5 (PRTE).
ENVIRONMENT = {
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
    "OMPI_MCA_hwloc_base_binding_policy": "none",
    "PRTE_MCA_hwloc_default_binding_policy": "none",
}


class Plan(NamedTuple):
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
    """Call `repeats` times, once what takes more than `short` seconds; return the last value.

    Before it the least seconds of CPU and on the wall: whatever disturbs a call makes it longer.
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


def load_program(file: Path) -> Any:
    """Return the module of a file."""
    spec: Any = spec_from_file_location(f"benchmark_{file.stem}", file)
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look it up
    spec.loader.exec_module(module)
    return module


def program(name: str) -> Any:
    """Return the module of another program beside which this one is measured."""
    return load_program(benchmark_folder() / "programs" / f"{name}.py")


def mpirun() -> str | None:
    """Return the command that starts ranks, None where there is none."""
    return shutil.which("mpirun") or shutil.which("mpiexec")


def in_processes(
    function: Callable[..., Any], scene: Scene, *given: Any, ranks: int
) -> tuple[Any, float]:
    """Return what function(comm, scene, *given) does there, and the peak memory, MB.

    ConvergenceError where the processes fail.
    """
    command = [sys.executable, "-m", __name__, function.__module__, function.__name__]
    command = [str(mpirun()), "-n", str(ranks)] * (ranks > 1) + command
    words = [*command, json.dumps([scene.to_dict(), *given])]
    # os.environ is as Python found it: without what MPI added for this process alone.
    environment = {**ENVIRONMENT, **os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ConvergenceError(f"{' '.join(command)}: {done.stderr.strip()[-2000:]}")
    result, memory = json.loads(done.stdout.strip().splitlines()[-1])
    return result, memory


def _main(module: str, name: str, text: str) -> None:
    comm, (scene, *given) = MPI.COMM_WORLD, json.loads(text)
    result = getattr(import_module(module), name)(comm, scene_from_dict(scene), *given)
    # Not by getrusage, which inherits the peak of the parent; kB.
    peak = Path("/proc/self/status").read_text(encoding="utf-8").partition("VmHWM:")[2].split()[0]
    memory = comm.allreduce(float(peak) / 1024.0)
    if comm.rank == 0:
        print(json.dumps([result, memory]), flush=True)


if __name__ == "__main__":
    _main(*sys.argv[1:])
