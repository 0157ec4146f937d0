"""Reduced bases against dense eigenproblems and full solves."""

import dataclasses
import gc
import itertools
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from mpi4py import MPI
from petsc4py import PETSc
from remainders import substructure

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.fem.geometric_stiffness import unit_loads
from dolfinopt.multibody.shape_integrals import shape_integrals
from dolfinopt.reduction import Options, balanced, craig_bampton, krylov, modal
from dolfinopt.reduction.basis import ritz
from dolfinopt.reduction.eigenproblem import (
    Pencil,
    _passes_over,
    complement_solve,
    largest_eigenpairs,
    lowest_eigenpairs,
)

COMM, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
LENGTH, HEIGHT, THICKNESS = 1.0, 0.06, 0.01  # m
YOUNG, POISSON, DENSITY = 70e9, 0.33, 2700.0  # Pa, -, kg/m3
REDUCTORS = {"craig-bampton": craig_bampton, "modal": modal}  # by eigenproblems
SUBSPACES = {"krylov": krylov, "balanced": balanced}
ALL = REDUCTORS | SUBSPACES
# Dense matrices carry the rounding of K, relative to its largest entry, into their smallest
# eigenvalues: 1e-16 (length / cell)^4 and more. Measured: up to 6e-9.
DENSE = 1e-7


def make_arm(cells=(20, 4), comm=SELF, length=LENGTH):
    return substructure((length, HEIGHT, THICKNESS), cells, comm)


def with_densities(arm, design):
    """Return the arm with densities x (n_cells,), or a design of places, as the scenes have it."""
    x = design(arm.mesh.centroid) if callable(design) else design
    substructure = getattr(arm, "substructure", arm)
    return substructure.at(YOUNG * (1e-6 + x**3), DENSITY * (1e-6 + x))


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
    return [np.vstack(arm.restrict(times(T))) for times in (arm.stiffness_times, arm.mass_times)]


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


@pytest.fixture(scope="module")
def at(shared_arm, own_arm):
    """Return both with the densities of a design."""
    return lambda design: [with_densities(one, design) for one in (shared_arm, own_arm)]


@pytest.mark.serial
@pytest.mark.parametrize("design", DESIGNS)
def test_statics(at, design):
    """Exact by constraint modes and Krylov vectors; truncated modes are too stiff."""
    shared, own = at(design)
    exact = np.linalg.inv(dense(own)[0])[-3:, -3:]
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))  # units of m, m, rad
    for reduce in (craig_bampton, krylov):
        for q in (3, 5, 7):
            found = tip_compliance(reduce(shared, Options(q)))
            assert np.abs((found - exact) / scale).max() < DENSE
    few, more = (tip_compliance(modal(shared, Options(q))) for q in (4, 8))
    for less, full in ((few, more), (more, exact)):
        missing = (full - less) / scale
        assert np.linalg.eigvalsh(missing).min() > -DENSE
        assert np.trace(missing) > 1e-3


def assert_modes(arm, own, method, q):
    """Assert that a basis is orthonormal, its stiffness right, and its eigenvalues the dense."""
    basis = ALL[method](arm, Options(q))
    first = 3 if method == "craig-bampton" else 0
    K, M = products(arm, basis)
    # Measured: M 2e-11 of a hundred modes, 3e-13 of few; K 7e-11 (products with K cancel).
    assert np.abs(M[first:, first:] - np.eye(q - first)).max() < (1e-8 if q == 100 else 1e-11)
    size = np.sqrt(np.diag(basis.stiffness))
    assert np.abs((K - basis.stiffness) / np.outer(size, size)).max() < 1e-8
    values = np.diag(basis.stiffness)[first:]
    assert (np.diff(values) > 0.0).all()
    assert np.array_equal(basis.stiffness[first:, first:], np.diag(values))
    if method == "craig-bampton":
        assert np.array_equal(basis.outboard, np.eye(3, q))
    if method in REDUCTORS:
        free = slice(-3) if first else slice(None)
        expected = scipy.linalg.eigvalsh(*(A[free, free] for A in dense(own)))
        assert values == pytest.approx(expected[: q - first], rel=DENSE)
    return basis


@pytest.mark.parametrize("design", DESIGNS)
@pytest.mark.parametrize(
    ("method", "q"),
    [
        ("craig-bampton", 9), ("modal", 6),
        *(pytest.param(method, q, marks=pytest.mark.serial)
          for method in ("krylov", "balanced") for q in (3, 4, 8, 12)),
    ],
)  # fmt: skip
def test_modes(at, method, q, design):
    assert_modes(*at(design), method, q)


@pytest.mark.serial
@pytest.mark.parametrize("method", sorted(REDUCTORS))
def test_a_hundred_coordinates(method):
    """All of the first 100 modes, none twice, none missed, on any number of ranks."""
    arm, own = (with_densities(make_arm((48, 6), comm), graded) for comm in (COMM, SELF))
    basis = assert_modes(arm, own, method, 100)
    for array in dataclasses.astuple(shape_integrals(arm, basis, 0.0)):
        assert np.isfinite(array).all()


@pytest.mark.parametrize("method", sorted(ALL))
def test_modes_keep_the_interfaces(shared_arm, method):
    arm = with_densities(shared_arm, graded)
    basis = ALL[method](arm, Options(7))
    assert basis.V.shape == basis.MV.shape == (len(arm.points), 2, 7)
    assert basis.start.shape[0] in (arm.num_interior, arm.num_interior + 3)
    assert basis.start.shape[1] == (0 if method in SUBSPACES else 7 - 3 * (method != "modal"))
    assert not basis.V[arm.inboard].any()
    outboard = arm.rigid[arm.outboard] @ basis.outboard
    assert np.array_equal(basis.V[arm.outboard], outboard)
    assert np.array_equal(basis.MV, arm.mass_times(basis.V))


def test_too_many_modes_are_an_error_that_says_so():
    with pytest.raises(ConvergenceError, match=r"arm 'arm': only \d+ of 5.*reduction\.coordinates"):
        lowest_eigenpairs(Pencil(with_densities(make_arm((2, 1)), uniform)), 5, None)


def test_interrupt_waits_for_an_eigenproblem():
    """Ended within its second product, SLEPc could not be destroyed any more."""
    calls = itertools.cycle([int, signal.raise_signal])
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt):
        pencil = Pencil(with_densities(make_arm(comm=SELF), uniform))
        largest_eigenpairs(pencil, lambda rows: (rows, next(calls)(2))[0], 1, 1e-4)
    PETSc.garbage_cleanup(SELF)


@pytest.mark.parametrize(
    ("method", "q"), [("craig-bampton", 4), ("craig-bampton", 8), ("modal", 4)]
)
def test_a_warm_start_finds_the_same_modes_with_less_work(shared_arm, method, q):
    counts, x = shared_arm.profile.counts, graded(shared_arm.mesh.centroid)
    before = REDUCTORS[method](with_densities(shared_arm, 0.97 * x), Options(q))
    arm = with_densities(shared_arm, x)
    begin = counts.solves
    cold = REDUCTORS[method](arm, Options(q))
    middle = counts.solves
    warm = REDUCTORS[method](arm, Options(q), before.start)
    assert counts.solves - middle <= middle - begin
    # Residuals are 1e-12, vectors right to that over the eigenvalues' relative gaps.
    size = np.abs(cold.V).max(axis=(0, 1), initial=1e-30)
    assert np.abs((warm.V - cold.V) / size).max(initial=0.0) < 1e-9
    assert np.diag(warm.stiffness) == pytest.approx(np.diag(cold.stiffness), rel=1e-11)


@pytest.mark.serial
@pytest.mark.parametrize("method", ["craig-bampton", "modal"])
def test_designs_are_forgotten(own_arm, method):
    """What a search gives to SLEPc keeps no design alive: each holds megabytes."""

    def alive():
        gc.collect()
        # Not `isinstance`, which asks what a weak proxy of another test no longer points to.
        return sum(issubclass(type(one), ElasticArm) for one in gc.get_objects())

    x, start, left = graded(own_arm.mesh.centroid), None, []
    for share in (1.0, 0.97, 0.94, 0.91):
        basis = REDUCTORS[method](with_densities(own_arm, share * x), Options(4), start)
        start = basis.start
        del basis
        left.append(alive())
    assert left[0] == left[-1]


def test_a_mode_of_another_symmetry_becomes_the_lowest():
    """Stretching falls below bending as a stubby arm is emptied; bending alone leads to bending."""
    arm, start, kinds = make_arm((16, 12), length=0.1), None, set()
    for core in (1.0, 0.5, 0.2, 0.1):
        x = np.where(np.abs(arm.mesh.centroid[:, 1]) < HEIGHT / 3.0, core, 1.0)
        arm = with_densities(arm, x)
        basis = craig_bampton(arm, Options(4), start)
        start = basis.start
        K, M = dense(arm)
        lowest = scipy.linalg.eigvalsh(K[:-3, :-3], M[:-3, :-3])[0]
        assert basis.stiffness[3, 3] == pytest.approx(lowest, rel=DENSE)
        along, across = np.abs(basis.MV[:, :, 3].sum(axis=0))
        kinds.add("stretching" if along > across else "bending")
    assert kinds == {"stretching", "bending"}  # the crossing took place


def inputs(arm):
    """Return unit loads of the interface and inertia loads of unit accelerations, dense (n, 6)."""
    X = arm.points
    zero, one = np.zeros(len(X)), np.ones(len(X))
    fields = np.stack([[zero, one], [-X[:, 1], X[:, 0]], [one, zero]]).transpose(2, 1, 0)
    loads = np.vstack(arm.restrict(arm.mass_times(np.ascontiguousarray(fields))))
    return np.hstack([np.eye(arm.num_dofs)[:, -3:], loads])


def rows(arm, basis):
    """Return the columns of a basis in the coordinates of `dense` (n, q)."""
    interior = basis.V[arm.interior_nodes].reshape(arm.num_interior, -1)
    return np.vstack([interior, basis.outboard])


@pytest.fixture(scope="module")
def stubby_arm():
    """Return an arm of this rank's own whose dense matrices carry 1e-12 and better."""
    return make_arm((10, 6), length=0.1)


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("design", [uniform, graded])
@pytest.mark.parametrize("blocks", [1, 3])
@pytest.mark.parametrize("places", [(0,), (1,), (0, 2)], ids=str)
def test_moments_match_at_the_shifts(stubby_arm, design, blocks, places):
    """k complete blocks: B' (K - s M)^-1 B and its reduced twin differ by O((s - w^2)^(2 k))."""
    arm = with_densities(stubby_arm, design)
    (K, M), B = dense(arm), inputs(arm)
    values = scipy.linalg.eigvalsh(K, M)
    # Half way from the n-th natural frequency to the next, where K - w^2 M is indefinite.
    centres = [0.5 * (values[n - 1] + values[n]) if n else 0.0 for n in places]
    shifts = tuple(float(np.sqrt(s) / (2.0 * np.pi)) for s in centres)
    basis = krylov(arm, Options(6 * blocks * len(shifts), shifts))
    B_r = rows(arm, basis).T @ B
    size = np.sqrt(np.diag(B.T @ np.linalg.solve(K, B)))  # inputs of different units

    def difference(s):
        full = B.T @ np.linalg.solve(K - s * M, B)
        reduced = B_r.T @ (B_r / (np.diag(basis.stiffness) - s)[:, None])
        return np.abs((full - reduced) / np.outer(size, size)).max()

    for s in centres:
        assert difference(s) < 1e-11  # measured: up to 3.5e-13
        if len(places) == 1 or blocks == 1:  # elsewhere differences are rounding
            # Far enough to be above it, near enough for the leading term.
            step = values[0] * {1: 1 / 32, 2: 1 / 2, 3: 4.0}[blocks]
            near, far = difference(s - step), difference(s - 2.0 * step)
            if s == 0.0 or blocks < 3:  # but for a pole nearby
                # Measured: 1.92 to 2.08, 3.6 to 3.9, 5.1 to 5.3.
                assert abs(np.log2(far / near) - 2 * blocks) < 0.5 * blocks


def dense_gramian(arm, options):
    """Return P by Gauss-Legendre quadrature of full responses, inputs in the arm's units."""
    (K, M), B = dense(arm), inputs(arm)
    mass = arm.mass_times(np.ones((len(arm.points), 2, 1)))[:, 0].sum()
    length = arm.mesh.outboard_point[0]
    units = np.array([mass, mass, mass * length, 1.0, 1.0 / length, 1.0])
    low, high = 2.0 * np.pi * np.array(options.band)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    P = np.zeros_like(K)
    for node, weight in zip(nodes, weights):
        w = 0.5 * (low + high) + 0.5 * (high - low) * node
        H = np.linalg.solve((1.0 + 1j * w * options.damping) * K - w**2 * M, B * units)
        P += 0.5 * (high - low) * weight / np.pi * (H @ H.conj().T).real
    return K, P


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("design", DESIGNS)
@pytest.mark.parametrize("band", [(0.0, 1000.0), (1000.0, 4000.0)])
def test_balanced_is_the_dense_gramians_dominant_space(stubby_arm, design, band):
    arm = with_densities(stubby_arm, design)
    options = Options(6, band=band, damping=1e-5)  # resonances wide enough for one Gauss rule
    K, P = dense_gramian(arm, options)
    lower = np.linalg.cholesky(K)
    P = lower.T @ P @ lower
    values, vectors = np.linalg.eigh(P)
    # Both spans in energy.
    ours = np.linalg.qr(lower.T @ rows(arm, balanced(arm, options)))[0]
    sine = np.sin(scipy.linalg.subspace_angles(vectors[:, -6:], ours)[0])
    gap = (values[-6] - values[-7]) / values[-1]
    assert gap > 1e-8
    assert sine < 1e-11 / gap  # measured: up to 1.4e-12
    # And optimal: responses lose no more energy than the eigenvalues left out.
    lost = np.trace(P) - np.trace(ours.T @ P @ ours)
    assert lost == pytest.approx(values[:-6].sum(), rel=1e-7)  # measured: 3e-9


FIRST = 49.0  # Hz; replaced by the arm's first frequency


@pytest.mark.serial
@pytest.mark.parametrize(
    ("cells", "reduce", "options", "words"),
    [
        ((2, 1), krylov, Options(8), "arm 'arm': only 7 of 8 Krylov .*reduction.coordinates"),
        ((2, 1), balanced, Options(8), r"only 7 of 8 .*reduction\.frequencies"),
        ((20, 4), krylov, Options(6, (FIRST,)), r"natural frequency.*reduction\.frequencies"),
        (
            (20, 4),
            balanced,
            Options(12, band=(0.0, 1e-3)),
            r"only \d+ of 12 .*reduction\.frequencies",
        ),
    ],
)
def test_what_subspaces_cannot_do(cells, reduce, options, words):
    arm, own = (with_densities(make_arm(cells, comm), graded) for comm in (COMM, SELF))
    if options.shifts == (FIRST,):
        first = float(np.sqrt(scipy.linalg.eigvalsh(*dense(own))[0]) / (2.0 * np.pi))
        options = dataclasses.replace(options, shifts=(first,))
    with pytest.raises(ConvergenceError, match=words):
        reduce(arm, options)


@pytest.mark.serial
def test_vectors_that_are_nearly_dependent(shared_arm):
    arm = with_densities(shared_arm, graded)
    V = krylov(arm, Options(3)).V
    for apart in (0.0, 1e-7):  # the square of it is lost in the energies' rounding
        near = np.concatenate([V[:, :, :2], V[:, :, 1:2] + apart * V[:, :, 2:]], axis=2)
        with pytest.raises(ConvergenceError, match="ask for fewer"):
            ritz(arm, near)
    assert ritz(arm, V).V.shape == V.shape


def pencil_of(K):
    """Return dense K with M = 1."""
    arm = SimpleNamespace(comm=MPI.COMM_SELF, mesh=SimpleNamespace(name="arm"))
    return SimpleNamespace(
        arm=arm,
        stiffness=lambda V: K @ V,
        mass=np.copy,
        inverse=lambda V: np.linalg.solve(K, V),
        precondition=lambda V: np.linalg.solve(K, V),
        total=np.copy,
    )


def test_modes_that_a_search_has_passed_over():
    """Of two modes of one frequency a Krylov sequence finds the sum alone; nearby modes tell."""
    K, unit = np.array([1.0, 1.0, 4.0, 9.0]), np.eye(4)
    pencil = pencil_of(np.diag(K))
    for found, over in (([0, 2], True), ([0, 1], False)):
        assert _passes_over(pencil, (K[found], unit[:, found]), unit[:, :3]) == over


@pytest.mark.serial
def test_adjoint_of_modes_is_no_answer_where_a_product_is_no_number():
    """Right where all products are; an error, and not what was found so far, where one is not."""
    K, broken = np.diag([1.0, 4.0, 9.0, 25.0, 36.0]), [np.inf]
    pencil = pencil_of(K)

    def inverse(v):
        broken[0] -= 1
        return np.full_like(v, np.nan) if broken[0] < 0 else (v.T / np.diag(K)).T

    pencil.precondition = inverse
    modes, values = np.eye(5)[:, :2], np.array([1.0, 4.0])
    right = np.random.default_rng(0).normal(size=(5, 2))
    expected = right / (np.diag(K)[:, None] - values + np.eye(5, 2) + np.eye(5, 2, 1))
    expected[:2] = 0.0
    found = complement_solve(pencil, modes, values, right)
    assert found[2:] == pytest.approx(expected[2:], rel=1e-7)
    assert np.abs(found[:2]).max() < 1e-12
    for after in range(3):  # the first product, or a later one
        broken[0] = after
        with pytest.raises(ConvergenceError, match="derivatives of mode 1 do not converge"):
            complement_solve(pencil, modes, values, right)


@pytest.mark.skipif(COMM.size == 1, reason="needs two ranks")
@pytest.mark.parametrize(
    ("method", "q"),
    [("craig-bampton", 3), ("craig-bampton", 8), ("modal", 6), ("krylov", 8), ("balanced", 6)],
)
def test_ranks_agree_with_one_rank(at, method, q):
    shared_arm, own_arm = at(graded)
    together, alone = (ALL[method](arm, Options(q)) for arm in (shared_arm, own_arm))
    pairs = [(together.stiffness, alone.stiffness), (together.outboard, alone.outboard)]
    pairs.append((by_place(shared_arm, together.V), by_place(own_arm, alone.V)))
    pairs += zip(*(
        dataclasses.astuple(shape_integrals(arm, basis, 2e-4, unit_loads(arm)))
        for arm, basis in ((shared_arm, together), (own_arm, alone))
    ))  # fmt: skip
    for ours, reference in pairs:
        scale = np.abs(reference).max(initial=0.0)  # of further interfaces: none
        assert np.abs(np.asarray(ours) - reference).max(initial=0.0) <= 1e-9 * scale
