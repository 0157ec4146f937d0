"""Machines of rigid arms alone: every command but those that design."""

import numpy as np
import pytest
from machines import with_keys
from runs import refusal, run, summary_of

import dolfinopt as do
from dolfinopt.part.folder import toml_text
from dolfinopt.scene.load import scene_from_dict

pytestmark = pytest.mark.serial
MASS, INERTIA, LENGTH, LOAD, EARTH = 2.0, 0.3, 1.0, 1.5, 9.81  # kg, kg m2, m, kg, m/s2
CONTROL = {"stiffness": [2e3], "damping": [20.0]}


def pendulum(folder, **tables):
    """Return one rigid arm with a payload on a table of its angle."""
    (folder / "swing.csv").write_text("t,arm\n0,-1.0\n0.6,0.8\n")
    tree = {
        "name": "pendulum",
        "material": {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2700.0},
        "arms": [{"name": "arm", "rigid": True, "length": LENGTH, "height": 0.05,
                  "thickness": 0.01, "mass": MASS, "inertia": INERTIA}],
        "motion": {"path": "joints", "file": str(folder / "swing.csv"), "base": "fixed",
                   "joint_height": 0.0, "horizon": 1.0, "gravity": [0.0, -EARTH]},
        "payload": {"mass": LOAD},
    }  # fmt: skip
    return with_keys(tree, tables)


@pytest.mark.parametrize("control", [None, CONTROL])
def test_torque_of_a_pendulum(control, tmp_path):
    """(J + m L^2 / 4 + M L^2) qdd + (m / 2 + M) g L cos q; under control the same, and no error."""
    result = do.Model(pendulum(tmp_path, control=control)).simulate()
    seen = result.trajectory.sampled
    inertia = INERTIA + MASS * LENGTH**2 / 4.0 + LOAD * LENGTH**2
    weight = (0.5 * MASS + LOAD) * EARTH * LENGTH
    torque = inertia * seen.motion.qdd[:, 1] + weight * np.cos(seen.motion.q[:, 1])
    assert np.abs(seen.joint_forces[:, 1] - torque).max() < 1e-9 * np.abs(torque).max()
    assert np.abs(seen.motion.qdd).max() > 1.0 and result.max_deviation < 1e-12


def test_commands(tmp_path, capsys):
    """Simulated, drawn anew, swept, exported; to optimise there is nothing."""
    scene, out = tmp_path / "scene.toml", tmp_path / "run"
    scene.write_text(toml_text(pendulum(tmp_path)))
    run("simulate", scene, "--out", out)
    assert summary_of(out)["max_deviation"] == 0.0 and summary_of(out)["grayness"] == 0.0
    (out / "machine.png").unlink()
    run("plot", out)
    assert (out / "machine.png").exists()
    run("sweep", scene, "--vary", "payload.mass=1,2", "--out", tmp_path / "sweep")
    assert "rigid arms" in capsys.readouterr().out
    run("export", out, "state-space", 0.3)
    with np.load(out / "state-space" / "state_space.npz") as data:
        assert data["states"].tolist() == ["arm", "arm rate"]
    for words in (("optimize", scene), ("gradient", scene), ("part", out),
                  ("compare", scene, "reductions")):  # fmt: skip
        refusal(lambda words=words: run(*words, "--out", tmp_path / "none"), "nothing to design")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("kind", ["eigenfrequency", "stress", "static"])
def test_responses_of_flexible_arms(kind, tmp_path):
    tree = pendulum(tmp_path, objective={"kind": kind})
    refusal(lambda: scene_from_dict(tree), "objective.kind", "no arm is flexible")
