"""Older words of a scene: each is read as what it is now, told once, and rewritten."""

import pytest
from runs import TWO_ARM

from dolfinopt.scene.load import read_scene, scene_from_dict
from dolfinopt.scene.messages import implausible
from dolfinopt.scene.old_words import read_old_words

pytestmark = pytest.mark.serial

FIXED = ("motion.base=fixed", "motion.radius=0.6")
VIBRATES = ("objective.kind=eigenfrequency",)
SHAPED = ("motion.shape=2", "objective.gradient=exact")
LOOP = "closures=[{name='loop', kind='slider', between=['arm2', 'ground'], axis=[1.0, 0.0]}]"
TURNS = (*FIXED[:1], "motion.path=rotation", "arms.1.length=0.5", LOOP)
ROBUST = ("design.projection=robust",)


@pytest.mark.parametrize(
    ("used", "old", "new"),
    [
        (TURNS, "motion.start_angle=0.1", "motion.initial_joints=[0.1]"),
        (FIXED, "motion.base_position=0.1", "motion.base=0.1"),
        (VIBRATES, "objective.follow=true", "objective.modes=first"),
        (SHAPED, "constraints.path_speed=9", "motion.max_speed=9"),
        (SHAPED, "constraints.path_acceleration=90", "motion.max_acceleration=90"),
        (SHAPED, "constraints.path_jerk=900", "motion.max_jerk=900"),
        (("part.optimize=true",), "part.iterations=3", "part.optimize=3"),
        ((), "simulation.stages=3", "simulation.sample=1e-3"),  # none of its own any more
        (ROBUST, "design.limits_on=eroded", "design.projection=robust-eroded"),
        (ROBUST, "design.limits_on=nominal", "design.projection=robust"),
        ((), "design.limits_on=eroded", "design.projection=false"),  # only robust ones have it
        ((), "arms.arm2.pattern=arm1", "arms.arm2.design=arm1"),
        (("reduction.coordinates=auto",), "reduction.tolerance=0.1", "reduction.coordinates=0.1"),
        ((), "objective.worst=deviation", "simulation.sample=1e-3"),
        ((), "constraints.damping_below=9", "simulation.sample=1e-3"),
        ((), "arms.arm1.ribs=3", "simulation.sample=1e-3"),
    ],
)
def test_a_scene_in_older_words_is_that_in_those_of_now(used, old, new):
    duration = ["motion.duration=1.9"] if used is SHAPED else []
    older, newer = (read_scene(TWO_ARM, [*used, word, *duration]) for word in (old, new))
    assert older == newer and newer.old_words == ()
    if not old.endswith("nominal"):
        table, *_, key = old.partition("=")[0].split(".")
        assert [f"{table}.{key} is read as" in line for line in implausible(older)] == [True]


def test_a_turn_about_an_axis_is_roll_pitch_and_yaw():
    arms = [{"angle": 0.1}, {"angle": 0.2, "angle_axis": [0, 1, 0]}, {}]
    tree = {"joints": [{}], "material": {"angle": 0.3, "angle_axis": [2.0, 0.0, 0.0]}, "arms": arms}
    assert len(read_old_words(tree, "scene.toml")) == 2
    for row, turn in zip((tree["material"], *arms), ([0.3, 0, 0], [0.1, 0, 0], [0, 0.2, 0], None)):
        assert row.get("angle") == (turn and pytest.approx(turn))


def test_a_start_of_zero_counts_beside_a_guess():
    tree = read_scene(TWO_ARM, [*TURNS, "motion.initial_joints=[0.1, 2.0]"]).to_dict()
    tree["motion"]["start_angle"] = 0.0
    assert scene_from_dict(tree).motion.initial_joints == (0.0, 2.0)


def test_a_run_folder_without_a_start_angle_is_read():
    tree = read_scene(TWO_ARM).to_dict()
    tree["motion"]["start_angle"] = 0.0
    assert scene_from_dict(tree).motion.initial_joints is None
