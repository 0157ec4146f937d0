"""The diagram of solid links: rows of both programs, goals, panels, names."""

from __future__ import annotations

import pytest
from mpi4py import MPI
from runs import TWO_ARM

from dolfinopt.bench import named, solid
from dolfinopt.errors import InputError
from dolfinopt.scene.load import load_scene

pytestmark = pytest.mark.serial


def test_both_iterations():
    """The same link: dofs of all nodes in DOLFINx, less the clamped and the rigid ones here."""
    cells, comm = (8, 3, 2), MPI.COMM_SELF
    scene = load_scene(TWO_ARM)
    dofs, phases = solid.ours(scene, cells, comm)
    assert dofs == 3 * 7 * 4 * 3 + 6
    assert len(phases) == 2 and all(len(row) == len(solid.PHASES) for row in phases)
    dofs, phases = solid.plain(scene, cells, comm)
    assert dofs == 3 * 9 * 4 * 3 and len(phases) == 1


def test_goals_and_panels():
    names = [solid.PLAIN, f"{solid.OURS}, {solid.COLD}", f"{solid.OURS}, {solid.WARM}"]
    rows = [
        (name, 1, dofs, seconds * dofs, *(0.0,) * len(solid.PHASES), 1e-6 * dofs)
        for name, seconds in zip(names, (1.0, 2.0, 0.5), strict=True)
        for dofs in (1000, 8000)
    ]
    assert [goal.measured for goal in solid.diagram().goals(rows)] == [2.0, 0.5]
    assert [panel.title for panel in solid.diagram().panels(rows)] == ["1 rank", "memory, one rank"]
    assert "exponent 1.00" in solid.diagram().notes(rows)[1]


def test_names():
    assert [one.name for one in named(["solid", "time"])] == ["solid", "time"]
    assert "solid" not in [one.name for one in named([])]
    with pytest.raises(InputError, match="no diagram 'plane'"):
        named(["plane"])
