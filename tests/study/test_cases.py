"""Cases: known by what they compute, done once, resumed, and the same on any number of ranks."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.optimization import iterate
from dolfinopt.optimization import loop as optimization
from dolfinopt.output import checkpoint, run
from dolfinopt.responses import evaluation
from dolfinopt.study import store
from dolfinopt.study.cases import Case, scene_content
from dolfinopt.study.simulate import simulate_scenarios
from dolfinopt.study.store import run_cases

WORLD, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
SMALL = ("arms.cells=[20,3]", "optimizer.max_iterations=3", "simulation.sample=0.01")


def scene(*overrides):
    return do.load_scene(TWO_ARM, [*SMALL, *overrides])


def design_of(folder):
    with np.load(folder / "design.npz") as data:
        return {key: data[key] for key in data.files}


def assert_same_design(one, other):
    assert one.keys() == other.keys()
    for key, value in one.items():
        np.testing.assert_array_equal(value, other[key])


def forbid(monkeypatch):
    """Let every attempt to compute something fail."""

    def refuse(*args, **kwargs):
        raise AssertionError("computed again")

    for module, name in ((run, "optimize"), (evaluation, "simulate_batch")):
        monkeypatch.setattr(module, name, refuse)


# -- keys ------------------------------------------------------------------------------------


@pytest.mark.serial  # ranks have no part in it
def test_name_is_no_part_of_the_key():
    assert Case(scene()).key == Case(scene('name="another"')).key
    assert Case(scene(), label="a") == Case(scene('name="b"'), label="b")


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize(
    "change",
    [
        "material.density=2701",
        "interpolation.penalty=3.1",
        "arms.arm2.length=1.01",
        "motion.flattening=0.9",
        "payload.mass=6.0001",
        "damping.stiffness_proportional=1e-4",
        "reduction.coordinates=5",
        "simulation.tolerance=2e-4",
        "objective.load_cases=29",
        "constraints.first_frequency=1.0",
        "design.initial=0.4",
        "optimizer.max_iterations=4",
        "control={stiffness=[1e3, 1e3, 1e3], damping=[1.0, 1.0, 1.0]}",
        "scenarios=[{changes=['payload.mass=4']}]",
    ],
)
def test_every_value_is_part_of_the_key(change):
    assert Case(scene()).key != Case(scene(change)).key


@pytest.mark.serial  # ranks have no part in it
def test_every_table_is_tried_above():
    tried = set(scene_content(scene()))
    assert tried == {
        "material", "interpolation", "arms", "motion", "payload", "damping", "reduction",
        "simulation", "objective", "constraints", "design", "optimizer", "scenarios", "control",
        "closure",  # a table like the others, which asks for another motion
        "joints",  # of machines in space, below
    }  # fmt: skip


@pytest.mark.serial  # ranks have no part in it
def test_joints_are_part_of_the_key():
    path = TWO_ARM.parent / "spatial_arm.toml"
    keys = {
        Case(do.load_scene(path, change)).key
        for change in ([], ["joints.elbow.axis=[0, 0, -1]"], ["joints.elbow.origin=[0, 0, 0.01]"])
    }
    assert len(keys) == 3


@pytest.mark.serial  # ranks have no part in it
def test_action_and_design_are_part_of_the_key(tmp_path):
    first, second = tmp_path / "a.npz", tmp_path / "b.npz"
    first.write_bytes(b"one")
    second.write_bytes(b"one")
    base = scene()
    keys = {
        Case(base).key,
        Case(base, "optimize").key,
        Case(base, "compare").key,
        Case(base, "simulate", first).key,
        Case(base, "simulate", Case(base, "optimize")).key,
        Case(base, "simulate", Case(scene("payload.mass=5"), "optimize")).key,
    }
    assert len(keys) == 6
    # The content counts, not the path.
    assert Case(base, "simulate", first).key == Case(base, "simulate", second).key
    second.write_bytes(b"two")
    assert Case(base, "simulate", first).key != Case(base, "simulate", second).key


@pytest.mark.serial  # ranks have no part in it
def test_files_of_the_scene_count_by_content(tmp_path):
    def key(path):
        return Case(scene('motion.path="points"', f'motion.file="{path}"')).key

    table = "t, x, y\n0, -0.9, 0\n1, 0, 0.5\n1.9, 0.9, 0\n"
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(table)
    assert key(tmp_path / "a.csv") == key(tmp_path / "b.csv")
    (tmp_path / "b.csv").write_text(table.replace("0.5", "0.6"))
    assert key(tmp_path / "a.csv") != key(tmp_path / "b.csv")


# -- doing them ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plan():
    """An optimisation, its design and the initial one in three scenes, and a comparison."""
    made = Case(scene(), "optimize", label="made")
    others = [scene(), scene("payload.mass=4"), scene("damping.stiffness_proportional=1e-3")]
    return [
        *(Case(one, "simulate", made) for one in others),
        *(Case(one) for one in others),
        Case(scene("reduction.method=modal"), "compare"),
    ]


@pytest.fixture(scope="module")
def done(plan, tmp_path_factory):
    """The plan done on all ranks together, and its folder."""
    path = tmp_path_factory.mktemp("cases") if WORLD.rank == 0 else None
    folder = WORLD.bcast(path, root=0)
    return folder, run_cases(plan, folder, WORLD, shown=False)


def test_files_and_outcomes(plan, done):
    folder, outcomes = done
    assert outcomes.computed == 8 and not outcomes.failures  # the optimisation was implied
    made = plan[0].design
    files = {path.name for path in outcomes[made].folder.iterdir()}
    assert files == {
        "checkpoint.npz", "design.npz", "history.csv", "summary.json", "trajectory.csv",
        "trajectory.npz",
    }  # fmt: skip
    assert outcomes[made].folder == folder / "cases" / made.key
    assert outcomes[made].iterations == 3 and len(outcomes[made].history()) == 4
    t, distance = outcomes[made].deviation()
    # The file has samples; extremes are looked for between them, too.
    assert distance.max() <= outcomes[made].max_deviation * (1.0 + 1e-12)
    assert distance.max() == pytest.approx(outcomes[made].max_deviation, rel=1e-3)
    assert abs(t[distance.argmax()] - outcomes[made].max_deviation_time) <= t[1] - t[0]
    assert outcomes[plan[0]].case is plan[0]


def test_same_as_without_cases(plan, done):
    """The optimisation has the bits of `optimize` on one rank."""
    _, outcomes = done
    made = plan[0].design
    result = do.optimize(scene(), world=SELF)
    design = design_of(outcomes[made].folder)
    for k, name in enumerate(("arm1", "arm2")):
        arm = result.arms[k]
        order = np.lexsort((arm.mesh.centroid[:, 1].round(9), arm.mesh.centroid[:, 0].round(9)))
        np.testing.assert_array_equal(design[f"{name}/density"], result.x_phys[k][order])
    assert outcomes[made].compliance == result.evaluation.compliance
    assert outcomes[made].max_deviation == result.evaluation.max_deviation


def test_ranks_do_not_matter(plan, done, tmp_path):
    """Done on each rank alone: the same bits as together, in any order."""
    _, together = done
    plan = plan[::-1]
    alone = run_cases(plan, tmp_path, SELF, shown=False)
    assert alone.computed == together.computed
    for case, outcome in alone.by_case.items():
        other = together[case]
        assert outcome.bases == other.bases
        if case.action != "compare":
            assert outcome.compliance == other.compliance
            assert outcome.max_deviation == other.max_deviation
            assert_same_design(design_of(outcome.folder), design_of(other.folder))


def test_second_run_computes_nothing(plan, done, monkeypatch):
    folder, outcomes = done
    forbid(monkeypatch)
    again = run_cases([*plan, *plan], folder, WORLD, shown=False)
    assert again.computed == 0
    assert repr(again.by_case) == repr(outcomes.by_case)  # nan is not equal to nan


def test_comparison(plan, done):
    """The first modes of modal truncation are those of many Craig-Bampton coordinates."""
    _, outcomes = done
    bases = outcomes[plan[-1]].bases
    assert [one.arm for one in bases] == ["arm1", "arm2"]
    for one in bases:
        np.testing.assert_allclose(one.mac, 1.0, atol=1e-4)
        np.testing.assert_allclose(one.frequency, 0.0, atol=1e-3)
        # Four modes lack what they need to bend under a moment at the tip.
        assert one.compliance[2] > 0.02


def assert_close(one, other):
    """Both are right to `simulation.tolerance` in the coordinates; compliance is their square."""
    tolerance = scene().simulation.tolerance
    assert one.compliance == pytest.approx(other.compliance, rel=4.0 * tolerance)
    assert one.max_deviation == pytest.approx(other.max_deviation, rel=2.0 * tolerance)


@pytest.mark.serial  # ranks have no part in it
def test_scenarios_share_what_they_can():
    """One mesh and factorisation, one basis and batch a reduction; results as if alone."""
    scenes = [
        scene(),
        scene("payload.mass=4", "motion.flattening=0.8"),
        scene("damping.stiffness_proportional=1e-3"),
        scene("reduction.coordinates=5", "damping.stiffness_proportional=1e-3"),
        scene("reduction.method=modal"),
    ]
    counts = []
    for one, found in zip(scenes, simulate_scenarios(scenes, None)):
        counts.append(found.profile.counts)
        [alone] = simulate_scenarios([one], None)
        assert_close(found.evaluation, alone.evaluation)
        assert found.scene is one and found.trajectory.scene is one
    assert [c.factorisations for c in counts] == [2, 0, 0, 0, 0]
    assert [c.eigenproblems for c in counts] == [2, 0, 0, 2, 2]
    assert [c.simulations for c in counts] == [3, 0, 0, 1, 1]


@pytest.fixture
def batches(monkeypatch):
    """How many scenes every call of the simulation took on this rank."""
    sizes = []
    whole = evaluation.simulate_batch

    def count(scenes, *args, **options):
        sizes.append(len(scenes))
        return whole(scenes, *args, **options)

    monkeypatch.setattr(evaluation, "simulate_batch", count)
    return sizes


@pytest.mark.serial  # ranks have no part in it
def test_sweep_of_nine_is_one_batch(tmp_path, batches):
    masses = np.linspace(4.0, 8.0, 9)
    sweep = [Case(scene(f"payload.mass={mass}")) for mass in masses]
    outcomes = run_cases(sweep, tmp_path, SELF, shown=False)
    assert batches == [9]
    # The first of the batch bears its account: one arm is factorised once, the other, too.
    counts = [
        json.loads((outcomes[case].folder / "summary.json").read_text())["counts"]
        for case in sorted(sweep, key=lambda case: case.key)
    ]
    assert [one["simulations"] for one in counts] == [9] + 8 * [0]
    assert [one["factorisations"] for one in counts] == [2] + 8 * [0]
    # In any order the same company, and nothing is computed again.
    again = run_cases(sweep[::-1], tmp_path, SELF, shown=False)
    assert again.computed == 0 and batches == [9]


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize(
    "key", ["material.density", "material.young_modulus", "arms.arm1.thickness"]
)
def test_what_scales_the_arms_is_one_batch(tmp_path, batches, key):
    """Against arms that are assembled and reduced anew."""
    values = {"density": (2500, 2900), "young_modulus": (60e9, 75e9), "thickness": (0.009, 0.012)}
    sweep = [Case(scene(f"{key}={value}")) for value in values[key.rpartition(".")[2]]]
    outcomes = run_cases(sweep, tmp_path, SELF, shown=False)
    assert batches == [2]
    for case in sweep:
        [alone] = simulate_scenarios([case.scene], None)
        assert_close(outcomes[case], alone.evaluation)


@pytest.mark.serial  # ranks have no part in it
def test_batches_have_one_basis():
    """A basis that depends on frequencies, or a frequency that is asked for, is not scaled."""
    key = Case(scene()).batch_key
    light = "material.density=2600"
    assert Case(scene(light, "payload.mass=4")).batch_key == key
    others = ["reduction.coordinates=5", "material.poisson_ratio=0.3", "design.initial=0.4"]
    assert key not in {Case(scene(other)).batch_key for other in others}
    krylov = ("reduction.method=krylov", "reduction.shifts=[30]")
    for settings in (krylov, ("objective.kind=static",), ("constraints.first_frequency=1",)):
        one, other = Case(scene(*settings)), Case(scene(*settings, light))
        assert one.batch_key != other.batch_key
    damped = "damping.stiffness_proportional=1e-3"
    assert Case(scene(damped)).batch_key == key
    gramian = "reduction.method=balanced"
    assert Case(scene(gramian, damped)).batch_key != Case(scene(gramian)).batch_key


@pytest.mark.serial  # ranks have no part in it
def test_chosen_coordinates_are_those_of_each_scene():
    """Nothing that "auto" came to in one scene is left in the next."""
    auto = "reduction.coordinates=auto"
    strict, loose = (scene(auto, f"reduction.tolerance={value}") for value in (0.002, 0.05))
    first, found = simulate_scenarios([strict, loose], None)
    [alone] = simulate_scenarios([loose], None)
    assert found.choice == alone.choice and found.evaluation == alone.evaluation
    assert first.choice.coordinates > found.choice.coordinates
    assert Case(strict).batch_key == Case(strict).key


@pytest.mark.serial  # ranks have no part in it
def test_growing_study_computes_the_new_cases_alone(plan, done, tmp_path, batches):
    """What is there stays as it is, and all are right to the tolerance in any company."""
    _, outcomes = done
    [case, *_] = together = plan[3:6]
    alone = run_cases([case], tmp_path, SELF, shown=False)
    kept = alone[case].design.stat().st_mtime_ns
    after = run_cases(together, tmp_path, SELF, shown=False)
    assert batches == [1, 2] and after.computed == 2
    assert after[case].design.stat().st_mtime_ns == kept
    assert after[case].compliance == alone[case].compliance
    for one in together:
        assert_close(after[one], outcomes[one])
    assert run_cases(plan[3:5], tmp_path, SELF, shown=False).computed == 0


def test_batch_interrupted_while_it_is_written(plan, done, shared_tmp_path, monkeypatch, batches):
    """Cases that are missing are computed with the company of those that are there."""
    from dolfinopt.output import run_folder as results

    _, outcomes = done
    together = plan[3:6]
    written = []
    whole = results.write_simulation

    class Killed(Exception):
        pass

    def stop(*args, **kwargs):
        if written:
            raise Killed
        written.append(whole(*args, **kwargs))

    if WORLD.rank == 0:
        with monkeypatch.context() as patch:
            patch.setattr(results, "write_simulation", stop)
            with pytest.raises(Killed):
                run_cases(together, shared_tmp_path, SELF, shown=False)
        batches.clear()
    WORLD.barrier()
    again = run_cases(together, shared_tmp_path, WORLD, shown=False)
    assert again.computed == 2 and sum(WORLD.allgather(sum(batches))) == 3
    for case in together:
        assert again[case].compliance == outcomes[case].compliance
        np.testing.assert_array_equal(again[case].deviation(), outcomes[case].deviation())


def test_damaged_summary_is_done_anew(plan, done, shared_tmp_path):
    folder, outcomes = done
    case = plan[3]
    if WORLD.rank == 0:
        shutil.copytree(folder / "cases", shared_tmp_path / "cases")
        name = outcomes[case].folder.name
        (shared_tmp_path / "cases" / name / "summary.json").write_text('{"seconds": {')
    WORLD.barrier()
    again = run_cases(plan, shared_tmp_path, WORLD, shown=False)
    assert again.computed == 1
    assert again[case].compliance == outcomes[case].compliance


# -- interruptions and failures --------------------------------------------------------------


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("where", ["before the first iteration", "between two", "at the end"])
def test_interrupted_run_goes_on(plan, done, tmp_path, monkeypatch, where):
    """What is computed again begins at the last checkpoint and ends in the same bits."""
    _, outcomes = done
    made = plan[0].design
    stop = {"before the first iteration": 0, "between two": 2, "at the end": None}[where]
    monkeypatch.setattr(optimization, "CHECKPOINT_INTERVAL", 0.0)

    class Killed(Exception):
        pass

    def tell(progress, label="", done=0, *args, **kwargs):
        if done == stop and not kwargs:
            raise Killed

    def no_summary(*args, **kwargs):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(store.Progress, "tell", tell)
        if stop is None:
            from dolfinopt.output import run_folder as results

            patch.setattr(results, "write_summary", no_summary)
        with pytest.raises(Killed):
            run_cases([made], tmp_path, SELF, shown=False)
    left = tmp_path / "cases" / made.key
    assert not (left / "summary.json").exists()
    reached = int(np.load(left / "checkpoint.npz")["iteration"])
    assert reached == {0: -1, 2: 1, None: 3}[stop]

    iterations = []
    step = iterate.Iterate._update
    monkeypatch.setattr(
        iterate.Iterate, "_update", lambda run, *a: (iterations.append(1), step(run, *a))
    )
    # Under another name: a checkpoint does not depend on it.
    renamed = Case(scene('name="another"'), "optimize")
    again = run_cases([renamed], tmp_path, SELF, shown=False)
    assert len(iterations) == 3 - max(reached, 0)
    assert again[made].compliance == outcomes[made].compliance
    assert_same_design(design_of(left), design_of(outcomes[made].folder))
    assert [row.iteration for row in again[made].history()] == [0, 1, 2, 3]


@pytest.mark.serial  # ranks have no part in it
def test_foreign_checkpoint_is_not_used(plan, done, tmp_path):
    """A checkpoint of another scene in the folder: the case begins anew."""
    _, outcomes = done
    made = plan[0].design
    left = tmp_path / "cases" / made.key
    left.mkdir(parents=True)
    checkpoint.begin(left, scene("payload.mass=1"))
    assert run_cases([made], tmp_path, SELF, shown=False)[made].compliance == (
        outcomes[made].compliance
    )


def test_failure_does_not_sink_the_others(plan, done, shared_tmp_path, monkeypatch):
    _, outcomes = done
    whole = evaluation.simulate_batch

    def fail_at_four(scenes, *args, **options):
        error = do.ConvergenceError("no solution at 4 kg")
        found = whole(scenes, *args, **options)
        return [error if s.payload.mass == 4.0 else one for s, one in zip(scenes, found)]

    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "simulate_batch", fail_at_four)
        first = run_cases(plan[3:6], shared_tmp_path, WORLD, shown=False)
    assert [one.failure for one in first.failures] == ["no solution at 4 kg"]
    assert first[plan[4]].failure and np.isnan(first[plan[4]].compliance)
    assert first[plan[5]].compliance == outcomes[plan[5]].compliance
    # The next run tries again, and what failed alone.
    again = run_cases(plan[3:6], shared_tmp_path, WORLD, shown=False)
    assert again.computed == 1 and not again.failures
    assert again[plan[4]].compliance == outcomes[plan[4]].compliance


def test_design_that_was_not_found(plan, shared_tmp_path, monkeypatch):
    """Simulations of a design whose optimisation failed say so."""

    def fail(*args, **kwargs):
        raise do.ConvergenceError("no way")

    monkeypatch.setattr(run, "optimize", fail)
    outcomes = run_cases(plan[:4], shared_tmp_path, WORLD, shown=False)
    assert [one.failure for one in outcomes.failures] == ["no way"] + 3 * ["made: no way"]
    assert outcomes[plan[3]].compliance > 0.0


# Another program that does a case: its folder's name is the key.
OWNER = """
import fcntl, pathlib, sys, time
place = pathlib.Path(sys.argv[1])
with open(place.parent / ".lock", "a+b") as stream:
    fcntl.lockf(stream, fcntl.LOCK_EX, 1, int(place.name[:12], 16))
    print("locked", flush=True)
    time.sleep(0.3)
    (place / "part").rename(place / "summary.json")
"""


def test_case_in_other_hands_is_waited_for(plan, done, shared_tmp_path):
    """A locked case is left to its owner, whose result is taken."""
    _, outcomes = done
    case = plan[3]
    if WORLD.rank > 0:
        run_cases([case], shared_tmp_path, WORLD, shown=False)
        return
    place = shared_tmp_path / "cases" / case.key
    place.mkdir(parents=True)
    data = json.loads((outcomes[case].folder / "summary.json").read_text())
    (place / "part").write_text(json.dumps(data | {"compliance": 12345.0}))
    owner = [sys.executable, "-c", OWNER, str(place)]
    with subprocess.Popen(owner, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "locked\n"
        found = run_cases([case], shared_tmp_path, WORLD, shown=False)
    assert found[case].compliance == 12345.0
    assert outcomes[case].compliance != 12345.0


def test_plain_lines_tell_of_every_case(plan, shared_tmp_path, capsys):
    run_cases(plan[3:5], shared_tmp_path, WORLD)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == (2 if WORLD.rank == 0 else 0)
    for k, line in enumerate(lines, 1):
        assert line.startswith(f"{k}/2") and "N m" in line
