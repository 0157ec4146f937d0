"""What the rest of the package counts on, whatever the version of DOLFINx."""

import subprocess
import sys

import dolfinx
import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI

from dolfinopt.mesh import compat

COMM = MPI.COMM_WORLD


@pytest.fixture(scope="module")
def mesh():
    corners = [np.zeros(2), np.array([2.0, 1.0])]
    return dolfinx.mesh.create_rectangle(COMM, corners, [6, 4], dolfinx.mesh.CellType.quadrilateral)


@pytest.mark.parametrize(("degree", "nodes"), [(1, 7 * 5), (2, 13 * 9)])
@pytest.mark.parametrize("components", [1, 2])
def test_spaces(mesh, degree, nodes, components):
    space = compat.lagrange_space(mesh, degree, components)
    assert space.dofmap.index_map.size_global == nodes
    assert space.dofmap.index_map_bs == components
    owned, ghosts = compat.local_cell_counts(mesh)
    assert COMM.allreduce(owned) == 24
    cells = compat.cell_nodes(space, owned)
    assert cells.shape == (owned, (degree + 1) ** 2)
    # All nodes of a cell lie in it.
    points = space.tabulate_dof_coordinates()[cells]
    corners = compat.cell_coordinates(mesh, owned)
    assert corners.shape == (owned, 4, 3)
    assert np.allclose(points.min(axis=1), corners.min(axis=1), atol=1e-14)
    assert np.allclose(points.max(axis=1), corners.max(axis=1), atol=1e-14)
    assert len(compat.cell_nodes(space, owned + ghosts)) == owned + ghosts


def test_scatters_are_transposes(mesh):
    space = compat.lagrange_space(mesh, 1)
    owned = space.dofmap.index_map.size_local
    rng = np.random.default_rng(COMM.rank)
    up, down = fem.Function(space), fem.Function(space)
    size = len(up.x.array)
    values, weights = rng.normal(size=(2, size))
    up.x.array[:], down.x.array[:] = values, weights
    compat.scatter_forward(up)
    compat.scatter_reverse_add(down)
    left = COMM.allreduce(float(up.x.array @ weights))
    right = COMM.allreduce(float(values[:owned] @ down.x.array[:owned]))
    assert left == pytest.approx(right, abs=1e-13)  # some forty terms of order one
    assert np.array_equal(up.x.array[:owned], values[:owned])
    assert COMM.size == 1 or COMM.allreduce(size - owned) > 0  # there were ghosts to fill


@pytest.mark.serial
def test_import_keeps_compilers_quiet():
    """The first record of a library must not set up logging to the terminal behind our back."""
    script = (
        "import logging, dolfinopt.mesh.compat; "
        "logging.info('compiled'); logging.getLogger('FFCx').warning('compiled')"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("", "")
