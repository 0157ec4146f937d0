"""Studies: what is planned, the tables and pictures that come of it, and what is refused."""

import re
import subprocess
import time

import click
import numpy as np
import pandas as pd
import pytest
from mpi4py import MPI
from runs import ROOT, TWO_ARM, by_root, command, contents, environment, overrides, refusal
from runs import run as run_command
from studies import COARSE, cells_of, column, rows_of, write_uniform

import dolfinopt as do
from dolfinopt.errors import ConvergenceError
from dolfinopt.study import studies as study
from dolfinopt.study import variants
from dolfinopt.study.cases import Runner
from dolfinopt.study.studies import given_designs
from dolfinopt.study.variants import parse_vary

WORLD, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
# Of the coordinates, whose square is the compliance. A batch's steps are not those of one scene:
# both results are right to it.
TOLERANCE = 1e-3
SMALL = [*COARSE, "optimizer.max_iterations=2", f"simulation.tolerance={TOLERANCE}"]
SETTINGS = overrides(*SMALL)
QUANTITIES = ("compliance [N m]", "maximal deviation [mm]")
alone = pytest.mark.serial  # ranks: test_ranks_do_not_matter


def scene(*overrides):
    return do.load_scene(TWO_ARM, [*SMALL, *overrides])


def run(*arguments, name="sweep"):
    run_command(name, *arguments)


def is_drawn(path):
    """Tell whether a picture holds more than a blank page."""
    from PIL import Image

    return np.asarray(Image.open(path).convert("L")).std() > 5.0


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("payload.mass=4:5:3", (4, 4.5, 5)),
        ("payload.mass = 8:4:2", (8, 4)),
        ("payload.mass=1e-1,2", (0.1, 2)),
        ("payload.mass=2,2", (2,)),
    ],
)
def test_vary(text, values):
    assert parse_vary(text).values == values


def test_vary_refuses_and_axes_bear_units():
    for text in ("payload.mass", "=1:2:3", "a=", "a=1:2", "a=1:2:1", "a=1:1:3", "a=1:2:x",
                 "a=one,two", "a=nan", "a=1:inf:3", "a=1:2:3:4", "a=1:2:-3"):  # fmt: skip
        refusal(lambda: parse_vary(text), "--vary", "expected")  # noqa: B023
    with pytest.raises(click.UsageError, match="what"):
        run_command("compare", TWO_ARM)
    for axis in ("payload.mass [kg]", "arms.arm2.length [m]", "motion.flattening [-]",
                 "joints.elbow.gear_stiffness [N m/rad, N/m]", "forces.pull.force [N]",
                 "closures.0.length [m]", "closure.point [m]",
                 "control.stiffness* [-]"):  # fmt: skip
        asked = parse_vary(f"{axis.split()[0]}=1,2")
        assert asked.axis == axis and asked.setting(2.0) == f"{asked.key}=2"


SWEEP, RANDOM, MASS = ["sweep", TWO_ARM], ["uncertainty", TWO_ARM], "payload.mass=normal:6:0.3"
OBJECTIVES, REDUCTIONS, SECTIONS = (
    ["compare", TWO_ARM, what] for what in ("objectives", "reductions", "sections")
)
BAD = [
    ([*SWEEP], "--vary"),
    ([*SWEEP, "tides"], "tides"),
    ([*SWEEP, "--vary", "payload.mas=1,2"], "payload.mass"),
    ([*SWEEP, "--vary", "payload.mass=a,b"], "expected"),
    ([*SWEEP, "--vary", "reduction.coordinates=4,4.5"], "integer"),
    ([*SWEEP, "--vary", "payload.mass=1,2", "--vary", "payload.mass=3,4"], "twice"),
    ([*SWEEP, "--vary", "motion.radius=1,5"], "from the shoulder"),
    ([*SWEEP, "payload", "--design", "nowhere.npz"], "nowhere.npz"),
    ([*SWEEP, "payload", "--design", "OTHER.npz"], "OTHER.npz: missing key"),
    ([*SWEEP, "--vary", "design.volume_fraction=0.4,0.6"], "--reoptimize"),
    ([*SWEEP, "--vary", "arms.arm2.length=0.9,1"], "--reoptimize"),  # of another size
    ([*SWEEP, "coordinates", "--vary", "payload.mass=1,2"], "only"),
    ([*SWEEP, "coordinates", "--vary", "reduction.coordinates=4,4.5"], "whole"),
    ([*SWEEP, "--design", "a.npz", "b.npz"], "b.npz"),  # a file that looks like a preset
    ([*SWEEP, "coordinates", "--reoptimize"], "compare reductions"),
    (["compare", TWO_ARM, "designs"], "objectives"),
    ([*OBJECTIVES, "--design", "a.npz"], "--design", "makes its own"),
    ([*OBJECTIVES, "joy"], 'objective.kind = "joy"'),
    ([*OBJECTIVES, "mass"], "a limit under"),
    ([*REDUCTIONS, "100000"], "100000"),
    ([*REDUCTIONS, "esl"], "esl"),
    ([*SECTIONS, "esl"], "esl: expected nothing behind"),
    ([*SECTIONS, "--design", "a.npz", "--design", "b.npz"], "one file"),
    (["reproduce", "--set", "payload.mas=4"], "payload.mass"),
    ([*RANDOM], "--random"),
    ([*RANDOM, "--random", "payload.mass"], "KEY=DISTRIBUTION"),
    ([*RANDOM, "--random", "payload.mass=cauchy:6:1"], "one of normal"),
    ([*RANDOM, "--random", "payload.mass=normal:6"], "normal:MEAN:DEVIATION"),
    ([*RANDOM, "--random", "reduction.coordinates=normal:4.2:1"], "an integer"),
    ([*RANDOM, "--random", "motion.elbow=uniform:0:1"], "motion.elbow"),  # a choice
    ([*RANDOM, "--random", "motion.flattening=normal:2:0.1"], "<= 1"),  # median out of range
    ([*RANDOM, "--random", "motion.flattening=uniform:0.9:1.1"], ">= 0 and <= 1"),
    ([*RANDOM, "--random", "payload.mass=normal:-1:2"], "payload.mass = -1"),  # half of it beyond
    ([*RANDOM, "--random", "design.initial=uniform:0.4:0.6"], "given design"),  # of the optimiser
    ([*RANDOM, "--random", "arms.arm2.length=normal:1:0.01"], "another length"),
    ([*RANDOM, "--random", MASS, "--random", "payload.mass=uniform:1:2"], "twice"),
    ([*RANDOM, "--random", MASS, "--samples", "5"], "at least 10"),
    ([*RANDOM, "--random", MASS, "--seed", "-1"], "--seed -1"),
]


@pytest.mark.parametrize("refused", BAD, ids=lambda refused: " ".join(map(str, refused[0][2:])))
def test_bad_input_is_one_line(refused, shared_tmp_path):
    """Of sweeps, comparisons, random values and the paper: before anything is written."""
    words, *expected = refused
    other = shared_tmp_path / "OTHER.npz"
    arrays = {"leg/centroid": np.zeros((1, 2)), "leg/density": np.ones(1)}
    by_root(lambda: np.savez(other, **arrays))
    line = [str(other) if part == other.name else part for part in words]
    refusal(lambda: run_command(*line, *SETTINGS, "--out", shared_tmp_path / "o"), *expected)
    assert not (shared_tmp_path / "o").exists()


def evaluated(scene, result, x=None):
    """Return what `evaluate` finds of a result's arms in a scene, by default of its design."""
    x = result.x_phys if x is None else {k: arm.uniform(x) for k, arm in result.arms.items()}
    return do.evaluate(scene, result.partition, result.arms, x, do.Profile())[0]


def test_payload(folder, capsys):
    """Every figure is that of a simulation by itself; the second time nothing is computed."""
    arguments = (TWO_ARM, "payload", "--vary", "payload.mass=4,8", *SETTINGS, "--out", folder)
    run(*arguments)
    first = capsys.readouterr()
    rows = rows_of(folder / "payload.csv")
    masses = column(rows, "payload.mass [kg]")
    np.testing.assert_array_equal(masses, [4.0, 8.0])
    result = do.optimize(scene(), world=SELF)
    for row, mass in zip(rows, masses, strict=True):
        for label, x in (("initial design", 0.5), ("optimised design", None)):
            one = evaluated(scene(f"payload.mass={mass}"), result, x)
            found = [float(row[f"{label}: {name}"]) for name in QUANTITIES]
            expected = [one.compliance, 1e3 * one.max_deviation]
            assert found == pytest.approx(expected, rel=4.0 * TOLERANCE)
    written = {path.name for path in folder.iterdir()}
    assert written >= {"payload.png", "payload.md", "payload_curves.csv"}
    assert is_drawn(folder / "payload.png")
    if WORLD.rank == 0:
        assert "5 cases computed" in first.out
        assert (folder / "payload.md").read_text() in first.out
    before = (folder / "payload.csv").read_bytes()
    run(*arguments)
    if WORLD.rank == 0:
        assert "0 cases computed" in capsys.readouterr().out
    assert (folder / "payload.csv").read_bytes() == before


@alone
def test_cross_evaluation(folder):
    """The matrix holds design i in scenario j, the losses follow from it."""
    steps = study.study(scene(), "payload", ["payload.mass=8,4"], [], reoptimize=True)
    done = Runner(folder, WORLD, False).follow(steps)
    tables = {table.name: table for table in done.tables}
    values = np.array([row[1:] for row in cells_of(tables["cross_compliance"])])
    loss = np.array([row[1:] for row in cells_of(tables["cross_compliance_loss"])])
    np.testing.assert_array_equal(loss, 100.0 * (values / np.diag(values) - 1.0))
    assert (np.diag(loss) == 0.0).all()
    for i, made in enumerate((8, 4)):
        design = do.optimize(scene(f"payload.mass={made}"), world=SELF)
        found = [evaluated(scene(f"payload.mass={m}"), design).compliance for m in (8, 4)]
        assert values[i] == pytest.approx(found, rel=4.0 * TOLERANCE)
    # Those made for each scenario stand in the main table, too.
    made_for_it = [row[-2] for row in cells_of(tables[""])]
    np.testing.assert_array_equal(made_for_it, np.diag(values))
    assert [figure.name for figure in done.figures] == ["", "cross"]


@pytest.mark.skipif(WORLD.size == 1, reason="compares one rank with several")
def test_ranks_do_not_matter(tmp_path, shared_tmp_path):
    vary, base = ["payload.mass=4:8:3", "motion.flattening=0.8,1"], scene()
    own, all_ranks = Runner(tmp_path, SELF, False), Runner(shared_tmp_path / "all", WORLD, False)
    single, together = (
        runner.follow(study.study(base, None, vary, [])) for runner in (own, all_ranks)
    )
    for one, other in zip(single.tables, together.tables, strict=True):
        assert (one.name, one.title) == (other.name, other.title)
        pd.testing.assert_frame_equal(one.frame, other.frame, check_exact=True)
    assert own.computed == all_ranks.computed == 13


def test_grid_of_two(folder):
    vary = ["payload.mass=4,8", "damping.stiffness_proportional=1e-4,2e-4,4e-4"]
    design = write_uniform(folder / "given.npz", (12, 3), 0.8)
    steps = study.study(scene(), None, vary, [design])
    done = Runner(folder, WORLD, shown=False).follow(steps)
    [table], [figure] = done.tables, done.figures
    assert [row[:2] for row in cells_of(table)] == [
        (m, d) for m in (4.0, 8.0) for d in (1e-4, 2e-4, 4e-4)
    ]
    assert "given: compliance [N m]" in table.frame.columns
    compliance = np.array([row[2] for row in cells_of(table)]).reshape(2, 3)
    assert (compliance[1] > compliance[0]).all()  # a heavier payload
    assert (np.diff(compliance) < 0.0).all()  # more damping
    left, _ = figure.panels
    np.testing.assert_array_equal([line.y for line in left.lines], compliance.T)


@alone
def test_three_keys_one_at_a_time(folder):
    vary = ["payload.mass=5,7", "motion.flattening=0.9,1", "material.density=2600,2800"]
    steps = study.study(scene(), None, vary, [])
    done = Runner(folder, WORLD, shown=False).follow(steps)
    assert [table.name for table in done.tables] == ["", *(text.split("=")[0] for text in vary)]
    bars = cells_of(done.tables[0])[: len(vary)]
    changes = {bar[2].split()[0]: bar[3:] for bar in bars}
    assert changes["payload.mass"][0] < 0.0 < changes["payload.mass"][1]
    assert changes["motion.flattening"][1] == 0.0  # the scene's own value
    largest = [max(map(abs, bar[3:])) for bar in bars]
    assert largest == sorted(largest, reverse=True)


@pytest.mark.parametrize(
    ("preset", "vary", "name"),
    [
        ("payload", [], "payload"),
        ("payload", ["payload.mass=4,8"], "payload"),
        ("payload", ["motion.duration=1,2"], "payload_motion.duration"),
        ("coordinates", ["reduction.coordinates=4,8"], "coordinates"),
        (None, ["material.density=2600:2800:5"], "material.density"),
        (None, [" payload.mass = 4", "arms.my arm.height=1"], "payload.mass_arms.my-arm.height"),
    ],
)
def test_files_are_named_after_what_varies(preset, vary, name):
    assert study.sweep_name(preset, vary) == name
    keys = [f"arms.{'a' * 60}{i}.thickness=1,2" for i in range(2)]  # long ones stay apart
    names = {study.sweep_name(None, keys), study.sweep_name(None, keys[::-1])}
    assert len(names) == 2 and max(map(len, names)) <= 120


def test_two_sweeps_share_a_folder(shared_tmp_path, capsys):
    """Each has its files; a sweep that grows computes what is new; another scene is refused."""
    folder = shared_tmp_path / "o"
    rough = overrides("optimizer.max_iterations=1")
    quick = [*SETTINGS, *rough, "--out", folder]

    def computed(*arguments):
        run(TWO_ARM, *arguments, *quick)
        said = capsys.readouterr().out
        return int(re.search(r"(\d+) cases computed", said)[1]) if WORLD.rank == 0 else None

    first = computed("--vary", "payload.mass=4,8")
    before = contents(folder)
    names = {f"payload.mass{end}" for end in (".csv", ".md", ".json", ".png", "_curves.csv")}
    assert set(before) == names
    computed("--vary", "motion.duration=1.9,2.1", "--no-plots")
    after = contents(folder)
    assert {name: after[name] for name in names} == before
    others = {f"motion.duration{end}" for end in (".csv", ".md", ".json", "_curves.csv")}
    assert set(after) == names | others
    grown = computed("--vary", "payload.mass=4,8,12", "--no-plots")
    if WORLD.rank == 0:
        # Two designs by value; the optimised design is made once, and 12 kg alone is new.
        assert (first, grown) == (1 + 4, 2)
    assert "payload.mass.png" not in contents(folder)  # it showed two values
    assert len(rows_of(folder / "payload.mass.csv")) == 3
    before = contents(folder)
    other = ["--vary", "payload.mass=4,8", "--set", "payload.inertia=0.1"]
    refusal(lambda: run(TWO_ARM, *other, *quick), "payload.mass.*", "another scene")
    assert contents(folder) == before
    computed(*other, "--overwrite", "--no-plots")
    assert contents(folder)["payload.mass.csv"] != before["payload.mass.csv"]


@pytest.mark.slow
@alone
def test_objective(folder):
    quick = overrides("optimizer.max_iterations=1", "simulation.tolerance=1e-2")
    run(TWO_ARM, "objectives", *SETTINGS, *quick, "--out", folder, name="compare")
    rows = rows_of(folder / "objective.csv")
    names = [row["objective"] for row in rows]
    # "Nothing attached" needs solid ends; nothing is limited that grows as material is taken away.
    every = (*variants.OBJECTIVES, *variants.RESPONSES[:2])
    possible = [label for label, _ in every if "nothing attached" not in label]
    assert names == ["initial design", *possible]
    assert [row["iterations"] for row in rows] == ["0"] + len(possible) * ["1"]
    compliance = dict(zip(names, column(rows, "compliance [N m]"), strict=True))
    for name in possible:
        if "eigenfrequency" not in name:
            assert compliance[name] < compliance["initial design"]
    # One iteration from the same start: of three pairs, among them frozen loads and the exact
    # gradient, which begins with them, objectives may agree.
    assert len({*compliance.values()}) >= len(names) - 3
    assert is_drawn(folder / "objective_designs.png")


def test_what_comparisons_and_studies_plan():
    """Solid ends allow "nothing attached"; few directions are not asked of the Gramian."""
    cases = next(study.objective_steps(scene("arms.passive=0.05")))
    every = (*variants.OBJECTIVES, *variants.RESPONSES[:2])
    assert [case.label for case in cases] == ["initial design", *(label for label, _ in every)]
    # The drives' effort takes as much material as its limits ask for.
    limited = scene("constraints.compliance=30")
    assert variants.posed(limited, "effort").design.volume_fraction == 1.0
    # Solid arms, as those of parts, leave nothing to optimise.
    solid = do.load_scene(TWO_ARM, ["design.initial=1.0", "design.volume_fraction=1.0"])
    assert given_designs(solid, ()) == {"solid arms": None}
    assert len(given_designs(do.load_scene(TWO_ARM), ())) == 2
    swept = variants.reductions(scene(), None, (4, 48))
    pairs = {(s.reduction.method, s.reduction.coordinates) for s in swept}
    assert ("balanced", 4) in pairs and ("balanced", 48) not in pairs
    krylov = ("reduction.method=krylov", "reduction.shifts=[0.0,100.0]")
    base = scene(*krylov, "reduction.coordinates=6")
    assert variants.reduced(base, "krylov", 8).reduction.shifts == (0.0, 100.0)
    assert variants.reduced(base, "modal", 8).reduction.shifts == (0.0,)


@pytest.mark.slow
@alone
def test_reduction(folder, monkeypatch):
    """Craig-Bampton and Krylov do not depend on q, modal truncation is below and climbs."""
    monkeypatch.setattr(study, "SWEPT", (4, 8))
    monkeypatch.setattr(variants, "REFERENCE", 8)
    run(TWO_ARM, "reductions", 4, *SETTINGS, "--set", "optimizer.max_iterations=1",
        "--no-plots", "--out", folder, name="compare")  # fmt: skip
    main = {row["method"]: row for row in rows_of(folder / "reduction.csv")}
    assert list(main) == list(variants.METHODS)
    own, again = "compliance, own model [N m]", "compliance, craig-bampton 8 [N m]"
    for method, row in main.items():
        off = float(row["own model off by [%]"])
        assert off == pytest.approx(100.0 * (float(row[own]) / float(row[again]) - 1.0), abs=1e-6)
        if method in ("craig-bampton", "krylov"):
            assert abs(off) < 0.1
    assert not list(folder.glob("reduction_*"))  # one table
    run(TWO_ARM, "coordinates", *SETTINGS, "--no-plots", "--out", folder)
    initial = "initial design: compliance [N m]"
    value = {(row["method"], int(row["coordinates"])): float(row[initial])
             for row in rows_of(folder / "coordinates.csv")}  # fmt: skip
    assert value["craig-bampton", 4] == pytest.approx(value["craig-bampton", 8], rel=1e-4)
    assert value["krylov", 4] == pytest.approx(value["craig-bampton", 8], rel=1e-4)
    assert value["modal", 4] < value["modal", 8] < 0.99 * value["craig-bampton", 8]


def test_failures_end_with_status_one(folder, monkeypatch):
    """The table names what failed and holds the rest."""
    from dolfinopt.responses import evaluation

    whole = evaluation.simulate

    def fail_at_seven(scene, *others):
        if scene.payload.mass == 7.25:
            raise ConvergenceError("no solution")
        return whole(scene, *others)

    monkeypatch.setattr(evaluation, "simulate", fail_at_seven)
    with pytest.raises(ConvergenceError, match=r"mass = 7\.25: no solution \(and 1 more\)"):
        run(TWO_ARM, "payload", "--vary", "payload.mass=4,7.25", *SETTINGS, "--out", folder)
    WORLD.barrier()
    rows = rows_of(folder / "payload.csv")
    value = "initial design: compliance [N m]"
    assert rows[0]["failed"] == "" and rows[0][value]
    assert rows[1]["failed"] == "no solution" and not rows[1][value]


@pytest.mark.slow
@pytest.mark.serial
def test_killed_study_goes_on(tmp_path, capsys):
    """Killed after some cases, the next call does the rest: all files are those of one run."""
    words = [TWO_ARM, "payload", "--vary", "payload.mass=4,7", "--reoptimize", *SETTINGS,
             "--no-plots", "--out"]  # fmt: skip
    run(*words, tmp_path / "whole")
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    line = command("sweep", *words, killed)
    with subprocess.Popen(line, env=environment(), cwd=ROOT, **silent) as begun:
        limit = time.monotonic() + 60.0
        while len(list(killed.glob("cases/*/summary.json"))) < 2:
            assert begun.poll() is None and time.monotonic() < limit
            time.sleep(0.01)
        begun.kill()
    done, every = (len(list(path.glob("cases/*/summary.json"))) for path in (killed, whole))
    assert 2 <= done < every == 11  # three designs made, they and the initial one with two masses
    capsys.readouterr()
    run(*words, killed)
    assert f"{every - done} cases computed" in capsys.readouterr().out
    a, b = (sorted(path.glob("*.csv")) for path in (killed, whole))
    assert [path.name for path in a] == [path.name for path in b] and len(a) == 6
    for one, other in zip(a, b, strict=True):
        assert one.read_bytes() == other.read_bytes()
