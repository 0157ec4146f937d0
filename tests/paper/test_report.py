"""A reproduction: its files, its page, and what is told where cases failed."""

import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from browser import browser, open_browser
from pages import Reader
from runs import overrides, run

from dolfinopt.errors import ConvergenceError
from dolfinopt.paper import reproduction as paper
from dolfinopt.paper.reproduction import TABLE, check_paper, failed_checks
from dolfinopt.study.cases import Outcomes

pytestmark = pytest.mark.serial  # cases are dealt out to ranks in tests/study

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
        keep = paper.reproduce
        patch.setattr(paper, "reproduce", lambda *given: kept.append(keep(*given)) or kept[-1])
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
