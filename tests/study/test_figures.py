"""Tables, curves and pictures of studies: what is drawn, and that it can be read."""

import csv
import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pictures import TOLERANCE, difference

from dolfinopt.plots.panels import Line, Panel
from dolfinopt.plots.style import looks
from dolfinopt.study.figures import draw
from dolfinopt.study.tables import LineFigure, Table

PICTURE = Path(__file__).parent / "sweep.png"  # written by `bare`, then looked at
pytestmark = pytest.mark.serial  # one rank shows all there is


def test_draw():
    """Axes with units, a legend each; equal names look alike; steep curves on a log scale."""
    x = np.arange(4.0)
    panels = (
        Panel("one", "mass [kg]", "compliance [N m]", (Line("a", x, x + 1.0), Line("b", x, x))),
        Panel("two", "mass [kg]", "deviation [mm]", (Line("b", x, 10.0**x),)),
    )
    drawn = draw(LineFigure("", "Title", panels))
    first, second = drawn.axes
    assert [axes.get_xlabel() for axes in drawn.axes] == ["mass [kg]"] * 2
    assert [axes.get_ylabel() for axes in drawn.axes] == ["compliance [N m]", "deviation [mm]"]
    assert first.get_yscale() == "linear" and second.get_yscale() == "log"
    np.testing.assert_array_equal(first.lines[0].get_ydata(), x + 1.0)
    assert first.lines[1].get_color() == second.lines[0].get_color() != first.lines[0].get_color()
    memory = Panel("", "n [-]", "memory [MB]", (Line("a", 10.0**x, 100.0 * (x + 1.0)),), log=True)
    (axes,) = draw(LineFigure("", "", (memory,))).axes
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert 10.0 < axes.get_ylim()[0] < 100.0 and 400.0 < axes.get_ylim()[1] < 1000.0


def sweep_figure(factor=1.0):
    """Return a sweep's figure: three designs, one of another magnitude, two quantities."""
    mass = np.linspace(4.0, 8.0, 5)
    designs = {"initial design": 0.5, "optimised design": 0.15, "made for it": 0.148 * factor}
    panels = []
    for names in (["initial design"], ["optimised design", "made for it"]):
        for what, power in (("compliance [N m]", 2.0), ("maximal deviation [mm]", 1.0)):
            lines = (Line(name, mass, designs[name] * mass**power) for name in names)
            panels.append(Panel("", "payload.mass [kg]", what, tuple(lines)))
    drawn = draw(LineFigure("", "Designs by payload.mass [kg].", tuple(panels)))
    for axes in drawn.axes:
        if legend := axes.get_legend():
            legend.remove()  # words
    return drawn


def test_sweep_looks_as_it_did(tmp_path):
    """Curves, colours, dashes, markers and scales; a curve that is 5 % off is another picture."""
    assert difference(PICTURE, sweep_figure(), tmp_path) == 0.0
    assert difference(PICTURE, sweep_figure(1.05), tmp_path) > TOLERANCE


def test_a_table_and_curves_as_text():
    """A row a point; where panels differ in what they show, the axes have no common name."""
    columns = ["a|b [m]", "n", "x"]
    cells = [("one|two", 3, 1.23456), ("", 4, np.nan)]
    table = Table("", "Title.", pd.DataFrame(cells, columns=columns))
    lines = table.markdown().splitlines()
    assert lines[0] == "Title." and len({len(line) for line in lines[2:]}) == 1
    assert r"one\|two" in lines[4] and "1.235" in lines[4]
    assert table.csv() == "a|b [m],n,x\none|two,3,1.23456\n,4,\n"
    x = np.array([1.0, 2.0])
    curves = Line("a", x, 2.0 * x), Line("b", x, np.array([3, np.nan]))
    panels = (Panel("p", "m [kg]", "c [N m]", curves),
              Panel("q", "m [kg]", "d [mm]", (Line("a", x, x),)))  # fmt: skip
    rows = list(csv.reader(io.StringIO(LineFigure("", "", panels[:1]).csv())))
    assert rows == [["panel", "line", "m [kg]", "c [N m]"], ["p", "a", "1", "2"],
                    ["p", "a", "2", "4"], ["p", "b", "1", "3"], ["p", "b", "2", ""]]  # fmt: skip
    both = LineFigure("", "", panels).csv()
    assert both.splitlines()[0] == "panel,line,x,y" and len(both.splitlines()) == 7


def test_looks_of_a_crowd():
    """28 before one comes twice; a figure's own differ in colour up to the seventh."""
    styles = looks([list("abcdefg"), [f"n{k}" for k in range(19)]])
    assert len({str(style) for style in styles.values()}) == 28
    assert len({styles[name]["color"] for name in "abcdefg"}) == 7
