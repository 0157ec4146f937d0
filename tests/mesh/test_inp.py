"""Links of others: Abaqus and CalculiX files, interfaces by bores wherever the file has them."""

import meshio
import numpy as np
import pytest
from mpi4py import MPI
from runs import refused
from scipy.spatial.transform import Rotation

from dolfinopt.errors import InputError
from dolfinopt.mesh.abaqus import facets_of, read_abaqus
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.mesh.gmsh_session import gmsh_on_root
from dolfinopt.scene.load import Arm

pytestmark = pytest.mark.serial
COMM = MPI.COMM_SELF
LENGTH, HEIGHT, THICKNESS, RADIUS = 0.3, 0.05, 0.02, 0.012
SIZE = {"name": "a", "length": LENGTH, "height": HEIGHT, "thickness": THICKNESS}
# Where a CAD program has the link: turned, and its inboard bore away from the origin.
TURNED = Rotation.from_rotvec([0.4, -0.8, 1.1]).as_matrix()
MOVED = np.array([0.12, -0.04, 0.033])  # m
MORE = """*MATERIAL, NAME=STEEL
*ELASTIC
210000., 0.3
*STEP
*STATIC
*BOUNDARY
inboard, 1, 3
*END STEP
"""


def write_link(path, order=1):
    """Write a flat link with two bores, tetrahedra, groups as Gmsh saves them."""
    with gmsh_on_root(COMM) as gmsh:
        model = gmsh.model
        model.add("link")
        occ, low = gmsh.model.occ, (-0.5 * HEIGHT, -0.5 * HEIGHT, -0.5 * THICKNESS)
        box = occ.addBox(*low, LENGTH + HEIGHT, HEIGHT, THICKNESS)
        bores = [(3, occ.addCylinder(x, 0.0, -THICKNESS, 0.0, 0.0, 2.0 * THICKNESS, RADIUS))
                 for x in (0.0, LENGTH)]  # fmt: skip
        ((solid, *_), _) = occ.cut([(3, box)], bores)
        occ.synchronize()
        wide = {
            face: np.ptp(np.reshape(model.getBoundingBox(2, face), (2, 3)), axis=0)[0]
            for _, face in model.getEntities(2)
        }
        for name, x in (("inboard", 0.0), ("outboard", LENGTH)):
            own = [face for face, size in wide.items() if abs(size - 2.0 * RADIUS) < 1e-4
                   and abs(occ.getCenterOfMass(2, face)[0] - x) < RADIUS]  # fmt: skip
            model.setPhysicalName(2, model.addPhysicalGroup(2, own), name)
        model.setPhysicalName(3, model.addPhysicalGroup(3, [solid[1]]), "part")
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.012)
        model.mesh.generate(3)
        model.mesh.setOrder(order)
        gmsh.option.setNumber("Mesh.SaveGroupsOfNodes", 1)
        gmsh.write(str(path))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with the link as .msh, .inp, and turned, in mm, of second order."""
    found = tmp_path_factory.mktemp("links")
    write_link(found / "link.msh")
    write_link(found / "link.inp")
    (found / "link.inp").write_text((found / "link.inp").read_text() + MORE)
    write_link(found / "faces.inp", order=2)
    write_link(found / "second.msh", order=2)
    mesh = meshio.read(found / "second.msh")
    cells = [block for block in mesh.cells if block.type == "tetra10"]
    points = 1e3 * (mesh.points @ TURNED.T + MOVED)
    meshio.write(found / "turned.inp", meshio.Mesh(points, cells), file_format="abaqus")
    return found


def link(folder, name, **keys):
    return arm_mesh(COMM, Arm(mesh=str(folder / name), cell_shape="tetrahedron", **SIZE | keys))


def bore(name, x, radius=RADIUS, sign=1.0):
    """Return a bore of the turned link."""
    point, axis = TURNED @ [x, 0.0, 0.0] + MOVED, sign * 3.0 * TURNED[:, 2]
    return {"name": name, "point": tuple(point), "axis": tuple(axis), "radius": radius}


BEGIN, END = bore("inboard", 0.0), bore("outboard", LENGTH)


def same(mesh, other):
    """Return whether cells lie at the same places, and interfaces have as many facets."""
    order = [np.lexsort(np.round(one.centroid, 9).T) for one in (mesh, other)]
    apart = mesh.centroid[order[0]] - other.centroid[order[1]]
    one, two = ((len(m.inboard_facets), len(m.outboard_facets), m.num_cells) for m in (mesh, other))
    return bool(one == two and np.abs(apart).max() < 1e-9)


def test_file_of_abaqus_is_that_of_gmsh(folder):
    """Sets as interfaces; what a model has besides its mesh does not matter."""
    plain = link(folder, "link.msh")
    assert same(link(folder, "link.inp"), plain)
    assert same(link(folder, "faces.inp"), plain)
    area = (LENGTH + HEIGHT) * HEIGHT - 2.0 * np.pi * RADIUS**2
    assert plain.area.sum() == pytest.approx(THICKNESS * area, rel=0.01)


def test_link_is_found_by_its_bores_wherever_it_lies(folder):
    """Turned, in mm, cells of second order and no sets: the same arm to rounding."""
    turned = link(folder, "turned.inp", mesh_scale=1e-3, interfaces=(BEGIN, END))
    assert same(turned, link(folder, "link.msh"))
    # An axis the other way turns the link over about x: its mirror image in y and z together.
    over = link(folder, "turned.inp", mesh_scale=1e-3,
                interfaces=(bore("inboard", 0.0, sign=-1.0), END))  # fmt: skip
    mirrored = np.sort(over.centroid * [1.0, -1.0, -1.0], axis=0)
    assert np.allclose(mirrored, np.sort(turned.centroid, axis=0), atol=1e-9)
    # A .msh file alike, where its groups are not asked for.
    there = BEGIN | {"point": (0.0, 0.0, 0.0), "axis": (0.0, 0.0, 1.0)}
    beyond = there | {"name": "outboard", "point": (LENGTH, 0.0, 0.0)}
    again = link(folder, "link.msh", interfaces=(there, beyond))
    assert same(again, link(folder, "link.msh"))


def write_blocks(path, surfaces):
    """Write a bar of 6 x 2 x 2 hexahedra by hand, sets of nodes and of cells."""
    nx, n = 6, 2
    x, y, z = np.meshgrid(
        np.linspace(0.0, 0.3, nx + 1), np.linspace(-0.02, 0.02, n + 1),
        np.linspace(-0.02, 0.02, n + 1), indexing="ij",
    )  # fmt: skip
    number = np.arange(1, x.size + 1).reshape(x.shape)
    lines = ["*HEADING", "a bar", "*NODE"]
    rows = zip(number.ravel(), x.ravel(), y.ravel(), z.ravel(), strict=True)
    lines += [f"{k}, {a:.9g}, {b:.9g}, {c:.9g}" for k, a, b, c in rows]
    lines.append("*ELEMENT, TYPE=C3D8R, ELSET=ALL")
    for cell, (i, j, k) in enumerate(np.ndindex(nx, n, n), 1):
        low, high = number[i : i + 2, j : j + 2, k], number[i : i + 2, j : j + 2, k + 1]
        around = [one[a] for one in (low, high) for a in ((0, 0), (1, 0), (1, 1), (0, 1))]
        lines.append(", ".join(map(str, [cell, *around])))
    for name, plane in (("INBOARD", number[0]), ("OUTBOARD-1", number[-1])):
        lines += [f"*NSET, NSET={name}", ", ".join(map(str, plane.ravel()))]
    side = number[2:4, 2, :]
    lines += ["*NSET, NSET=Side", ", ".join(map(str, side.ravel()))]
    lines += ["*ELSET, ELSET=PASSIVE_ROOT, GENERATE", "1, 4, 1", "*ELSET, ELSET=VOID", "13, 14"]
    if surfaces:  # in place of the sets of nodes
        lines = [line.replace("BOARD", "") if "NSET" in line else line for line in lines]
        lines += ["*ELSET, ELSET=_last, GENERATE", "21, 24, 1"]
        lines += ["*SURFACE, TYPE=ELEMENT, NAME=inboard", "PASSIVE_ROOT, S6"]
        lines += ["*SURFACE, TYPE=ELEMENT, NAME=Outboard", "_last, S4"]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("surfaces", [False, True])
def test_sets_are_interfaces_and_regions(surfaces, tmp_path):
    """Hexahedra of CalculiX; a further interface, cells that stay solid and void."""
    write_blocks(tmp_path / "bar.inp", surfaces)
    mesh = arm_mesh(COMM, Arm(
        mesh=str(tmp_path / "bar.inp"), cell_shape="hexahedron", name="a", length=0.3, height=0.04,
        thickness=0.04, interfaces=({"name": "side", "point": (0.125, 0.02, 0.0)},),
    ))  # fmt: skip
    assert mesh.num_cells == 24 and mesh.area.sum() == pytest.approx(0.3 * 0.04**2, rel=1e-12)
    assert (len(mesh.inboard_facets), len(mesh.outboard_facets)) == (4, 4)
    assert [len(one.facets) for one in mesh.further] == [2]
    assert np.all(mesh.passive == (mesh.centroid[:, 0] < 0.05)) and mesh.passive.sum() == 4
    assert mesh.void.sum() == 2 and np.allclose(mesh.centroid[mesh.void, 0], 0.175)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("solid bar\n", ["bar.inp", "begins with *"]),
        ("*NODE\n1, 0, 0, 0\n*INCLUDE, INPUT=/etc/passwd\n", ["line 3, *INCLUDE", "one file"]),
        ("*NODE\n1, 0, 0\n*ELEMENT, TYPE=C3D8\n1, 1\n", ["line 4, *ELEMENT, TYPE=C3D8", "8 nodes"]),
        ("*NODE\n1, 0, a\n", ["line 2, *NODE", "'a' is not a number"]),
        ("*NODE\n1, 0\n*ELEMENT, TYPE=C3D6\n", ["line 3, *ELEMENT, TYPE=C3D6", "hexahedra"]),
        ("*NODE\n1, 0\n1, 1\n", ["line 3, *NODE", "node 1 for the second time"]),
        ("*NODE\n1, 0\n*ELEMENT, TYPE=C3D4\n1, 1, 1, 1, 2\n", ["line 4", "no node 2"]),
        ("*NODE\n1, 0\n*NSET, NSET=a, GENERATE\n1, 5, 1, 1\n", ["line 4, *NSET", "step"]),
        ("*NODE\n1, 0\n*NSET,\nNSET=a\n1, b\n", ["line 5, *NSET,NSET=a", "'b'"]),
        ("*NODE, INPUT=nodes.txt\n", ["line 1, *NODE, INPUT=nodes.txt", "one file"]),
        ("*NODE, SYSTEM=C\n1, 0\n", ["line 1", "another system"]),
        ("*NODE\n1, 0\n*NGEN\n1, 5\n", ["line 3, *NGEN", "written out"]),
        ("*NODE\n1,0,0,0\n2,1,0,0\n3,0,1,0\n*ELEMENT, TYPE=CPS3\n1,1,2,3\n", ["C3D4", "C3D8"]),
    ],
)
def test_files_that_are_no_link(text, words, tmp_path):
    (tmp_path / "bar.inp").write_text(text)
    with refused(*words):
        link(tmp_path, "bar.inp")


def test_forms_that_programs_write(folder):
    """Several blocks of nodes, GENERATE, sets of sets, lines and masses beside the cells."""
    lines = (folder / "link.inp").read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if line.upper().startswith("*NODE")) + 1
    last = next(k for k in range(first, len(lines)) if lines[k].startswith("*"))
    nodes, rest = lines[first:last], lines[last:]
    half = len(nodes) // 2
    rest = [line.replace("NSET=inboard", "NSET=left") for line in rest]
    more = ["*NSET, NSET=INBOARD", "left,", "*NSET, NSET=fixed, GENERATE", "1, 5, 2", "7, 9",
            "*ELEMENT, TYPE=B31, ELSET=BEAM", "900001, 1, 2", "*ELEMENT, TYPE=MASS", "900002, 1",
            "*MASS, ELSET=BEAM", "0.1"]  # fmt: skip
    text = [*lines[:first], *nodes[:half], "*Node, nset=second", *nodes[half:], *rest, *more]
    (folder / "forms.inp").write_text("\r\n".join(text))
    assert same(link(folder, "forms.inp"), link(folder, "link.msh"))
    mesh = read_abaqus("\n".join(text))
    assert mesh.node_sets["fixed"] == [1, 3, 5, 7, 8, 9]
    assert len(mesh.node_sets["second"]) == len(nodes) - half


def test_nodes_of_an_element_set_and_faces_of_a_surface():
    """`*NSET, ELSET=` takes corners; a surface names sets, elements or nodes."""
    text = (
        "*NODE\n1,0,0,0\n2,1,0,0\n3,0,1,0\n4,0,0,1\n*ELEMENT, TYPE=C3D4, ELSET=E\n"
        "7, 1, 2,\n3, 4\n*NSET, NSET=n, ELSET=e\n*SURFACE, NAME=s\n7, S2\nE, S4\n"
        "*SURFACE, TYPE=NODE, NAME=p\nn, 1.0\n"
    )
    mesh = read_abaqus(text)
    assert mesh.node_sets == {"n": [1, 2, 3, 4], "p": [1, 2, 3, 4]}
    assert facets_of(mesh, "s") == [[1, 4, 2], [3, 4, 1]]


def test_what_is_missing_is_told(folder):
    """Sets of other names, bores of other radii or places, with what the file has."""
    with refused('node set "inboard" is missing', "*NSET, NSET=inboard", "state its bore"):
        link(folder, "turned.inp")
    with refused("no bore of radius 0.01 m", '"inboard"', "0.012 m from the axis", "mesh_scale"):
        bores = bore("inboard", 0.0, 0.01), END
        link(folder, "turned.inp", mesh_scale=1e-3, interfaces=bores)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"interfaces": (BEGIN,)}, ['"outboard"', "the arm's frame"]),
        ({"interfaces": (BEGIN, bore("outboard", 0.31))}, ["0.31 [m]", "distance"]),
        ({"interfaces": (BEGIN | {"axis": (0.0, 0.0, 0.0)}, END)}, ["not of length zero"]),
        ({"interfaces": (BEGIN | {"axis": None}, END)}, ["expected those of the bore"]),
        ({"cell_shape": None}, ["tetrahedron", ".inp"]),
        ({"mesh": None, "cells": (20, 4), "cell_shape": None, "mesh_scale": 0.001},
         ["the default, without mesh"]),
    ],
)  # fmt: skip
def test_keys_that_do_not_fit(folder, keys, words):
    told = {"mesh": str(folder / "turned.inp"), "cell_shape": "tetrahedron"} | SIZE | keys
    with pytest.raises(ValueError) as caught:
        Arm(**{key: value for key, value in told.items() if value is not None})
    assert all(word in str(caught.value) for word in words)
    assert not isinstance(caught.value, InputError)
