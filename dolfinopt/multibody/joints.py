"""What is between a drive and its arm: bearings that give way, friction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.multibody.shape_integrals import ShapeIntegrals

if TYPE_CHECKING:
    from dolfinopt.multibody.mechanism import Mechanism

# Directions of a bearing that the plane has: along x, y, and about z.
IN_PLANE = [0, 1, 5]


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


def bearing_body(stiffness: np.ndarray, damping: np.ndarray, dimension: int) -> ShapeIntegrals:
    """Return a bearing as a body: massless, its outboard interface on springs at its origin.

    Its coordinates are displacement and rotation vector of the interface in the directions that
    have a spring. Rotations are exact, whatever their size.

    Args:
        stiffness, damping: (6,) along and about x, y, z; N/m, N m/rad, N s/m, N m s/rad. Without a
            spring it is rigid in that direction.
        dimension: 2 or 3.
    """
    d, g = (2, 2) if dimension == 2 else (3, 9)
    directions = np.array(IN_PLANE if dimension == 2 else range(6))
    k, c = np.asarray(stiffness)[directions], np.asarray(damping)[directions]
    springs = np.flatnonzero(k)
    q = len(springs)
    return ShapeIntegrals(
        mass=0.0,
        w=np.zeros((d, 1 + q)),
        W=np.zeros((g, 1 + q, 1 + q)),
        K=np.diag(k[springs]),
        D=np.diag(c[springs]),
        outboard=np.eye(len(k))[:, springs],
        outboard_point=np.zeros(d),
        K0=np.zeros((0, q, q)),
        K0_outboard=np.zeros((0, q, q)),
        further_points=np.zeros((0, d)),
        along_modes=np.zeros((0, q, q)),
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
        more.append(replace(held, name=name, kind="fixed", coordinate=None, rotor=0.0))
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
    found = [every[i] for i in bearing.outboard.argmax(axis=0)]
    return [(name, "rad" if name.startswith("r") else "m") for name in found]
