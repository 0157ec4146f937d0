"""Values of a scene that follow from others."""

import pytest
from runs import ROOT, TWO_ARM

import dolfinopt as do

SPACE = ROOT / "demos" / "spatial_arm.toml"
FORK = 'arms.link2.interfaces=[{name="side", point=[0.2, 0.02, 0.0], radius=0.02}]'


@pytest.fixture(scope="module")
def unstated(tmp_path_factory):
    """Return the spatial demo without its number of coordinates."""
    path = tmp_path_factory.mktemp("unstated") / "arm.toml"
    text = SPACE.read_text().replace("coordinates = 6 ", "# ")
    path.write_text(text.replace('"spatial_arm.csv"', f'"{SPACE.with_suffix(".csv")}"'))
    return path


@pytest.mark.serial
def test_coordinates_of_solid_arms(unstated):
    """Six of every outboard interface; in the plane four."""
    assert do.load_scene(TWO_ARM).reduction.coordinates == 4
    scene = do.load_scene(unstated)
    assert scene.reduction.coordinates == 6
    assert "coordinates" not in scene.to_tree()["reduction"]
    assert do.load_scene(unstated, [FORK, "payload.interface=side"]).reduction.coordinates == 12
    assert do.load_scene(unstated, ["reduction.coordinates=7"]).reduction.coordinates == 7
    assert do.load_scene(unstated, ["reduction.method=modal"]).reduction.coordinates == 4
