"""The paper: its cases, and what is found in their results."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from runs import TWO_ARM

from dolfinopt.data import paper_scene
from dolfinopt.output.summary import filter_warnings
from dolfinopt.paper import reproduction as paper
from dolfinopt.paper.reproduction import bend, check_paper, failed_checks, percent, power, span
from dolfinopt.study.cases import Case

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
    """All that `reproduce --check` demands, each of which can fail, see FLAWS."""
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
    assert scene.design.radius == pytest.approx(2.0 * max(paper.cell_sizes(scene).values()))
    assert filter_warnings(scene, paper.cell_sizes(scene)) == []
    scene = paper.load_paper(True, ["design.filter_radius=0.01"])
    assert scene.design.radius == 0.01
    [warning] = filter_warnings(scene, paper.cell_sizes(scene))
    assert "arm1" in warning and "0.02" in warning  # two cells of 10 mm
    full = paper.load_paper()  # the paper's scene is fixed: 1.5 of its cells
    assert full.design.radius == 0.0075 and len(filter_warnings(full, paper.cell_sizes(full))) == 1


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
