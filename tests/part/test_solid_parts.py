"""Parts of solid arms: closed, of the design's volume, exact at the arm's own faces."""

from __future__ import annotations

import io
import json
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT, run, shell
from solids import HEIGHT, LENGTH, THICKNESS, solid_scene

import dolfinopt as do
from dolfinopt.errors import InputError
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.part.isosurface import cut, nodal_densities, outside
from dolfinopt.part.solid import MM, triangle_bytes
from dolfinopt.part.solid_part import make_solid_part, solid_domain
from dolfinopt.part.three_mf import CORE, three_mf_bytes

trimesh = pytest.importorskip("trimesh")
pytestmark = pytest.mark.serial
CELLS = (40, 6, 4)
LOW = np.array([0.0, -0.5 * HEIGHT, -0.5 * THICKNESS])
HIGH = np.array([LENGTH, 0.5 * HEIGHT, 0.5 * THICKNESS])


def windows(x, y, z):
    """A frame with struts, holes along z; crisp."""
    return 1.0 * ((np.abs(y) > 0.0131) | (np.abs((x + 0.05) % 0.1 - 0.05) < 0.0255))


def hollow(x, y, z):
    """A cavity that no face shows, and slanted grey ends."""
    inside = (np.abs(y) < 0.013) & (np.abs(z) < 0.005)
    return np.where(inside, np.clip(30.0 * np.abs(x - 0.25 + 2.0 * y) - 4.0, 0.0, 1.0), 1.0)


def islands(x, y, z):
    """A bar along the lower side, and two pieces that no joint holds."""
    return 1.0 * (
        (y < -0.006) | (x < 0.03) | (x > 0.47) | ((y > 0.01) & (np.abs(x % 0.2 - 0.1) < 0.02))
    )


def read_three_mf(data):
    """Return the mesh of a 3MF file, its corners as the file has them."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        model = ElementTree.fromstring(file.read("3D/3dmodel.model"))
    assert model.get("unit") == "millimeter"
    points, triangles = (
        [[one.get(key) for key in keys] for one in model.iter(f"{{{CORE}}}{tag}")]
        for tag, keys in (("vertex", "xyz"), ("triangle", ("v1", "v2", "v3")))
    )
    return trimesh.Trimesh(np.array(points, float), np.array(triangles, int), process=False)


@pytest.fixture(scope="module")
def domain_with():
    """A function that returns the domain of a density given by x, y, z, m."""
    mesh = arm_mesh(MPI.COMM_SELF, solid_scene(cells=CELLS).arms[0])
    return lambda density: solid_domain(mesh, density(*mesh.centroid.T).astype(float))


@pytest.mark.parametrize("density", [windows, hollow, islands])
def test_part_of_a_solid(domain_with, density):
    domain = domain_with(density)
    part = make_solid_part(domain)
    assert part.watertight
    assert part.surface.volume == pytest.approx(domain.volume, rel=1e-4)
    assert 0.01 * domain.cell < part.distance <= 0.5 * domain.cell
    stl = trimesh.load_mesh(
        io.BytesIO(triangle_bytes(MM * part.surface.corners, "part, mm")), "stl"
    )
    for found, size in ((stl, 1e-7), (read_three_mf(three_mf_bytes(part.surface, "a & b")), 1e-9)):
        assert found.is_watertight and found.is_winding_consistent
        assert found.volume == pytest.approx(1e9 * domain.volume, rel=1e-4)
        assert found.bounds == pytest.approx(MM * np.array([LOW, HIGH]), abs=MM * size)
    assert (part.surface.points >= LOW - 1e-12).all() and (
        part.surface.points <= HIGH + 1e-12
    ).all()
    # Points on the arm's own faces are where the isosurface has them: in their planes to 1e-9 m.
    points, nodes, values = nodal_densities(domain.corners, domain.x_phys)
    before, _ = outside(cut(points, nodes, values, part.level))
    off = [
        np.minimum(np.abs(p - LOW), np.abs(p - HIGH)) for p in (before.points, part.surface.points)
    ]
    near = [(one.min(axis=1) < 1e-3 * domain.cell) for one in off]
    assert off[1][near[1]].min(axis=1).max() < 1e-9
    if density is not islands:
        assert part.pieces == 0 and np.array_equal(*near)
        assert np.array_equal(before.points[near[0]], part.surface.points[near[0]])
    for side in (0.0, LENGTH):  # all of both interfaces, where the design has them
        flat = (np.abs(part.surface.corners[..., 0] - side) < 1e-9).all(axis=1)
        a, b, c = part.surface.corners[flat].swapaxes(0, 1)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        assert area == pytest.approx(HEIGHT * THICKNESS, rel=1e-9)


def test_three_mf_is_read_by_others(domain_with):
    pytest.importorskip("networkx")
    pytest.importorskip("lxml")
    surface = make_solid_part(domain_with(windows)).surface
    found = trimesh.load(io.BytesIO(three_mf_bytes(surface, "a & b")), "3mf", force="mesh")
    assert found.is_watertight
    assert found.volume == pytest.approx(1e9 * surface.volume, rel=1e-6)


def test_pieces_without_a_joint_are_left_out(domain_with):
    """The level makes up for them, and they are told."""
    part = make_solid_part(domain_with(islands))
    assert part.pieces == 2 and part.pieces_volume > 0.0
    assert any("2 pieces without a joint" in one for one in part.warnings)
    points = part.surface.points
    assert not ((points[:, 1] > 0.01) & (np.abs(points[:, 0] - 0.1) < 0.03)).any()


def test_smoothing_takes_stairs_away(domain_with):
    """A slanted crisp end of a cavity: less area than the isosurface, at the same volume."""
    domain = domain_with(lambda x, y, z: 1.0 * (hollow(x, y, z) > 0.5))
    part = make_solid_part(domain)
    before = outside(cut(*nodal_densities(domain.corners, domain.x_phys), part.level))[0]
    assert trimesh.Trimesh(*(part.surface.points, part.surface.triangles)).area < (
        0.995 * trimesh.Trimesh(before.points, before.triangles).area
    )


@pytest.mark.parametrize(
    ("density", "words"),
    [
        (lambda x, y, z: 1.0 * (np.abs(x - 0.25) > 0.1), "and joins both interfaces"),
        (lambda x, y, z: np.full_like(x, 0.5), "too grey for a part"),
    ],
)
def test_no_part_can_be_made(domain_with, density, words):
    with pytest.raises(InputError, match=f"arm 'arm1': .*{words}"):
        make_solid_part(domain_with(density))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """What `dolfinopt part` reads of a run of two solid links."""
    path = tmp_path_factory.mktemp("solids") / "run"
    changes = [f"arms.{name}.cells=[20,4,2]" for name in ("link1", "link2")]
    scene = do.load_scene(ROOT / "demos" / "spatial_arm.toml", changes)
    arrays = {}
    for arm in scene.arms[1:]:
        mesh = arm_mesh(MPI.COMM_SELF, arm)
        arrays[f"{arm.name}/centroid"] = mesh.centroid
        arrays[f"{arm.name}/density"] = windows(*mesh.centroid.T)
    path.mkdir()
    np.savez(path / "design.npz", **arrays)
    (path / "summary.json").write_text(json.dumps({"scene": scene.to_dict()}))
    return path


def test_two_ranks_write_the_same_solids(finished, tmp_path, capfd):
    run("part", finished, "--out", tmp_path / "one")
    told = capfd.readouterr().out
    assert "no STEP of solids" in told and "column: no part" in told
    done = shell("part", finished, "--out", tmp_path / "two", "--no-plots", ranks=2)
    assert done.returncode == 0, done.stderr
    here, there = (
        {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()}
        for name in ("one", "two")
    )
    kinds = [f"link{k}.{kind}" for k in (1, 2) for kind in ("3mf", "msh", "stl")]
    assert sorted(there) == sorted([*kinds, "part.json", "part.toml"])
    assert here.keys() - there.keys() == {"part.png"}
    assert [name for name in there if here[name] != there[name]] == []
    rows = json.loads(here["part.json"])["arms"]
    for row in rows.values():
        assert row["volume"] == pytest.approx(row["design_volume"], rel=1e-4)
        assert row["watertight"] and row["pieces_left_out"] == 0
    # The machine with the parts: solid, of their mass but for the facets of its mesh.
    scene = do.load_scene(tmp_path / "one" / "part.toml")
    mesh = arm_mesh(MPI.COMM_SELF, scene.arms[1])
    assert mesh.area.sum() == pytest.approx(rows["link1"]["volume"], rel=0.01)
    assert len(mesh.inboard_facets) and len(mesh.outboard_facets)
    assert scene.design.volume_fraction == 1.0


@pytest.mark.parametrize("option", ["--polish=2", "--tolerance=1e-4", "--curves=arcs"])
def test_options_of_outlines_are_refused(finished, option):
    done = shell("part", finished, option)
    assert done.returncode == 2 and option.split("=")[0] in done.stderr
    assert not (finished / "part").exists()
