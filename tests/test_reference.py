"""The whole chain against independent programs (benchmarks/reference), and against differences."""

import json
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from remainders import built_of
from runs import TWO_ARM

from dolfinopt.scene.load import read_scene

pytestmark = pytest.mark.serial  # ranks have no part in it

REFERENCE = Path(__file__).parents[1] / "benchmarks" / "reference"
TWO_ARM_VALUES = json.loads((REFERENCE / "two_arm_200x12.json").read_text())


def wave(x, y):
    return 0.55 + 0.25 * np.sin(6.0 * np.pi * x) * np.cos(2.0 * np.pi * y / 0.06) + 0.1 * x


DESIGNS = {"half": lambda x, y: np.full_like(x, 0.5), "wave": wave}
METHODS = {"cms": "craig-bampton", "modal": "modal"}


LINEAR = "arms.element=linear"  # which two_arm_200x12.json is of


def simulate(designs, *overrides):
    """Return a scene's arms, the physical densities of these designs, evaluation, trajectory."""
    built = built_of(read_scene(TWO_ARM, overrides), MPI.COMM_SELF)
    x = {k: DESIGNS[designs[k]](*arm.mesh.centroid.T) for k, arm in built.arms.items()}
    return built, x, *built.evaluate(x)


@pytest.fixture(
    scope="module",
    params=TWO_ARM_VALUES["cases"],
    ids=lambda case: "-".join([case["design"][0], case["method"], str(case["coordinates"])]),
)
def case(request):
    """Return the reference values of one case and our simulation of it."""
    values = request.param
    changes = (LINEAR, f"reduction.method={METHODS[values['method']]}",
               f"reduction.coordinates={values['coordinates']}",
               f"motion.duration={values['duration']}")  # fmt: skip
    return values, *simulate(values["design"], *changes)


def test_bodies(case):
    values, built, x, *_ = case
    for k, arm in built.arms.items():
        body = arm.reduce(x[k])
        # Measured: 1e-14, 2e-9, 3e-9 at worst; the reference's digits.
        assert body.mass == pytest.approx(values["mass"][k], rel=1e-8)
        assert body.first_frequency == pytest.approx(values["first_frequency"][k], rel=1e-5)
        compliance = body.outboard @ np.linalg.solve(body.K, body.outboard.T)
        expected = np.array(values["tip_compliance"][k])
        # u_x, u_y and theta have units and sizes of their own: entry (i, j) counts against
        # the two diagonal entries it couples.
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert np.abs((compliance - expected) / scale).max() < 1e-5


def test_simulation(case):
    """Default tolerance, 1e-4 of the elastic coordinates; the reference steps by 10 ms."""
    values, _, _, evaluation, found = case
    # Measured: 7e-6 at worst.
    assert evaluation.compliance == pytest.approx(values["compliance"], rel=1e-4)
    # The scene's objective is the same sum, in another order.
    assert evaluation.objective == pytest.approx(evaluation.compliance, rel=1e-14)
    # Measured: 4e-7; samples are 1 ms apart.
    assert evaluation.max_deviation == pytest.approx(values["max_deviation"], rel=1e-4)
    assert evaluation.max_deviation_time == pytest.approx(values["max_deviation_time"], abs=1e-9)
    samples = np.rint(np.array(values["t"]) / 1e-3).astype(int)
    assert np.allclose(found.t[samples], values["t"], atol=1e-12)
    # Measured: 1.2e-5 of the maximum.
    error = np.abs(found.deviation[samples] - values["deviation"]).max()
    assert error < 1e-4 * values["max_deviation"]


@pytest.mark.parametrize("kind", ["esl", "exact"])
def test_gradient_of_the_integrated_compliance(kind):
    """Integral of q'Kq over the horizon, trajectory frozen or not, summed over 10 x 3 boxes."""
    (values,) = TWO_ARM_VALUES["gradients"]
    changes = (LINEAR, "objective.kind=integral_compliance", f"objective.gradient={kind}",
               f"reduction.coordinates={values['coordinates']}",
               f"motion.duration={values['duration']}")  # fmt: skip
    built, _, evaluation, trajectory = simulate(values["design"], *changes)
    # Measured: 4e-6.
    assert evaluation.objective == pytest.approx(values["value"], rel=1e-4)
    for k, slope in built.gradient(trajectory).items():
        arm = built.arms[k]
        place = arm.mesh.centroid / [arm.scene.arms[k].length, arm.scene.arms[k].height] + [0, 0.5]
        i, j = (place * [10, 3]).astype(int).T
        boxes = np.zeros((10, 3))
        np.add.at(boxes, (i, j), slope)
        expected = np.array(values[kind][k])
        # Measured: 7e-6 (esl), 1.7e-5 (exact).
        assert np.abs(boxes - expected).max() < 1e-4 * np.abs(expected).max()


def test_slow_motion_against_geometrically_exact_beams():
    """Up to eight periods after the motion: 0.5 % more stiffness would be 1.2 % out of step."""
    table = np.loadtxt(REFERENCE / "exudyn_beam_slow.csv", delimiter=",", skiprows=1)
    *_, found = simulate(["half", "half"], "motion.duration=3.0", "motion.horizon=6.0")
    samples = np.rint(table[:, 0] / 1e-3).astype(int)
    assert np.allclose(found.t[samples], table[:, 0], atol=1e-9)
    reference = table[:, 1:]
    largest = np.hypot(*reference.T).max()
    assert largest == pytest.approx(0.0197, rel=2e-3)
    # Measured: 0.54 %; small deformations in a floating frame explain up to 0.6 %.
    error = np.hypot(*(found.deviation[samples] - reference).T)
    assert error.max() < 0.006 * largest
