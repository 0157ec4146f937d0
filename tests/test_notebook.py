"""The notebook: every cell runs, in its order, as a kernel would run it."""

import json
import logging
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[1] / "demos" / "from_python.ipynb"


@pytest.mark.serial
def test_every_cell_of_the_notebook_runs(monkeypatch, capsys):
    monkeypatch.chdir(NOTEBOOK.parent)
    monkeypatch.setattr(logging, "basicConfig", lambda: None)  # pytest has its own
    names = {"__name__": "notebook"}
    for number, cell in enumerate(json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
    assert names["again"].warnings == names["result"].warnings
    said = capsys.readouterr().out
    first, last = (float(said.split(f"\n{k} ")[-1].split()[0]) for k in (0, 3))
    assert last < 0.7 * first  # of the loop of one's own
