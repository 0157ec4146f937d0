"""Exact gradients: trajectories by differences, what a wrong one does, the cost."""

from dataclasses import replace

import numpy as np
import pytest
from remainders import taylor, wave
from runs import TWO_ARM, demo, refused, scene

from dolfinopt.dynamics.adjoint import Adjoint
from dolfinopt.multibody.shape_integrals import scaled
from dolfinopt.reduction import METHODS, AdjointFields, Method

QUICK = ("arms.cells=[24,3]", "motion.horizon=2.2", "simulation.tolerance=1e-3")
# At random designs of undamped arms the remainder's cubic part outweighs its square at 0.01.
FINER = tuple(0.00125 / 4.0**k for k in range(3))
LOADED = ["motion.gravity=[0.5,-9.81]", "payload.inertia=0.05"]


def rates(test):
    return {row.direction: round(row.rate, 3) for row in test.rows}


@pytest.mark.parametrize(
    ("key", "value", "remedy"),
    [
        ("reduction.method", "balanced", "craig-bampton"),
    ],
)
def test_nothing_to_check(key, value, remedy):
    """Where there is no exact gradient, one line says so and what to choose."""
    with refused(str(TWO_ARM), key, value, remedy):
        taylor(scene(*QUICK, f"{key}={value}"), wave, FINER)


@pytest.mark.serial  # ranks have no part in it
def test_frozen_deviation_stands_beside_the_exact_one():
    """Static loads tell most of a heavy payload's deviation, but not all."""
    test = taylor(scene(*QUICK, "objective.kind=deviation"), wave, FINER)
    assert test.passed, rates(test)
    assert 0.1 < test.angle < 45.0 and 0.5 < test.ratio < 1.0
    slopes = {row.direction: (row.slope, row.slope_frozen) for row in test.rows}
    exact, frozen = slopes["random"]
    assert abs(exact - frozen) > 0.1 * abs(exact)


def no_modes(patch):
    def nothing(_, basis, *__):
        return AdjointFields(0.0 * basis.V, 0.0 * basis.V)

    frozen = {name: Method(method.reduce, nothing) for name, method in METHODS.items()}
    patch.setattr("dolfinopt.responses.sensitivity.METHODS", frozen)


def no_trajectory(patch):
    def none(adjoint, *_):
        return [
            replace(scaled(body, 0.0, 0.0, 0.0), outboard=np.zeros_like(body.outboard))
            for body in adjoint.system.mechanism.bodies
        ]

    patch.setattr(Adjoint, "by_bodies", none)


def no_start(patch):
    patch.setattr("dolfinopt.dynamics.adjoint.add_gradients", lambda first, _: first)


def no_filter(patch):
    patch.setattr("dolfinopt.arms.arm.Arm.backward", lambda arm, slope, _: arm._active(slope))


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("fault", [no_modes, no_trajectory, no_start, no_filter])
def test_a_wrong_gradient_is_found(monkeypatch, fault):
    """Each part of the chain left out alone: the remainders become of first order, or less."""
    fault(monkeypatch)
    finest = (2e-5, 5e-6)
    test = taylor(scene(*QUICK, "design.filter_radius=0.05", *LOADED), wave, finest)
    assert not test.passed
    assert min(row.rate for row in test.rows) < 1.3


@pytest.mark.slow
@pytest.mark.serial
def test_payload_demo(shared_tmp_path, capsys):
    """Runs, tables and draws on few cells; a light payload gains by the exact gradient."""
    rows = demo("demo_payload").main(shared_tmp_path, (20, 2), (0.2,), 60)
    frozen, exact = rows
    assert (frozen["gradient"], exact["gradient"]) == ("esl", "exact")
    assert exact["compliance [N m]"] < 0.8 * frozen["compliance [N m]"]  # 0.70
    assert exact["material [-]"] < 0.45 < frozen["material [-]"]  # 0.397, 0.500
    lines = (shared_tmp_path / "payload.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 3 and lines[0] == ",".join(frozen)
    assert (shared_tmp_path / "payload.png").read_bytes().startswith(b"\x89PNG")
    assert "exact" in capsys.readouterr().out
