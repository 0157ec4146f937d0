"""What closes the loops of a tree of bodies: constraints between interfaces, or with the ground.

A closure ties the frame a, an outboard interface of a body, to the joint's frame b on another
interface or on the ground. Its equations are made of three kinds, each with its force on both:

    along     e . (p_a - p_b) = 0       e fixed to b
    facing    l u . v = 0               u fixed to a, v to b; l a length, so that all are in m
    distance  |p_a - p_b| - L = 0       L constant, or a rigid coordinate: a cylinder

    kind        equations   in space                                    in the plane
    ball        3           three along
    pin         5           three along, two facing: both see the axis  two along
    slider      5           two along, three facing                     one along: it may turn
    universal   4           three along, one facing: both crosses
    rod         1           distance                                    distance

Every coordinate inboard of a site shifts it by dp and turns it by s; a coordinate further out is
turned with it, so that d2p = s x dp' and ds' = s x s': this is all there is of second order, but
for the arms' own deformation. Plane and space are one code, see `dimension`; coordinates are
ordered [rigid (R), elastic (N)], C together. Source: Featherstone, Rigid Body Dynamics Algorithms
(2008), ch. 8; Garcia de Jalon & Bayo, Kinematic and Dynamic Simulation of Multibody Systems (1994),
ch. 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.multibody.dimension import Dimension
from dolfinopt.multibody.kinematics import Posed, SiteMotion, no_gradient
from dolfinopt.multibody.ranks import least_norm
from dolfinopt.multibody.tree import Mechanism, Site

# -- equations: value, force on both frames, and how the force changes as these move -------------
#
# Changes are those by a displacement (d, ., n) and a rotation (r, ., n) of either frame; trailing
# axes of directions come before the instants.

# Loads are (2 d + 2 r, ., n), force and moment on a, then those on b; changes dp_a, s_a, dp_b, s_b
# likewise.


@dataclass(frozen=True, eq=False)
class Along:
    """e . (p_a - p_b) = 0, e (d,) in b's frame."""

    e: np.ndarray

    def value(self, a: SiteMotion, b: SiteMotion) -> np.ndarray:
        """Return it (n,), m."""
        return (b.turned(self.e) * (a.place - b.place)).sum(axis=0)

    def loads(self, a: SiteMotion, b: SiteMotion) -> np.ndarray:
        """Return its gradient as loads on both frames."""
        e, apart = b.turned(self.e), a.place - b.place
        return np.concatenate([e, np.zeros((a.dim.r, e.shape[1])), -e, a.dim.moment(e, apart)])

    def changes(self, a: SiteMotion, b: SiteMotion, moved: np.ndarray) -> np.ndarray:
        """Return how these change."""
        dim, (by_a, still, by_b, spin) = a.dim, _parts(a.dim, moved)
        e, apart = _before(b.turned(self.e), by_a), _before(a.place - b.place, by_a)
        turned = dim.velocity(spin, e)
        moment = dim.moment(turned, apart) + dim.moment(e, by_a - by_b)
        return np.concatenate([turned, np.zeros_like(still), -turned, moment])


@dataclass(frozen=True, eq=False)
class Facing:
    """length u . v = 0, u (d,) in a's frame, v (d,) in b's."""

    u: np.ndarray
    v: np.ndarray
    length: float

    def value(self, a: SiteMotion, b: SiteMotion) -> np.ndarray:
        """Return it (n,), m."""
        return self.length * (a.turned(self.u) * b.turned(self.v)).sum(axis=0)

    def loads(self, a: SiteMotion, b: SiteMotion) -> np.ndarray:
        """Return its gradient as loads on both frames."""
        moment = self.length * a.dim.moment(a.turned(self.u), b.turned(self.v))
        none = np.zeros_like(a.place)
        return np.concatenate([none, moment, none, -moment])

    def changes(self, a: SiteMotion, b: SiteMotion, moved: np.ndarray) -> np.ndarray:
        """Return how these change."""
        dim, (by_a, spin_a, _, spin_b) = a.dim, _parts(a.dim, moved)
        u, v = _before(a.turned(self.u), by_a), _before(b.turned(self.v), by_a)
        moment = dim.moment(dim.velocity(spin_a, u), v) + dim.moment(u, dim.velocity(spin_b, v))
        none, moment = np.zeros_like(by_a), self.length * moment
        return np.concatenate([none, moment, none, -moment])


@dataclass(frozen=True, eq=False)
class Distance:
    """|p_a - p_b| - L = 0, L a constant length, m, or else a rigid coordinate by its place."""

    length: float
    coordinate: int | None = None

    def value(self, a: SiteMotion, b: SiteMotion) -> np.ndarray:
        """Return it (n,), m."""
        length = self.length if self.coordinate is None else a.posed.q_r[:, self.coordinate]
        out: np.ndarray = np.linalg.norm(a.place - b.place, axis=0) - length
        return out

    def loads(self, a: SiteMotion, b: SiteMotion) -> np.ndarray:
        """Return its gradient as loads on both frames."""
        apart = a.place - b.place
        n, none = apart / np.linalg.norm(apart, axis=0), np.zeros((a.dim.r, apart.shape[1]))
        return np.concatenate([n, none, -n, none])

    def changes(self, a: SiteMotion, b: SiteMotion, moved: np.ndarray) -> np.ndarray:
        """Return how these change."""
        by_a, spin, by_b, _ = _parts(a.dim, moved)
        apart = _before(a.place - b.place, by_a)
        size = np.linalg.norm(apart, axis=0)
        n, by = apart / size, by_a - by_b
        turned = (by - n * (n * by).sum(axis=0)) / size
        none = np.zeros_like(spin)
        return np.concatenate([turned, none, -turned, none])


Equation = Along | Facing | Distance


def _parts(dim: Dimension, moved: np.ndarray) -> list[np.ndarray]:
    """Return displacement and rotation of either frame."""
    return np.split(moved, [dim.d, dim.b, dim.b + dim.d])


def _before(x: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return x (d, n) with axes for the directions of (d, ..., n)."""
    return x.reshape(len(x), *(1,) * (like.ndim - 2), x.shape[-1])


# -- closures ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Tie:
    """One closure.

    Attributes:
        name: of it.
        a: the interface that it holds.
        b: the interface it is tied to; None: the ground.
        point: (d,) of the joint's frame in b's frame, m.
        rotation: (d, d) of the joint's frame.
        equations: all of them.
    """

    name: str
    a: Site
    b: Site | None
    point: np.ndarray
    rotation: np.ndarray
    equations: tuple[Equation, ...]

    @property
    def is_rod(self) -> bool:
        """Whether its frames are apart."""
        return isinstance(self.equations[0], Distance)


@dataclass(frozen=True, eq=False)
class Loops:
    """All closures of a machine, k equations; every one has its multiplier.

    Attributes:
        ties: the closures.
    """

    ties: tuple[Tie, ...] = ()

    @property
    def count(self) -> int:
        """Number k of equations."""
        return sum(len(tie.equations) for tie in self.ties)

    @cached_property
    def equations(self) -> tuple[Equation, ...]:
        """Those of all closures."""
        return tuple(one for tie in self.ties for one in tie.equations)

    @cached_property
    def lengths(self) -> np.ndarray:
        """By what (k,) a multiplier is a moment, m; 1 of forces."""
        return np.array([one.length if isinstance(one, Facing) else 1.0 for one in self.equations])

    def by_tie(self, values: np.ndarray) -> list[float]:
        """Return the norm of every closure's part of values (k,) of the equations."""
        ends = np.cumsum([len(tie.equations) for tie in self.ties])[:-1]
        return [float(np.linalg.norm(part)) for part in np.split(values, ends)]

    def reactions(self, multipliers: np.ndarray) -> np.ndarray:
        """Return forces and moments on the first frames, N and N m, of multipliers (n, k)."""
        out: np.ndarray = multipliers * self.lengths
        return out

    def at(self, mechanism: Mechanism, q_r: np.ndarray, q: np.ndarray) -> ClosedLoops:
        """Return them at n poses, q_r (n, R) and q (n, N)."""
        return ClosedLoops(self, Posed(mechanism, q_r, q))


class ClosedLoops:
    """Closures at n poses: gaps, Jacobian, forces and what they depend on."""

    def __init__(self, loops: Loops, posed: Posed) -> None:
        """Take them and the poses."""
        self.loops, self.posed = loops, posed
        dim = posed.mechanism.dim
        one, none = np.eye(dim.d), np.zeros(dim.d)
        self._sites = [
            (
                SiteMotion(posed, tie.a, none, one),
                SiteMotion(posed, tie.b, tie.point, tie.rotation),
            )
            for tie in loops.ties
        ]

    @property
    def places(self) -> np.ndarray:
        """Where both frames of every closure are (n, closures, 2, d), m."""
        pairs = [np.stack([a.place.T, b.place.T], axis=1) for a, b in self._sites]
        return np.stack(pairs, axis=1)

    @property
    def _equations(self) -> list[tuple[Equation, SiteMotion, SiteMotion]]:
        pairs = zip(self.loops.ties, self._sites, strict=True)
        return [(one, a, b) for tie, (a, b) in pairs for one in tie.equations]

    @cached_property
    def gap(self) -> np.ndarray:
        """The equations (n, k), m."""
        out = np.empty((len(self.posed.q), self.loops.count))
        for k, (one, a, b) in enumerate(self._equations):
            out[:, k] = one.value(a, b)
        return out

    @cached_property
    def jacobian(self) -> np.ndarray:
        """Their derivatives by all coordinates (n, k, C)."""
        size = self.posed.mechanism.num_rigid + self.posed.q.shape[1]
        out = np.empty((len(self.posed.q), self.loops.count, size))
        for k, (one, a, b) in enumerate(self._equations):
            on_a, on_b = np.split(one.loads(a, b), 2)
            out[:, k] = a.generalised_force(on_a) + b.generalised_force(on_b)
            if isinstance(one, Distance) and one.coordinate is not None:
                out[:, k, one.coordinate] -= 1.0
        return out

    def generalised_force(self, multipliers: np.ndarray) -> np.ndarray:
        """Return what the closures' forces of multipliers (n, k) do on every coordinate (n, C)."""
        out: np.ndarray = np.einsum("nk,nkc->nc", multipliers, self.jacobian)
        return out

    def closing(self, forces: np.ndarray, dependent: np.ndarray) -> np.ndarray:
        """Return the multipliers (n, k) of least norm that give what joints that follow need.

        Args:
            forces: (n, R) of inverse dynamics without closures.
            dependent: the joints that follow, rigid coordinates; at most k.
        """
        J = self.jacobian[:, :, dependent]
        return least_norm(J.swapaxes(1, 2), forces[:, dependent])

    def interface_loads(self, multipliers: np.ndarray) -> dict[Site, np.ndarray]:
        """Return what interfaces give to the closures, force and moment in their components."""
        found: dict[Site, np.ndarray] = {}
        for sites, loads in zip(self._sites, self._loads(multipliers), strict=True):
            for site, load in zip(sites, np.split(loads, 2), strict=True):
                if not site.way:
                    continue
                end = site.way[-1]
                own = site.load_on(*self.posed.interface(*end), -load)
                found[end] = own + found[end] if end in found else own
        return found

    def _loads(
        self, multipliers: np.ndarray, moved: Sequence[np.ndarray] | None = None
    ) -> list[np.ndarray]:
        """Return the loads of every closure on its two frames, or their change as frames move."""
        weights, found = iter(multipliers.T), []
        for k, (tie, sites) in enumerate(zip(self.loops.ties, self._sites, strict=True)):
            every = [
                one.loads(*sites) if moved is None else one.changes(*sites, moved[k])
                for one in tie.equations
            ]
            found.append(np.sum([next(weights) * loads for loads in every], axis=0))
        return found

    def hessian(self, multipliers: np.ndarray) -> np.ndarray:
        """Return the derivative of `generalised_force` by all coordinates (n, C, C)."""
        moved = [np.concatenate([a.by, b.by]) for a, b in self._sites]
        every = self._loads(multipliers), moved, self._loads(multipliers, moved)
        size, count = self.posed.mechanism.num_rigid + self.posed.q.shape[1], len(self.posed.q)
        found = np.zeros((count, size, size))
        for sites, loads, by, changed in zip(self._sites, *every, strict=True):
            found += np.einsum("bjn,bin->nji", by, changed)
            for site, load in zip(sites, np.split(loads, 2), strict=True):
                if site.way:
                    found += site.hessian(load)
        return found

    def acceleration(self, rates: np.ndarray) -> np.ndarray:
        """Return what rates (n, R) of rigid bodies add to the second derivatives (n, k), m/s2.

        The power g' of unit loads on moving frames, differentiated.
        """
        found = []
        moved = self._along(rates)
        bias = [
            np.concatenate([*a.acceleration(rates), *b.acceleration(rates)]) for a, b in self._sites
        ]
        for tie, sites, v, a in zip(self.loops.ties, self._sites, moved, bias, strict=True):
            for one in tie.equations:
                power = one.changes(*sites, v) * v + one.loads(*sites) * a
                found.append(power.sum(axis=0))
        return np.stack(found, axis=1) if found else np.zeros((len(rates), 0))

    def gradient(
        self, weights: np.ndarray, multipliers: np.ndarray, virtual: np.ndarray
    ) -> list[dict[str, np.ndarray]]:
        """Return the derivative of sum_n weights_n . gap_n + work_n(multipliers) . virtual_n.

        Args:
            weights, multipliers: (n, k).
            virtual: (n, C) displacements of all coordinates.

        Returns:
            Of every body, by its outboard modes (b, q) and K0_outboard (b, q, q).
        """
        found, moved = no_gradient(self.posed.mechanism), self._along(virtual)
        every = self._loads(weights), self._loads(multipliers), self._loads(multipliers, moved)
        for sites, *loads in zip(self._sites, *every, strict=True):
            for site, *own in zip(sites, *(np.split(one, 2) for one in loads), strict=True):
                site.add_gradient(found, *own, virtual)
        return found

    def _along(self, virtual: np.ndarray) -> list[np.ndarray]:
        """Return displacement and rotation of every closure's frames."""
        return [np.concatenate([a.along(virtual), b.along(virtual)]) for a, b in self._sites]
