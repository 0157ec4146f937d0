"""Reduced bases against dense eigenproblems, full solves and beam theory."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI
from scipy.optimize import brentq

from dolfinopt.body import floating_body
from dolfinopt.elasticity import ElasticArm, element_operators
from dolfinopt.errors import ConvergenceError
from dolfinopt.ledger import Ledger
from dolfinopt.mesh import structured_arm
from dolfinopt.reduction import Basis, craig_bampton, modal
from dolfinopt.reduction.basis import lowest_eigenpairs

COMM, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
LENGTH, HEIGHT, THICKNESS = 1.0, 0.06, 0.01  # m
YOUNG, POISSON, DENSITY = 70e9, 0.33, 2700.0  # Pa, -, kg/m3
REDUCTORS = {"craig-bampton": craig_bampton, "modal": modal}
# Dense matrices carry the rounding of K, relative to its largest entry, into their smallest
# eigenvalues: 1e-16 (length / cell)^4 and more. Measured: up to 6e-9.
DENSE = 1e-7


def make_arm(cells=(20, 4), comm=SELF, length=LENGTH):
    mesh = structured_arm(comm, "arm", length, HEIGHT, cells)
    return ElasticArm(mesh, element_operators(mesh, THICKNESS, POISSON), Ledger())


def set_densities(arm, x):
    """Interpolate as in the scenes; x (n_cells,)."""
    arm.set_design(YOUNG * (1e-6 + x**3), DENSITY * (1e-6 + x))


def uniform(place):
    return np.full(len(place), 0.5)


def graded(place):
    """Without any symmetry."""
    return 0.5 + 0.45 * np.sin(7.0 * place[:, 0] + 40.0 * place[:, 1])


def hollow(place):
    """A sandwich: near-void core, symmetric about the axis."""
    return np.where(np.abs(place[:, 1]) < 0.25 * HEIGHT, 1e-3, 1.0)


DESIGNS = [uniform, graded, hollow]


def dense(arm):
    """Return T'KT and T'MT (n, n) of an arm on one rank, outboard coordinates last."""
    unit = np.eye(arm.num_dofs)
    T = arm.expand(unit[:-3], unit[-3:])
    return np.vstack(arm.restrict(arm.stiffness_times(T))), np.vstack(
        arm.restrict(arm.mass_times(T))
    )


def products(arm, basis):
    """Return V'KV and V'MV (q, q)."""
    K = arm.comm.allreduce(np.einsum("nik,nil->kl", basis.V, arm.stiffness_times(basis.V)))
    return K, arm.comm.allreduce(np.einsum("nik,nil->kl", basis.V, basis.MV))


def tip_compliance(basis):
    """Return the compliance (3, 3) of the outboard coordinates."""
    return basis.outboard @ np.linalg.solve(basis.stiffness, basis.outboard.T)


def by_place(arm, field):
    """Return the nodal rows (n, ...) of all ranks, each node once, ordered by place."""
    owned = arm.operators.space.dofmap.index_map.size_local
    place = np.concatenate(arm.comm.allgather(arm.points[:owned]))
    rows = np.concatenate(arm.comm.allgather(field[:owned]))
    return rows[np.lexsort(np.round(place, 6).T)]


@pytest.fixture(scope="module")
def shared_arm():
    """Return an arm that all ranks share."""
    return make_arm(comm=COMM)


@pytest.fixture(scope="module")
def own_arm():
    """Return an arm of this rank's own."""
    return make_arm()


# -- against dense algebra ------------------------------------------------------------------------


@pytest.mark.parametrize("design", DESIGNS)
def test_constraint_modes_are_statically_exact(shared_arm, own_arm, design):
    for arm in (shared_arm, own_arm):
        set_densities(arm, design(arm.mesh.centroid))
    K, _ = dense(own_arm)
    exact = np.linalg.inv(K)[-3:, -3:]
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))  # units of m, m, rad
    for q in (3, 5):
        found = tip_compliance(craig_bampton(shared_arm, q))
        assert np.abs((found - exact) / scale).max() < DENSE
    # Truncated modes are too stiff, the more so the fewer.
    few, more = (tip_compliance(modal(shared_arm, q)) for q in (4, 8))
    for less, full in ((few, more), (more, exact)):
        missing = (full - less) / scale
        assert np.linalg.eigvalsh(missing).min() > -DENSE
        assert np.trace(missing) > 1e-3


@pytest.mark.parametrize("design", DESIGNS)
def test_craig_bampton_modes(shared_arm, own_arm, design):
    for arm in (shared_arm, own_arm):
        set_densities(arm, design(arm.mesh.centroid))
    q = 9
    basis = craig_bampton(shared_arm, q)
    K, M = products(shared_arm, basis)
    assert np.array_equal(basis.outboard, np.eye(3, q))
    # Normal modes are orthonormal in M, orthogonal in K to one another and to the constraint
    # modes. Measured: M 1e-14, K 5e-11 (products with K cancel).
    assert np.abs(M[3:, 3:] - np.eye(q - 3)).max() < 1e-11
    size = np.sqrt(np.diag(basis.stiffness))
    assert np.abs((K - basis.stiffness) / np.outer(size, size)).max() < 1e-8
    dense_K, dense_M = dense(own_arm)
    values = scipy.linalg.eigvalsh(dense_K[:-3, :-3], dense_M[:-3, :-3])[: q - 3]
    assert np.diag(basis.stiffness)[3:] == pytest.approx(values, rel=DENSE)


@pytest.mark.parametrize("design", DESIGNS)
def test_modal_modes(shared_arm, own_arm, design):
    for arm in (shared_arm, own_arm):
        set_densities(arm, design(arm.mesh.centroid))
    q = 6
    basis = modal(shared_arm, q)
    K, M = products(shared_arm, basis)
    # Measured: M 3e-13, K 7e-11.
    assert np.abs(M - np.eye(q)).max() < 1e-11
    size = np.sqrt(np.diag(basis.stiffness))
    assert np.abs((K - basis.stiffness) / np.outer(size, size)).max() < 1e-8
    values = scipy.linalg.eigvalsh(*dense(own_arm))[:q]
    assert np.diag(basis.stiffness) == pytest.approx(values, rel=DENSE)
    assert np.array_equal(basis.stiffness, np.diag(np.diag(basis.stiffness)))


@pytest.mark.parametrize("method", sorted(REDUCTORS))
def test_modes_keep_the_interfaces(shared_arm, method):
    arm = shared_arm
    set_densities(arm, graded(arm.mesh.centroid))
    basis = REDUCTORS[method](arm, 7)
    assert basis.V.shape == basis.MV.shape == (len(arm.points), 2, 7)
    assert basis.start.shape[0] in (arm.num_interior, arm.num_interior + 3)
    assert not basis.V[arm.inboard].any()
    outboard = arm.rigid[arm.outboard] @ basis.outboard
    assert np.array_equal(basis.V[arm.outboard], outboard)
    assert np.array_equal(basis.MV, arm.mass_times(basis.V))


@pytest.mark.parametrize("method", sorted(REDUCTORS))
def test_a_hundred_coordinates(method):
    """All of the first 100 modes, none twice, none missed, on any number of ranks."""
    arm, own = make_arm((48, 6), COMM), make_arm((48, 6))
    for one in (arm, own):
        set_densities(one, graded(one.mesh.centroid))
    basis = REDUCTORS[method](arm, 100)
    first = 3 if method == "craig-bampton" else 0
    K, M = dense(own)
    free = slice(None) if first == 0 else slice(-3)
    values = scipy.linalg.eigvalsh(K[free, free], M[free, free])[: 100 - first]
    assert np.diag(basis.stiffness)[first:] == pytest.approx(values, rel=DENSE)
    mass = products(arm, basis)[1][first:, first:]
    # Measured: 2e-11 modal, 4e-13 Craig-Bampton.
    assert np.abs(mass - np.eye(100 - first)).max() < 1e-8
    for array in dataclasses.astuple(floating_body(arm, basis, 0.0)):
        assert np.isfinite(array).all()


@pytest.mark.parametrize("method", sorted(REDUCTORS))
def test_every_degree_of_freedom(method):
    """As many coordinates as the arm has: the reduced model is the full one."""
    arm = make_arm((3, 1), COMM)
    own = make_arm((3, 1))
    for one in (arm, own):
        set_densities(one, graded(one.mesh.centroid))
    body = floating_body(arm, REDUCTORS[method](arm, arm.num_dofs), 0.0)
    reduced = scipy.linalg.eigvalsh(body.K, body.M)
    assert arm.num_dofs == 11
    assert reduced == pytest.approx(scipy.linalg.eigvalsh(*dense(own)), rel=DENSE)


def test_too_many_modes_are_an_error_that_says_so():
    arm = make_arm((2, 1))
    set_densities(arm, uniform(arm.mesh.centroid))
    K, M = arm.interior_stiffness(), arm.interior_mass()
    with pytest.raises(ConvergenceError, match=r"arm 'arm': only \d+ of 5.*reduction\.coordinates"):
        lowest_eigenpairs(arm, K, M, arm.solve_vector, 5, None)


# -- what it costs --------------------------------------------------------------------------------


def test_counts():
    arm = make_arm(comm=COMM)
    counts = arm.ledger.counts
    set_densities(arm, graded(arm.mesh.centroid))

    def tally():
        return counts.assemblies, counts.factorisations, counts.eigenproblems

    craig_bampton(arm, 3)
    assert tally() == (2, 1, 0)  # three coordinates need no eigenproblem
    assert counts.solves == 3
    craig_bampton(arm, 4)
    assert tally() == (2, 1, 1)
    modal(arm, 4)
    assert tally() == (2, 1, 2)
    set_densities(arm, uniform(arm.mesh.centroid))
    modal(arm, 1)
    assert tally() == (4, 2, 3)


# -- the search's start ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "q"), [("craig-bampton", 4), ("craig-bampton", 8), ("modal", 4)]
)
def test_a_warm_start_finds_the_same_modes_with_less_work(shared_arm, method, q):
    arm = shared_arm
    counts = arm.ledger.counts
    x = graded(arm.mesh.centroid)
    set_densities(arm, 0.97 * x)
    before = REDUCTORS[method](arm, q)
    set_densities(arm, x)
    begin = counts.solves
    cold = REDUCTORS[method](arm, q)
    middle = counts.solves
    warm = REDUCTORS[method](arm, q, before.start)
    assert counts.solves - middle <= middle - begin
    # Residuals are 1e-12, vectors right to that over the eigenvalues' relative gaps.
    size = np.abs(cold.V).max(axis=(0, 1), initial=1e-30)
    assert np.abs((warm.V - cold.V) / size).max(initial=0.0) < 1e-9
    assert np.diag(warm.stiffness) == pytest.approx(np.diag(cold.stiffness), rel=1e-11)


@pytest.mark.parametrize("method", sorted(REDUCTORS))
def test_the_start_decides_nothing(shared_arm, method):
    """From any one mode, or with signs reversed, the search ends with the same basis."""
    arm = shared_arm
    set_densities(arm, hollow(arm.mesh.centroid))
    q = 9
    cold = REDUCTORS[method](arm, q)
    size = np.abs(cold.V).max(axis=(0, 1), initial=1e-30)
    last = cold.start.shape[1] - 1
    for start in (-cold.start, cold.start[:, :1], cold.start[:, last:], cold.start[:, :0]):
        again = REDUCTORS[method](arm, q, start)
        assert np.abs((again.V - cold.V) / size).max(initial=0.0) < 1e-8


def test_a_mode_of_another_symmetry_becomes_the_lowest():
    """Beams keep their symmetry about the axis: bending and stretching modes do not mix.

    As the core of a stubby arm is emptied, stretching falls below bending. A search that starts
    from the bending mode alone never leaves bending.
    """
    arm = make_arm((16, 12), length=0.1)
    start = None
    kinds = set()
    for core in (1.0, 0.5, 0.2, 0.1):
        x = np.where(np.abs(arm.mesh.centroid[:, 1]) < HEIGHT / 3.0, core, 1.0)
        set_densities(arm, x)
        basis = craig_bampton(arm, 4, start)
        start = basis.start
        K, M = dense(arm)
        lowest = scipy.linalg.eigvalsh(K[:-3, :-3], M[:-3, :-3])[0]
        assert basis.stiffness[3, 3] == pytest.approx(lowest, rel=DENSE)
        along, across = np.abs(basis.MV[:, :, 3].sum(axis=0))
        kinds.add("stretching" if along > across else "bending")
    assert kinds == {"stretching", "bending"}  # the crossing took place


def test_modes_point_the_same_way_on_any_mesh():
    seen = {method: [] for method in REDUCTORS}
    for cells in ((20, 2), (40, 4), (60, 6)):
        arm = make_arm(cells, COMM)
        set_densities(arm, uniform(arm.mesh.centroid))
        owned = arm.operators.space.dofmap.index_map.size_local
        # No mode counted here rests at a quarter of the length.
        place = np.abs(arm.points[:owned] - [0.25 * LENGTH, 0.5 * HEIGHT]).max(axis=1) < 1e-6
        for method, values in seen.items():
            # Fixed at both ends, the fourth bending mode and stretching are too close to count.
            basis = REDUCTORS[method](arm, 6)
            values.append(COMM.allreduce(basis.V[:owned][place].sum(axis=0)))
    for values in seen.values():
        larger = np.argmax(np.abs(values[0]), axis=0)
        ways = [np.sign(value[larger, np.arange(6)]) for value in values]
        assert np.array_equal(ways[0], ways[1]) and np.array_equal(ways[0], ways[2])
        assert ways[0].all()


# -- ranks ----------------------------------------------------------------------------------------


@pytest.mark.skipif(COMM.size == 1, reason="needs two ranks")
@pytest.mark.parametrize(
    ("method", "q"), [("craig-bampton", 3), ("craig-bampton", 8), ("modal", 6)]
)
def test_ranks_agree_with_one_rank(shared_arm, own_arm, method, q):
    for arm in (shared_arm, own_arm):
        set_densities(arm, graded(arm.mesh.centroid))
    together, alone = (REDUCTORS[method](arm, q) for arm in (shared_arm, own_arm))
    pairs = [
        (together.stiffness, alone.stiffness),
        (together.outboard, alone.outboard),
        (by_place(shared_arm, together.V), by_place(own_arm, alone.V)),
    ]
    bodies = [
        dataclasses.astuple(floating_body(arm, basis, 2e-4))
        for arm, basis in ((shared_arm, together), (own_arm, alone))
    ]
    pairs += list(zip(*bodies))
    for ours, reference in pairs:
        scale = np.abs(reference).max()
        assert np.abs(np.asarray(ours) - reference).max() <= 1e-9 * scale


# -- against beam theory --------------------------------------------------------------------------

SHEAR = YOUNG / (2.0 * (1.0 + POISSON))  # Pa
AREA, INERTIA = HEIGHT * THICKNESS, THICKNESS * HEIGHT**3 / 12.0  # m2, m4
SHEAR_FACTOR = 5.0 / 6.0  # exact for the energy of parabolic shear over a rectangle
REFINEMENT = [(50, 3), (100, 6), (200, 12), (400, 24)]


@pytest.fixture(scope="module")
def beams():
    """Return tip compliances and frequencies (modal, Craig-Bampton), Hz, of ever finer arms."""
    compliance, modes, reduced = [], [], []
    for cells in REFINEMENT:
        arm = make_arm(cells)
        arm.set_design(np.full(arm.mesh.num_cells, YOUNG), np.full(arm.mesh.num_cells, DENSITY))
        C = tip_compliance(craig_bampton(arm, 3))
        compliance.append([C[0, 0], C[1, 1], C[2, 2], C[1, 2]])
        modes.append(_frequencies(arm, modal(arm, 5)))
        reduced.append(_frequencies(arm, craig_bampton(arm, 12)))
    return np.array(compliance), np.array(modes), np.array(reduced)


def _frequencies(arm: ElasticArm, basis: Basis) -> np.ndarray:
    body = floating_body(arm, basis, 0.0)
    return np.sqrt(scipy.linalg.eigvalsh(body.K, body.M)[:5]) / (2.0 * np.pi)


def rates_and_limit(values):
    """Return the orders seen in three successive differences, and Richardson's limit.

    For values v + c h^p the differences fall by 2^p with each halving.
    """
    steps = np.diff(values, axis=0)
    rates = np.log2(steps[:-1] / steps[1:])
    return rates, values[-1] + steps[-1] / (2.0 ** rates[-1] - 1.0)


def test_tip_compliance_converges_to_timoshenko(beams):
    """Clamped bar with a rigid end face under forces and moment there."""
    theory = np.array(
        [
            LENGTH / (YOUNG * AREA),
            LENGTH**3 / (3.0 * YOUNG * INERTIA) + LENGTH / (SHEAR_FACTOR * SHEAR * AREA),
            LENGTH / (YOUNG * INERTIA),
            LENGTH**2 / (2.0 * YOUNG * INERTIA),
        ]
    )
    compliance = beams[0]
    assert (np.diff(compliance, axis=0) > 0.0).all()  # displacement elements are too stiff
    # Bending: 5.5 %, 1.5 %, 0.5 %, 0.2 % below theory.
    rates, limit = rates_and_limit(compliance[:, 1:])
    # Measured: 1.90, 1.95. Stress singularities in the clamped corners, of order 1.5, are weak.
    assert (rates > 1.85).all() and (rates < 2.05).all()
    # Both end faces keep their height, which Poisson's contraction would change: about a height's
    # length of each end is stiffer, by up to nu^2, and nu^2 h / L = 0.65 %. Measured: bending
    # 0.12, 0.08, 0.08 %, stretching 0.18 %.
    ends = POISSON**2 * HEIGHT / LENGTH
    assert np.abs(limit / theory[1:] - 1.0).max() < 0.25 * ends
    assert abs(compliance[-1, 0] / theory[0] - 1.0) < 0.4 * ends


def timoshenko_frequencies(count):
    """Return the first bending frequencies, Hz, of a clamped-free Timoshenko beam.

    Transfer matrix of (w, psi, moment, shear force); at the free end the last two vanish.
    """

    def end(w):
        mass, rotary = DENSITY * AREA * w**2, DENSITY * INERTIA * w**2
        system = np.zeros((4, 4))
        system[0, 1], system[0, 3] = 1.0, 1.0 / (SHEAR_FACTOR * SHEAR * AREA)
        system[1, 2] = 1.0 / (YOUNG * INERTIA)
        system[2, 1], system[2, 3] = -rotary, -1.0
        system[3, 0] = -mass
        return np.linalg.det(scipy.linalg.expm(system * LENGTH)[2:, 2:])

    grid = np.linspace(10.0, 1.2e4, 1200)  # rad/s
    values = np.array([end(w) for w in grid])
    change = np.flatnonzero(values[:-1] * values[1:] < 0.0)[:count]
    return np.array([brentq(end, grid[i], grid[i + 1]) for i in change]) / (2.0 * np.pi)


def test_frequencies_converge_to_timoshenko(beams):
    """Clamped-free: the rigid end face without mass hardly differs from a free one."""
    _, modes, reduced = beams
    bending = timoshenko_frequencies(4)
    # The theory itself, slender limit: 1.8751^2 sqrt(EI / rho A) / L^2, less shear and rotation.
    slender = 1.8751040687119611**2 * np.sqrt(YOUNG * INERTIA / (DENSITY * AREA)) / (2.0 * np.pi)
    assert 0.996 * slender < bending[0] < slender
    first = [0, 1, 2, 4]  # the fourth mode is the first of stretching
    rates, limit = rates_and_limit(modes[:, first])
    # Measured: 1.94 to 1.96.
    assert (rates > 1.9).all() and (rates < 2.05).all()
    # Measured: 0.08, 0.12, 0.19, 0.28 % above, by the same stiffer ends.
    assert (np.abs(limit / bending - 1.0) < [1.5e-3, 2e-3, 3e-3, 4e-3]).all()
    stretching = 0.25 / LENGTH * np.sqrt(YOUNG / DENSITY)
    assert modes[-1, 3] == pytest.approx(stretching, rel=1.5e-3)  # measured: 0.086 %
    # Craig-Bampton bounds the same frequencies from above: 1.4e-6, 4e-5, 3e-4, 1e-3, 8e-4.
    excess = reduced / modes - 1.0
    assert (excess > -1e-10).all()
    assert (excess < [1e-5, 1e-4, 1e-3, 2e-3, 2e-3]).all()
