"""Bodies made of point masses, whose shape integrals are sums, in the plane and in space."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dolfinopt.multibody.body import Constants
from dolfinopt.multibody.rotations import skew
from dolfinopt.multibody.shape_integrals import STIFFENING, TABLE, ShapeIntegrals, rigid_body
from dolfinopt.multibody.tree import (
    GROUND,
    Joint,
    Mechanism,
    Rotor,
    Site,
)


def plane_body(
    mass: float,
    moment: np.ndarray,
    inertia: float,
    C: np.ndarray,
    j: np.ndarray,
    r: np.ndarray,
    M: np.ndarray,
    G: np.ndarray,
    K: np.ndarray,
    D: np.ndarray,
    outboard: np.ndarray,
    outboard_point: np.ndarray,
    K0: np.ndarray | None = None,
) -> ShapeIntegrals:
    """Return a plane body from its integrals by name, see `ShapeIntegrals`.

    K0 is (7, q, q), by accelerations and by the outboard interface's loads; None if linear.
    """
    none = np.zeros((0, *K.shape))
    W = np.array(
        [np.block([[inertia, j], [j[:, None], M]]), np.block([[0.0, 0.0 - r], [r[:, None], G]])]
    )
    w, K0 = np.column_stack([moment, C]), none if K0 is None else K0
    further = np.zeros((0, 2))  # as a mesh in the plane has: equal bodies are equal in every bit
    return ShapeIntegrals(
        float(mass), w, W, K, D, outboard, outboard_point, K0[:4], K0[4:], further, none
    )


# By which integrals a function of a body is differentiated.
CONSTANTS = [one.name for one in TABLE if not one.name.endswith(("_point", "_points"))]
STEP = 1e-30  # of a complex step


@dataclass(frozen=True)
class JointHardware:
    """What sits at one arm's ends besides the arm itself.

    Attributes:
        mass, inertia: at the outboard interface, kg, kg m2.
        rotor: that drives the inboard joint, or None.
    """

    mass: float = 0.0
    inertia: float = 0.0
    rotor: Rotor | None = None


def plane_chain(
    bodies: Sequence[ShapeIntegrals],
    payload_mass: float,
    payload_inertia: float,
    gravity: Sequence[float],
    joint_height: float,
    *,
    hardware: Sequence[JointHardware] = (),
    cart_mass: float = 0.0,
) -> Mechanism:
    """Return a cart on a horizontal rail that carries a chain of arms and a payload.

    Args:
        bodies: from the cart outwards.
        payload_mass: point mass at the last outboard interface, kg.
        payload_inertia: its rotary inertia, kg m2.
        gravity: (g_x, g_y), m/s2.
        joint_height: y of the first joint, m.
        hardware: what sits at every arm's ends, or none.
        cart_mass: kg.
    """
    none = np.zeros(2)
    hardware, last = hardware or (JointHardware(),) * len(bodies), len(bodies) - 1
    joints = [
        Joint(f"joint {k}", "revolute", k - 1, 1 + k, np.ones(1), np.zeros(2), np.eye(2), one.rotor)
        for k, one in enumerate(hardware)
    ]
    loads = {(k, 0): np.array([one.mass, one.inertia]) for k, one in enumerate(hardware)}
    if bodies:
        loads[last, 0] += payload_mass, payload_inertia
    return Mechanism(
        bodies=tuple(bodies),
        joints=tuple(joints),
        loads={
            at: Constants(rigid_body(x[0], none, x[1], none))
            for at, x in loads.items()
            if x.any() or at[0] == last
        },
        gravity=np.array(gravity, dtype=float)[:, None],
        end=(last, 0),
        origin=np.array([0.0, joint_height]),
        cart=cart_mass,
    )


@dataclass(frozen=True)
class Cloud:
    """Point masses that move by linear modes in a body's frame, in d = 2 or 3 dimensions.

    Attributes:
        points: (n, d) reference positions X, m.
        masses: (n,) kg.
        modes: (n, d, q) displacement of every point.
        K, D: (q, q) stiffness and damping.
        outboard: (3, q) u_x, u_y, theta of the outboard interface; (6 i, q) of all, in space.
        ends: (i, d) their reference positions, m.
    """

    points: np.ndarray
    masses: np.ndarray
    modes: np.ndarray
    K: np.ndarray
    D: np.ndarray
    outboard: np.ndarray
    ends: np.ndarray

    def body(self) -> ShapeIntegrals:
        """Return the shape integrals as sums over the points."""
        m, X, Phi, q = self.masses, self.points, self.modes, len(self.K)
        if X.shape[1] == 3:
            N = np.concatenate([X[:, :, None], Phi], axis=2)
            W = np.einsum("n,nak,nbl->abkl", m, N, N).reshape(9, 1 + q, 1 + q)
            ends, none = (self.outboard, self.ends[0]), np.zeros((0, q, q))
            w = np.einsum("n,nak->ak", m, N)
            return ShapeIntegrals(m.sum(), w, W, self.K, self.D, *ends, none, none, self.ends[1:])
        SX, SPhi = (np.stack([-x[:, 1], x[:, 0]], axis=1) for x in (X, Phi))
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
            outboard_point=self.ends[0],
        )


def random_cloud(rng: np.random.Generator, q: int, d: int = 2, interfaces: int = 1) -> Cloud:
    """Return a body without any symmetry, of about 1 kg and 1 m."""
    root, damping = rng.normal(size=(2, q, q))
    return Cloud(
        points=rng.normal(loc=(0.5, 0.1, 0.0)[:d], scale=0.4, size=(10, d)),
        masses=rng.uniform(0.05, 0.15, size=10),
        modes=rng.normal(scale=0.3, size=(10, d, q)),
        K=root @ root.T + np.eye(q),
        D=damping @ damping.T,
        outboard=rng.normal(scale=0.3, size=(3 if d == 2 else 6 * interfaces, q)),
        ends=np.array([[1.0, 0.2, -0.1], [0.4, 0.3, 0.2]])[:interfaces, :d],
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
    points, ends = np.column_stack([length * u, np.zeros(24)]), np.array([[length, 0.0]])
    outboard = np.array([[0.0, 0.0, 1.0], [1.0, length / 2.0, 0.0], [1.5 / length, 1.0, 0.0]])
    return Cloud(points, np.full(24, mass / 24), modes, K, damping * K, outboard, ends)


# -- chains in the plane ---------------------------------------------------------------------


@dataclass(frozen=True)
class Chain:
    """Clouds on a cart by Lagrange's equations; y = (x_cart, angles, elastic coordinates).

    Positions are those of real rotation matrices, so that a complex step differentiates them to
    rounding. With K0 (7 + q, q, q), by the seven loads and L of the modes, bodies deform in the
    second order: first moment s, inertia J, angular momentum h of the relative motion, outboard
    interface and the displacement q along the modes lose 1/2 q'K0 q by the load that works on them.
    """

    clouds: tuple[Cloud, ...]
    payload_mass: float
    payload_inertia: float
    gravity: tuple[float, float]
    joint_height: float
    joints: tuple[JointHardware, ...] = ()
    cart_mass: float = 0.0
    K0: tuple[np.ndarray, ...] = ()

    @property
    def rigid(self) -> int:
        """Number of rigid coordinates."""
        return 1 + len(self.clouds)

    @property
    def size(self) -> int:
        """Number of all coordinates."""
        return self.rigid + sum(len(cloud.K) for cloud in self.clouds)

    @cached_property
    def bodies(self) -> tuple[ShapeIntegrals, ...]:
        """The same as shape integrals, with geometric stiffness if there is any."""
        bodies = tuple(cloud.body() for cloud in self.clouds)
        return tuple(
            replace(body, K0=K0[:4], K0_outboard=K0[4:7], along_modes=K0[7:])
            for body, K0 in zip(bodies, self.K0)
        ) or bodies  # fmt: skip

    def mechanism(self) -> Mechanism:
        """Return the same chain of shape integrals."""
        load = self.payload_mass, self.payload_inertia
        own = self.gravity, self.joint_height
        return plane_chain(self.bodies, *load, *own, hardware=self.joints, cart_mass=self.cart_mass)

    def parts(self, y: np.ndarray) -> list[np.ndarray]:
        """Return each arm's elastic coordinates."""
        return np.split(y[self.rigid :], np.cumsum([len(cloud.K) for cloud in self.clouds])[:-1])

    def frames(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the arms' origins and outboard places (1 + arms, 2), angles before and behind."""
        origins, behind = [np.array([y[0], self.joint_height])], []
        angles, angle = [], np.zeros((), dtype=y.dtype)
        for k, (cloud, e) in enumerate(zip(self.clouds, self.parts(y), strict=True)):
            bent = np.array([e @ A @ e for A in self.K0[k][4:7]]) if self.K0 else np.zeros(3)
            u = cloud.outboard @ e - 0.5 * bent
            angles.append(angle + y[1 + k])
            origins.append(origins[-1] + rotation(angles[-1]) @ (cloud.ends[0] + u[:2]))
            angle = angles[-1] + u[2]
            behind.append(angle)
        return np.array(origins), np.array(angles), np.array(behind)

    def points(self, y: np.ndarray) -> np.ndarray:
        """Return the places (n, 2) of all point masses."""
        origins, angles, _ = self.frames(y)
        parts = zip(self.clouds, self.parts(y), origins, angles)
        return np.concatenate(
            [o + (c.points + c.modes @ e) @ rotation(a).T for c, e, o, a in parts]
        )

    @property
    def carried(self) -> np.ndarray:
        """Masses and inertias (2, arms) at the outboard interfaces, kg and kg m2."""
        found = np.zeros((2, len(self.clouds)))
        for k, joint in enumerate(self.joints):
            found[:, k] = joint.mass, joint.inertia
        found[:, -1] += self.payload_mass, self.payload_inertia
        return found

    def momentum_product(self, y: np.ndarray, u: np.ndarray, v: np.ndarray) -> float:
        """Return u' M(y) v from the velocities of points and interfaces, or by the integrals."""

        def along(function: Callable[[np.ndarray], Any], x: np.ndarray) -> Any:
            found = function(y + 1j * STEP * x)
            return [np.imag(z) / STEP for z in found] if isinstance(found, tuple) else (
                np.imag(found) / STEP
            )  # fmt: skip

        (p, a, b), (r, c, d) = (along(self.frames, x) for x in (u, v))
        masses, inertias = self.carried
        total = self.cart_mass * u[0] * v[0]
        total += masses @ (p[1:] * r[1:]).sum(axis=1) + inertias @ (b * d)
        for k, joint in enumerate(self.joints):
            assert joint.rotor is not None
            spins = [
                (behind[k - 1] if k else 0.0) + joint.rotor.ratio * x[1 + k]
                for behind, x in ((b, u), (d, v))
            ]
            total += joint.rotor.inertia * spins[0] * spins[1]
        if not self.K0:
            m = np.concatenate([cloud.masses for cloud in self.clouds])
            return total + np.einsum("n,ni,ni->", m, along(self.points, u), along(self.points, v))
        angles = self.frames(y)[1]
        for k, (body, K0) in enumerate(zip(self.bodies, self.K0)):
            e, R = self.parts(y)[k], rotation(angles[k])
            s = body.w[:, 0] + body.w[:, 1:] @ e - 0.5 * np.array([e @ A @ e for A in K0[:2]])
            L = e @ K0[7:]
            z, turn = e - 0.5 * L @ e, np.eye(len(e)) - L
            J = body.W[0, 0, 0] + 2.0 * body.W[0, 0, 1:] @ e - e @ K0[3] @ e + z @ body.M @ z
            by_s, by_h = (
                body.w[:, 1:] - e @ K0[:2],
                body.W[1, 1:, 0] + turn.T @ body.W[1, 1:, 1:] @ z - K0[2] @ e,
            )
            around = np.array([-s[1], s[0]])
            (v1, w1, s1, h1, e1), (v2, w2, s2, h2, e2) = (
                (R.T @ place[k], turned[k], by_s @ ed, by_h @ ed, turn @ ed)
                for place, turned, ed in ((p, a, self.parts(u)[k]), (r, c, self.parts(v)[k]))
            )
            total += body.mass * v1 @ v2 + v1 @ (s2 + w2 * around) + v2 @ (s1 + w1 * around)
            total += J * w1 * w2 + w1 * h2 + w2 * h1 + e1 @ body.M @ e2
        return total

    def kinetic(self, y: np.ndarray, yd: np.ndarray) -> float:
        """Return T, J."""
        return 0.5 * self.momentum_product(y, yd, yd)

    def potential(self, y: np.ndarray) -> float:
        """Return the potential of gravity and elasticity, J."""
        origins, angles, _ = self.frames(y)
        weight, elastic = self.carried[0] @ origins[1:], 0.0
        for k, (body, e) in enumerate(zip(self.bodies, self.parts(y))):
            s = body.w[:, 0] + body.w[:, 1:] @ e
            if self.K0:
                s = s - 0.5 * np.array([e @ A @ e for A in self.K0[k][:2]])
            weight = weight + body.mass * origins[k] + rotation(angles[k]) @ s
            elastic += 0.5 * e @ body.K @ e
        return elastic - weight @ np.array(self.gravity)

    def forces(self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> np.ndarray:
        """Return d/dt dT/dyd - dT/dy + dV/dy + D yd by numerical differentiation."""
        unit = np.eye(self.size)

        def momentum(t: float) -> np.ndarray:
            here, speed = y + t * yd + 0.5 * t * t * ydd, yd + t * ydd
            return np.array([self.momentum_product(here, e, speed) for e in unit])

        def lagrangian(t: float) -> np.ndarray:
            return np.array([self.kinetic(y + t * e, yd) - self.potential(y + t * e) for e in unit])

        damping = [c.D @ e for c, e in zip(self.clouds, self.parts(yd), strict=True)]
        lost = np.concatenate([np.zeros(self.rigid), *damping])
        return derivative(momentum) - derivative(lagrangian) + lost


COORDINATES = (2, 3, 1)  # of the arms from the cart outwards


# Motors, gearboxes and bearings at the outboard interfaces, and rotors of the joints.
def spatial_mechanism(
    bodies: Sequence[ShapeIntegrals],
    joints: Sequence[Joint],
    carried: Mapping[Site, ShapeIntegrals],
    gravity: Sequence[float] | np.ndarray,
    end: Site,
) -> Mechanism:
    """Return bodies on joints; what they carry are rigid bodies in the interfaces' frames."""
    loads = {site: Constants(one) for site, one in carried.items()}
    down = np.array(gravity, dtype=float)[:, None]
    return Mechanism(tuple(bodies), tuple(joints), loads, down, end, np.zeros(3))


HARDWARE = tuple(JointHardware(0.1 * k, 0.05 * k, Rotor(0.2 / k, 0.5 * k)) for k in (1, 2, 3))


def random_chain(
    rng: np.random.Generator,
    arms: int,
    bent: bool = False,
    coordinates: tuple[int, ...] = COORDINATES,
) -> Chain:
    """Return a chain of random clouds with payload and gravity in both directions."""
    clouds = tuple(random_cloud(rng, q) for q in coordinates[:arms])
    K0 = [0.05 * rng.normal(size=(7 + q, q, q)) for q in coordinates[:arms] * bent]
    stiffness = tuple(A + A.swapaxes(1, 2) for A in K0)
    return Chain(clouds, 0.8, 0.3, (1.0, -2.0), -0.4, HARDWARE[:arms], 0.6, stiffness)


def rotation(angle: np.ndarray) -> np.ndarray:
    """Return the matrix that turns by an angle."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


# -- trees in space --------------------------------------------------------------------------


@dataclass(frozen=True)
class CloudTree:
    """Clouds joined as a tree, by Newton's law for every point; y = (joints, motors, elastic).

    Rotors are rings of points that turn about the joint's axis on what the joint sits on. The
    mechanism carries their masses along the axis, which has all but the moment of inertia about it.
    """

    clouds: tuple[Cloud, ...]
    joints: tuple[Joint, ...]
    carried: dict[tuple[int, int], Cloud]  # by arm and interface; rigid
    gravity: np.ndarray
    end: int

    def mechanism(self) -> Mechanism:
        """Return the same tree of shape integrals."""
        every = dict(self.carried)
        for site, axial in self._axial:
            other = every.get(site)
            every[site] = axial if other is None else _together(axial, other)
        carried = {site: one.body() for site, one in every.items()}
        bodies = [cloud.body() for cloud in self.clouds]
        return spatial_mechanism(bodies, self.joints, carried, self.gravity, (self.end, 0))

    @property
    def _motors(self) -> int:
        """Number of motors with coordinates of their own."""
        return sum(j.rotor is not None and j.rotor.motor is not None for j in self.joints)

    @property
    def rigid(self) -> int:
        """Number of coordinates of joints and motors."""
        return sum(joint.coordinate is not None for joint in self.joints) + self._motors

    @property
    def _axial(self) -> list[tuple[tuple[int, int], Cloud]]:
        """Masses along the rotors' axes on what carries them."""
        found = []
        for joint in self.joints:
            if joint.rotor is not None and joint.parent != GROUND:
                masses = _ring(joint.rotor.inertia)[1]
                size = np.sqrt(0.5 * joint.rotor.inertia / masses.sum())
                along = size * np.outer([1.0, -1.0, 1.0, -1.0], joint.rotation @ joint.axis)
                found.append(
                    ((joint.parent, joint.interface), _rigid(joint.origin + along, masses))
                )
        return found

    def forces(self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> np.ndarray:
        """Return the generalised force of every coordinate: sum m J' (p'' - g) + K e + D e'."""
        masses, _, second = self._points(y, yd, ydd)
        none = np.zeros_like(y)
        steps = 1j * STEP * np.eye(len(y))
        J = [self._points(y + step, none, none)[1].imag / STEP for step in steps]
        out = np.einsum("n,kni,ni->k", masses, J, second - self.gravity)
        first = self.rigid
        for cloud in self.clouds:
            part = slice(first, first + len(cloud.K))
            out[part] += cloud.K @ y[part] + cloud.D @ yd[part]
            first = part.stop
        return out

    def _points(
        self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return masses (n,), places and accelerations (n, 3) of all points.

        Every frame is the product of exponentials of 4 x 4 matrices along y + yd t + ydd t^2 / 2,
        taken as polynomials of t by blocks: exp of a block Toeplitz matrix holds its series.
        """
        series = (y, yd, 0.5 * ydd)
        ends: dict[tuple[int, int], np.ndarray] = {(GROUND, 0): _polynomial(np.eye(4))}
        first, joints = self.rigid, self.rigid - self._motors
        masses, places, second = [], [], []
        for i, (joint, cloud) in enumerate(zip(self.joints, self.clouds, strict=True)):
            part = slice(first, first + len(cloud.K))
            first = part.stop
            frame = ends[joint.parent, joint.interface]
            frame = frame @ _polynomial(_place(joint.rotation, joint.origin))
            bodies = []
            if (rotor := joint.rotor) is not None and joint.parent != GROUND:
                k = joint.coordinate if rotor.motor is None else joints + rotor.motor
                turns = _place(skew(joint.axis), np.zeros(3))
                turns[3, 3] = 0.0
                spun = frame @ expm(_polynomial(*(rotor.ratio * turns * c[k] for c in series)))
                ring, mass = _ring(rotor.inertia)
                across = np.linalg.svd(joint.axis[None])[2][1:]  # normal to the axis
                bodies.append((spun, mass, [ring @ across, *(0.0 * ring @ across,) * 2]))
            if (k := joint.coordinate) is not None:
                generator = _place(0.0 * np.eye(3), joint.axis)
                if joint.kind == "revolute":
                    generator = _place(skew(joint.axis), np.zeros(3))
                generator[3, 3] = 0.0
                frame = frame @ expm(_polynomial(*(generator * c[k] for c in series)))
            moved = [c[part] for c in series]
            for s, point in enumerate(cloud.ends):
                B = cloud.outboard[6 * s : 6 * s + 6]
                u, theta = [B[:3] @ e for e in moved], [skew(B[3:] @ e) for e in moved]
                u[0] = u[0] + point
                rates = (_place(0.0 * np.eye(3), x) for x in u[1:])
                shift = _polynomial(_place(np.eye(3), u[0]), *rates)
                turn = [np.pad(x, (0, 1)) for x in theta]
                ends[i, s] = frame @ shift @ expm(_polynomial(*turn))
            X = [cloud.points + cloud.modes @ moved[0], *(cloud.modes @ e for e in moved[1:])]
            bodies.append((frame, cloud.masses, X))
            for (k, s), load in self.carried.items():
                if k == i:
                    still = [load.points, *(0.0 * load.points,) * 2]
                    bodies.append((ends[i, s], load.masses, still))
            for place, mass, points in bodies:
                c0, c1, c2 = (place[:4, 4 * j : 4 * j + 4] for j in range(3))
                R0, R1, R2 = (c[:3, :3] for c in (c0, c1, c2))
                masses.append(mass)
                places.append(points[0] @ R0.T + c0[:3, 3])
                acceleration = points[0] @ R2.T + points[1] @ R1.T + points[2] @ R0.T + c2[:3, 3]
                second.append(2.0 * acceleration)
        return np.concatenate(masses), np.concatenate(places), np.concatenate(second)


def _ring(inertia: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points (4, 2) about an axis and their masses, of a moment of inertia, kg m2."""
    points = 0.7 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    return points, np.full(4, inertia / (4 * 0.7**2))


def _rigid(points: np.ndarray, masses: np.ndarray) -> Cloud:
    """Return a rigid body in space without further interfaces."""
    none = np.zeros((0, 0))
    modes, outboard = np.zeros((len(points), 3, 0)), np.zeros((6, 0))
    return Cloud(points, masses, modes, none, none, outboard, np.zeros((1, 3)))


def _together(one: Cloud, other: Cloud) -> Cloud:
    """Return two rigid bodies in one frame as one."""
    points = np.concatenate([one.points, other.points])
    return _rigid(points, np.concatenate([one.masses, other.masses]))


def _place(R: np.ndarray, origin: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4), dtype=np.result_type(R, origin))
    out[:3, :3], out[:3, 3] = R, origin
    if R.any():
        out[3, 3] = 1.0
    return out


def _polynomial(*coefficients: np.ndarray) -> np.ndarray:
    """Return c_0 + c_1 t + c_2 t^2 as a block Toeplitz matrix (12, 12)."""
    out = np.zeros((12, 12), dtype=np.result_type(*coefficients))
    for k, c in enumerate(coefficients):
        for i in range(3 - k):
            out[4 * i : 4 * i + 4, 4 * (i + k) : 4 * (i + k) + 4] = c
    return out


def random_tree(rng: np.random.Generator, interfaces: int = 1) -> CloudTree:
    """Return two branches with every kind of joint, rigid and flexible bodies, and loads."""
    last = interfaces - 1
    rigid, fork = (random_cloud(rng, q, 3, interfaces) for q in (0, 3))
    outer = random_cloud(rng, 2, 3), random_cloud(rng, 3, 3, interfaces)
    kinds = (
        ("revolute", GROUND, 0, None), ("revolute", 0, 3, Rotor(0.3, 1.5), last),
        ("prismatic", 1, 1, Rotor(0.2, 2.0)), ("fixed", 1, None, None, last),
        ("revolute", 3, 2, Rotor(0.4, 0.8, motor=0), last),
    )  # fmt: skip
    joints = []
    for kind, parent, coordinate, rotor, *interface in kinds:
        axis, origin, turn = rng.normal(size=(3, 3))
        place = (
            axis / np.linalg.norm(axis),
            0.3 * origin,
            Rotation.from_rotvec(turn).as_matrix(),
            rotor,
        )
        joints.append(Joint("joint", kind, parent, coordinate, *place, *interface))
    loads = {site: random_cloud(rng, 0, 3) for site in sorted({(1, 0), (1, last), (3, 0), (4, 0)})}
    clouds = rigid, fork, *outer, rigid
    return CloudTree(clouds, tuple(joints), loads, rng.normal(size=3), 4)


# -- changes and derivatives -----------------------------------------------------------------


def stiffened(rng: np.random.Generator, body: ShapeIntegrals) -> ShapeIntegrals:
    """Return a body with some geometric stiffness by all 7 or 18 loads and more."""
    q, b, frame = body.num_modes, len(body.outboard), len(body.w) + len(body.W)
    K0 = rng.normal(scale=0.2, size=(frame + b + q, q, q))
    K0 = K0 + K0.swapaxes(1, 2)
    # The modes of light clouds move little mass.
    parts = {"K0": K0[:frame], "K0_outboard": K0[frame : frame + b]}
    return replace(body, **parts, along_modes=0.1 * K0[frame + b :])


def change_of(rng: np.random.Generator, body: ShapeIntegrals, name: str) -> np.ndarray:
    """Return a change of an integral that keeps its symmetries."""
    change = np.asarray(rng.normal(size=np.shape(getattr(body, name))))
    if name in ("K", "D", *STIFFENING):
        return change + change.swapaxes(-1, -2)
    if name != "W":
        return change
    if len(change) == 2:  # int N'N and int N'SN
        return change + np.array([1.0, -1.0])[:, None, None] * change.swapaxes(1, 2)
    blocks = change.reshape(3, 3, *change.shape[1:])  # W_ba = W_ab'
    return (blocks + blocks.transpose(1, 0, 3, 2)).reshape(change.shape)


def changed(model: Any, arm: int, name: str, change: np.ndarray) -> Any:
    """Return the mechanism with one constant of one body increased."""
    bodies = list(model.bodies)
    bodies[arm] = replace(bodies[arm], **{name: getattr(bodies[arm], name) + change})
    return replace(model, bodies=tuple(bodies))


def derivative(function: Callable[[float], ArrayLike], step: float = 5e-3) -> np.ndarray:
    """Return the derivative at zero, of size and scale one to 1e-13, by sixth-order differences."""
    total: np.ndarray | float = 0.0
    for k, weight in ((1, 45.0 / 60.0), (2, -9.0 / 60.0), (3, 1.0 / 60.0)):
        there, back = np.asarray(function(k * step)), np.asarray(function(-k * step))
        total = total + weight * (there - back) / step
    return np.asarray(total)


def complex_derivative(function: Callable[[complex], np.ndarray]) -> np.ndarray:
    """Return the derivative at 0 by a complex step, to rounding."""
    return np.imag(function(1j * STEP)) / STEP


def assert_close(
    found: ArrayLike, expected: ArrayLike, relative: float, size: float | None = None
) -> None:
    """Assert equality to `relative` times `size`, by default the largest expected value."""
    size = float(np.abs(expected).max()) if size is None else size
    here, there = np.asarray(found), np.asarray(expected)
    np.testing.assert_allclose(here, there, rtol=0.0, atol=relative * size)
