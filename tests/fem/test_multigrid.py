"""Conjugate gradients with multigrid for solid arms, beside the direct solution."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from solids import elastic_link, link_mesh, solid_arm, solid_scene

from dolfinopt.arms.arm import Arm, field_tolerance
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.fem import interior, multigrid
from dolfinopt.fem.assembly import InteriorEntries, InteriorMatrix
from dolfinopt.fem.interior import choose_solver
from dolfinopt.fem.multigrid import MultigridSolver
from dolfinopt.multibody.shape_integrals import TABLE
from dolfinopt.profiling import Profile
from dolfinopt.responses.sensitivity import exact_gradient

COMM = MPI.COMM_WORLD
CELLS = (20, 4, 3)


@pytest.fixture(scope="module")
def direct():
    arm = solid_arm(cells=CELLS, stiffening=True)
    assert not arm.substructure.interior.is_iterative  # decided now, whatever a test sets then
    return arm


@pytest.fixture
def iterative(monkeypatch):
    monkeypatch.setattr(interior, "WIDEST", 0)
    arm = solid_arm(cells=CELLS, stiffening=True)
    assert isinstance(arm.substructure.interior.solver, MultigridSolver)
    return arm


def hollow(arm, void):
    """Return a box beam with a soft core in which an island floats."""
    x, y, z = arm.mesh.centroid.T
    core = (np.abs(y) < 0.015) & (np.abs(z) < 0.005)
    island = core & (np.abs(x - 0.25) < 0.03)
    return np.where(arm.mesh.passive | island, 1.0, np.where(core, void, 1.0))


def difference(one, other):
    """Return the largest difference of an integral's entries, in its largest."""
    pairs = [[np.asarray(getattr(x, each.name)) for x in (one, other)] for each in TABLE]
    return max(
        float(np.abs(a - b).max(initial=0.0) / np.abs(a).max(initial=1e-300)) for a, b in pairs
    )


@pytest.mark.serial
@pytest.mark.parametrize("void", [0.1, 0.01, 1e-3])  # contrasts of 1e3, 1e6, 1e9 but for the floor
def test_as_the_direct_solution(direct, iterative, void):
    """Body and gradient to 50 times the tolerance of 1e-7; the geometric stiffness is the worst."""
    states = [arm.state(hollow(arm, void)) for arm in (direct, iterative)]
    assert difference(*(state.body for state in states)) < 5e-6
    by = states[0].body
    gradients = [exact_gradient(state, by) for state in states]
    largest = COMM.allreduce(np.abs(gradients[0]).max(initial=0.0), MPI.MAX)
    assert np.abs(gradients[0] - gradients[1]).max(initial=0.0) < 5e-6 * largest
    assert iterative.substructure.interior.solver.steps < 70


@pytest.mark.serial
def test_what_does_not_converge_is_told(iterative, monkeypatch):
    """With cures that help: a stiffer void, or a factor."""
    monkeypatch.setattr(multigrid, "SOLVER_ITERATIONS", 2)
    elastic = iterative.state(hollow(iterative, 0.1)).elastic
    with pytest.raises(ConvergenceError, match=r"interpolation\.floor.*pc_type cholesky"):
        _ = elastic.constraint_modes


@pytest.mark.serial
@pytest.mark.parametrize("cells", [(5, 3, 4), (9, 3, 2), (8, 2, 2)])
def test_grids_of_a_box(cells):
    """All levels are P' K P of the assembled matrix, odd counts, too; the cycle is symmetric."""
    scene = solid_scene(cells=cells)
    static = scene.objective.unchecked_copy({"kind": "static"})
    arm = Arm(scene.unchecked_copy({"objective": static}), 0, MPI.COMM_SELF, Profile())
    substructure, rng = arm.substructure, np.random.default_rng(2)
    young = 70e9 * 10.0 ** rng.uniform(-4.0, 0.0, arm.mesh.num_cells)
    elastic = substructure.at(young, young)
    for system, K in (
        (substructure.interior, elastic.K),
        (substructure.extended, substructure.extend(elastic.K)),
    ):
        solver = MultigridSolver(system.layout.box, system.layout.has_interfaces, 1e-8)
        solver.update(K)
        direct = interior.PetscSolver(system.layout)
        direct.update(K)
        indptr, columns, values = direct._matrix.mat.getValuesCSR()
        order = np.argsort(solver._place)  # the multigrid's rows
        A = sp.csr_matrix((values, columns, indptr)).toarray()[np.ix_(order, order)]
        grids = solver._grids
        assert grids.times(np.eye(len(A))) == pytest.approx(A, abs=1e-14 * np.abs(A).max())
        P = np.eye(len(A))
        for grid, (step, _) in zip(grids.levels[1:], grids.steps, strict=True):
            P = P @ step
            coarse = P.T @ A @ P
            found = grid.times(np.eye(len(coarse)))
            assert found == pytest.approx(coarse, abs=1e-14 * np.abs(coarse).max())
        V = grids.cycle(np.eye(len(A)))
        assert np.abs(V - V.T).max() < 1e-12 * np.abs(V).max()
        assert np.linalg.eigvalsh(0.5 * (V + V.T))[0] > 0.0


@pytest.mark.serial
@pytest.mark.parametrize(
    ("shape", "element"), [("hexahedron", "linear"), ("tetrahedron", "quadratic")]
)
def test_only_grids_are_boxes(shape, element):
    box = elastic_link(element, link_mesh(shape, (4, 3, 2))).substructure.interior.layout.box
    assert (box is None) == (shape == "tetrahedron")
    assert box is None or box.shape == (4, 2, 3)


@pytest.mark.serial
def test_tolerance_of_fields():
    """What an optimisation and a simulation leave: stricter ones ask for more, within bounds."""
    scene = solid_scene()
    assert field_tolerance(scene) == pytest.approx(1e-7)
    for table, keys, expected in (
        ("simulation", {"tolerance": 1e-6}, 1e-9),
        ("optimizer", {"tolerance": 1e-4}, 2e-8),
        ("optimizer", {"tolerance": 0.0}, 1e-10),
    ):
        changed = getattr(scene, table).unchecked_copy(keys)
        assert field_tolerance(scene.unchecked_copy({table: changed})) == pytest.approx(expected)


@pytest.mark.serial
@pytest.mark.parametrize(("method", "count"), [("craig-bampton", 9), ("modal", 3)])
def test_gradient_of_modes_without_a_factor(monkeypatch, method, count):
    """As the direct one, also at a second design, whose search begins with the first one's."""
    gradients, bodies = [], []
    for width in (10**9, 0):
        monkeypatch.setattr(interior, "WIDEST", width)
        arm = solid_arm(cells=(12, 4, 3), method=method, coordinates=count)
        assert arm.state(hollow(arm, 0.2)).body.M.any()
        state = arm.state(hollow(arm, 0.1))
        bodies.append(state.body)
        gradients.append(exact_gradient(state, bodies[0]))
    assert difference(*bodies) < 1e-6
    assert np.abs(gradients[1] - gradients[0]).max() < 2e-6 * np.abs(gradients[0]).max()


@pytest.mark.serial
def test_which_solver(monkeypatch):
    """By shape and size alone; what needs more memory than is free is refused with the estimate."""
    layout = solid_arm(cells=(10, 3, 2)).substructure.interior.layout
    assert layout.bandwidth == 3 * (4 * 3 + 4 + 1 + 1) - 1
    monkeypatch.setattr(interior, "free_memory", lambda: 0.0)
    for changes, name in (
        ({}, "LAPACK's band"),
        ({"bandwidth": interior.WIDEST + 1}, "conjugate gradients"),
        ({"bandwidth": interior.WIDEST_OF_STATICS + 1, "has_interfaces": True},
         "conjugate gradients"),
    ):  # fmt: skip
        assert choose_solver(replace(layout, **changes), 1e-8).name == name
    wide = replace(layout, band_work_limit=0.0, num_rows=10**6)
    with pytest.raises(InputError, match=r"1000000 unknowns takes about 20 GB"):
        choose_solver(wide, 1e-8)
    monkeypatch.setattr(interior, "free_memory", lambda: 1e11)
    assert choose_solver(wide, 1e-8).name == "mumps"


@pytest.mark.skipif(COMM.size == 1, reason="needs two ranks")
def test_shared_rows():
    """What a rank has of another's rows is added there, at row numbers beyond a 32-bit product."""
    owned, rank, size = 60_000, COMM.rank, COMM.size
    mine, other = owned * rank + 7, owned * ((rank + 1) % size) + 7
    rows = np.array([mine, mine, other], dtype=PETSc.IntType)
    columns = np.array([mine, mine + 1, other + 1], dtype=PETSc.IntType)
    order = np.lexsort((columns, rows))
    entries = InteriorEntries(rows[order], columns[order], np.arange(3)[order])
    matrix = InteriorMatrix(COMM, entries, owned)
    for factor in (1.0, 2.0):
        matrix.update(factor * np.array([1.0, 10.0, 100.0]))
        values = matrix.mat.getValues([mine], [mine, mine + 1, mine + 2])
        assert np.allclose(values, [[factor, 110.0 * factor, 0.0]])


@pytest.mark.skipif(COMM.size == 1, reason="needs two ranks")
def test_ranks_agree(monkeypatch):
    """The same body on any number of ranks, as the tolerance allows."""
    monkeypatch.setattr(interior, "WIDEST", 0)
    arms = [solid_arm(comm, cells=(10, 3, 2)) for comm in (MPI.COMM_SELF, COMM)]
    assert difference(*(arm.state(hollow(arm, 0.01)).body for arm in arms)) < 2e-6
