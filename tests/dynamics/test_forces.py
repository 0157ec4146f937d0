"""Forces on interfaces, [[forces]]: closed forms and control."""

from dataclasses import replace

import numpy as np
import pytest
from machines import fork, trajectory_of, two_arm, with_keys

from dolfinopt.scene.load import scene_from_dict

pytestmark = pytest.mark.serial
ANGLE = 0.7  # rad, at which the arm is held
LENGTH, HEIGHT, THICKNESS, MODULUS = 1.0, 0.02, 0.01, 70e9


def held(folder, *forces, **changes):
    """Return one arm of solid material that its joint holds at `ANGLE`."""
    (folder / "held.csv").write_text(f"t,arm\n0,{ANGLE}\n0.1,{ANGLE}\n")
    tree = {
        "material": {"young_modulus": MODULUS, "poisson_ratio": 0.0, "density": 2700.0},
        "arms": [{"name": "arm", "length": LENGTH, "height": HEIGHT, "thickness": THICKNESS,
                  "cells": [100, 4]}],
        "motion": {"path": "joints", "file": "held.csv", "base": "fixed", "duration": 0.1,
                   "horizon": 0.1},
        "payload": {"mass": 0.0},
        "design": {"initial": 1.0, "volume_fraction": 1.0},
        "simulation": {"stiffening": False},
        "forces": list(forces),
    }  # fmt: skip
    return scene_from_dict(with_keys(tree, changes), str(folder / "held.toml"))


@pytest.mark.parametrize(
    ("force", "moment", "frame"),
    [((0.0, 2.0), 0.0, "arm"), ((0.0, 0.0), 1.5, "world"), ((0.0, -3.0), 1.0, "world")],
)
def test_cantilever_bends_by_the_closed_form(force, moment, frame, tmp_path):
    """Tip and joint of Timoshenko's beam, F L^3 / 3 E I + F L / k G A + M L^2 / 2 E I."""
    one = held(tmp_path, {"arm": "arm", "force": force, "moment": moment, "frame": frame})
    found = trajectory_of(one)
    own = complex(*force) * (np.exp(-1j * ANGLE) if frame == "world" else 1.0)
    EI, EA = MODULUS * THICKNESS * HEIGHT**3 / 12.0, MODULUS * THICKNESS * HEIGHT
    across = own.imag * (LENGTH**3 / (3.0 * EI) + LENGTH / (5.0 / 6.0 * 0.5 * EA))
    across += moment * LENGTH**2 / (2.0 * EI)
    tip = (own.real * LENGTH / EA + 1j * across) * np.exp(1j * ANGLE)
    # 100 cells leave 4e-5 to 1.1e-4, 50 cells 3e-4.
    assert found.deviation[-1] == pytest.approx([tip.real, tip.imag], rel=1.5e-4)
    assert np.ptp(found.distance) < 1e-9 * abs(tip)  # it begins in equilibrium
    place = LENGTH + complex(*found.deviation[0]) * np.exp(-1j * ANGLE)
    torque = -((np.conj(place) * own).imag + moment)
    assert found.joint_forces[0, 1] == pytest.approx(torque, rel=1e-9)


def test_force_along_the_arm_stiffens_it(tmp_path):
    """Pulled by P, a cantilever bends by F / P (L - tanh(kL) / k), k^2 = P / EI."""
    # Timoshenko & Gere, Theory of Elastic Stability (1961), sec. 1.11.
    pull, across = 400.0, 1.0
    forces = {"arm": "arm", "force": [pull, across], "frame": "arm"}
    changes = {"simulation": {"stiffening": True}, "reduction": {"coordinates": 8}}
    found = trajectory_of(held(tmp_path, forces, **changes))
    # The force keeps the arm's direction at rest, whatever the tip does.
    k = np.sqrt(pull / (MODULUS * THICKNESS * HEIGHT**3 / 12.0))
    exact = across / pull * (LENGTH - np.tanh(k * LENGTH) / k)
    tip = complex(*found.deviation[-1]) * np.exp(-1j * ANGLE)
    linear = across * LENGTH**3 / (3.0 * pull / k**2)
    assert linear / exact > 1.2
    assert tip.imag == pytest.approx(exact, rel=1e-3)


def test_feed_forward_knows_forces_unless_they_are_disturbances(tmp_path):
    """A moment that the control foresees leaves no error at the start, another one M / k."""
    push = {"arm": "arm2", "moment": 20.0}
    quick = ("arms.cells=[8,2]", "motion.horizon=2.0")
    for known in (True, False):
        tree = two_arm(*quick) | {
            "control": {"stiffness": [2e5, 2e4, 2e4], "damping": [2e4, 600.0, 600.0]},
            "forces": [push | {"feed_forward": known}],
        }
        found = trajectory_of(scene_from_dict(tree))
        error = found.motion.q[0, 1:] - found.desired.q[0, 1:]
        if known:
            assert np.abs(error).max() < 1e-12
        else:
            assert error == pytest.approx([20.0 / 2e4, 20.0 / 2e4], rel=1e-9)


def test_link_between_pin_and_cylinder_bears_its_force(tmp_path):
    """The joint of a link that its second interface pushes, in space, by the rigid lever."""
    (tmp_path / "table.csv").write_text("t,swing,slide\n0,0,0\n0.2,0,0\n")
    tree = with_keys(fork(), {"motion": {"gravity": [0.0, 0.0, 0.0]}})
    tree["joints"][0]["axis"] = [0, 0, 1]
    tree["arms"] = [dict(one) for one in tree["arms"][:2]]
    tree["joints"] = tree["joints"][:2]
    tree["payload"] = {"mass": 0.0}
    tree["simulation"] = {"stiffening": False}
    (tmp_path / "table.csv").write_text("t,swing\n0,0.3\n0.2,0.3\n")
    force = np.array([10.0, 50.0, 0.0])
    tree["forces"] = [{"arm": "link", "interface": "side", "force": list(force), "frame": "arm"}]
    one = scene_from_dict(tree, str(tmp_path / "link.toml"))
    found = trajectory_of(one)
    lever = np.array([0.29, 0.02, 0.0])
    # The interface has moved by the link's deflection, 2e-4 of the lever.
    assert found.joint_forces[-1, 0] == pytest.approx(-np.cross(lever, force)[2], rel=1e-3)
    assert found.compliance[-1, 0] > 0.0
    other = replace(found.problem.mechanism, forces=())
    assert other.sites[0] == (0,)
    assert found.mechanism.sites[0] == (0, 1)
