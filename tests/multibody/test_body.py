"""Inertia shape integrals: rigid figures in closed form, modes by brute-force quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from remainders import substructure

from dolfinopt.multibody.shape_integrals import shape_integrals
from dolfinopt.reduction import Options, craig_bampton, modal

COMM = MPI.COMM_WORLD
LENGTH, HEIGHT, THICKNESS = 1.2, 0.3, 0.01  # m
YOUNG, DENSITY = 70e9, 2700.0  # Pa, kg/m3
DAMPING = 2e-4  # s
REDUCTORS = {"craig-bampton": craig_bampton, "modal": modal}
# Sums over some dozens of cells; measured: 1e-15.
ROUNDING = 1e-12


def uneven(place):
    """Densities in [0, 1] without structure, the same on any number of ranks."""
    place = np.round(place, 9)
    return 0.5 + 0.49 * np.sin(300.0 * place[:, 0] + 1700.0 * place[:, 1])


@pytest.fixture(scope="module")
def uneven_arm():
    arm = substructure((LENGTH, HEIGHT, THICKNESS), (10, 3), COMM)
    x = uneven(arm.mesh.centroid)
    return arm.at(YOUNG * x**3, DENSITY * x)


def quadrature(arm, x, V):
    """Return the integrals by 3 x 3 Gauss points a cell of the bilinear fields, one by one."""
    points = 0.5 + 0.5 * np.sqrt(0.6) * np.array([-1.0, 0.0, 1.0])
    weights = np.array([5.0, 8.0, 5.0]) / 18.0
    S = np.array([[0.0, -1.0], [1.0, 0.0]])
    q = V.shape[2]
    m, c, J = 0.0, np.zeros(2), 0.0
    C, j, r = np.zeros((2, q)), np.zeros(q), np.zeros(q)
    M, G = np.zeros((q, q)), np.zeros((q, q))
    for nodes, density in zip(arm.operators.cells, DENSITY * x):
        corners, modes = arm.points[nodes], V[nodes]
        area = abs(np.linalg.det([corners[1] - corners[0], corners[2] - corners[0]]))
        for a, wa in zip(points, weights):
            for b, wb in zip(points, weights):
                shape = np.array([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
                dm = wa * wb * area * THICKNESS * density
                X, Phi = shape @ corners, np.tensordot(shape, modes, 1)
                m, c, J = m + dm, c + dm * X, J + dm * X @ X
                C += dm * Phi
                j += dm * X @ Phi
                r += dm * (S @ X) @ Phi
                M += dm * Phi.T @ Phi
                G += dm * Phi.T @ (S @ Phi)
    parts = (m, c, J, C, j, r, M, G)
    return [arm.comm.allreduce(part) for part in parts]


@pytest.mark.parametrize("method", sorted(REDUCTORS))
def test_integrals_of_modes_by_quadrature(uneven_arm, method):
    arm = uneven_arm
    basis = REDUCTORS[method](arm, Options(6))
    body = shape_integrals(arm, basis, DAMPING)
    names = ("mass", "moment", "inertia", "C", "j", "r", "M", "G")
    for name, expected in zip(names, quadrature(arm, uneven(arm.mesh.centroid), basis.V)):
        scale = np.abs(expected).max()
        assert np.abs(getattr(body, name) - expected).max() < ROUNDING * scale, name
    assert np.array_equal(body.G, -body.G.T)
    assert np.array_equal(body.M, body.M.T)
    assert np.linalg.eigvalsh(body.M)[0] > 0.0
    assert np.array_equal(body.K, basis.stiffness)
    assert np.array_equal(body.D, DAMPING * basis.stiffness)
    assert np.array_equal(body.outboard, basis.outboard)


def test_modes_give_the_first_frequency_of_the_body(uneven_arm):
    body = shape_integrals(uneven_arm, modal(uneven_arm, Options(2)), DAMPING)
    values = np.sqrt(np.diag(body.K)) / (2.0 * np.pi)
    # Modes are orthonormal in M to 1e-12.
    assert body.first_frequency == pytest.approx(values[0], rel=1e-11)
    # Every other basis gives an upper bound.
    for q in (3, 4, 8):
        body = shape_integrals(uneven_arm, craig_bampton(uneven_arm, Options(q)), DAMPING)
        assert body.first_frequency > values[0] * (1.0 - 1e-11)
    assert body.first_frequency == pytest.approx(values[0], rel=1e-5)  # measured: 3e-7
