"""What the diagrams measure is right: motions, elements, other programs, random cases."""

import math
from functools import partial
from typing import get_args

import numpy as np
import pytest
from mpi4py import MPI

from dolfinopt.bench import accuracy, iterations, measure, solid
from dolfinopt.dynamics import radau
from dolfinopt.dynamics.system import relative_error
from dolfinopt.errors import ConvergenceError
from dolfinopt.paper.reproduction import load_paper
from dolfinopt.profiling import Profile
from dolfinopt.scene.tables.arms import ElementName
from dolfinopt.study.variants import changed, reduced

pytestmark = pytest.mark.serial  # a bench runs on one rank and starts others itself

SCENE = load_paper()


@pytest.fixture(scope="module")
def problem():
    """The paper's motion with coarse uniform arms of two slow vibrations each."""
    scene = reduced(changed(SCENE, "arms.cells=[20,2]", "motion.horizon=1.9"), "modal", 2)
    built = measure.arms_of(scene)
    return accuracy.problem_of(scene, built, {k: arm.uniform(0.5) for k, arm in built.items()})


@pytest.fixture(scope="module")
def reference(problem):
    """What the problem's solutions are measured against."""
    return accuracy.Reference(problem)


# -- motion ----------------------------------------------------------------------------------


def test_scipy_and_radau_agree(problem, reference):
    """Two independent paths through the same residual; the errors fall with the tolerance."""

    def error(q):
        return relative_error(problem.mechanism, q - reference.q, reference.q)

    assert error(accuracy.METHODS["SciPy Radau"](1e-3, reference)) < 1e-2
    errors = [error(accuracy.radau_motion(3, tol, reference)) for tol in (1e-3, 1e-5)]
    assert errors[0] < 1e-3 and errors[1] < 1e-5  # the tolerances


# -- elements and programs -------------------------------------------------------------------


def test_elements_that_do_not_lock():
    """A slender solid arm of few cells against beam theory: E I and Cowper's shear."""
    E, nu, h, t = 70e9, 0.33, 0.06, 0.01
    shear = (12 + 11 * nu) / (10 * (1 + nu)) * 2 * (1 + nu) / (E * h * t)
    # The rigid end leaves no shear at a free one, but its moment is free: a cantilever.
    right = 1.0 / (3 * E * t * h**3 / 12) + shear
    names = get_args(ElementName)
    error = {e: accuracy.tip_compliance(SCENE, e, (50, 3))[0] / right - 1.0 for e in names}
    # A clamped end does not let the section warp: 0.1 % of the compliance.
    assert all(abs(error[n]) < 3e-3 for n in (accuracy.DEFAULT, accuracy.FINEST))
    assert error["linear"] < -0.03  # they lock


def test_static_iterations():
    """Compliance of a slender uniform arm by beam theory; its slope by differences."""
    cells = 100, 12
    iterate = iterations.plain_iteration(SCENE, cells)
    x = np.full(math.prod(cells), 0.5)
    compliance, slope = iterate(x)
    # Q1 cells twice as long as high are up to 3 % too stiff; the floor adds 1e-5.
    beam = 1.0 / (3 * 70e9 * 0.5**3 * 0.01 * 0.06**3 / 12)
    assert compliance == pytest.approx(beam, rel=0.04)
    d = np.random.default_rng(3).normal(size=len(x))
    central = (iterate(x + 1e-4 * d)[0] - iterate(x - 1e-4 * d)[0]) / 2e-4
    assert slope @ d == pytest.approx(central, rel=1e-4)


def test_both_links():
    """The same link: dofs of all nodes in DOLFINx, less the clamped and the rigid ones here."""
    dofs, solver, seconds = solid.iterate_link(MPI.COMM_SELF, SCENE, (4, 3, 2))
    assert dofs == 3 * 3 * 4 * 3 + 6 and solver == "LAPACK's band" and len(seconds) == 2
    dofs, _, seconds = solid.plain_link(MPI.COMM_SELF, SCENE, (4, 3, 2))
    assert dofs == 3 * 5 * 4 * 3 and len(seconds) == 1
    dofs, solver, seconds = solid.iterate_link(MPI.COMM_SELF, SCENE, (4, 3, 2), True)
    assert dofs == 3 * 3 * 4 * 3 + 6 and solver == "LAPACK's band" and len(seconds) == 2


# -- random cases ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def built():
    return measure.arms_of(changed(SCENE, "arms.cells=[24,6]"))


@pytest.fixture(scope="module")
def draw(built):
    """A function that draws a case by its number."""
    return partial(accuracy.random_case, changed(SCENE, "arms.cells=[24,6]"), built)


def test_random_cases_differ_and_come_back(draw):
    cases = [draw(number) for number in range(8)]
    cells = [cells for cells, _ in cases]
    assert [one[1] for one in cells[:4]] == list(accuracy.KINDS)
    assert {one[2] for one in cells} == set(accuracy.PATHS)
    assert {one[6] > 0.0 for one in cells} == {True, False}
    assert len({one[3:6] for one in cells}) == len(cells)
    again, problem = draw(5)
    assert again == cells[5]
    K, other = (one.mechanism.bodies[0].K for one in (problem, cases[5][1]))
    np.testing.assert_array_equal(K, other)
    for one in cells:
        assert 0.5 <= one[4] <= 6.0 and 0.0 <= one[5] <= 50.0


def rows_of(case):
    return accuracy.TOLERANCE.frame(accuracy.compared(*case))


def test_errors_of_a_damped_case(draw):
    """The largest difference at the reference's own instants, found by hand."""
    case = next(one for n in range(1, 20) if (one := draw(n))[0][6] > 1e-5)
    rows, problem = rows_of(case), case[1]
    assert rows["tolerance [-]"].tolist() == list(accuracy.CASE_TOLERANCES)
    found = radau.integrate(problem, 1e-3, accuracy.STAGES, Profile())
    right = accuracy.reference(problem, found)
    assert right.error <= 1e-6 and len(right.a) > len(found.a) and right.a.shape[1] == 5
    t = np.linspace(0.0, problem.breakpoints[-1], 4001)
    q = right.sample(t)
    error = relative_error(problem.mechanism, found.sample(t) - q, q)
    # The reference is right to a hundredth, and other instants are as near to the largest error.
    assert rows["true error [-]"][1] == pytest.approx(error, rel=0.05)
    assert rows["estimate [-]"][1] == found.error
    assert (rows["true error [-]"] <= rows["tolerance [-]"]).all()


def test_failures_count(draw, monkeypatch):
    """A simulation that fails misses its tolerance; without a reference there is no case."""
    case = draw(1)

    def fail(*_):
        raise ConvergenceError("gave up")

    with monkeypatch.context() as patch:
        patch.setattr(radau, "integrate", fail)
        assert np.isinf(rows_of(case)["true error [-]"]).all()
    monkeypatch.setattr(radau, "on_grid", fail)
    with pytest.raises(ConvergenceError, match="gave up"):
        accuracy.reference(case[1], radau.integrate(case[1], 1e-2, 4, Profile()))
