"""Links as Timoshenko beams, independent of the package's finite elements, and the chain of them.

The chain: yaw, pitch, pitch, two aluminium links and 4 kg. Geometrically exact beams give 19.05 mm
of largest deviation as Saint-Venant beams, 18.62 mm with rigid end faces (issue 16).
"""

import numpy as np
from scipy.linalg import eigh

from dolfinopt.multibody.machine import (
    GROUND,
    Joint,
    rigid_spatial_body,
    roll_pitch_yaw,
    skew,
    spatial_mechanism,
)
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals

YOUNG, POISSON, DENSITY = 70e9, 0.33, 2700.0  # Pa, -, kg/m3
HEIGHT, THICKNESS = 0.04, 0.02  # m
# Torsion constant over height thickness^3 of a section of 2 : 1, Saint-Venant.
TORSION = 0.22868
START, END = np.array([0.0, 0.3, -1.9]), np.array([1.6, 1.1, -0.5])  # rad
DURATION = 0.6  # s
ELEMENTS = 40  # of a link


def beam_link(length: float, normal_modes: int = 6) -> ShapeIntegrals:
    """Return a link by linear Timoshenko elements, Craig-Bampton modes, sums over Gauss points."""
    area = HEIGHT * THICKNESS
    shear = YOUNG / (2.0 * (1.0 + POISSON))
    sections = np.array([
        YOUNG * area, 5.0 / 6.0 * shear * area, 5.0 / 6.0 * shear * area,
        shear * TORSION * HEIGHT * THICKNESS**3,
        YOUNG * HEIGHT * THICKNESS**3 / 12.0, YOUNG * THICKNESS * HEIGHT**3 / 12.0,
    ])  # fmt: skip
    h, size = length / ELEMENTS, 6 * (ELEMENTS + 1)
    K, points, masses, fields = np.zeros((size, size)), [], [], []
    gauss = 0.5 / np.sqrt(3.0)
    for e in range(ELEMENTS):
        dofs = slice(6 * e, 6 * e + 12)
        B = np.zeros((6, 12))  # strains at the middle: no locking
        B[:, :6], B[:, 6:] = -np.eye(6) / h, np.eye(6) / h
        B[1, [5, 11]] = -0.5  # v' - theta_z
        B[2, [4, 10]] = 0.5  # w' + theta_y
        K[dofs, dofs] += h * (B.T * sections) @ B
        for s in (0.5 - gauss, 0.5 + gauss):
            for y in (-HEIGHT * gauss, HEIGHT * gauss):
                for z in (-THICKNESS * gauss, THICKNESS * gauss):
                    N = np.zeros((3, size))
                    for node, share in ((e, 1.0 - s), (e + 1, s)):
                        N[:, 6 * node : 6 * node + 3] = share * np.eye(3)
                        N[:, 6 * node + 3 : 6 * node + 6] = -share * skew(np.array([0.0, y, z]))
                    points.append([h * (e + s), y, z])
                    masses.append(DENSITY * area * h / 8.0)
                    fields.append(N)
    X, m, N = np.array(points), np.array(masses), np.array(fields)
    M = np.einsum("n,nai,naj->ij", m, N, N, optimize=True)
    inner, tip = slice(6, size - 6), slice(size - 6, size)
    V = np.zeros((size, 6 + normal_modes))
    V[tip, :6] = np.eye(6)
    V[inner, :6] = -np.linalg.solve(K[inner, inner], K[inner, tip])
    count = size - 12
    modes = eigh(K[inner, inner], M[inner, inner], subset_by_index=[0, normal_modes - 1])[1]
    V[inner, 6:] = modes[:, :normal_modes]
    assert count >= normal_modes
    Phi = np.concatenate([X[:, :, None], N @ V], axis=2)
    q = 6 + normal_modes
    reduced = V.T @ K @ V
    reduced = 0.5 * (reduced + reduced.T)
    return ShapeIntegrals(
        mass=float(m.sum()),
        w=np.einsum("n,nak->ak", m, Phi),
        W=np.einsum("n,nak,nbl->abkl", m, Phi, Phi, optimize=True).reshape(9, 1 + q, 1 + q),
        K=reduced,
        D=1e-4 * reduced,
        outboard=V[tip],
        outboard_point=np.array([length, 0.0, 0.0]),
        K0=np.zeros((0, q, q)),
        K0_outboard=np.zeros((0, q, q)),
    )


def reference_chain(normal_modes: int = 6) -> Mechanism:
    """Return the chain of the module."""
    z = np.array([0.0, 0.0, 1.0])
    column = rigid_spatial_body(0.0, (0.0,) * 3, (0.0,) * 6)
    tilt = roll_pitch_yaw((0.5 * np.pi, 0.0, 0.0))
    joints = (
        Joint("yaw", "revolute", GROUND, 0, z),
        Joint("shoulder", "revolute", 0, 1, z, rotation=tilt),
        Joint("elbow", "revolute", 1, 2, z),
    )
    load = rigid_spatial_body(4.0, (0.0,) * 3, (0.0,) * 6)
    bodies = (column, beam_link(0.5, normal_modes), beam_link(0.45, normal_modes))
    return spatial_mechanism(bodies, joints, {(2, 0): load}, (0.0, 0.0, -9.81), (2, 0))


def quintic_motion(t: np.ndarray) -> RigidMotion:
    """Return the chain's joints by quintics."""
    u = np.clip(t / DURATION, 0.0, 1.0)
    s = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    sd = 30.0 * u**2 * (1.0 - u) ** 2 / DURATION
    sdd = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / DURATION**2
    step = END - START
    return RigidMotion(START + np.outer(s, step), np.outer(sd, step), np.outer(sdd, step))
