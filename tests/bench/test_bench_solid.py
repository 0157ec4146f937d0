"""The diagram of solid links: rows of both programs, goals, panels, names."""

from __future__ import annotations

import math

import pytest
from mpi4py import MPI
from runs import TWO_ARM

from dolfinopt.bench import Plan, common, named, solid, solid_link
from dolfinopt.errors import InputError
from dolfinopt.fem.interior import ITERATIVE
from dolfinopt.scene.load import load_scene

pytestmark = pytest.mark.serial


def test_both_iterations():
    """The same link: dofs of all nodes in DOLFINx, less the clamped and the rigid ones here."""
    cells, comm = (8, 3, 2), MPI.COMM_SELF
    scene = load_scene(TWO_ARM)
    found = solid_link.ours(scene, cells, comm)
    assert found.dofs == 3 * 7 * 4 * 3 + 6 and found.solver == "LAPACK's band"
    assert [len(row) for row in found.phases] == 2 * [len(solid_link.PHASES)]
    found = solid_link.plain(scene, cells, comm)
    assert found.dofs == 3 * 9 * 4 * 3 and len(found.phases) == 1


def rows_of(seconds: dict[str, float], ranks: int = 1, power: float = 1.0) -> list[tuple]:
    """Return rows of links whose seconds a degree of freedom grow with a power of these."""
    rest = (0.0,) * len(solid_link.PHASES)
    return [
        (name, ranks, dofs, factor * dofs**power, *rest, 1e-5 * dofs, solver)
        for name, factor in seconds.items()
        for dofs, solver in ((20_000, "mumps"), (200_000, ITERATIVE), (1_000_000, ITERATIVE))
    ]


SECONDS = {
    solid.PLAIN: 1.0,
    f"{solid.OURS}, first design": 2.0,
    f"{solid.OURS}, nearby design": 0.5,
}


def test_goals_and_panels():
    rows = [*rows_of(SECONDS), *rows_of(SECONDS, 2, 1.1)]
    diagram = solid.diagram()
    measured = {goal.what: goal.measured for goal in diagram.goals(rows)}
    expected = [2.0, 0.5, 1.0, 1.0, 2.0, 0.5, 1.1, 1.1, 10.0]
    assert list(measured.values()) == pytest.approx(expected)
    assert "memory of 1 000 000 dofs on two ranks, GB" in measured
    titles = ["1 rank", "2 ranks", "peak of 1 rank", "peak of 2 ranks"]
    titles.append("phases of the first design, 2 ranks")
    assert [panel.title for panel in diagram.panels(rows)] == titles
    factor = rows_of({"factor, first design": 1.0})
    assert [panel.title for panel in diagram.panels(rows + factor)][2] == "either solver, one rank"
    assert "exponent 1.00" in diagram.notes(rows)[2]
    few = [row for row in rows if row[2] == 20_000]
    assert all(math.isnan(goal.measured) for goal in diagram.goals(few) if "exponent" in goal.what)
    assert not diagram.goals([(*row[:2], 9000, *row[3:]) for row in few])


def test_goes_on(tmp_path, monkeypatch):
    """What was measured before a bench was ended is not measured again."""
    asked: list[tuple] = []

    def in_process(scene, who, cells, ranks):
        if len(asked) == 3:
            raise KeyboardInterrupt
        asked.append((who, cells, ranks))
        names = [solid.PLAIN] if who == "plain" else [f"{solid.WHO[who]}, {solid.COLD}"]
        return [(name, ranks, 1000, 1.0) for name in names]

    monkeypatch.setattr(solid, "in_process", in_process)
    plan, said = Plan(load_scene(TWO_ARM), True), []
    with pytest.raises(KeyboardInterrupt):
        common.measured(solid.diagram(), plan, tmp_path, said.append)
    before, asked[:] = asked[:], []
    monkeypatch.setattr(solid, "RANKS", (1,))
    rows = common.measured(solid.diagram(), plan, tmp_path, said.append)
    assert len(rows) == 6 and not set(before) & set(asked)
    assert said[0].endswith("(1 of 10)") and said[-1].endswith("(6 of 6)")


def test_what_does_not_fit_is_left_out(monkeypatch):
    monkeypatch.setattr(solid, "free_memory", lambda: 4e9)
    said: list[str] = []
    steps = solid.diagram().measure(Plan(load_scene(TWO_ARM), False), said.append)
    assert any("260 x 26 x 17 cells, 1 rank" in name for name in steps)
    assert not any("260 x 26 x 17 cells, 2 ranks" in n or n.startswith("362") for n in steps)
    assert said == ["6 measurements need more memory than is free: left out"]


def test_names():
    assert [one.name for one in named(["solid", "time"])] == ["solid", "time"]
    assert "solid" not in [one.name for one in named([])]
    with pytest.raises(InputError, match="no diagram 'plane'"):
        named(["plane"])
