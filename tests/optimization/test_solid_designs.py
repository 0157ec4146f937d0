"""Optimisation in space: it resumes in the same bits, and is the same on any number of ranks."""

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT

import dolfinopt as do
from dolfinopt import parallel
from dolfinopt.fem import interior

WORLD = MPI.COMM_WORLD
DEMO = ROOT / "demos" / "spatial_arm.toml"
SMALL = ("arms.link1.cells=[6,2,2]", "arms.link2.cells=[6,2,2]", "arms.passive=0.08",
         "simulation.sample=0.05", "simulation.tolerance=1e-2",
         "objective.load_cases=3")  # fmt: skip


def small(*settings, iterations):
    """Return the chain in few cells."""
    return do.load_scene(DEMO, (*SMALL, f"optimizer.max_iterations={iterations}", *settings))


@pytest.mark.serial
def test_resumes_where_it_was(tmp_path, monkeypatch):
    """Eigenvectors, and what iterative solves set out from, are remembered."""
    # To 1e-10: products of arrays round otherwise where these lie elsewhere in memory (1e-12 seen).
    # From other guesses, with this tolerance of the fields, designs differ by 1e-4.
    monkeypatch.setattr(interior, "WIDEST", 0)
    # Loose, so that a guess is seen in what comes of it.
    monkeypatch.setattr("dolfinopt.arms.arm.FIELD_TOLERANCES", (1e-4, 1e-4))
    settings = "reduction.coordinates=7"
    whole = do.optimize(small(settings, iterations=2))
    do.optimize(small(settings, iterations=1), tmp_path)
    resumed = do.optimize(small(settings, iterations=2), tmp_path, resume=True)
    for k in whole.x_phys:
        np.testing.assert_allclose(resumed.x_phys[k], whole.x_phys[k], rtol=1e-10)
    for row, other in zip(resumed.history, whole.history, strict=True):
        assert row.objective == pytest.approx(other.objective, rel=1e-10)
    one, other = (found.certificate.kkt for found in (resumed, whole))
    assert one == pytest.approx(other, rel=1e-8)


@pytest.mark.skipif(WORLD.size == 1, reason="needs more than one rank")
@pytest.mark.parametrize("kind", ["esl", "exact"])
def test_same_design_where_ranks_share_a_link(kind, monkeypatch):
    """A link on all ranks and whole on one: 1e-8."""
    rigid = ("arms.link1.rigid=true", f"objective.gradient={kind}")
    settings = small(*rigid, iterations=2)
    alone = do.optimize(settings, world=MPI.COMM_SELF)
    monkeypatch.setattr(parallel, "SPLIT_CELLS", 0)
    shared = do.optimize(settings.model_copy(update={"name": "shared"}))
    assert shared.evaluation.objective == pytest.approx(alone.evaluation.objective, rel=1e-8)
    for k, arm in shared.arms.items():
        assert arm.mesh.num_cells < 24  # not the whole link
        places = [tuple(row) for row in np.rint(1e5 * arm.mesh.centroid).astype(int)]
        whole = np.rint(1e5 * alone.arms[k].mesh.centroid).astype(int)
        known = {tuple(row): x for row, x in zip(whole, alone.x_phys[k], strict=True)}
        expected = [known[place] for place in places]
        assert shared.x_phys[k] == pytest.approx(expected, abs=1e-8)
