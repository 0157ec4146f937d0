"""Solid arms from STEP, .geo and .msh files: groups, interfaces by place, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from runs import refusal
from solids import HEIGHT, LENGTH, THICKNESS, solid_scene

from dolfinopt.arms.arm import Arm as Flexible
from dolfinopt.errors import InputError
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh, arm_mesh
from dolfinopt.mesh.checks import facet_corners
from dolfinopt.mesh.gmsh_session import gmsh_on_root
from dolfinopt.profiling import Profile
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


def mesh_of(path: Path, **keys: object) -> ArmMesh:
    told = {"cell_shape": "tetrahedron"} | keys
    return arm_mesh(COMM, Arm(**KEYS | told, mesh=str(path)))


def sums(mesh: ArmMesh) -> np.ndarray:
    """Return volume, solid volume and the areas of both interfaces as the mass they carry."""
    return COMM.allreduce(np.array([mesh.area.sum(), mesh.area[mesh.passive].sum()]))


def written(folder: Path, name: str, bored: bool, *more: float) -> Path:
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


def facets_at(mesh: ArmMesh, facets: np.ndarray) -> np.ndarray:
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


def test_body_of_a_step_file(shared_tmp_path):
    """Quadratic tetrahedra, from file to floating body: six coordinates, the solid's inertia."""
    path = written(shared_tmp_path, "bar.step", bored=False)
    keys = {"cells": None, "mesh": str(path), "mesh_size": 0.015, "cell_shape": "tetrahedron"}
    scene = solid_scene(**keys, filter_radius=0.02)
    arm = Flexible(scene, 0, COMM, Profile())
    body = arm.reduce(arm.physical(np.ones(arm.mesh.num_cells)))
    mass = 2700.0 * LENGTH * HEIGHT * THICKNESS
    assert body.mass == pytest.approx(mass, rel=1e-9)
    assert body.W[0, 0, 0] == pytest.approx(mass * LENGTH**2 / 3.0, rel=1e-9)
    bending = 3.0 * 70e9 * THICKNESS * HEIGHT**3 / 12.0 / LENGTH**3
    assert np.linalg.inv(body.K)[1, 1] * bending == pytest.approx(1.0, abs=0.02)


def row_of_cubes(path: Path) -> Path:
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
