"""Shape optimisation of solid parts: surfaces, plates, and stress of outlines."""

from __future__ import annotations

import json
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from moved_nodes import node_test
from parts import folder_with, frame, write_run
from runs import ROOT, run

import dolfinopt as do
from dolfinopt.cli.shared import scene_of
from dolfinopt.errors import InputError
from dolfinopt.part.check import simulate_parts
from dolfinopt.part.part import make_parts, mesh_parts
from dolfinopt.part.problem import Problem
from dolfinopt.part.solid.free_surface import free_surface
from dolfinopt.part.stress import (
    OutlineStress,
    corner_stress_in_plane,
    corner_stress_in_space,
    stress_of_parts,
)
from dolfinopt.responses.response import Analysis

pytestmark = pytest.mark.serial
COARSE = ("arms.link2.rigid=true", "simulation.sample=0.02",
          "simulation.tolerance=1e-4", "objective.kind=integral_compliance")  # fmt: skip


def open_box(x, y, z):
    """A cavity with two windows to the faces across z."""
    inside = (np.abs(y) < 0.012) & (np.abs(x - 0.25) < 0.18)
    return 1.0 * ~(inside & ((np.abs(z) < 0.006) | (np.abs(np.abs(x - 0.25) - 0.1) < 0.05)))


def window(x, y, z):
    """A plate with one opening."""
    return 1.0 * ~((np.abs(y) < 0.012) & (np.abs(x - 0.25) < 0.15))


@pytest.fixture(scope="module")
def form(tmp_path_factory):
    """Folder and scene of a run, its part and what moves of it."""
    cells = "arms.link1.cells=[25,4,4]"
    scene = do.load_scene(ROOT / "demos" / "spatial_arm.toml", (cells, *COARSE))
    folder = write_run(tmp_path_factory.mktemp("solid") / "run", scene, open_box)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dolfinopt.part.mesh.ACROSS", 1.0)  # large cells take little time
        (part,) = make_parts(scene, folder).values()
        problem = Problem(scene, {1: part}, {})
        yield (
            folder,
            scene,
            part,
            problem,
            problem.evaluated({1: free_surface(part, part.mesh())}, {}),
        )


@pytest.fixture
def surface(form):
    """The surface that moves."""
    return form[4].outlines[1]


def moves_of(form):
    """Return smooth random moves of about a millimetre."""
    free = form[4].outlines[1]
    x = np.random.default_rng(1).standard_normal(free.count)
    s = free.filtered(x)
    return 1e-3 * x / np.abs(s).max(), 1e-3 * s / np.abs(s).max()


def test_size_by_moves_is_its_difference(form):
    free, (x, s) = form[4].outlines[1], moves_of(form)
    ends = [free.moved(sign * 1e-2 * s).size for sign in (1.0, -1.0)]
    # Of third order in the moves: central differences leave (1e-5 m / 5e-3 m)^2 of it.
    assert 0.5 * (ends[0] - ends[1]) == pytest.approx(1e-2 * free.size_by_x() @ x, rel=1e-4)


def test_nodes_stay_on_the_faces_of_the_arm(form):
    state, (_, s) = form[4], moves_of(form)
    free = state.outlines[1]
    places = state.bodies[1].points
    moved = free.moved(s)
    after = moved.followed(state.bodies[1]).points
    assert np.abs(after - places).max() > 5e-4
    low, high = places.min(axis=0), places.max(axis=0)
    for axis in range(3):
        for end in (low[axis], high[axis]):
            on = np.abs(places[:, axis] - end) < 1e-12
            assert on.any() and np.abs(after[on, axis] - end).max() < 1e-12
    ends = np.isin(places[:, 0], (low[0], high[0]))
    assert np.array_equal(after[ends], places[ends])
    rim = (np.abs(places[:, 2] - high[2]) < 1e-12) & ~ends  # those of windows slide in the faces
    assert np.abs(after[rim] - places[rim]).max() > 1e-4
    assert moved.made.watertight
    assert moved.made.volume == pytest.approx(moved.size, rel=2e-3)


def test_kept_arrays_are_the_form(form):
    free, (_, s) = form[4].outlines[1], moves_of(form)
    moved = free.moved(s)
    again = free.restored(moved.arrays)
    assert again.count == moved.count and again.size == pytest.approx(moved.size, rel=1e-14)
    assert np.array_equal(again.made.surface.points, moved.made.surface.points)
    for one, other in zip(again.room(), moved.room(), strict=True):
        assert one.shape == other.shape


def test_one_place_that_would_fold_does_not_keep_back_the_others(form, surface):
    free, (_, s) = surface, moves_of(form)
    places, cell = free.mesh.points[free.nodes], free.part.domain.cell
    away = np.linalg.norm(places - places[0], axis=1)
    # How far a place must move to fold depends on the mesh, which every Gmsh makes its own.
    moves = (np.where(away < 0.5 * cell, far * cell, 0.1 * s) for far in (1.5, 3.0, 6.0))
    folding = next(one for one in moves if not free._moved(one).is_valid)
    moved = free.moved(folding)
    assert moved.is_valid
    went = ((moved.mesh.points - free.mesh.points)[free.nodes] * free.along).sum(axis=1)
    went /= np.square(free.along).sum(axis=1)
    far = away > 6.0 * cell
    assert far.sum() > 0.5 * len(far) and np.allclose(went[far], folding[far], atol=1e-12)
    assert np.abs(went[away < 0.5 * cell]).max() < 1.0 * cell


def test_a_surface_that_would_cross_itself_gives_way_to_that_of_the_mesh(
    form, surface, monkeypatch
):
    moved = surface.moved(moves_of(form)[1])
    monkeypatch.setattr("dolfinopt.part.solid.free_surface.crossings", lambda _: np.ones((1, 2)))
    assert moved.made.watertight
    assert moved.made.volume == pytest.approx(moved.size, rel=1e-12)


def test_a_surface_that_gmsh_cannot_mesh_keeps_its_triangles(form, surface, monkeypatch):
    """Its mesh is filled anew; there is no coarse one."""
    moved = surface.moved(moves_of(form)[1])

    def lost(*_):
        raise InputError("Gmsh finds no faces")

    monkeypatch.setattr("dolfinopt.part.mesh.tetrahedra_of", lost)
    part = moved.made
    meshes = mesh_parts({1: part})
    assert not meshes.coarse
    mesh = meshes.fine[1]
    assert mesh.volumes.sum() == pytest.approx(part.volume, rel=1e-6)
    assert mesh.quality.min() > 0.5 * moved.mesh.quality.min()
    for name in ("boundary", "inboard", "outboard"):
        before, after = (np.unique(one.points[getattr(one, name)].reshape(-1, 3), axis=0)
                         for one in (moved.mesh, mesh))  # fmt: skip
        assert before.shape == after.shape
        assert np.abs(before - after).max() < 1e-4  # m: it has the part's volume, not the mesh's


@pytest.mark.slow
def test_gradient_of_the_machine(form):
    """Remainders are of second order: compliance and volume of a moving arm."""
    _, _, _, problem, state = form
    free, (x, s) = state.outlines[1], moves_of(form)
    slope, left = problem.slopes(state)[0] @ x, []
    for h in (0.2, 0.05):
        moved = free.moved(h * s)
        mesh = moved.followed(state.bodies[1])
        found = problem.evaluated({1: moved}, {1: mesh}, state.simulated.trajectory.solutions)
        left.append(abs(found.values[0] - state.values[0] - h * slope))
    rate = np.log(left[0] / left[1]) / np.log(4.0)
    assert rate == pytest.approx(2.0, abs=0.1)


@pytest.mark.slow
def test_compliance_falls_at_no_more_volume(form):
    folder, _, part, *_ = form
    run("part", folder, "--optimize", "--iterations", "2", "--no-check", "--no-plots")
    figures = json.loads((folder / "part" / "part.json").read_text())
    shape, link = figures["optimize"], figures["arms"]["link1"]
    assert shape["after"] <= shape["before"]
    assert shape["iterations"] == 2 and shape["after"] < 0.985 * shape["before"]
    assert link["watertight"] and link["volume"] <= 1.01 * part.domain.volume
    assert do.load_scene(folder / "part" / "part.toml").arms[1].mesh is not None


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
def test_gradient_by_nodes(base, tmp_path, monkeypatch) -> None:
    """Remainders are of second order; a node in the middle of the solid counts nothing."""
    monkeypatch.setattr("dolfinopt.responses.stress.NEGLIGIBLE_POWER_SHARE", 0.0)
    (tmp_path / "bar.geo").write_text(BAR)
    plane, kind = base != "spatial_arm", "objective.kind=stress"
    told = (f"arms.mesh='{tmp_path}/bar.geo'", *PLANE) if plane else SPACE
    scene = do.load_scene(ROOT / "demos" / f"{base}.toml", (*ROUGHLY, *told, kind))
    stress = corner_stress_in_plane if plane else corner_stress_in_space

    def middle(length: float, places: np.ndarray, margin: float) -> np.ndarray:
        return (places[:, 0] > 0.15 * length) & (places[:, 0] < 0.85 * length)

    parts = {
        k: SimpleNamespace(stress=stress, regular=partial(middle, arm.length))
        for k, arm in enumerate(scene.arms)  # cells end at twelfths, or fifths
    }
    response = OutlineStress(scene.objective, parts)
    size = 0.01 if plane else 0.005  # m, of cells of 20 to 100 mm
    found = node_test(scene, solid, size, cut=not plane, response=response)
    assert found.slope != 0.0
    assert found.rate == pytest.approx(2.0, abs=0.1)


def solid(k: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return densities of solid material."""
    return np.ones_like(x)


def test_largest_is_that_of_the_part(tmp_path) -> None:
    """As the check of a part finds it; the p-mean is below."""
    folder = folder_with(tmp_path / "run", frame, "arms.cells=[100,6]", "simulation.sample=0.005")
    scene = scene_of(folder)
    parts = make_parts(scene, folder)
    state = simulate_parts(scene, parts, mesh_parts(parts).coarse)
    known = stress_of_parts(state.arms, state.trajectory, parts)
    response = OutlineStress(scene.objective, parts)
    designs = {k: arm.current for k, arm in state.arms.items()}
    place = state.scene, state.partition, designs, state.trajectory
    found = response.measure(Analysis(*place, do.Profile()))
    assert found.values[0] == pytest.approx(known[0].peak.value, rel=1e-9)
    assert 0.1 * found.values[0] < found.smooth[0] < found.values[0]
