"""The paper: its cases and figures, and what is found in them."""

import csv
import dataclasses
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from mpi4py import MPI

from dolfinopt.cli import commands
from dolfinopt.data import paper_scene
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.output.summary import filter_warnings
from dolfinopt.paper import reproduction as paper
from dolfinopt.paper.statements import (
    bend,
    check_paper,
    failed_checks,
    percent,
    power,
    span,
)
from dolfinopt.study import cases

pytestmark = pytest.mark.serial  # cases are dealt out to ranks in test_cases

ROOT = Path(__file__).parents[2]
WORLD = MPI.COMM_WORLD
TINY = (
    "arms.cells=[16,3]",
    "optimizer.max_iterations=2",
    "simulation.sample=0.01",
    "simulation.tolerance=1e-2",
)
# As it was before this process began MPI, which would confuse another mpirun.
ENVIRONMENT = dict(os.environ)


def made_up():
    """Round results that meet every demand of `--check`.

    They are made up so that each demand can be broken alone: what the program computes is for the
    demands themselves to judge, in `dolfinopt reproduce --check`.
    """
    columns = ["table", "label", "kind", "x", "made_for", "compliance", "deviation"]
    nan, (before, after, solid) = math.nan, (paper.INITIAL, paper.OPTIMUM, paper.SOLID)
    cms, modal = paper.METHODS
    objectives = [
        (before, "", 28.0, 0.055),
        ("dynamic loads (esl)", "esl", 2.5, 0.008),
        ("static compliance", "static", 2.7, 0.009),
        ("eigenfrequency", "eigenfrequency", 2.6, 0.0085),
    ]
    reductions = [(cms, 4, 2.5, 0.008), (cms, 48, 2.5, 0.008), (modal, 4, 900.0, 1.5),
                  (modal, 48, 800.0, 1.4)]  # fmt: skip
    rows = []
    for ends in ("", "ends "):
        rows += [(f"{ends}objectives", *one[:2], nan, nan, *one[2:]) for one in objectives]
        rows += [(f"{ends}reductions", f"{method} {n}", method, n, nan, c, d)
                 for method, n, c, d in reductions]  # fmt: skip
    for label, method, values, deviation in (
        (before, cms, (28.0, 28.0, 28.0), 0.055),
        (before, modal, (25.0, 27.0, 27.5), 0.05),
        (after, cms, (2.5, 2.5, 2.5), 0.008),
        (after, modal, (1.9, 2.1, 2.2), 0.007),
    ):
        rows += [("coordinates", label, method, n, nan, c, deviation)
                 for n, c in zip((4, 48, 100), values, strict=True)]  # fmt: skip
    for table, values in (("payload", (4.0, 6.0, 8.0)), ("path", (0.0, 0.5, 1.0))):
        designs = [(before, nan, 1.0, 0.01)] + [(solid, nan, 0.08, 0.0011)] * (table == "path")
        designs += [(f"made for {value:g}", value, 0.1, 0.0014) for value in values]
        # Deviation linear in the value, compliance its square; optima alike.
        rows += [(table, label, "", v, made_for, c * (v + 4.0) ** 2, d * (v + 4.0))
                 for label, made_for, c, d in designs for v in values]  # fmt: skip
    return pd.DataFrame(rows, columns=columns).assign(own=2.0, apart=0.0)


RESULTS = made_up()
SETTING = paper.setting_of(paper.load_paper())


def tiny_plan():
    """Everything the paper asks, in fewer steps."""
    return paper.Plan(
        paper.load_paper(overrides=TINY),
        variants=paper.VARIANTS[:1] + paper.VARIANTS[-2:],
        optimised=(4, 8),
        swept=(4, 12),
        masses=(4.0, 6.0, 8.0),
        flattenings=(0.0, 0.5, 1.0),
        paths=(0.0, 1.0),
    )


# -- what the texts say of the scene ---------------------------------------------------------


def test_texts_take_their_values_from_the_scene():
    """Payload, path, penalty and volume are those of --set, not the paper's."""
    assert SETTING["machine"] == (
        "A cart carries two flexible arms that move 6 kg along a semicircle."
    )
    settings = ["payload.mass=4", "motion.flattening=0.5", "interpolation.penalty=2"]
    settings += ["design.initial=0.25", "design.volume_fraction=0.25"]
    setting = paper.setting_of(paper.load_paper(overrides=settings))
    assert setting["machine"] == (
        "A cart carries two flexible arms that move 4 kg along a semicircle flattened to 0.5."
    )
    words, ours = (
        {check.name: check.reason for check in check_paper(RESULTS, one)}["path, a tenth"]
        for one in (setting, SETTING)
    )
    assert "has 6.25 % of the solid arm's stiffness (0.25 to the power 2)" in words
    assert "25.0 % of the material in two flanges has 57.8 % of it" in words  # 1 - 0.75^3
    assert "4 times the material" in words
    assert "12.5 %" in ours and "14.3 %" in ours  # 1/8, and 1/8 over 7/8


# -- checks on made-up results ---------------------------------------------------------------


def test_made_up_results_meet_all_demands():
    """All that `reproduce --check` demands."""
    checks = check_paper(RESULTS, SETTING)
    assert failed_checks(checks) == []
    assert all(check.statement and check.found and check.criterion for check in checks)


def altered(where, **factors):
    """Return the results with some rows' values multiplied, or set where they are 0."""
    rows = RESULTS.copy()
    for name, factor in factors.items():
        before = rows.loc[rows.eval(where), name]
        assert len(before) > 0
        rows.loc[before.index, name] = np.where(before == 0.0, factor, factor * before)
    return rows


REDUCED = "table == 'reductions' and label == "
AFTER = "table == 'coordinates' and label == 'optimised design'"
FLAWS = {
    "initial deviation": altered("label == 'initial design' and kind == ''", deviation=1.3),
    "dynamic loads": altered("table == 'objectives' and kind == 'esl'", compliance=1.04),
    "modal truncation with few coordinates": altered(f"{REDUCED}'modal 4'", deviation=0.008),
    "Craig-Bampton designs": altered(f"{REDUCED}'craig-bampton 4'", compliance=1.04),
    "coordinates, initial design": altered("kind == 'modal' and x == 48", compliance=1.03),
    "coordinates, optimised design": altered(f"{AFTER} and kind == 'modal'", compliance=1.2),
    "deviation by reduction": altered(f"{AFTER} and kind == 'craig-bampton'", apart=0.02),
    "payload, linear": altered("table == 'payload'", deviation=np.nan),
    "payload, loss": altered("table == 'payload' and made_for == 4", compliance=1.06),
    "path, a tenth": altered("table == 'path' and made_for == 0", deviation=1.7),
    "path, loss": altered("table == 'path' and made_for == 1", compliance=0.9),
}


@pytest.mark.parametrize("name", FLAWS)
def test_check_finds(name):
    """Every demand fails where it should, under its name."""
    failed = failed_checks(check_paper(FLAWS[name], SETTING))
    assert any(line.startswith(f"{name}: expected") for line in failed)


def test_every_demand_can_fail():
    assert {check.name for check in check_paper(RESULTS, SETTING) if check.demand} == set(FLAWS)


def test_sentences_follow_from_the_results():
    """A check that holds says so, with the figure; one that does not gives the reason."""
    for check in check_paper(RESULTS, SETTING):
        start = "Holds: " if check.holds else "Does not hold: "
        assert check.sentence.startswith(start + check.found)
        assert check.holds or check.reason
    stiffer = altered("table == 'objectives' and kind == 'esl'", deviation=0.3875)
    before, after = (check_paper(one, SETTING)[2] for one in (RESULTS, stiffer))
    assert not before.holds and "8.00 mm" in before.sentence
    assert after.holds and "3.10 mm" in after.sentence


@pytest.mark.parametrize("overrides", [(), ("arms.cells=[80, 4]",), ("arms.cells=[400, 24]",)])
def test_coarse_cells_get_a_filter_of_two(overrides):
    """Below, designs hang together by corners of cells; never finer than the paper's radius."""
    scene = paper.load_paper(True, overrides)
    largest = max(paper.cell_sizes(scene).values())
    assert scene.design.radius == pytest.approx(max(2.0 * largest, 0.0075))
    assert filter_warnings(scene, paper.cell_sizes(scene)) == []


def test_filter_that_is_asked_for_stays():
    scene = paper.load_paper(True, ["design.filter_radius=0.01"])
    assert scene.design.radius == 0.01
    [warning] = filter_warnings(scene, paper.cell_sizes(scene))
    assert "1 cells of arm 'arm1'" in warning and "0.02 or more" in warning
    full = paper.load_paper()  # the paper's scene is fixed: 1.5 of its cells
    assert full.design.radius == 0.0075 and len(filter_warnings(full, paper.cell_sizes(full))) == 1


# -- measures --------------------------------------------------------------------------------


def test_measures():
    x = np.linspace(4.0, 8.0, 9)
    assert span([2.0, 4.0]) == 0.5
    assert bend(x, 3.0 + 2.0 * x) < 1e-12
    assert bend([-1.0, 0.0, 1.0], [3.0, 0.0, 3.0]) == pytest.approx(1.0)
    assert power(x, 0.1 * x**1.9) == pytest.approx(1.9)
    assert [percent(s) for s in (0.0125, 0.136, 15.6)] == ["1.25 %", "13.6 %", "16 times"]


def test_losses():
    """Against the best of each column, by hand."""
    rows = pd.DataFrame(
        [(math.nan, 9.0, 9.0, 9.0), (0.0, 1.0, 7.0, 5.0), (1.0, 1.5, 7.0, 4.0)],
        columns=["made_for", 0.0, 0.5, 1.0],
    ).melt("made_for", var_name="x", value_name="compliance")
    np.testing.assert_allclose(paper.loss(rows, "compliance"), [[0.0, 0.25], [0.5, 0.0]])


# -- what is planned -------------------------------------------------------------------------


def test_scene_comes_with_the_package():
    demo = ROOT / "demos" / "two_arm.toml"
    assert paper_scene().read_bytes() == demo.read_bytes()
    assert paper_scene().is_relative_to(Path(paper.__file__).parent)


def test_plan_is_complete():
    """All that the paper varies, and nothing twice."""
    table = paper.Plan(paper.load_paper()).table
    scenes = [case.scene for case in table.case]
    assert {s.payload.mass for s in scenes} >= {4.0, 5.0, 6.0, 7.0, 8.0}
    assert {s.motion.flattening for s in scenes} >= {0.0, 0.25, 0.5, 0.75, 1.0}
    designs = [case.design for case in table.case if isinstance(case.design, cases.Case)]
    made = {case for case in (*designs, *table.made) if case.action == "optimize"}
    made = {case for case in made if case.scene.arms[0].passive == 0.0}
    found = {
        (s.reduction.method, s.reduction.coordinates, s.payload.mass, s.motion.flattening)
        for s in (case.scene for case in made)
    }
    assert found == {
        *(("craig-bampton", 4, mass, 1.0) for mass in (4.0, 6.0, 8.0)),
        *(("craig-bampton", 4, 6.0, s) for s in (0.0, 0.25, 0.5, 0.75)),
        *((method, q, 6.0, 1.0) for method in ("craig-bampton", "modal") for q in (4, 48)),
    }
    kinds = [*table.kind[table.table == "objectives"]]
    assert kinds.count("static") == 2 and kinds.count("eigenfrequency") == 2
    # The nominal design stands for six reasons and is optimised once.
    assert len(made) == len(kinds) - 1 + 3 + 2 + 4


def test_bad_input_is_one_line(shared_tmp_path):
    for words, expected in (
        (["--set", "payload.mas=4"], "payload.mass"),
        (["--set", "motion.radius=5"], "from the shoulder"),
    ):
        with pytest.raises(InputError, match=expected) as caught:
            commands.main(
                ["reproduce", "--out", str(shared_tmp_path / "o"), *words],
                standalone_mode=False,
                obj=WORLD,
            )
        assert "\n" not in str(caught.value) and not (shared_tmp_path / "o").exists()


# -- the run ---------------------------------------------------------------------------------


REPRODUCE = ["reproduce", *(word for value in TINY for word in ("--set", value)), "--no-plots"]


@pytest.fixture(scope="module")
def small():
    """Let the command do with fewer steps; return a function that runs it and how often."""
    plan = tiny_plan()

    def reproduce(*words):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(paper, "Plan", lambda scene: dataclasses.replace(plan, scene=scene))
            commands.main([*REPRODUCE, *map(str, words)], standalone_mode=False, obj=WORLD)

    return reproduce


@pytest.fixture(scope="module")
def whole(small, tmp_path_factory):
    """The folder of a reproduction that ran through on one rank."""
    path = tmp_path_factory.mktemp("paper")
    small("--out", path)
    return path


def computed_cases(said):
    """Return how many cases a reproduction says that it has computed."""
    return int(re.search(r"(\d+) cases computed", said)[1])


def test_pipeline(small, whole, capsys):
    """Cases, figures' data, and the verdict; the second time nothing is computed."""
    capsys.readouterr()
    with pytest.raises(ConvergenceError) as caught:  # two iterations make no good design
        small("--out", whole, "--check")
    text = capsys.readouterr().out
    assert (
        "path, a tenth: expected at most 2 times the deviation of solid arms on every path; found"
        in str(caught.value)
    )
    assert computed_cases(text) == 0
    assert "payload, linear (paper: nearly linear)." in text
    names = {path.name for path in whole.iterdir()}
    assert names == {f"fig{k:02d}.csv" for k in range(3, 16)} | {"measured.json", "cases"}
    measured = json.loads((whole / "measured.json").read_text())
    told = re.findall(r"^(.*?) \(paper: ", text, re.M)
    assert told == [check.name for check in check_paper(RESULTS, SETTING)]
    rows = list(csv.DictReader((whole / "fig10.csv").open(newline="")))
    initial = [r for r in rows if r["line"] == "initial design"]
    assert [float(r["payload [kg]"]) for r in initial] == [4.0, 6.0, 8.0]
    own = measured["payload"]["designs"][0]["compliance"]
    np.testing.assert_allclose([float(r["compliance [N m]"]) for r in initial], own)
    assert measured["iterations"] == 2


PROGRAM = """
import dataclasses, sys
sys.path.insert(0, {tests!r})
from dolfinopt.paper import reproduction as paper
from test_paper import tiny_plan
plan = tiny_plan()
paper.Plan = lambda scene: dataclasses.replace(plan, scene=scene)
from dolfinopt.cli import main
main()
"""


@pytest.mark.slow
def test_killed_run_continues(small, whole, tmp_path, capsys):
    """Killed on two ranks: the next call does the rest, and all files are those of one run."""
    out, program = tmp_path / "a", tmp_path / "program.py"
    program.write_text(PROGRAM.format(tests=str(Path(__file__).parent)))
    line = ["mpirun", "--oversubscribe", "-n", "2", sys.executable, str(program), *REPRODUCE]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(
        [*line, "--out", str(out)], start_new_session=True, env=ENVIRONMENT, cwd=ROOT, **silent
    ) as begun:
        limit = time.monotonic() + 60.0
        while len(list(out.glob("cases/*/summary.json"))) < 5:
            assert begun.poll() is None and time.monotonic() < limit
            time.sleep(0.005)
        os.killpg(begun.pid, signal.SIGKILL)
        begun.wait()
    done, every = (len(list(path.glob("cases/*/summary.json"))) for path in (out, whole))
    capsys.readouterr()
    while True:
        try:
            small("--out", out)
            break
        except InputError as error:  # a rank outlives its killed mpirun for a moment
            assert "another run works" in str(error) and time.monotonic() < limit
            time.sleep(0.1)
    # A rank may outlive its killed mpirun for a moment, and finish a case.
    assert 5 <= done and 0 < computed_cases(capsys.readouterr().out) <= every - done
    a, b = (sorted(path.glob("*.*")) for path in (out, whole))
    assert [path.name for path in a] == [path.name for path in b] and len(a) == 14
    for one, other in zip(a, b, strict=True):
        assert one.read_bytes() == other.read_bytes()
