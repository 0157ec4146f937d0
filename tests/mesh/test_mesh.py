"""Meshes: the parametric geometry, its groups, and the facets between cells."""

import json
import subprocess
import sys

import dolfinx
import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT, STATED, refusal

import dolfinopt as do
from dolfinopt.arms.arm import Arm as ScenesArm
from dolfinopt.data import mesh_folder
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import box_arm, interior_facets
from dolfinopt.mesh.checks import cell_areas
from dolfinopt.mesh.gmsh_session import DESIGN, INBOARD, OUTBOARD, PASSIVE
from dolfinopt.scene.load import Arm

COMM = MPI.COMM_WORLD
# Gmsh places the points of a curve by integrating its length to Mesh.LcIntegrationPrecision = 1e-9;
# measured here: off by 2e-12 of the curve's length at most.
PLACING = 1e-10

SHAPES = [  # length m, height m, cells
    (1.0, 0.06, (20, 4)),
    (2.5, 0.1, (50, 3)),
    (0.3, 0.5, (1, 1)),
    (0.7, 0.2, (1, 7)),
    (3.0, 0.02, (7, 1)),
    (10.0, 0.01, (400, 2)),  # a thousand times longer than high
]


def arm(length=1.0, height=0.06, cells=(20, 4), passive=0.0, comm=COMM):
    return box_arm(comm, "arm", (length, height), cells, passive)


def collect(values):
    """Return the owned rows of all ranks."""
    return np.concatenate(COMM.allgather(values))


@pytest.fixture(scope="module", params=SHAPES, ids=str)
def shaped(request):
    """Return length, height, cells and the mesh made of them."""
    return *request.param, arm(*request.param)


def test_cells_tile_the_arm(shaped):
    length, height, cells, mesh = shaped
    centroid, area = collect(mesh.centroid), collect(mesh.area)
    assert mesh.num_cells == len(mesh.centroid) == compat.local_cell_counts(mesh.mesh)[0]
    assert len(area) == cells[0] * cells[1]
    size = np.array([length / cells[0], height / cells[1]])
    corner = (centroid - [0.0, -0.5 * height]) / size - 0.5
    found = set(map(tuple, np.rint(corner).astype(int).tolist()))
    assert found == {(i, j) for i in range(cells[0]) for j in range(cells[1])}
    assert np.abs((corner - np.rint(corner)) * size).max() < PLACING * length
    tolerance = PLACING * (length / size[0] + height / size[1])
    assert np.abs(area / size.prod() - 1.0).max() < tolerance
    assert np.array_equal(mesh.outboard_point, [length, 0.0])
    assert not mesh.passive.any()


def test_interfaces_are_the_short_sides(shaped):
    length, height, cells, mesh = shaped
    owned = mesh.mesh.topology.index_map(1).size_local
    for facets, x in ((mesh.inboard_facets, 0.0), (mesh.outboard_facets, length)):
        assert COMM.allreduce(int((facets < owned).sum())) == cells[1]
        middle = np.empty((0, 3))
        if len(facets):
            middle = dolfinx.mesh.compute_midpoints(mesh.mesh, 1, facets.astype(np.int32))
        assert np.all(np.abs(middle[:, 0] - x) < PLACING * length)
        sides = np.sort(collect(middle[facets < owned, 1]))
        expected = (np.arange(cells[1]) + 0.5) * height / cells[1] - 0.5 * height
        assert np.abs(sides - expected).max() < PLACING * height


# Cells along; the passive length and how many columns of cells it makes at each end, if there are.
PASSIVE_COLUMNS = {
    20: {0.0: 0, 0.024: 0, 0.026: 1, 0.05: 1, 0.08: 2, 0.46: 9, 0.474: 9, 0.476: 10},
    8: {0.1875: 1},  # exactly the second column's centre
    5: {0.3: 1, 0.49: 2, 0.51: 3},  # the middle column belongs to both ends
    6: {5.0: 6},  # longer than the arm
    1: {0.3: 0, 0.6: 1},
}


@pytest.mark.serial  # ranks: test_ranks of test_elements
@pytest.mark.parametrize(
    ("along", "passive", "columns"),
    [(along, *case) for along, cases in PASSIVE_COLUMNS.items() for case in cases.items()],
)
def test_passive_cells_have_their_centre_within_the_passive_length(along, passive, columns):
    mesh = arm(cells=(along, 2), passive=passive)
    x = mesh.centroid[:, 0]
    rule = np.minimum(x, 1.0 - x) < passive - 1e-12  # rounding must not decide the border
    assert np.array_equal(mesh.passive, rule)
    assert mesh.passive.sum() == 2 * min(2 * columns, along)
    assert np.abs(mesh.area * along / 0.03 - 1.0).max() < 1e-9
    # Blocks of solid cells leave the interfaces where they are.
    for facets, end in ((mesh.inboard_facets, 0.0), (mesh.outboard_facets, 1.0)):
        middle = dolfinx.mesh.compute_midpoints(mesh.mesh, 1, facets.astype(np.int32))
        assert len(facets) >= 2 and np.abs(middle[:, 0] - end).max() < PLACING
    if 2.0 * passive < 1.0:  # what a scene admits
        size = {"length": 1.0, "height": 0.06, "thickness": 0.01}
        assert Arm(name="a", **size, cells=(along, 2), passive=passive).passive_columns == columns


@pytest.mark.parametrize("shape", ["quadrilateral", "triangle"])
def test_interior_facets_against_brute_force(shape):
    kind = getattr(dolfinx.mesh.CellType, shape)
    corners = [np.zeros(2), np.array([1.0, 0.5])]
    mesh = dolfinx.mesh.create_rectangle(COMM, corners, [5, 4], kind)
    points = mesh.geometry.x
    points[:, :2] += 0.03 * np.sin(9.0 * points[:, [1, 0]] + np.array([0.3, 1.1]))
    cells = compat.cell_geometry_nodes(mesh, sum(compat.local_cell_counts(mesh)))
    sets, middle = [set(nodes) for nodes in cells], points[cells].mean(axis=1)
    expected = {}
    for i in range(len(sets)):
        for j in range(i):
            shared = sorted(sets[i] & sets[j])
            if len(shared) == 2:
                a, b = points[shared]
                expected[j, i] = (np.linalg.norm(a - b), np.linalg.norm(middle[i] - middle[j]))
    first, second, length, distance = interior_facets(mesh)
    found = {(min(i, j), max(i, j)): (a, b) for i, j, a, b in zip(first, second, length, distance)}
    assert len(found) == len(first)
    assert found.keys() == expected.keys()
    for pair, figures in expected.items():
        assert found[pair] == pytest.approx(figures, rel=1e-14)


def test_area_of_distorted_cells():
    """Against the boundary: twice the area is the sum of x dy - y dx around the polygon."""
    rng = np.random.default_rng(1)
    quad = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    for corners, around in ((quad, [0, 1, 3, 2]), (quad[:3], [0, 1, 2])):
        cells = corners + 0.2 * rng.uniform(-1.0, 1.0, (30, len(corners), 2))
        x, y = cells[:, around, 0], cells[:, around, 1]
        twice = (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
        assert np.allclose(cell_areas(cells), 0.5 * twice, rtol=1e-14)


# In a process of its own: Gmsh keeps parameters as long as the process lives.
GMSH_ALONE = """
import json, sys
import gmsh
gmsh.initialize(["gmsh", "-v", "0", *sys.argv[2:]])
gmsh.open(sys.argv[1])
gmsh.model.mesh.generate(2)
groups = []
for dim, tag in gmsh.model.getPhysicalGroups():
    entities = gmsh.model.getEntitiesForPhysicalGroup(dim, tag)
    elements = [gmsh.model.mesh.getElements(dim, e) for e in entities]
    kinds = sorted({gmsh.model.mesh.getElementProperties(k)[0] for e in elements for k in e[0]})
    count = sum(len(tags) for e in elements for tags in e[1])
    groups.append([dim, tag, gmsh.model.getPhysicalName(dim, tag), kinds, count])
print(json.dumps([groups, gmsh.model.getBoundingBox(-1, -1)]))
"""
CURVE, SURFACE = ["Line 2"], ["Quadrilateral 4"]


@pytest.mark.serial
@pytest.mark.parametrize(
    ("arguments", "length", "surfaces"),
    [
        ("", 1.0, [[2, DESIGN, "design", SURFACE, 2400]]),
        ("-setnumber length 2 -setnumber passive 0.05", 2.0,
         [[2, DESIGN, "design", SURFACE, 2280], [2, PASSIVE, "passive", SURFACE, 120]]),
    ],
)  # fmt: skip
def test_geometry_opens_by_itself(arguments, length, surfaces):
    """Gmsh alone meshes the file, with its defaults or with -setnumber."""
    command = [sys.executable, "-c", GMSH_ALONE, str(mesh_folder() / "arm.geo")]
    run = subprocess.run(command + arguments.split(), capture_output=True, text=True, check=True)
    groups, box = json.loads(run.stdout)
    curves = [[1, INBOARD, "inboard", CURVE, 12], [1, OUTBOARD, "outboard", CURVE, 12]]
    assert groups == curves + surfaces
    assert box == pytest.approx((0.0, -0.03, 0.0, length, 0.03, 0.0), abs=1e-6)  # Gmsh's margin


BORES = str(mesh_folder() / "arm_bores.geo")
SHAPED = ["quadrilateral", "triangle"]


def solid(size, shape):
    """Return frequency, Hz, flexibility (3, 3) and body of the solid arm with bores."""
    entry = {"name": "a", "length": 0.5, "height": 0.06, "thickness": 0.01, "mesh": BORES}
    entry |= {"mesh_size": size, "cell_shape": shape, "element": "linear"}
    material = {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2700.0}
    data = {"material": material, "arms": [entry], "design": {"filter_radius": 0.0}}
    arm = ScenesArm(do.scene_from_dict(STATED | data), 0, COMM, do.Profile())
    body = arm.reduce(np.ones(arm.mesh.num_cells))
    squares = np.linalg.eigvals(np.linalg.solve(body.M, body.K)).real
    flexibility = body.outboard @ np.linalg.solve(body.K, body.outboard.T)
    return np.sqrt(squares.min()) / (2.0 * np.pi), flexibility, body


@pytest.mark.serial  # ranks: test_ranks of test_elements
@pytest.mark.parametrize("shape", SHAPED)
def test_arm_with_bores_is_a_beam_between_them(shape):
    """u_x, u_y and theta of the outboard bore about its centre; pulling does not bend."""
    _, flexibility, body = solid(0.005, shape)
    EI, GA, L = 70e9 * 0.01 * 0.06**3 / 12.0, 70e9 / 2.66 * 0.01 * 0.06, 0.5  # N m2, N, m
    # A beam with a rotational spring at each bore, whose flexibility the tip's rotation gives.
    spring = 0.5 * (flexibility[2, 2] - L / EI)
    assert 0.0 < spring < 0.1 * L / EI  # 0.055
    assert flexibility[1, 2] == pytest.approx(L**2 / (2.0 * EI) + L * spring, rel=1e-3)  # 2e-4
    bending = L**3 / (3.0 * EI) + L**2 * spring + L / (GA * 5.0 / 6.0)
    assert flexibility[1, 1] == pytest.approx(bending, rel=1e-2)  # 2e-3
    assert flexibility[0, 0] == pytest.approx(L / (70e9 * 0.01 * 0.06), rel=0.2)
    scale = np.sqrt(np.outer(np.diag(flexibility), np.diag(flexibility)))
    assert np.abs((flexibility / scale)[0, 1:]).max() < 1e-7  # mirror images to 1e-9 of the curves
    assert np.array_equal(body.outboard_point, [0.5, 0.0])


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("design.volume_fraction=0.02", ["volume", "arm 'arm1'"]),
        ("design={volume_fraction=0.02, shared_volume=true}", ["volume", "all arms together"]),
        ("reduction.coordinates=9999", ["at most"]),
    ],
)
def test_limits_that_only_the_mesh_can_tell(override, words):
    """The solid rings of the demo are 0.0207 of an arm; its coarse mesh has some 1000 dofs."""
    file = ROOT / "demos" / "two_arm_bores.toml"
    scene = do.load_scene(file, ["arms.mesh_size=0.015", override])
    partition = do.partition_arms(COMM, scene.cell_counts)
    refusal(lambda: do.build_arms(scene, partition, do.Profile()), str(file), *words)


@pytest.mark.serial
def test_import_keeps_compilers_quiet():
    """The first record of a library must not set up logging to the terminal behind our back."""
    script = "import logging, dolfinopt.mesh.compat; logging.info('compiled'); "
    script += "logging.getLogger('FFCx').warning('compiled')"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("", "")
