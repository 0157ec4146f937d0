"""Random uncertainties from the command line: what is asked, tables and pictures."""

from __future__ import annotations

import click
import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM, overrides
from runs import run as run_command
from studies import cells_of, column, rows_of, write_uniform

import dolfinopt as do
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.study.figures import draw
from dolfinopt.study.uncertainty import Sampling, nominal_value, parse_input, study_random

WORLD = MPI.COMM_WORLD
SMALL = ["arms.cells=[12,3]", "optimizer.max_iterations=2", "simulation.sample=0.01",
         "simulation.tolerance=1e-2"]  # fmt: skip
SETTINGS = overrides(*SMALL)
MASS, YOUNG = "payload.mass=normal:6:0.3", "material.young_modulus=normal:70e9:2e9"
TWO = "uncertainty_payload.mass_material.young_modulus"


def scene(*overrides):
    return do.load_scene(TWO_ARM, [*SMALL, *overrides])


def run(*arguments):
    run_command("uncertainty", *arguments)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the studies of this file keep what they compute."""
    path = tmp_path_factory.mktemp("random") if WORLD.rank == 0 else None
    return WORLD.bcast(path, root=0)


def tables_of(done):
    return {table.name: table for table in done.tables}


# -- what is asked ---------------------------------------------------------------------------


BAD = {
    "no distribution": (["--random", "payload.mass"], "KEY=DISTRIBUTION"),
    "unknown distribution": (["--random", "payload.mass=cauchy:6:1"], "expected one of normal"),
    "wrong numbers": (["--random", "payload.mass=normal:6"], "normal:MEAN:DEVIATION"),
    "unknown key": (["--random", "payload.mas=normal:6:1"], "payload.mass"),
    "unknown arm": (["--random", "arms.leg.thickness=normal:6:1"], "arm1"),
    "a table": (["--random", "payload=normal:6:1"], "a table"),
    "an integer": (["--random", "reduction.coordinates=normal:4.2:1"], "an integer"),
    "a choice": (["--random", "motion.elbow=uniform:0:1"], "motion.elbow"),
    "an array": (["--random", "motion.gravity=normal:0:1"], "motion.gravity"),
    "median out of range": (["--random", "motion.flattening=normal:2:0.1"], "<= 1"),
    "beyond the range": (["--random", "motion.flattening=uniform:0.9:1.1"], ">= 0 and <= 1"),
    "half beyond": (["--random", "payload.mass=normal:-1:2"], "payload.mass = -1"),
    "of the optimisation": (["--random", "design.initial=uniform:0.4:0.6"], "given design does"),
    "of the integration": (["--random", "simulation.sample=uniform:1e-3:2e-3"], "given design"),
    "another size": (["--random", "arms.arm2.length=normal:1:0.01"], "another length"),
    "twice": (["--random", MASS, "--random", "payload.mass=uniform:1:2"], "twice"),
    "out of reach": (["--random", "motion.radius=normal:1:1"], "from the shoulder"),
    "few samples": (["--random", MASS, "--samples", "5"], "at least 10"),
    "negative seed": (["--random", MASS, "--seed", "-1"], "--seed -1"),
    "unknown sampler": (["--random", MASS, "--sampler", "dice"], "latin-hypercube"),
    "nothing random": ([], "--random"),
    "no design": (["--random", MASS, "--design", "nowhere.npz"], "nowhere.npz"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line(name, shared_tmp_path):
    arguments, word = BAD[name]
    with pytest.raises((InputError, click.UsageError)) as caught:
        run(TWO_ARM, *arguments, *SETTINGS, "--out", shared_tmp_path / "o")
    error = caught.value
    message = error.format_message() if isinstance(error, click.UsageError) else str(error)
    assert "\n" not in message and word in message
    assert not (shared_tmp_path / "o").exists()


def test_inputs_are_cut_off_at_the_range():
    """Half a normal distribution about the key's largest value is left: mean 1 - s sqrt(2/pi)."""
    one = parse_input(scene(), "motion.flattening=normal:0.999999:0.01")
    assert (one.distribution.low, one.distribution.high) == (0.0, 1.0)
    assert one.distribution.mean == pytest.approx(1.0 - 0.01 * (2.0 / np.pi) ** 0.5, abs=1e-6)
    assert one.axis == "motion.flattening [-]"
    young = parse_input(scene(), "arms.arm2.young_modulus=lognormal:70e9:0.05")
    assert young.axis == "arms.arm2.young_modulus [Pa]" and young.distribution.low == 1.0


def test_nominal_values():
    given = scene("arms.arm2.density=2600.0", "arms.arm2.thickness=0.02")
    for key, value in (
        ("payload.mass", 6.0),
        ("arms.arm2.density", 2600.0),
        ("arms.arm1.density", 2700.0),
        ("arms.1.thickness", 0.02),
        ("arms.density", None),
        ("arms.height", 0.06),
    ):
        assert nominal_value(given, key) == value


# -- what comes out --------------------------------------------------------------------------


@pytest.mark.serial
def test_command(folder, capsys):
    """Statistics are those of the samples in the file; the second time nothing is computed."""
    arguments = (TWO_ARM, "--random", MASS, "--random", YOUNG, "--samples", 32, *SETTINGS,
                 "--out", folder / "two")  # fmt: skip
    run(*arguments)
    first = capsys.readouterr().out
    rows = rows_of(folder / "two" / f"{TWO}.csv")
    assert len(rows) == 32
    mass = column(rows, "payload.mass [kg]")
    assert mass.mean() == pytest.approx(6.0, abs=0.02)
    assert mass.std() == pytest.approx(0.3, rel=0.1)
    statistics = rows_of(folder / "two" / f"{TWO}_statistics.csv")
    for label in ("initial design", "optimised design"):
        for quantity in ("compliance [N m]", "maximal deviation [mm]"):
            values = column(rows, f"{label}: {quantity}")
            mine = {r["statistic"]: r for r in statistics if r["quantity"] == quantity}
            expected = {
                "mean": values.mean(),
                "standard deviation": values.std(ddof=1),
                "5 % quantile": np.quantile(values, 0.05),
                "50 % quantile": np.quantile(values, 0.5),
                "95 % quantile": np.quantile(values, 0.95),
            }
            for name, value in expected.items():
                assert float(mine[name][label]) == pytest.approx(value, rel=1e-8)
            low, high = (float(mine["mean"][f"{label}: {end}"]) for end in ("from", "to"))
            assert low < values.mean() < high
            assert 0.0 < float(mine["nominal"][label]) < values.max()
    indices = rows_of(folder / "two" / f"{TWO}_indices.csv")
    assert len(indices) == 8
    for one in indices:
        first_order, total = float(one["first order [-]"]), float(one["total [-]"])
        assert 0.0 <= first_order <= total + 1e-9 <= 1.0 + 2e-9
        # A heavier payload matters more than as many per cent less of stiffness.
        assert (total > 0.5) == (one["input"] == "payload.mass")
    names = ("", "_indices", "_scatter")
    assert all((folder / "two" / f"{TWO}{name}.png").is_file() for name in names)
    if WORLD.rank == 0:
        assert "67 cases computed" in first  # two designs at 33 points, and one made
        assert (folder / "two" / f"{TWO}.md").read_text() in first
    WORLD.barrier()
    before = (folder / "two" / f"{TWO}.csv").read_bytes()
    run(*arguments, "--no-plots")
    if WORLD.rank == 0:
        assert "0 cases computed" in capsys.readouterr().out
    assert (folder / "two" / f"{TWO}.csv").read_bytes() == before


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """A design of solid arms in a file, which needs no optimisation."""
    path = tmp_path_factory.mktemp("design") / "solid.npz" if WORLD.rank == 0 else None
    return write_uniform(WORLD.bcast(path, root=0), (12, 3), 1.0)


def study(given, folder, *random, base=None, **options):
    base = scene() if base is None else base
    return study_random(base, random, [given], folder, WORLD, Sampling(**options), shown=False)


@pytest.mark.serial  # ranks: test_ranks_do_not_matter of test_sampling
def test_small_scatter_is_linear(folder, given):
    """The standard deviation is that of the linearised model, by central differences."""
    fine = scene("simulation.tolerance=1e-4", "motion.horizon=2.2")
    spread = {"payload.mass": 0.01, "material.young_modulus": 1e8, "arms.thickness": 1e-5}
    centre = {"payload.mass": 6.0, "material.young_modulus": 70e9, "arms.thickness": 0.01}
    texts = [f"{key}=normal:{centre[key]!r}:{s!r}" for key, s in spread.items()]
    done = study(given, folder, *texts, base=fine, samples=64)
    found = {row[:2]: row[2] for row in cells_of(tables_of(done)["statistics"])}

    def simulate(key, value):
        other = scene("simulation.tolerance=1e-4", "motion.horizon=2.2", f"{key}={value!r}")
        partition = do.partition_arms(MPI.COMM_SELF, other.cell_counts)
        arms = do.build_arms(other, partition, do.Profile())
        x = {k: arm.uniform(1.0) for k, arm in arms.items()}
        evaluation, _ = do.evaluate(other, partition, arms, x, do.Profile())
        return np.array([evaluation.compliance, 1e3 * evaluation.max_deviation])

    parts = [
        0.5 * (simulate(key, centre[key] + s) - simulate(key, centre[key] - s))
        for key, s in spread.items()
    ]
    expected = np.sqrt(np.sum(np.square(parts), axis=0))
    shares = np.square(parts) / np.sum(np.square(parts), axis=0)
    quantities = ("compliance [N m]", "maximal deviation [mm]")
    for j, quantity in enumerate(quantities):
        # 64 net points give a normal law's standard deviation to some 2 %.
        assert found[quantity, "standard deviation"] == pytest.approx(expected[j], rel=0.04)
        name = quantity.partition(" [")[0]
        rows = [row for row in cells_of(tables_of(done)["indices"]) if row[1] == name]
        # The polynomial knows the distributions themselves.
        np.testing.assert_allclose([row[3] for row in rows], shares[:, j], atol=0.01)


@pytest.mark.serial  # ranks: test_ranks_do_not_matter of test_sampling
def test_both_ways_to_the_indices(folder, given):
    """Saltelli's scheme takes more simulations and comes to the polynomial's indices."""
    fitted = study(given, folder / "i", MASS, YOUNG, samples=32)
    direct = study(given, folder / "i", MASS, YOUNG, samples=32, indices="saltelli", seed=3)
    assert direct.computed == 1 + 16 * (2 + 2)
    assert len(tables_of(direct)[""].frame) == 64
    ours, theirs = (cells_of(tables_of(done)["indices"]) for done in (fitted, direct))
    assert len(ours) == len(theirs) == 4
    for one, other in zip(ours, theirs, strict=True):
        assert one[:3] == other[:3]
        for value, (low, high) in ((one[3], other[4:6]), (one[6], other[7:9])):
            # Twice as far as the 95 % interval of eight estimates leaves no chance.
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            assert abs(value - middle) < 2.0 * half and half < 0.8
    # Mixed samples are no draws of their own: statistics rest on 32.
    assert sorted(direct.figures[0].frame["sample"]) == list(range(33))


def test_one_input_has_no_indices(folder, given):
    done = study(given, folder, MASS, samples=20, sampler="latin-hypercube", indices="saltelli")
    assert done.computed == 21
    assert list(tables_of(done)) == ["inputs", "statistics", ""]
    assert [figure.name for figure in done.figures] == ["", "scatter"]


def test_scenarios_are_left_out(folder, given):
    several = scene('scenarios=[{changes=["payload.mass=4"]}]')
    plain = study(given, folder / "p", MASS, samples=10)
    assert study(given, folder / "p", MASS, base=several, samples=10).computed == 0
    assert plain.computed == 11


@pytest.mark.serial
def test_failures_end_with_status_1(folder, given, monkeypatch):
    from dolfinopt.study import simulate

    def failing(scenes, *_):
        return [ConvergenceError("no luck")] * len(scenes)

    monkeypatch.setattr(simulate, "simulate_batch", failing)
    with pytest.raises(ConvergenceError, match=r"solid, sample 0 \(\): no luck \(and 10 more\)"):
        run(TWO_ARM, "--random", MASS, "--samples", 10, "--design", given, *SETTINGS,
            "--out", folder / "f")  # fmt: skip
    rows = rows_of(folder / "f" / "uncertainty_payload.mass.csv")
    assert len(rows) == 10 and rows[0]["solid: compliance [N m]"] == ""


# -- pictures --------------------------------------------------------------------------------


@pytest.mark.serial
def test_pictures_show_the_samples(folder, given):
    done = study(given, folder / "i", MASS, YOUNG, samples=32)
    values = tables_of(done)[""].frame.to_numpy()[:, 3:5]
    histogram, bars, scatter = done.figures
    drawn = draw(histogram)
    for j, axes in enumerate(drawn.axes[:2]):
        assert sum(patch.get_height() for patch in axes.patches) == 32
        [curve] = drawn.axes[2 + j].lines
        np.testing.assert_array_equal(curve.get_xdata(), np.sort(values[:, j]))
        assert curve.get_ydata()[-1] == 1.0
    heights = [patch.get_height() for patch in draw(bars).axes[0].patches]
    rows = [row for row in cells_of(tables_of(done)["indices"]) if row[1] == "compliance"]
    np.testing.assert_allclose(heights, [row[3] for row in rows] + [row[6] for row in rows])
    axes = draw(scatter).axes
    assert len(axes) == 4
    np.testing.assert_array_equal(axes[3].lines[0].get_ydata(), values[:, 1])
    assert axes[2].get_xlabel() == "payload.mass [kg]"
