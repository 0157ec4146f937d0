"""The Helmholtz filter: what it keeps, its transpose, and the kernel it converges to."""

import dolfinx
import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from runs import STATED

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.density.filter import HelmholtzFilter
from dolfinopt.errors import ConvergenceError
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh, box_arm

COMM = MPI.COMM_WORLD
LENGTH, HEIGHT = 1.0, 0.06  # m


def arm(cells=(40, 6), comm=COMM, length=LENGTH, height=HEIGHT, passive=0.0):
    return box_arm(comm, "arm", (length, height), cells, passive)


def rough(centroid):
    """Return a field in [0, 1] that jumps from cell to cell, the same on any number of ranks."""
    return 0.5 + 0.5 * np.sin(1e4 * centroid[:, 0] + 7e4 * centroid[:, 1])


def radius_of(r):
    """Return the cone radius of the Helmholtz length r."""
    return 2.0 * np.sqrt(3.0) * r


@pytest.fixture(scope="module")
def mesh():
    return arm(passive=0.1)


def test_radius_zero_is_the_identity(mesh):
    smooth = HelmholtzFilter(mesh, 0.0)
    x = rough(mesh.centroid)
    for apply in (smooth.forward, smooth.backward):
        y = apply(x)
        assert np.array_equal(y, x)
        assert y is not x  # who changes the result keeps the design


# -- cells of any shape ----------------------------------------------------------------------


def square(kind, cells, comm=COMM):
    """Return a mesh of the unit square (sheared, graded or with its nodes moved at random)."""
    shape, deformed = kind.split()
    cell = getattr(dolfinx.mesh.CellType, shape)
    corners = [np.zeros(2), np.ones(2)]
    mesh = dolfinx.mesh.create_rectangle(
        comm, corners, [cells, cells], cell, ghost_mode=dolfinx.mesh.GhostMode.shared_facet
    )
    points = mesh.geometry.x
    x, y = points[:, :2].T.copy()
    if deformed == "sheared":
        points[:, 0] += 0.5 * (y - 0.5)
    elif deformed == "graded":
        points[:, 0] += 0.10 * np.sin(2.0 * np.pi * x)
        points[:, 1] -= 0.08 * np.sin(2.0 * np.pi * y)
    elif deformed == "random":
        inside = (np.abs(x - 0.5) < 0.499) & (np.abs(y - 0.5) < 0.499)
        points[:, 0] += inside * 0.25 / cells * np.sin(1e3 * x + 3e3 * y)
        points[:, 1] += inside * 0.25 / cells * np.sin(2.7e3 * x - 1.3e3 * y)
    owned, _ = compat.local_cell_counts(mesh)
    p = compat.cell_coordinates(mesh, owned)[:, :, :2]
    if p.shape[1] == 3:
        first, second = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    else:  # the diagonals
        first, second = p[:, 3] - p[:, 0], p[:, 2] - p[:, 1]
    area = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    none = np.empty(0, dtype=np.int32)
    solid = np.zeros(owned, dtype=bool)
    return ArmMesh(
        "a", comm, mesh, p.mean(axis=1), area, solid, solid, none, none, np.array([1.0, 0.0])
    )


DEFORMED = ["right-angled", "sheared", "graded", "random"]
KINDS = [f"{shape} {deformed}" for shape in ("triangle", "quadrilateral") for deformed in DEFORMED]
ORTHOGONAL = ["quadrilateral right-angled", "quadrilateral graded"]


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_kept_on_any_mesh(kind):
    """Constants, the volume, and that backward is the transpose, to rounding."""
    mesh = square(kind, 20)
    smooth = HelmholtzFilter(mesh, 0.1)
    assert smooth.keeps_bounds == (kind in ORTHOGONAL)
    assert np.allclose(smooth.forward(np.full(mesh.num_cells, 0.3)), 0.3, rtol=1e-12)
    x = rough(np.round(mesh.centroid, 9)) - 0.4
    w = np.cos(3e4 * mesh.centroid[:, 0] - 2e4 * mesh.centroid[:, 1])
    y, back = smooth.forward(x), smooth.backward(w)
    sums = [mesh.area @ x, mesh.area @ y, w @ y, back @ x, np.abs(w) @ np.abs(y)]
    volume, filtered, left, right, size = COMM.allreduce(np.array(sums))
    assert filtered == pytest.approx(volume, rel=1e-11)
    assert abs(left - right) < 1e-12 * size


@pytest.mark.serial  # ranks: test_ranks_agree_on_any_mesh
@pytest.mark.parametrize("kind", KINDS)
def test_second_moments_are_those_of_the_cone(kind):
    """Spread of one cell's material: 2 r^2 = radius^2 / 6 along each axis, none across.

    The two-point flux alone gives 0.71 and 1.33 of it on right-angled triangles, at any
    refinement. Measured at r = 3.3 cells: 2e-4 on uniform meshes (the boundary), 2e-3 graded,
    random cells 4e-3; twice as coarse four times as much.
    """
    radius = radius_of(1.0 / 24.0)
    mesh = square(kind, 80)
    distance = np.hypot(*(mesh.centroid - 0.5).T)
    nearest = COMM.allreduce((distance.min(initial=9.0), COMM.rank), MPI.MINLOC)
    x, centre = np.zeros(mesh.num_cells), None
    if COMM.rank == nearest[1]:
        cell = int(np.argmin(distance))
        x[cell], centre = 1.0 / mesh.area[cell], mesh.centroid[cell]
    away = mesh.centroid - COMM.bcast(centre, root=nearest[1])
    y = HelmholtzFilter(mesh, radius).forward(x) * mesh.area
    moments = COMM.allreduce(np.einsum("n,ni,nj->ij", y, away, away)) / (radius**2 / 6.0)
    assert moments == pytest.approx(np.eye(2), abs=5e-3)


@pytest.mark.skipif(COMM.size == 1, reason="needs two ranks")
@pytest.mark.parametrize("kind", KINDS)
def test_ranks_agree_on_any_mesh(kind):
    def by_place(comm):
        mesh = square(kind, 12, comm)
        smooth = HelmholtzFilter(mesh, 0.2, open_edges=True)
        x = rough(np.round(mesh.centroid, 9))
        columns = [mesh.centroid, smooth.forward(x)[:, None], smooth.backward(x)[:, None]]
        rows = np.concatenate(comm.allgather(np.hstack(columns)))
        return rows[np.lexsort(np.round(rows[:, :2], 6).T)]

    assert np.allclose(by_place(COMM), by_place(MPI.COMM_SELF), atol=1e-9)


@pytest.mark.serial  # ranks: test_ranks_agree_on_any_mesh
@pytest.mark.parametrize("kind", KINDS)
def test_open_edges_are_those_of_a_void_around(kind):
    """Solid throughout, a side of length L: 1 - exp(-L / 2 r) cosh(s / r) in the middle of it."""
    r = 0.05
    mesh = square(kind, 48)
    y = HelmholtzFilter(mesh, radius_of(r), open_edges=True).forward(np.ones(mesh.num_cells))
    s = mesh.centroid[:, 1] - 0.5
    x = mesh.centroid[:, 0] - 0.5 - (0.5 * s if "sheared" in kind else 0.0)
    middle = (np.abs(x) < 0.1) & (np.abs(s) < 0.45)
    exact = 1.0 - np.exp(-0.5 / r) * np.cosh(s / r)
    error = np.abs(y - exact)[middle].max(initial=0.0)
    assert COMM.allreduce(error, MPI.MAX) < 4e-3


@pytest.mark.serial  # ranks: test_ranks_agree_on_any_mesh
def test_chain_through_what_is_clipped(shared_tmp_path):
    """Derivative of sum w x_phys^2 on skew triangles, of a crisp design and a narrow filter."""
    path = shared_tmp_path / "skew.geo"
    if COMM.rank == 0:
        path.write_text(SKEW)
    COMM.barrier()
    data = {
        "material": {"young_modulus": 7e10, "poisson_ratio": 0.3, "density": 2700.0},
        "arms": [{"name": "a", "length": 1.0, "height": 0.2, "thickness": 0.01, "mesh": str(path)}],
        "design": {"filter_radius": 0.02},
    }
    arm = Arm(do.scene_from_dict(STATED | data), 0, COMM, do.Profile())
    x = (np.sin(arm.mesh.centroid @ [25.0, 40.0]) > 0.0).astype(float)
    d = (1.0 - 2.0 * x) * (0.5 + rough(np.round(arm.mesh.centroid, 9)))  # into the bounds
    w = 1.0 + arm.mesh.centroid[:, 0]

    def value(h):
        return COMM.allreduce(w @ arm.physical(x + h * d) ** 2)

    here = arm.filtered(x)
    assert COMM.allreduce(int(here.clipped.sum())) > 10
    slope = COMM.allreduce(d @ arm.backward(2.0 * w * here.x_phys, here))
    remainders = [abs(value(h) - value(0.0) - h * slope) for h in (1e-3, 1e-4)]
    assert remainders[1] < 0.02 * remainders[0]  # of second order
    wrong = COMM.allreduce(d @ arm.backward(2.0 * w * here.x_phys))
    assert abs(wrong - slope) > 1e-3 * abs(slope)


SKEW = """Point(1) = {0, -0.1, 0}; Point(2) = {1, -0.1, 0}; Point(3) = {1, 0.1, 0};
Point(4) = {0, 0.1, 0}; Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
Transfinite Curve {1, 3} = 41; Transfinite Curve {2, 4} = 5; Transfinite Surface {1};
Physical Curve("inboard") = {4}; Physical Curve("outboard") = {2};
"""


@pytest.mark.serial
def test_a_filter_that_does_not_converge_is_told():
    """One line of this program's, no error of PETSc's."""
    options = PETSc.Options("dolfinopt_filter_")
    options["ksp_max_it"] = 1
    smooth = HelmholtzFilter(box_arm(MPI.COMM_SELF, "a", (1.0, 0.2, 0.2), (20, 4, 4)), 0.2)
    del options["ksp_max_it"]
    with pytest.raises(ConvergenceError, match=r"smaller design\.filter_radius"):
        smooth.forward(np.linspace(0.0, 1.0, 320))
