"""Bodies made of point masses, whose shape integrals are sums, in the plane and in space."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

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


# -- machines as points ----------------------------------------------------------------------


@dataclass(frozen=True)
class PointMachine:
    """Clouds joined as a tree, by Newton's law for every point; y = (joints, motors, elastic).

    Attributes:
        mechanism: the same of shape integrals.
        clouds, joints: one for every body, in space.
        carried: rigid, by body and interface.
        gravity: (3,), m/s2.
    """

    mechanism: Mechanism
    clouds: tuple[Cloud, ...]
    joints: tuple[Joint, ...]
    carried: Mapping[Site, Cloud]
    gravity: np.ndarray

    def places(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return masses (n,) and places (n, 3) of all points, and the last body's interface."""
        motors = sum(j.coordinate is not None for j in self.joints)
        first = motors + sum(j.rotor is not None and j.rotor.motor is not None for j in self.joints)
        ends, found = {(GROUND, 0): (np.zeros(3), np.eye(3))}, []
        for i, (joint, cloud) in enumerate(zip(self.joints, self.clouds, strict=True)):
            origin, R = ends[joint.parent, joint.interface]
            origin, R = origin + R @ joint.origin, R @ joint.rotation
            if (rotor := joint.rotor) is not None:
                k = joint.coordinate if rotor.motor is None else motors + rotor.motor
                ring, spun = rotor_points(rotor.inertia, joint.axis), rotor.ratio * y[k]
                found.append((ring.masses, origin + ring.points @ (R @ turn(spun * joint.axis)).T))
            if joint.kind == "revolute":
                R = R @ turn(y[joint.coordinate] * joint.axis)
            elif joint.kind == "prismatic":
                origin = origin + y[joint.coordinate] * R @ joint.axis
            e, first = y[first : first + len(cloud.K)], first + len(cloud.K)
            found.append((cloud.masses, origin + (cloud.points + cloud.modes @ e) @ R.T))
            for s, point in enumerate(cloud.ends):
                u = cloud.outboard[6 * s : 6 * s + 6] @ e
                there, E = origin + R @ (point + u[:3]), R @ turn(u[3:])
                ends[i, s] = there, E
                if (load := self.carried.get((i, s))) is not None:
                    found.append((load.masses, there + load.points @ E.T))
        masses, points = zip(*found)
        return np.concatenate(masses), np.concatenate(points), ends[len(self.clouds) - 1, 0][0]

    def forces(self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> np.ndarray:
        """Return the generalised force of every coordinate: sum m J' (p'' - g) + K e + D e'."""

        def speeds(here: np.ndarray, along: np.ndarray) -> np.ndarray:
            return complex_derivative(lambda h: self.places(here + h * along)[1])

        second = derivative(lambda t: speeds(y + t * yd + 0.5 * t * t * ydd, yd + t * ydd), 2e-3)
        J = [speeds(y, unit) for unit in np.eye(len(y))]
        out = np.einsum("n,kni,ni->k", self.places(y)[0], J, second - self.gravity)
        first = len(y) - sum(len(cloud.K) for cloud in self.clouds)
        for cloud in self.clouds:
            part = slice(first, first := first + len(cloud.K))
            out[part] += cloud.K @ y[part] + cloud.D @ yd[part]
        return out


def turn(theta: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) by a rotation vector, real or complex."""
    return expm(skew(theta))


def rigid_cloud(points: ArrayLike, masses: ArrayLike) -> Cloud:
    """Return a rigid body in space whose interface is its origin."""
    X, none = np.array(points, dtype=float), np.zeros((0, 0))
    modes, outboard = np.zeros((len(X), 3, 0)), np.zeros((6, 0))
    return Cloud(X, np.array(masses), modes, none, none, outboard, np.zeros((1, 3)))


def rotor_points(inertia: float, axis: np.ndarray) -> Cloud:
    """Return a moment of inertia about an axis and nothing else: a ring without its mass.

    Negative masses on the axis take away the ring's mass and its inertia across the axis.
    """
    radius, across = 0.7, np.linalg.svd(axis[None])[2][1:]
    mass = inertia / radius**2
    on_axis = radius * np.sqrt(0.5) * axis
    points = [*(radius * across), *(-radius * across), on_axis, -on_axis]
    return rigid_cloud(points, [0.25 * mass] * 4 + [-0.5 * mass] * 2)


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


def random_chain(
    rng: np.random.Generator, arms: int, coordinates: tuple[int, ...] = (2, 3, 1)
) -> PointMachine:
    """Return a chain of random clouds in the plane with payload and gravity in both directions."""
    clouds = [random_cloud(rng, q) for q in coordinates[:arms]]
    hardware = [JointHardware(0.1 * k, 0.05 * k, Rotor(0.2 / k, 0.5 * k)) for k in (1, 2, 3)][:arms]
    mechanism = plane_chain(
        [one.body() for one in clouds], 0.8, 0.3, (1.0, -2.0), -0.4,
        hardware=hardware, cart_mass=0.6,
    )  # fmt: skip
    x, _, z = np.eye(3)
    joints, carried = [Joint("cart", "prismatic", GROUND, 0, x, np.array([0.0, -0.4, 0.0]))], {}
    for k, one in enumerate(hardware):
        joints.append(Joint("joint", "revolute", k, 1 + k, z, rotor=one.rotor))
        last = k == arms - 1
        mass, inertia = one.mass + 0.8 * last, one.inertia + 0.3 * last
        ends = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
        carried[1 + k, 0] = rigid_cloud(ends, [0.5 * inertia, 0.5 * inertia, mass - inertia])
    bodies = rigid_cloud([[0.0, 0.0, 0.0]], [0.6]), *map(in_space, clouds)
    return PointMachine(mechanism, bodies, tuple(joints), carried, np.array([1.0, -2.0, 0.0]))


def in_space(cloud: Cloud) -> Cloud:
    """Return a plane body among those in space."""
    points, ends = (np.pad(x, ((0, 0), (0, 1))) for x in (cloud.points, cloud.ends))
    modes = np.pad(cloud.modes, ((0, 0), (0, 1), (0, 0)))
    outboard = np.insert(cloud.outboard, [2, 2, 2], 0.0, axis=0)
    return replace(cloud, points=points, ends=ends, modes=modes, outboard=outboard)


def random_tree(rng: np.random.Generator, interfaces: int = 1) -> PointMachine:
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
        axis, origin, turned = rng.normal(size=(3, 3))
        place = axis / np.linalg.norm(axis), 0.3 * origin, turn(turned), rotor
        joints.append(Joint("joint", kind, parent, coordinate, *place, *interface))
    loads = {site: random_cloud(rng, 0, 3) for site in sorted({(1, 0), (1, last), (3, 0), (4, 0)})}
    clouds, gravity = (rigid, fork, *outer, rigid), rng.normal(size=3)
    bodies, carried = [c.body() for c in clouds], {at: c.body() for at, c in loads.items()}
    mechanism = spatial_mechanism(bodies, joints, carried, gravity, (4, 0))
    return PointMachine(mechanism, clouds, tuple(joints), loads, gravity)


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
