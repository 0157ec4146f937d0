"""Meshes and geometry as other programs write them: Gmsh in all of its formats, CadQuery."""

from pathlib import Path

import gmsh
import numpy as np
import pytest
from mpi4py import MPI

from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.scene.tables.arms import Arm

SIZE = {"name": "link", "length": 0.3, "height": 0.04, "thickness": 0.01}
AREA = 0.34 * 0.04 - 2.0 * np.pi * 0.008**2
CADQUERY = Path(__file__).parent / "programs" / "cadquery_face.step"

pytestmark = pytest.mark.serial


def write_link(path, version, binary, quadrilaterals=False):
    """Let Gmsh write a plate with two bores, its groups as a user names them."""
    gmsh.initialize()
    try:
        for name, value in (("General.Terminal", 0), ("Mesh.MeshSizeMax", 0.008),
                            ("Mesh.RecombineAll", quadrilaterals), ("Mesh.Binary", binary),
                            ("Mesh.MshFileVersion", version)):  # fmt: skip
            gmsh.option.setNumber(name, value)
        occ = gmsh.model.occ
        plate = occ.addRectangle(-0.02, -0.02, 0.0, 0.34, 0.04)
        bores = [(2, occ.addDisk(x, 0.0, 0.0, 0.008, 0.008)) for x in (0.0, 0.3)]
        ((_, face),), _ = occ.cut([(2, plate)], bores)
        occ.synchronize()
        rims = {round(occ.getCenterOfMass(1, line)[0], 6): line
                for _, line in gmsh.model.getEntities(1) if gmsh.model.getType(1, line) == "Circle"
                or gmsh.model.getType(1, line) == "Ellipse"}  # fmt: skip
        for x, name in ((0.0, "inboard"), (0.3, "outboard")):
            gmsh.model.setPhysicalName(1, gmsh.model.addPhysicalGroup(1, [rims[x]]), name)
        gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, [face]), "link")
        gmsh.model.mesh.generate(2)
        gmsh.write(str(path))
    finally:
        gmsh.finalize()


@pytest.mark.parametrize(
    ("version", "binary"), [(2.2, False), (2.2, True), (4.0, False), (4.1, False), (4.1, True)]
)
def test_every_format_of_gmsh_is_read(tmp_path, version, binary):
    file = tmp_path / "link.msh"
    write_link(file, version, binary, quadrilaterals=binary)
    mesh = arm_mesh(MPI.COMM_SELF, Arm(mesh=str(file), **SIZE))
    assert mesh.area.sum() == pytest.approx(AREA, rel=5e-3)
    assert (mesh.centroid > -0.02).all()
    assert len(mesh.inboard_facets) == len(mesh.outboard_facets) > 4


def test_a_face_of_cadquery_is_meshed():
    """In millimetres, rounded corners, no names: the bores are found."""
    arm = Arm(mesh=str(CADQUERY), mesh_size=0.008, **SIZE)
    corners = 4.0 * (1.0 - np.pi / 4.0) * 0.008**2
    mesh = arm_mesh(MPI.COMM_SELF, arm)
    assert mesh.area.sum() == pytest.approx(AREA - corners, rel=2e-3)
