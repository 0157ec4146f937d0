"""Plates in space, and the stress on the outlines of parts with its gradient."""

from __future__ import annotations

import json

import numpy as np
import pytest
from moved_nodes import node_test
from parts import folder_with, frame, write_run
from runs import ROOT, run

import dolfinopt as do
from dolfinopt.cli.shared import scene_of
from dolfinopt.part.check import simulate_parts
from dolfinopt.part.part import make_parts, mesh_parts
from dolfinopt.part.stress import (
    OutlineStress,
    corner_stress,
    stress_of_parts,
)
from dolfinopt.responses.response import Analysis

pytestmark = pytest.mark.serial
COARSE = ("arms.link2.rigid=true", "simulation.sample=0.02",
          "simulation.tolerance=1e-4", "objective.kind=integral_compliance")  # fmt: skip


def window(x, y, z):
    """A plate with one opening."""
    return 1.0 * ~((np.abs(y) < 0.012) & (np.abs(x - 0.25) < 0.15))


def test_plate_in_space_has_the_sides_of_a_plane_part(tmp_path):
    """Optimised, and with the words of old, which have no effect."""
    scene = do.load_scene(
        ROOT / "demos" / "spatial_arm.toml", ("arms.link1.cells=[40,4,2]", *COARSE)
    )
    folder = write_run(tmp_path / "run", scene, window)
    words = "--optimize", "--simplify", "--iterations", "1", "--no-check", "--no-plots"
    run("part", folder, *words)
    figures = json.loads((folder / "part" / "part.json").read_text())
    assert figures["optimize"]["after"] <= figures["optimize"]["before"]
    assert "CYLINDRICAL_SURFACE" in (folder / "part" / "link1.step").read_text()


# -- the p-mean of the stress on the outline of parts, and its gradient by the places of nodes  ---


BAR = """Point(1) = {0, -0.03, 0}; Point(2) = {1, -0.03, 0}; Point(3) = {1, 0.03, 0};
Point(4) = {0, 0.03, 0}; Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
Transfinite Curve {1, 3} = 13; Transfinite Curve {2, 4} = 4; Transfinite Surface {1};
Physical Curve("inboard") = {4}; Physical Curve("outboard") = {2};
"""
ROUGHLY = ("simulation.tolerance=1e-4", "simulation.sample=0.01", "objective.gradient=exact",
           "design.filter_radius=0")  # fmt: skip
PLANE = ("arms.cell_shape=triangle", "arms.passive=0", "motion.horizon=2.2",
         "simulation.stiffening=true")  # fmt: skip
SPACE = ("arms.link1.cells=[5,1,1]", "arms.link2.cells=[5,1,1]", "arms.passive=0.06",
         "simulation.stiffening=false")  # fmt: skip


@pytest.mark.parametrize("base", ["two_arm", "controlled_two_arm", "spatial_arm"])
def test_gradient_by_nodes(base, tmp_path, monkeypatch):
    """Remainders are of second order; a node in the middle of the solid counts nothing."""
    monkeypatch.setattr("dolfinopt.responses.stress.NEGLIGIBLE_POWER_SHARE", 0.0)
    (tmp_path / "bar.geo").write_text(BAR)
    plane, kind = base != "spatial_arm", "objective.kind=stress"
    told = (f"arms.mesh='{tmp_path}/bar.geo'", *PLANE) if plane else SPACE
    scene = do.load_scene(ROOT / "demos" / f"{base}.toml", (*ROUGHLY, *told, kind))

    def middle(length, places):  # cells end at twelfths, fifths
        return (places[:, 0] > 0.15 * length) & (places[:, 0] < 0.85 * length)

    def points(k, state):
        every = corner_stress(state)
        return every.counted(middle(scene.arms[k].length, every.places))

    response = OutlineStress(scene.objective, points)
    size = 0.01 if plane else 0.005  # m, of cells of 20 to 100 mm
    found = node_test(scene, solid, size, cut=not plane, response=response)
    assert found.slope != 0.0
    assert found.rate == pytest.approx(2.0, abs=0.1)


def solid(k, x, y):
    """Return densities of solid material."""
    return np.ones_like(x)


def test_largest_is_that_of_the_part(tmp_path):
    """As the check of a part finds it; the p-mean is below."""
    folder = folder_with(tmp_path / "run", frame, "arms.cells=[100,6]", "simulation.sample=0.005")
    scene = scene_of(folder)
    parts = make_parts(scene, folder)
    state = simulate_parts(scene, parts, mesh_parts(parts).coarse)
    known = stress_of_parts(state.arms, state.trajectory, parts)

    def points(k, design):
        every = parts[k].stress(design)
        return every.counted(parts[k].regular(every.places, scene.objective.stress_margin))

    response = OutlineStress(scene.objective, points)
    designs = {k: arm.current for k, arm in state.arms.items()}
    place = state.scene, state.partition, designs, state.trajectory
    found = response.measure(Analysis(*place, do.Profile()))
    assert found.values[0] == pytest.approx(known[0].peak.value, rel=1e-9)
    assert 0.1 * found.values[0] < found.smooth[0] < found.values[0]
