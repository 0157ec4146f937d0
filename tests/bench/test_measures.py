"""What the diagrams measure is right: motions, elements, other programs, random cases."""

import math
from functools import partial

import numpy as np
import pytest
from mpi4py import MPI

from dolfinopt.bench import arms, iterations, measure, motion, programs, solid, tolerance
from dolfinopt.dynamics import generalized_alpha, radau
from dolfinopt.dynamics.collocation import even_steps
from dolfinopt.dynamics.system import relative_error
from dolfinopt.errors import ConvergenceError
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.multibody.measured import DENSE_INSTANTS
from dolfinopt.multibody.motion import rigid_motion
from dolfinopt.paper.reproduction import load_paper
from dolfinopt.profiling import Profile
from dolfinopt.study.variants import changed, reduced

pytestmark = pytest.mark.serial  # a bench runs on one rank and starts others itself

SCENE = load_paper()
COARSE = "simulation.tolerance=1e-2"


@pytest.fixture(scope="module")
def problem():
    """The paper's motion with coarse uniform arms of two slow vibrations each."""
    scene = reduced(changed(SCENE, "arms.cells=[20,2]", "motion.horizon=1.9"), "modal", 2)
    built = measure.arms_of(scene)
    return motion.problem_of(scene, built, {k: arm.uniform(0.5) for k, arm in built.items()})


@pytest.fixture(scope="module")
def reference(problem):
    """What the problem's solutions are measured against."""
    return motion.find_reference(problem, 1e-7)


# -- motion ----------------------------------------------------------------------------------


def test_accelerations_solve_the_residual(problem):
    size = problem.mechanism.num_coordinates
    rng = np.random.default_rng(1)
    q, qd = 1e-3 * rng.normal(size=size), 1e-2 * rng.normal(size=size)
    qdd = motion.accelerations(problem, 0.7, q, qd)
    now = problem.at(np.array([0.7]))
    left, at_rest = (now.residual(q[None], qd[None], rate[None]) for rate in (qdd, 0 * qdd))
    assert np.abs(left).max() < 1e-11 * np.abs(at_rest).max()


def test_jacobian_is_the_derivative_of_accelerations(problem):
    problem = problem.preconditioner().system
    size = problem.mechanism.num_coordinates
    rng = np.random.default_rng(2)
    y, d = 1e-3 * rng.normal(size=2 * size), rng.normal(size=2 * size)
    exact = motion.jacobian(problem, 0.7, y) @ d

    def rate(step):
        q, qd = np.split(y + step * d, 2)
        return np.concatenate([qd, motion.accelerations(problem, 0.7, q, qd)])

    central = (rate(1e-5) - rate(-1e-5)) / 2e-5
    np.testing.assert_allclose(central, exact, rtol=1e-6, atol=1e-6 * np.abs(exact).max())


def test_scipy_and_radau_agree(problem, reference):
    """Two independent paths through the same residual; the errors fall with the tolerance."""
    assert max(reference.errors(motion._scipy("Radau", 1e-3, reference))) < 1e-2
    errors = [reference.errors(motion._radau(3, tol, reference))[0] for tol in (1e-3, 1e-5)]
    assert errors[0] < 1e-3 and errors[1] < 1e-5  # the tolerances


def test_newmark_is_of_second_order(problem, reference):
    errors = []
    for count in (200, 400):
        found = generalized_alpha.on_grid(problem, even_steps(problem, count), 1e-8, 1.0)
        errors.append(reference.errors(found.sample(reference.t))[0])
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.4)


# -- elements and programs -------------------------------------------------------------------


def test_elements_that_do_not_lock():
    """A slender solid arm of few cells against beam theory: E I and Cowper's shear."""
    E, nu, h, t = 70e9, 0.33, 0.06, 0.01
    shear = (12 + 11 * nu) / (10 * (1 + nu)) * 2 * (1 + nu) / (E * h * t)
    # The rigid end leaves no shear at a free one, but its moment is free: a cantilever.
    right = 1.0 / (3 * E * t * h**3 / 12) + shear
    scene = changed(SCENE, COARSE)
    error = {e.name: arms.respond(scene, e, (50, 3))[0][0] / right - 1.0 for e in arms.ELEMENTS}
    # A clamped end does not let the section warp: 0.1 % of the compliance.
    assert all(abs(error[n]) < 3e-3 for n in (arms.DEFAULT, "Q2", "P2 triangles"))
    assert error["Q1"] < -0.03 and error["P1 triangles"] < -0.2  # they lock


def test_graded_reference():
    """The reference's grid covers the arm, and halving it shows its error to be of 1e-5."""
    grid = arms.grid_arm(1.0, 0.06, (12, 4), graded=True)
    assert grid.area.sum() == pytest.approx(0.06, rel=1e-12)
    assert grid.area.min() < 1e-2 * grid.area.max()  # the corners
    scene = changed(SCENE, COARSE)
    coarse, fine = (arms.respond(scene, arms.FINER, n)[0][0] for n in ((15, 2), (30, 4)))
    uniform = arms.respond(scene, arms.ELEMENTS[2], (60, 4))[0][0]
    # Uniform cells of the same height lose a tenth of a percent at the corners.
    assert abs(coarse / fine - 1.0) < 3e-4 and 3e-5 < abs(uniform / fine - 1.0) < 1e-3


@pytest.mark.parametrize("make", [iterations.plain_statics, programs.pymoto_iteration])
def test_static_iterations(make):
    """Compliance of a slender uniform arm by beam theory; its slope by differences."""
    iterate = make(SCENE, (100, 12))
    if iterate is None:
        pytest.skip("not installed")
    x = np.full(1200, 0.5)
    compliance, slope = iterate(x)
    # Q1 cells twice as long as high are up to 3 % too stiff; the floor adds 1e-5.
    beam = 1.0 / (3 * 70e9 * 0.5**3 * 0.01 * 0.06**3 / 12)
    assert compliance == pytest.approx(beam, rel=0.04)
    d = np.random.default_rng(3).normal(size=1200)
    central = (iterate(x + 1e-4 * d)[0] - iterate(x - 1e-4 * d)[0]) / 2e-4
    assert slope @ d == pytest.approx(central, rel=1e-4)


def test_exudyn_moves_alike():
    """Geometrically exact beams against cubic elements: within a percent of the deviation."""
    pytest.importorskip("exudyn")
    right = iterations.solid_motion(SCENE, (15, 2))
    found = programs.exudyn_tip(SCENE, 8, 1500)
    # Steps of 2 ms: 1.8e-3 was seen.
    assert iterations.place_error(right, found[:, 0], found[:, 1:]) < 5e-3


def test_both_links():
    """The same link: dofs of all nodes in DOLFINx, less the clamped and the rigid ones here."""
    found = solid.iterate_link(MPI.COMM_SELF, SCENE, (4, 3, 2), solid.OURS)
    assert found["dofs"] == 3 * 3 * 4 * 3 + 6 and found["solver"] == "LAPACK's band"
    assert [len(row) for row in found["phases"]] == 2 * [len(solid.PHASES)]
    found = solid.plain_link(MPI.COMM_SELF, SCENE, (4, 3, 2), solid.PLAIN)
    assert found["dofs"] == 3 * 5 * 4 * 3 and len(found["phases"]) == 1


def test_plain_link_bends_like_a_beam():
    """Solid, one load: E I and shear, by cells that lock a little."""
    size = length, height, thickness = 0.5, 0.04, 0.02
    arm = box_arm(MPI.COMM_SELF, "link", size, (60, 6, 3))
    statics = programs.PlainStatics(arm, 70e9, 0.33, height * thickness, 1e-8)
    compliance, _ = statics(np.ones(arm.num_cells))
    # Trilinear cells of this size are 2.4 % too stiff; of half the size 0.6 %.
    assert compliance == pytest.approx(length**3 / (70e9 * thickness * height**3 / 4), rel=0.03)


def test_solvers_are_timed():
    scene = changed(SCENE, "arms.cells=[12,2]")
    rows = iterations.time_solvers(MPI.COMM_SELF, scene, ["petsc, nd"])
    names = [name for name, *_ in rows]
    assert {"lapack, natural", "mumps, its own"} <= {*names} and "petsc, nd" not in names
    assert all(seconds > 0.0 for _, *row in rows for seconds in row)


# -- random cases ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def built():
    return measure.arms_of(changed(SCENE, "arms.cells=[24,6]"))


@pytest.fixture(scope="module")
def draw(built, tmp_path_factory):
    """A function that draws a case by its number."""
    scene, folder = changed(SCENE, "arms.cells=[24,6]"), tmp_path_factory.mktemp("tables")
    return partial(tolerance.random_case, scene, built, folder=folder)


def test_random_cases_differ_and_come_back(draw):
    cases = [draw(number=number) for number in range(8)]
    assert [case.cells[1] for case in cases[:4]] == list(tolerance.KINDS)
    assert {case.scene.motion.path for case in cases} == set(tolerance.PATHS)
    assert {case.scene.damping.stiffness_proportional > 0.0 for case in cases} == {True, False}
    assert len({case.cells[3:5] for case in cases}) == len(cases)
    again = draw(number=5)
    assert again.cells == cases[5].cells
    assert all(np.array_equal(again.x_phys[k], x) for k, x in cases[5].x_phys.items())
    for case in cases:
        moved = case.scene.motion
        assert 0.5 <= moved.duration <= 6.0 and 0.0 <= case.scene.payload.mass <= 50.0
        t = np.linspace(0.0, moved.duration, DENSE_INSTANTS)
        assert np.isfinite(rigid_motion(t, case.scene).qdd).all()


@pytest.mark.parametrize("kind", tolerance.KINDS)
def test_random_designs(built, kind):
    arm = built[0]
    x = tolerance.random_design(kind, arm, np.random.default_rng(1))
    along, up = arm.mesh.centroid.T
    assert x.shape == (arm.mesh.num_cells,) and x.min() >= 0.0 and x.max() <= 1.0
    assert (kind == "uniform") == (np.ptp(x) == 0.0)
    assert (kind == "void and solid") == (set(np.unique(x)) == {0.0, 1.0})
    if kind == "weak tips":  # the last of 24 cells, over at least a tenth of the length
        assert x[along > 0.95].max() < 0.5 < x[(along < 0.7) & (np.abs(up) > 0.02)].min()


def test_random_field_is_normal_and_smooth():
    """Mean 0, variance 1 and covariance exp(-d^2 / 2 l^2) over many fields."""
    points = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.2]])
    rng = np.random.default_rng(2)
    fields = np.array([tolerance.random_field(points, 0.1, rng) for _ in range(4000)])
    right = np.exp([[0.0, -0.5, -2.0], [-0.5, 0.0, -2.5], [-2.0, -2.5, 0.0]])
    # Five standard deviations of a covariance from 4000 samples.
    np.testing.assert_allclose(fields.T @ fields / 4000, right, atol=5.0 * math.sqrt(2.0 / 4000))


def rows_of(case):
    return tolerance.DIAGRAM.frame(tolerance.compared(case, tolerance.TOLERANCES))


def test_errors_of_a_damped_case(draw):
    """The largest difference at the reference's own instants, found by hand."""
    case = next(c for n in range(1, 20) if (c := draw(number=n)).cells[5] > 1e-5)
    rows = rows_of(case)
    assert rows["tolerance [-]"].tolist() == list(tolerance.TOLERANCES)
    found = radau.integrate(case.problem, 1e-3, tolerance.STAGES, Profile())
    right = tolerance.reference(case.problem, found, 1e-3)
    assert right.error <= 1e-5 and len(right.a) > len(found.a) and right.a.shape[1] == 5
    t = np.linspace(0.0, case.scene.motion.horizon, 4001)
    q = right.sample(t)
    error = relative_error(case.problem.mechanism, found.sample(t) - q, q)
    # The reference is right to a hundredth, and other instants are as near to the largest error.
    assert rows["true error [-]"][1] == pytest.approx(error, rel=0.05)
    assert rows["estimate [-]"][1] == found.error
    assert (rows["true error [-]"] <= rows["tolerance [-]"]).all()


def test_failures_have_names(draw, monkeypatch):
    case = draw(number=1)

    def fail(*_):
        raise ConvergenceError("gave up")

    with monkeypatch.context() as patch:
        patch.setattr(radau, "integrate", fail)
        rows = rows_of(case)
    assert (rows["failure"] == "gave up").all() and rows["estimate [-]"].isna().all()
    with monkeypatch.context() as patch:
        patch.setattr(tolerance, "reference", fail)
        rows = rows_of(case)
    assert (rows["failure"] == "reference: gave up").all() and rows["true error [-]"].isna().all()
    found = radau.integrate(case.problem, 1e-2, tolerance.STAGES, Profile())
    assert rows["estimate [-]"][0] == found.error
