"""Estimated against true errors: random cases, their reference, what is told of them."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dolfinopt.bench import common, tolerance
from dolfinopt.bench.tolerance import Run
from dolfinopt.dynamics.system import relative_error
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.motion import DENSE, rigid_motion
from dolfinopt.paper.reproduction import load_paper

pytestmark = pytest.mark.serial  # a bench runs on one rank


@pytest.fixture(scope="module")
def arms():
    return common.arms_of(load_paper(overrides=("arms.cells=[24,6]",)))


@pytest.fixture(scope="module")
def draw(arms, tmp_path_factory):
    """A function that draws a case by its number."""
    scene = load_paper(overrides=("arms.cells=[24,6]",))
    return partial(tolerance.random_case, scene, arms, folder=tmp_path_factory.mktemp("tables"))


def _row(tol, estimate, true, failure="", scipy=math.nan, damping=0.0):
    case = 1, "smooth", "arc", 1.0, 1.0, damping, 4
    return *case, tol, estimate, true, true / estimate, 10, 0.1, 1e-9, scipy, failure


def test_random_cases_differ_and_come_back(draw):
    cases = [draw(number=number) for number in range(12)]
    assert [case.design for case in cases[:4]] == list(tolerance.DESIGNS)
    assert {case.scene.motion.path for case in cases} == set(tolerance.PATHS)
    assert {case.scene.damping.stiffness_proportional > 0.0 for case in cases} == {True, False}
    assert len({case.cells()[3:5] for case in cases}) == len(cases)
    again = draw(number=5)
    assert again.cells() == cases[5].cells()
    assert all(np.array_equal(again.x_phys[k], x) for k, x in cases[5].x_phys.items())
    for case in cases:
        motion = case.scene.motion
        assert 0.5 <= motion.duration <= 6.0 and 0.0 <= case.scene.payload.mass <= 50.0
        t = np.linspace(0.0, motion.duration, DENSE)
        assert np.isfinite(rigid_motion(t, case.scene).qdd).all()


def test_random_designs(arms):
    rng = np.random.default_rng(1)
    for kind in tolerance.DESIGNS:
        for arm in arms.values():
            x = tolerance.random_design(kind, arm, rng)
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
    fields = np.array([tolerance._random_field(points, 0.1, rng) for _ in range(4000)])
    right = np.exp([[0.0, -0.5, -2.0], [-0.5, 0.0, -2.5], [-2.0, -2.5, 0.0]])
    # Five standard deviations of a covariance from 4000 samples.
    np.testing.assert_allclose(fields.T @ fields / 4000, right, atol=5.0 * math.sqrt(2.0 / 4000))


def test_errors_of_a_damped_case(draw):
    """The largest difference at the reference's own instants, found by hand."""
    case = next(c for n in range(20) if (c := draw(number=n)).cells()[5] > 1e-5)
    case = replace(case, number=1)  # none to the finest tolerance
    rows = tolerance.compared(case)
    assert [row[tolerance.TOLERANCE] for row in rows] == list(tolerance.TOLERANCES)
    run = tolerance.run(case.problem, 1e-3)
    right = tolerance.reference(case.problem, run)
    assert right.error <= 1e-5 and len(right.a) > len(run.found.a) and right.a.shape[1] == 5
    t = np.linspace(0.0, case.scene.motion.horizon, 4001)
    q = right.sample(t)
    error = relative_error(case.problem.mechanism, run.found.sample(t) - q, q)
    # The reference is right to a hundredth, and other instants are as near to the largest error.
    assert rows[1][tolerance.TRUE] == pytest.approx(error, rel=0.05)
    assert rows[1][tolerance.ESTIMATE] == run.found.error
    assert all(row[tolerance.TRUE] <= row[tolerance.TOLERANCE] for row in rows)


def test_scipy_confirms_the_reference(draw, arms):
    """One vibration an arm, by an explicit method of order 8 with other error control."""
    case = min((draw(number=n) for n in range(30)), key=lambda case: case.scene.motion.horizon)
    # The reference's 1e-8, and SciPy's local 1e-10 over some thousand steps.
    assert tolerance.checked(tolerance._slowest(case, arms)) < 1e-7


def test_failures_have_names(draw, monkeypatch):
    case = draw(number=1)

    def fail(*_):
        raise ConvergenceError("gave up")

    run = tolerance.run(case.problem, 1e-2)
    with monkeypatch.context() as patch:
        patch.setattr(tolerance.radau, "integrate", fail)
        rows = tolerance.compared(case)
    assert all(row[tolerance.FAILURE] == "gave up" and math.isnan(row[9]) for row in rows)
    with monkeypatch.context() as patch:
        patch.setattr(tolerance, "reference", fail)
        rows = tolerance.compared(case)
    assert all(row[tolerance.FAILURE] == "reference: gave up" for row in rows)
    assert rows[0][tolerance.ESTIMATE] == run.found.error and math.isnan(rows[0][tolerance.TRUE])
    with pytest.raises(ConvergenceError, match="gave up"):
        tolerance.reference(case.problem, Run(1e-2, 0.0, ConvergenceError("gave up")))


def test_what_is_told():
    rows = [
        _row(1e-2, 5e-3, 6e-3),
        _row(1e-2, 4e-3, 2e-2, damping=1e-5, scipy=3e-9),
        _row(1e-2, math.nan, math.nan, "gave up"),
        _row(1e-3, 5e-4, 5e-4),
    ]
    text = "\n".join(tolerance.diagram().notes(rows))
    assert "To 0.01: 3 cases, met in 1 of 2; largest true error 2 times the tolerance" in text
    assert "3.1 in the median, 1.2 to 5. Failures: case 1: gave up." in text
    assert "To 0.001: 1 cases, met in 1 of 1" in text and "by at most 3e-09" in text
    (goal,) = tolerance.diagram().goals(rows)
    assert goal.measured == 2.0 and goal.remark.startswith("1 of 3") and "1 failed" in goal.remark
    ranges, cases = tolerance.diagram().panels(rows)
    assert {line.label: list(line.y) for line in ranges.lines}["largest"] == [5e-4, 2e-2]
    points = [line for line in cases.lines if line.label == "undamped"]
    assert [(x, y) for line in points for x, y in zip(line.x, line.y) if x == x] == [
        (5e-3, 6e-3),
        (5e-4, 5e-4),
    ]


def test_lone_points_are_marked_and_not_joined():
    from dolfinopt.study.figures import FEW

    rows = [_row(1e-2, 5e-3, 6e-3)] * 50
    lines = [line for line in tolerance.diagram().panels(rows)[1].lines if line.label == "undamped"]
    assert sum(np.isfinite(line.x).sum() for line in lines) == 50
    for line in lines:
        assert len(line.x) <= FEW and np.isnan(line.x[1::2]).all()
