"""Tables: what is refused, and the curves through their rows against SciPy's conditions."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from bodies import assert_close, derivative
from runs import refusal

from dolfinopt.errors import InputError
from dolfinopt.paths import Curve, Table, curve_by_chord, curve_in_time, read_table

pytestmark = pytest.mark.serial  # nothing here knows of ranks

ROWS = np.array([[0.0, 0.0], [0.3, 0.4], [1.1, 0.3], [1.0, -0.2], [1.6, -0.3]])
TIMES = np.array([0.0, 0.3, 0.8, 1.1, 1.9])  # s


def written(folder: Path, text: str) -> str:
    """Return the path of a table with this content."""
    path = folder / "table.csv"
    path.write_text(text, encoding="utf-8")
    return str(path)


def table(t: np.ndarray | None = None, rows: np.ndarray = ROWS) -> Table:
    """Return a table that was not read from a file."""
    return Table("table.csv", tuple(range(2, 2 + len(rows))), t, rows)


def test_columns_in_any_order_comments_blank_lines_and_spreadsheets(tmp_path: Path) -> None:
    """Values are those of the columns asked for; lines are those of the file."""
    text = '\ufeff# a path\n\n"y", t ,x\r\n  # from here\n2, 0, 1\n\n-4e-1,.5,3\n'
    found = read_table(written(tmp_path, text), ("x", "y"))
    assert found.rows.tolist() == [[1.0, 2.0], [3.0, -0.4]]
    assert found.t is not None
    assert found.t.tolist() == [0.0, 0.5]
    assert found.lines == (5, 7)
    assert read_table(written(tmp_path, "x,y\n1,2\n1,2\n"), ("x", "y")).t is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["no rows", "x,y or t,x,y"]),
        ("# x,y\n\n", ["no rows", "x,y or t,x,y"]),
        ("1,2\n3,4\n5,6\n", ["line 1", "column '1'", "x,y or t,x,y"]),
        ("\nx;y\n0;1\n1;1\n", ["line 2", "column 'x;y'", "x,y or t,x,y"]),
        ("t,x,y,z\n0,0,0,0\n", ["line 1", "column 'z'", "x,y or t,x,y"]),
        ("x,y,x\n0,0,0\n", ["line 1", "column 'x' twice", "x,y or t,x,y"]),
        ("t,x\n0,0\n1,1\n", ["line 1", "column 'y'", "x,y or t,x,y"]),
        ("x,y\n", ["0 row(s)", "at least 2"]),
        ("x,y\n0,0\n", ["1 row(s)", "at least 2"]),
        ("x,y\n0,0\n1\n", ["line 3", "1 value(s)", "2", "x,y"]),
        ("x,y\n0,0\n1,2,3\n", ["line 3", "3 value(s)", "2", "x,y"]),
        ("x,y\n0,0\n1,a1\n", ["line 3, column y = 'a1'", "a finite number"]),
        ("x,y\n0,0\n# 1\n1,\n", ["line 4, column y = ''", "a finite number"]),
        ("x,y\n0,0\n1,nan\n", ["line 3, column y = 'nan'", "a finite number"]),
        ("x,y\n-inf,0\n1,0\n", ["line 2, column x = '-inf'", "a finite number"]),
        ("t,x,y\n1,0,0\n2,1,0\n", ["line 2, column t = 1", "0 [s]"]),
        ("t,x,y\n0,0,0\n2,1,0\n2,1,1\n", ["line 4, column t = 2", "more than 2 [s]"]),
        (b"x,y\n# L\xe4nge\n", ["line 2", "UTF-8"]),
    ],
)
def test_bad_table(tmp_path: Path, text: str | bytes, words: list[str]) -> None:
    """One line that names the file, the line, the column and the value."""
    file = tmp_path / "table.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    refusal(lambda: read_table(str(file), ("x", "y")), f"{file}: ", *words)


def test_file_that_cannot_be_read(tmp_path: Path) -> None:
    for file, reason in (
        (str(tmp_path), "Is a directory"),
        (str(tmp_path / "absent.csv"), "No such file"),
    ):
        refusal(lambda: read_table(file, ("x", "y")), "cannot be read", reason)  # noqa: B023
    with pytest.raises(InputError, match="not a file name"):
        read_table("a\0b", ("x", "y"))


@pytest.mark.parametrize("same", [1, 4])
def test_repeated_rows_have_no_chord(same: int) -> None:
    """Without times only: with them the end-effector waits."""
    rows = ROWS.copy()
    rows[same] = rows[same - 1]
    refusal(lambda: curve_by_chord(table(rows=rows)), f"table.csv: line {2 + same}", "same values")
    assert_close(curve_in_time(table(TIMES, rows))(TIMES)[0][same], rows[same], 1e-13, 1.0)


def jump(curve: Curve, order: int, at: float) -> float:
    """Return the largest jump of a derivative at a parameter inside."""
    step = 1e-9
    sides = [curve.derivatives[order](np.array([at + d])) for d in (-step, step)]
    return float(np.abs(sides[1] - sides[0]).max())


def test_curve_in_time_goes_from_rest_to_rest() -> None:
    """Through every row, twice (in fact four times) continuously differentiable."""
    curve = curve_in_time(table(TIMES))
    assert curve.end == TIMES[-1]
    assert curve.kinks == ()
    value, _, _ = curve(TIMES)
    assert_close(value, ROWS, 1e-13)
    _, first, second = (f(TIMES[[0, -1]]) for f in curve.derivatives)
    size = [np.abs(f(np.linspace(0.0, 1.9, 99))).max() for f in curve.derivatives]
    assert_close(first, np.zeros((2, 2)), 1e-13, size[1])
    assert_close(second, np.zeros((2, 2)), 1e-12, size[2])
    for knot in TIMES[1:-1]:
        # A step of 1e-9 s changes a smooth derivative by 1e-9 of the next one, some 100 times it.
        assert jump(curve, 2, knot) < 1e-6 * size[2]
    before = curve(np.array([-1.0, 0.0, 1.9, 5.0]))
    assert_close(before[0], ROWS[[0, 0, -1, -1]], 1e-13)
    assert not before[1].any()
    assert not before[2].any()


def test_two_rows_in_time_are_the_quintic_law() -> None:
    """Degree 5 with rest at both ends is 10 u^3 - 15 u^4 + 6 u^5."""
    curve = curve_in_time(table(np.array([0.0, 2.0]), np.array([[1.0], [4.0]])))
    u = np.linspace(0.0, 1.0, 11)
    expected = 1.0 + 3.0 * (10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5)
    assert_close(curve(2.0 * u)[0][:, 0], expected, 1e-13)


def test_curve_by_chord_is_the_natural_cubic_spline() -> None:
    """Through every row at its share of the chords' length; the third derivative jumps."""
    curve = curve_by_chord(table())
    lengths = [0.0, 0.5, np.hypot(0.8, 0.1), np.hypot(0.1, 0.5), np.hypot(0.6, 0.1)]
    places = np.cumsum(lengths) / np.sum(lengths)
    assert_close(curve(places)[0], ROWS, 1e-14)
    assert_close(curve.kinks, places[1:-1], 1e-15)
    second = curve.derivatives[2]
    assert_close(second(np.array([0.0, 1.0])), np.zeros((2, 2)), 1e-12, 10.0)
    for a, b in pairwise(places):  # linear between the rows
        ends = second(np.array([a, 0.5 * (a + b), b - 1e-15]))
        assert_close(0.5 * (ends[0] + ends[2]), ends[1], 1e-11, 10.0)
    for knot in places[1:-1]:
        assert jump(curve, 2, knot) < 1e-5


@pytest.mark.parametrize("t", [TIMES, None], ids=["time", "chord"])
def test_derivatives(t: np.ndarray | None) -> None:
    """By differences, away from the rows."""
    curve = curve_by_chord(table()) if t is None else curve_in_time(table(t))
    u = curve.end * np.array([0.07, 0.31, 0.55, 0.91])
    value, first, second = curve(u)
    assert value.shape == (4, 2)
    assert_close(derivative(lambda h: curve(u + h)[0], 2e-3), first, 1e-10)
    assert_close(derivative(lambda h: curve(u + h)[1], 2e-3), second, 1e-10)
