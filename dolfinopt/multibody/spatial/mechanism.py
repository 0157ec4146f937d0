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
from typing import Literal

import numpy as np

from dolfinopt.multibody.mechanism import ElasticBodies
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.rotations import ONE

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
    def num_joints(self) -> int:
        """Number of rigid coordinates."""
        return len(self.movable)

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
