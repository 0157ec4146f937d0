"""What a design is compared with: solid arms before, straight bars of its mass after the run."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM, run, summary_of
from runs import overrides as told

import dolfinopt as do
from dolfinopt import progress
from dolfinopt.optimization.assessment import solid_sentence, straight_bars
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.output.design import read_history
from dolfinopt.parallel import partition_arms
from dolfinopt.plots.curves import limits_figure
from dolfinopt.responses.constraints import Limit

WORLD = MPI.COMM_WORLD
STATIC = ("arms.cells=[24,6]", "objective.kind=static", "design.filter_radius=0.03")
LIMITS = ("constraints.tip_deflection=1e-12", "optimizer.max_iterations=40")


@pytest.mark.parametrize("fraction", [0.3, 0.5, 0.8])
def test_bars_have_the_mass_of_the_design(fraction):
    """About the arm's axis, full in the middle, nothing outside; a cell may be cut."""
    scene, profile = do.load_scene(TWO_ARM, STATIC), do.Profile()
    partition = partition_arms(WORLD, scene.cell_counts)
    arms = do.build_arms(scene, partition, profile)
    evaluator = Evaluator(scene, partition, arms, profile)
    x = {k: np.full(arm.mesh.num_cells, fraction) for k, arm in arms.items()}
    for k, bar in straight_bars(evaluator, x).items():
        arm, least = arms[k], scene.design.minimum
        assert arm.volume_fraction(bar) == pytest.approx(fraction, rel=1e-6)
        y = np.abs(arm.mesh.centroid[:, 1])
        assert (bar[y < 0.5 * fraction * 0.06 - 0.006] == 1.0).all()
        np.testing.assert_allclose(bar[y > 0.5 * fraction * 0.06 + 0.006], least)


def test_what_solid_arms_do_not_keep_is_told(caplog):
    """Before the first iteration; under static loads nothing else keeps it either."""
    caplog.set_level(logging.INFO, "dolfinopt.progress")
    do.optimize(do.load_scene(TWO_ARM, (*STATIC, *LIMITS[:1], "optimizer.max_iterations=1")))
    assert "solid arms" not in caplog.text  # of studies and scripts
    limit = Limit("tip_deflection", "arm1", 2e-3, 1e-3, "m")
    assert solid_sentence([limit]) == (
        "solid arms: tip deflection of arm1 2 of 1 mm: 200 % (cannot be kept)"
    )
    deviation = Limit("deviation", "", 2e-3, 1e-3, "m")  # lighter arms may keep it
    assert solid_sentence([deviation]) == "solid arms: deviation 2 of 1 mm: 200 %"


@pytest.mark.serial
def test_the_last_lines_of_a_run(tmp_path, capsys, caplog, monkeypatch):
    """What was gained, which limits hold and how far, multipliers of those that bind."""
    caplog.set_level(logging.INFO, "dolfinopt.progress")
    monkeypatch.setattr(progress.log, "propagate", True)
    words = ("constraints.tip_deflection=1e-4", "optimizer.max_iterations=40")
    run("optimize", TWO_ARM, "--no-plots", "--out", tmp_path / "run", *told(*STATIC, *words))
    printed = capsys.readouterr()
    assert "solid arms: tip deflection of arm1" in caplog.text
    assert "below the starting design" in printed.out
    assert "straight solid bars of the same mass" in printed.out
    assert "  limits kept: volume fraction of arm1 0.5 of 0.5: 100 %" in printed.out
    assert "certificate" not in printed.out and "pieces" not in printed.out
    assert summary_of(tmp_path / "run")["bars"]["objective"] > 0.0
    rows = read_history(tmp_path / "run" / "history.csv")
    last = rows[-1]
    assert last.multipliers["volume_fraction_arm1"] > 0.0 and last.merit < rows[0].merit
    assert last.multipliers["tip_deflection_arm1"] == pytest.approx(0.0, abs=1e-9)
    arms = "arm1", "arm2"
    volumes = tuple(Limit("volume_fraction", arm, 0.5, 0.5, "-") for arm in arms)
    deflections = tuple(Limit("tip_deflection", arm, 1e-5, 1e-4, "m") for arm in arms)
    result = SimpleNamespace(rows=rows, limits=volumes + deflections)
    above, below = limits_figure(result).axes
    assert len(above.lines) == len(below.lines) == len(last.constraints)
    share = 100.0 * last.constraints["tip_deflection_arm1"] / 1e-4
    drawn = {line.get_label(): line.get_ydata()[-1] for line in above.lines}
    assert drawn["tip deflection of arm1"] == pytest.approx(share)
    result.limits = volumes
    assert limits_figure(result) is None
