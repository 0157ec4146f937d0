"""Cases: known by what they compute, done once, resumed, and the same on any number of ranks."""

import logging
import pickle

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM, refusal
from studies import COARSE

import dolfinopt as do
from dolfinopt import disk
from dolfinopt.optimization import iterate
from dolfinopt.optimization import loop as optimization
from dolfinopt.output import checkpoint
from dolfinopt.responses import evaluation
from dolfinopt.study import cases as computing
from dolfinopt.study.cases import Case, run_cases, scene_content, simulate_scenarios

WORLD, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
TOLERANCE = 1e-3  # of the coordinates
SMALL = [*COARSE, "optimizer.max_iterations=3", f"simulation.tolerance={TOLERANCE}"]
alone = pytest.mark.serial  # ranks have no part in it


def scene(*overrides):
    return do.load_scene(TWO_ARM, [*SMALL, *overrides])


def assert_close(one, other):
    """Both are right to the tolerance in the coordinates; compliance is their square."""
    assert one.compliance == pytest.approx(other.compliance, rel=4.0 * TOLERANCE)
    assert one.max_deviation == pytest.approx(other.max_deviation, rel=2.0 * TOLERANCE)


def assert_same(one, other):
    """Both have the same bits."""
    assert one.compliance == other.compliance and one.max_deviation == other.max_deviation
    with np.load(one.design) as a, np.load(other.design) as b:
        assert a.files == b.files
        for key in a.files:
            np.testing.assert_array_equal(a[key], b[key])


class Killed(Exception):
    """Ends a run as a signal would."""


def killed(*args, **kwargs):
    raise Killed


CHANGES = {
    "material": "material.density=2701",
    "interpolation": "interpolation.penalty=3.1",
    "arms": "arms.arm2.length=1.01",
    "motion": "motion.flattening=0.9",
    "payload": "payload.mass=6.0001",
    "forces": 'forces=[{arm="arm2", force=[1.0, 0.0]}]',
    "damping": "damping.stiffness_proportional=1e-4",
    "reduction": "reduction.coordinates=5",
    "simulation": "simulation.tolerance=2e-4",
    "objective": "objective.load_cases=29",
    "constraints": "constraints.first_frequency=1.0",
    "design": "design.initial=0.4",
    "optimizer": "optimizer.max_iterations=4",
    "feed_forward": "feed_forward.kind=tip",
    "control": "control={stiffness=[1e3, 1e3, 1e3], damping=[1.0, 1.0, 1.0]}",
    "scenarios": "scenarios=[{changes=['payload.mass=4']}]",
}


@alone
def test_every_value_is_part_of_the_key():
    """But the name; closures and joints are tables of other machines."""
    known = Case(scene()).key
    assert Case(scene('name="another"'), label="b").key == known
    assert {*scene_content(scene())} == {*CHANGES, "closures", "joints"}
    for change in CHANGES.values():
        assert Case(scene(change)).key != known
    spatial = TWO_ARM.parent / "spatial_arm.toml"
    other = "joints.elbow.origin=[0, 0, 0.01]"
    assert Case(do.load_scene(spatial)).key != Case(do.load_scene(spatial, [other])).key


@alone
def test_action_and_design_are_part_of_the_key(tmp_path):
    first, second = tmp_path / "a.npz", tmp_path / "b.npz"
    first.write_bytes(b"one")
    second.write_bytes(b"one")
    base = scene()
    keys = {
        Case(base).key,
        Case(base, "optimize").key,
        Case(base, "sample").key,
        Case(base, "simulate", first).key,
        Case(base, "simulate", Case(base, "optimize")).key,
        Case(base, "simulate", Case(scene("payload.mass=5"), "optimize")).key,
    }
    assert len(keys) == 6
    # The content counts, not the path.
    assert Case(base, "simulate", first).key == Case(base, "simulate", second).key
    second.write_bytes(b"two")
    assert Case(base, "simulate", first).key != Case(base, "simulate", second).key


@alone
def test_files_of_the_scene_count_by_content(tmp_path):
    def key(path):
        return Case(scene('motion.path="points"', f'motion.file="{path}"')).key

    table = "t, x, y\n0, -0.9, 0\n1, 0, 0.5\n1.9, 0.9, 0\n"
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(table)
    assert key(tmp_path / "a.csv") == key(tmp_path / "b.csv")
    (tmp_path / "b.csv").write_text(table.replace("0.5", "0.6"))
    assert key(tmp_path / "a.csv") != key(tmp_path / "b.csv")


@pytest.fixture(scope="module")
def plan():
    """An optimisation's design and the initial one in three scenes."""
    made = Case(scene(), "optimize", label="made")
    others = [scene(), scene("payload.mass=4"), scene("damping.stiffness_proportional=1e-3")]
    return [
        *(Case(one, "simulate", made) for one in others),
        *(Case(one) for one in others),
    ]


@pytest.fixture(scope="module")
def done(plan, folder):
    """The plan done on all ranks together, and its folder."""
    return folder, run_cases(plan, folder, WORLD, shown=False)


@pytest.fixture
def simulated(monkeypatch):
    """The payloads of the scenes that were simulated on this rank, kg."""
    payloads = []
    whole = evaluation.simulate

    def count(scene, *others):
        payloads.append(scene.payload.mass)
        return whole(scene, *others)

    monkeypatch.setattr(evaluation, "simulate", count)
    return payloads


def test_files_and_outcomes(plan, done):
    """The optimisation that was implied has the files and bits of `optimize` on one rank."""
    folder, outcomes = done
    assert outcomes.computed == 7 and not outcomes.failures
    assert {path.name for path in folder.iterdir()} == {"cases"}
    made = outcomes[plan[0].design]
    assert made.folder == folder / "cases" / plan[0].design.key
    assert {path.name for path in made.folder.iterdir()} == {
        "checkpoint.npz", "design.npz", "history.csv", "summary.json", "trajectory.csv",
        "trajectory.npz",
        "budget.csv",
    }  # fmt: skip
    assert made.iterations == 3 and len(made.history()) == 4
    t, distance = made.deviation()
    # The file has samples; extremes are looked for between them, too.
    assert distance.max() <= made.max_deviation * (1.0 + 1e-12)
    assert abs(t[distance.argmax()] - made.max_deviation_time) <= t[1] - t[0]
    result = do.optimize(scene(), world=SELF)
    assert made.compliance == result.evaluation.compliance
    with np.load(made.design) as design:
        for k, name in enumerate(("arm1", "arm2")):
            x, y = result.arms[k].mesh.centroid.T.round(9)
            order = np.lexsort((y, x))
            np.testing.assert_array_equal(design[f"{name}/density"], result.x_phys[k][order])


@pytest.mark.skipif(WORLD.size == 1, reason="compares one rank with several")
def test_ranks_do_not_matter(plan, done, tmp_path, shared_tmp_path, simulated):
    """Done on each rank alone: the same bits as together, in any order; every job is done once."""
    _, together = done
    single = run_cases(plan[::-1], tmp_path, SELF, shown=False)
    assert single.computed == together.computed
    for case, outcome in single.by_case.items():
        assert_same(outcome, together[case])
    simulated.clear()
    run_cases(plan[3:], shared_tmp_path / "all", WORLD, shown=False)
    assert sum(WORLD.allgather(len(simulated))) == 3


def test_second_run_computes_nothing(plan, done, monkeypatch):
    folder, outcomes = done
    monkeypatch.setattr(computing, "_do", killed)
    again = run_cases([*plan, *plan], folder, WORLD, shown=False)
    assert again.computed == 0
    assert repr(again.by_case) == repr(outcomes.by_case)  # nan is not equal to nan


@alone
def test_scenarios_share_what_they_can():
    """One mesh and factorisation, one basis a reduction; results as if alone."""
    damped = "damping.stiffness_proportional=1e-3"
    scenes = [
        scene(),
        scene("payload.mass=4", "motion.flattening=0.8"),
        scene(damped),
        scene("reduction.coordinates=5", damped),
        scene("reduction.method=balanced"),
        scene("reduction.method=balanced", damped),
    ]
    counts = []
    for one, found in zip(scenes, simulate_scenarios(scenes, None)):
        counts.append(found.profile.counts)
        [single] = simulate_scenarios([one], None)
        assert_close(found.evaluation, single.evaluation)
        assert found.scene is one and found.trajectory.scene is one
    assert [c.factorisations for c in counts][:4] == [2, 0, 0, 0]
    assert [c.eigenproblems for c in counts][:4] == [2, 0, 0, 2]


@alone
def test_chosen_coordinates_are_those_of_each_scene():
    """Nothing that "auto" came to in one scene is left in the next."""
    auto = "reduction.coordinates=auto"
    strict, loose = (scene(auto, f"reduction.tolerance={value}") for value in (0.002, 0.05))
    first, found = simulate_scenarios([strict, loose], None)
    [single] = simulate_scenarios([loose], None)
    assert found.choice == single.choice and found.evaluation == single.evaluation
    assert first.choice.coordinates > found.choice.coordinates


@alone
def test_simulations_that_are_not_kept_have_the_same_figures(plan, done, tmp_path):
    """Two files in place of five, the same figures; all files once they are to be kept."""
    _, outcomes = done
    case = plan[3]
    brief = run_cases([case], tmp_path, SELF, shown=False, keep=False)[case]
    assert {path.name for path in brief.folder.iterdir()} == {"deviation.npz", "summary.json"}
    assert_close(brief, outcomes[case])
    assert np.array_equal(brief.deviation(), outcomes[case].deviation())
    assert run_cases([case], tmp_path, SELF, shown=False, keep=False).computed == 0
    kept = run_cases([case], tmp_path, SELF, shown=False)
    assert kept.computed == 1 and kept[case].design.exists()
    assert run_cases([case], tmp_path, SELF, shown=False, keep=False).computed == 0


@alone
@pytest.mark.parametrize("where", ["between two iterations", "at the end"])
def test_interrupted_optimisation_goes_on(plan, done, tmp_path, monkeypatch, where):
    """What is computed again begins at the last checkpoint and ends in the same bits."""
    _, outcomes = done
    made = plan[0].design
    monkeypatch.setattr(optimization, "CHECKPOINT_SECONDS", 0.0)
    reached = 3
    with monkeypatch.context() as patch:
        if where == "at the end":
            patch.setattr(computing, "write_result", killed)
        else:
            reached, told = 1, []

            def stop(place):
                told.append(place)
                if len(told) == 4:  # before the job, then after each iteration
                    raise Killed

            patch.setattr(computing._Place, "check", stop)
        with pytest.raises(Killed):
            run_cases([made], tmp_path, SELF, shown=False)
    left = tmp_path / "cases" / made.key
    assert not (left / "summary.json").exists()
    assert pickle.loads(np.load(left / "checkpoint.npz")["memory"])[0].iteration == reached
    iterations = []
    step = iterate.Iterate.step
    monkeypatch.setattr(
        iterate.Iterate, "step", lambda run, *a: (iterations.append(1), step(run, *a))
    )
    # Under another name: a checkpoint does not depend on it.
    again = run_cases([Case(scene('name="another"'), "optimize")], tmp_path, SELF, shown=False)
    assert len(iterations) == 3 - reached
    assert_same(again[made], outcomes[made])
    assert [row.iteration for row in again[made].history()] == [0, 1, 2, 3]


@alone
def test_foreign_checkpoint_is_not_used(plan, done, tmp_path):
    """A checkpoint of another scene in the folder: the case begins anew."""
    _, outcomes = done
    made = plan[0].design
    left = tmp_path / "cases" / made.key
    left.mkdir(parents=True)
    checkpoint.begin(left, scene("payload.mass=1"))
    assert_same(run_cases([made], tmp_path, SELF, shown=False)[made], outcomes[made])


def test_failure_does_not_sink_the_others(plan, done, shared_tmp_path, monkeypatch):
    """The next run tries again, and what failed alone; designs that were not found are named."""
    _, outcomes = done
    whole = evaluation.simulate

    def fail_at_four(scene, *others):
        if scene.payload.mass == 4.0:
            raise do.ConvergenceError("no solution at 4 kg")
        return whole(scene, *others)

    def fail(*args, **kwargs):
        raise do.ConvergenceError("no way")

    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "simulate", fail_at_four)
        patch.setattr(computing, "optimize", fail)
        first = run_cases(plan[:6], shared_tmp_path, WORLD, shown=False)
    told = sorted(line.partition(": ")[2] for line in first.failures)
    assert told == ["made: no way"] * 3 + ["no solution at 4 kg", "no way"]
    assert first[plan[4]].failure and np.isnan(first[plan[4]].compliance)
    assert first[plan[5]].compliance == outcomes[plan[5]].compliance
    again = run_cases(plan[3:6], shared_tmp_path, WORLD, shown=False)
    assert again.computed == 1 and not again.failures
    assert_close(again[plan[4]], outcomes[plan[4]])


@alone
def test_another_run_is_refused(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(disk, "try_lock", lambda *arguments: False)
    refusal(lambda: run_cases(plan, tmp_path, SELF, shown=False), str(tmp_path), "another run")


def test_every_case_is_logged(plan, shared_tmp_path, caplog):
    log = logging.getLogger("dolfinopt.progress")
    log.propagate = True
    with caplog.at_level(logging.INFO, "dolfinopt.progress"):
        run_cases(plan[3:5], shared_tmp_path, WORLD)
        lines = [record.getMessage() for record in caplog.records]
        assert len(lines) == (2 if WORLD.rank == 0 else 0)
        for left, line in zip((1, 0), lines):
            assert "N m" in line and line.endswith(f"; {left} to go")
        caplog.clear()
        run_cases(plan[3:5], shared_tmp_path, WORLD)
        assert not caplog.records
