"""The loop: what it reaches, that it resumes in the same bits, and on any number of ranks."""

import signal
import subprocess
import time

import numpy as np
import pytest
from mpi4py import MPI
from runs import (
    TWO_ARM,
    assert_same_bits,
    by_root,
    command,
    environment,
    overrides,
    run,
    scene,
)

import dolfinopt as do
from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.iterate import Iterate
from dolfinopt.optimization.measured import DECIMALS
from dolfinopt.optimization.stopping import StopCode
from dolfinopt.output import checkpoint
from dolfinopt.parallel import on_root
from dolfinopt.responses.measured import STIFFNESS_CHANGE

WORLD = MPI.COMM_WORLD


def small(*settings, iterations=6):
    return scene("arms.cells=[40,4]", f"optimizer.max_iterations={iterations}", *settings)


QUICK = ["motion.horizon=2.0", "simulation.tolerance=1e-3"]
SMALLEST = ["motion.horizon=1.9", "simulation.tolerance=1e-2", "arms.cells=[24,3]"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("element", "compliance", "deviation"),
    [("linear", 28.038, 55.575e-3), ("incompatible", 28.162, 55.787e-3)],
)
def test_two_arm_manipulator(element, compliance, deviation):
    """The paper's example. An independent model of linear elements ends at 2.6 N m."""
    result = do.optimize(scene("optimizer.max_iterations=60", f"arms.element={element}"))
    if WORLD.rank == 0:
        first, last = result.history[0], result.history[-1]
        assert first.objective == pytest.approx(compliance, rel=1e-4)
        assert first.max_deviation == pytest.approx(deviation, rel=1e-4)
        assert last.objective < 2.6
        assert last.max_deviation < 8e-3
        assert last.volume_fraction == pytest.approx(0.5, abs=1e-4)
        assert last.grayness < 0.35


@pytest.mark.serial
def test_volume_limits():
    """Each arm keeps its own limit; a shared limit lets material move to the inner arm."""
    for shared in (False, True):
        settings = ["design.shared_volume=true"] if shared else []
        result = do.optimize(small(*SMALLEST, *settings, iterations=25))
        mine = {k: arm.volume_fraction(result.x_phys[k]) for k, arm in result.arms.items()}
        fractions = list(do.gather_arms(result.partition, mine).values())
        assert np.mean(fractions) == pytest.approx(0.5, abs=2e-3)
        if shared:
            assert fractions[0] > 0.52 and fractions[1] < 0.48  # 0.594, 0.405
        else:
            assert fractions == pytest.approx([0.5, 0.5], abs=2e-3)


@pytest.mark.serial
def test_stops_when_the_best_design_gains_no_more():
    """Looked at in every fifth iteration: by the history at the first that gained no 2 % in 20."""
    result = do.optimize(small(*SMALLEST, "optimizer.tolerance=0.02", iterations=200))
    assert result.converged and result.stop_code is StopCode.SETTLED
    best = np.minimum.accumulate([row.objective for row in result.history])
    gains = {k: best[k - 20] / best[k] - 1.0 for k in range(25, len(best), 5)}
    assert result.iterations == next(k for k, gain in gains.items() if gain <= 0.02) < 200


def test_no_iterations_evaluate_the_initial_design():
    result = do.optimize(small(iterations=0))
    assert result.iterations == 0 and not result.converged
    assert len(result.history) == (1 if WORLD.rank == 0 else 0)


def test_passive_cells_stay_solid():
    result = do.optimize(small("arms.passive=0.05", iterations=4))
    for k, arm in result.arms.items():
        assert arm.mesh.passive.sum() == 2 * 2 * 4  # two columns of four cells at both ends
        assert (result.x_phys[k][arm.mesh.passive] == 1.0).all()


@pytest.mark.serial
def test_stiffening_is_looked_at_again_for_the_final_design():
    """Solid arms need none of it; the light ones that remain do."""
    light = ["objective.kind=mass", "objective.gradient=exact", "constraints.deviation=0.04"]
    light += ["design.initial=1.0", "design.volume_fraction=1.0", "simulation.stiffening=auto"]
    before = do.optimize(small(*SMALLEST, *light, iterations=0))
    after = do.optimize(small(*SMALLEST, *light, iterations=3))
    asked = [next(iter(one.arms.values())).stiffening for one in (before, after)]
    assert not asked[0].on and asked[0].estimate < STIFFNESS_CHANGE
    assert asked[1].on and asked[1].estimate > STIFFNESS_CHANGE
    place = small(*SMALLEST, "simulation.stiffening=true"), after.partition
    arms = do.build_arms(*place, do.Profile())
    evaluation, _ = do.evaluate(*place, arms, after.x_phys, do.Profile(), simulated=True)
    # Both are simulated to 1e-2 of the tolerance, from other starts.
    assert after.evaluation.max_deviation == pytest.approx(evaluation.max_deviation, rel=3e-3)


@pytest.mark.serial
def test_a_design_that_cannot_be_simulated_any_more_loses_nothing(monkeypatch):
    """With stiffening at the end: the design before is returned."""
    settings = ["objective.kind=mass", "objective.gradient=exact", "constraints.deviation=0.04"]
    settings += ["simulation.stiffening=auto", "design.initial=1.0", "design.volume_fraction=1.0"]
    whole, fails = Iterate.begin_anew, []

    def failing(self):
        evaluate = self.evaluate
        self.evaluate = lambda: fails.append(self.iteration) or give_up()
        try:
            return whole(self)
        finally:
            self.evaluate = evaluate

    def give_up():
        raise ConvergenceError("the motion cannot be simulated")

    monkeypatch.setattr(Iterate, "begin_anew", failing)
    result = do.optimize(small(*SMALLEST, *settings, iterations=3))
    assert fails and result.iterations == 3
    assert np.isfinite(result.evaluation.max_deviation)
    asked = next(iter(result.arms.values())).stiffening
    assert not asked.on and asked.estimate > STIFFNESS_CHANGE  # told, and left out


@pytest.mark.serial
def test_what_rounding_changes_is_forgotten():
    """Starts that are 1e-10 apart lead to the same designs, in the same bits; 1e-6 does not."""
    starts = 0.5, 0.5 + 1e-10, 0.5 + 1e-6
    runs = [do.optimize(small(*SMALLEST, f"design.initial={x!r}", iterations=4)) for x in starts]
    plain, near, far = (np.concatenate(list(run.x_phys.values())) for run in runs)
    assert np.array_equal(near, plain) and not np.array_equal(far, plain)


@pytest.mark.serial
def test_a_step_without_a_motion_is_made_shorter(monkeypatch):
    """Three times a quarter as long; then the run ends with the design that it has, and says so."""
    tried, lengths, fails = Evaluator.tried, [], [2]

    def failing(self, x):
        if self.solutions:
            lengths.append(x)
            if len(lengths) <= fails[0]:
                self.start = self.solutions, {}
                raise ConvergenceError("too weak")
        return tried(self, x)

    monkeypatch.setattr(Evaluator, "tried", failing)
    result = do.optimize(small(*SMALLEST, iterations=1))
    assert result.iterations == 1
    start = np.full_like(lengths[0], 0.5)
    longest = [np.abs(x - start).max() for x in lengths[:3]]
    # The first may go 0.9 of the way to the asymptotes at most.
    half = 0.51 * 10.0**-DECIMALS  # of the last decimal of a design variable
    assert longest[1:] == pytest.approx([0.999 * 0.05, 0.999 * 0.0125], abs=half)
    assert 0.1 < longest[0] <= 0.18
    lengths.clear()
    fails[0] = 4
    ended = do.optimize(small(*SMALLEST, iterations=5))
    assert ended.iterations == 0 and ended.stop_code is StopCode.STUCK
    assert "no step leads on (too weak)" in ended.stop_reason


@pytest.mark.slow
# With one threshold grey edges stay that are as good as any: 0.103; it keeps no width.
@pytest.mark.parametrize(("kind", "grayness"), [("heaviside", 0.11), ("robust", 0.02)])
def test_projection_ends_crisp(kind, grayness):
    """From all grey to no grey with volumes kept, and as good as without a projection or better."""
    # Cut it is the same design, but for cells that meet in corners alone: cut it is without them.
    statics = ["objective.kind=static", "arms.cells=[60,8]", "design.filter_radius=0.025"]
    sharp = ["design.continuation=15", "design.sharpness=64", f"design.projection={kind}"]
    result = do.optimize(small(*statics, *sharp, iterations=250))
    grey = do.optimize(small(*statics, iterations=30))
    if WORLD.rank == 0:
        last = result.history[-1]
        assert last.grayness < grayness < 0.2 < grey.history[-1].grayness
        assert last.volume_fraction == pytest.approx(0.5, abs=1e-3)
        assert result.evaluation.max_deviation < grey.evaluation.max_deviation
    cut = {k: arm.contacts(result.x_phys[k] > 0.5) for k, arm in result.arms.items()}
    contacts = WORLD.allreduce(sum(one.count for one in cut.values()))
    rise = result.crisp.objective / result.evaluation.objective - 1.0
    assert rise > 0.05 if contacts else abs(rise) < 0.02
    assert result.evaluation.objective < grey.evaluation.objective


def test_bounds_out_of_reach_are_told():
    """No design of half the material is so stiff: the run says so."""
    result = do.optimize(small("objective.kind=static", "constraints.tip_deflection=1e-6"))
    assert max(result.evaluation.constraints) > 10.0
    assert not result.converged
    value = 1e6 * max(result.evaluation.values_of("tip_deflection"))
    assert value > 10.0
    assert "tip deflection of arm1" in result.violated
    assert "of 0.001 mm: " in result.violated
    assert result.violated in result.stop_reason
    kept = do.optimize(small("objective.kind=static", "constraints.tip_deflection=1.0"))
    assert kept.violated == "" and "not met" not in kept.stop_reason


def test_resume_gives_the_same_bits(shared_tmp_path, monkeypatch):
    """Interrupted after any iteration, whatever was saved last: the same designs and history."""
    monkeypatch.setattr("dolfinopt.optimization.loop.CHECKPOINT_SECONDS", 0.0)
    folders = {name: shared_tmp_path / str(name) for name in ("whole", 0, 1, 4, 6)}
    by_root(lambda: [folder.mkdir() for folder in folders.values()])
    whole = do.optimize(small(*SMALLEST), folders["whole"])
    for stop in (0, 1, 4, 6):
        folder = folders[stop]
        interrupted = small(*SMALLEST, iterations=stop)
        do.optimize(interrupted, folder)
        resumed = do.optimize(small(*SMALLEST), folder, resume=True)
        assert_same_bits(resumed, whole)
        if WORLD.rank == 0:
            np.testing.assert_array_equal(resumed.initial_deviation, whole.initial_deviation)


# Sharper in every iteration, but not so sharp that arms fall apart, which are slow to simulate.
GENTLE = ["design.continuation=2", "design.sharpness=4.0", "design.filter_radius=0.05"]
ROBUST = "design.projection=robust"
# One line an option of which the next iteration remembers something.
REMEMBERED = [
    ["arms.element=incompatible", "simulation.stiffening=true"],
    ["arms.element=quadratic"],
    ["reduction.method=modal"],
    ["reduction.method=modal", "arms.arm2.design=arm1"],
    ["reduction.method=krylov", "reduction.coordinates=3"],
    ["reduction.method=balanced", "reduction.coordinates=3"],
    ["objective.kind=static"],
    ["objective.kind=deviation"],
    ["objective.kind=effort", "constraints.deviation=8e-3"],
    ["objective.kind=mass", "constraints.peak_force=[20.0,30.0,20.0]", "constraints.settling=0.1"],
    ["objective.kind=mass", "constraints.deviation=0.05", "constraints.stress=60e6"],
    ["objective.kind=settling", "objective.gradient=exact", "constraints.mass=1.7"],
    ["objective.kind=eigenfrequency"],
    ["objective.kind=eigenfrequency", "objective.follow=true", *GENTLE, ROBUST],
    ["objective.kind=eigenfrequency", "objective.follow=true", "arms.arm2.design=arm1"],
    ["objective.kind=eigenfrequency", "arms.arm1.rigid=true"],
    ["constraints.first_frequency=5.0", "constraints.tip_deflection=6e-5"],
    [*GENTLE, "design.projection=heaviside"],
    [*GENTLE, ROBUST],
    ["scenarios=[{changes=['payload.mass=3']}, {changes=['motion.flattening=0.5']}]"],
]
OPTIONS = pytest.mark.parametrize("overrides", REMEMBERED, ids=" ".join)


@pytest.mark.slow
@pytest.mark.serial
@OPTIONS
def test_every_option_resumes_in_the_same_bits(overrides, shared_tmp_path):
    """Eigenvectors of every arm and place, the projection's sharpness, all are remembered."""
    settings = [*SMALLEST, *overrides]
    whole = do.optimize(small(*settings, iterations=3))
    do.optimize(small(*settings, iterations=1), shared_tmp_path)
    resumed = do.optimize(small(*settings, iterations=3), shared_tmp_path, resume=True)
    assert_same_bits(resumed, whole)
    assert str(resumed.evaluation) == str(whole.evaluation)
    np.testing.assert_array_equal(resumed.initial_deviation, whole.initial_deviation)


def optimized_alone(scene):
    """Return the designs of one rank and their evaluation as text."""
    alone = do.optimize(scene, world=MPI.COMM_SELF)
    return alone.x_phys, str(alone.evaluation)


@pytest.mark.skipif(WORLD.size == 1, reason="needs more than one rank")
@OPTIONS
def test_every_option_gives_the_same_bits_on_any_number_of_ranks(overrides):
    settings = [*SMALLEST, *overrides]
    together = do.optimize(small(*settings, iterations=2))
    designs, evaluation = on_root(WORLD, optimized_alone, small(*settings, iterations=2))
    for k in together.x_phys:
        np.testing.assert_array_equal(together.x_phys[k], designs[k])
    assert str(together.evaluation) == evaluation


def rows_of(folder):
    """Return how many designs a run has told of, once it has something to go on from."""
    history = folder / "history.csv"
    if not (folder / checkpoint.NAME).exists() or not history.exists():
        return 0
    return history.read_text().count("\n") - 1


@pytest.mark.serial
@pytest.mark.slow
def test_sigkill_and_resume(tmp_path):
    """Killed at any moment, a resumed run writes the same design to the last bit."""
    changes = [*QUICK, "arms.cells=[24,3]", "optimizer.max_iterations=20"]
    line = ["optimize", TWO_ARM, *overrides(*changes), "--no-plots", "--out"]
    run(*line, tmp_path / "whole")
    folder = tmp_path / "killed"
    process = subprocess.Popen(command(*line, folder), env=environment())
    deadline = time.monotonic() + 60.0
    while rows_of(folder) < 4 and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL  # it was still at work
    run(*line, folder, "--resume")
    with np.load(tmp_path / "whole" / "design.npz") as a, np.load(folder / "design.npz") as b:
        assert a.files == b.files
        for key in a.files:
            np.testing.assert_array_equal(a[key], b[key])


def test_damaged_checkpoint(shared_tmp_path):
    by_root(lambda: (shared_tmp_path / checkpoint.NAME).write_bytes(b"PK\x03\x04 no archive"))
    with pytest.raises(do.InputError, match="cannot read this checkpoint"):
        do.optimize(small(), shared_tmp_path, resume=True)
