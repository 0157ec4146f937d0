"""Materials by name, and warnings of what a scene hardly means."""

import json

import pytest
from runs import ROOT, TWO_ARM, overrides, run, summary_of
from scenes import minimal, refused

from dolfinopt.scene.load import pose_scenarios, read_scene, scene_from_dict
from dolfinopt.scene.messages import implausible
from dolfinopt.scene.tables.material import CATALOGUE, SOURCES

pytestmark = pytest.mark.serial


def tree(solid, **arm2):
    data = minimal(material=solid)
    data["arms"][1] |= arm2
    return data


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_material_is_a_plausible_one_with_a_source(name):
    scene, known = scene_from_dict(tree(name)), CATALOGUE[name]
    held = scene.material.model_dump(mode="json", exclude_none=True)
    assert held == {"name": name, "kind": "isotropic", **known}
    assert len(SOURCES[name]) > 10
    assert implausible(scene) == []
    # Yield strains from that of mild steel to that of plastics.
    if "yield_strength" in known:
        assert 1e-3 < known["yield_strength"] / known["young_modulus"] < 0.03
    assert scene_from_dict(json.loads(json.dumps(scene.to_dict()))) == scene


def test_numbers_take_the_place_of_the_catalogue():
    name = "aluminium 7075-T6"
    assert scene_from_dict(tree(name)) == scene_from_dict(tree({"name": name}))
    own = scene_from_dict(tree({"name": name, "density": 2790.0})).material
    assert (own.density, own.young_modulus, own.yield_strength) == (2790.0, 71.7e9, 460e6)
    scene = scene_from_dict(tree(name), overrides=["material.young_modulus=70e9"])
    assert (scene.material.young_modulus, scene.material.density) == (70e9, 2810.0)
    for key in ("material", "material.name"):  # numbers of the file do not outlive another name
        known = {"name": "steel S355", "kind": "isotropic", **CATALOGUE["steel S355"]}
        found = read_scene(TWO_ARM, [f"{key}=steel S355"]).material
        assert found.model_dump(exclude_none=True) == known
    assert read_scene(TWO_ARM).material.yield_strength is None
    assert read_scene(TWO_ARM, ["material.yield_strength=95e6"]).material.yield_strength == 95e6


def test_an_arm_has_its_own_material():
    data = tree("steel S235", material="titanium Ti-6Al-4V", density=4500.0)
    data["arms"].append({"name": "arm3"})
    data["arms"].append({"name": "arm4", "material": "POM"})
    scene = scene_from_dict(data)
    first, second, third, fourth = (scene.material_of(i) for i in range(4))
    assert first == scene.material
    assert (second.young_modulus, second.density) == (113.8e9, 4500.0)
    assert third == second  # taken over, like all keys
    assert fourth.density == CATALOGUE["POM"]["density"]
    changed = scene_from_dict(data, overrides=["arms.arm2.material=PEEK"])
    assert changed.material_of(1).density == CATALOGUE["PEEK"]["density"]


CARBON = {"kind": "orthotropic", "young_modulus": [140e9, 10e9], "shear_modulus": 5e9,
          "poisson_ratio": 0.3, "density": 1600.0}  # fmt: skip


def test_an_arm_is_of_another_kind_than_the_scene():
    data = tree("steel S235", **CARBON, angle=0.5)
    data["arms"] += [{"name": "arm3", "angle": 0.1}, {"name": "arm4", "kind": "isotropic"}]
    data["arms"][3] |= {"young_modulus": 70e9, "poisson_ratio": 0.3, "density": 2700.0}
    scene = scene_from_dict(data)
    first, second, third, fourth = (scene.material_of(i) for i in range(4))
    assert first == scene.material
    assert (second.young_modulus, second.angle, second.density) == ((140e9, 10e9), 0.5, 1600.0)
    assert second.yield_strength is None  # not the steel's
    assert third == second.model_copy(update={"angle": 0.1})
    assert (fourth.kind, fourth.angle) == ("isotropic", None)
    data["arms"].append({"name": "arm5", "material": "CFRP unidirectional", "angle": 0.2})
    assert scene_from_dict(data).material_of(4).modulus == 181e9
    assert scene_from_dict(json.loads(json.dumps(scene.to_dict()))) == scene


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"young_modulus": 140e9}, ["material.young_modulus", "[E1, E2]"]),
        ({"shear_modulus": None}, ["material.shear_modulus", "a value", "shear modulus of"]),
        ({"young_modulus": [140e9, 10e9, 10e9]}, ["young_modulus", "2 of an arm in plane stress"]),
        ({"poisson_ratio": 3.75}, ["poisson_ratio", "|nu12| < sqrt(E1/E2) = 3.742"]),
        ({"poisson_ratio": [0.3, 1.0, 0.3]}, ["|nu23| < sqrt(E2/E3) = 1"]),
        ({"poisson_ratio": [2.2, 0.9, 2.2]}, ["smaller ratios"]),
        ({"angle": [0.0, 0.0, 0.1]}, ["material.angle", "plane stress"]),
        ({"yield_strength": 1e9}, ["material.yield_strength", 'none with kind = "orthotropic"']),
        ({"kind": "isotropic"}, ["material.shear_modulus", 'none with kind = "isotropic"']),
    ],
)
def test_constants_that_no_material_has(change, words):
    solid = {key: value for key, value in (CARBON | change).items() if value is not None}
    refused(tree(solid), *words)


def test_what_needs_a_strength_or_one_modulus_is_refused():
    """A limit on stress; scenarios that change more than a factor of all stiffness."""
    words = "arm1 is orthotropic", "no strength criterion", "limit deviation"
    refused(tree(CARBON) | {"constraints": {"stress": 1e8}}, "constraints.stress", *words)
    refused(tree("POM", **CARBON) | {"objective": {"kind": "stress"}}, "objective.kind", "arm2 is")
    for change in ("material.shear_modulus=6e9", "material.angle=0.1"):
        data = tree(CARBON) | {"scenarios": [{"changes": [change]}]}
        refused(data, "scenarios.0.changes", "of the material density alone")
    data = tree(CARBON) | {"scenarios": [{"changes": ["material.density=1700"]}]}
    assert pose_scenarios(scene_from_dict(data))[0].material.density == 1700
    # An arm of its own kind states all values.
    refused(tree(CARBON, kind="isotropic", poisson_ratio=0.3), "arms.1.young_modulus (arm2)")
    refused(tree("POM", angle=0.1), "arms.1.angle (arm2) = 0.1", 'none with kind = "isotropic"')


def test_a_misspelt_material_is_suggested():
    for name, near in (("aluminum 7075-T6", '"aluminium 7075-T6"'), ("Steel s355", '"steel S355"'),
                       ("42crmo4", '"steel 42CrMo4"'), ("pla", '"PLA printed"')):  # fmt: skip
        refused(tree(name), "material.name = ", "did you mean", near)
        refused(tree("POM", material=name), "arms.1.material (arm2) = ", "did you mean", near)


def test_scenarios_change_values_not_the_material():
    data = tree("steel S235") | {"scenarios": [{"changes": ["material.density=7800"]}]}
    assert pose_scenarios(scene_from_dict(data))[0].material.density == 7800
    for change in ("material=steel S355", "material.name=steel S355"):
        data["scenarios"] = [{"changes": [change]}]
        refused(data, "not another material")


def test_keys_lists_the_catalogue(capsys):
    run("keys", "material")
    said = capsys.readouterr().out
    assert all(name in said and source in said for name, source in SOURCES.items())
    run("keys", "Steel S")
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.startswith("material")
    assert [row[:10] for row in rows] == ["steel S235", "steel S355"]


# -- warnings for what a scene may say, but hardly means  -----------------------------------------


DEMOS = sorted((ROOT / "demos").glob("*.toml"))


@pytest.mark.parametrize("demo", DEMOS, ids=lambda path: path.stem)
def test_demos_are_plausible(demo):
    assert implausible(read_scene(demo)) == []


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
    found = implausible(read_scene(TWO_ARM, [change]))
    assert len(set(found)) == len(found)
    assert found == [] if words is None else all(word in found[0] for word in words)


def test_cells_too_coarse_for_solid_ends(tmp_path):
    """0.015 m of them; a cell's centre lies within it from 34 cells along the metre on."""
    scene = tmp_path / "scene.toml"
    scene.write_text(TWO_ARM.read_text().replace("passive = 0.0 ", "# "))
    coarse = implausible(read_scene(scene, ["arms.cells=[33, 2]"]))
    names = [line.split(":")[0] for line in coarse]
    assert names == ["arms.arm1.cells = [33, 2]", "arms.arm2.cells = [33, 2]"]
    assert implausible(read_scene(scene, ["arms.cells=[34, 2]"])) == []
    assert implausible(read_scene(scene, ["arms.cells=[33, 2]", "arms.passive=0"])) == []


def test_warnings_come_before_the_run_once_and_are_kept(tmp_path, capsys):
    changes = overrides("arms.cells=[12,2]", "material.density=0.5")
    run("simulate", TWO_ARM, "--no-plots", "--out", tmp_path / "out", *changes)
    words = "material.density = 0.5 kg/m3"
    assert capsys.readouterr().err.count(words) == 1
    assert any(words in warning for warning in summary_of(tmp_path / "out")["warnings"])
