"""Tables and curves of studies, as Markdown and CSV."""

import csv
import io

import numpy as np
import pandas as pd
import pytest

from dolfinopt.study.tables import Line, LineFigure, Panel, Study, Table, write_study

pytestmark = pytest.mark.serial  # nothing here knows of ranks


def test_table():
    columns = ["a|b [m]", "n", "x"]
    rows = [("one|two", 3, 1.23456), ("", 4, np.nan)]
    table = Table("", "Title.", pd.DataFrame(rows, columns=columns))
    lines = table.markdown().splitlines()
    assert lines[0] == "Title." and len({len(line) for line in lines[2:]}) == 1
    assert r"one\|two" in lines[4] and "1.235" in lines[4]
    assert table.csv() == "a|b [m],n,x\none|two,3,1.23456\n,4,\n"


def test_curves_as_csv():
    """A row a point; where panels differ in what they show, the axes have no common name."""
    x = np.array([1.0, 2.0])
    panels = [
        Panel(
            "p", "m [kg]", "c [N m]", (Line("a", x, 2.0 * x), Line("b", x, np.array([3, np.nan])))
        ),
        Panel("q", "m [kg]", "d [mm]", (Line("a", x, x),)),
    ]
    alone = LineFigure("", "", (panels[0],)).csv()
    rows = list(csv.reader(io.StringIO(alone)))
    assert rows[0] == ["panel", "line", "m [kg]", "c [N m]"]
    assert rows[1:] == [["p", "a", "1", "2"], ["p", "a", "2", "4"], ["p", "b", "1", "3"],
                        ["p", "b", "2", ""]]  # fmt: skip
    both = LineFigure("", "", tuple(panels)).csv()
    assert both.splitlines()[0] == "panel,line,x,y" and len(both.splitlines()) == 7


def test_files(tmp_path):
    one = Table("", "First.", pd.DataFrame({"a": [1]}))
    other = Table("more", "Second.", pd.DataFrame({"b": [2.5]}))
    line = Line("l", np.array([0.0]), np.array([1.0]))
    figure = LineFigure("f", "", (Panel("", "x [s]", "y [m]", (line,)),))
    study = Study("name", (one, other), (figure,), (), 0)
    write_study(study, tmp_path)
    files = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert set(files) == {"name.csv", "name_more.csv", "name.md", "name_f_curves.csv"}
    assert files["name_more.csv"] == "b\n2.5\n"
    assert files["name.md"] == one.markdown() + "\n" + other.markdown()
