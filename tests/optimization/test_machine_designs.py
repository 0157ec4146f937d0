"""Optimised machines of plane and space: results, and what goes with control and loops."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT, assert_same_bits, overrides, run, summary_of

import dolfinopt as do
from dolfinopt import parallel
from dolfinopt.dynamics import radau
from dolfinopt.fem import interior
from dolfinopt.optimization import loop
from dolfinopt.parallel import on_root

WORLD = MPI.COMM_WORLD
CONTROLLED, SLIDER_CRANK, FOUR_BAR = (
    ROOT / "demos" / f"{name}.toml" for name in ("controlled_two_arm", "slider_crank", "four_bar")
)
COARSE = {
    CONTROLLED: ["arms.cells=[30,4]", "design.filter_radius=0.03", "motion.horizon=2.2"],
    SLIDER_CRANK: ["arms.rod.cells=[40,6]", "design.filter_radius=0.008"],
    FOUR_BAR: ["arms.coupler.cells=[40,6]", "arms.rocker.cells=[36,6]",
               "design.filter_radius=0.008"],
}  # fmt: skip
ROUGHLY = "simulation.tolerance=1e-2"
DEMOS = pytest.mark.parametrize("path", COARSE, ids=lambda path: path.stem)


def coarse(path: Path, *changes: str, iterations: int = 3):
    changes = (*COARSE[path], f"optimizer.max_iterations={iterations}", *changes)
    return do.load_scene(path, changes)


# Objective at the start and after 15 iterations; largest deviation in mm after them.
RESULTS = {
    CONTROLLED: (0.0470233, 0.0113337, 13.2711),
    SLIDER_CRANK: (0.0126551, 0.00610026, 0.0813227),
    FOUR_BAR: (0.000244071, 7.51492e-05, 0.0),
}


@pytest.mark.serial
@DEMOS
def test_demo(path):
    """What a demo ends with, on few cells: the figures of this version."""
    result = do.optimize(coarse(path, iterations=15))
    before, after, deviation = RESULTS[path]
    first, last = result.history[0], result.history[-1]
    assert first.objective == pytest.approx(before, rel=1e-4)
    assert last.objective == pytest.approx(after, rel=1e-2)
    assert 1e3 * last.max_deviation == pytest.approx(deviation, rel=2e-2, abs=1e-6)
    assert last.volume_fraction <= 0.5 + 1e-3


@pytest.mark.slow
@pytest.mark.serial  # ranks: the same of other scenes in test_optimization
@DEMOS
def test_resumes_in_the_same_bits(path, shared_tmp_path):
    whole = do.optimize(coarse(path, ROUGHLY))
    do.optimize(coarse(path, ROUGHLY, iterations=1), shared_tmp_path)
    resumed = do.optimize(coarse(path, ROUGHLY), shared_tmp_path, resume=True)
    assert_same_bits(resumed, whole)


@pytest.mark.slow
@pytest.mark.serial
def test_a_marched_run_resumes_in_the_same_bits(shared_tmp_path, monkeypatch):
    """Drives at their limits let Newton's method fail over the horizon: steps are remembered."""
    marches, march = [], radau.March.run
    monkeypatch.setattr(radau.March, "run", lambda self: (marches.append(1), march(self))[1])
    bound = ("control.limits=[300,150,60]", "simulation.tolerance=1e-4")
    whole = do.optimize(coarse(CONTROLLED, *bound))
    assert marches
    do.optimize(coarse(CONTROLLED, *bound, iterations=1), shared_tmp_path)
    resumed = do.optimize(coarse(CONTROLLED, *bound), shared_tmp_path, resume=True)
    assert_same_bits(resumed, whole)


@pytest.mark.skipif(WORLD.size == 1, reason="needs more than one rank")
@DEMOS
def test_same_design_on_any_number_of_ranks(path):
    together = do.optimize(coarse(path, ROUGHLY, iterations=2))
    scene = coarse(path, ROUGHLY, iterations=2)
    alone = on_root(WORLD, lambda: do.optimize(scene, world=MPI.COMM_SELF).x_phys)
    for k in together.x_phys:
        np.testing.assert_allclose(together.x_phys[k], alone[k], rtol=0, atol=1e-8)


TWO_LOADS = "scenarios=[{{changes=['{}']}}, {{changes=['{}']}}]"
VARIANTS = {
    "gains of a scenario": (
        CONTROLLED, TWO_LOADS.format("payload.mass=3", "control.stiffness_factor=0.1")),
    "speed of a scenario": (SLIDER_CRANK, TWO_LOADS.format("payload.mass=0.3", "motion.speed=100")),
    "projection under control": (CONTROLLED, "design.projection=robust", "design.sharpness=4.0"),
    "order under control": (CONTROLLED, "reduction.coordinates=auto"),
    # Much of a rod's load is axial, in which modes add up slowly.
    "order of a rod": (SLIDER_CRANK, "reduction.coordinates=auto", "reduction.tolerance=0.02",
                       ),
    "force on the slider of a scenario": (
        SLIDER_CRANK, TWO_LOADS.format("closure.force=-200", "closure.force=0")),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("name", VARIANTS)
def test_goes_with(name, monkeypatch):
    """The objective falls within eight iterations, by the gradient of all variants together."""
    monkeypatch.setattr(loop, "begins_with_frozen_loads", lambda scene: False)
    path, *changes = VARIANTS[name]
    result = do.optimize(coarse(path, ROUGHLY, *changes, iterations=8))
    objectives = [row.objective for row in result.history]
    assert objectives[-1] < 0.95 * objectives[0], objectives


@pytest.mark.serial
def test_cut_design_that_falls_apart_is_told(shared_tmp_path):
    """Cut at one half before it is crisp, a rod cannot be simulated: the result is kept."""
    changes = ["design.projection=heaviside", "design.sharpness=4.0", "optimizer.max_iterations=1"]
    short = ["motion.duration=0.03", "motion.horizon=0.03"]  # every step fails in many ways
    words = [*COARSE[SLIDER_CRANK], *short, *changes]
    out = "--no-plots", "--out", shared_tmp_path / "rod"
    run("optimize", SLIDER_CRANK, *overrides(*words), *out)
    summary = summary_of(shared_tmp_path / "rod")
    assert "crisp" not in summary
    assert any("cut at a density of one half" in one for one in summary["warnings"])


# -- optimisation in space: it resumes in the same bits, and is the same on any number of ranks  --


DEMO = ROOT / "demos" / "spatial_arm.toml"
SMALL = ("arms.link1.cells=[6,2,2]", "arms.link2.cells=[6,2,2]", "arms.passive=0.08",
         "simulation.sample=0.05", "simulation.tolerance=1e-2",
         "objective.load_cases=3")  # fmt: skip


def small(*settings, iterations):
    """Return the chain in few cells."""
    return do.load_scene(DEMO, (*SMALL, f"optimizer.max_iterations={iterations}", *settings))


KILLED = """
import os, signal, sys
from pathlib import Path
import dolfinopt as do
from dolfinopt.fem import interior
from dolfinopt.optimization import loop

interior.WIDEST, loop.CHECKPOINT_SECONDS = int(sys.argv[2]), 0.0
scene = do.load_scene(sys.argv[3], sys.argv[4:])

def report(row):
    if row.iteration == 1:
        os.kill(os.getpid(), signal.SIGKILL)

do.optimize(scene, Path(sys.argv[1]), report=report)
"""


@pytest.mark.serial
@pytest.mark.parametrize(("width", "error"), [(0, 1e-12), (10**9, 0.0)], ids=["cg", "factor"])
def test_resumes_where_it_was_killed(width, error, tmp_path, monkeypatch):
    """Designs by factors in the same bits; by conjugate gradients, which start from zero, nearly.

    Products of arrays round otherwise where these lie elsewhere in memory.
    """
    monkeypatch.setattr(interior, "WIDEST", width)
    settings = "reduction.coordinates=7"
    scene = small(settings, iterations=3)
    whole = do.optimize(scene)
    keys = *SMALL, "optimizer.max_iterations=3", settings
    words = [sys.executable, "-c", KILLED, str(tmp_path), str(width), str(DEMO), *keys]
    killed = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    resumed = do.optimize(scene, tmp_path, resume=True)
    assert len(resumed.history) == len(whole.history)
    for k in whole.x_phys:
        np.testing.assert_allclose(resumed.x_phys[k], whole.x_phys[k], rtol=error)
    for row, other in zip(resumed.history, whole.history, strict=True):
        assert row.objective == pytest.approx(other.objective, rel=error, abs=0.0)
    one, other = (found.certificate.kkt for found in (resumed, whole))
    assert one == pytest.approx(other, rel=1e4 * error, abs=0.0)


@pytest.mark.skipif(WORLD.size == 1, reason="needs more than one rank")
@pytest.mark.parametrize("kind", ["esl", "exact"])
def test_same_design_where_ranks_share_a_link(kind, monkeypatch):
    """A link on all ranks and whole on one: 1e-8."""
    rigid = ("arms.link1.rigid=true", f"objective.gradient={kind}")
    settings = small(*rigid, iterations=2)
    alone = do.optimize(settings, world=MPI.COMM_SELF)
    monkeypatch.setattr(parallel, "SPLIT_CELLS", 0)
    shared = do.optimize(settings.unchecked_copy({"name": "shared"}))
    assert shared.evaluation.objective == pytest.approx(alone.evaluation.objective, rel=1e-8)
    for k, arm in shared.arms.items():
        assert arm.mesh.num_cells < 24  # not the whole link
        places = [tuple(row) for row in np.rint(1e5 * arm.mesh.centroid).astype(int)]
        whole = np.rint(1e5 * alone.arms[k].mesh.centroid).astype(int)
        known = {tuple(row): x for row, x in zip(whole, alone.x_phys[k], strict=True)}
        expected = [known[place] for place in places]
        assert shared.x_phys[k] == pytest.approx(expected, abs=1e-8)
