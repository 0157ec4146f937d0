"""Shape optimisation of the splines of parts."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from parts import folder_with, frame
from runs import run

from dolfinopt.cli.shared import scene_of
from dolfinopt.errors import InputError
from dolfinopt.part import polish as polishing
from dolfinopt.part.curves import MIRROR, Spline, direction
from dolfinopt.part.mesh import mesh_parts
from dolfinopt.part.part import make_parts
from dolfinopt.part.polish import polish
from dolfinopt.part.shape_gradient import by_outline
from dolfinopt.responses.constraints import EXCESS

pytestmark = pytest.mark.serial

SMALL = ("arms.cells=[100,6]", "simulation.sample=0.005", "arms.0.symmetric=true")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A frame: its folder, scene, parts, meshes, and what polishing brings."""
    folder = folder_with(tmp_path_factory.mktemp("polish") / "run", frame, *SMALL)
    scene = scene_of(folder)
    parts = make_parts(scene, folder)
    meshes = mesh_parts(parts)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(polishing, "WORTH", 1e-3)
        return folder, scene, parts, meshes, polish(scene, parts, meshes, 2)


def test_steps_make_the_objective_better_at_the_same_area(made):
    _, _, parts, _, found = made
    assert found.steps == 2 and found.kept and found.gain > 0.002
    assert found.after < found.before
    before, after = parts[0].shape, found.parts[0].shape
    assert after.area == pytest.approx(before.area, rel=1e-8)
    assert after.is_simple(1e-5) and 0.0 < found.farthest < 0.75 * parts[0].domain.cell
    assert f"{100.0 * found.gain:.2g} % better" in found.sentence


def test_what_is_not_free_stays_and_joints_stay_smooth(made):
    before, after = made[2][0].shape, made[4].parts[0].shape
    for a, b in zip(before.pieces, after.pieces, strict=True):
        if not a.free:
            assert b.curve is a.curve
        else:
            assert isinstance(b.curve, Spline) and (b.curve.knots == a.curve.knots).all()
    for old, new in zip(before.loops, after.loops, strict=True):
        for k in range(len(old)):
            turn = [
                direction(loop[k - 1].curve, 1.0) @ direction(loop[k].curve, 0.0)
                for loop in (old, new)
            ]
            assert np.abs(new[k - 1].curve.end - new[k].curve.start).max() < 1e-12
            if turn[0] > 1.0 - 1e-9:
                assert turn[1] > 1.0 - 1e-9


def test_symmetric_arm_stays_symmetric(made):
    shape = made[4].parts[0].shape
    points = np.vstack([c.points for c in shape.curves if isinstance(c, Spline)])
    apart = np.linalg.norm(points[:, None] - points * MIRROR, axis=2).min(axis=1)
    assert apart.max() < 1e-9


@pytest.mark.parametrize("stiffening", [False, True], ids=["linear", "stiffened"])
@pytest.mark.parametrize("kind", ["esl", "compliance", "deviation", "stress"])
def test_derivative_at_the_outline_is_that_of_the_objective(made, kind, stiffening):
    """Against central differences: of a step along the descent, which keeps the area, and another.

    Instants and time steps are not held: that of the load cases' worst changes by up to 8e-4.
    """
    scene, part, mesh = made[1], made[2][0], made[3].coarse[0]
    changes = {"objective": {"kind": kind}, "simulation": {"stiffening": stiffening}}
    posed = scene.model_copy(
        update={key: getattr(scene, key).model_copy(update=one) for key, one in changes.items()}
    )
    outline = polishing.OutlineMoves.of(part)
    state = polishing._evaluated(posed, {0: part}, {0: mesh})[0]
    pull = by_outline(state, {0: mesh})[0]
    descent = outline.descent(part.shape, mesh, pull)
    noise = np.random.default_rng(0).normal(size=outline.count)
    for moves in (descent, noise + noise[outline.partner]):
        moves = 0.01 * part.domain.cell * moves / np.abs(moves).max()
        places, values = [], []
        for sign in (1.0, -1.0):
            moved = mesh.morphed(_with_moves(outline, part.shape, sign * moves))
            places.append(moved.points[mesh.sides[:, 0]])
            values.append(polishing._evaluated(posed, {0: part}, {0: moved})[1])
        predicted = (pull * (places[0] - places[1])).sum()
        assert values[0] - values[1] == pytest.approx(predicted, rel=2e-3)


def _with_moves(outline, shape, moves):
    number, loops = iter(range(len(shape.pieces))), []
    for loop in shape.loops:
        loops.append(tuple(outline._piece(piece, next(number), moves) for piece in loop))
    return replace(shape, loops=tuple(loops))


def test_less_than_one_per_cent_is_left_out(made):
    _, scene, parts, meshes, _ = made
    found = polish(scene, parts, meshes, 1)
    assert not found.kept and found.steps == 1 and 0.0 < found.gain < 0.01
    assert found.parts[0] is parts[0] and found.meshes is meshes
    assert "left out" in found.sentence


def test_limits_that_are_met_stay_met(made, monkeypatch):
    _, scene, parts, meshes, _ = made
    before = polishing._evaluated(scene, parts, meshes.coarse)[0].evaluation
    limit = 1.0002 * before.max_deviation
    limits = scene.constraints.model_copy(update={"deviation": limit})
    posed = scene.model_copy(update={"constraints": limits})
    monkeypatch.setattr(polishing, "WORTH", 0.0)
    found = polish(posed, parts, meshes, 1)
    after = polishing._evaluated(posed, found.parts, found.meshes.coarse)
    assert after[2] <= 2.0 * EXCESS  # on a mesh of its own


def test_mass_and_arcs_are_refused(made):
    folder, scene, parts, meshes, _ = made
    objective = scene.objective.model_copy(update={"kind": "mass"})
    with pytest.raises(InputError, match=r"--polish: objective\.kind"):
        polish(scene.model_copy(update={"objective": objective}), parts, meshes, 1)
    with pytest.raises(InputError, match="expected splines"):
        run("part", folder, "--curves", "arcs", "--polish", 1, "--no-plots", "--no-check")
    assert not (folder / "part").exists()


def test_command_writes_polished_parts(made, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(polishing, "WORTH", 1e-3)
    folder, _, parts, _, found = made
    run("part", folder, "--polish", 2, "--out", tmp_path, "--no-plots", "--no-check")
    assert found.sentence in capsys.readouterr().out
    figures = json.loads((tmp_path / "part.json").read_text())
    assert figures["polish"]["kept"] and figures["polish"]["gain"] == pytest.approx(found.gain)
    assert figures["arms"]["arm1"]["distance"] == pytest.approx(parts[0].shape.distance)
