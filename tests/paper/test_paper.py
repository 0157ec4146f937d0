"""The paper: its cases, and what is found in their results."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from browser import browser, open_browser
from pages import Reader
from runs import TWO_ARM, overrides, run

from dolfinopt.data import paper_scene
from dolfinopt.errors import ConvergenceError
from dolfinopt.paper import reproduction as paper
from dolfinopt.paper.reproduction import (
    TABLE,
    bend,
    check_paper,
    failed_checks,
    percent,
    power,
    span,
)
from dolfinopt.study.cases import Case, Outcomes, Runner

pytestmark = pytest.mark.serial  # cases are dealt out to ranks in tests/study


def made_up():
    """Round results that meet every demand of `--check`, made up so that each breaks alone."""
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
    rows += [("objectives", *one[:2], nan, nan, *one[2:]) for one in objectives]
    rows += [("reductions", f"{method} {n}", method, n, nan, c, d)
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


def test_made_up_results_meet_all_demands():
    """All that `reproduce` demands, each of which can fail, see FLAWS."""
    checks = check_paper(RESULTS)
    assert failed_checks(checks) == []
    assert all(check.statement and check.found and check.criterion for check in checks)
    assert {check.name for check in checks if check.demand} == set(FLAWS)


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
    failed = failed_checks(check_paper(FLAWS[name]))
    assert any(line.startswith(f"{name}: expected") for line in failed)


def test_sentences_follow_from_the_results():
    """A check that holds says so, with the figure; one that does not gives the reason."""
    for check in check_paper(RESULTS):
        start = "Holds: " if check.holds else "Does not hold: "
        assert check.sentence.startswith(start + check.found)
        assert check.holds or check.reason
    stiffer = altered("table == 'objectives' and kind == 'esl'", deviation=0.3875)
    before, after = (check_paper(one)[2] for one in (RESULTS, stiffer))
    assert not before.holds and "8.00 mm" in before.sentence
    assert after.holds and "3.10 mm" in after.sentence


def test_coarse_cells_get_a_filter_of_two():
    """Below, designs hang together by corners of cells; a filter that is asked for stays."""
    scene = paper.load_paper(True)
    assert scene.design.radius == pytest.approx(2.0 * scene.arms[0].cell_size)
    assert paper.load_paper(True, ["design.filter_radius=0.01"]).design.radius == 0.01
    assert paper.load_paper().design.radius == 0.0075  # the paper's: 1.5 of its cells


def test_measures_and_losses():
    """Losses against the best of each column, by hand."""
    x = np.linspace(4.0, 8.0, 9)
    assert span([2.0, 4.0]) == 0.5
    assert bend(x, 3.0 + 2.0 * x) < 1e-12
    assert bend([-1.0, 0.0, 1.0], [3.0, 0.0, 3.0]) == pytest.approx(1.0)
    assert power(x, 0.1 * x**1.9) == pytest.approx(1.9)
    assert [percent(s) for s in (0.0125, 0.136, 15.6)] == ["1.25 %", "13.6 %", "16 times"]
    rows = pd.DataFrame(
        [(math.nan, 9.0, 9.0, 9.0), (0.0, 1.0, 7.0, 5.0), (1.0, 1.5, 7.0, 4.0)],
        columns=["made_for", 0.0, 0.5, 1.0],
    ).melt("made_for", var_name="x", value_name="compliance")
    np.testing.assert_allclose(paper.loss(rows, "compliance"), [[0.0, 0.25], [0.5, 0.0]])


def test_plan_is_complete():
    """All that the paper varies, and nothing twice; its scene comes with the package."""
    assert paper_scene().read_bytes() == TWO_ARM.read_bytes()
    assert paper_scene().is_relative_to(Path(paper.__file__).parent)
    table = paper.Plan(paper.load_paper()).table
    scenes = [case.scene for case in table.case]
    assert {s.payload.mass for s in scenes} >= {4.0, 5.0, 6.0, 7.0, 8.0}
    assert {s.motion.flattening for s in scenes} >= {0.0, 0.25, 0.5, 0.75, 1.0}
    designs = [case.design for case in table.case if isinstance(case.design, Case)]
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


# -- A reproduction: its files, its page, and what is told where cases failed  --------------------


TINY = (
    "arms.cells=[8,2]",
    "optimizer.max_iterations=1",
    "simulation.sample=0.01",
    "simulation.tolerance=1e-2",
    "motion.horizon=1.9",
)
PLAN = paper.Plan


def tiny(scene):
    """Return a plan of everything the paper asks, in fewer steps."""
    few = {"variants": (paper.VARIANTS[0], paper.VARIANTS[-1]), "optimised": (4,), "swept": (4, 6)}
    few |= {"masses": (4.0, 8.0), "payloads": (4.0, 8.0), "paths": (0.0, 1.0)}
    return PLAN(scene, **few, flattenings=(0.0, 1.0))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a reproduction, its outcomes, and what it said."""
    folder, kept = tmp_path_factory.mktemp("paper"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "Plan", tiny)
        follow = Runner.follow
        patch.setattr(Runner, "follow", lambda *given: kept.append(follow(*given)) or kept[-1])
        run("reproduce", "--out", folder, *overrides(*TINY))
        return folder, kept[-1]


@pytest.mark.slow
def test_files(whole):
    """Figures 3 to 15, none of them blank, their data, the table and the page."""
    from PIL import Image

    folder, (results, _) = whole
    numbers = [f"fig{k:02d}" for k in range(3, 16)]
    expected = {f"{name}.{ending}" for name in numbers for ending in ("csv", "png")}
    assert {path.name for path in folder.iterdir()} == {
        *expected, "measured.json", "report.html", "cases",
    }  # fmt: skip
    for name in numbers:
        assert np.asarray(Image.open(folder / f"{name}.png").convert("L")).std() > 5.0
        assert len(pd.read_csv(folder / f"{name}.csv").dropna(how="all")) > 1
    rows = pd.read_csv(folder / "fig10.csv")
    initial = rows[rows.line == "initial design"]
    own = results[(results.table == "payload") & (results.label == "initial design")]
    assert initial["payload [kg]"].tolist() == [4.0, 8.0]
    np.testing.assert_allclose(initial["compliance [N m]"], own.compliance)
    measured = pd.DataFrame(json.loads((folder / "measured.json").read_text()))
    np.testing.assert_allclose(measured.deviation, results.deviation)


def test_second_run_computes_nothing(whole, monkeypatch, capsys):
    """The verdict is told anew; one iteration makes no good design."""
    monkeypatch.setattr(paper, "Plan", tiny)
    words = "--out", whole[0], "--check", "--no-plots", *overrides(*TINY)
    with pytest.raises(ConvergenceError, match=r"path, a tenth: .*2 times"):
        run("reproduce", *words)
    said = capsys.readouterr().out
    assert "\n0 cases computed" in said
    told = re.findall(r"^(.*?) \(paper: ", said, re.M)
    assert told == [one["name"] for one in TABLE["statement"]]


def test_page(whole):
    """Complete in itself, sound, with every statement and every picture."""
    text = (whole[0] / "report.html").read_text(encoding="utf-8")
    page = Reader(text)
    loaded = [a.get(key) for _, a in page.tags for key in ("src", "data", "poster", "srcset")]
    assert all(address.startswith("data:") for address in loaded if address is not None)
    assert not re.search(r"url\(|@import|<script", text)
    assert [a["href"] for a in page.all("a")] == ["https://doi.org/10.1016/j.piutam.2015.01.018"]
    assert len(page.all("h1")) == 1 and page.all("html")[0]["lang"] == "en"
    assert len(page.all("img")) == 13 and all(len(image["alt"]) > 10 for image in page.all("img"))
    assert text.count("Holds if:") == 15
    assert "arms.arm1.cells = [8, 2] in place of [200, 12]" in text and "payload.mass =" not in text


@pytest.mark.skipif(browser() is None, reason="needs Chromium")
def test_page_in_a_browser(whole, tmp_path):
    """No complaint, no request, and nothing wider than the window, on a desk and on a phone."""
    with open_browser(tmp_path) as window:
        for size in ((1280, 900), (390, 844)):  # px
            window.open(whole[0] / "report.html", *size)
            assert window.complaints() == []
            sent = [address for address in window.requests() if not address.startswith("data:")]
            assert sent == [(whole[0] / "report.html").resolve().as_uri()]
            assert window.value("document.documentElement.scrollWidth") == size[0]


def test_report_without_some_results(whole, tmp_path):
    """Cases that failed are named; nothing that needs them holds, and the rest is told."""
    outcomes = whole[1][1]
    plan = tiny(paper.load_paper(overrides=TINY))
    table = plan.table
    lost = {plan.optimum, table.made[table.table == "reductions"].iloc[-1]}
    lost |= {case for case in table.case if case.design in lost}
    nothing = {"failure": "it <diverged>", "compliance": np.nan, "max_deviation": np.nan}
    found = {
        case: replace(outcome, **nothing) if case in lost else outcome
        for case, outcome in outcomes.by_case.items()
    }
    outcomes = Outcomes(found, 0)
    results = paper.add_outcomes(table, outcomes)
    checks = check_paper(results)
    wrong = {line.partition(":")[0] for line in failed_checks(checks)}
    assert wrong >= {"dynamic loads", "coordinates, optimised design"}
    assert "coordinates, initial design" not in wrong
    figures = paper.all_figures(results, outcomes)
    assert [*figures] == [*range(3, 16)]
    paper.write_report(plan, results, outcomes, checks, tmp_path)
    assert "it &lt;diverged&gt;" in (tmp_path / "report.html").read_text(encoding="utf-8")
