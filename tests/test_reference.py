"""The whole chain against independent programs (tests/reference), and against differences."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM

from dolfinopt.arms.arm import build_arms
from dolfinopt.parallel import gather_arms, partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import load_cases
from dolfinopt.responses.evaluation import evaluate, gradient
from dolfinopt.scene.load import load_scene

pytestmark = pytest.mark.serial  # ranks have no part in it

COMM = MPI.COMM_WORLD
REFERENCE = Path(__file__).parent / "reference"
TWO_ARM_VALUES = json.loads((REFERENCE / "two_arm_200x12.json").read_text())
METHODS = {"cms": "craig-bampton", "modal": "modal"}


def half(centroid):
    return np.full(len(centroid), 0.5)


def wave(centroid):
    x, y = centroid.T
    return 0.55 + 0.25 * np.sin(6.0 * np.pi * x) * np.cos(2.0 * np.pi * y / 0.06) + 0.1 * x


DESIGNS = {"half": half, "wave": wave}


@dataclass(frozen=True)
class Run:
    """A scene simulated with given designs; what is sampled of the trajectory is on all ranks."""

    scene: object
    partition: object
    arms: dict
    trajectory: object  # on the root
    evaluation: object
    bodies: list
    t: np.ndarray
    deviation: np.ndarray
    compliance: np.ndarray
    q_e: list  # (n, q) of every arm
    cases: object


LINEAR = "arms.element=linear"  # which two_arm_200x12.json is of


def simulate(designs, *overrides):
    scene = load_scene(TWO_ARM, overrides)
    partition = partition_arms(COMM, scene.cell_counts)
    arms = build_arms(scene, partition, Profile())
    x_phys = {k: DESIGNS[designs[k]](arm.mesh.centroid) for k, arm in arms.items()}
    evaluation, trajectory = evaluate(scene, partition, arms, x_phys, Profile())
    bodies = list(
        gather_arms(partition, {k: arm.reduce(x_phys[k]) for k, arm in arms.items()}).values()
    )
    known = None
    if trajectory is not None:
        known = (
            bodies,
            trajectory.t,
            trajectory.deviation,
            trajectory.compliance,
            [trajectory.q_e[:, part] for part in trajectory.mechanism.slices],
            load_cases(trajectory, scene),
        )
    return Run(scene, partition, arms, trajectory, evaluation, *COMM.bcast(known, root=0))


# -- a NumPy/SciPy model of the same two arms -----------------------------------------------------


@pytest.fixture(
    scope="module",
    params=TWO_ARM_VALUES["cases"],
    ids=lambda case: "-".join([case["design"][0], case["method"], str(case["coordinates"])]),
)
def case(request):
    """Return the reference values of one case and our simulation of it."""
    values = request.param
    run = simulate(
        values["design"],
        LINEAR,
        f"reduction.method={METHODS[values['method']]}",
        f"reduction.coordinates={values['coordinates']}",
        f"motion.duration={values['duration']}",
    )
    return values, run


def test_bodies(case):
    values, run = case
    for k, body in enumerate(run.bodies):
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
    values, run = case
    evaluation = run.evaluation
    # Measured: 7e-6 at worst.
    assert evaluation.compliance == pytest.approx(values["compliance"], rel=1e-4)
    # The scene's objective is the same sum, in another order.
    assert evaluation.objective == pytest.approx(evaluation.compliance, rel=1e-14)
    # Measured: 4e-7; samples are 1 ms apart.
    assert evaluation.max_deviation == pytest.approx(values["max_deviation"], rel=1e-4)
    assert evaluation.max_deviation_time == pytest.approx(values["max_deviation_time"], abs=1e-9)
    samples = np.rint(np.array(values["t"]) / 1e-3).astype(int)
    assert np.allclose(run.t[samples], values["t"], atol=1e-12)
    # Measured: 1.2e-5 of the maximum.
    error = np.abs(run.deviation[samples] - values["deviation"]).max()
    assert error < 1e-4 * values["max_deviation"]


@pytest.mark.parametrize("kind", ["esl", "exact"])
def test_gradient_of_the_integrated_compliance(kind):
    """Integral of q'Kq over the horizon, trajectory frozen or not, summed over 10 x 3 boxes."""
    (values,) = TWO_ARM_VALUES["gradients"]
    run = simulate(
        values["design"],
        LINEAR,
        'objective.kind="compliance"',
        f'objective.gradient="{kind}"',
        f"reduction.coordinates={values['coordinates']}",
        f"motion.duration={values['duration']}",
    )
    # Measured: 4e-6.
    assert run.evaluation.objective == pytest.approx(values["value"], rel=1e-4)
    for k, slope in gradient(run.scene, run.partition, run.arms, run.trajectory, Profile()).items():
        arm = run.arms[k]
        place = arm.mesh.centroid / [arm.scene.arms[k].length, arm.scene.arms[k].height] + [0, 0.5]
        i, j = (place * [10, 3]).astype(int).T
        boxes = np.zeros((10, 3))
        np.add.at(boxes, (i, j), slope)
        boxes = arm.mesh.comm.allreduce(boxes)
        expected = np.array(values[kind][k])
        # Measured: 7e-6 (esl), 1.7e-5 (exact).
        assert np.abs(boxes - expected).max() < 1e-4 * np.abs(expected).max()


# -- geometrically exact beams --------------------------------------------------------------------


def test_slow_motion_against_geometrically_exact_beams():
    """Beams of large deformation without a floating frame, and the vibration they are left with.

    The last comes eight periods after the motion: cells that are 0.5 % too stiff, as linear ones,
    would be out of step by 1.2 % of the maximum.
    """
    table = np.loadtxt(REFERENCE / "exudyn_beam_slow.csv", delimiter=",", skiprows=1)
    run = simulate(["half", "half"], "motion.duration=3.0", "motion.horizon=6.0")
    samples = np.rint(table[:, 0] / 1e-3).astype(int)
    assert np.allclose(run.t[samples], table[:, 0], atol=1e-9)
    reference = table[:, 1:]
    largest = np.hypot(*reference.T).max()
    assert largest == pytest.approx(0.0197, rel=2e-3)
    # Measured: 0.54 %; small deformations in a floating frame explain up to 0.6 %.
    error = np.hypot(*(run.deviation[samples] - reference).T)
    assert error.max() < 0.006 * largest
