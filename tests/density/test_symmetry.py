"""Symmetric designs: pairs of cells, the exact transpose, and the chain of an arm."""

import dataclasses

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT, refused

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.data import mesh_folder
from dolfinopt.density.filter import Average, mirrored
from dolfinopt.mesh.arm_mesh import arm_mesh, box_arm
from dolfinopt.scene.load import Arm as Entry

COMM = MPI.COMM_WORLD
BORES = str(mesh_folder() / "arm_bores.geo")
SCENE = ROOT / "demos" / "two_arm_bores.toml"


def bores(shape, **keys):
    keys = {"length": 0.5, "height": 0.06, "thickness": 0.01, "mesh_size": 0.01} | keys
    return arm_mesh(COMM, Entry(name="a", mesh=BORES, cell_shape=shape, **keys))


MESHES = {
    "rectangle": lambda: box_arm(COMM, "a", (1.0, 0.06), (20, 4)),
    "odd rectangle": lambda: box_arm(COMM, "a", (1.0, 0.06), (20, 5)),
    "quadrilaterals": lambda: bores("quadrilateral"),
    "triangles": lambda: bores("triangle"),
}


@pytest.fixture(scope="module", params=MESHES)
def mesh(request):
    return MESHES[request.param]()


def symmetric(mesh):
    return Average(mesh, mirrored(mesh))


def wave(centroid):
    """Return a field in [0, 1] without any symmetry."""
    return 0.5 + 0.5 * np.sin(31.0 * centroid[:, 0] + 70.0 * centroid[:, 1] + 0.4)


def test_field_becomes_the_mean_of_itself_and_its_mirror_image(mesh):
    symmetry = symmetric(mesh)
    here, there = mesh.centroid, mesh.centroid * [1.0, -1.0]
    y = symmetry.forward(wave(here))
    # Gmsh places points to 1e-9 of their curves, the wave is 80 / m steep.
    assert np.allclose(y, 0.5 * (wave(here) + wave(there)), atol=1e-7)
    assert np.array_equal(symmetry.forward(y), y)  # pairs: the second time changes nothing
    even = np.cos(50.0 * here[:, 1])
    assert np.allclose(symmetry.forward(even), even, atol=1e-7)
    odd = np.sin(50.0 * here[:, 1])
    assert np.allclose(symmetry.forward(odd), 0.0, atol=1e-7)
    assert np.array_equal(symmetry.forward(np.full(mesh.num_cells, 0.3)), np.full(len(odd), 0.3))
    before, after = COMM.allreduce(np.array([mesh.area @ wave(here), mesh.area @ y]))
    assert after == pytest.approx(before, rel=1e-8)  # areas of a pair agree to 1e-9


def test_mesh_without_symmetry_is_refused():
    mesh = box_arm(COMM, "a", (1.0, 0.06), (20, 4))
    above = dataclasses.replace(mesh, centroid=mesh.centroid + np.array([0.0, 0.03]))
    with refused("no mirror image", "1.25 cell"):
        symmetric(above)


# --- in an arm -------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["quadrilateral", "triangle"])
def test_chain_is_the_transpose_of_physical(shape):
    """Symmetry, filter and solid cells together, on an arm that the ranks share."""
    overrides = ["arms.mesh_size=0.012", f'arms.cell_shape="{shape}"']
    arm = Arm(do.load_scene(SCENE, overrides), 0, COMM, do.Profile())
    centroid = arm.mesh.centroid
    x, dx = 0.35 + 0.3 * wave(centroid), 0.3 * np.cos(60.0 * centroid[:, 1] + 20.0 * centroid[:, 0])
    w = arm.mesh.area * np.sin(45.0 * centroid[:, 0] + 90.0 * centroid[:, 1])
    change = arm.physical(x + dx) - arm.physical(x)  # linear: no limit is met
    left, right, size = COMM.allreduce(
        np.array([w @ change, arm.backward(w) @ dx, np.abs(w) @ np.abs(change)])
    )
    assert abs(left - right) < 1e-12 * size
    physical = arm.physical(x)
    assert np.allclose(symmetric(arm.mesh).forward(physical), physical, atol=1e-9)
    assert (physical[arm.mesh.passive] == 1.0).all()
