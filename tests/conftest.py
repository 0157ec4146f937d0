"""Set-up of the tests: environment, read by MPI and pictures, plugin of the ranks, fixtures.

The environment is completed before anything imports MPI; what the user has set stays.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest

ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",  # the ranks and workers are the parallelism
    "PYTHONNOUSERSITE": "1",  # ~/.local must not replace the NumPy that DOLFINx was built for
    # Pictures without a display: VTK draws through EGL.
    "MPLBACKEND": "Agg",
    "VTK_DEFAULT_OPENGL_WINDOW": "vtkEGLRenderWindow",
    "PYVISTA_OFF_SCREEN": "true",
    # Containers run as root; more ranks than cores are fine: Open MPI 4 (OMPI), then 5 (PRTE).
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
    "OMPI_MCA_hwloc_base_binding_policy": "none",
    "PRTE_MCA_hwloc_default_binding_policy": "none",
    "OMPI_MCA_btl": "self,vader",
    "OMPI_MCA_pml": "ob1",
    # Without an entry in /etc/hosts a name server would be asked for 5 s.
    "RES_OPTIONS": "timeout:1 attempts:1",
}
for _name, _value in ENVIRONMENT.items():
    os.environ.setdefault(_name, _value)

# Examples that are the same on all ranks and in every run; no deadline on a shared machine.
hypothesis.settings.register_profile("ranks", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("ranks")


def pytest_configure(config: pytest.Config) -> None:
    """Register the plugin of the ranks, except in the process that only distributes the tests.

    MPI leaves its settings in the environment of the process it starts in. The workers of
    pytest-xdist inherit it and an mpirun started by one of them would take itself for a rank.
    """
    distributes = config.getoption("numprocesses", None) and not hasattr(config, "workerinput")
    if not distributes:
        from ranks import Ranks

        config.pluginmanager.register(Ranks(config), "ranks")


@pytest.fixture
def shared_tmp_path(tmp_path: Path) -> Path:
    """Rank 0's temporary folder, on all ranks."""
    from mpi4py import MPI

    return MPI.COMM_WORLD.bcast(tmp_path, root=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a file's tests keep what they share: rank 0's temporary folder, on all ranks."""
    from mpi4py import MPI

    world = MPI.COMM_WORLD
    return world.bcast(tmp_path_factory.mktemp("kept") if world.rank == 0 else None, root=0)


@pytest.fixture
def write(shared_tmp_path: Path) -> Callable[[str, str], Path]:
    """Return what writes a text file on the root and returns its path on all ranks."""
    from mpi4py import MPI

    def write(name: str, text: str) -> Path:
        path = shared_tmp_path / name
        if MPI.COMM_WORLD.rank == 0:
            path.write_text(text + "\n")  # Gmsh ignores a last statement without it
        MPI.COMM_WORLD.barrier()
        return path

    return write


@pytest.fixture(autouse=True, scope="module")
def _clean_ranks() -> Iterator[None]:
    """Free what a file's tests left on all ranks together, and at no other time.

    Freeing PETSc's objects is collective, so that the collector must not run when it pleases; a
    run of it takes 0.1 s, too long for every test.
    """
    from mpi4py import MPI

    if MPI.COMM_WORLD.size == 1:
        yield
        return
    from petsc4py import PETSc

    gc.disable()
    yield
    gc.enable()
    gc.collect()
    PETSc.garbage_cleanup()
