"""Buckling of parts under static loads, against Euler's bar."""

import numpy as np
import pytest
from mpi4py import MPI
from runs import scene

from dolfinopt.arms.arm import build_arms
from dolfinopt.fem.geometric_stiffness import unit_loads
from dolfinopt.parallel import partition_arms
from dolfinopt.part.buckling import (
    buckling_factor,
    free_motions,
    geometric_stiffness,
    worst_instants,
)
from dolfinopt.profiling import Profile

pytestmark = pytest.mark.serial

LENGTH, HEIGHT, THICKNESS = 1.0, 0.03, 0.01
ALONG_X, FORCE = 0, 4  # unit loads: acceleration, and force at the outboard interface
BAR = f"""Point(1) = {{0, {-HEIGHT / 2}, 0}}; Point(2) = {{{LENGTH}, {-HEIGHT / 2}, 0}};
Point(3) = {{{LENGTH}, {HEIGHT / 2}, 0}}; Point(4) = {{0, {HEIGHT / 2}, 0}};
Line(1) = {{1, 2}}; Line(2) = {{2, 3}}; Line(3) = {{3, 4}}; Line(4) = {{4, 1}};
Curve Loop(1) = {{1, 2, 3, 4}}; Plane Surface(1) = {{1}};
Transfinite Curve {{1, 3}} = 41; Transfinite Curve {{2, 4}} = 3; Transfinite Surface {{1}};
Physical Curve("inboard") = {{4}}; Physical Curve("outboard") = {{2}};
"""


@pytest.fixture(scope="module")
def bar(tmp_path_factory):
    """A straight slender bar of quadratic triangles, and EI."""
    path = tmp_path_factory.mktemp("bar") / "bar.geo"
    path.write_text(BAR)
    one = scene(
        f"arms.0.mesh='{path}'", "arms.0.element=quadratic", f"arms.0.thickness={THICKNESS}",
        f"arms.0.height={HEIGHT}", "arms.1.rigid=true", "design.filter_radius=0",
    )  # fmt: skip
    arm = build_arms(one, partition_arms(MPI.COMM_SELF, one.cell_counts), Profile())[0]
    arm.set_design(np.ones(arm.mesh.num_cells))
    young = one.material_of(0).young_modulus
    return arm.current.elastic, young * THICKNESS * HEIGHT**3 / 12.0


def factor_of(arm, load, size):
    u = size * unit_loads(arm).fields[:, :, load]
    return buckling_factor(arm, u, np.zeros_like(u))


def test_bar_buckles_at_eulers_force(bar):
    """Clamped and free; shear lowers it by F / (k G A), 0.06 %."""
    arm, bending = bar
    euler = np.pi**2 * bending / (4.0 * LENGTH**2)
    factor = factor_of(arm, FORCE, -euler / 10.0)
    assert factor == pytest.approx(10.0, rel=0.01)
    assert factor_of(arm, FORCE, -euler / 20.0) == pytest.approx(2.0 * factor, rel=1e-5)


def test_bar_under_its_inertia_buckles_at_the_known_acceleration(bar):
    """q L = 7.837 EI / L^2 of a column under its own weight (Greenhill 1881)."""
    arm, bending = bar
    mass = arm.density[0] * LENGTH * HEIGHT * THICKNESS
    a = 7.8373 * bending / LENGTH**2 / mass / 10.0
    inertia = np.zeros_like(arm.points)
    inertia[:, 0] = -a
    u = -a * unit_loads(arm).fields[:, :, ALONG_X]
    assert buckling_factor(arm, u, inertia) == pytest.approx(10.0, rel=0.01)


def test_tension_alone_does_not_buckle(bar):
    arm, bending = bar
    euler = np.pi**2 * bending / (4.0 * LENGTH**2)
    assert factor_of(arm, FORCE, euler / 10.0) == np.inf


def test_geometric_stiffness_is_that_of_the_reduction(bar):
    """Of any motions, rotations of the outboard interface included, and of every unit load."""
    arm, loads = bar[0], unit_loads(bar[0])
    motions = free_motions(arm)
    x = np.random.default_rng(1).standard_normal((motions.shape[1], 2))
    known = loads.geometric_stiffness((motions @ x).reshape(*arm.points.shape, 2))
    for load, expected in enumerate(known):
        inertia = np.zeros_like(arm.points)
        if load < loads.num_inertial:
            inertia = loads.accelerations[:, :, load]
        K0 = geometric_stiffness(arm, motions, loads.fields[:, :, load], inertia)
        assert x.T @ (K0 @ x) == pytest.approx(expected, rel=1e-6, abs=1e-9 * np.abs(known).max())


def test_worst_instants_are_peaks_of_the_energy():
    t = np.linspace(0.0, 5.0, 501)
    energies = np.sin(np.pi * t) ** 2 * (1.0 + t)
    assert t[worst_instants(energies)] == pytest.approx([4.5, 3.5, 2.5], abs=0.03)
    assert worst_instants(np.array([3.0, 1.0, 2.0])).tolist() == [0, 2]  # ends count
