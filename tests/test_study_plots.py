"""Pictures of studies: what is drawn, and that it can be read."""

import numpy as np

from dolfinopt.findings import Line, LineFigure, MatrixFigure, Panel, TornadoFigure
from dolfinopt.study_plots import column_figure, line_figure, matrix_figure, tornado_figure


def test_line_figure():
    """Axes with units, a legend; equal names look alike; steep curves on a log scale."""
    x = np.arange(4.0)
    panels = (
        Panel("one", "mass [kg]", "compliance [N m]", (Line("a", x, x + 1.0), Line("b", x, x))),
        Panel("two", "mass [kg]", "deviation [mm]", (Line("b", x, 10.0**x),)),
    )
    drawn = line_figure(LineFigure("", "Title", (panels,)))
    left, right = drawn.axes
    assert [axes.get_xlabel() for axes in drawn.axes] == ["mass [kg]"] * 2
    assert [axes.get_ylabel() for axes in drawn.axes] == ["compliance [N m]", "deviation [mm]"]
    assert left.get_yscale() == "linear" and right.get_yscale() == "log"
    np.testing.assert_array_equal(left.lines[0].get_ydata(), x + 1.0)
    assert left.lines[1].get_color() == right.lines[0].get_color() != left.lines[0].get_color()
    assert right.get_legend() is not None


def test_legend_names_every_curve():
    """Also those that only a panel before the last one shows."""
    x = np.arange(3.0)
    panels = (
        Panel("", "x [-]", "y [-]", (Line("a", x, x), Line("b", x, x))),
        Panel("", "x [-]", "y [-]", (Line("b", x, x),)),
    )
    drawn = line_figure(LineFigure("", "", (panels,)))
    texts = [text.get_text() for text in drawn.axes[1].get_legend().get_texts()]
    assert texts == ["a", "b"]


def test_column_of_panels():
    """Below each other, one look a curve, every legend below its panel; sweeps keep a margin."""
    t, x = np.linspace(0.0, 3.0, 200), np.linspace(0.0, 1.0, 9)
    rows = (
        (Panel("", "t [s]", "y [mm]", (Line("a", t, t), Line("b", t, t))),),
        (Panel("", "s [-]", "y [mm]", tuple(Line(name, x, x) for name in "bcdef")),),
    )
    drawn = column_figure(LineFigure("", "", rows))
    drawn.canvas.draw()
    first, second = (part.axes[0] for part in drawn.subfigs)
    assert first.get_position().y0 > 0.0 and len(drawn.axes) == 2
    assert first.lines[1].get_color() == second.lines[0].get_color()
    assert first.get_xlim() == (0.0, 3.0) and second.get_xlim()[0] < 0.0
    for part, names in zip(drawn.subfigs, ("ab", "bcdef"), strict=True):
        (legend,) = part.legends
        assert [text.get_text() for text in legend.get_texts()] == list(names)
        assert legend.get_window_extent().y1 < part.axes[0].get_window_extent().y0


def test_matrix_and_tornado_figures():
    values = np.array([[0.0, 1.5], [-2.0, 0.0]])
    drawn = matrix_figure(MatrixFigure("", "T", "made for [kg]", "used at [kg]", ("4", "8"),
                                       (("loss [%]", values),)))  # fmt: skip
    texts = [text.get_text() for text in drawn.axes[0].texts]
    assert texts == ["0.00", "1.50", "-2.00", "0.00"]
    assert drawn.axes[0].get_ylabel() == "made for [kg]"
    drawn = tornado_figure(TornadoFigure("", "T", (("panel", (("mass", -3.0, 4.0),)),)))
    assert [patch.get_width() for patch in drawn.axes[0].patches] == [-3.0, 4.0]
    assert drawn.axes[0].get_xlabel() == "change [%]"
