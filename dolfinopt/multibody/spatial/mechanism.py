"""A tree of rigid and flexible bodies in space: what inverse dynamics works on.

Every body hangs on its parent's outboard interface, or on the ground, by one joint, whose frame is
placed as in URDF; the body's own frame is the joint's. What a body carries at its outboard
interface without a joint (payload, motor) is a rigid body in the interface's frame. Source:
Featherstone, Rigid Body Dynamics Algorithms (2008); Schwertassek & Wallrapp (1999).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import factorial
from typing import Literal

import numpy as np

from dolfinopt.multibody.mechanism import ElasticBodies
from dolfinopt.multibody.motion import RigidMotion, along_table, columns_of
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.scene.load import Arm, Scene
from dolfinopt.scene.tables import machine as scenes
from dolfinopt.scene.tables.arms import interface_number

GROUND = -1
JointType = Literal["revolute", "prismatic", "fixed"]
Site = tuple[int, int]  # body, and which of its outboard interfaces
TRANSPOSED = np.arange(9).reshape(3, 3).T.ravel()  # of W_ab: the places of W_ba


@dataclass(frozen=True, eq=False)
class Joint:
    """What holds a body.

    Attributes:
        name: of the joint.
        kind: revolute, prismatic or fixed.
        parent: index of the body whose outboard interface it sits on, or `GROUND`.
        coordinate: its place among the rigid coordinates; None of a fixed one.
        axis: (3,) unit vector in the joint's frame.
        origin: (3,) of the joint's frame in the parent's interface frame, m.
        rotation: (3, 3) from the joint's frame to the parent's interface frame.
        rotor: inertia of what drives it, times the gear ratio squared, kg m2 (prismatic: kg).
        interface: number of the parent's outboard interface, 0 for the first.
    """

    name: str
    kind: JointType
    parent: int
    coordinate: int | None
    axis: np.ndarray
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: ONE)
    rotor: float = 0.0
    interface: int = 0


@dataclass(frozen=True, eq=False)
class Constants:
    """One body's integrals as the equations use them; q modes.

    Attributes:
        body: the integrals.
        c, C: (3,), (3, q) int X and int Phi.
        W_rest, W_modes: (9 (1 + q),), (q, 9 (1 + q)): W_ab eta = W_rest + e W_modes.
        modes: (9, q q) of W_ab among the modes.
        M: (q, q) mass.
        B: (6 i, q) displacement and rotation of its i outboard interfaces.
        K0: (12, q, q) of the frame's accelerations a and A_ab, or None of a linear body.
        K0_outboard: (6 i, q, q), or None.
        points: (i, 3) reference positions of the interfaces.
        L: (q, q, q) of `ModalDisplacement`, or None.
    """

    body: ShapeIntegrals
    c: np.ndarray
    C: np.ndarray
    W_rest: np.ndarray
    W_modes: np.ndarray
    modes: np.ndarray
    M: np.ndarray
    B: np.ndarray
    K0: np.ndarray | None
    K0_outboard: np.ndarray | None
    points: np.ndarray
    L: np.ndarray | None

    @property
    def num_modes(self) -> int:
        """Number q."""
        return len(self.M)


def constants_of(body: ShapeIntegrals) -> Constants:
    """Return a spatial body's constants."""
    q = body.num_modes
    by_eta = body.W.transpose(2, 0, 1).reshape(1 + q, -1)  # of eta_l: (ab, k)
    modes = body.W[:, 1:, 1:]
    stiffened = body.is_stiffened
    return Constants(
        body=body,
        c=body.w[:, 0],
        C=body.w[:, 1:],
        W_rest=by_eta[0],
        W_modes=by_eta[1:],
        modes=modes.reshape(9, -1),
        M=modes[0] + modes[4] + modes[8],
        B=body.outboard,
        K0=body.K0 if stiffened else None,
        K0_outboard=body.K0_outboard if stiffened else None,
        points=body.points,
        L=body.along_modes if len(body.along_modes) else None,
    )


@dataclass(frozen=True, eq=False)
class SpatialMechanism(ElasticBodies):
    """Bodies, the joints that hold them, what they carry, and gravity.

    Attributes:
        bodies: in the order of the elastic coordinates.
        joints: that hold them, in the same order.
        carried: what every body carries at its first outboard interface, a rigid body in the frame
            of the interface, or None; an empty tuple for nothing at all.
        gravity: (3,) m/s2.
        end: index of the body that has the end-effector.
        end_interface: which of its interfaces that is, 0 the first.
        carried_further: what bodies carry at other interfaces, likewise, by (body, interface).
    """

    joints: tuple[Joint, ...]
    carried: tuple[ShapeIntegrals | None, ...]
    gravity: np.ndarray
    end: int
    end_interface: int = 0
    carried_further: Mapping[Site, ShapeIntegrals] = field(default_factory=dict)

    @cached_property
    def constants(self) -> tuple[Constants, ...]:
        """Every body's constants."""
        return tuple(map(constants_of, self.bodies))

    @cached_property
    def every_load(self) -> dict[Site, ShapeIntegrals]:
        """All that bodies carry, by (body, interface)."""
        first = {(i, 0): one for i, one in enumerate(self.carried) if one is not None}
        return first | dict(self.carried_further)

    @cached_property
    def loads(self) -> dict[Site, Constants]:
        """Constants of `every_load`."""
        return {site: constants_of(one) for site, one in self.every_load.items()}

    @cached_property
    def sites(self) -> tuple[tuple[int, ...], ...]:
        """Of every body the interfaces on which something sits, ascending."""
        found: list[set[int]] = [set() for _ in self.bodies]
        for joint in self.joints:
            if joint.parent != GROUND:
                found[joint.parent].add(joint.interface)
        for body, interface in self.every_load:
            found[body].add(interface)
        return tuple(tuple(sorted(one)) for one in found)

    def hanging(self, body: int, interface: int) -> tuple[int, ...]:
        """Return the bodies that hang on an interface."""
        return tuple(k for k in self.children[body] if self.joints[k].interface == interface)

    @cached_property
    def order(self) -> tuple[int, ...]:
        """The bodies, every one behind its parent."""
        found: list[int] = []
        while len(found) < len(self.joints):
            more = [
                i
                for i, joint in enumerate(self.joints)
                if i not in found and (joint.parent == GROUND or joint.parent in found)
            ]
            assert more, "joints form a loop"
            found += more
        return tuple(found)

    @cached_property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """The bodies that hang on every body."""
        every = range(len(self.bodies))
        return tuple(tuple(i for i in every if self.joints[i].parent == k) for k in every)

    @cached_property
    def chain(self) -> tuple[int, ...]:
        """The bodies from the ground to the end-effector's."""
        found = [self.end]
        while self.joints[found[0]].parent != GROUND:
            found.insert(0, self.joints[found[0]].parent)
        return tuple(found)

    @cached_property
    def movable(self) -> tuple[int, ...]:
        """For every rigid coordinate the body whose joint it is."""
        found = [(j.coordinate, i) for i, j in enumerate(self.joints) if j.coordinate is not None]
        return tuple(i for _, i in sorted(found))

    @property
    def num_rigid(self) -> int:
        """Number of rigid coordinates."""
        return len(self.movable)

    def __getitem__(self, part: slice | np.ndarray) -> SpatialMechanism:
        """Return itself: it is the same at all instants."""
        return self

    @cached_property
    def rotors(self) -> np.ndarray:
        """Reflected inertia of every rigid coordinate's drive."""
        return np.array([self.joints[i].rotor for i in self.movable])


# -- rigid bodies ----------------------------------------------------------------------------


def rigid_spatial_body(
    mass: float,
    centre: np.ndarray | tuple[float, ...],
    inertia: np.ndarray | tuple[float, ...],
    outboard_point: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0),
    further_points: np.ndarray | tuple[tuple[float, ...], ...] = (),
) -> ShapeIntegrals:
    """Return a spatial body without elastic coordinates.

    Args:
        mass: kg.
        centre: (3,) of mass, m.
        inertia: (6,) xx, yy, zz, xy, xz, yz of the inertia tensor about the centre, as in URDF,
            kg m2.
        outboard_point: (3,) of its outboard interface, m.
        further_points: (i, 3) of others, m.
    """
    r, tensor = np.asarray(centre, dtype=float), inertia_tensor(inertia)
    # int x_a x_b = tr(I)/2 delta - I about the centre, and m r r' more about the frame's origin.
    second = 0.5 * np.trace(tensor) * ONE - tensor + mass * np.outer(r, r)
    square, further = np.zeros((0, 0)), np.reshape(further_points, (-1, 3)).astype(float)
    return ShapeIntegrals(
        mass=float(mass),
        w=(mass * r)[:, None],
        W=second.reshape(9, 1, 1),
        K=square,
        D=square,
        outboard=np.zeros((6 + 6 * len(further), 0)),
        outboard_point=np.asarray(outboard_point, dtype=float),
        K0=np.zeros((0, 0, 0)),
        K0_outboard=np.zeros((0, 0, 0)),
        further_points=further,
    )


def inertia_about_centre(body: ShapeIntegrals) -> tuple[np.ndarray, np.ndarray]:
    """Return centre (3,), m, and inertia tensor (3, 3) about it, kg m2, of the undeformed body."""
    centre = body.w[:, 0] / body.mass if body.mass else np.zeros(3)
    second = body.W[:, 0, 0].reshape(3, 3) - body.mass * np.outer(centre, centre)
    return centre, np.trace(second) * ONE - second


def inertia_tensor(inertia: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """Return the tensor (3, 3) of xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=float)


# -- rotations in space: rotation vectors with exact derivatives, axes and angles, URDF's frames
#
# A rotation vector theta, x = theta . theta, turns by
#     R = exp(theta~) = 1 + c_1 theta~ + c_2 theta~^2,
# and with J = 1 + c_2 theta~ + c_3 theta~^2 the rate theta' is the angular velocity J theta', in
# the
# components of the frame that theta turns away from. c_k(x) = sum_j (-x)^j / (2 j + k)! have the
# derivatives c_k' = (k c_(k+2) - c_(k+1)) / 2 without a division: nothing is lost at small angles.
# At large ones, where the series cancels, they follow from sine and cosine.
# All functions take complex numbers, whose imaginary part is then a derivative.
# Source: Stumpff (1959); Simo & Vu-Quoc (1988), doi:10.1016/0045-7825(88)90073-4; Sola, Deray &
# Atchuthan (2018), arXiv:1812.01537.

# Terms of the series: 1e-24 at x = 1, and 1e-40 up to x = FAR, where rounding has grown to 1e-15.
TERMS, NEAR = 10, 1.0
MANY_TERMS, FAR = 40, 10.0

ONE: np.ndarray = np.eye(3)
_NEXT, _OTHER = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return u x v (..., 3)."""
    return u[..., _NEXT] * v[..., _OTHER] - u[..., _OTHER] * v[..., _NEXT]


def skew(v: np.ndarray) -> np.ndarray:
    """Return v~ (..., 3, 3), v~ u = v x u."""
    out = np.zeros((*v.shape, 3), dtype=v.dtype)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def axial(A: np.ndarray) -> np.ndarray:
    """Return (A_yz - A_zy, A_zx - A_xz, A_xy - A_yx) (..., 3) of matrices (..., 3, 3)."""
    return np.stack([A[..., j, k] - A[..., k, j] for j, k in ((1, 2), (2, 0), (0, 1))], axis=-1)


def dot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return u . v (...) of vectors (..., 3)."""
    return (u * v).sum(axis=-1)


def times(A: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return A v (n, 3) of matrices (n, 3, 3), or one (3, 3), and vectors (n, 3)."""
    return v @ A.T if A.ndim == 2 else np.einsum("nij,nj->ni", A, v)


def transposed_times(A: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return A' v (n, 3)."""
    return v @ A if A.ndim == 2 else np.einsum("nji,nj->ni", A, v)


def series(x: np.ndarray, orders: int = 8) -> list[np.ndarray]:
    """Return c_0 ... c_(orders-1) at x (n,): by their series, or those of many turns closed."""
    far = np.abs(x) > FAR
    if not far.any():
        return _series(x, orders)
    near = _series(np.where(far, 0.0, x), orders)
    large = _closed(np.where(far, x, FAR), orders)
    return [np.where(far, b, a) for a, b in zip(near, large, strict=True)]


def _closed(x: np.ndarray, orders: int) -> list[np.ndarray]:
    """Return c_0 = cos(angle), c_1 = sin(angle) / angle, c_(k+2) = (1 / k! - c_k) / x."""
    angle = np.sqrt(x)
    found = [np.cos(angle), np.sin(angle) / angle]
    for k in range(orders - 2):
        found.append((1.0 / factorial(k) - found[k]) / x)
    return found


def _series(x: np.ndarray, orders: int) -> list[np.ndarray]:
    terms = TERMS if np.abs(x).max(initial=0.0) <= NEAR else MANY_TERMS
    last = [_horner(x, k, terms) for k in (orders - 1, orders - 2)]
    found = last
    for k in range(orders - 3, -1, -1):
        found.append(1.0 / factorial(k) - x * found[-2])
    return found[::-1]


def _horner(x: np.ndarray, k: int, terms: int) -> np.ndarray:
    value = np.zeros_like(x)
    for j in range(terms - 1, -1, -1):
        value = 1.0 / factorial(2 * j + k) - x * value
    return value


def exponential(theta: np.ndarray) -> np.ndarray:
    """Return R (..., 3, 3) of rotation vectors (..., 3)."""
    c = series(dot(theta, theta), 3)
    A = skew(theta)
    return ONE + c[1][..., None, None] * A + c[2][..., None, None] * (A @ A)


def about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the rotations (n, 3, 3) about a unit axis (3,) by angles (n,)."""
    A = skew(axis)
    # Of a column NumPy takes other instructions, and another last bit, where the end of its stride
    # touches the memory of the result.
    angle = np.ascontiguousarray(angle)
    s, c = np.sin(angle), np.cos(angle)
    return ONE + s[:, None, None] * A + (1.0 - c)[:, None, None] * (A @ A)


def roll_pitch_yaw(rpy: tuple[float, float, float]) -> np.ndarray:
    """Return the rotation (3, 3) of URDF's fixed-axis roll, pitch, yaw: Rz(y) Ry(p) Rx(r)."""
    x, y, z = (about(ONE[i], np.array([angle]))[0] for i, angle in enumerate(rpy))
    R: np.ndarray = z @ y @ x
    return R


@dataclass(frozen=True, eq=False)
class Turning:
    """A rotation vector and its rates, and the motion they are; arrays over n instants.

    Attributes:
        theta, rate, second: (n, 3) rotation vector, its first and second derivative.
    """

    theta: np.ndarray
    rate: np.ndarray
    second: np.ndarray

    @cached_property
    def _c(self) -> list[np.ndarray]:
        return [c[:, None] for c in series(dot(self.theta, self.theta))]

    @cached_property
    def _first(self) -> tuple[np.ndarray, np.ndarray]:
        """c_2', c_3' (n, 1)."""
        return _derivative(self._c, 2), _derivative(self._c, 3)

    @cached_property
    def _second(self) -> tuple[np.ndarray, np.ndarray]:
        """c_2'', c_3'' (n, 1)."""
        c = self._c
        first = {k: _derivative(c, k) for k in (3, 4, 5)}
        return 0.5 * (2 * first[4] - first[3]), 0.5 * (3 * first[5] - first[4])

    @cached_property
    def R(self) -> np.ndarray:
        """The rotation (n, 3, 3)."""
        A, c = skew(self.theta), self._c
        return ONE + c[1][..., None] * A + c[2][..., None] * (A @ A)

    @cached_property
    def J(self) -> np.ndarray:
        """Angular velocity by the rate (n, 3, 3)."""
        A, c = skew(self.theta), self._c
        return ONE + c[2][..., None] * A + c[3][..., None] * (A @ A)

    @cached_property
    def velocity(self) -> np.ndarray:
        """Angular velocity J theta' (n, 3)."""
        return times(self.J, self.rate)

    @cached_property
    def acceleration(self) -> np.ndarray:
        """Its derivative J theta'' + J' theta' (n, 3)."""
        theta, v, c = self.theta, self.rate, self._c
        along = dot(theta, v)[:, None]
        first, second = self._first
        turned = cross(theta, v)
        bent = 2.0 * along * (first * turned + second * cross(theta, turned))
        return times(self.J, self.second) + bent + c[3] * cross(v, turned)

    def by_theta(self, v: np.ndarray, sign: float = 1.0) -> np.ndarray:
        """Return the derivative of J v by theta (n, 3, 3); of J' v with `sign` = -1."""
        theta, c = self.theta, self._c
        x, along = dot(theta, theta)[:, None], dot(theta, v)[:, None]
        first, second = self._first
        turned = 2.0 * sign * first * cross(theta, v) + 2.0 * second * (along * theta - x * v)
        out = -sign * c[2][..., None] * skew(v) + _outer(turned, theta)
        return out + c[3][..., None] * (
            along[..., None] * ONE + _outer(theta, v) - 2.0 * _outer(v, theta)
        )

    @cached_property
    def acceleration_by_theta(self) -> np.ndarray:
        """Derivative of `acceleration` by theta (n, 3, 3)."""
        theta, v, c = self.theta, self.rate, self._c
        x, s, square = dot(theta, theta)[:, None], dot(theta, v)[:, None], dot(v, v)[:, None]
        (d2, d3), (dd2, dd3) = self._first, self._second
        turned, plane = cross(theta, v), s * theta - x * v
        out = self.by_theta(self.second)
        out = out + _outer(2.0 * d2 * turned + 2.0 * d3 * plane - c[3] * v, v)
        out += _outer(4.0 * s * (dd2 * turned + dd3 * plane), theta)
        out += _outer(2.0 * d3 * (square * theta - s * v), theta)
        out -= (2.0 * d2 * s)[..., None] * skew(v)
        out += (c[3] * square + 2.0 * d3 * s * s)[..., None] * ONE
        return out + (2.0 * d3 * s)[..., None] * (_outer(theta, v) - 2.0 * _outer(v, theta))

    @cached_property
    def acceleration_by_rate(self) -> np.ndarray:
        """Derivative of `acceleration` by theta' (n, 3, 3): d(J theta')/d theta + J'."""
        theta, v, c = self.theta, self.rate, self._c
        A, B = skew(theta), skew(v)
        s = 2.0 * dot(theta, v)[:, None, None]
        first, second = (x[..., None] for x in self._first)
        rate = c[2][..., None] * B + s * (first * A + second * (A @ A))
        return self.by_theta(v) + rate + c[3][..., None] * (A @ B + B @ A)


def _derivative(c: list[np.ndarray], k: int) -> np.ndarray:
    """Return c_k' by x."""
    return 0.5 * (k * c[k + 2] - c[k + 1])


def _outer(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return u v' (n, 3, 3)."""
    return u[..., :, None] * v[..., None, :]


# -- the joints from the ground to the end-effector, links rigid: places, Jacobian,
# accelerations


@dataclass(frozen=True, eq=False)
class Pose:
    """The end-effector at n instants, world's components; k joints that move.

    Attributes:
        place: (n, 3) m.
        rotation: (n, 3, 3) from the end-effector's frame to the world's.
        jacobian: (n, 6, k) velocity and angular velocity by the joints' rates.
        bias: (n, 6) acceleration and angular acceleration at these rates, the joints' own zero.
    """

    place: np.ndarray
    rotation: np.ndarray
    jacobian: np.ndarray
    bias: np.ndarray


@dataclass(frozen=True, eq=False)
class RigidChain:
    """Rigid links from the ground to the end-effector.

    Attributes:
        joints: from the ground outwards, fixed ones included.
        points: (3,) for every joint where on its parent the interface is that it sits on, m.
        end: (3,) the end-effector in the last link's frame, m.
    """

    joints: tuple[Joint, ...]
    points: tuple[np.ndarray, ...]
    end: np.ndarray

    @property
    def coordinates(self) -> tuple[int, ...]:
        """Which of the machine's rigid coordinates move the end-effector."""
        return tuple(j.coordinate for j in self.joints if j.coordinate is not None)

    @property
    def reach(self) -> float:
        """Length of the links together, m."""
        offsets = [p + joint.origin for p, joint in zip(self.points, self.joints, strict=True)]
        return float(sum(map(np.linalg.norm, [*offsets, self.end]))) or 1.0

    def at(self, q: np.ndarray, qd: np.ndarray | None = None) -> Pose:
        """Return the end-effector for the machine's joint coordinates.

        Args:
            q: (n, joints) rad, m.
            qd: (n, joints) rates; zero by default.
        """
        count = len(q)
        qd = np.zeros_like(q) if qd is None else qd
        R, p = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3))
        w, wd, a = np.zeros((3, count, 3))
        origins, axes, slides = [], [], []
        for joint, point in zip(self.joints, self.points, strict=True):
            away = times(R, np.broadcast_to(point + joint.origin, p.shape))
            p = p + away
            a = a + cross(wd, away) + cross(w, cross(w, away))
            R = R @ joint.rotation
            if (k := joint.coordinate) is None:
                continue
            axis = times(R, np.broadcast_to(joint.axis, p.shape))
            turned = axis * qd[:, k, None]
            if joint.kind == "prismatic":
                slid = axis * q[:, k, None]
                p = p + slid
                a = a + cross(wd, slid) + cross(w, cross(w, slid)) + 2.0 * cross(w, turned)
            else:
                R = R @ about(joint.axis, q[:, k])
                wd, w = wd + cross(w, turned), w + turned
            origins.append(p)
            axes.append(axis)
            slides.append(joint.kind == "prismatic")
        away = times(R, np.broadcast_to(self.end, p.shape))
        p, a = p + away, a + cross(wd, away) + cross(w, cross(w, away))
        J = np.zeros((count, 6, len(axes)))
        for i, (origin, axis, slide) in enumerate(zip(origins, axes, slides, strict=True)):
            J[:, :3, i] = axis if slide else cross(axis, p - origin)
            J[:, 3:, i] = 0.0 if slide else axis
        return Pose(p, R, J, np.hstack([a, wd]))


# -- A scene's rigid arms, payload and joints -> bodies and joints of a machine in space ---------

Inertia = tuple[float, ...]


def rigid_link(arm: Arm, density: float) -> ShapeIntegrals:
    """Return a rigid arm's body: as stated, or of the solid bar of length, height, thickness.

    Args:
        arm: of the scene.
        density: of its material, kg/m3.
    """
    x, y, z = arm.length, arm.height, arm.thickness
    mass = density * x * y * z if arm.mass is None else arm.mass
    centre = (0.5 * x, 0.0, 0.0) if arm.centre is None else arm.centre
    inertia = arm.inertia
    if inertia is None:
        squares = (y * y + z * z, x * x + z * z, x * x + y * y)
        inertia = (*(mass * square / 12.0 for square in squares), 0.0, 0.0, 0.0)
    further = tuple(one.point for one in arm.interfaces)
    return rigid_spatial_body(mass, centre, _tensor(inertia), (x, 0.0, 0.0), further)


def _tensor(inertia: float | Inertia) -> Inertia:
    """Return xx, yy, zz, xy, xz, yz; a number is the moment about every axis."""
    return inertia if isinstance(inertia, tuple) else (*[inertia] * 3, 0.0, 0.0, 0.0)


def build_spatial_mechanism(scene: Scene, bodies: list[ShapeIntegrals]) -> SpatialMechanism:
    """Put the bodies on the scene's joints, with what they carry.

    Args:
        scene: with [[joints]].
        bodies: of the arms, in the scene's order.
    """
    gravity = scene.motion.gravity
    end, interface = scene.end_effector
    return SpatialMechanism(
        bodies=tuple(bodies),
        joints=joints_of(scene),
        carried=tuple(_carried(scene, k) for k in range(len(bodies))),
        gravity=np.array(gravity if len(gravity) == 3 else (0.0, 0.0, 0.0)),
        end=end,
        end_interface=interface,
        carried_further={(end, interface): _payload(scene)} if interface else {},
    )


def joints_of(scene: Scene) -> tuple[Joint, ...]:
    """Return the joints that hold the arms, in the arms' order."""
    index = {arm.name: k for k, arm in enumerate(scene.arms)}
    coordinates = {joint.name: i for i, joint in enumerate(scene.movable)}
    by_child = {index[joint.child]: joint for joint in scene.joints}
    joints = []
    for k, arm in enumerate(scene.arms):
        one = by_child[k]
        parent, interface = GROUND, 0
        if one.parent != scenes.GROUND:
            parent = index[one.parent]
            interface = interface_number(scene.arms[parent], one.parent_interface) or 0
        axis = np.array((0.0, 0.0, 1.0) if one.axis is None else one.axis)
        joints.append(
            Joint(
                name=one.name,
                kind=one.type,
                parent=parent,
                coordinate=coordinates.get(one.name),
                axis=axis / np.linalg.norm(axis),
                origin=np.array(one.origin, dtype=float),
                rotation=roll_pitch_yaw(one.rpy),
                rotor=arm.rotor_inertia * arm.gear_ratio**2,
                interface=interface,
            )
        )
    return tuple(joints)


def end_chain(scene: Scene) -> RigidChain:
    """Return the rigid links from the ground to the end-effector."""
    joints, (arm, interface) = joints_of(scene), scene.end_effector
    points = [[np.array(point) for point in one.interface_points] for one in scene.arms]
    end, chain = points[arm][interface], [joints[arm]]
    while chain[0].parent != GROUND:
        chain.insert(0, joints[chain[0].parent])
    ground = np.zeros(3)
    sits = [ground if j.parent == GROUND else points[j.parent][j.interface] for j in chain]
    return RigidChain(tuple(chain), tuple(sits), end)


def _payload(scene: Scene) -> ShapeIntegrals:
    """Return the payload, in the frame of the end-effector's interface."""
    payload = scene.payload
    return rigid_spatial_body(payload.mass, payload.offset, _tensor(payload.inertia))


def _carried(scene: Scene, k: int) -> ShapeIntegrals | None:
    """Return what arm k carries at its outboard interface: motors, the payload."""
    arm = scene.arms[k]
    parts = []
    if arm.joint_mass or arm.joint_inertia:
        parts.append(rigid_spatial_body(arm.joint_mass, (0.0,) * 3, _tensor(arm.joint_inertia)))
    if scene.end_effector == (k, 0):
        parts.append(_payload(scene))
    if not parts:
        return None
    return parts[0] if len(parts) == 1 else parts[0] + parts[1]


# -- motion of a spatial machine's joints at given instants --------------------------------------


def joint_motion(t: np.ndarray, scene: Scene) -> RigidMotion:
    """Return the joints at instants t (n,), s: of the scene's table, or of the end-effector's path.

    Raises:
        InputError: the table cannot be used, or the path cannot be followed.
    """
    if scene.motion.path != "joints":
        from dolfinopt.multibody.spatial.end_effector import follower

        return RigidMotion(*follower(scene).at(t))
    return RigidMotion(*along_table(t, scene.motion, columns_of(scene)))


def check_joint_motion(scene: Scene) -> None:
    """Raise `InputError` when the scene's table or path cannot be followed."""
    joint_motion(np.zeros(1), scene)
