"""Meshes: the parametric geometry, its groups, facets between cells, boxes and uniform members."""

import json
import math
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
from dolfinopt.mesh import compat, hollow
from dolfinopt.mesh.arm_mesh import box_arm, neighbours
from dolfinopt.mesh.checks import cell_sizes, check_cells, facet_areas
from dolfinopt.mesh.gmsh_session import DESIGN, INBOARD, OUTBOARD, PASSIVE
from dolfinopt.mesh.hollow import FLAT_BAR, SOLID_BAR, member
from dolfinopt.mesh.solid_cells import TENSOR
from dolfinopt.output.design import arms_with_design
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Arm
from dolfinopt.study.sections import Members

COMM = MPI.COMM_WORLD
# Gmsh places the points of a curve by integrating its length to Mesh.LcIntegrationPrecision = 1e-9;
# measured here: off by 2e-12 of the curve's length at most.
PLACING = 1e-10


def arm(length=1.0, height=0.06, cells=(20, 4), passive=0.0, comm=COMM):
    return box_arm(comm, "arm", (length, height), cells, passive)


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


# -- members of uniform section: areas in closed form, their bodies against the theory of beams  --


LENGTH, HEIGHT, THICKNESS = 0.5, 0.04, 0.02  # m
E, NU = 70e9, 0.33
G = 0.5 * E / (1.0 + NU)
MESHED = {"rectangular tube": hollow.RECTANGULAR_TUBE, "round tube": hollow.ROUND_TUBE,
          "I section": hollow.I_SECTION}  # fmt: skip


def moments(kind, share):
    """Return A, I_z, I_y, the shear areas along y and z, and the twist by a moment L / (G J)."""
    # Shear areas: walls that carry it, half of a thin ring, 5/6 of a rectangle. Twist: Bredt's
    # formula at the wall's middle, the circle's polar moment, Vlasov's with both ends held from
    # warping, the series of the rectangle (Timoshenko & Goodier, Theory of Elasticity, 109).
    h, b, L = HEIGHT, THICKNESS, LENGTH
    if kind == "solid bar":
        h, b = share * h, share * b
        n = np.arange(1, 60, 2)
        series = (np.tanh(0.5 * n * np.pi * h / b) / n**5).sum()
        J = h * b**3 / 3.0 * (1.0 - 192.0 * b / np.pi**5 / h * series)
        A = h * b
        return A, b * h**3 / 12.0, h * b**3 / 12.0, A / 1.2, A / 1.2, L / (G * J)
    if kind == "rectangular tube":
        t = 0.5 * share * b
        hi, bi, hm, bm = h - 2.0 * t, b - 2.0 * t, h - t, b - t
        J = 2.0 * t * (hm * bm) ** 2 / (hm + bm)
        I_z, I_y = (b * h**3 - bi * hi**3) / 12.0, (h * b**3 - hi * bi**3) / 12.0
        return h * b - hi * bi, I_z, I_y, 2.0 * t * h, 2.0 * t * b, L / (G * J)
    if kind == "round tube":
        R, r = 0.5 * b, 0.5 * b * (1.0 - share)
        A, inertia = math.pi * (R**2 - r**2), 0.25 * math.pi * (R**4 - r**4)
        return A, inertia, inertia, 0.5 * A, 0.5 * A, L / (2.0 * G * inertia)
    t = share * min(0.5 * h, b)
    A, hm = 2.0 * b * t + (h - 2.0 * t) * t, h - t
    I_z = (b * h**3 - (b - t) * (h - 2.0 * t) ** 3) / 12.0
    I_y = (2.0 * t * b**3 + (h - 2.0 * t) * t**3) / 12.0
    J, warping = (2.0 * b + hm) * t**3 / 3.0, t * b**3 * hm**2 / 24.0
    k = math.sqrt(G * J / (E * warping))
    twist = (L - 2.0 / k * math.tanh(0.5 * k * L)) / (G * J)
    return A, I_z, I_y, t * h, 2.0 * b * t / 1.2, twist


@pytest.mark.parametrize("share", [0.02, 0.2, 0.6])
@pytest.mark.parametrize("kind", MESHED)
def test_volume(kind, share):
    """Cells are valid and have the section's area, the circle's too, all along."""
    section = MESHED[kind]
    found = member(section, LENGTH, (HEIGHT, THICKNESS), share)
    cells = found.cells[:, TENSOR[8, 3]]
    check_cells(found.points, cells)
    area = section.area(HEIGHT, THICKNESS, share)
    assert area == pytest.approx(moments(kind, share)[0], rel=1e-12)
    assert cell_sizes(found.points[cells]).sum() == pytest.approx(area * LENGTH, rel=1e-9)
    for facets, x in ((found.inboard, 0.0), (found.outboard, LENGTH)):
        assert (found.points[facets][:, :, 0] == x).all()


def test_areas_of_bars():
    assert FLAT_BAR.area(0.06, 0.01, 0.5) == pytest.approx(0.03 * 0.01, rel=1e-15)
    assert SOLID_BAR.area(0.06, 0.01, 0.5) == pytest.approx(0.03 * 0.005, rel=1e-15)
    assert FLAT_BAR.measures(0.06, 0.01, 0.5) == (0.03, 0.01)


@pytest.mark.serial
@pytest.mark.parametrize("share", [0.02, 0.2])
@pytest.mark.parametrize("kind", [*MESHED, "solid bar"])
def test_cantilever(kind, share, tmp_path):
    """Bending both ways and twist of the clamped member; twist where the walls are thin."""
    own = [f"arms.link1.{key}={value}" for key, value in
           (("length", LENGTH), ("height", HEIGHT), ("thickness", THICKNESS))]  # fmt: skip
    keys = [*own, "simulation.stiffening=false"]
    scene = do.load_scene(ROOT / "demos" / "spatial_arm.toml", keys)
    members = Members(scene, kind, MESHED.get(kind, SOLID_BAR), tmp_path)
    made = members.case((share, share)).scene
    _, _, arms, x_phys = arms_with_design(MPI.COMM_SELF, made, None, Profile())
    body = arms[1].reduce(x_phys[1])
    A, I_z, I_y, along_y, along_z, twist = moments(kind, share)
    assert body.mass == pytest.approx(2700.0 * A * LENGTH, rel=1e-9)
    assert body.mass == pytest.approx(members.mass(1, share), rel=1e-9)
    flexibility = np.diag(body.outboard @ np.linalg.solve(body.K, body.outboard.T))
    expected = [LENGTH**3 / (3.0 * E * second) + LENGTH / (G * a)
                for second, a in ((I_z, along_y), (I_y, along_z))]  # fmt: skip
    assert flexibility[1:3] == pytest.approx(expected, rel=0.01)
    if share < 0.1 or kind in ("round tube", "solid bar"):
        # 6 x 4 cells over the bar's section: tests/fem/test_elements.py.
        error = 0.035 if kind == "solid bar" else 0.01
        assert flexibility[3] == pytest.approx(twist, rel=error)


# -- solid arms: boxes of hexahedra, volumes and facets of cells in space, what cannot be a solid


SIZE, CELLS = (0.5, 0.04, 0.02), (10, 4, 2)


def test_box():
    """Size, interfaces, solid ends by whole layers, and nodes on the very lines of the grid."""
    mesh = box_arm(COMM, "a", SIZE, CELLS, passive=0.08)
    counts = [mesh.num_cells, mesh.area.sum(), mesh.passive.sum()]
    assert np.allclose(COMM.allreduce(np.array(counts)), [80, np.prod(SIZE), 2 * 2 * 8])
    facets = mesh.mesh.topology.index_map(2).size_local
    ends = (mesh.inboard_facets, mesh.outboard_facets)
    assert [COMM.allreduce(int((side < facets).sum())) for side in ends] == [8, 8]
    assert mesh.dim == 3 and np.array_equal(mesh.outboard_point, [0.5, 0.0, 0.0])
    x, y, z = mesh.mesh.geometry.x.T
    for values, first, step in ((x, 0.0, 0.05), (y, -0.02, 0.01), (z, -0.01, 0.01)):
        assert np.array_equal(values, first + step * np.rint((values - first) / step))
    assert mesh.passive.tolist() == (np.abs(mesh.centroid[:, 0] - 0.25) > 0.15).tolist()


def test_neighbours():
    """Cells with a common face: their middles are one cell apart, in one direction."""
    mesh = box_arm(COMM, "a", SIZE, CELLS)
    pairs = neighbours(mesh.mesh)
    corners = compat.cell_coordinates(mesh.mesh, sum(compat.local_cell_counts(mesh.mesh)))
    apart = np.abs(np.diff(corners.mean(axis=1)[pairs], axis=1))[:, 0] / [0.05, 0.01, 0.01]
    assert np.allclose(np.sort(apart), [0.0, 0.0, 1.0])
    if COMM.size == 1:
        assert len(pairs) == 9 * 8 + 10 * 3 * 2 + 10 * 4


def test_volumes_of_skew_cells():
    """Boxes and tetrahedra under a linear map; a frustum, whose faces are planes."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
    F = np.array([[1.0, 0.3, -0.2], [0.1, 0.7, 0.4], [-0.3, 0.2, 1.1]])
    volume = np.linalg.det(F)
    assert cell_sizes((corners @ F.T)[None])[0] == pytest.approx(volume)
    assert cell_sizes((corners[[0, 1, 2, 4]] @ F.T)[None])[0] == pytest.approx(volume / 6.0)
    frustum = corners.copy()
    frustum[4:, :2] *= 0.5
    assert cell_sizes(frustum[None])[0] == pytest.approx((1.0 + 0.5 + 0.25) / 3.0)
    assert np.allclose(np.abs(facet_areas(frustum[None, 4:])), [[0.0, 0.0, 0.25]])


# Five tetrahedra in a hexahedron whose corners are numbered as a tensor product.
FIVE = np.array([[0, 1, 2, 4], [3, 1, 2, 7], [5, 1, 4, 7], [6, 2, 4, 7], [1, 2, 4, 7]])


def row():
    """Return points and cells of three cubes in a row along z."""
    grid = np.stack(np.meshgrid(np.arange(4), [0, 1], [0, 1], indexing="ij"), axis=3)
    return grid.reshape(-1, 3)[:, ::-1].astype(float), np.arange(8) + 4 * np.arange(3)[:, None]


# Three tetrahedra at one facet, the second one on its other side.
FAN = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.1, 0.1, 1], [0.1, 0.1, -1], [0.3, 0.3, 1.0]])
THREE = np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]])


def changed(place, *value):
    points = row()[0]
    points[place] = value
    return points


@pytest.mark.serial
def test_sound_cells():
    """Whichever way round their corners are numbered."""
    points, cells = row()
    check_cells(points, cells)
    check_cells(points * [1.0, 1.0, -1.0], cells)
    turned = cells.copy()
    turned[1] = cells[1][[1, 0, 3, 2, 5, 4, 7, 6]]
    check_cells(points, turned)
    check_cells(points[:8], FIVE)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("points", "cells", "words"),
    [
        (changed(5, np.nan, 0.0, 0.0), row()[1], ["2 cells", "no numbers"]),
        (row()[0] * [1.0, 1.0, 0.0], row()[1], ["3 cells", "flat"]),
        (changed(5, 1.0, 0.0, 2.5), row()[1], ["1 cells", "folded", "(0.5, 0.5, "]),
        (row()[0], np.concatenate([row()[1], row()[1][:1]]), ["2 cells", "overlap"]),
        (row()[0], np.repeat(row()[1][:1], 3, axis=0), ["3 cells", "overlap"]),
        (FAN, THREE, ["cells overlap"]),
        (changed(7, 0.2, 0.2, 0.2)[:8], FIVE, ["overlap", "inverted"]),
        (row()[0], row()[1][[0, 2]], ["2 separate parts"]),
    ],
)
def test_cells_that_are_no_solid(points, cells, words):
    refusal(lambda: check_cells(points, cells), *words)
