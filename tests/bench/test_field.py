"""The benchmark of the field: case files, verdicts, and the published results."""

from dataclasses import replace

import pytest
from runs import TWO_ARM, refused, run

from dolfinopt.bench import field
from dolfinopt.errors import ConvergenceError, InputError

pytestmark = pytest.mark.serial  # a case runs on one rank

CASES = {case.name: case for case in field.read_cases()}


@pytest.mark.parametrize("name", [case.name for case in field.chosen_cases([], False)])
def test_published_results_are_those_of_today(name):
    """Ours to a hundredth of the limit, or to 1e-4 where the limit is that of the problem."""
    for one in field.check(CASES[name]):
        assert one.met, one.of.what
        found = one.difference if one.of.table else one.value
        room = 0.01 * one.of.limit * abs(one.reference) if one.of.limit else 0.0
        assert found == pytest.approx(one.of.ours, rel=1e-4, abs=room), one.of.what


def test_two_arm_is_the_demo():
    assert CASES["two-arm"].scene.read_bytes() == TWO_ARM.read_bytes()


@pytest.mark.parametrize(
    ("way", "difference", "met"),
    [
        ("near", 0.009, True),
        ("near", -0.011, False),
        ("most", -0.5, True),
        ("most", 0.011, False),
        ("least", 0.5, True),
        ("least", -0.011, False),
        ("near", float("nan"), False),
    ],
)
def test_verdict(way, difference, met):
    case = CASES["quanser"]
    value = replace(case.values[0], way=way, limit=0.01)
    assert field.Checked(case, value, 1.0, 1.0, difference).met is met


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("title =", "tittle ="), "tittle"),
        (("origin =", "#origin ="), "origin is missing"),
        (("scene =", "#scene ="), "scene or program"),
        (("unit =", 'way = "about"\nunit ='), "about"),
        (("loaded frequency", "colour"), "colour"),
    ],
)
def test_wrong_case_files(tmp_path, change, told):
    text = (field.benchmark_folder() / "quanser" / "case.toml").read_text().replace(*change, 1)
    file = tmp_path / "case.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=told) as caught:
        field.read_case(file)
    assert str(file) in str(caught.value)


def test_command(tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    run("bench", "field", "--case", "quanser", "--out", out)
    assert "1 values within their limits" in capsys.readouterr().out
    assert "met" in (out / "field.csv").read_text()
    missed = replace(CASES["quanser"].values[0], reference=1.0)
    cases = (replace(CASES["quanser"], values=(missed,)),)
    monkeypatch.setattr(field, "read_cases", lambda: cases)
    with refused("quanser", missed.what, error=ConvergenceError):
        run("bench", "field")
    assert "MISSED" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("field", "--case", "sling"), ("--case", "sling", "rod")),
        (("field", "--case", "rod", "--all"), ("--case", "--all")),
        (("field", "time"), ("field", "time")),
        (("field", "--quick"), ("field", "--quick")),
        (("time", "--all"), ("--all", "field")),
    ],
)
def test_wrong_words(words, told):
    with refused(*told):
        run("bench", *words)
