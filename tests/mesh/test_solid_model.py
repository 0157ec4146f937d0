"""Solid and hollow arms from STEP, .geo and .msh files: groups, interfaces by place, refusals."""

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT, refusal, refused
from solids import HEIGHT, LENGTH, THICKNESS, solid_arm

import dolfinopt as do
from dolfinopt.errors import InputError
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.mesh.checks import cell_sizes, check_cells, facet_corners
from dolfinopt.mesh.gmsh_session import gmsh_on_root
from dolfinopt.mesh.hollow import Member, Wall, box_hull, tube_hull
from dolfinopt.mesh.solid_cells import TENSOR, msh_bytes
from dolfinopt.scene.load import Arm
from dolfinopt.scene.tables.joints import Interface

COMM = MPI.COMM_WORLD
KEYS = {"name": "a", "length": LENGTH, "height": HEIGHT, "thickness": THICKNESS, "cells": None}
BOX = f"""
SetFactory("OpenCASCADE");
Box(1) = {{0, {-HEIGHT / 2}, {-THICKNESS / 2}, 0.1, {HEIGHT}, {THICKNESS}}};
Box(2) = {{0.1, {-HEIGHT / 2}, {-THICKNESS / 2}, 0.4, {HEIGHT}, {THICKNESS}}};
BooleanFragments {{ Volume{{1}}; Delete; }}{{ Volume{{2}}; Delete; }}
Physical Volume("passive root") = {{1}};
Physical Surface("Inboard") = {{Surface In BoundingBox {{-1e-6, -1, -1, 1e-6, 1, 1}}}};
Physical Surface("Outboard") = {{Surface In BoundingBox {{0.499999, -1, -1, 0.500001, 1, 1}}}};
"""


def mesh_of(path, **keys):
    told = {"cell_shape": "tetrahedron"} | keys
    return arm_mesh(COMM, Arm(**KEYS | told, mesh=str(path)))


def sums(mesh):
    """Return volume, solid volume and the areas of both interfaces as the mass they carry."""
    return COMM.allreduce(np.array([mesh.area.sum(), mesh.area[mesh.passive].sum()]))


def written(folder, name, bored, *more):
    """Write the box, or a bar with bores about both joint axes and more, as a file of Gmsh's."""
    path = folder / name
    with gmsh_on_root(COMM) as gmsh:
        if COMM.rank == 0:
            occ = gmsh.model.occ
            gmsh.option.setString("Geometry.OCCTargetUnit", "MM")
            reach = 0.5 * HEIGHT if bored else 0.0
            low = -reach, -0.5 * HEIGHT, -0.5 * THICKNESS
            bar = [(3, occ.addBox(*low, LENGTH + 2.0 * reach, HEIGHT, THICKNESS))]
            if bored:
                hole = -THICKNESS, 0.0, 0.0, 2.0 * THICKNESS, 0.01
                places = (0.0, LENGTH, *more)
                occ.cut(bar, [(3, occ.addCylinder(x, 0.0, *hole)) for x in places])
            occ.dilate(occ.getEntities(3), 0.0, 0.0, 0.0, 1e3, 1e3, 1e3)  # files are in mm
            occ.synchronize()
            gmsh.write(str(path))
    COMM.barrier()
    return path


def test_geo_with_groups(write):
    path = write("box.geo", BOX)
    mesh = mesh_of(path, mesh_size=0.02)
    volume = LENGTH * HEIGHT * THICKNESS
    assert np.allclose(sums(mesh), [volume, 0.2 * volume], rtol=1e-9)
    hexahedra = mesh_of(path, mesh_size=0.02, cell_shape="hexahedron")
    assert np.allclose(sums(hexahedra), [volume, 0.2 * volume], rtol=1e-9)
    assert mesh.dim == 3 and np.array_equal(mesh.outboard_point, [LENGTH, 0.0, 0.0])


def facets_at(mesh, facets):
    """Return the middles (n, 3) of facets of tetrahedra, of all ranks."""
    corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
    middles = corners[:, np.array(facet_corners(3, 4))].mean(axis=2)
    found = middles[np.isin(compat.cell_facets(mesh.mesh, mesh.num_cells), facets)]
    return np.concatenate(COMM.allgather(found))


def test_further_interfaces(shared_tmp_path, write):
    """Faces by name, in capitals or not, also where it begins like another's; a bore by place."""
    lug = Interface(name="outboard lug", point=(0.05, 0.5 * HEIGHT, 0.0))
    box = f"{{-1, {0.5 * HEIGHT - 1e-6}, -1, 0.100001, 1, 1}}"
    named = f'Physical Surface("Outboard lug") = {{Surface In BoundingBox {box}}};'
    mesh = mesh_of(write("lug.geo", BOX + named), mesh_size=0.02, interfaces=(lug,))
    middles = facets_at(mesh, mesh.further[0].facets)
    assert len(middles) and np.abs(middles[:, 1] - 0.5 * HEIGHT).max() < 1e-12
    assert middles[:, 0].max() < 0.1
    assert np.array_equal(mesh.further_points, [lug.point])
    bored = written(shared_tmp_path, "three.step", True, 0.2)
    hub = Interface(name="hub", point=(0.2, 0.0, 0.0))
    mesh = mesh_of(bored, mesh_size=0.01, passive=0.005, interfaces=(hub,))
    radius = np.linalg.norm(facets_at(mesh, mesh.further[0].facets)[:, :2] - [0.2, 0.0], axis=1)
    assert len(radius) >= 8 and np.abs(radius - 0.01).max() < 2e-3
    near = np.linalg.norm(mesh.centroid[:, :2] - [0.2, 0.0], axis=1) < 0.013
    assert mesh.passive[near].all()


@pytest.mark.parametrize("bored", [False, True])
def test_step_without_names(shared_tmp_path, bored):
    """Flat ends, or bores about the joint axes; solid cells about them; a body of right mass."""
    path = written(shared_tmp_path, "bar.step", bored)
    mesh = mesh_of(path, mesh_size=0.01, passive=0.03)
    total, solid = sums(mesh)
    bar, holes = (LENGTH + HEIGHT) * HEIGHT * THICKNESS, 2.0 * np.pi * 0.01**2 * THICKNESS
    expected = bar - holes if bored else LENGTH * HEIGHT * THICKNESS
    assert total == pytest.approx(expected, rel=0.01)
    assert 0.05 * total < solid < 0.3 * total
    facets = mesh.mesh.topology.index_map(2).size_local
    ends = [(side < facets).sum() for side in (mesh.inboard_facets, mesh.outboard_facets)]
    assert COMM.allreduce(np.array(ends)).min() >= 8


def row_of_cubes(path):
    """Write one layer of hexahedra along the arm as Gmsh's file."""
    places = [(x, y, z) for x in np.linspace(0.0, LENGTH, 3) for y in (-0.5, 0.5)
              for z in (-0.5, 0.5)]  # fmt: skip
    points = [(x, y * HEIGHT, z * THICKNESS) for x, y, z in places]
    ring = (1, 3, 4, 2)  # around a cross-section, in Gmsh's order
    elements = [(3, k, [4 * x + i for i in ring]) for k, x in ((1, 0), (2, 2))]
    elements += [(5, 3, [4 * x + i for x in (k, k + 1) for i in ring]) for k in (0, 1)]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", "3"]
    lines += ['2 1 "inboard"', '2 2 "outboard"', '3 3 "body"', "$EndPhysicalNames", "$Nodes"]
    lines += [str(len(points)), *(f"{i} {x} {y} {z}" for i, (x, y, z) in enumerate(points, 1))]
    lines += ["$EndNodes", "$Elements", str(len(elements))]
    for i, (kind, group, corners) in enumerate(elements, 1):
        lines.append(f"{i} {kind} 2 {group} {group} {' '.join(map(str, corners))}")
    path.write_text("\n".join([*lines, "$EndElements", ""]))
    return path


@pytest.mark.serial
def test_refusals(shared_tmp_path):
    plain = written(shared_tmp_path, "bar.step", bored=False)
    nameless, flat = shared_tmp_path / "nameless.geo", shared_tmp_path / "flat.msh"
    nameless.write_text(BOX.replace("Inboard", "left"))
    flat.write_text("$MeshFormat\n4.1 0 8\n$EndMeshFormat\n")
    away = Interface(name="hub", point=(0.3, 0.0, 0.0))
    for path, keys, words in (
        (plain, {"length": 0.6}, ["x = 0.6 m"]),
        (plain, {"height": 0.05}, ["height = 0.05 m"]),
        (plain, {"thickness": 0.03}, ["thickness = 0.03 m"]),
        (plain, {"interfaces": (away,)}, ['"hub"', "a face named so"]),
        (nameless, {}, ['no faces in a group "inboard"']),
        (row_of_cubes(shared_tmp_path / "cubes.msh"), {"mesh_size": None}, ['"hexahedron"']),
        (flat, {"mesh_size": None}, ["flat.msh", "arm 'a'"]),
    ):
        refusal(lambda: mesh_of(path, **{"mesh_size": 0.02} | keys), *words)  # noqa: B023


@pytest.mark.serial
def test_names_of_faces(shared_tmp_path):
    """Named outboard one by one, the six faces of a box: one of them lies at the joint."""
    text = written(shared_tmp_path, "bar.step", bored=False).read_text(encoding="latin-1")
    pieces = text.split("ADVANCED_FACE('',")
    assert len(pieces) == 7
    found, join = [], "ADVANCED_FACE('',".join
    for k in range(1, 7):
        path = shared_tmp_path / f"named{k}.step"
        named = f"{join(pieces[:k])}ADVANCED_FACE('Outboard',{join(pieces[k:])}"
        path.write_text(named, encoding="latin-1")
        try:
            found.append(mesh_of(path, mesh_size=0.04))
        except InputError as error:
            assert 'group "outboard" has its middle at' in str(error)
            elsewhere = path
    assert len(found) == 1
    off = mesh_of(elsewhere, mesh_size=0.04, interface_offset=1.0)
    assert len(off.outboard_facets) and off.num_cells == found[0].num_cells


# -- hollow links: the hull's grid, the wall's volume in closed form, its map and what is refused


SIZE, CELLS, WALL = (0.5, 0.08, 0.06), (6, 4, 3), 0.004  # m
ROUND = (0.5, 0.06, 0.06)
HOLLOW = ("arms.link1.hollow=true", "arms.link1.wall=0.002")


@pytest.mark.parametrize(
    "hull, area",
    [(box_hull(SIZE, CELLS, WALL), 0.08 * 0.06 - 0.072 * 0.052),
     (tube_hull(ROUND, CELLS), np.pi * (0.03**2 - 0.026**2))],
    ids=["box", "tube"],
)  # fmt: skip
def test_the_wall_has_the_volume_of_its_section(hull, area):
    """To rounding: mitred corners of a box, and a circle's area of a polygon."""
    mesh = hull.member(WALL)
    check_cells(mesh.points, mesh.cells[:, TENSOR[8, 3]])
    assert cell_sizes(mesh.points[mesh.cells[:, TENSOR[8, 3]]]).sum() == pytest.approx(area * 0.5)
    assert len(mesh.inboard) == len(mesh.outboard) == hull.shape[1]


def test_thickness_follows_the_cells_and_gradients_go_back():
    """t is linear in x: backward is its transpose, and a uniform x is a uniform wall."""
    rng = np.random.default_rng(2)
    hull = box_hull(SIZE, CELLS, WALL)
    along, around = hull.shape
    nodes = rng.permutation(2 * (along + 1) * around)
    wall = Wall(hull, 0.001, WALL, nodes, rng.permutation(along * around))
    comm = MPI.COMM_SELF
    assert wall.thickness(comm, np.full(along * around, 0.5)) == pytest.approx(0.0025)
    x, by = rng.random(along * around), rng.standard_normal((len(nodes), 3))
    moved = wall.points(comm, x) - wall.points(comm, np.zeros_like(x))
    assert (moved * by).sum() == pytest.approx(wall.backward(by) @ x)


def test_ends_are_flanges():
    """Cells nearer to the ends than arms.passive stay as thick as the largest wall."""
    arm = walled(cells=(10, 3, 2), passive=0.06)
    x = arm.mesh.centroid[:, 0]
    assert np.array_equal(arm.mesh.passive, (x < 0.06) | (x > 0.44))
    thickness = arm.mesh.wall.thickness(MPI.COMM_SELF, arm.uniform())
    assert thickness[[0, -1]] == pytest.approx(0.003)
    # A wall of 1 mm between 0.5 and 3 mm; its volume over that of the thickest.
    inner = ~arm.mesh.passive
    assert arm.uniform()[inner] == pytest.approx(0.2)


def walled(**keys):
    return solid_arm(MPI.COMM_SELF, hollow=True, wall=0.001, max_wall=0.003, **keys)


@pytest.mark.serial
@pytest.mark.parametrize(
    "changes, words",
    [
        (("arms.link1.wall=0.002",), ("wall", "0.002", "only with hollow")),
        (("arms.link1.hollow=true",), ("arms.1.wall", "a value with hollow = true")),
        ((*HOLLOW, "arms.link1.max_wall=0.01"), ("max_wall", "0.01", "less than half")),
        ((*HOLLOW, "arms.link1.min_wall=0.005"), ("min_wall", "less than max_wall")),
        ((*HOLLOW, "arms.link1.min_wall=0.003"), ("wall", "0.002", "min_wall = 0.003")),
        ((*HOLLOW, "arms.link1.hollow=tube"), ("height", "0.04", "thickness = 0.02")),
        ((*HOLLOW, "arms.link1.symmetric=extruded"), ("symmetric", "with hollow = true")),
        ((*HOLLOW, "arms.link1.element=quadratic"), ("element", "incompatible")),
        ((*HOLLOW, "arms.link1.cells=[60,60,40]"), ("cells", "at most 150", "200")),
        ((*HOLLOW, "arms.link2.hollow=true", "arms.link2.wall=0.002", "interpolation.penalty=4",
          "design.initial=0.5"),
         ("interpolation.penalty", "3.0, the default", "solid")),
        ((*HOLLOW, "design.projection=heaviside"), ("projection", "with a hollow arm")),
        ((*HOLLOW, "arms.link2.hollow=true", "arms.link2.wall=0.002", "design.initial=0.7"),
         ("design.initial", "0.7", "arms.wall")),
    ],
)  # fmt: skip
def test_what_a_hollow_arm_cannot_have(changes, words):
    """One line: key, value and what is expected; and no plane arm has an inside."""
    with refused(*(word for word in words if not word.startswith("arms.0"))):
        do.load_scene(ROOT / "demos" / "spatial_arm.toml", changes)
    with refused("hollow", "cells = [nx, ny, nz]"):
        do.load_scene(ROOT / "demos" / "two_arm.toml", ("arms.hollow=true", "arms.wall=0.002"))


def taper():
    """Return a solid whose section shrinks along it from 60 x 40 mm to half of both."""
    counts = np.array([7, 5, 5])
    grid = np.indices(counts).reshape(3, -1).T / (counts - 1.0)
    x, y, z = grid.T
    points = np.column_stack([0.5 * x, *((1.0 - 0.5 * x) * (np.array([[0.06], [0.04]])
                              * (np.array([y, z]) - 0.5)))])  # fmt: skip
    number = np.arange(len(grid)).reshape(counts)
    a = number[:-1, :-1, :-1], number[:-1, 1:, :-1], number[:-1, 1:, 1:], number[:-1, :-1, 1:]
    b = number[1:, :-1, :-1], number[1:, 1:, :-1], number[1:, 1:, 1:], number[1:, :-1, 1:]
    hexahedra = np.stack([one.ravel() for one in (*a, *b)], axis=1)
    first = np.stack([one[0].ravel() for one in a], axis=1)
    last = np.stack([one[-1].ravel() for one in b], axis=1)
    return Member(points, hexahedra, first[:, ::-1], last)


def hull_arm(tmp_path, mesh, **keys):
    """Return the arm whose hull is a mesh's."""
    path = tmp_path / "hull.msh"
    path.write_bytes(msh_bytes(mesh))
    size = {"height": 0.06, "thickness": 0.04, "cells": (10, 4, 4)}
    told = {"hollow": str(path), "wall": 0.001, "passive": 0.0, "max_wall": 0.002}
    return solid_arm(MPI.COMM_SELF, **(size | told | keys))


@pytest.mark.serial
def test_hull_of_a_file_lies_on_its_surface(tmp_path):
    """Every point on a side of the taper, and the wall as thick as it should be there."""
    arm = hull_arm(tmp_path, taper())
    outer = arm.mesh.wall.hull.outer
    half = (1.0 - outer[:, :, 0]) * 0.5 * np.array([[[0.06]], [[0.04]]])
    apart = np.abs(outer[:, :, 1:].transpose(2, 0, 1)) / half
    assert apart.max(axis=0) == pytest.approx(np.ones(apart.shape[1:]), abs=1e-5)
    assert outer[[0, -1], 0, 0] == pytest.approx([0.0, 0.5])


@pytest.mark.serial
def test_hulls_that_are_refused(tmp_path):
    """A surface behind another one, and a wall that would cross itself."""
    behind = box_hull((0.5, 0.06, 0.04), (6, 4, 4), 0.005).member(0.005)
    with refused("hull.msh", "2 times", "star-shaped", "hollow"):
        hull_arm(tmp_path, behind)
    with refused("arms.max_wall = 0.015", "crosses itself", "thinner"):
        hull_arm(tmp_path, taper(), max_wall=0.015)
