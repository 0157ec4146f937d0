"""Settling in every rest: after the motion, in stops of its path, and in dwells that are stated."""

from __future__ import annotations

import numpy as np
import pytest
from runs import TWO_ARM, overrides, refused, run, scene, summary_of, tomllib

import dolfinopt as do
from dolfinopt.dynamics.build import rests_of
from dolfinopt.part.folder import toml_text
from dolfinopt.responses.constraints import deviation_limits, limits_of
from dolfinopt.responses.response import find
from dolfinopt.scene.load import scene_from_dict

pytestmark = pytest.mark.serial
# A fast stroke, a dwell, and a slow one: the first leaves the larger vibration.
FIRST = "t,cart,arm1,arm2\n0,0,2.0,-1.5\n0.3,0.1,1.7,-1.2\n"
BOTH = FIRST + "0.6,0.1,1.7,-1.2\n1.6,0,1.4,-1.0\n"
QUICK = ("arms.cells=[16,2]", "simulation.tolerance=1e-5", "simulation.sample=0.01",
         "damping.stiffness_proportional=2e-3", "payload.mass=0.5",
         "objective.gradient=exact")  # fmt: skip


def strokes(folder, text, *changes):
    """Return the two-arm scene on a table of joints."""
    file, last = folder / f"strokes{len(text)}.csv", text.split()[-1].split(",")[0]
    file.write_text(text)
    return scene("motion.path=joints", f"motion.file={file}", f"motion.duration={last}",
                 "motion.horizon=2", *QUICK, *changes)  # fmt: skip


def moved(one):
    """Return evaluation and trajectory of the initial design."""
    found = do.Model(one).simulate()
    return found.evaluation, found.trajectory


def test_the_vibration_between_two_strokes_counts(tmp_path):
    """It is that which the first stroke leaves by itself, and more than the last one does."""
    evaluation, both = moved(strokes(tmp_path, BOTH, "constraints.settling=1e-3"))
    dwell = (both.t >= 0.3) & (both.t <= 0.6)
    last = both.distance[both.t >= 1.6].max()
    assert rests_of(both.scene) == ((0.3, 0.6), (1.6, 2.0))
    assert both.settling == both.distance[dwell].max() > 2.5 * last
    limits = {one.quantity: one for one in limits_of(both.scene, evaluation)}
    assert limits["settling"].value == both.settling
    _, alone = moved(strokes(tmp_path, FIRST, "motion.horizon=0.6"))
    assert both.settling == pytest.approx(alone.settling, rel=1e-3)
    assert deviation_limits(both.scene) == [(1e-3, 0.3, 0.6), (1e-3, 1.6, 2.0)]
    without = strokes(tmp_path, BOTH, "motion.dwells=false")
    assert rests_of(without) == ((1.6, 2.0),)
    assert moved(without)[1].settling == pytest.approx(last, rel=1e-6)


def test_dwells_that_are_stated_take_the_place_of_stops(tmp_path):
    stated = strokes(tmp_path, BOTH, "motion.dwells=[[0.4,0.5],[1.2,1.6]]",
                     "constraints.settling_after=0.05")  # fmt: skip
    # The second one goes on in the rest after the motion.
    assert rests_of(stated) == ((0.45, 0.5), (1.25, 2.0))
    _, one = moved(stated)
    counted = ((one.t >= 0.45 - 1e-9) & (one.t <= 0.5 + 1e-9)) | (one.t >= 1.25 - 1e-9)
    assert np.array_equal(one.at_rest, counted)
    assert one.settling == one.distance[counted].max()
    response = find("settling")(stated.objective)
    p = stated.objective.exponent
    mean = np.mean(one.distance[counted] ** p) ** (1.0 / p)
    assert response.of_motion(one) == pytest.approx(mean, rel=0.02)  # but for the ends' weights


def test_a_stop_at_the_end_of_a_table_begins_the_last_rest(tmp_path):
    text = BOTH + "1.8,0,1.4,-1.0\n"
    assert rests_of(strokes(tmp_path, text)) == ((0.3, 0.6), (1.6, 2.0))
    # Before the first move nothing has settled.
    late = "t,cart,arm1,arm2\n0,0,2,-1\n0.1,0,2,-1\n0.4,0,1.5,-1\n"
    assert rests_of(strokes(tmp_path, late)) == ((0.4, 2.0),)
    law = strokes(tmp_path, BOTH, "motion.law=trapezoidal")
    assert rests_of(law) == ((0.3, 0.6), (1.6, 2.0))


def test_without_stops_settling_is_as_ever():
    one = scene(*QUICK)
    assert rests_of(one) == ((one.motion.duration, one.motion.horizon),)
    _, trajectory = moved(one)
    after = trajectory.t >= one.motion.duration - 1e-9 * one.motion.horizon
    assert np.array_equal(trajectory.at_rest, after)
    assert "settling_after" not in one.constraints.limits


def test_a_dwell_is_longer_than_the_delay(tmp_path):
    delay = "constraints.settling_after=0.3"
    with refused("motion.dwells", "settling_after = 0.3 [s]", "[0.4, 0.6]"):
        scene("motion.dwells=[[0.4,0.6]]", delay)
    # The stops of a table are known with it.
    one = strokes(tmp_path, BOTH, delay)
    with refused("settling_after = 0.3: expected less than 0.3 [s]", "from 0.3 to 0.6 s"):
        do.Model(one)


def test_the_summary_tells_the_same(tmp_path):
    delay = "constraints.settling_after=0.1"
    one = strokes(tmp_path, BOTH, delay)
    told = ["motion.path=joints", f"motion.file={one.motion.file}", "motion.duration=1.6",
            "motion.horizon=2", *QUICK, delay]  # fmt: skip
    run("simulate", TWO_ARM, "--out", tmp_path / "run", "--no-plots", *overrides(*told))
    summary = summary_of(tmp_path / "run")
    _, trajectory = moved(one)
    inside = (trajectory.t >= 0.4 - 1e-9) & (trajectory.t <= 0.6 + 1e-9)
    assert summary["settling"] == trajectory.distance[inside].max()
    assert summary["scene"]["motion"]["dwells"] is True


def test_dwells_stand_in_the_scene_of_a_part():
    """part.toml is written by the same function."""
    told = scene("motion.dwells=[[0.4,0.5],[1.2,1.6]]", "constraints.settling_after=0.05")
    again = scene_from_dict(tomllib.loads(toml_text(told.to_tree())))
    assert rests_of(again) == rests_of(told) == ((0.45, 0.5), (1.25, 1.6), (1.95, 3.0))
    none = scene_from_dict(tomllib.loads(toml_text(scene("motion.dwells=false").to_tree())))
    assert none.motion.dwells is False
