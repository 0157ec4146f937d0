"""The motion's law as design variables beside the densities."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from runs import QUICK, TWO_ARM, overrides, quick, run, scene, summary_of

import dolfinopt as do
from dolfinopt.errors import InputError
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.gradient_check import held_steps
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile

pytestmark = pytest.mark.serial  # commands run in this process

LIMITS = "constraints.deviation=0.012", "constraints.settling=5e-4"
DURATION = "objective.kind=duration", "objective.gradient=exact", "motion.shape=2", *LIMITS


def evaluator_of(*changes: str) -> Evaluator:
    one = scene(
        "arms.cells=[16,3]", "design.filter_radius=0.07", "simulation.tolerance=1e-8",
        "objective.gradient=exact", *changes,
    )  # fmt: skip
    partition = partition_arms(MPI.COMM_SELF, one.cell_counts)
    found = Evaluator(one, partition, do.build_arms(one, partition, Profile()), Profile())
    return found.with_gradient("exact")


@pytest.mark.parametrize(
    "changes",
    [
        ["objective.kind=settling", "constraints.stress=40e6", "motion.gravity=[0,-9.81]"],
        ["objective.kind=integral_compliance", "constraints.effort=10",
         'control={stiffness=[2e4,2e4,1e4],damping=[200,200,100]}'],
    ],
    ids=["prescribed", "controlled"],
)  # fmt: skip
def test_gradient_by_the_law(changes: list[str]) -> None:
    """Of objective and limits, against central differences of the whole simulation."""
    chain = evaluator_of("motion.shape=[0.05,-0.03]", "simulation.stiffening=false", *changes)
    x = chain.variables.initial
    chain.evaluate(x)
    chain.solutions = held_steps(chain.trajectory)
    here = chain.evaluate(x)[-1]
    step = 1e-4 * (np.arange(len(x)) == chain.variables.size)
    sides = [chain.tried(x + sign * step)[-1].evaluation for sign in (1.0, -1.0)]
    a, b = ((one.objective, *np.array(smooth_of(one))) for one in sides)
    limits = np.array([1.0, *here.evaluation.smooth_limits])
    expected = (np.array(a) - np.array(b)) / 2e-4 / limits
    found = [here.objective[chain.variables.size], *here.constraints[:, chain.variables.size]]
    assert found == pytest.approx(expected, rel=2e-5, abs=1e-9)  # stress leaves out 1e-5


def smooth_of(one) -> np.ndarray:
    """Return the smooth values of the limits."""
    return (1.0 + np.array(one.constraints)) * np.array(one.smooth_limits)


def test_gradient_by_the_duration() -> None:
    """Time, rates and accelerations scale with it; its instants are those of the motion."""
    chain = evaluator_of(*DURATION, "motion.horizon=2.8995", "simulation.stiffening=false")
    x = chain.variables.initial
    here = chain.evaluate(x)[-1]
    base, ends = chain.trajectory, []
    h = 1e-5
    for sign in (1.0, -1.0):
        moved = x.copy()
        moved[-1] += sign * h
        one = smooth_of(chain.tried(moved)[-1].evaluation)
        ends.append(one)
        assert len(chain.trajectory.t) == len(base.t)
    change = (ends[0] - ends[1]) / (2.0 * h) / np.array(here.evaluation.smooth_limits)
    assert here.constraints[2:, -1] == pytest.approx(change[2:], rel=1e-3)
    low, high = chain.variables.law_bounds
    assert here.objective[-1] == pytest.approx(high[-1] - low[-1])
    assert not here.objective[:-1].any()


def test_run_is_resumed_in_the_same_bits_and_its_design_read_with_its_law(tmp_path: Path) -> None:
    """design.npz holds shape and duration; simulate takes both."""
    wide = "constraints.deviation=1", "constraints.settling=0.1"  # m: kept by every design
    words = [*overrides(*QUICK, *DURATION, *wide), "--no-plots"]
    for folder, counts in (("whole", [3]), ("parts", [1, 3])):
        for k, count in enumerate(counts):
            more = ["--resume"] if k else []
            limit = ["--set", f"optimizer.max_iterations={count}"]
            run("optimize", TWO_ARM, "--out", tmp_path / folder, *words, *limit, *more)
    files = [np.load(tmp_path / name / "design.npz") for name in ("whole", "parts")]
    assert sorted(files[0].files) == sorted(files[1].files)
    for key in files[0].files:
        np.testing.assert_array_equal(files[0][key], files[1][key])
    assert files[0]["motion/shape"].shape == (2,) and files[0]["motion/shape"].any()
    design = tmp_path / "whole" / "design.npz"
    run("simulate", TWO_ARM, "--out", tmp_path / "again", "--design", design, *words)
    first, again = (summary_of(tmp_path / name) for name in ("whole", "again"))
    assert again["scene"]["motion"] == first["scene"]["motion"]
    assert again["max_deviation"] == pytest.approx(first["max_deviation"], rel=1e-4)  # other steps
    assert first["scene"]["motion"]["duration"] == files[0]["motion/duration"][0] != 1.9
    model = do.Model(TWO_ARM, *QUICK, *DURATION, *wide)
    assert model.evaluate(design).values["objective"] == files[0]["motion/duration"][0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["feed_forward.kind=tip"], "feed_forward.kind"),
        (["objective.gradient=esl"], "objective.gradient"),
        (
            [
                "motion.shape=0",
                "objective.kind=duration",
                "motion.law=s-curve",
                "motion.max_speed=30",
                "motion.duration=1.9",
            ],
            "motion.shape",
        ),
        ([f"motion.shape={[0.01] * 9}"], "at most 8 coefficients"),
    ],
)
def test_what_a_designed_law_cannot_be_combined_with(changes: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        quick("motion.shape=2", "objective.gradient=exact", *changes)


def test_rates_along_the_path() -> None:
    """Of the quintic law in closed form; their gradients by differences."""
    limits = "max_speed", "max_acceleration", "max_jerk"
    chain = evaluator_of(
        "objective.kind=duration", "motion.shape=[0.0,0.0]",
        *(f"motion.{one}=1" for one in limits), "motion.duration=1.9",
    )  # fmt: skip
    x, T = chain.variables.initial, chain.scene.motion.duration
    here = chain.evaluate(x)[-1]
    found = [one.values[0] for one in here.evaluation.responses[-3:]]
    peaks = np.pi * np.array([15 / 8 / T, 10 / np.sqrt(3) / T**2, 60 / T**3])
    assert found == pytest.approx(peaks, rel=0.02)  # of the jerk means between samples
    assert found[:2] == pytest.approx(peaks[:2], rel=1e-4)
    for k in range(chain.variables.size, len(x)):
        step = 1e-5 * (np.arange(len(x)) == k)
        a, b = (smooth_of(chain.tried(x + sign * step)[-1].evaluation) for sign in (1.0, -1.0))
        expected = (a - b) / 2e-5 / np.array(here.evaluation.smooth_limits)
        assert here.constraints[-3:, k] == pytest.approx(expected[-3:], rel=1e-6, abs=1e-8)


def test_model_names_the_derivatives_by_the_law() -> None:
    one = quick("objective.kind=duration", "objective.gradient=exact", "motion.shape=1")
    found = do.Model(one).gradient()
    assert sorted(found) == ["arm1", "arm2", "motion"]
    assert found["motion"].tolist() == [0.0, 1.0] and not found["arm1"].any()
