"""Beams that are spun up: the standard test of geometric stiffening."""

from pathlib import Path

import numpy as np
import pytest
from bodies import plane_chain
from remainders import substructure

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.fem.geometric_stiffness import unit_loads
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import shape_integrals
from dolfinopt.profiling import Profile
from dolfinopt.reduction import METHODS, Options

pytestmark = pytest.mark.serial

REFERENCE = Path(__file__).parents[2] / "benchmarks" / "reference"
RUN_UP = 15.0  # s


def cells_beam(length, area, bending, axial, line_mass):
    """Return a beam of EI (N m2), EA (N), rho A (kg/m) as a floating body of plane cells, nu = 0.

    Its section is a rectangle whose height follows from EI / EA.
    """
    height = np.sqrt(12.0 * bending / axial)
    size = (length, height, area / height)
    arm = substructure(size, (100, 2), element="incompatible", poisson_ratio=0.0)
    one = np.ones(arm.mesh.num_cells)
    design = arm.at(axial / area * one, line_mass / area * one)
    basis = METHODS["craig-bampton"].reduce(design, Options(6), None)
    return shape_integrals(design, basis, 0.0, unit_loads(design))


def spun_up(speed):
    """Return the motion whose angular velocity grows to `speed`, rad/s, as t - sin, in 15 s."""
    a = 2.0 * np.pi / RUN_UP

    def motion(t):
        on = t < RUN_UP
        angle = np.where(on, speed / RUN_UP * (0.5 * t * t + (np.cos(a * t) - 1.0) / a**2), 0.0)
        angle += np.where(on, 0.0, speed * (t - 0.5 * RUN_UP))
        rate = np.where(on, speed / RUN_UP * (t - np.sin(a * t) / a), speed)
        growth = np.where(on, speed / RUN_UP * (1.0 - np.cos(a * t)), 0.0)
        columns = [np.stack([np.zeros_like(t), x], axis=1) for x in (angle, rate, growth)]
        return RigidMotion(*columns)

    return motion


def tip(body, speed, t):
    """Return axial and transverse deflection (n, 2) of the tip in the rotating frame, m."""
    mechanism = plane_chain((body,), 0.0, 0.0, (0.0, 0.0), 0.0)
    system = MachineSystem(mechanism, spun_up(speed), (0.0, RUN_UP, float(t[-1])))
    q = radau.integrate(system, 1e-5, 4, Profile()).sample(t, 0)
    linear = q @ body.outboard[:2].T
    return linear - 0.5 * np.einsum("ni,pij,nj->np", q, body.K0_outboard[:2], q)


@pytest.fixture(scope="module")
def slender():
    """Return the beam of Wu & Haug (1988), doi:10.1080/08905458808960262."""
    E, A, inertia, rho = 6.8952e10, 7.2968e-5, 8.2189e-9, 2766.67
    return cells_beam(8.0, A, E * inertia, E * A, rho * A)


def test_wu_and_haug(slender):
    """Against geometrically exact beams, checked by refinement (Exudyn): `reference/README.md`."""
    table = np.loadtxt(REFERENCE / "spin_up.csv", delimiter=",", skiprows=1)
    found = tip(slender, 4.0, table[:, 0])
    largest = np.abs(table[:, 3]).max()
    # Third-order terms are left out: measured 0.15 % at a deflection of 7 % of the length.
    assert np.abs(found[:, 1] - table[:, 3]).max() < 2e-3 * largest
    assert found[:, 1].min() == pytest.approx(-0.533611, rel=2e-3)
    assert found[found[:, 1].argmin(), 0] == pytest.approx(-0.020464, rel=2e-3)


def test_simo_and_vu_quoc():
    """Least tip deflection -0.574 m near 6.76 s, steady stretch 5.14e-4 m.

    Simo & Vu-Quoc (1987), doi:10.1016/0045-7825(87)90170-6, six modes of an Euler-Bernoulli beam.
    """
    body = cells_beam(10.0, 1.0, 1.4e4, 2.8e7, 1.2)
    t = np.linspace(0.0, 25.0, 5001)
    found = tip(body, 6.0, t)
    least = found[:, 1].argmin()
    assert found[least, 1] == pytest.approx(-0.574, abs=1e-3)  # the digits that are published
    assert t[least] == pytest.approx(6.76, abs=0.02)
    # The stretch rho A w^2 L^3 / (3 EA), of a beam that oscillates by a few per cent about it.
    steady = found[t > 20.0, 0].mean()
    assert steady == pytest.approx(5.14e-4, rel=2e-3)  # measured 2e-4
