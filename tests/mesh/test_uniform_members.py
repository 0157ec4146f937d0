"""Members of uniform section: areas in closed form, their bodies against the theory of beams."""

import math

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT

import dolfinopt as do
from dolfinopt.mesh import hollow
from dolfinopt.mesh.checks import cell_volumes, check_cells
from dolfinopt.mesh.hollow import FLAT_BAR, SOLID_BAR, member
from dolfinopt.mesh.solid_cells import TENSOR
from dolfinopt.output.design import arms_with_design
from dolfinopt.profiling import Profile
from dolfinopt.study.sections import Members

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
    cells = found.cells[:, TENSOR[8]]
    check_cells(found.points, cells)
    area = section.area(HEIGHT, THICKNESS, share)
    assert area == pytest.approx(moments(kind, share)[0], rel=1e-12)
    assert cell_volumes(found.points[cells]).sum() == pytest.approx(area * LENGTH, rel=1e-9)
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
    _, arms, x_phys = arms_with_design(MPI.COMM_SELF, made, None, Profile())
    body = arms[1].reduce(x_phys[1])
    A, I_z, I_y, along_y, along_z, twist = moments(kind, share)
    assert body.mass == pytest.approx(2700.0 * A * LENGTH, rel=1e-9)
    assert body.mass == pytest.approx(members.mass(1, share), rel=1e-9)
    flexibility = np.diag(body.outboard @ np.linalg.solve(body.K, body.outboard.T))
    expected = [LENGTH**3 / (3.0 * E * second) + LENGTH / (G * a)
                for second, a in ((I_z, along_y), (I_y, along_z))]  # fmt: skip
    assert flexibility[1:3] == pytest.approx(expected, rel=0.01)
    if share < 0.1 or kind in ("round tube", "solid bar"):
        assert flexibility[3] == pytest.approx(twist, rel=0.01)
