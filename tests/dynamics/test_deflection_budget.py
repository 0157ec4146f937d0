"""Where the largest deflection comes from: against statics by hand, and their sum."""

import pytest
from machines import fork, loop_tree, simulated, two_arm, with_keys
from runs import TWO_ARM, demo, overrides, run, summary_of

from dolfinopt.dynamics.budget import deflection_budget

pytestmark = pytest.mark.serial

MASS, EARTH = 4.0, 9.81  # kg, m/s2
WEIGHT = MASS * EARTH
BEARING = [2e6, 5e5, 0.0, 0.0, 0.0, 3e4]
GEAR, GAIN = 1e4, 4e4  # N m/rad
LENGTHS = (0.6, 0.4)  # m


def budget_of(tree):
    """Return the budget of a scene's initial design."""
    found = deflection_budget(simulated(tree).trajectory)
    assert found is not None
    return found


def by_part(budget):
    """Return the deflections of all parts, m, by kind and name."""
    return {(one.kind, one.name): one.deflection for one in budget.parts}


def held_level(tmp_path, **changes):
    """Return a level, rigid beam and a level arm at its end, weightless, that hold a payload."""
    file = tmp_path / "still.csv"
    file.write_text("t,beam,arm\n0,0,0\n0.2,0,0\n")
    bar = {"height": 0.05, "thickness": 0.02, "passive": 0.0, "density": 1e-3}
    tree = two_arm()
    tree["arms"] = [
        {"name": "beam", "length": LENGTHS[0], "rigid": True, "mass": 0.0, "inertia": 0.0, **bar},
        {"name": "arm", "length": LENGTHS[1], "cells": [80, 10], **bar, "gear_stiffness": GEAR,
         "bearing_stiffness": BEARING},
    ]  # fmt: skip
    tree |= {
        "motion": {"path": "joints", "file": str(file), "base": "fixed", "joint_height": 0.0,
                   "duration": 0.2, "horizon": 0.2, "gravity": [0.0, -EARTH]},
        "payload": {"mass": MASS},
        "control": {"stiffness": [GAIN, GAIN], "damping": [100.0, 100.0], "feed_forward": "none"},
    }  # fmt: skip
    return with_keys(tree, {"simulation": {"stiffening": False}, "design": {"initial": 1.0},
                            "objective": {"kind": "deviation"}, **changes})  # fmt: skip


def test_softer_parts_are_the_linear_whole(tmp_path):
    """What the sum leaves out is of second order of itself: a tenth of the load, a hundredth."""
    apart = []
    for mass in (MASS, 0.1 * MASS):
        one = budget_of(held_level(tmp_path, payload={"mass": mass}))
        apart.append(abs(one.linear / one.deviation - 1.0))
    assert apart[0] / apart[1] == pytest.approx(100.0, rel=0.05)


def test_gear_on_a_prescribed_motor(tmp_path):
    """Without control what a motor on its desired angle leaves is the gear's; links first."""
    tree = held_level(tmp_path)
    budget = budget_of({**tree, "control": None})
    assert list(budget.shares) == ["links", "bearings", "gears"]
    expected = WEIGHT * LENGTHS[1] ** 2 / GEAR
    assert by_part(budget)["gear", "arm"] == pytest.approx(expected, rel=1e-4)


def test_statics_in_space(tmp_path):
    """A level link that carries its load to the side: bending and twist of bearing, gear, drive."""
    file = tmp_path / "still.csv"
    file.write_text("t,lift\n0,0\n0.2,0\n")
    length, side = 0.5, 0.2
    springs = [1e6, 2e6, 3e6, 4e4, 5e4, 6e4]
    tree = fork() | {
        "name": "still",
        "arms": [{"name": "link", "length": length, "height": 0.05, "thickness": 0.05,
                  "cells": [16, 2, 2], "passive": 0.0, "density": 1.0}],
        "design": {"initial": 1.0},
        # Turned about y, the link's z is the world's: the load is along -z, its arm along y.
        "joints": [{"name": "lift", "type": "revolute", "parent": "ground", "child": "link",
                    "axis": [0, 1, 0], "bearing_stiffness": springs, "gear_stiffness": GEAR}],
        "motion": {"path": "joints", "file": str(file), "horizon": 0.2, "gravity": [0, 0, -EARTH]},
        "payload": {"mass": MASS, "offset": [0.0, side, 0.0]},
        "control": {"stiffness": [GAIN], "damping": [100.0], "feed_forward": "none"},
    }  # fmt: skip
    tree["reduction"] = {"coordinates": 6}
    tree["simulation"] = {"stiffening": False, "tolerance": 1e-5}
    budget = budget_of(tree)
    found = by_part(budget)
    assert found["gear", "lift"] == pytest.approx(WEIGHT * length**2 / GEAR, rel=5e-4)
    assert found["control", "lift"] == pytest.approx(WEIGHT * length**2 / GAIN, rel=5e-4)
    # The end is the interface, off the load's line by `side`: twist about x does not lower it.
    bearing = WEIGHT * (1.0 / springs[2] + length**2 / springs[4])
    assert found["bearing", "lift"] == pytest.approx(bearing, rel=5e-4)
    bent = WEIGHT * length**3 / (3.0 * 70e9 * 0.05**4 / 12.0)
    assert found["link", "link"] == pytest.approx(bent, rel=0.03)  # shear is 1 %, few cells
    assert budget.linear == pytest.approx(sum(found.values()), rel=1e-14)


def test_of_a_slider_and_of_a_pin(tmp_path):
    """A slider's deviation is that of its rod; a pinned end has none."""
    budget = budget_of(loop_tree("slider"))
    assert list(budget.shares) == ["links"]
    assert budget.linear == pytest.approx(budget.deviation, rel=0.05)
    assert deflection_budget(simulated(loop_tree("pin")).trajectory) is None


def test_motors_ahead_take_off_what_gears_give(tmp_path):
    """At rest nothing is left of gear and drive; the rest stays."""
    rigid, wound = (
        by_part(budget_of(held_level(tmp_path, control={"feed_forward": one})))
        for one in ("rigid", "elastic")
    )
    gear = WEIGHT * LENGTHS[1] ** 2 / GEAR
    assert rigid["gear", "arm"] == pytest.approx(gear, rel=1e-4)
    assert abs(wound["gear", "arm"]) < 1e-4 * gear and abs(wound["control", "arm"]) < 1e-4 * gear
    for part in (("link", "arm"), ("bearing", "arm")):
        assert wound[part] == pytest.approx(rigid[part], rel=1e-4)


@pytest.mark.slow
def test_budget_of_the_demo(tmp_path):
    """Gears hold most of the deflection; lighter links hold more of it than before."""
    rows = demo("demo_geared_robot").main(tmp_path, 2)
    before, after, *ahead = rows
    assert before["gears [mm]"] > 0.8 * before["deflection [mm]"]
    assert after["mass of links [kg]"] < before["mass of links [kg]"]
    assert after["links [mm]"] > before["links [mm]"]
    assert all(row["gears [mm]"] < 0.1 * before["gears [mm]"] for row in ahead)
    assert (tmp_path / "budget.png").read_bytes().startswith(b"\x89PNG")


def test_budget_is_the_first_thing_told(tmp_path, capsys):
    """On the screen, in summary.json and as a table, all the same."""
    run("simulate", TWO_ARM, "--no-plots", "--out", tmp_path / "run", *overrides(
        "arms.cells=[16,3]", "motion.horizon=1.9", "simulation.tolerance=1e-3",
        "arms.gear_stiffness=1e4"))  # fmt: skip
    summary = summary_of(tmp_path / "run")
    found = summary["deflection_budget"]
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(
        f"the deviation comes from links {100.0 * found['shares']['links']:.3g} %, "
    )
    assert lines[1].startswith(f"at {found['instant']:.3f} s")
    assert found["deviation"] == summary["max_deviation"]
    rows = (tmp_path / "run" / "budget.csv").read_text().splitlines()
    assert rows[0] == "kind,part,deflection [m],share [-]"
    for row, part, line in zip(rows[1:], found["parts"], lines[2:6], strict=True):
        kind, name, deflection, share = row.split(",")
        assert (kind, name) == (part["kind"], part["name"]) == tuple(line.split()[:2])
        assert float(deflection) == pytest.approx(part["deflection"], rel=1e-9)
        assert float(share) == pytest.approx(part["share"], rel=1e-9)
