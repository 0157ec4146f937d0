"""Bodies made of point masses, whose shape integrals are sums, and measures for the dynamics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, plane_body


@dataclass(frozen=True)
class Cloud:
    """Point masses that move by linear modes in a body's frame.

    Attributes:
        points: (n, 2) reference positions X, m.
        masses: (n,) kg.
        modes: (n, 2, q) displacement of every point.
        K, D: (q, q) stiffness and damping.
        outboard: (3, q) u_x, u_y, theta of the outboard interface.
        outboard_point: (2,) its reference position, m.
    """

    points: np.ndarray
    masses: np.ndarray
    modes: np.ndarray
    K: np.ndarray
    D: np.ndarray
    outboard: np.ndarray
    outboard_point: np.ndarray

    def body(self) -> ShapeIntegrals:
        """Return the shape integrals as sums over the points."""
        m, X, Phi = self.masses, self.points, self.modes
        SX = np.stack([-X[:, 1], X[:, 0]], axis=1)
        SPhi = np.stack([-Phi[:, 1], Phi[:, 0]], axis=1)
        return plane_body(
            mass=m.sum(),
            moment=m @ X,
            inertia=m @ (X * X).sum(axis=1),
            C=np.einsum("n,nik->ik", m, Phi),
            j=np.einsum("n,ni,nik->k", m, X, Phi),
            r=np.einsum("n,ni,nik->k", m, SX, Phi),
            M=np.einsum("n,nik,nil->kl", m, Phi, Phi),
            G=np.einsum("n,nik,nil->kl", m, Phi, SPhi),
            K=self.K,
            D=self.D,
            outboard=self.outboard,
            outboard_point=self.outboard_point,
        )


def random_cloud(rng: np.random.Generator, coordinates: int) -> Cloud:
    """Return a body without any symmetry, of about 1 kg and 1 m."""
    count = 12
    root, damping = rng.normal(size=(2, coordinates, coordinates))
    return Cloud(
        points=rng.normal(loc=(0.5, 0.1), scale=0.5, size=(count, 2)),
        masses=rng.uniform(0.05, 0.15, size=count),
        modes=rng.normal(scale=0.3, size=(count, 2, coordinates)),
        K=root @ root.T + np.eye(coordinates),
        D=damping @ damping.T,
        outboard=rng.normal(scale=0.3, size=(3, coordinates)),
        outboard_point=np.array([1.0, 0.2]),
    )


def beam(
    length: float = 0.5,  # m
    mass: float = 0.6,  # kg
    bending: float = 15.0,  # N m2
    axial: float = 1.5e3,  # N
    damping: float = 0.0,  # s, of the stiffness
) -> Cloud:
    """Return a slender cantilever: deflected by a tip force, a tip moment and a tip pull.

    With u = x / length: v_1 = u^2 (3 - u) / 2, v_2 = length u^2 / 2, w = u, so that the stiffness
    is int bending v_i'' v_j'' and axial / length in closed form.
    """
    u = (np.arange(24) + 0.5) / 24
    modes = np.zeros((24, 2, 3))
    modes[:, 1, 0] = u**2 * (3.0 - u) / 2.0
    modes[:, 1, 1] = length * u**2 / 2.0
    modes[:, 0, 2] = u
    K = np.zeros((3, 3))
    K[:2, :2] = bending / length**3 * np.array([[3.0, 1.5 * length], [1.5 * length, length**2]])
    K[2, 2] = axial / length
    return Cloud(
        points=np.column_stack([length * u, np.zeros(24)]),
        masses=np.full(24, mass / 24),
        modes=modes,
        K=K,
        D=damping * K,
        outboard=np.array([[0.0, 0.0, 1.0], [1.0, length / 2.0, 0.0], [1.5 / length, 1.0, 0.0]]),
        outboard_point=np.array([length, 0.0]),
    )


@dataclass(frozen=True)
class Chain:
    """Clouds on a cart by Lagrange's equations; y = (x_cart, angles, elastic coordinates).

    Positions are written out with rotation matrices in real numbers, so that a complex step
    differentiates them to rounding.
    """

    clouds: tuple[Cloud, ...]
    payload_mass: float
    payload_inertia: float
    gravity: tuple[float, float]
    joint_height: float

    @property
    def rigid(self) -> int:
        """Number of rigid coordinates."""
        return 1 + len(self.clouds)

    @property
    def size(self) -> int:
        """Number of all coordinates."""
        return self.rigid + sum(cloud.K.shape[0] for cloud in self.clouds)

    def mechanism(self) -> Mechanism:
        """Return the same chain of shape integrals."""
        return Mechanism(
            tuple(cloud.body() for cloud in self.clouds),
            self.payload_mass,
            self.payload_inertia,
            self.gravity,
            self.joint_height,
        )

    def parts(self, y: np.ndarray) -> list[np.ndarray]:
        """Return each arm's elastic coordinates."""
        return np.split(
            y[self.rigid :], np.cumsum([cloud.K.shape[0] for cloud in self.clouds])[:-1]
        )

    def places(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return all points (n, 2), the payload's place (2,) and angle."""
        origin = np.array([y[0], self.joint_height])
        angle = np.zeros((), dtype=y.dtype)
        points = []
        for cloud, joint, e in zip(self.clouds, y[1 : self.rigid], self.parts(y), strict=True):
            angle = angle + joint
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            points.append(origin + (cloud.points + cloud.modes @ e) @ turn.T)
            origin = origin + turn @ (cloud.outboard_point + cloud.outboard[:2] @ e)
            angle = angle + cloud.outboard[2] @ e
        return np.concatenate(points), origin, angle

    def rates(self, y: np.ndarray, yd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the velocities of `places`, by a complex step along yd."""
        points, tip, angle = self.places(y + 1e-30j * yd)
        return points.imag * 1e30, tip.imag * 1e30, angle.imag * 1e30

    def momentum_product(self, y: np.ndarray, u: np.ndarray, v: np.ndarray) -> float:
        """Return u' M(y) v from the points' velocities."""
        masses = np.concatenate([cloud.masses for cloud in self.clouds])
        points_u, tip_u, angle_u = self.rates(y, u)
        points_v, tip_v, angle_v = self.rates(y, v)
        return (
            np.einsum("n,ni,ni->", masses, points_u, points_v)
            + self.payload_mass * tip_u @ tip_v
            + self.payload_inertia * angle_u * angle_v
        )

    def kinetic(self, y: np.ndarray, yd: np.ndarray) -> float:
        """Return T, J."""
        return 0.5 * self.momentum_product(y, yd, yd)

    def potential(self, y: np.ndarray) -> float:
        """Return the potential of gravity and elasticity, J."""
        masses = np.concatenate([cloud.masses for cloud in self.clouds])
        points, tip, _ = self.places(y)
        weight = masses @ points + self.payload_mass * tip
        elastic = sum(0.5 * e @ c.K @ e for c, e in zip(self.clouds, self.parts(y), strict=True))
        return elastic - weight @ np.array(self.gravity)

    def dissipation(self, yd: np.ndarray) -> float:
        """Return the power that damping takes, W."""
        return sum(e @ c.D @ e for c, e in zip(self.clouds, self.parts(yd), strict=True))

    def forces(self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> np.ndarray:
        """Return d/dt dT/dyd - dT/dy + dV/dy + D yd by numerical differentiation."""
        unit = np.eye(self.size)

        def momentum(t: float) -> np.ndarray:
            here, speed = y + t * yd + 0.5 * t * t * ydd, yd + t * ydd
            return np.array([self.momentum_product(here, e, speed) for e in unit])

        def lagrangian(t: float) -> np.ndarray:
            return np.array([self.kinetic(y + t * e, yd) - self.potential(y + t * e) for e in unit])

        damping = np.concatenate(
            [np.zeros(self.rigid)]
            + [c.D @ e for c, e in zip(self.clouds, self.parts(yd), strict=True)]
        )
        return derivative(momentum) - derivative(lagrangian) + damping


def derivative(function: Callable[[float], ArrayLike], step: float = 5e-3) -> np.ndarray:
    """Return the derivative at zero by central differences of sixth order.

    For functions of size and scale one the truncation, step^6 / 140, and the rounding,
    1e-16 / step, both stay below 1e-13.
    """
    total: np.ndarray | float = 0.0
    for k, weight in ((1, 45.0 / 60.0), (2, -9.0 / 60.0), (3, 1.0 / 60.0)):
        there, back = np.asarray(function(k * step)), np.asarray(function(-k * step))
        total = total + weight * (there - back) / step
    return np.asarray(total)


def assert_close(
    found: ArrayLike, expected: ArrayLike, relative: float, size: float | None = None
) -> None:
    """Assert equality to `relative` times `size`, by default the largest expected value.

    Components that happen to be near zero are measured beside the others.
    """
    size = float(np.abs(expected).max()) if size is None else size
    here, there = np.asarray(found), np.asarray(expected)
    np.testing.assert_allclose(here, there, rtol=0.0, atol=relative * size)
