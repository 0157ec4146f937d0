"""Older words of a scene: each is read as what it is now, told once, and rewritten."""

import pytest
from runs import TWO_ARM, run

from dolfinopt.scene.load import read_scene
from dolfinopt.scene.messages import implausible

pytestmark = pytest.mark.serial

FIXED = ("motion.base=fixed", "motion.radius=0.6")
VIBRATES = ("objective.kind=eigenfrequency",)
SHAPED = ("motion.shape=2", "objective.gradient=exact")
ROBUST = ("design.projection=robust",)


@pytest.mark.parametrize(
    ("used", "old", "new"),
    [
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
    ],
)
def test_a_scene_in_older_words_is_that_in_those_of_now(used, old, new) -> None:
    duration = ["motion.duration=1.9"] if used is SHAPED else []
    older, newer = (read_scene(TWO_ARM, [*used, word, *duration]) for word in (old, new))
    assert older == newer and newer.old_words == ()
    if not old.endswith("nominal"):
        table, *_, key = old.partition("=")[0].split(".")
        assert [f"{table}.{key} is read as" in line for line in implausible(older)] == [True]


def test_upgrade_rewrites_a_file(tmp_path) -> None:
    """Comments and order stay; the file as it was is kept beside it."""
    text = TWO_ARM.read_text(encoding="utf-8")
    older = text.replace("[motion]", '[motion]\nbase = "fixed"\nbase_position = 0.1')
    older = older.replace("projection = false", 'projection = "robust"\nlimits_on = "eroded"')
    file = tmp_path / "scene.toml"
    file.write_text(older, encoding="utf-8")
    before = read_scene(file)
    run("keys", "--upgrade", file)
    after = read_scene(file)
    assert after == before and before.old_words and not after.old_words
    assert file.read_text(encoding="utf-8").count("#") == older.count("#")
    assert after.motion.base == 0.1 and after.design.projection == "robust-eroded"
