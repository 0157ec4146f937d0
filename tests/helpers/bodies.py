"""Bodies made of point masses, whose shape integrals are sums, and measures for the dynamics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from dolfinopt.multibody.mechanism import JointHardware, Mechanism
from dolfinopt.multibody.shape_integrals import STIFFENING, TABLE, ShapeIntegrals, plane_body

# By which integrals a function of a body is differentiated.
CONSTANTS = [one.name for one in TABLE if one.name != "outboard_point"]


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
    joints: tuple[JointHardware, ...] = ()
    cart_mass: float = 0.0

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
            joints=self.joints,
            cart_mass=self.cart_mass,
        )

    def interfaces(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places (arms, 2) and angles (arms,) of the outboard interfaces."""
        origin = np.array([y[0], self.joint_height])
        angle = np.zeros((), dtype=y.dtype)
        places, angles = [], []
        for cloud, joint, e in zip(self.clouds, y[1 : self.rigid], self.parts(y), strict=True):
            origin = origin + _rotation(angle + joint) @ (
                cloud.outboard_point + cloud.outboard[:2] @ e
            )
            angle = angle + joint + cloud.outboard[2] @ e
            places.append(origin)
            angles.append(angle)
        return np.array(places), np.array(angles)

    def hardware_product(self, y: np.ndarray, u: np.ndarray, v: np.ndarray) -> float:
        """Return what masses at the interfaces, rotors and the cart add to u' M(y) v."""
        total = self.cart_mass * u[0] * v[0]
        (p, a), (r, b) = (
            tuple(x.imag * 1e30 for x in self.interfaces(y + 1e-30j * z)) for z in (u, v)
        )
        for k, joint in enumerate(self.joints):
            total += joint.mass * p[k] @ r[k] + joint.inertia * a[k] * b[k]
            total += joint.rotor * u[1 + k] * v[1 + k]
        return total

    def hardware_weight(self, y: np.ndarray) -> np.ndarray:
        """Return the first moment of the masses at the interfaces (2,), kg m."""
        places = self.interfaces(y)[0]
        return sum((j.mass * p for j, p in zip(self.joints, places)), np.zeros(2))

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
            + self.hardware_product(y, u, v)
        )

    def kinetic(self, y: np.ndarray, yd: np.ndarray) -> float:
        """Return T, J."""
        return 0.5 * self.momentum_product(y, yd, yd)

    def potential(self, y: np.ndarray) -> float:
        """Return the potential of gravity and elasticity, J."""
        masses = np.concatenate([cloud.masses for cloud in self.clouds])
        points, tip, _ = self.places(y)
        weight = masses @ points + self.payload_mass * tip + self.hardware_weight(y)
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


@dataclass(frozen=True)
class BentChain(Chain):
    """A chain whose bodies deform in the second order, by Lagrange's equations.

    First moment s, inertia J, angular momentum h of the relative motion and the outboard interface
    lose 1/2 q'K0 q by the load that works on them; so does the displacement q along the modes. The
    kinetic energy is built of them: what geometric stiffness is in the theory.

    Attributes:
        K0: of every cloud, (7 + q, q, q): by the seven loads, and L of its modes.
    """

    K0: tuple[np.ndarray, ...] = ()

    def mechanism(self) -> Mechanism:
        """Return the chain of bodies with geometric stiffness."""
        linear = super().mechanism()
        bodies = [
            replace(body, K0=K0[:4], K0_outboard=K0[4:7], along_modes=K0[7:])
            for body, K0 in zip(linear.bodies, self.K0, strict=True)
        ]
        return replace(linear, bodies=tuple(bodies))

    def frames(self, y: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return origins (2,) and angles of all frames, the payload's last."""
        origins, angles = [np.array([y[0], self.joint_height])], []
        angle = np.zeros((), dtype=y.dtype)
        for cloud, K0, joint, e in zip(
            self.clouds, self.K0, y[1 : self.rigid], self.parts(y), strict=True
        ):
            angles.append(angle + joint)
            d = (
                cloud.outboard_point
                + cloud.outboard[:2] @ e
                - 0.5 * np.array([e @ A @ e for A in K0[4:6]])
            )
            origins.append(origins[-1] + _rotation(angles[-1]) @ d)
            angle = angles[-1] + cloud.outboard[2] @ e - 0.5 * e @ K0[6] @ e
        return origins, [*angles, angle]

    def interfaces(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places (arms, 2) and angles (arms,) of the outboard interfaces."""
        origins, angles = self.frames(y)
        inner = [a - joint for a, joint in zip(angles[1:-1], y[2 : self.rigid], strict=True)]
        return np.array(origins[1:]), np.array([*inner, angles[-1]])

    def places(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return no points, the payload's place (2,) and angle."""
        origins, angles = self.frames(y)
        return np.zeros((0, 2)), origins[-1], angles[-1]

    def momentum_product(self, y: np.ndarray, u: np.ndarray, v: np.ndarray) -> float:
        """Return u' M(y) v from the bodies' integrals."""
        moved = [self.frames(y + 1e-30j * x) for x in (u, v)]
        angles = self.frames(y)[1]
        total = 0.0
        for k, (cloud, K0) in enumerate(zip(self.clouds, self.K0, strict=True)):
            body, e = cloud.body(), self.parts(y)[k]
            s = body.moment + body.C @ e - 0.5 * np.array([e @ A @ e for A in K0[:2]])
            along = e @ K0[7:]
            z, turn = e - 0.5 * along @ e, np.eye(len(e)) - along
            J = body.inertia + 2.0 * body.j @ e - e @ K0[3] @ e + z @ body.M @ z
            by_s, by_h = body.C - e @ K0[:2], body.r + turn.T @ body.G @ z - K0[2] @ e
            rates = []
            for (origins, turned), x in zip(moved, (u, v), strict=True):
                velocity = _rotation(angles[k]).T @ origins[k].imag * 1e30
                ed = self.parts(x)[k]
                rates.append((velocity, turned[k].imag * 1e30, by_s @ ed, by_h @ ed, ed))
            (v1, w1, s1, h1, e1), (v2, w2, s2, h2, e2) = rates
            around = np.array([-s[1], s[0]])
            total += body.mass * v1 @ v2 + v1 @ (s2 + w2 * around) + v2 @ (s1 + w1 * around)
            total += J * w1 * w2 + w1 * h2 + w2 * h1
            total += (turn @ e1) @ body.M @ (turn @ e2)
        (tip1, angle1), (tip2, angle2) = (
            (origins[-1].imag * 1e30, turned[-1].imag * 1e30) for origins, turned in moved
        )
        total += self.payload_mass * tip1 @ tip2 + self.payload_inertia * angle1 * angle2
        return total + self.hardware_product(y, u, v)

    def potential(self, y: np.ndarray) -> float:
        """Return the potential of gravity and elasticity, J."""
        origins, angles = self.frames(y)
        weight, elastic = self.payload_mass * origins[-1] + self.hardware_weight(y), 0.0
        for k, (cloud, K0) in enumerate(zip(self.clouds, self.K0, strict=True)):
            body, e = cloud.body(), self.parts(y)[k]
            s = body.moment + body.C @ e - 0.5 * np.array([e @ A @ e for A in K0[:2]])
            weight = weight + body.mass * origins[k] + _rotation(angles[k]) @ s
            elastic = elastic + 0.5 * e @ body.K @ e
        return elastic - weight @ np.array(self.gravity)


def _rotation(angle: np.ndarray) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


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


def unit_changes(body: ShapeIntegrals, name: str) -> Iterator[np.ndarray]:
    """Yield changes that span all an integral can do: int N'N, K, D symmetric, int N'SN skew."""
    shape = np.shape(getattr(body, name))
    for index in np.ndindex(shape):
        change = np.zeros(shape)
        change[index] = 1.0
        if name in ("K", "D", *STIFFENING):
            change = change + change.swapaxes(-1, -2)
        elif name == "W":
            change[0] += change[0].T
            change[1] -= change[1].T
        yield change


def changed(model: Mechanism, arm: int, name: str, change: np.ndarray) -> Mechanism:
    """Return the mechanism with one constant of one arm increased."""
    bodies = list(model.bodies)
    bodies[arm] = replace(bodies[arm], **{name: getattr(bodies[arm], name) + change})
    return replace(model, bodies=tuple(bodies))
