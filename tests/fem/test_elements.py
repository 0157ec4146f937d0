"""Any element that fulfils the interface works in the program's own assembly and reduction."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from mpi4py import MPI

from dolfinopt.fem.elasticity import Substructure
from dolfinopt.fem.elements import Element, LagrangeElement, plane_stress, strains
from dolfinopt.mesh.arm_mesh import structured_arm
from dolfinopt.profiling import Profile
from dolfinopt.reduction import Options, craig_bampton

COMM = MPI.COMM_WORLD
LENGTH, HEIGHT, THICKNESS = 1.0, 0.2, 0.01  # m
YOUNG = 70e9  # Pa
# Two points a direction; they integrate bilinear quadrilaterals without curved sides well enough
# to pass the patch test on any, and exactly on parallelograms.
GAUSS = 0.5 + 0.5 / np.sqrt(3.0) * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
# Sums of some hundred rounded terms; Gmsh places points to 2e-12 of the length.
ROUNDING = 1e-10


@dataclass(frozen=True)
class BendingQuadrilateral(LagrangeElement):
    """A second element: bilinear with four condensed modes that bend it (QM6).

    Source: Taylor, Beresford & Wilson (1976), doi:10.1002/nme.1620100602.
    """

    def operators(self, mesh, thickness, poisson_ratio):
        linear = super().operators(mesh, thickness, poisson_ratio)
        own, sizes = self._own_strains(linear, GAUSS)
        B = np.concatenate([super().strain_operator(mesh, linear, GAUSS), own], axis=3)
        total = np.einsum(
            "ep,epia,ij,epjb->eab", 0.25 * thickness * sizes, B, plane_stress(poisson_ratio), B
        )
        recovery = -np.linalg.solve(total[:, 8:, 8:], total[:, 8:, :8])
        stiffness = total[:, :8, :8] + total[:, :8, 8:] @ recovery
        return replace(linear, stiffness=stiffness, recovery=recovery)

    def strain_operator(self, mesh, operators, points):
        own, _ = self._own_strains(operators, points)
        return super().strain_operator(mesh, operators, points) + own @ operators.recovery[:, None]

    @staticmethod
    def _own_strains(operators, points):
        """Return strains (n, p, 3, 4) of the condensed modes, and dA (n, p) in the unit square."""
        corners = operators.points[operators.cells]

        def jacobian(a, b):
            local = np.array([[b - 1, a - 1], [1 - b, -a], [-b, 1 - a], [b, a]])
            return np.einsum("eni,nk->eik", corners, local)

        centre = jacobian(0.5, 0.5)
        back, size = np.linalg.inv(centre), np.linalg.det(centre)
        sizes = np.stack([np.linalg.det(jacobian(*one)) for one in points], axis=1)
        local = np.stack([np.diag(1.0 - 2.0 * one) for one in points])  # of a (1 - a), b (1 - b)
        gradients = (
            np.einsum("pmk,ekj->epmj", local, back) * (size[:, None] / sizes)[..., None, None]
        )
        return strains(gradients), np.abs(sizes)


def solid_arm(element: Element, cells, poisson_ratio, distort=False):
    mesh = structured_arm(COMM, "arm", LENGTH, HEIGHT, cells)
    if distort:
        points = mesh.mesh.geometry.x
        x, y, _ = points.T
        inside = np.sin(np.pi * x / LENGTH) * np.cos(np.pi * y / HEIGHT)
        points[:, 0] += 0.04 * inside * np.cos(7.0 * x)
        points[:, 1] += 0.02 * inside * np.sin(9.0 * x + y)
    operators = element.operators(mesh, THICKNESS, poisson_ratio)
    ones = np.ones(mesh.num_cells)
    return Substructure(mesh, operators, Profile()).at(YOUNG * ones, 2700.0 * ones)


ELEMENTS = [LagrangeElement(1), LagrangeElement(2), BendingQuadrilateral()]


@pytest.mark.parametrize("element", ELEMENTS, ids=repr)
def test_patch(element):
    """Tension on distorted cells: no force inside, all at the end, the same strain everywhere."""
    nu, stretch = 0.33, 1e-3
    arm = solid_arm(element, (8, 3), nu, distort=True)
    field = (arm.points * [stretch, -nu * stretch])[:, :, None]
    forces, outboard = arm.restrict(arm.stiffness_times(field))
    pull = YOUNG * stretch * HEIGHT * THICKNESS
    assert np.abs(forces).max(initial=0.0) < ROUNDING * pull
    assert outboard[:, 0] == pytest.approx([pull, 0.0, 0.0], abs=ROUNDING * pull)
    B = element.strain_operator(arm.mesh, arm.operators, GAUSS)
    u = field[arm.operators.cells].reshape(arm.mesh.num_cells, -1)
    found = np.einsum("epij,ej->epi", B, u)
    assert np.abs(found - stretch * np.array([1.0, -nu, 0.0])).max(initial=0.0) < 1e-9 * stretch


@pytest.mark.parametrize(("element", "exact"), zip(ELEMENTS, [False, True, True]), ids=repr)
def test_pure_bending_of_the_reduced_arm(element, exact):
    """A moment at the tip: rotation L / (E I), strain -y / (E I), in the reduced model, too."""
    arm = solid_arm(element, (5, 1), 0.0)
    basis = craig_bampton(arm, Options(4))
    q = np.linalg.solve(basis.stiffness, basis.outboard[2])  # by 1 N m
    bending = YOUNG * THICKNESS * HEIGHT**3 / 12.0
    rotation = basis.outboard[2] @ q
    if not exact:  # bilinear cells as long as high resist bending by shear
        assert rotation < 0.75 * LENGTH / bending
        return
    assert rotation == pytest.approx(LENGTH / bending, rel=ROUNDING)
    u = (basis.V @ q)[arm.operators.cells].reshape(arm.mesh.num_cells, -1)
    found = np.einsum("epij,ej->epi", element.strain_operator(arm.mesh, arm.operators, GAUSS), u)
    y = HEIGHT * (GAUSS[:, 1] - 0.5)
    assert np.abs(found[:, :, 0] + y / bending).max(initial=0.0) < 1e-9 * HEIGHT / bending
    # Linear strain: the shear of the bilinear part is recovered away, as is the missing curvature.
    assert np.abs(found[:, :, 1:]).max(initial=0.0) < 1e-9 * HEIGHT / bending


def test_energy_of_the_strain_operator():
    """u' k_e u = int (B u)' C B u t dA on parallelograms, where two points are exact."""
    nu = 0.33
    arm = solid_arm(LagrangeElement(1), (5, 2), nu)
    B = LagrangeElement(1).strain_operator(arm.mesh, arm.operators, GAUSS)
    weight = 0.25 * THICKNESS * arm.mesh.area
    k = np.einsum("e,epia,ij,epjb->eab", weight, B, plane_stress(nu), B)
    assert np.abs(k - arm.operators.stiffness).max(initial=0.0) < 1e-12
