"""Effort of the drives: closed form of a point mass, balance of power, weights, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from runs import demo, scene

import dolfinopt as do
from dolfinopt import Model
from dolfinopt.paths import quintic
from dolfinopt.responses.constraints import constraint_label, limits_by_column, limits_of

# Ranks: limits of effort and peak force in test_every_option_gives_the_same_bits_on_any_number...
pytestmark = pytest.mark.serial
EFFORT = "objective.kind=effort"
KEPT = "constraints.compliance=1e6"  # N m; far away
SMALL = ("arms.cells=[20,3]", EFFORT, KEPT)


def point_mass_forces(t: np.ndarray, mass: float, gravity: float) -> np.ndarray:
    """Return the forces (n, 3) of cart, shoulder and elbow that move a point mass on the arc."""
    # Newton's law of the payload alone: arms of 1 m without mass hand its force on.
    s, sd, sdd = quintic(t, 1.9)
    place = np.exp(1j * np.pi * (1.0 - s))  # x + i y
    force = mass * ((-1j * np.pi * sdd - (np.pi * sd) ** 2) * place + 1j * gravity)
    shoulder = 0.5 * place.real - 0.5j
    chord = place - shoulder
    length = np.abs(chord)
    elbow = shoulder + 0.5 * chord + np.sqrt(1.0 - 0.25 * length**2) * 1j * chord / length
    moments = [(np.conj(place - joint) * force).imag for joint in (shoulder, elbow)]
    return np.stack([force.real, *moments], axis=1)


@pytest.mark.parametrize("weights", [None, (0.01, 0.02, 0.05), (0.0, 0.0, 1.0)])
@pytest.mark.parametrize("gravity", [0.0, 9.81])
def test_rigid_limit_is_newtons_law(gravity, weights) -> None:
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


def test_it_is_the_drives_root_mean_square_of_the_summary() -> None:
    """Weighted; of a fixed base the joints' alone."""
    for changes in ((), ("motion.base=fixed", "motion.radius=0.6")):
        made = scene(*SMALL, *changes)
        result = Model(made).simulate()
        rms = result.trajectory.drives[1][made.driven_columns]
        assert len(rms) == len(made.driven)
        assert result.objective == pytest.approx(np.linalg.norm(rms), rel=1e-12)
        assert result.unit == "-"


def test_peak_forces_are_limited_drive_by_drive() -> None:
    """The true values are the largest samples; smooth ones and weights only lead there."""
    limits = "constraints.peak_force=[20.0,30.0,10.0]"
    weighted = ["objective.effort_weights=[0.0,2.0,1.0]", "constraints.effort=100.0"]
    made = scene("arms.cells=[20,3]", limits, *weighted)
    result = Model(made).simulate()
    found = limits_of(made, result.evaluation)[-3:]
    assert [one.name for one in found] == [f"peak_force_{k}" for k in ("cart", "arm1", "arm2")]
    assert [one.unit for one in found] == ["N", "N m", "N m"]
    assert [one.limit for one in found] == [20.0, 30.0, 10.0]
    assert constraint_label("peak_force_cart") == "peak force of cart [N]"
    assert constraint_label("peak_force_arm2") == "peak force of arm2 [N m]"
    # As the optimiser has them, the true ones over their limits.
    relative = [one.value / one.limit - 1.0 for one in found]
    assert result.evaluation.constraints[-3:] == pytest.approx(relative, rel=1e-12)
    peaks = np.abs(result.trajectory.joint_forces).max(axis=0)
    assert [one.value for one in found] == pytest.approx(list(peaks), rel=1e-12)
    smooth = np.array(result.evaluation.responses[-1].smooth)
    assert (smooth < peaks).all() and (smooth > 0.7 * peaks).all()


def test_a_drive_may_have_no_limit() -> None:
    """As inf in a scene, and null in a summary's, which is read back."""
    made = scene("arms.cells=[20,3]", "constraints.peak_force=[inf,30.0,inf]")
    result = Model(made).simulate()
    (found,) = limits_of(made, result.evaluation)[-1:]
    assert (found.name, found.limit) == ("peak_force_arm1", 30.0)
    assert len(result.evaluation.constraints) == 3  # with the volumes of both arms
    assert limits_by_column(made, ["peak_force_arm1"]) == {"peak_force_arm1": 30.0}
    text = json.dumps(made.to_dict(), allow_nan=False)
    assert do.scene_from_dict(json.loads(text)) == made


def test_weighted_sum_of_peak_forces_as_objective() -> None:
    """Each p-mean times its weight; a large exponent brings it to the peaks."""
    weights = np.array([0.0, 2.0, 1.0])
    options = ["objective.effort_weights=[0.0,2.0,1.0]", "objective.exponent=200", KEPT]
    result = Model(scene("arms.cells=[20,3]", "objective.kind=peak_force", *options)).simulate()
    expected = float(weights @ np.abs(result.trajectory.joint_forces).max(axis=0))
    assert result.objective == pytest.approx(expected, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    "limit", ["effort=7.4", "peak_force=[100.0,15.0,7.0]"], ids=["effort", "peak force"]
)
def test_a_limit_of_the_drives_is_met(limit: str) -> None:
    """The stiffest light arms are heavier than these drives can take: true values end at it."""
    changes = ["arms.cells=[24,3]", "payload.mass=0.5", f"constraints.{limit}"]
    changes += ["design.volume_fraction=0.7", "design.filter_radius=0.05"]
    changes += ["simulation.tolerance=1e-3", "motion.horizon=2.2", "optimizer.max_iterations=30"]
    result = do.optimize(scene(*changes))
    assert not result.violated
    asked = [one for one in result.limits if one.quantity != "volume_fraction"]
    assert -5e-3 < max(one.excess for one in asked) <= 1e-3


def test_effort_demo(tmp_path: Path) -> None:
    """Runs, tables and draws on few cells."""
    rows = demo("demo_effort").main(tmp_path, (20, 2), 3)
    assert [row["design"] for row in rows] == ["least compliance", "least effort"]
    lines = (tmp_path / "effort.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 3 and lines[0].startswith("design,effort,deviation [mm]")
    assert (tmp_path / "effort.png").read_bytes().startswith(b"\x89PNG")


def test_the_gradient_is_exact_whatever_is_asked_for() -> None:
    """Frozen loads tell nothing of forces that come from mass."""
    model = Model(scene(*SMALL, "motion.horizon=2.2"))
    frozen, exact = (model.gradient(kind=kind) for kind in ("esl", "exact"))
    for name, values in exact.items():
        np.testing.assert_array_equal(values, frozen[name])
        assert values.any()
    # Material at the end of the last arm is carried by every drive.
    assert exact["arm2"][model.centroids["arm2"][:, 0] > 0.9].sum() > 0.0
