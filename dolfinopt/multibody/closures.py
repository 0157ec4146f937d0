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

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.multibody.dimension import Dimension
from dolfinopt.multibody.kinematics import Posed, SiteMotion, no_gradient
from dolfinopt.multibody.ranks import least_norm
from dolfinopt.multibody.tree import Mechanism, Site

# -- equations: value, force on both frames, and how the force changes as these move -------------
#
# Loads are (2 d + 2 r, n), force and moment on a, then those on b. Changes are those by m moves of
# both frames, dp_a, s_a, dp_b, s_b (2 d + 2 r, m, n).


@dataclass(frozen=True, eq=False)
class Along:
    """e . (p_a - p_b) = 0, e (d,) in b's frame."""

    e: np.ndarray

    def value(self, a: SiteMotion, b: SiteMotion) -> np.ndarray:
        """Return it (n,), m."""
        return (b.turned(self.e) * (a.place - b.place)).sum(axis=0)

    def loads(self, a: SiteMotion, b: SiteMotion) -> np.ndarray:
        """Return its gradient as loads on both frames."""
        e = b.turned(self.e)
        return _pair(a.dim, e, a.dim.moment(e, a.place - b.place))

    def changes(self, a: SiteMotion, b: SiteMotion, moved: np.ndarray) -> np.ndarray:
        """Return how these change."""
        dim, (by_a, _, by_b, spin) = a.dim, _parts(a.dim, moved)
        e, apart = b.turned(self.e)[:, None], (a.place - b.place)[:, None]
        turned = dim.velocity(spin, e)
        return _pair(dim, turned, dim.moment(turned, apart) + dim.moment(e, by_a - by_b))


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
        return _pair(a.dim, np.zeros_like(a.place), -moment, moment)

    def changes(self, a: SiteMotion, b: SiteMotion, moved: np.ndarray) -> np.ndarray:
        """Return how these change."""
        dim, (by_a, spin_a, _, spin_b) = a.dim, _parts(a.dim, moved)
        u, v = a.turned(self.u)[:, None], b.turned(self.v)[:, None]
        moment = dim.moment(dim.velocity(spin_a, u), v) + dim.moment(u, dim.velocity(spin_b, v))
        moment *= self.length
        return _pair(dim, np.zeros_like(by_a), -moment, moment)


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
        return _pair(a.dim, apart / np.linalg.norm(apart, axis=0))

    def changes(self, a: SiteMotion, b: SiteMotion, moved: np.ndarray) -> np.ndarray:
        """Return how these change."""
        by_a, _, by_b, _ = _parts(a.dim, moved)
        apart, by = (a.place - b.place)[:, None], by_a - by_b
        size = np.linalg.norm(apart, axis=0)
        n = apart / size
        return _pair(a.dim, (by - n * (n * by).sum(axis=0)) / size)


Equation = Along | Facing | Distance


def _parts(dim: Dimension, moved: np.ndarray) -> list[np.ndarray]:
    """Return displacement and rotation of either frame."""
    return np.split(moved, [dim.d, dim.b, dim.b + dim.d])


def _pair(
    dim: Dimension,
    force: np.ndarray,
    moment: np.ndarray | float = 0.0,
    on_a: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return a force on a and its opposite on b, there with a moment, and one on a."""
    none = np.zeros((dim.r, *force.shape[1:]))
    return np.concatenate([force, none + on_a, -force, none + moment])


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

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of every equation's force or moment."""
        return tuple("N m" if isinstance(equation, Facing) else "N" for equation in self.equations)


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
        return tuple(equation for tie in self.ties for equation in tie.equations)

    @cached_property
    def lengths(self) -> np.ndarray:
        """By what (k,) a multiplier is a moment, m; 1 of forces."""
        return np.array(
            [
                equation.length if isinstance(equation, Facing) else 1.0
                for equation in self.equations
            ]
        )

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Return every closure's part of values (..., k) of the equations."""
        ends = np.cumsum([len(tie.equations) for tie in self.ties])
        return np.split(values, ends, axis=-1)[: len(self.ties)]

    def by_tie(self, values: np.ndarray) -> list[float]:
        """Return the norm of every closure's part of values (k,)."""
        return [float(np.linalg.norm(part)) for part in self.split(values)]

    def reactions(self, multipliers: np.ndarray) -> np.ndarray:
        """Return forces and moments on the first frames, N and N m, of multipliers (n, k)."""
        out: np.ndarray = multipliers * self.lengths
        return out

    def at(self, mechanism: Mechanism, q_r: np.ndarray, q: np.ndarray) -> ClosedLoops:
        """Return them at n poses, q_r (n, R) and q (n, N)."""
        return ClosedLoops(self, Posed(mechanism, q_r, q))


class ClosedTie:
    """One closure at n poses; loads and moves of its two frames are (2 d + 2 r, ., n)."""

    def __init__(self, tie: Tie, posed: Posed) -> None:
        """Take it and the poses."""
        dim, self.equations = posed.mechanism.dim, tie.equations
        on_a = SiteMotion(posed, tie.a, np.zeros(dim.d), np.eye(dim.d))
        self.sites = on_a, SiteMotion(posed, tie.b, tie.point, tie.rotation)
        self.by = np.concatenate([site.by for site in self.sites])

    @cached_property
    def loads(self) -> np.ndarray:
        """Loads of the m equations on both frames (2 b, m, n)."""
        return np.stack([equation.loads(*self.sites) for equation in self.equations], axis=1)

    @property
    def jacobian(self) -> np.ndarray:
        """Derivatives of the equations by all coordinates (n, m, C)."""
        out: np.ndarray = np.einsum("bmn,bcn->nmc", self.loads, self.by)
        for k, equation in enumerate(self.equations):
            if isinstance(equation, Distance) and equation.coordinate is not None:
                out[:, k, equation.coordinate] -= 1.0
        return out

    def loads_of(self, multipliers: np.ndarray) -> list[np.ndarray]:
        """Return force and moment (b, n) of multipliers (n, m) on either frame."""
        return np.split(np.einsum("bmn,nm->bn", self.loads, multipliers), 2)

    def changes(self, multipliers: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return how these change by moves of both frames (2 b, ., n)."""
        pairs = zip(multipliers.T, self.equations, strict=True)
        return np.sum([w * item.changes(*self.sites, moved) for w, item in pairs], axis=0)

    def along(self, virtual: np.ndarray) -> np.ndarray:
        """Return how both frames move by virtual coordinates (2 b, 1, n)."""
        return np.asarray(np.einsum("bcn,nc->bn", self.by, virtual)[:, None])

    def hessian(self, multipliers: np.ndarray) -> np.ndarray:
        """Return the derivative of the generalised force by all coordinates (n, C, C)."""
        changed = self.changes(multipliers, self.by)
        result: np.ndarray = np.einsum("bjn,bin->nji", self.by, changed)
        pairs = zip(self.sites, self.loads_of(multipliers), strict=True)
        return result + sum(site.hessian(load) for site, load in pairs if site.way)

    def acceleration(self, rates: np.ndarray) -> np.ndarray:
        """Return what rates (n, R) of rigid bodies add to the second derivatives (n, m), m/s2.

        The power g' of unit loads on moving frames, differentiated.
        """
        v, bias = self.along(rates), [x for site in self.sites for x in site.acceleration(rates)]
        turned = np.concatenate(
            [equation.changes(*self.sites, v) for equation in self.equations], axis=1
        )
        power = turned * v + self.loads * np.concatenate(bias)[:, None]
        return np.asarray(power.sum(axis=0).T)


class ClosedLoops:
    """Closures at n poses: gaps, Jacobian, forces and what they depend on."""

    def __init__(self, loops: Loops, posed: Posed) -> None:
        """Take them and the poses."""
        self.loops, self.posed = loops, posed
        self.ties = [ClosedTie(tie, posed) for tie in loops.ties]

    @property
    def places(self) -> np.ndarray:
        """Where both frames of every closure are (n, closures, 2, d), m."""
        every = [[site.place for site in tie.sites] for tie in self.ties]
        return np.moveaxis(np.array(every), -1, 0)

    @cached_property
    def gap(self) -> np.ndarray:
        """The equations (n, k), m."""
        rows = [equation.value(*tie.sites) for tie in self.ties for equation in tie.equations]
        return np.reshape(rows, (len(rows), len(self.posed.q))).T

    @cached_property
    def jacobian(self) -> np.ndarray:
        """Their derivatives by all coordinates (n, k, C)."""
        count, elastic = self.posed.q.shape
        none = np.zeros((count, 0, self.posed.mechanism.num_rigid + elastic))
        return np.concatenate([none, *(tie.jacobian for tie in self.ties)], axis=1)

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
        result: dict[Site, np.ndarray] = {}
        for tie, part in self._each(multipliers):
            for site, load in zip(tie.sites, tie.loads_of(part), strict=True):
                if site.way:
                    end = site.way[-1]
                    own = site.load_on(*self.posed.interface(*end), -load)
                    result[end] = own + result[end] if end in result else own
        return result

    def _each(self, multipliers: np.ndarray) -> Iterator[tuple[ClosedTie, np.ndarray]]:
        """Return every closure and its part of multipliers (n, k)."""
        return zip(self.ties, self.loops.split(multipliers), strict=True)

    def hessian(self, multipliers: np.ndarray) -> np.ndarray:
        """Return the derivative of `generalised_force` by all coordinates (n, C, C)."""
        return np.sum([tie.hessian(part) for tie, part in self._each(multipliers)], axis=0)

    def acceleration(self, rates: np.ndarray) -> np.ndarray:
        """Return what rates (n, R) of rigid bodies add to the second derivatives (n, k), m/s2."""
        none = np.zeros((len(rates), 0))
        return np.concatenate([none, *(tie.acceleration(rates) for tie in self.ties)], axis=1)

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
        result = no_gradient(self.posed.mechanism)
        for (tie, part), own in zip(self._each(multipliers), self.loops.split(weights)):
            changed = np.split(tie.changes(part, tie.along(virtual))[:, 0], 2)
            loads = tie.loads_of(own), tie.loads_of(part), changed
            for site, weight, load, change in zip(tie.sites, *loads, strict=True):
                site.add_gradient(result, weight, load, change, virtual)
        return result
