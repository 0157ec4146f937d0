"""Material laws: orthotropic ones against closed forms and published beams, laws of one's own."""

import numpy as np
import pytest
import solids
from mpi4py import MPI
from solids import solid_arm
from test_elements import SHAPES, distorted

from dolfinopt.fem.laws import Orthotropic, directions, turned
from dolfinopt.fem.tensors import ElementTensors, stress_points
from dolfinopt.profiling import Profile
from dolfinopt.responses.sensitivity import static_response
from dolfinopt.scene.tables.material import Material

E1, E2, G12, NU12 = 140e9, 10e9, 5e9, 0.3
CARBON = {"kind": "orthotropic", "young_modulus": (E1, E2), "shear_modulus": G12}
CARBON |= {"poisson_ratio": NU12, "density": 1600.0}


def material(**more):
    return Material(**CARBON | more)


def off_axis(angle):
    """Return 1/E_x, -nu_xy/E_x, eta/E_x and 1/G_xy at an angle from direction 1.

    eta is Lekhnitskii's coefficient, the shear strain of a tension over its extension.
    Source: Lekhnitskii, Theory of Elasticity of an Anisotropic Body (1981).
    """
    c, s = np.cos(angle), -np.sin(angle)  # of x, seen from direction 1
    a, b, d, e = 1.0 / E1, 1.0 / E2, NU12 / E1, 1.0 / G12
    return np.array(
        [
            a * c**4 + (e - 2.0 * d) * (s * c) ** 2 + b * s**4,
            (a + b - e) * (s * c) ** 2 - d * (s**4 + c**4),
            -(2.0 * a + 2.0 * d - e) * s * c**3 + (2.0 * b + 2.0 * d - e) * s**3 * c,
            2.0 * (2.0 * a + 2.0 * b + 4.0 * d - e) * (s * c) ** 2 + e * (s**4 + c**4),
        ]
    )


@pytest.mark.serial
@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0])
@pytest.mark.parametrize(("shape", "element"), SHAPES, ids=repr)
def test_tension(shape, element, degrees):
    """140, 21.3 and 10 GPa: exact stress and energy on distorted cells, nodes inside in balance."""
    arm, size, _ = distorted(shape, element)
    d, mesh, solid = len(size), arm.mesh, material(angle=np.radians(degrees))
    C = turned(Orthotropic(solid).tensor(d), directions(mesh, solid))
    tensors = ElementTensors(mesh, element, 1.0, C, Profile())
    extension, contraction, shear, _ = off_axis(np.radians(degrees))
    strain = np.zeros((d, d))
    strain[0, 0], strain[1, 1], strain[0, 1] = extension, contraction, shear
    if d == 3:  # through the thickness, where E3 = E2
        strain[2, 2] = -NU12 / E1 * np.cos(np.radians(degrees)) ** 2
        strain[2, 2] -= NU12 / E2 * np.sin(np.radians(degrees)) ** 2
    u = (tensors.points @ strain)[tensors.cells].reshape(mesh.num_cells, -1, 1)
    stress = E1 * (tensors.stress(stress_points(tensors.cell)) @ u[:, None])
    assert np.allclose(stress[..., 0, 0], 1.0, rtol=1e-10)
    assert np.abs(stress[..., 1:, 0]).max() < 1e-10
    energy = (u.swapaxes(1, 2) @ tensors.stiffness @ u)[:, 0, 0]
    assert np.allclose(E1 * energy, extension * mesh.area, rtol=1e-9)


@pytest.mark.serial
@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0])
def test_a_wound_tube(degrees):
    """Extension, twist and what couples both of a thin wall, fibres at an angle in it, to 1 %.

    The wall is in tension F / A, or in shear M / (2 A R).
    """
    L, d, angle = 3.0, 0.12, np.radians(degrees)
    t = d / 60.0
    arm = solid_arm(
        MPI.COMM_SELF, length=L, height=d, thickness=d, cells=(48, 6, 6), hollow="tube",
        wall=t, min_wall=0.5 * t, max_wall=4.0 * t, passive=0.0,
        angle=angle, **CARBON,
    )  # fmt: skip
    tip = static_response(arm.state(arm.uniform()).elastic, np.eye(6)[[0, 3]]).tip
    R = 0.5 * (d - t)
    A = 2.0 * np.pi * R * t
    extension, _, shear, twist = off_axis(angle)
    # Seen from outside the angle is counter-clockwise, a moment about x the other way round.
    exact = L / A * np.array([[extension, -shear / R], [-shear / R, twist / R**2]])
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert np.abs((tip[[0, 3]] - exact) / scale).max() < 0.01


@pytest.mark.serial
@pytest.mark.parametrize(
    ("degrees", "measured"),
    [(15.0, [82.5, 511.3, 1423.4, 1526.9]), (30.0, [52.7, 331.8, 924.7, 1766.9])],
)
def test_published_beams(degrees, measured):
    """Frequencies of cantilevers of graphite and epoxy, Hz, to 4 %.

    The clamp holds the section's twist, which goes with bending: 3.7 % above a beam's with E_x,
    and 1.0 % on four times the length.
    """
    # Abarcar & Cunniff, J. Composite Materials 6 (1972) 504-517: 190.5 x 12.7 x 3.18 mm.
    size = {"length": 0.1905, "height": 0.0127, "thickness": 0.00318}
    carbon = {"kind": "orthotropic", "young_modulus": (129.11e9, 9.408e9), "density": 1551.5}
    carbon |= {"shear_modulus": (5.1567e9, 2.5414e9, 4.3053e9), "poisson_ratio": NU12}
    arm = solid_arm(
        MPI.COMM_SELF, **size, **carbon, cells=(30, 4, 1), passive=0.0, element="quadratic",
        angle=np.radians(degrees),
    )  # fmt: skip
    found = solids.frequencies(arm.state(arm.uniform(1.0)).elastic, 8)
    nearest = [found[np.abs(found - one).argmin()] for one in measured]
    assert nearest == pytest.approx(measured, rel=0.04)
