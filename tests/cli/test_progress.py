"""What is shown while an optimisation runs, and the time it says to have taken."""

import time

import pytest

from dolfinopt.cli.shared import plain_lines
from dolfinopt.optimization.state import FurtherRow, HistoryRow

pytestmark = pytest.mark.serial  # one rank shows all there is


def test_lines_without_a_terminal(capsys):
    """The first row's wait is no silence, either; the last row is repeated while nothing comes."""
    with plain_lines(400, every=0.05) as show:
        deadline = time.monotonic() + 10.0
        text = ""
        while "setting up" not in text and time.monotonic() < deadline:
            time.sleep(0.01)
            text += capsys.readouterr().err
        show(HistoryRow(7, 2.5, 0.0075, 0.3, 0.5, 0.2, 1.0))
        while text.count("7/400") < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
            text += capsys.readouterr().err
    assert "setting up" in text
    assert text.count("7/400 objective 2.5 dev 7.5 mm") >= 2
    time.sleep(0.1)
    assert capsys.readouterr().err.count("\n") <= 1  # it ends with the run


def test_further_iterations_are_told_apart(capsys):
    with plain_lines(400, every=0.02) as show:
        show(FurtherRow(3, 2.5, 0.0075, 0.3, 0.5, 0.2, 1.0, of=20))
        deadline, text = time.monotonic() + 10.0, ""
        while "objective" not in text and time.monotonic() < deadline:
            time.sleep(0.01)
            text += capsys.readouterr().err
    assert "exact gradient, further 3/20 objective 2.5" in text and "/400" not in text


def test_a_short_run_says_nothing(capsys):
    with plain_lines(10, every=60.0) as show:
        show(HistoryRow(1, 2.5, 0.0075, 0.3, 0.5, 0.2, 1.0))
    assert capsys.readouterr().err == ""
