"""The display of many cases: what ranks say arrives, on a terminal and elsewhere."""

import sys

from mpi4py import MPI

from dolfinopt.study.progress import open_progress

WORLD = MPI.COMM_WORLD


class Terminal:
    """Standard error that is a terminal, and keeps what is written."""

    def __init__(self):
        self.text = ""

    def isatty(self):
        return True

    def write(self, text):
        self.text += text
        return len(text)

    def flush(self):
        pass


def tell_all(shown=True):
    """Let every rank work on two cases of three steps."""
    with open_progress(WORLD, 2 * WORLD.size, shown) as progress:
        for k in range(2):
            label = f"case {WORLD.rank}.{k}"
            for step in range(3):
                progress.tell(label, step, 3, f"step {step}")
            progress.tell(label, text="found", finished=1)
    return progress


def test_root_hears_everything(capsys):
    progress = tell_all()
    lines = capsys.readouterr().err.splitlines()
    if WORLD.rank > 0:
        assert lines == [] and progress.finished == 0
        return
    total = 2 * WORLD.size
    assert progress.finished == total and progress.ended == WORLD.size
    assert [line.split("/")[0].strip() for line in lines] == [str(k + 1) for k in range(total)]
    told = sorted(line.split("  ", 1)[1] for line in lines)
    assert told == [f"case {rank}.{k}: found" for rank in range(WORLD.size) for k in range(2)]


def test_silent_when_told_to(capsys):
    progress = tell_all(shown=False)
    assert capsys.readouterr().err == ""
    assert progress.finished == (2 * WORLD.size if WORLD.rank == 0 else 0)


def test_terminal(monkeypatch):
    terminal = Terminal()
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", terminal)
    tell_all()
    if WORLD.rank > 0:
        assert terminal.text == ""
        return
    total = 2 * WORLD.size
    assert f"{total}/{total} cases" in terminal.text


def test_nothing_to_do(capsys):
    with open_progress(WORLD, 0):
        pass
    assert capsys.readouterr().err == ""
