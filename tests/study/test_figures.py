"""Tables, curves and pictures of studies: what is drawn, and that it can be read."""

import csv
import io
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text
from pictures import TOLERANCE, difference

from dolfinopt.plots.style import BLUE, LONGEST, ORANGE, look, look_numbers, shortened, spread
from dolfinopt.study.figures import common_looks, draw, line_figure
from dolfinopt.study.tables import FrameFigure, Line, LineFigure, Panel, Table

PICTURE = Path(__file__).parent / "sweep.png"  # written by `bare`, then looked at
pytestmark = pytest.mark.serial  # one rank shows all there is


def test_line_figure():
    """Axes with units, a legend each; equal names look alike; steep curves on a log scale."""
    x = np.arange(4.0)
    panels = (
        Panel("one", "mass [kg]", "compliance [N m]", (Line("a", x, x + 1.0), Line("b", x, x))),
        Panel("two", "mass [kg]", "deviation [mm]", (Line("b", x, 10.0**x),)),
    )
    drawn = line_figure(LineFigure("", "Title", panels))
    first, second = drawn.axes
    assert [axes.get_xlabel() for axes in drawn.axes] == ["mass [kg]"] * 2
    assert [axes.get_ylabel() for axes in drawn.axes] == ["compliance [N m]", "deviation [mm]"]
    assert first.get_yscale() == "linear" and second.get_yscale() == "log"
    np.testing.assert_array_equal(first.lines[0].get_ydata(), x + 1.0)
    assert first.lines[1].get_color() == second.lines[0].get_color() != first.lines[0].get_color()
    memory = Panel("", "n [-]", "memory [MB]", (Line("a", 10.0**x, 100.0 * (x + 1.0)),), log=True)
    (axes,) = line_figure(LineFigure("", "", (memory,))).axes
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert 10.0 < axes.get_ylim()[0] < 100.0 and 400.0 < axes.get_ylim()[1] < 1000.0


def test_long_names_leave_room_for_the_curves():
    """Names of designs are paths: their beginnings are cut."""
    x = np.linspace(0.0, 3.0, 20)
    folder = "results/a-folder-with-a-long-name/" * 4
    names = [f"{folder}{k}.npz" for k in range(3)]
    lines = tuple(Line(name, x, x * (k + 1.0)) for k, name in enumerate(names))
    panels = tuple(Panel(f"payload {k} kg", "t [s]", "u [mm]", lines) for k in range(2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Matplotlib's, where nothing is left of the axes
        figure = line_figure(LineFigure("long", "Long names", panels))
        figure.canvas.draw()
    assert all(axes.get_window_extent().width / figure.dpi > 2.5 for axes in figure.axes)
    written = {text.get_text() for text in figure.findobj(Text)}
    assert {f"...{name[3 - LONGEST :]}" for name in names} <= written
    assert shortened("short.npz") == "short.npz"


def test_one_thing_has_one_look_in_all_figures():
    """Different designs look different although they never meet in one panel or row."""
    x = np.arange(3.0)

    def row(*names):
        return Panel("", "x [-]", "y [-]", tuple(Line(name, x, x) for name in names))

    figures = [
        LineFigure("1", "", (row("initial design"), row("a"), row("b"))),
        LineFigure("2", "", (row("b", "c"), row("a", "optimised design"))),
    ]
    styles = common_looks(figures)
    seen = [(s["color"], str(s["linestyle"])) for s in styles.values()]
    assert len(set(seen)) == len(seen) == 5
    for figure in figures:
        lines = [line for axes in line_figure(figure, styles).axes for line in axes.lines]
        for line in lines:
            assert line.get_color() == styles[line.get_label()]["color"]
        assert len({line.get_linewidth() for line in lines}) == 1
        assert len({line.get_markersize() for line in lines}) == 1
    # What every run's pictures show looks alike in all of them.
    looks = (styles[f"{which} design"]["color"] for which in ("initial", "optimised"))
    assert (*looks,) == (ORANGE, BLUE)


def test_looks_of_a_crowd():
    """28 before one comes twice; a figure's own differ up to the seventh; names do not overlap."""
    numbers = look_numbers([list("abcdefg"), [f"n{k}" for k in range(19)]])
    assert len(set(numbers.values())) == 26
    assert len({look(numbers[name])["color"] for name in "abcdefg"}) == 7
    assert len(look_numbers([[f"n{k}" for k in range(60)]])) == 60
    np.testing.assert_allclose(spread([0.5, 0.5, 0.9], 0.1), [0.5, 0.6, 0.9])
    np.testing.assert_allclose(spread([1.0, 0.99], 0.1), [1.0, 0.9])


def test_coordinates_double():
    x = np.array([4.0, 8.0, 16.0])
    panel = Panel("", "q [-]", "y [-]", (Line("a", x, x),), x_log2=True)
    drawn = line_figure(LineFigure("", "", (panel,)))
    (axes,) = drawn.axes
    assert axes.get_xscale() == "log"
    a, b, c = axes.transData.transform(np.column_stack([x, x]))[:, 0]
    assert b - a == pytest.approx(c - b)
    drawn.canvas.draw()
    assert {"4", "8", "16"} <= {label.get_text() for label in axes.get_xticklabels()}


def test_column_of_panels():
    """Below each other, one look a curve, every legend below its panel; sweeps keep a margin."""
    t, x = np.linspace(0.0, 3.0, 200), np.linspace(0.0, 1.0, 9)
    panels = (
        Panel("", "t [s]", "y [mm]", (Line("a", t, t), Line("b", t, t))),
        Panel("", "s [-]", "y [mm]", tuple(Line(name, x, x) for name in "bcdef")),
    )
    drawn = line_figure(LineFigure("", "", panels))
    drawn.canvas.draw()
    first, second = drawn.axes
    assert first.get_position().x0 == pytest.approx(second.get_position().x0, abs=1e-3)  # aligned
    assert first.lines[1].get_color() == second.lines[0].get_color()
    assert first.get_xlim() == (0.0, 3.0) and second.get_xlim()[0] < 0.0
    for axes, names in zip(drawn.axes, ("ab", "bcdef"), strict=True):
        legend = axes.get_legend()
        assert [text.get_text() for text in legend.get_texts()] == list(names)
        assert legend.get_window_extent().y1 < axes.get_window_extent().y0
    assert first.get_legend().get_window_extent().y0 > second.get_window_extent().y1


@pytest.mark.parametrize("factor", [0.1, 1.0, 100.0])
def test_losses_have_one_scale(factor):
    values = factor * np.array([[0.0, 1.5], [-2.0, 0.0]])
    frame = pd.DataFrame(values, columns=["used at 4", "used at 8"]).assign(panel="loss [%]")
    frame.insert(0, "made for [kg]", ["4", "8"])
    axes = draw(FrameFigure("", "T", "matrix", frame)).axes[0]
    assert axes.images[0].get_clim() == (-10.0, 10.0)
    assert [text.get_text() for text in axes.texts] == [f"{value:.2f}" for value in values.flat]
    assert (axes.get_ylabel(), axes.get_xlabel()) == ("made for [kg]", "used at [kg]")


def sweep_figure(factor=1.0):
    """Return a sweep's figure: three designs, one of another magnitude, two quantities."""
    mass = np.linspace(4.0, 8.0, 5)
    designs = {"initial design": 0.5, "optimised design": 0.15, "made for it": 0.148 * factor}
    panels = []
    for names in (["initial design"], ["optimised design", "made for it"]):
        for what, power in (("compliance [N m]", 2.0), ("maximal deviation [mm]", 1.0)):
            lines = (Line(name, mass, designs[name] * mass**power) for name in names)
            panels.append(Panel("", "payload.mass [kg]", what, tuple(lines)))
    drawn = line_figure(LineFigure("", "Designs by payload.mass [kg].", tuple(panels)))
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
