"""A tree of rigid and flexible bodies in the plane or in space: what inverse dynamics works on.

Every body hangs on its parent's outboard interface, or on the ground, by one joint, whose frame is
placed as in URDF; the body's own frame is the joint's. What a body carries at an outboard interface
without a joint (payload, motor) is a rigid body in the interface's frame. Source: Featherstone,
Rigid Body Dynamics Algorithms (2008); Schwertassek & Wallrapp (1999).
Every body works in its own tangent frame at its inboard joint.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.linalg import block_diag

from dolfinopt.multibody.body import Constants, Motion
from dolfinopt.multibody.dimension import DIMENSIONS, Dimension
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, rigid_body, rigid_spatial_body

if TYPE_CHECKING:
    from dolfinopt.multibody.rigid_motion import RigidMotion

# -- a tree of bodies, in the plane and in space: what inverse dynamics works on

GROUND = -1
JointType = Literal["revolute", "prismatic", "fixed"]
Site = tuple[int, int]  # body, and which of its outboard interfaces


@dataclass(frozen=True)
class Rotor:
    """The rotor of a joint's motor, carried by what the joint sits on, its axis along the joint's.

    Attributes:
        inertia: J about its axis, which is not part of any body's inertia, kg m2.
        ratio: turns of the rotor for one of the joint, against what carries it; rad/m of a
            prismatic joint, whose screw is right-handed.
        motor: its place among the motors behind springs, which have coordinates of their own;
            None: it turns with the joint.
    """

    inertia: float
    ratio: float
    motor: int | None = None


@dataclass(frozen=True, eq=False)
class Joint:
    """What holds a body.

    Attributes:
        name: of the joint.
        kind: revolute, prismatic or fixed.
        parent: index of the body whose outboard interface it sits on, or `GROUND`.
        coordinate: its place among the rigid coordinates; None of a fixed one.
        axis: (3,) unit vector in the joint's frame; (1,) of a plane's joint, which turns.
        origin: (d,) of the joint's frame in the parent's interface frame, m.
        rotation: (d, d) from the joint's frame to the parent's interface frame.
        rotor: of what drives it, or None.
        interface: number of the parent's outboard interface, 0 for the first.
    """

    name: str
    kind: JointType
    parent: int
    coordinate: int | None
    axis: np.ndarray
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    rotor: Rotor | None = None
    interface: int = 0

    @cached_property
    def turns(self) -> np.ndarray:
        """A revolute joint's rotation by (1, sin(angle), 1 - cos(angle)) (d, d, 3)."""
        R, S = self.rotation, DIMENSIONS[len(self.origin)].skew(self.axis)
        return np.stack([R, R @ S, R @ S @ S], axis=-1)


@dataclass(frozen=True, eq=False)
class Friction:
    """Friction of joints against their speeds v, f = f_v v + f_c tanh(v / v_s).

    Attributes:
        viscous: f_v (R,), N m s/rad, N s/m.
        coulomb: f_c (R,), N m, N.
        speed: v_s (R,) > 0, rad/s, m/s.
    """

    viscous: np.ndarray
    coulomb: np.ndarray
    speed: np.ndarray

    def force(self, v: np.ndarray) -> np.ndarray:
        """Return f (n, R) at speeds v (n, R)."""
        return self.viscous * v + self.coulomb * np.tanh(v / self.speed)

    def slope(self, v: np.ndarray) -> np.ndarray:
        """Return df/dv (n, R)."""
        bent = 1.0 - np.square(np.tanh(v / self.speed))
        return self.viscous + self.coulomb / self.speed * bent

    def of(self, coordinates: np.ndarray) -> Friction:
        """Return that of some coordinates."""
        return Friction(*(x[coordinates] for x in (self.viscous, self.coulomb, self.speed)))

    @classmethod
    def none(cls, count: int) -> Friction:
        """Return none, of so many coordinates."""
        return cls(np.zeros(count), np.zeros(count), np.ones(count))

    @property
    def acts(self) -> bool:
        """Whether there is any."""
        return bool(self.viscous.any() or self.coulomb.any())


@dataclass(frozen=True)
class AppliedForce:
    """A given force and moment on an outboard interface, whose values stand in the motion.

    Attributes:
        site: the interface.
        column: its place among `RigidMotion.applied`.
        in_world: whether it keeps its direction in the world; otherwise in the body's frame.
        known: whether a control's feed-forward counts it.
    """

    site: Site
    column: int
    in_world: bool = True
    known: bool = True


@dataclass(frozen=True, eq=False)
class Mechanism:
    """Bodies, the joints that hold them, what they carry, and gravity; in the plane or in space.

    Attributes:
        bodies: in the order of the elastic coordinates.
        joints: that hold them, in the same order.
        loads: what they carry at interfaces without a joint, in the interfaces' frames.
        gravity: (d, 1) m/s2.
        end: the end-effector's interface.
        origin: (d,) of the ground's frame, which a cart moves along x, m.
        cart: its mass, kg, of the first rigid coordinate; None without one.
        forces: given ones on interfaces.
        bearings: the bodies whose joints sit on bearings, see `joints.with_bearings`: the last
            bodies, massless, in this order.
        friction: of the joints' coordinates, or None.
        rods: number of further rigid coordinates, lengths of rods that close loops.
    """

    bodies: tuple[ShapeIntegrals, ...]
    joints: tuple[Joint, ...]
    loads: Mapping[Site, Constants]
    gravity: np.ndarray
    end: Site
    origin: np.ndarray
    cart: float | None = None
    forces: tuple[AppliedForce, ...] = ()
    bearings: tuple[int, ...] = ()
    friction: Friction | None = None
    rods: int = 0

    @property
    def rigid(self) -> Mechanism:
        """The same of bodies of the same mass and inertia that do not deform."""
        return replace(self, bodies=tuple(body.rigid_part for body in self.bodies))

    @property
    def foreseen(self) -> Mechanism:
        """The same under the forces alone that are known in advance."""
        return replace(self, forces=tuple(force for force in self.forces if force.known))

    # -- coordinates -------------------------------------------------------------------------

    @property
    def dim(self) -> Dimension:
        """What differs between the plane and space."""
        return DIMENSIONS[len(self.gravity)]

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Each body's place in the vector of all elastic coordinates."""
        ends = np.cumsum([0, *(body.num_modes for body in self.bodies)])
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @property
    def num_arms(self) -> int:
        """Number of bodies that are no bearings."""
        return len(self.bodies) - len(self.bearings)

    @property
    def arms(self) -> tuple[ShapeIntegrals, ...]:
        """The bodies that are no bearings."""
        return self.bodies[: self.num_arms]

    @property
    def bearing_columns(self) -> slice:
        """Place of the bearings' coordinates among all elastic ones: the last ones."""
        return slice(sum(body.num_modes for body in self.arms), None)

    @property
    def num_coordinates(self) -> int:
        """Number N of elastic coordinates of all bodies."""
        return sum(body.num_modes for body in self.bodies)

    @cached_property
    def num_rigid(self) -> int:
        """Number R of rigid coordinates, of cart, joints and rods."""
        return (self.cart is not None) + len(self.movable) + self.rods

    @cached_property
    def rotors(self) -> Mapping[int, int]:
        """Coordinates of all rotors by the bodies whose joints they drive.

        That of the joint, or R + its place of a motor behind a spring.
        """
        return {
            i: joint.coordinate if joint.rotor.motor is None else self.num_rigid + joint.rotor.motor
            for i, joint in enumerate(self.joints)
            if joint.rotor is not None and joint.coordinate is not None
        }

    @cached_property
    def motor_joints(self) -> np.ndarray:
        """Coordinates (M,) of the joints whose motors are behind springs.

        The motors' own coordinates follow the R rigid ones.
        """
        own = {k: self.joints[i].coordinate for i, k in self.rotors.items()}
        return np.array([own[k] for k in sorted(own) if k >= self.num_rigid], dtype=int)

    @cached_property
    def movable(self) -> tuple[int, ...]:
        """The bodies whose joints have a coordinate, in the order of these."""
        result = [(j.coordinate, i) for i, j in enumerate(self.joints) if j.coordinate is not None]
        return tuple(i for _, i in sorted(result))

    @property
    def cart_coordinate(self) -> int | None:
        """Place of the cart among the rigid coordinates, None without one."""
        return None if self.cart is None else 0

    # -- how the recursions go along it ------------------------------------------------------

    @cached_property
    def constants(self) -> tuple[Constants, ...]:
        """The bodies' integrals as the equations use them."""
        return tuple(map(Constants, self.bodies))

    @cached_property
    def sites(self) -> tuple[tuple[int, ...], ...]:
        """Of every body the interfaces on which something sits, ascending."""
        taken = {(joint.parent, joint.interface) for joint in self.joints}
        taken |= {*self.loads, *(force.site for force in self.forces)}
        every = range(len(self.joints))
        return tuple(tuple(sorted(s for body, s in taken if body == k)) for k in every)

    @cached_property
    def hanging(self) -> Mapping[Site, tuple[int, ...]]:
        """The bodies that hang on every interface on which something sits, and on the ground."""
        sites = [(GROUND, 0), *((i, s) for i, own in enumerate(self.sites) for s in own)]
        places = [(joint.parent, joint.interface) for joint in self.joints]
        return {site: tuple(k for k, place in enumerate(places) if place == site) for site in sites}

    @cached_property
    def order(self) -> tuple[int, ...]:
        """The bodies depth first: behind its parent every one with all that hangs on it."""
        every = range(len(self.joints))

        def branch(k: int) -> list[tuple[int, int]]:
            joint = self.joints[k]
            before = [] if joint.parent == GROUND else branch(joint.parent)
            return [*before, (joint.interface, k)]

        return tuple(sorted(every, key=branch))

    @cached_property
    def way(self) -> tuple[Site, ...]:
        """From the ground to the end-effector: every body and the interface that leads on."""
        return self.way_to(self.end)

    def way_to(self, site: Site) -> tuple[Site, ...]:
        """Return every body from the ground to a site, and the interface that leads on."""
        result = [site]
        while (joint := self.joints[result[0][0]]).parent != GROUND:
            result.insert(0, (joint.parent, joint.interface))
        return tuple(result)

    @cached_property
    def reach(self) -> float:
        """Length of the links from the ground to the end-effector together, m."""
        total, point = 0.0, np.zeros(self.dim.d)
        for i, number in self.way:
            total += float(np.linalg.norm(point + self.joints[i].origin))
            point = self.constants[i].points[number]
        return total + float(np.linalg.norm(point)) or 1.0

    def is_felt(self, i: int) -> bool:
        """Return whether a body inboard of body i deforms under its load."""
        return any(self.bodies[k].num_modes for k, _ in self.way_to((i, 0))[:-1])

    def base(self, q_r: np.ndarray) -> np.ndarray:
        """Return where the ground's frame is (d, n), m, for rigid coordinates (n, R)."""
        return self.origin[:, None] + self.virtual_ground(q_r)[: self.dim.d]

    def ground(self, motion: RigidMotion) -> Motion:
        """Return the motion of what the first joints sit on: that of the cart, less gravity."""
        a, still = np.split(self.virtual_ground(motion.qdd), [self.dim.d])
        return a - self.gravity, still, still

    def virtual_ground(self, x: np.ndarray) -> np.ndarray:
        """Return displacement and rotation (d + r, n) of the ground for coordinates (n, .)."""
        out = np.zeros((self.dim.b, len(x)), dtype=x.dtype)
        if self.cart is not None:
            out[0] = x[:, 0]
        return out

    # -- how stiff and how large it is -------------------------------------------------------

    @property
    def softness(self) -> float:
        """Largest static deflection of an interface by a unit force, m/N; in the plane across."""
        return max(
            (
                self.dim.softness(B, body.K, point)
                for body, points in zip(
                    self.bodies, (constant.points for constant in self.constants)
                )
                if body.num_modes
                for B, point in zip(np.split(body.outboard, len(points)), points, strict=True)
            ),
            default=0.0,
        )

    @property
    def levers(self) -> np.ndarray:
        """Deflection of the end by unit rigid coordinates (R,), m; at most."""
        reach = sum(
            float(np.linalg.norm(constant.points, axis=1).max()) for constant in self.constants
        )
        reach += sum(float(np.linalg.norm(joint.origin)) for joint in self.joints)
        slides = [self.joints[i].kind == "prismatic" for i in self.movable]
        slides = [True, *slides] if self.cart is not None else slides
        return np.where(slides + [True] * self.rods, 1.0, reach)

    def energies(self, q: np.ndarray) -> np.ndarray:
        """Return q' K q of every body (..., bodies), twice its energy, N m; q (..., N)."""
        pairs = zip(self.bodies, (q[..., part] for part in self.slices), strict=True)
        each = [np.einsum("...k,...k->...", e @ body.K, e) for body, e in pairs]
        return np.stack(each, axis=-1) if each else np.zeros((*q.shape[:-1], 0))

    def norm(self, q: np.ndarray) -> np.ndarray:
        """Return every body's largest sqrt(q' K q) over n instants (..., bodies); q (..., n, N)."""
        return np.sqrt(np.maximum(self.energies(q), 0.0).max(axis=-2))

    def deflections(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return every arm's largest deflection over its length, and its largest rotation, rad.

        Those (arms,) of its outboard interfaces in its own frame along q (n, N), with the way by
        which bending shortens a stiffened arm, -1/2 q' K0 q.
        """
        d, b, result = self.dim.d, self.dim.b, np.zeros((2, self.num_arms))
        for k, (part, body) in enumerate(zip(self.slices, self.arms)):
            moved = q[:, part] @ body.outboard.T
            if body.is_stiffened:
                moved -= 0.5 * (q[:, part] @ body.K0_outboard * q[:, part]).sum(axis=2).T
            moved = moved.reshape(-1, b)  # each interface
            parts = np.split(moved, [d], axis=1)
            sizes = [np.linalg.norm(x, axis=1).max(initial=0.0) for x in parts]
            length = np.linalg.norm(self.constants[k].points, axis=1).max()
            result[:, k] = sizes[0] / (length or np.inf), sizes[1]
        return result[0], result[1]

    def stiffness(self) -> np.ndarray:
        """Return the block-diagonal stiffness (N, N)."""
        return np.asarray(block_diag(*(body.K for body in self.bodies)))

    def damping(self) -> np.ndarray:
        """Return the block-diagonal damping (N, N)."""
        return np.asarray(block_diag(*(body.D for body in self.bodies)))


# -- what is between a drive and its arm: bearings, friction ---------------------------------


# Directions of a bearing that the plane has: along x, y, and about z.
IN_PLANE = [0, 1, 5]


def bearing_body(
    stiffness: Sequence[float], damping: Sequence[float], dimension: int
) -> ShapeIntegrals:
    """Return a bearing as a body: massless, its outboard interface on springs at its origin.

    Its coordinates are displacement and rotation vector of the interface in the directions that
    have a spring. Rotations are exact, whatever their size.

    Args:
        stiffness, damping: (6,) along and about x, y, z; N/m, N m/rad, N s/m, N m s/rad. Without a
            spring it is rigid in that direction.
        dimension: 2 or 3.
    """
    directions = np.array(IN_PLANE if dimension == 2 else range(6))
    k, c = np.asarray(stiffness)[directions], np.asarray(damping)[directions]
    springs = np.flatnonzero(k)
    massless = rigid_spatial_body(0.0, np.zeros(3), np.zeros(6))
    if dimension == 2:
        massless = rigid_body(0.0, np.zeros(2), 0.0, np.zeros(2))
    return replace(
        massless.in_basis(np.zeros((0, len(springs)))),
        K=np.diag(k[springs]),
        D=np.diag(c[springs]),
        outboard=np.eye(len(k))[:, springs],
    )


def with_bearings(mechanism: Mechanism, bearings: Mapping[int, ShapeIntegrals]) -> Mechanism:
    """Return the mechanism with bearings at joints, as bodies behind all others.

    A bearing sits where the joint's frame is, its axes those of the frame at the coordinate zero,
    and holds the joint.

    Args:
        mechanism: without them.
        bearings: see `bearing_body`, by the body whose joint they hold.
    """
    if not bearings:
        return mechanism
    joints, more = list(mechanism.joints), []
    d = mechanism.dim.d
    for place, k in enumerate(bearings, len(joints)):
        held = joints[k]
        name = f"bearing of {held.name}"
        more.append(replace(held, name=name, kind="fixed", coordinate=None, rotor=None))
        joints[k] = replace(held, parent=place, interface=0, origin=np.zeros(d), rotation=np.eye(d))
    return replace(
        mechanism,
        bodies=(*mechanism.bodies, *bearings.values()),
        joints=(*joints, *more),
        bearings=tuple(bearings),
    )


def moves(bearing: ShapeIntegrals) -> list[tuple[str, str]]:
    """Return name and unit of a bearing's coordinates: x, y, z in m, rx, ry, rz in rad."""
    names = ("x", "y", "z", "rx", "ry", "rz")
    every = names if len(bearing.outboard) == len(names) else [names[i] for i in IN_PLANE]
    result = [every[i] for i in bearing.outboard.argmax(axis=0)]
    return [(name, "rad" if name.startswith("r") else "m") for name in result]
