"""Kinds of responses against closed forms: effort of drives, settling, orientation, stiffness."""

import json

import numpy as np
import pytest
from machines import held_link
from remainders import built_of
from runs import demo, refused, scene

import dolfinopt as do
from dolfinopt import Model
from dolfinopt.motion.build import rests
from dolfinopt.plots.curves import deviation_limits
from dolfinopt.responses.constraints import limits_of
from dolfinopt.responses.response import find
from dolfinopt.scene.laws import Limits, law_for

# Ranks: limits of effort and peak force in test_every_option_gives_the_same_bits_on_any_number...
EFFORT = "objective.kind=effort"
QUINTIC = law_for("quintic", 1.0, Limits(), 0.25)
KEPT = "constraints.compliance=1e6"  # N m; far away
SMALL = ("arms.cells=[20,3]", EFFORT, KEPT)


def point_mass_forces(t, mass, gravity):
    """Return the forces (n, 3) of cart, shoulder and elbow that move a point mass on the arc."""
    # Newton's law of the payload alone: arms of 1 m without mass hand its force on.
    s, sd, sdd = QUINTIC(t, 1.9)
    place = np.exp(1j * np.pi * (1.0 - s))  # x + i y
    force = mass * ((-1j * np.pi * sdd - (np.pi * sd) ** 2) * place + 1j * gravity)
    shoulder = 0.5 * place.real - 0.5j
    chord = place - shoulder
    length = np.abs(chord)
    elbow = shoulder + 0.5 * chord + np.sqrt(1.0 - 0.25 * length**2) * 1j * chord / length
    moments = [(np.conj(place - joint) * force).imag for joint in (shoulder, elbow)]
    return np.stack([force.real, *moments], axis=1)


@pytest.mark.serial
@pytest.mark.parametrize("weights", [None, (0.01, 0.02, 0.05), (0.0, 0.0, 1.0)])
@pytest.mark.parametrize("gravity", [0.0, 9.81])
def test_rigid_limit_is_newtons_law(gravity, weights):
    """Stiff arms of hardly any mass: the payload's inertia is all that the drives feel."""
    changes = [f"motion.gravity=[0.0, {-gravity}]", "material.density=1e-3"]
    changes += ["material.young_modulus=1e14", "simulation.stiffening=false"]
    changes += [] if weights is None else [f"objective.effort_weights={list(weights)}"]
    result = Model(scene(*SMALL, *changes)).simulate()
    w = np.ones(3) if weights is None else np.array(weights)
    t = np.linspace(0.0, 3.0, 30001)
    squares = ((w * point_mass_forces(t, 6.0, gravity)) ** 2).sum(axis=1)
    expected = np.sqrt(np.sum(0.5 * (squares[1:] + squares[:-1]) * np.diff(t)) / 3.0)
    assert result.objective == pytest.approx(expected, rel=1e-4)


@pytest.mark.serial
def test_it_is_the_drives_root_mean_square_of_the_summary():
    """Weighted; of a fixed base the joints' alone."""
    for changes in ((), ("motion.base=fixed", "motion.radius=0.6")):
        made = scene(*SMALL, *changes)
        result = Model(made).simulate()
        rms = result.trajectory.drives[1][made.driven_columns]
        assert len(rms) == len(made.driven)
        assert result.objective == pytest.approx(np.linalg.norm(rms), rel=1e-12)
        assert result.unit == "-"


@pytest.mark.serial
def test_peak_forces_are_limited_drive_by_drive():
    """The true values are the largest samples; smooth ones and weights only lead there."""
    limits = "constraints.peak_force=[20.0,30.0,10.0]"
    weighted = ["objective.effort_weights=[0.0,2.0,1.0]", "constraints.effort=100.0"]
    made = scene("arms.cells=[20,3]", limits, *weighted)
    result = Model(made).simulate()
    found = limits_of(made, result.evaluation)[-3:]
    assert [one.name for one in found] == [f"peak_force_{k}" for k in ("cart", "arm1", "arm2")]
    assert [one.unit for one in found] == ["N", "N m", "N m"]
    assert [one.limit for one in found] == [20.0, 30.0, 10.0]
    assert [one.words for one in found][::2] == ["peak force of cart", "peak force of arm2"]
    # As the optimiser has them, the true ones over their limits.
    relative = [one.value / one.limit - 1.0 for one in found]
    assert result.evaluation.constraints[-3:] == pytest.approx(relative, rel=1e-12)
    peaks = np.abs(result.trajectory.joint_forces).max(axis=0)
    assert [one.value for one in found] == pytest.approx(list(peaks), rel=1e-12)
    smooth = np.array(result.evaluation.responses[-1].smooth)
    assert (smooth < peaks).all() and (smooth > 0.7 * peaks).all()


@pytest.mark.serial
def test_a_drive_may_have_no_limit():
    """As inf in a scene, and null in a summary's, which is read back."""
    made = scene("arms.cells=[20,3]", "constraints.peak_force=[inf,30.0,inf]")
    result = Model(made).simulate()
    (found,) = limits_of(made, result.evaluation)[-1:]
    assert (found.name, found.limit) == ("peak_force_arm1", 30.0)
    assert len(result.evaluation.constraints) == 3  # with the volumes of both arms
    text = json.dumps(made.to_dict(), allow_nan=False)
    assert do.scene_from_dict(json.loads(text)) == made


@pytest.mark.serial
def test_weighted_sum_of_peak_forces_as_objective():
    """Each p-mean times its weight; a large exponent brings it to the peaks."""
    weights = np.array([0.0, 2.0, 1.0])
    options = ["objective.effort_weights=[0.0,2.0,1.0]", "objective.exponent=200", KEPT]
    result = Model(scene("arms.cells=[20,3]", "objective.kind=peak_force", *options)).simulate()
    expected = float(weights @ np.abs(result.trajectory.joint_forces).max(axis=0))
    assert result.objective == pytest.approx(expected, rel=0.03)


@pytest.mark.serial
def test_effort_demo(tmp_path):
    """Runs, tables and draws on few cells."""
    rows = demo("demo_effort").main(tmp_path, (20, 2), 3)
    assert [row["design"] for row in rows] == ["least compliance", "least effort"]
    lines = (tmp_path / "effort.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 3 and lines[0].startswith("design,effort,deviation [mm]")
    assert (tmp_path / "effort.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.serial
def test_the_gradient_is_exact_whatever_is_asked_for():
    """Frozen loads tell nothing of forces that come from mass."""
    model = Model(scene(*SMALL, "motion.horizon=2.2"))
    frozen, exact = (model.gradient(kind=kind) for kind in ("esl", "exact"))
    for name, values in exact.items():
        np.testing.assert_array_equal(values, frozen[name])
        assert values.any()
    # Material at the end of the last arm is carried by every drive.
    assert exact["arm2"][model.centroids["arm2"][:, 0] > 0.9].sum() > 0.0


# -- settling in every rest: after the motion, in stops of its path, and in dwells that are state


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


@pytest.mark.serial
def test_the_vibration_between_two_strokes_counts(tmp_path):
    """It is that which the first stroke leaves by itself, and more than the last one does."""
    evaluation, both = moved(strokes(tmp_path, BOTH, "constraints.settling=1e-3"))
    dwell = (both.t >= 0.3) & (both.t <= 0.6)
    last = both.distance[both.t >= 1.6].max()
    assert rests(both.scene) == ((0.3, 0.6), (1.6, 2.0))
    assert both.settling == both.distance[dwell].max() > 2.5 * last
    limits = {one.quantity: one for one in limits_of(both.scene, evaluation)}
    assert limits["settling"].value == both.settling
    _, alone = moved(strokes(tmp_path, FIRST, "motion.horizon=0.6"))
    assert both.settling == pytest.approx(alone.settling, rel=1e-3)
    assert deviation_limits(both.scene) == [(1.0, 0.3, 0.6), (1.0, 1.6, 2.0)]
    without = strokes(tmp_path, BOTH, "motion.dwells=false")
    assert rests(without) == ((1.6, 2.0),)
    assert moved(without)[1].settling == pytest.approx(last, rel=1e-6)


@pytest.mark.serial
def test_dwells_that_are_stated_take_the_place_of_stops(tmp_path):
    stated = strokes(tmp_path, BOTH, "motion.dwells=[[0.4,0.5],[1.2,1.6]]",
                     "constraints.settling_after=0.05")  # fmt: skip
    # The second one goes on in the rest after the motion.
    assert rests(stated) == ((0.45, 0.5), (1.25, 2.0))
    _, one = moved(stated)
    counted = ((one.t >= 0.45 - 1e-9) & (one.t <= 0.5 + 1e-9)) | (one.t >= 1.25 - 1e-9)
    assert np.array_equal(one.at_rest, counted)
    assert one.settling == one.distance[counted].max()
    response = find("settling")(stated.objective)
    p = stated.objective.exponent
    mean = np.mean(one.distance[counted] ** p) ** (1.0 / p)
    assert response.of_motion(one) == pytest.approx(mean, rel=0.02)  # but for the ends' weights


@pytest.mark.serial
def test_a_stop_at_the_end_of_a_table_begins_the_last_rest(tmp_path):
    text = BOTH + "1.8,0,1.4,-1.0\n"
    assert rests(strokes(tmp_path, text)) == ((0.3, 0.6), (1.6, 2.0))
    # Before the first move nothing has settled.
    late = "t,cart,arm1,arm2\n0,0,2,-1\n0.1,0,2,-1\n0.4,0,1.5,-1\n"
    assert rests(strokes(tmp_path, late)) == ((0.4, 2.0),)
    law = strokes(tmp_path, BOTH, "motion.law=trapezoidal")
    assert rests(law) == ((0.3, 0.6), (1.6, 2.0))


@pytest.mark.serial
def test_a_dwell_is_longer_than_the_delay(tmp_path):
    delay = "constraints.settling_after=0.3"
    with refused("motion.dwells", "settling_after = 0.3 [s]", "[0.4, 0.6]"):
        scene("motion.dwells=[[0.4,0.6]]", delay)
    # The stops of a table are known with it.
    with refused("settling_after = 0.3: expected less than 0.3 [s]", "from 0.3 to 0.6 s"):
        strokes(tmp_path, BOTH, delay)


# -- orientation: how far the end-effector is turned from where rigid links would hold it  --------


YOUNG, LENGTH, HEIGHT, THICKNESS, MASS, GRAVITY = 70e9, 1.0, 0.04, 0.02, 2.0, 9.81  # SI
LINKS = {
    kind: {"height": HEIGHT, "thickness": THICKNESS, "cells": cells}
    for kind, cells in (("plane", [60, 4]), ("space", [40, 2, 2]))
}


def machine(kind, folder, *changes):
    """Return a solid cantilever of no weight with a payload, held still."""
    gravity = [0.0, -GRAVITY] + [0.0] * (kind == "space")
    return held_link(folder, LINKS[kind], gravity, changes, payload={"mass": MASS})


SOLID = "design.initial=1.0", "design.volume_fraction=1.0"
SAGGING = "control={feed_forward='none', stiffness=[2e4], damping=[600.0]}"  # N m/rad, N m s/rad


@pytest.mark.serial
@pytest.mark.parametrize("controlled", [False, True])
@pytest.mark.parametrize("kind", LINKS)
def test_cantilever_under_its_payload(kind, controlled, tmp_path):
    """theta = F L^2 / (2 E I) about z, and with control what the joint gives way, F L / k."""
    changes = (*SOLID, SAGGING) if controlled else SOLID
    run = do.Model(machine(kind, tmp_path, *changes)).simulate()
    force, inertia = MASS * GRAVITY, THICKNESS * HEIGHT**3 / 12.0
    expected = force * LENGTH**2 / (2.0 * YOUNG * inertia) + controlled * force * LENGTH / 2e4
    turned = run.trajectory.rotation
    # The clamped face hinders lateral contraction: measured 9e-4 in the plane, 3.3e-3 in space.
    assert turned[0, -1] == pytest.approx(-expected, rel=5e-3)
    assert np.abs(turned[:, :-1]).max(initial=0.0) < 1e-12
    assert run.trajectory.max_rotation == np.linalg.norm(turned, axis=1).max()


# -- stiffness of single arms under given loads: Timoshenko's cantilever, a limit kept  -----------


@pytest.mark.serial
@pytest.mark.parametrize("dim", [2, 3])
def test_timoshenkos_cantilever(dim, tmp_path):
    """u = F L^3 / (3 EI) + F L / (k G A) + M L^2 / (2 EI), theta = F L^2 / (2 EI) + M L / EI."""
    L, b, h, E, nu, F, M = 1.0, 0.02, 0.1, 70e9, 0.3, 100.0, 20.0
    inertia, area = b * h**3 / 12.0, b * h
    shear = 5.0 / 6.0 * E / (2.0 * (1.0 + nu)) * area
    u = F * L**3 / (3.0 * E * inertia) + F * L / shear + M * L**2 / (2.0 * E * inertia)
    theta = F * L**2 / (2.0 * E * inertia) + M * L / (E * inertia)
    case = {"arm": "link", "displacement": u, "rotation": 0.9 * theta}
    case |= {2: {"force": [0.0, F], "moment": M},
             3: {"force": [0.0, F, 0.0], "moment": [0.0, 0.0, M]}}[dim]  # fmt: skip
    link = {"height": h, "thickness": b, "cells": [60, 6, 1][:dim]}
    tables = {"payload": {"mass": 1.0}, "objective": {"kind": "static"}}
    one = held_link(tmp_path, link, [0.0] * dim, constraints={"stiffness": [case]}, **tables)
    built = built_of(one)
    place, turn = limits_of(one, built.evaluate(built.uniform(1.0))[0])[1:]
    # The clamped edge hinders lateral contraction: measured 0.3 %.
    assert (place.value, turn.value) == pytest.approx((u, theta), rel=5e-3)
    assert (place.name, place.unit) == ("stiffness_link_case1", "m")
    assert (turn.name, turn.unit) == ("stiffness_link_case1_rotation", "rad")
    assert not turn.met and "stiffness of link_case1_rotation" in turn.usage
