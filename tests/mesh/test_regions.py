"""Parts of an arm that stay solid or void: which cells they are, in all designs, and refusals."""

import json

import numpy as np
import pytest
from matplotlib.colors import to_hex
from mpi4py import MPI
from runs import ROOT, STATED, TWO_ARM, refusal

import dolfinopt as do
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.output.design import gather_views
from dolfinopt.plots.design import REGION, design_figure

WORLD = MPI.COMM_WORLD
SMALL = ("arms.cells=[40,6]", "arms.passive=0.05", "arms.arm2.rigid=true")
HOLE = '{kind = "void", circle = [0.5, 0.0, 0.021]}'
SLOT = '{kind = "void", box = [0.2, -0.01, 0.3, 0.01], depth = [0.0, 0.006]}'
LUG = '{kind = "solid", box = [0.2, 0.01, 0.3, 0.05]}'  # beyond the edge, too


def regions(*words):
    return f"arms.arm1.regions=[{', '.join(words)}]"


def built(*changes):
    scene = do.load_scene(TWO_ARM, (*SMALL, *changes))
    partition = do.partition_arms(WORLD, scene.cell_counts)
    return scene, partition, do.build_arms(scene, partition, do.Profile())


def refused(words, *changes):
    return refusal(lambda: built(*changes), *words)


@pytest.mark.parametrize("symmetric", ["false", "true"])
def test_cells_of_regions(symmetric):
    """By their centroids; where the design is symmetric the mirror image counts, too."""
    _, _, arms = built(regions(HOLE, LUG), f"arms.symmetric={symmetric}")
    for arm in arms.values():
        x, y = arm.mesh.centroid.T
        side = np.abs(y) if symmetric == "true" else y
        lug = (x > 0.2) & (x < 0.3) & (side > 0.01)
        ends = (x < 0.05) | (x > 0.95)
        assert np.array_equal(arm.mesh.passive, lug | ends)
        assert np.array_equal(arm.mesh.void, (x - 0.5) ** 2 + y**2 < 0.021**2)
        assert arm.mesh.void.any() and lug.any()


@pytest.mark.parametrize("projection", ["false", "heaviside", "robust"])
@pytest.mark.parametrize("symmetric", ["false", "true"])
def test_regions_stay_in_every_design(projection, symmetric):
    scene, partition, arms = built(
        regions(HOLE, LUG), f"design.projection={projection}", f"arms.symmetric={symmetric}"
    )
    evaluator = Evaluator(scene, partition, arms, do.Profile())
    evaluator.projection.beta = 8.0
    variables = evaluator.variables
    x = np.clip(np.linspace(0.1, 0.9, variables.size), variables.xmin, variables.xmax)
    for design in evaluator.physical_designs(x):
        for k, one in design.items():
            mesh = arms[k].mesh
            assert (one.x_phys[mesh.passive] == 1.0).all() and (one.x_phys[mesh.void] == 0.0).all()
            by_x = arms[k].backward(np.ones(mesh.num_cells), one)
            assert (by_x[mesh.fixed] == 0.0).all() and (by_x[~mesh.fixed] > 0.0).any()
    fixed = variables.xmin == variables.xmax
    assert fixed.sum() == WORLD.allreduce(sum(arm.mesh.fixed.sum() for arm in arms.values()))


def test_regions_are_drawn():
    scene, partition, arms = built(regions(HOLE, LUG), "arms.symmetric=true")
    x_phys = {k: arm.uniform(0.5) for k, arm in arms.items()}
    views = gather_views(scene, partition, arms, x_phys)
    if WORLD.rank > 0:
        return
    kinds = [kind for kind, _ in views[0].regions]
    assert kinds == ["void", "void", "solid", "solid"]  # mirror images, too
    circle = views[0].regions[0][1]
    np.testing.assert_allclose(np.hypot(*(circle - [0.5, 0.0]).T), 0.021)
    drawn = design_figure(views[:1], "regions").axes[0].patches
    edges = [to_hex(patch.get_edgecolor()) for patch in drawn]
    assert edges == [REGION[kind] for kind in kinds]


@pytest.mark.serial
@pytest.mark.parametrize(
    ("region", "place", "allowed"),
    [
        ('{kind="hole", circle=[0.5,0,0.01]}', "regions.0.kind", '"solid" | "void"'),
        ("{circle=[0.5,0,0.01]}", "missing key arms.0.regions.0.kind", "solid or void"),
        ('{kind="void"}', "regions.0.kind", "one of box = [x0, y0, x1, y1] and circle"),
        ('{kind="void", box=[0.4,0,0.5,0.01], circle=[0.5,0,0.01]}', "regions.0.kind", "not both"),
        ('{kind="void", box=[0.4,0,0.5]}', "regions.0.box", "four numbers"),
        ('{kind="void", box=[0.5,0,0.4,0.01]}', "regions.0.box", "x0 < x1 and y0 < y1"),
        ('{kind="void", circle=[0.5,0,0.0]}', "regions.0.circle", "three numbers"),
        ('{kind="void", round=[0.5,0,0.01]}', "unknown key arms.0.regions.0.round", "kind, box"),
        ('{kind="void", circle=[500,0,10]}', "regions.0.circle", "x from 0 to 1"),
        ('{kind="void", circle=[0.5,0.05,0.01]}', "regions.0.circle", "y from -0.03 to 0.03"),
        ('{kind="void", circle=[0.5,0,0.001]}', "regions.0.circle", "centroid of no cell"),
        (f"{HOLE}, {HOLE.replace('void', 'solid')}", "regions.0.circle", "solid region"),
        ('{kind="void", circle=[0.02,0,0.03]}', "regions.0.circle", "arms.passive"),
        ('{kind="void", box=[0.4,-0.03,0.5,0.03]}', "regions.0.box", "not cut the arm"),
        ('{kind="void", box=[0.3,-0.02,0.6,-0.01]}, {kind="void", box=[0.3,0.01,0.6,0.02]}, '
         '{kind="void", box=[0.3,-0.02,0.325,0.02]}, {kind="void", box=[0.575,-0.02,0.6,0.02]}, '
         '{kind="solid", circle=[0.45,0,0.015]}', "regions.3.box", "neither interface"),
        (SLOT, "regions.0", "only with a solid arm"),
    ],
)  # fmt: skip
def test_bad_regions(region, place, allowed):
    refused([place, allowed], regions(region))


@pytest.mark.serial
def test_regions_belong_to_an_arm_with_cells_and_are_set_as_a_whole():
    """They are taken over from the arm before; void that stays makes room in the volume."""
    most = regions('{kind = "solid", box = [0.1, -0.03, 0.75, 0.03]}')
    refused(["two_arm.toml", "volume_fraction = 0.5", "arms.regions smaller"], most)
    built(most, "design.volume_fraction=0.8")
    refused(["design.volume_fraction = 0.5", "shorten arms.passive"], "arms.passive=0.26")
    refused(["none with rigid"], f"arms.arm2.regions=[{HOLE}]")
    data = do.load_scene(TWO_ARM, (*SMALL, regions(HOLE))).to_tree()
    assert do.scene_from_dict(data).arms[1].regions == ()
    words = "unknown key arms.0.regions.0.kind (arm1)", "as a whole", "an array of tables"
    refused(words, "arms.arm1.regions.0.kind=void")
    one = {"name": "arm1", "length": 1.0, "height": 0.06, "thickness": 0.01}
    one |= {"regions": [{"kind": "void", "circle": [0.5, 0.0, 0.01]}]}
    data = {"material": "POM", "arms": [one, {"name": "arm2"}, {"name": "arm3", "regions": []}]}
    scene = do.scene_from_dict(STATED | data, overrides=["arms.arm2.length=0.9"])
    assert scene.arms[0].regions == scene.arms[1].regions != ()
    assert scene.arms[2].regions == ()
    assert do.scene_from_dict(json.loads(json.dumps(scene.to_dict()))) == scene


BORES = (f"arms.arm1.mesh={ROOT / 'meshes' / 'arm_bores.geo'}", "arms.arm2.rigid=true")
BORES += ("arms.passive=0.0",)


def test_regions_of_a_mesh_file():
    _, _, arms = built(*BORES, regions(HOLE, LUG))
    for arm in arms.values():
        x, y = arm.mesh.centroid.T
        assert np.array_equal(arm.mesh.void, (x - 0.5) ** 2 + y**2 <= 0.021**2)
        assert arm.mesh.passive[(x > 0.2) & (x < 0.3) & (y > 0.01)].all()
    for region, words in (
        ('{kind="void", box=[0.4,-0.05,0.5,0.05]}', ["arms.arm1.regions.0.box", "not cut"]),
        (
            '{kind="void", circle=[5.0,0,0.1]}',
            ["two_arm.toml: arms.arm1.regions.0.circle", "of no"],
        ),
        ('{kind="solid", box=[0.05,-0.05,0.9,0.05]}', ["volume_fraction = 0.5", "solid cells"]),
    ):
        refusal(lambda: built(*BORES, regions(region)), *words)  # noqa: B023


SPACE = ROOT / "demos" / "spatial_arm.toml"
BLOCK = ("arms.cells=[12,4,4]", "arms.link2.rigid=true", "design.filter_radius=0.05")
RIB = '{kind = "solid", box = [0.1, 0.01, 0.4, 0.02]}'


@pytest.mark.serial
@pytest.mark.parametrize("symmetric", ["false", "true"])
def test_regions_of_solids_have_a_depth(symmetric):
    """Through the whole thickness, or from z0 to z1 (with its mirror image)."""
    changes = f"arms.link1.regions=[{SLOT}, {RIB}]", f"arms.symmetric_z={symmetric}"
    scene = do.load_scene(SPACE, (*BLOCK, *changes))
    partition = do.partition_arms(MPI.COMM_SELF, scene.cell_counts)
    mesh = do.build_arms(scene, partition, do.Profile())[1].mesh
    x, y, z = mesh.centroid.T
    depth = np.abs(z) if symmetric == "true" else z
    slot = (x > 0.2) & (x < 0.3) & (np.abs(y) < 0.01) & (depth > 0.0) & (depth < 0.006)
    assert np.array_equal(mesh.void, slot) and slot.any()
    rib = (x > 0.1) & (x < 0.4) & (y > 0.01)
    assert np.array_equal(mesh.passive & (x > 0.1) & (x < 0.4), rib) and rib.any()


@pytest.mark.serial
@pytest.mark.parametrize(
    ("region", "word"),
    [
        ('{kind="void", box=[0.2, -0.01, 0.3, 0.01], depth=[0.006, 0.0]}', "z0 < z1"),
        ('{kind="void", box=[0.2, -0.01, 0.3, 0.01], depth=[0.02, 0.03]}', "z from -0.01"),
        ('{kind="void", box=[0.2, -0.1, 0.3, 0.1], depth=[-0.1, 0.1]}', "nothing joins"),
        (SLOT, "extruded"),
    ],
)
def test_depths_that_cannot_be(region, word):
    design = "extruded" if word == "extruded" else "false"
    changes = f"arms.link1.regions=[{region}]", f"arms.symmetric={design}"

    def built() -> None:
        scene = do.load_scene(SPACE, (*BLOCK, *changes))
        do.build_arms(scene, do.partition_arms(MPI.COMM_SELF, scene.cell_counts), do.Profile())

    refusal(built, word)
