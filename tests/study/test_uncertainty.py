"""Random uncertainties: what is asked, what each sample gives, tables and pictures."""

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM, by_root, overrides, refusal
from runs import run as run_command
from studies import COARSE, column, rows_of, write_uniform

import dolfinopt as do
from dolfinopt.errors import ConvergenceError
from dolfinopt.study import cases as computing
from dolfinopt.study import uncertainty
from dolfinopt.study.cases import Runner, run_cases, scales_bodies, with_sample
from dolfinopt.study.uncertainty import (
    nominal_value,
    parse_input,
    sample_cases,
    sample_texts,
    study_random,
)

WORLD, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
SMALL = [*COARSE, "optimizer.max_iterations=2", "simulation.tolerance=1e-2"]
MASS, YOUNG = "payload.mass=normal:6:0.3", "material.young_modulus=normal:70e9:2e9"
TWO = "uncertainty_payload.mass_material.young_modulus"
CHUNK = 6
alone = pytest.mark.serial  # ranks: test_ranks_do_not_matter


def scene(*overrides):
    return do.load_scene(TWO_ARM, [*SMALL, *overrides])


def run(*arguments):
    run_command("uncertainty", *arguments)


@pytest.fixture(scope="module")
def given(folder):
    """A design of solid arms in a file, which needs no optimisation."""
    return write_uniform(folder / "solid.npz", (12, 3), 1.0)


def evaluated(*overrides, density=0.5):
    """Return what `evaluate` finds in a scene with one density, arms built for it alone."""
    other = scene(*overrides)
    partition = do.partition_arms(SELF, other.cell_counts)
    arms = do.build_arms(other, partition, do.Profile())
    x = {k: arm.uniform(density) for k, arm in arms.items()}
    return do.evaluate(other, partition, arms, x, do.Profile())[0]


def test_inputs_are_cut_off_at_the_range():
    """Half a normal distribution about the key's largest value is left: mean 1 - s sqrt(2/pi)."""
    one = parse_input(scene(), "motion.flattening=normal:0.999999:0.01")
    assert (one.distribution.low, one.distribution.high) == (0.0, 1.0)
    assert one.distribution.moments[0] == pytest.approx(1.0 - 0.01 * (2.0 / np.pi) ** 0.5, abs=1e-6)
    assert one.axis == "motion.flattening [-]"
    young = parse_input(scene(), "arms.arm2.young_modulus=lognormal:70e9:0.05")
    assert young.axis == "arms.arm2.young_modulus [Pa]" and young.distribution.low == 1.0


def test_nominal_values_and_a_sample_out_of_reach():
    given = scene("arms.arm2.density=2600.0", "arms.arm2.thickness=0.02")
    nominal = {"payload.mass": 6.0, "arms.arm2.density": 2600.0, "arms.arm1.density": 2700.0,
               "arms.1.thickness": 0.02, "arms.height": 0.06}  # fmt: skip
    assert {key: nominal_value(given, key) for key in nominal} == nominal
    assert np.isnan(nominal_value(given, "arms.density"))
    assert with_sample(scene(), (), 0) == scene()
    words = "--random", "sample 2", "motion.radius=5.0"
    refusal(lambda: with_sample(scene(), ("motion.radius=5.0",), 2), *words)


@pytest.fixture
def chunks(monkeypatch):
    monkeypatch.setattr(uncertainty, "CHUNK", CHUNK)


def masses(count):
    return 6.0 + 0.3 * np.sin(np.arange(count, dtype=float))


def payloads(count, *overrides, design=None):
    """Return cases of samples of the payload's mass."""
    samples = sample_texts(["payload.mass"], masses(count)[:, None])
    return sample_cases(scene(*overrides), samples, "it", design)


def respond(cases, folder, comm=WORLD):
    """Return what came of all samples (3, 1 + n), how many were computed, and what failed."""
    outcomes = run_cases(cases, folder, comm, shown=False)
    found = [outcomes[case] for case in cases]
    arrays = np.concatenate([np.stack([*one.samples.values()]) for one in found], axis=1)
    return arrays, outcomes.computed, [line for o in found for line in o.failures]


@alone
@pytest.mark.parametrize(
    ("changes", "scaling"),
    [
        ({"payload.mass": 7.0, "motion.duration": 2.1, "arms.arm2.young_modulus": 60e9}, True),
        ({"arms.thickness": 0.009, "damping.stiffness_proportional": 1e-3}, True),
        ({"material.poisson_ratio": 0.2, "material.density": 3000.0}, False),
    ],
    ids=["scaled", "thickness", "reduced anew"],
)
def test_samples_are_scenes_by_themselves(changes, scaling, tmp_path):
    """Whether bodies are scaled or reduced anew: as `evaluate` has it."""
    base = scene("simulation.tolerance=1e-6")
    assert scales_bodies(base, changes) == scaling
    cases = sample_cases(base, sample_texts([*changes], np.array([[*changes.values()]])), "", None)
    found, computed, failures = respond(cases, tmp_path)
    assert computed == 2 and not failures
    texts = [f"{key}={value}" for key, value in changes.items()]
    each = [evaluated("simulation.tolerance=1e-6", *more) for more in ((), texts)]
    figures = [(one.compliance, one.max_deviation, one.max_deviation_time) for one in each]
    # Both are right to the tolerance in the coordinates; some of it is lost in their squares.
    np.testing.assert_allclose(found.T, figures, rtol=1e-5)
    assert np.abs(figures[1][0] / figures[0][0] - 1.0) > 1e-4  # it does matter


def test_what_is_known_is_not_done_again(chunks, given, shared_tmp_path):
    """Further samples are added to complete chunks, whose bits stay; damaged ones are done anew."""
    count = 2 * CHUNK - 1  # and the scene itself: two chunks
    first, computed, _ = respond(payloads(count), shared_tmp_path)
    assert computed == 2 * CHUNK and first.shape == (3, 2 * CHUNK)
    damaged = next((shared_tmp_path / "cases").glob("*/summary.json"))
    by_root(lambda: damaged.write_bytes(damaged.read_bytes()[:100]))
    again, computed, _ = respond(payloads(count), shared_tmp_path)
    assert computed == CHUNK
    np.testing.assert_array_equal(first, again)
    more, computed, _ = respond(payloads(count + 3, 'name="other"'), shared_tmp_path)
    assert computed == 3  # another name is the same scene
    np.testing.assert_array_equal(first, more[:, : 2 * CHUNK])
    few = CHUNK - 1
    assert respond(payloads(few, "motion.flattening=0.9"), shared_tmp_path)[1] == CHUNK
    assert respond(payloads(few, design=given), shared_tmp_path)[1] == CHUNK


@pytest.mark.skipif(WORLD.size == 1, reason="compares one rank with several")
def test_ranks_do_not_matter(chunks, given, tmp_path, shared_tmp_path):
    """The same bits, whoever does a chunk, of two designs."""
    count = 2 * CHUNK + 1
    cases = payloads(count - 1) + payloads(count - 1, design=given)
    single, *_ = respond(cases, tmp_path / "alone", SELF)
    together, computed, _ = respond(cases, shared_tmp_path / "all")
    assert computed == 2 * count
    np.testing.assert_array_equal(single, together)
    assert (single[0, :count] != single[0, count:]).all()


@alone
def test_failures_are_told_and_tried_again(chunks, given, tmp_path, monkeypatch):
    """What was found is kept for this run; the command ends with status 1."""
    honest = computing.simulate_all

    def failing(scenes, *others):
        return [
            ConvergenceError("too heavy") if scene.payload.mass > 6.25 else one
            for scene, one in zip(scenes, honest(scenes, *others), strict=True)
        ]

    cases = payloads(CHUNK - 1)
    heavy = np.flatnonzero(masses(CHUNK - 1) > 6.25) + 1
    assert 0 < len(heavy) < CHUNK - 1
    with monkeypatch.context() as patch:
        patch.setattr(computing, "simulate_all", failing)
        found, _, failures = respond(cases, tmp_path, SELF)
        with pytest.raises(ConvergenceError, match=r"sample \d+ \(payload.*\): too heavy \(and"):
            run(TWO_ARM, "--random", MASS, "--samples", 10, "--design", given, *overrides(*SMALL),
                "--out", tmp_path / "f")  # fmt: skip
    assert [line.split()[2] for line in failures] == [*map(str, heavy)]
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found[0])), heavy)
    rows = rows_of(tmp_path / "f" / "uncertainty_payload.mass.csv")
    assert len(rows) == 10 and "" in {row["solid: compliance [N m]"] for row in rows}
    found, computed, failures = respond(cases, tmp_path, SELF)
    assert computed == CHUNK and not failures and np.isfinite(found).all()


@pytest.mark.slow
@alone
def test_command(folder, capsys):
    """Statistics are those of the samples in the file; the second time nothing is computed."""
    arguments = (TWO_ARM, "--random", MASS, "--random", YOUNG, "--samples", 32,
                 *overrides(*SMALL), "--out", folder / "two")  # fmt: skip
    run(*arguments)
    first = capsys.readouterr().out
    rows = rows_of(folder / "two" / f"{TWO}.csv")
    assert len(rows) == 32
    statistics = rows_of(folder / "two" / f"{TWO}_statistics.csv")
    for label in ("initial design", "optimised design"):
        for quantity in ("compliance [N m]", "maximal deviation [mm]"):
            values = column(rows, f"{label}: {quantity}")
            mine = {r["statistic"]: r for r in statistics if r["quantity"] == quantity}
            assert float(mine["mean"][label]) == pytest.approx(values.mean(), rel=1e-8)
            assert 0.0 < float(mine["nominal"][label]) < values.max()
    indices = rows_of(folder / "two" / f"{TWO}_indices.csv")
    assert len(indices) == 8
    for one in indices:
        first_order, total = float(one["first order [-]"]), float(one["total [-]"])
        assert 0.0 <= first_order <= total + 1e-9 <= 1.0 + 2e-9
        # A heavier payload matters more than as many per cent less of stiffness.
        assert (total > 0.5) == (one["input"] == "payload.mass")
    assert (folder / "two" / f"{TWO}.png").is_file()
    assert "67 cases computed" in first  # two designs at 33 points, and one made
    assert (folder / "two" / f"{TWO}.md").read_text() in first
    before = (folder / "two" / f"{TWO}.csv").read_bytes()
    run(*arguments, "--no-plots")
    assert "0 cases computed" in capsys.readouterr().out
    assert (folder / "two" / f"{TWO}.csv").read_bytes() == before


def study(given, folder, *random, base=None, **options):
    base = scene() if base is None else base
    steps = study_random(base, random, [given], **options)
    runner = Runner(folder, WORLD, False)
    return runner.follow(steps), runner.computed


def tables_of(done):
    return {table.name: table for table in done.tables}


def test_one_input_has_no_indices(folder, given):
    """Nor have the scene's scenarios a part in it."""
    done, computed = study(given, folder, MASS, samples=10)
    assert computed == 11
    assert list(tables_of(done)) == ["inputs", "statistics", ""]
    several = scene('scenarios=[{changes=["payload.mass=4"]}]')
    _, computed = study(given, folder, MASS, base=several, samples=10)
    assert computed == 0
