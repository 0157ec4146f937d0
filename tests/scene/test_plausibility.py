"""Warnings for what a scene may say, but hardly means."""

import pytest
from runs import ROOT, TWO_ARM, overrides, run, summary_of

from dolfinopt.scene.load import load_scene
from dolfinopt.scene.messages import implausible

pytestmark = pytest.mark.serial  # one rank shows all there is

DEMOS = sorted((ROOT / "demos").glob("*.toml"))


@pytest.mark.parametrize("demo", DEMOS, ids=lambda path: path.stem)
def test_demos_are_plausible(demo):
    assert implausible(load_scene(demo)) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("material.young_modulus=70", ["material.young_modulus = 70 Pa"]),
        ("material.young_modulus=70e12", ["material.young_modulus = 7e+13 Pa"]),
        ("arms.arm2.young_modulus=70e12", ["arms.arm2.young_modulus = 7e+13 Pa"]),
        ("material.density=2.7", None),  # aerogel and foam
        ("material.density=0.27", ["material.density = 0.27 kg/m3"]),
        ("material.density=2.7e5", ["material.density = 270000 kg/m3"]),
        ("arms.height=1.5", ["arms.arm1", "height, 1.5 m", "length, 1 m"]),
        ("arms.thickness=100", ["thickness 100 m", "factor of 1000"]),
        ("design.filter_radius=0.061", ["design.filter_radius = 0.061 m", "height"]),
        ("design.filter_radius=0.06", None),
        ("damping.stiffness_proportional=2", ["stiffness_proportional = 2 s"]),
        ("motion.gravity=[0, -981]", ["motion.gravity = [0.0, -981.0] m/s2", "30 m/s2"]),
        ("payload.mass=6e5", ["payload.mass = 600000 kg", "10000 times the mass"]),
    ],
)
def test_what_is_hardly_meant_is_told(change, words):
    found = implausible(load_scene(TWO_ARM, [change]))
    assert len(set(found)) == len(found)
    assert found == [] if words is None else all(word in found[0] for word in words)


def test_cells_too_coarse_for_solid_ends(tmp_path):
    """0.015 m of them; a cell's centre lies within it from 34 cells along the metre on."""
    scene = tmp_path / "scene.toml"
    scene.write_text(TWO_ARM.read_text().replace("passive = 0.0 ", "# "))
    coarse = implausible(load_scene(scene, ["arms.cells=[33, 2]"]))
    names = [line.split(":")[0] for line in coarse]
    assert names == ["arms.arm1.cells = [33, 2]", "arms.arm2.cells = [33, 2]"]
    assert implausible(load_scene(scene, ["arms.cells=[34, 2]"])) == []
    assert implausible(load_scene(scene, ["arms.cells=[33, 2]", "arms.passive=0"])) == []


def test_warnings_come_before_the_run_once_and_are_kept(tmp_path, capsys):
    changes = overrides("arms.cells=[12,2]", "material.density=0.5")
    run("simulate", TWO_ARM, "--no-plots", "--out", tmp_path / "out", *changes)
    words = "material.density = 0.5 kg/m3"
    assert capsys.readouterr().err.count(words) == 1
    assert any(words in warning for warning in summary_of(tmp_path / "out")["warnings"])
