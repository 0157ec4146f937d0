"""The only file that knows DOLFINx 0.5 from 0.9 from 0.11."""

from __future__ import annotations

import errno
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.parallel import on_root
from dolfinopt.progress import log
from dolfinopt.scene.tables.arms import CellShape

# DOLFINx 0.5 logs each JIT compilation through the root logger; a handler set beforehand keeps
# `logging.basicConfig` from being triggered by the first message.
logging.getLogger().addHandler(logging.NullHandler())
for _name in ("UFL", "FFCx"):
    logging.getLogger(_name).setLevel(logging.ERROR)

import basix  # noqa: E402
import dolfinx  # noqa: E402
import dolfinx.jit  # noqa: E402
import ufl  # noqa: E402
from dolfinx import fem, la  # noqa: E402
from dolfinx.mesh import GhostMode  # noqa: E402
from mpi4py import MPI  # noqa: E402

VERSION = tuple(int(part) for part in dolfinx.__version__.split(".")[:2])


def dolfinx_version() -> str:
    """Return DOLFINx's version, e.g. "0.5.2"."""
    return dolfinx.__version__


@cache
def check_form_cache() -> None:
    """Raise InputError unless DOLFINx finds a folder for the forms that it compiles."""
    home = os.environ.get("XDG_CACHE_HOME")
    try:
        folder = Path(home or Path.home() / ".cache") / "fenics"
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK) and not any(folder.glob("*.so")):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except (OSError, RuntimeError) as error:  # Path.home() finds none
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{home or '~/.cache'}: compiled forms cannot be kept there ({reason}); set the "
            "environment variable XDG_CACHE_HOME to a folder that you may write"
        ) from None


@contextmanager
def quiet_compilers() -> Iterator[None]:
    """Keep what compilers say from standard error: command lines, UFL's doubts about arrays."""
    before = logging.root.manager.disable
    logging.disable(logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Applying str", UserWarning)
            yield
    finally:
        logging.disable(before)


@quiet_compilers()
def model_to_mesh(model: Any, comm: MPI.Comm, gdim: int) -> tuple[Any, Any, Any]:
    """Distribute the Gmsh model of rank 0 over `comm`; return (mesh, cell tags, facet tags).

    Cells are ghosted across shared facets, so that every rank sees the neighbours of its cells.
    """
    if VERSION >= (0, 10):
        from dolfinx.io import gmsh as gmshio
    else:
        from dolfinx.io import gmshio
    if VERSION < (0, 6):
        return gmshio.model_to_mesh(model, comm, 0, gdim)
    links = (2,) if VERSION >= (0, 11) else ()  # cells a facet joins at most
    partitioner = dolfinx.mesh.create_cell_partitioner(GhostMode.shared_facet, *links)
    data = gmshio.model_to_mesh(model, comm, 0, gdim, partitioner=partitioner)
    if isinstance(data, tuple) and not hasattr(data, "cell_tags"):
        return data[0], data[1], data[2]
    return data.mesh, data.cell_tags, data.facet_tags


def lagrange_element(shape: str, degree: int, components: int | None = None) -> Any:
    """Return a Lagrange element of UFL, with components or scalar; constants of degree 0."""
    if VERSION < (0, 7):
        family = "Lagrange" if degree else "DG"
        if components is None:
            return ufl.FiniteElement(family, shape, degree)
        # FFCx 0.5 writes this variant into the element of a mesh when it compiles: without it the
        # signatures of all forms of the mesh would change then, and miss what was compiled before.
        variant = {"variant": "equispaced"} if degree == 1 else {}
        return ufl.VectorElement(family, shape, degree, dim=components, **variant)
    from basix.ufl import element

    size = () if components is None else (components,)
    return element("P", shape, degree, discontinuous=degree == 0, shape=size)


def mixed_element(*parts: Any) -> Any:
    """Return a mixed element of UFL."""
    if VERSION < (0, 7):
        return ufl.MixedElement(*parts)
    from basix.ufl import mixed_element

    return mixed_element(list(parts))


def lagrange_space(mesh: Any, degree: int, components: int = 1) -> Any:
    """Return the continuous Lagrange space of `degree` with 1 or more components a node.

    DOLFINx 0.5 compiles its element; what an interrupted run has left of it is compiled anew.
    """
    try:
        return _lagrange_space(mesh, degree, components)
    except (RuntimeError, TimeoutError):  # the first on several ranks
        if not on_root(mesh.comm, _remove_interrupted):
            raise
        return _lagrange_space(mesh, degree, components)


@quiet_compilers()
def _lagrange_space(mesh: Any, degree: int, components: int) -> Any:
    if VERSION < (0, 7):
        if components == 1:
            return fem.FunctionSpace(mesh, ("Lagrange", degree))
        return fem.VectorFunctionSpace(mesh, ("Lagrange", degree), dim=components)
    if components == 1:
        return fem.functionspace(mesh, ("Lagrange", degree))
    return fem.functionspace(mesh, ("Lagrange", degree, (components,)))


def form_folder() -> Path:
    """Return DOLFINx's folder for what it compiles."""
    known = "get_parameters" if VERSION < (0, 6) else "get_options"
    return Path(getattr(dolfinx.jit, known)()["cache_dir"])


def _remove_interrupted() -> bool:
    """Remove what interrupted compilations left; return whether there was any."""
    left = [
        path for path in form_folder().glob("*.c") if not path.with_suffix(".c.cached").exists()
    ]
    for path in left:
        log.info("%s: its compilation was interrupted and is repeated", path)
        path.unlink(missing_ok=True)
    return bool(left)


def _rows(adjacency: Any, columns: int) -> np.ndarray:
    """Return a fixed-width connectivity as an array (n, columns) whatever its container."""
    return np.asarray(getattr(adjacency, "array", adjacency)).reshape(-1, columns)


def cell_nodes(space: Any, num_cells: int) -> np.ndarray:
    """Return the (block) dof numbers (num_cells, nodes a cell) of the first cells, local."""
    nodes = space.dofmap.dof_layout.num_dofs  # not of the first cell: a rank may have none
    return _rows(space.dofmap.list, nodes)[:num_cells].astype(np.int32)


def cell_shape(mesh: Any) -> CellShape:
    """Return "triangle", "quadrilateral", "tetrahedron" or "hexahedron"."""
    shape: CellShape = mesh.topology.cell_type.name
    return shape


def cell_corner_count(mesh: Any) -> int:
    """Return the corners of a cell, 3, 4 or 8; cells have straight sides."""
    return int(mesh.geometry.cmap.create_dof_layout().num_dofs)  # a rank may have no cell


def cell_geometry_nodes(mesh: Any, num_cells: int) -> np.ndarray:
    """Return the geometry's node numbers (num_cells, points a cell) of the first cells, local."""
    return _rows(mesh.geometry.dofmap, cell_corner_count(mesh))[:num_cells]


def cell_coordinates(mesh: Any, num_cells: int) -> np.ndarray:
    """Return the coordinates (num_cells, points a cell, 3) of the first cells, m."""
    return mesh.geometry.x[cell_geometry_nodes(mesh, num_cells)]


class MovedMesh:
    """A mesh whose nodes lie elsewhere, and that shares all else with the one it was.

    DOLFINx 0.5 cannot copy one. Function spaces are the other one's.
    """

    def __init__(self, mesh: Any, points: np.ndarray):
        """Place the nodes at (n, 3) points, m."""
        self.topology = mesh.topology
        self.geometry = _MovedGeometry(mesh.geometry, points)


class _MovedGeometry:
    def __init__(self, geometry: Any, points: np.ndarray):
        self._geometry, self.x = geometry, points

    def __getattr__(self, name: str) -> Any:
        return getattr(self._geometry, name)


def cell_facets(mesh: Any, num_cells: int) -> np.ndarray:
    """Return the facets' local numbers (num_cells, facets a cell) of the first cells.

    In the order of the reference cell, see `cells.facet_corners`.
    """
    dim = mesh.topology.dim
    mesh.topology.create_entities(dim - 1)
    mesh.topology.create_connectivity(dim, dim - 1)
    links = mesh.topology.connectivity(dim, dim - 1)
    facets = basix.topology(getattr(basix.CellType, cell_shape(mesh)))[dim - 1]
    return _rows(links, len(facets))[:num_cells].astype(np.int32)


def facets_on(mesh: Any, plane: float, tolerance: float) -> np.ndarray:
    """Return the local numbers of this rank's boundary facets on the plane x = `plane`."""
    result = dolfinx.mesh.locate_entities_boundary(
        mesh, mesh.topology.dim - 1, lambda x: np.abs(x[0] - plane) < tolerance
    )
    return np.asarray(result, dtype=np.int32)


def box_mesh(comm: MPI.Comm, low: np.ndarray, high: np.ndarray, cells: tuple[int, ...]) -> Any:
    """Return a grid of quadrilaterals or hexahedra, ghosted as by `model_to_mesh`.

    Args:
        comm: ranks that share it.
        low, high: (d,) opposite corners, m.
        cells: d numbers along the axes.
    """
    plane, kinds = len(cells) == 2, dolfinx.mesh.CellType
    create = dolfinx.mesh.create_rectangle if plane else dolfinx.mesh.create_box
    return create(
        comm,
        [np.asarray(low, dtype=float), np.asarray(high, dtype=float)],
        list(cells),
        kinds.quadrilateral if plane else kinds.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )


def local_cell_counts(mesh: Any) -> tuple[int, int]:
    """Return the number of cells this rank owns and the number of its ghost cells."""
    cells = mesh.topology.index_map(mesh.topology.dim)
    return cells.size_local, cells.num_ghosts


def scatter_reverse_add(function: Any) -> None:
    """Add the ghosts' values to their owners."""
    if hasattr(la, "InsertMode"):
        function.x.scatter_reverse(la.InsertMode.add)
    else:
        function.x.scatter_reverse(la.ScatterMode.add)


@quiet_compilers()
def compile_form(form: ufl.Form) -> Any:
    """Compile a UFL form; the JIT cache of DOLFINx keeps it between runs."""
    return fem.form(form)
