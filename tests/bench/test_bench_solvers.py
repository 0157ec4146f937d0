"""The diagram of solvers: rows, and that they are drawn."""

from __future__ import annotations

import pytest
from runs import TWO_ARM

from dolfinopt.bench import solvers
from dolfinopt.scene.load import load_scene
from dolfinopt.study.variants import changed

pytestmark = pytest.mark.serial


def test_solvers_are_timed_in_a_process_of_their_own() -> None:
    scene = changed(load_scene(TWO_ARM), "arms.cells=[12,2]")
    rows = solvers._in_process(scene, 2, {"petsc, nd"})
    names = [row[0] for row in rows]
    assert solvers.OURS in names and "mumps, its own" in names
    assert "petsc, nd" not in names
    assert all(seconds > 0.0 for row in rows for seconds in row[1:])


def test_notes_and_panels_of_some_rows() -> None:
    rows = [
        (solvers.OURS, 1, 2400, 0.01, 0.01),
        ("mumps, its own", 1, 2400, 0.01, 0.03),
        (solvers.OURS, 2, 2400, 0.02, 0.02),
    ]
    panels = solvers.diagram().panels(rows)
    assert [line.label for line in panels[0].lines] == [solvers.OURS, "mumps, its own"]
    assert f"{solvers.OURS}, 2 threads" in [line.label for line in panels[1].lines]
    assert "lapack, natural is fastest, 0.02 s on 1 thread" in solvers.diagram().notes(rows)[1]
