"""Trees of bodies made of point masses in space, and plane bodies posed as spatial ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import TABLE, ShapeIntegrals, in_space
from dolfinopt.multibody.spatial.mechanism import (
    GROUND,
    Joint,
    SpatialMechanism,
    exponential,
    rigid_spatial_body,
    skew,
)

STEP = 1e-30  # of a complex step


@dataclass(frozen=True)
class SpatialCloud:
    """Point masses that move by linear modes in a body's frame.

    Attributes:
        points: (n, 3) reference positions X, m.
        masses: (n,) kg.
        modes: (n, 3, q) displacement of every point.
        K, D: (q, q).
        outboard: (6 i, q) displacement and rotation vector of every outboard interface.
        ends: (i, 3) their reference points, m.
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
        N = np.concatenate([self.points[:, :, None], self.modes], axis=2)
        q = len(self.K)
        W = np.einsum("n,nak,nbl->abkl", self.masses, N, N).reshape(9, 1 + q, 1 + q)
        w = np.einsum("n,nak->ak", self.masses, N)
        none = np.zeros((0, q, q))
        ends = self.outboard, self.ends[0]
        return ShapeIntegrals(
            self.masses.sum(), w, W, self.K, self.D, *ends, none, none, self.ends[1:]
        )


def spatial_cloud(rng: np.random.Generator, q: int, interfaces: int = 1) -> SpatialCloud:
    """Return a body without any symmetry, of about 1 kg and 1 m."""
    root, damping = rng.normal(size=(2, q, q))
    return SpatialCloud(
        points=rng.normal(loc=(0.5, 0.1, 0.0), scale=0.4, size=(9, 3)),
        masses=rng.uniform(0.05, 0.15, size=9),
        modes=rng.normal(scale=0.3, size=(9, 3, q)),
        K=root @ root.T + np.eye(q),
        D=damping @ damping.T,
        outboard=rng.normal(scale=0.3, size=(6 * interfaces, q)),
        ends=np.array([[1.0, 0.2, -0.1], [0.4, 0.3, 0.2]])[:interfaces],
    )


def random_joint(
    rng: np.random.Generator,
    kind: str,
    parent: int,
    coordinate: int | None,
    rotor: float = 0.0,
    interface: int = 0,
) -> Joint:
    """Return a joint anywhere, its axis in any direction."""
    axis, origin, turn = rng.normal(size=(3, 3))
    return Joint(
        "joint", kind, parent, coordinate, axis / np.linalg.norm(axis), 0.3 * origin,
        exponential(turn), rotor, interface,
    )  # fmt: skip


@dataclass(frozen=True)
class CloudTree:
    """Clouds in a tree by Newton's law, point by point; y = (joints, elastic coordinates)."""

    clouds: tuple[SpatialCloud, ...]
    joints: tuple[Joint, ...]
    carried: dict[tuple[int, int], SpatialCloud]  # by body and interface
    gravity: np.ndarray
    end: int

    def mechanism(self) -> SpatialMechanism:
        """Return the same tree of shape integrals."""
        carried = {site: one.body() for site, one in self.carried.items()}
        first = tuple(carried.pop((i, 0), None) for i in range(len(self.clouds)))
        bodies = tuple(cloud.body() for cloud in self.clouds)
        tree = bodies, self.joints, first, self.gravity, self.end
        return SpatialMechanism(*tree, carried_further=carried)

    def forces(self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> np.ndarray:
        """Return the generalised force of every coordinate: sum m J' (p'' - g) + K e + D e'."""
        masses, _, second = self._points(y, yd, ydd)
        none = np.zeros_like(y)
        steps = 1j * STEP * np.eye(len(y))
        J = [self._points(y + step, none, none)[1].imag / STEP for step in steps]
        out = np.einsum("n,kni,ni->k", masses, J, second - self.gravity)
        for joint in self.joints:
            if joint.coordinate is not None:
                out[joint.coordinate] += joint.rotor * ydd[joint.coordinate]
        first = sum(joint.coordinate is not None for joint in self.joints)
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
        first = sum(joint.coordinate is not None for joint in self.joints)
        masses, places, second = [], [], []
        for i, (joint, cloud) in enumerate(zip(self.joints, self.clouds, strict=True)):
            part = slice(first, first + len(cloud.K))
            first = part.stop
            inner = ends[joint.parent, joint.interface]
            frame = inner @ _polynomial(_place(joint.rotation, joint.origin))
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
                shift = _polynomial(
                    _place(np.eye(3), u[0]), *(_place(0.0 * np.eye(3), x) for x in u[1:])
                )
                turn = [np.pad(x, (0, 1)) for x in theta]
                ends[i, s] = frame @ shift @ expm(_polynomial(*turn))
            X = [cloud.points + cloud.modes @ moved[0], *(cloud.modes @ e for e in moved[1:])]
            bodies = [(frame, cloud.masses, X)]
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
    """Return two branches with every kind of joint, rigid and flexible bodies, and loads.

    With two interfaces the branches leave a flexible body at both of them, and others are held at
    the second one.
    """
    last = interfaces - 1
    rigid, fork = (spatial_cloud(rng, q, interfaces) for q in (0, 3))
    clouds = (rigid, fork, spatial_cloud(rng, 2), spatial_cloud(rng, 3, interfaces), rigid)
    kinds = (
        ("revolute", GROUND, 0, 0.0), ("revolute", 0, 3, 0.3, last), ("prismatic", 1, 1, 0.4),
        ("fixed", 1, None, 0.0, last), ("revolute", 3, 2, 0.0, last),
    )  # fmt: skip
    joints = tuple(random_joint(rng, *one) for one in kinds)
    sites = sorted({(1, 0), (1, last), (3, 0), (4, 0)})
    loads = {site: spatial_cloud(rng, 0) for site in sites}
    return CloudTree(clouds, joints, loads, rng.normal(size=3), 4)


def stiffened(rng: np.random.Generator, body: ShapeIntegrals) -> ShapeIntegrals:
    """Return a body with some geometric stiffness."""
    q, b = body.num_modes, len(body.outboard)
    K0 = rng.normal(scale=0.2, size=(12 + b + q, q, q))
    K0 = K0 + K0.swapaxes(1, 2)
    # The modes of light clouds move little mass.
    return replace(body, K0=K0[:12], K0_outboard=K0[12 : 12 + b], along_modes=0.1 * K0[12 + b :])


def changes(rng: np.random.Generator, body: ShapeIntegrals) -> dict[str, np.ndarray]:
    """Return a change of every integral that keeps its symmetries."""
    found = {}
    for one in TABLE:
        value = np.asarray(getattr(body, one.name))
        change = rng.normal(size=value.shape)
        if one.name[0] in "KD" or one.name == "along_modes":
            change = change + change.swapaxes(-1, -2)
        if one.name == "W":  # W_ba = W_ab'
            blocks = change.reshape(3, 3, *change.shape[1:])
            change = (blocks + blocks.transpose(1, 0, 3, 2)).reshape(change.shape)
        if not one.name.endswith(("_point", "_points")):
            found[one.name] = change
    return found


def derivative(function: Callable[[complex], np.ndarray]) -> np.ndarray:
    """Return the derivative at 0 by a complex step."""
    return np.imag(function(1j * STEP)) / STEP


# -- plane machines in space -----------------------------------------------------------------


def posed_machine(plane: Mechanism) -> SpatialMechanism:
    """Return a plane machine in space: a cart on the x axis, joints about z."""
    x, _, z = np.eye(3)
    still = np.eye(3)
    cart = rigid_spatial_body(0.0, np.zeros(3), np.zeros(6))
    height = np.array([0.0, plane.joint_height, 0.0])
    joints = [Joint("cart", "prismatic", GROUND, 0, x, rotor=float(plane.rotors[0]))]
    carried: list[ShapeIntegrals | None] = [None]
    for k in range(len(plane.bodies)):
        origin = height if k == 0 else np.zeros(3)
        rotor = float(plane.rotors[1 + k])
        joints.append(Joint(f"joint{k}", "revolute", k, 1 + k, z, origin, still, rotor))
        load = plane.carried(k)
        inertia = None if load is None else (0.0, 0.0, load[1], 0.0, 0.0, 0.0)
        carried.append(None if load is None else rigid_spatial_body(load[0], np.zeros(3), inertia))
    bodies = (cart, *map(in_space, plane.bodies))
    gravity = np.array([*plane.gravity, 0.0])
    return SpatialMechanism(bodies, tuple(joints), tuple(carried), gravity, len(plane.bodies))


def posed_motion(motion: RigidMotion) -> RigidMotion:
    """Return a plane machine's motion as that of the joints in space."""
    return RigidMotion(motion.q, motion.qd, motion.qdd)
