"""Geometry files: arms with bores, a user's own, and one line for each that cannot be an arm."""

import multiprocessing
import os
import re
import time

import numpy as np
import pytest
from dolfinx.fem import locate_dofs_topological
from mpi4py import MPI
from runs import refusal

from dolfinopt.data import mesh_folder
from dolfinopt.errors import InputError
from dolfinopt.mesh import compat, geometry
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.mesh.checks import check_cells, check_mesh
from dolfinopt.mesh.gmsh_session import gmsh_on_root, in_child
from dolfinopt.mesh.step import _circle, read_shapes
from dolfinopt.scene.load import Arm

COMM = MPI.COMM_WORLD
BORES = str(mesh_folder() / "arm_bores.geo")
LENGTH, HEIGHT = 0.5, 0.06  # m
BORE = HEIGHT / 6.0  # m, the file's default
SHAPES = ["quadrilateral", "triangle"]
SIDES = {"quadrilateral": 4, "triangle": 3}


def entry(mesh, **keys):
    keys = {"length": LENGTH, "height": HEIGHT, "thickness": 1.0} | keys
    return Arm(name="a", mesh=str(mesh), **keys)


def bores(**keys):
    return arm_mesh(COMM, entry(BORES, **keys))


def refused(path, *words, **keys):
    """Check that a file is refused in one line, on all ranks."""
    words = str(path), "arm 'a'", *words
    return refusal(lambda: arm_mesh(COMM, entry(path, **keys)), *words)


def collect(values):
    return np.concatenate(COMM.allgather(values))


def corners(mesh):
    """Return the corners (n, 3 or 4, 2) of this rank's cells."""
    return compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, :2]


def facet_nodes(mesh, facets):
    """Return the coordinates (n, 2) of all ranks' nodes of facets."""
    space = compat.lagrange_space(mesh.mesh, 1)
    nodes = locate_dofs_topological(space, 1, facets.astype(np.int32))
    return collect(space.tabulate_dof_coordinates()[nodes, :2])


def radius_error(mesh, facets, x, radius):
    """Return by how much nodes of facets miss the circle about (x, 0); there are some."""
    found = np.linalg.norm(facet_nodes(mesh, facets) - [x, 0.0], axis=1)
    assert len(found) >= 16
    return np.abs(found - radius).max()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("passive", "ring"), [(0.012, 0.012), pytest.param(0.0, HEIGHT / 8.0, marks=pytest.mark.serial)]
)
def test_bores_are_interfaces_in_solid_rings(shape, passive, ring):
    mesh = bores(mesh_size=0.006, cell_shape=shape, passive=passive)
    assert corners(mesh).shape[1] == SIDES[shape]
    for facets, x in ((mesh.inboard_facets, 0.0), (mesh.outboard_facets, LENGTH)):
        assert radius_error(mesh, facets, x, BORE) < 1e-9  # Gmsh's points on circles: 1e-11
    centroid = collect(mesh.centroid)
    axis = np.where(centroid[:, 0] < 0.5 * LENGTH, 0.0, LENGTH)
    radius = np.hypot(centroid[:, 0] - axis, centroid[:, 1])
    assert np.array_equal(collect(mesh.passive), radius < BORE + ring)
    points = collect(corners(mesh)).reshape(-1, 2)
    half = 0.5 * HEIGHT
    np.testing.assert_allclose(points.min(axis=0), [-half, -half], atol=1e-9)
    np.testing.assert_allclose(points.max(axis=0), [LENGTH + half, half], atol=1e-9)
    assert np.array_equal(mesh.outboard_point, [LENGTH, 0.0])


PLAIN = """
Point(1) = {0, -0.03, 0, 0.02}; Point(2) = {0.5, -0.03, 0, 0.02};
Point(3) = {0.5, 0.03, 0, 0.02}; Point(4) = {0, 0.03, 0, 0.02};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
"""
TIP = """
Point(5) = {0.52, 0.01, 0, 0.02}; Point(6) = {0.52, -0.01, 0, 0.02};
Line(5) = {2, 6}; Line(6) = {6, 5}; Line(7) = {5, 3};
Curve Loop(2) = {5, 6, 7, -2}; Plane Surface(2) = {2};
"""
MILLIMETRES = re.sub(r"\b0\.\d+", lambda m: str(1e3 * float(m[0])), PLAIN)
ENDS = 'Physical Curve("inboard") = {4}; Physical Curve("outboard") = {2};\n'


def gmsh_writes(path, make):
    """Let Gmsh on the root write what `make(gmsh)` makes; return the path on all ranks."""
    with gmsh_on_root(COMM) as gmsh:
        if COMM.rank == 0:
            make(gmsh)
            gmsh.write(str(path))
    COMM.barrier()
    return path


def figures(mesh):
    """Return number of cells, area, solid area, lines of each interface: of all ranks."""
    owned = mesh.mesh.topology.index_map(1).size_local
    lines = [(mesh.inboard_facets < owned).sum(), (mesh.outboard_facets < owned).sum()]
    parts = [mesh.num_cells, mesh.area.sum(), mesh.area[mesh.passive].sum(), *lines]
    return COMM.allreduce(np.array(parts))


PLATE, BOSS = 0.03, 0.02 * 0.04  # m2, of both surfaces


@pytest.mark.serial  # Gmsh runs on one rank
@pytest.mark.parametrize(
    ("groups", "area", "solid", "noted"),
    [
        ('Physical Surface("passive") = {2};', PLATE + BOSS, BOSS, ()),
        ('Physical Surface("design") = {1};', PLATE, 0.0, ()),  # the other is left out
        # Told by how their names begin.
        *((f'Physical Surface("{name}") = {{2}};', PLATE + BOSS, BOSS, ())
          for name in ("passive2", "Passive boss", "PASSIVE_left")),
        ('Physical Surface("boss") = {2}; Physical Surface("web") = {1};', PLATE + BOSS, 0.0,
         ('"boss"', '"web"')),
    ],
)  # fmt: skip
def test_own_geometry_without_parameters(write, groups, area, solid, noted):
    """Groups of curves in capitals or not; names of surfaces without a meaning are listed."""
    ends = ENDS.upper().replace("PHYSICAL CURVE", "Physical Curve")
    path = write("own.geo", PLAIN + TIP + ends + groups)
    mesh = arm_mesh(COMM, entry(path))
    _, *areas, inboard, outboard = figures(mesh)
    assert areas == pytest.approx([area, solid], rel=1e-9)
    assert inboard == 3 and outboard == 3
    assert len(mesh.notes) == bool(noted) and all(name in mesh.notes[0] for name in noted)
    quads = figures(arm_mesh(COMM, entry(path, cell_shape="quadrilateral")))
    assert quads[1:3] == pytest.approx([area, solid], rel=1e-9)


@pytest.mark.serial  # Gmsh runs on one rank
def test_products_that_open_cascade_has_numbered_have_no_names(shared_tmp_path):
    """Every file that it writes has them: "Open CASCADE STEP translator 7.6 1.1"."""

    def halves(gmsh):
        # Open CASCADE keeps the unit of what the process read before.
        gmsh.option.setString("Geometry.OCCTargetUnit", "M")
        for x in (0.0, 0.5 * LENGTH):
            gmsh.model.occ.addRectangle(x, -0.5 * HEIGHT, 0.0, 0.5 * LENGTH, HEIGHT)
        gmsh.model.occ.synchronize()

    path = gmsh_writes(shared_tmp_path / "two.step", halves)
    assert path.read_text().count("PRODUCT('Open CASCADE STEP translator") == 3
    assert arm_mesh(COMM, entry(path)).notes == ()


def test_passive_cells_lie_within_passive_of_an_interface(write):
    """The rule of the rectangular arm, where the file has no parameter for it."""
    mesh = arm_mesh(COMM, entry(write("own.geo", PLAIN + ENDS), passive=0.07))
    x = mesh.centroid[:, 0]
    assert np.array_equal(mesh.passive, np.minimum(x, LENGTH - x) < 0.07)
    assert 0 < COMM.allreduce(int(mesh.passive.sum())) < COMM.allreduce(mesh.num_cells)


def plate(occ):
    """Make a rectangle with a bore at each joint axis, that of the inboard one larger by 3 mm."""
    half = 0.5 * HEIGHT
    bar = occ.addRectangle(-half, -half, 0.0, LENGTH + HEIGHT, HEIGHT)
    tools = [(2, occ.addDisk(x, 0.0, 0.0, r, r)) for x, r in ((0.0, 0.013), (LENGTH, BORE))]
    occ.cut([(2, bar)], tools)


def ring(occ):
    """Make the ring between a bore of 10 mm and that of the plate."""
    occ.cut([(2, occ.addDisk(0, 0, 0, 0.013, 0.013))], [(2, occ.addDisk(0, 0, 0, BORE, BORE))])


def bar_with_straight_ends(occ):
    occ.addRectangle(0.0, -0.5 * HEIGHT, 0.0, LENGTH, HEIGHT)


def step_file(path, **products):
    """Write a STEP file in millimetres with one product for each `name=make(occ)`."""

    def write(gmsh, name, make):
        gmsh.clear()
        make(gmsh.model.occ)
        gmsh.model.occ.synchronize()
        gmsh.option.setString("Geometry.OCCTargetUnit", "M")
        gmsh.write(str(path))
        return re.sub(r"'Open CASCADE STEP translator[^']*'", f"'{name}'", path.read_text())

    with gmsh_on_root(COMM) as gmsh:
        if COMM.rank == 0:
            data = ""
            for k, (name, make) in enumerate(products.items()):
                head, rest = write(gmsh, name, make).split("DATA;")
                body, tail = rest.split("ENDSEC;", 1)
                data += re.sub(r"#(\d+)", lambda m, k=k: f"#{k * 10000 + int(m[1])}", body)
            assert "MILLI" in data
            path.write_text(f"{head}DATA;{data}ENDSEC;{tail}")
    COMM.barrier()
    return path


def lifted(make, z, thickness):
    """Return what makes a solid from z on of the section that `make` makes."""

    def solid(occ):
        make(occ)
        faces = occ.getEntities(2)
        occ.translate(faces, 0.0, 0.0, z)
        occ.extrude(faces, 0.0, 0.0, thickness)
        occ.remove(occ.getEntities(2), recursive=False)

    return solid


@pytest.mark.serial  # Gmsh runs on one rank
@pytest.mark.parametrize(
    ("z", "shape"), [(None, "triangle"), *((z, "quadrilateral") for z in (None, 0.0, -0.005, 0.3))]
)
def test_step_with_bores(shared_tmp_path, z, shape):
    """A section, or a prismatic solid that is taken by its planar face."""
    make = plate if z is None else lifted(plate, z, 0.01)
    path = step_file(shared_tmp_path / "arm.step", plate=make)
    mesh = arm_mesh(COMM, entry(path, mesh_size=0.003, cell_shape=shape, thickness=0.01))
    assert corners(mesh).shape[1] == SIDES[shape]
    area = HEIGHT * (LENGTH + HEIGHT) - np.pi * (0.013**2 + BORE**2)
    assert figures(mesh)[1] == pytest.approx(area, rel=1e-3)  # polygons in place of circles
    assert radius_error(mesh, mesh.inboard_facets, 0.0, 0.013) < 1e-9
    assert radius_error(mesh, mesh.outboard_facets, LENGTH, BORE) < 1e-9
    assert np.abs(mesh.mesh.geometry.x[:, 2]).max() == 0.0


@pytest.mark.serial  # Gmsh runs on one rank
def test_step_product_named_passive_stays_solid(shared_tmp_path):
    """Two products that touch without a common curve; the ring's inner circle is the interface."""
    path = step_file(shared_tmp_path / "arm.step", arm=plate, passive=ring)
    mesh = arm_mesh(COMM, entry(path, mesh_size=0.004))
    assert np.array_equal(mesh.passive, np.linalg.norm(mesh.centroid, axis=1) < 0.0129)
    assert COMM.allreduce(int(mesh.passive.sum())) >= 10
    assert radius_error(mesh, mesh.inboard_facets, 0.0, BORE) < 1e-9
    path.write_text(path.read_text().replace("'passive'", "'bush'"))
    mesh = arm_mesh(COMM, entry(path, mesh_size=0.004))  # without a meaning: listed
    assert not mesh.passive.any()
    assert len(mesh.notes) == 1 and '"arm", "bush"' in mesh.notes[0]


@pytest.mark.serial  # Gmsh runs on one rank
def test_step_names_edges_and_faces(shared_tmp_path):
    """The larger hole is named, though a smaller one is about the same axis."""
    path = step_file(shared_tmp_path / "arm.step", arm=two_faces)
    # The circle through (13, 0) mm, and the face that also reaches the bore of 10 mm.
    edge = named(path.read_text(), "EDGE_CURVE", lambda p: np.allclose(p, [[13.0, 0.0, 0.0]]))
    face = named(edge, "ADVANCED_FACE", lambda p: len(p) == 2)
    face = face.replace("EDGE_CURVE('x'", "EDGE_CURVE('Inboard'").replace("('x'", "('passive'")
    path.write_text(face)
    mesh = arm_mesh(COMM, entry(path, mesh_size=0.004))
    assert radius_error(mesh, mesh.inboard_facets, 0.0, 0.013) < 1e-9
    assert np.array_equal(mesh.passive, np.linalg.norm(mesh.centroid, axis=1) < 0.0129)


def two_faces(occ):
    """Make plate and ring in one, with a common curve."""
    plate(occ)
    ring(occ)
    occ.fragment(occ.getEntities(2), [])


def named(text, kind, fits):
    """Return the text of a STEP file with the name x for shapes whose vertices fit."""
    marked = re.sub(rf"#(\d+) = {kind}\(''", rf"#\1 = {kind}('\1'", text)
    for shapes in read_shapes(marked):
        for number, vertices in zip(shapes.names, shapes.vertices, strict=True):
            if fits(vertices):
                marked = marked.replace(f"{kind}('{number}'", f"{kind}('x'")
    return re.sub(rf"{kind}\('\d+'", f"{kind}(''", marked)


BOTH = 'Physical Surface("design") = {1}; Physical Surface("passive") = {1};'


@pytest.mark.parametrize(
    ("text", "keys", "words"),
    [
        (PLAIN, {}, ['"inboard"', "no named groups"]),
        (PLAIN + ENDS.replace("inb", "onb"), {}, ['"onboard"', '"outboard"']),
        (PLAIN + ENDS.replace("2", "4"), {}, ["curve 4", '"inboard" and "outboard"']),
        (PLAIN + ENDS + BOTH, {}, ["surface 1", '"design" and "passive"']),
        (PLAIN + ENDS, {"length": 0.6}, ["(0.5, 0) m", "(length, 0) = (0.6, 0) m"]),
        (PLAIN + ENDS, {"height": 0.1}, ["0.06 m", "height = 0.1 m within 0.005 m"]),
        (PLAIN + ENDS, {"height": 0.04}, ["0.06 m", "height = 0.04 m within 0.002 m"]),
        (MILLIMETRES + ENDS, {}, ["500 x 60 m", "0.5 x 0.06 m", "millimetres", "mesh_scale"]),
        (PLAIN + ENDS, {"mesh_size": 0.01}, ['no parameter "mesh size (m)"']),
        (PLAIN.replace("0.03, 0,", "0.03, 1,") + ENDS, {}, ["1 m off the plane z = 0"]),
        (PLAIN + ENDS + "Point(9) = {foo, 0, 0};", {}, ["'foo'"]),
        ("Point(1) = {0, 0, 0};" + ENDS, {}, ["no curves in a group"]),
        (PLAIN + TIP + ENDS + "Mesh.Algorithm = 5; Recombine Surface {2};", {},
         ["triangles and quadrilaterals"]),
        (PLAIN + ENDS + "Extrude {0, 0, 0.1} { Surface{1}; Layers{1}; }\nMesh 3;", {},
         ["off the plane z = 0"]),
    ],
)  # fmt: skip
def test_geometry_that_cannot_be_an_arm(write, text, keys, words):
    refused(write("own.geo", text), *words, **keys)


def remade(path, text, change):
    """Write a .msh file of a .geo text after `change(gmsh)`."""

    def make(gmsh):
        source = path.with_suffix(".geo")
        source.write_text(text + "\n")
        gmsh.open(str(source))
        change(gmsh)

    return gmsh_writes(path, make)


def test_meshes_that_cannot_be_an_arm(shared_tmp_path, write):
    def second_order(gmsh):
        gmsh.option.setNumber("Mesh.ElementOrder", 2)
        gmsh.model.mesh.generate(2)

    def body(gmsh):
        gmsh.model.geo.extrude([(2, 1)], 0, 0, 0.02)
        gmsh.model.geo.synchronize()
        gmsh.model.addPhysicalGroup(3, [1])
        gmsh.model.mesh.generate(3)

    def push(gmsh):
        """Move a node across its neighbours: such a mesh was accepted with too much mass."""
        gmsh.model.mesh.generate(2)
        tags, points, _ = gmsh.model.mesh.getNodes(2, 1)
        gmsh.model.mesh.setNode(int(tags[0]), [points[0] + 0.045, points[1], 0.0], [])

    for change, words in (
        (second_order, ['"Triangle 6"', "straight"]),
        (body, ["3D"]),
        (lambda gmsh: gmsh.model.mesh.generate(1), ["no cells", "2D"]),
        (push, [" cells "]),
    ):
        text = PLAIN + ENDS + 'Physical Surface("design") = {1};'
        message = refused(remade(shared_tmp_path / "arm.msh", text, change), *words)
        assert change is not push or "overlap" in message or "folded" in message
    refused(write("none.msh", "hello\n"), "not a mesh of Gmsh")
    refused(BORES, "half the height, 0.03 m", passive=0.02)
    refused(BORES, "overlap", "length 0.05 m", length=0.05)


def test_a_mesh_in_millimetres(shared_tmp_path, write):
    """The unit is told before what follows from it; with its scale the arm is that in metres."""
    text = PLAIN + ENDS + 'Physical Surface("design") = {1};'

    def scaled(gmsh):
        gmsh.model.geo.dilate(gmsh.model.getEntities(), 0, 0, 0, 1e3, 1e3, 1e3)
        gmsh.model.geo.synchronize()
        gmsh.model.mesh.setSize(gmsh.model.getEntities(0), 20.0)
        gmsh.model.mesh.generate(2)

    path = remade(shared_tmp_path / "mm.msh", text, scaled)
    refused(path, "500 x 60 m", "0.5 x 0.06 m", "arms.mesh_scale = 0.001")
    mesh = arm_mesh(COMM, entry(path, mesh_scale=1e-3))
    plain = arm_mesh(COMM, entry(write("m.geo", text)))
    areas = [COMM.allreduce(one.area[: one.num_cells].sum()) for one in (mesh, plain)]
    assert areas == pytest.approx([0.5 * 0.06] * 2, rel=1e-12)


solid_box = lifted(bar_with_straight_ends, 0.0, 0.01)


def chamfered(occ):
    box = occ.addBox(0.0, -0.5 * HEIGHT, 0.0, LENGTH, HEIGHT, 0.01)
    occ.synchronize()
    edge = occ.getEntitiesInBoundingBox(-1.0, 0.029, 0.009, 1.0, 0.031, 0.011, 1)[0][1]
    face = occ.getEntitiesInBoundingBox(-1.0, -1.0, 0.009, 1.0, 1.0, 0.011, 2)[0][1]
    occ.chamfer([box], [edge], [face], [0.002])


def stepped(occ):
    low = occ.addBox(0.0, -0.5 * HEIGHT, 0.0, LENGTH, HEIGHT, 0.01)
    boss = occ.addBox(0.2, -0.01, 0.0, 0.02, 0.02, 0.02)
    occ.fuse([(3, low)], [(3, boss)])


@pytest.mark.parametrize(
    ("make", "thickness", "words"),
    [
        (solid_box, 0.02, ["0.01 m thick", "arms.thickness = 0.02 m"]),
        (solid_box, 1e-5, ["millimetres"]),
        (chamfered, 0.01, ["normal to z"]),
        (stepped, 0.02, ["a step at z = 0.01 m"]),
    ],
)
def test_solids_that_cannot_be_an_arm(shared_tmp_path, make, thickness, words):
    refused(step_file(shared_tmp_path / "arm.step", arm=make), *words, thickness=thickness)


QUARTERS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))


@pytest.mark.parametrize("x", [0.0, 0.1])
def test_bores_of_any_radius_are_interfaces(x):
    """Also where rounding of an arc's points puts its two halves on either side of a border."""
    radii = [0.0254 * k / 32.0 for k in range(1, 17)] + [1e-3 * k for k in range(2, 16)]
    radii += [0.0254 * k / 64.0 for k in range(5, 20)]
    for radius in radii:
        with gmsh_on_root(COMM) as gmsh:
            if COMM.rank > 0:
                continue
            occ = gmsh.model.occ
            centre = occ.addPoint(x, 0.0, 0.0)
            ring = [occ.addPoint(x + s * radius, t * radius, 0.0) for s, t in QUARTERS]
            arcs = [occ.addCircleArc(ring[k - 1], centre, ring[k]) for k in range(4)]
            occ.synchronize()
            assert sorted(_circle(gmsh.model, x, 0.0, SQUARES)) == sorted(arcs), radius


def outline(occ):
    occ.addCircle(0.0, 0.0, 0.0, BORE)


def test_step_files_that_cannot_be_an_arm(shared_tmp_path, write):
    path = shared_tmp_path / "arm.step"
    refused(step_file(path, line=outline), "no face")
    refused(step_file(path, arm=plate), "no interface at (0.4, 0) m", length=0.4)
    refused(write("none.step", "hello\n"), "not a STEP file")


def two_squares(**changes):
    """Return the mesh of an arm of two square cells, 2 m x 1 m, as `check_mesh` takes it."""
    points, cells = grid(2, 1)
    ends = {"inboard": np.array([[0, 3]]), "outboard": np.array([[5, 2]])}
    parts = {"cells": cells} | ends | changes
    return points - [0.0, 0.5], parts.pop("cells"), parts


SQUARES = Arm(name="a", length=2.0, height=1.0, thickness=1.0, mesh="a.msh")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cells": np.array([[0, 1, 4, 3], [1, 2, 4, 5]])}, ["1 cells", "folded"]),
        ({"cells": np.array([[0, 1, 2], [0, 1, 4]])}, ["1 cells", "flat"]),
        ({"cells": np.array([[0, 1, 3], [2, 5, 4]])}, ["2 separate parts"]),
        ({"inboard": np.array([[0, 4]])}, ['"inboard"', "no sides"]),
        ({"outboard": np.array([[1, 4]])}, ['"outboard"', "(1, 0) m"]),
    ],
)
def test_check_refuses(changes, words):
    refusal(lambda: check_mesh(*two_squares(**changes), SQUARES), *words)


@pytest.mark.serial  # Gmsh runs on one rank
def test_options_of_one_file_do_not_reach_the_next(write):
    """RecombineAll, sizes and parameters of an arm before leave the next one as it is alone."""
    path = write("own.geo", PLAIN + ENDS)
    alone = figures(arm_mesh(COMM, entry(path)))
    arm_mesh(COMM, entry(path, cell_shape="quadrilateral"))
    bores(mesh_size=0.02)
    assert np.array_equal(figures(arm_mesh(COMM, entry(path))), alone)
    assert np.array_equal(figures(bores()), figures(bores(mesh_size=HEIGHT / 12.0)))
    # Nor does a refused one: Gmsh's parser would go on with the rest of a text it gave up.
    refused(write("bad.geo", "x = = 1;\nPoint(1) = {1};\n" + PLAIN), "syntax error")
    assert np.array_equal(figures(arm_mesh(COMM, entry(path))), alone)


def fan(turns):
    """Return triangles about the origin through so many turns, neighbours sharing a side."""
    angle = np.linspace(0.0, 2.0 * np.pi * turns, 13)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cells = np.array([[0, k, k + 1] for k in range(1, 13)])
    return np.concatenate([np.zeros((1, 2)), rim]), cells


def grid(along=6, across=3):
    """Return points (n, 2) and quadrilaterals of a grid of unit cells."""
    x, y = np.meshgrid(np.arange(along + 1.0), np.arange(across + 1.0))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    first = (np.arange(across)[:, None] * (along + 1) + np.arange(along)).ravel()
    return points, np.stack([first, first + 1, first + along + 1, first + along + 2], axis=1)


def horseshoe(turn):
    """Return a strip of unit width bent round by so many turns: beyond one it meets itself."""
    points, cells = grid(40, 1)
    angle = 2.0 * np.pi * turn * points[:, 0] / 40.0
    radius = 4.0 + points[:, 1]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1), cells


def spiral():
    """Return a strip whose end crosses its beginning, though no cell's centre lies in another."""
    points, cells = horseshoe(1.005)
    return points * (1.0 + 0.1 * (np.arange(len(points)) % 41) / 40.0)[:, None], cells


def pushed():
    """Return triangles with an inner point beyond its neighbours."""
    points, quads = grid()
    cells = np.concatenate([quads[:, [0, 1, 3]], quads[:, [0, 3, 2]]])
    points[8] += [1.3, 0.2]
    return points, cells


def mirrored():
    """Return a grid of cells the last column of which is folded back onto the one before."""
    points, cells = grid()
    points[points[:, 0] == 6.0, 0] = 4.0
    return points, cells


def doubled():
    """Return a grid and a moved copy of one of its cells, which shares a point with it."""
    points, cells = grid()
    new = len(points) + np.arange(4)
    new[3] = cells[7, 3]
    points = np.concatenate([points, points[cells[7]] + [0.01, 0.013]])
    return points, np.concatenate([cells, [new]])


def test_cells_side_by_side_are_accepted():
    check_mesh(*two_squares(), SQUARES)
    check_mesh(*two_squares(cells=np.array([[0, 3, 1, 4], [1, 2, 4, 5]])), SQUARES)  # clockwise
    for made in (grid(), fan(0.9), horseshoe(0.95)):
        check_cells(*made)


@pytest.mark.parametrize(
    "made", [fan(1.1), horseshoe(1.02), spiral(), pushed(), mirrored(), doubled()], ids=range(6)
)
def test_overlapping_cells_are_refused(made):
    assert re.search(r"\d+ cells overlap .*\(", refusal(lambda: check_cells(*made)))


def test_errors_of_the_program_are_not_the_users(write, monkeypatch):
    path = write("own.geo", PLAIN + ENDS)

    def broken(*_):
        raise ZeroDivisionError("a mistake in here")

    monkeypatch.setattr(geometry, "check_mesh", broken)
    with gmsh_on_root(COMM) as gmsh:
        if COMM.rank == 0:
            with pytest.raises(ZeroDivisionError):
                geometry.build_model(gmsh, entry(path))


@pytest.mark.serial
def test_truncated_step_file_leaves_the_terminal_alone(shared_tmp_path, capfd):
    path = step_file(shared_tmp_path / "arm.step", arm=plate)
    path.write_text(path.read_text()[:3000])
    capfd.readouterr()
    refused(path)
    assert capfd.readouterr() == ("", "")


def test_gmsh_may_end_its_own_process_alone_and_ctrl_c_ends_it(monkeypatch):
    with pytest.raises(InputError, match="gave up"):
        in_child(os._exit, 1)
    assert in_child(abs, -1) == 1
    with pytest.raises(ZeroDivisionError):
        in_child(divmod, 1, 0)

    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("multiprocessing.connection.Connection.recv", interrupted)
    with pytest.raises(KeyboardInterrupt):
        in_child(time.sleep, 600.0)
    assert not multiprocessing.active_children()
