"""Modes of one arm: natural vibrations with what it carries, buckling under its static stress.

Buckling: with all loads of an instant grown by a factor, their directions kept, the lowest positive
lambda of

    (K + lambda K0) phi = 0

is the factor at which the arm is no longer stable. It is clamped at its inboard interface; the
outboard ones are rigid and move freely, as in the reduction. Nothing else in the chain holds it:
what is beyond only loads it. Plane arms buckle in their plane.
Source: Cook, Malkus, Plesha & Witt, Concepts and Applications of Finite Element Analysis (2002),
ch. 18; Wallrapp & Schwertassek (1991), doi:10.1002/nme.1620320818.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy.linalg import eigh

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.fem.stress import Prestress
from dolfinopt.multibody.newton_euler import outward_pass
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.rotations import ONE, skew
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, rigid_spatial_body
from dolfinopt.multibody.tree import Mechanism
from dolfinopt.reduction.eigenproblem import Pencil, largest_eigenpairs, lowest_eigenpairs

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm

# -- what an arm carries ---------------------------------------------------------------------


class Carried(Protocol):
    """What an arm carries at its outboard interface; equal ones compare as equal."""

    def matrix(self) -> np.ndarray:
        """Return the inertia under displacements and rotations of the interface."""


@dataclass(frozen=True)
class RigidIntegrals:
    """Mass, first moment and inertia of something rigid about the origin of its frame.

    Attributes:
        mass: m, kg.
        moment: int X as a complex number x + i y, kg m.
        inertia: int X . X, kg m2.
    """

    mass: float
    moment: complex
    inertia: float

    def __add__(self, other: RigidIntegrals) -> RigidIntegrals:
        return RigidIntegrals(
            self.mass + other.mass, self.moment + other.moment, self.inertia + other.inertia
        )

    def rotated(self, angle: float) -> RigidIntegrals:
        """Return the same in a frame from which this one is turned by `angle`, rad."""
        return RigidIntegrals(self.mass, self.moment * np.exp(1j * angle), self.inertia)

    def shifted(self, lever: complex) -> RigidIntegrals:
        """Return the same about a point from which this frame's origin lies at `lever`, m."""
        first = self.moment + self.mass * lever
        second = self.inertia + 2.0 * (np.conj(lever) * self.moment).real
        return RigidIntegrals(self.mass, first, second + self.mass * abs(lever) ** 2)

    def matrix(self) -> np.ndarray:
        """Return the inertia (3, 3) under displacements (u_x, u_y, theta) of the origin."""
        m, c = self.mass, self.moment
        return np.array(
            [[m, 0.0, -c.imag], [0.0, m, c.real], [-c.imag, c.real, self.inertia]], dtype=float
        )


def rigid_integrals(arm: ElasticArm) -> RigidIntegrals:
    """Integrate the mass of an arm's design (collective on its ranks)."""
    X = arm.points
    fields = arm.mass_times(np.stack([np.ones_like(X), X], axis=2))
    second = np.sum(X * fields[:, :, 1])
    parts = np.array([fields[:, 0, 0].sum(), *fields[:, :, 1].sum(axis=0), second])
    mass, x, y, inertia = arm.comm.allreduce(parts)
    return RigidIntegrals(float(mass), complex(x, y), float(inertia))


@dataclass(frozen=True)
class Chain:
    """Bodies from the cart outwards, frozen at given joint angles, and what is fixed to them.

    Attributes:
        bodies: of every arm, in its own frame.
        outboard_points: (arms,) of every arm, complex, m.
        angles: (arms,) joint angle inboard of every arm, rad; the first one has no effect.
        loads: (arms,) at every outboard point: motor and bearing of the joint, payload.
        kind: "rigid-body", "point-mass" or "none", see `carried`.
    """

    bodies: Sequence[RigidIntegrals]
    outboard_points: Sequence[complex]
    angles: Sequence[float]
    loads: Sequence[RigidIntegrals]
    kind: str

    def carried(self) -> list[RigidIntegrals]:
        """Return what every arm carries, about its outboard point and in its own frame.

        "rigid-body": everything outboard, frozen. "point-mass": its mass alone. "none": nothing.
        """
        load = self.loads[-1]
        found = [load]
        for k in reversed(range(1, len(self.bodies))):
            load = (self.bodies[k] + load.shifted(self.outboard_points[k])).rotated(self.angles[k])
            load = load + self.loads[k - 1]
            found.append(load)
        return [self._kept(load) for load in reversed(found)]

    def _kept(self, load: RigidIntegrals) -> RigidIntegrals:
        if self.kind == "rigid-body":
            return load
        return RigidIntegrals(load.mass if self.kind == "point-mass" else 0.0, 0j, 0.0)

    def cotangents(self, by_carried: Sequence[np.ndarray]) -> list[RigidIntegrals]:
        """Return the derivatives by every body's integrals from those by `carried` matrices (3, 3).

        The transpose of `carried`: outwards, as every arm is part of what those before it carry.
        """
        cotangent = RigidIntegrals(0.0, 0j, 0.0)
        found = [cotangent]
        for k in range(1, len(self.bodies)):
            cotangent = cotangent + self._kept(_of_matrix(by_carried[k - 1]))
            cotangent = cotangent.rotated(-self.angles[k])
            found.append(cotangent)
            cotangent = _of_shifted(cotangent, self.outboard_points[k])
        return found


def _of_matrix(by_matrix: np.ndarray) -> RigidIntegrals:
    """Return derivatives by mass, moment, inertia from those by `RigidIntegrals.matrix`."""
    g = by_matrix + by_matrix.T
    return RigidIntegrals(
        float(by_matrix[0, 0] + by_matrix[1, 1]), complex(g[1, 2], -g[0, 2]), float(by_matrix[2, 2])
    )


def _of_shifted(by_shifted: RigidIntegrals, lever: complex) -> RigidIntegrals:
    """Return derivatives by a body's integrals from those by its `shifted` ones."""
    moment, inertia = by_shifted.moment, by_shifted.inertia
    mass = by_shifted.mass + (np.conj(moment) * lever).real + inertia * abs(lever) ** 2
    return RigidIntegrals(float(mass), moment + 2.0 * inertia * lever, inertia)


# -- the arm by itself -----------------------------------------------------------------------

RITZ_VECTORS = 4  # in space bending in two planes comes in pairs
EIGENVALUE_CHANGE = 1e-5  # relative, of the first one, after which no more iterations are made
SUBSPACE_ITERATIONS = 50  # two to four are enough unless the arm has many modes of one frequency


def full_first_frequency(arm: ElasticArm, V: np.ndarray, K_r: np.ndarray, M_r: np.ndarray) -> float:
    """Return the first natural frequency of the full clamped-free arm, Hz (collective).

    Subspace iteration, Z <- K^-1 M Z with Rayleigh's and Ritz' values of Z, from the lowest modes
    of the reduced model. Every iteration lowers the value and leaves (lambda_1 / lambda_5)^2 of
    its error; with the factorisation at hand it costs a solve for each vector.
    Source: Parlett, The Symmetric Eigenvalue Problem (1998), doi:10.1137/1.9781611971163, ch. 14.

    Args:
        arm: with its design set.
        V: (n_nodes, d, q) reduced basis.
        K_r, M_r: (q, q) reduced stiffness and mass.
    """
    count = min(len(K_r), RITZ_VECTORS)
    values, vectors = _agreed(arm, *eigh(K_r, M_r, subset_by_index=[0, count - 1]))
    loads = arm.mass_times(V @ vectors)
    for _ in range(SUBSPACE_ITERATIONS):
        Z = arm.static_response(*arm.restrict(loads))
        MZ = arm.mass_times(Z)
        flat = Z.reshape(-1, count).T
        products = flat @ np.stack([loads, MZ]).reshape(2, -1, count)
        K, M = arm.comm.allreduce(products) if arm.comm.size > 1 else products
        before = values[0]
        values, vectors = _agreed(arm, *eigh(0.5 * (K + K.T), 0.5 * (M + M.T)))
        if before - values[0] <= EIGENVALUE_CHANGE * values[0]:
            break
        loads = MZ @ vectors
    return float(np.sqrt(max(values[0], 0.0)) / (2.0 * np.pi))


def _agreed(arm: ElasticArm, *pairs: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the eigenpairs of the arm's first rank on all: processors may round differently."""
    return arm.comm.bcast(pairs, root=0) if arm.comm.size > 1 else pairs


# -- modes -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LoadedModes:
    """The lowest modes of one clamped-free arm with a mass at its outboard interface.

    Attributes:
        values: (k,) squared angular frequencies, rad2/s2, ascending.
        field: (n_nodes, 2, k) nodal values, orthonormal in mass and carried mass together.
        outboard: (3, k) displacements of the outboard interface.
        start: (owned rows, k) initial guess for the next design; the followed mode comes first.
        followed: index of the mode most like the first column of the start.
    """

    values: np.ndarray
    field: np.ndarray
    outboard: np.ndarray
    start: np.ndarray
    followed: int

    @property
    def frequency(self) -> float:
        """The first natural frequency, Hz."""
        return float(np.sqrt(max(self.values[0], 0.0)) / (2.0 * np.pi))


def loaded_modes(
    arm: ElasticArm, carried: Carried, count: int, start: np.ndarray | None
) -> LoadedModes:
    """Return the lowest modes of T'KT phi = lambda (T'MT + carried mass) phi.

    Modes are matched with the first of the design before by the modal assurance criterion
    MAC = (phi' M psi)^2 / ((phi' M phi) (psi' M psi)), so that a mode can be followed when others
    cross it. Source: Allemang & Brown (1982), Proc. 1st IMAC, 110-116.

    Args:
        arm: with its design set.
        carried: about the outboard point.
        count: number of modes.
        start: `LoadedModes.start` of a nearby design, or None.
    """
    pencil = Pencil(arm, is_free=True, carried=carried.matrix())
    count = min(count, arm.num_dofs)
    values, vectors = lowest_eigenpairs(pencil, count, start)
    followed = 0
    if start is not None and start.shape[1] > 0:
        overlap = pencil.total(vectors.T @ pencil.mass(start[:, :1]))[:, 0]
        followed = int(np.argmax(overlap**2))
    interior, outboard = pencil.split(vectors)
    order = [followed, *(k for k in range(count) if k != followed)]
    field = arm.expand(interior, outboard)
    return LoadedModes(values, field, outboard, vectors[:, order], followed)


# -- a machine in space frozen in one pose: what every body carries at its interfaces --------


@dataclass(frozen=True)
class CarriedInertia:
    """Inertia of what is rigid under displacements and rotations of interfaces.

    Attributes:
        entries: of the matrix (b, b), row by row; kg, kg m, kg m2. b is 6 of every interface.
    """

    entries: tuple[float, ...]

    def matrix(self) -> np.ndarray:
        """Return it as (b, b)."""
        size = math.isqrt(len(self.entries))
        return np.array(self.entries).reshape(size, size)


def mass_matrix(body: ShapeIntegrals) -> np.ndarray:
    """Return the inertia (6, 6) of a rigid body under displacement and rotation of its origin."""
    G, c = body.W[:, 0, 0].reshape(3, 3), skew(body.w[:, 0])
    return np.block([[body.mass * ONE, -c], [c, np.trace(G) * ONE - G]])


def by_integrals(by_matrix: np.ndarray) -> ShapeIntegrals:
    """Return the derivatives by a rigid body's integrals from those by its `mass_matrix`."""
    mixed, turning = by_matrix[3:, :3] - by_matrix[:3, 3:], by_matrix[3:, 3:]
    first = np.array([mixed[k, j] - mixed[j, k] for j, k in ((1, 2), (2, 0), (0, 1))])
    second = np.trace(turning) * ONE - turning
    zero = rigid_spatial_body(0.0, np.zeros(3), np.zeros(6))
    mass = float(np.trace(by_matrix[:3, :3]))
    return replace(zero, mass=mass, w=first[:, None], W=second.reshape(9, 1, 1))


@dataclass(frozen=True, eq=False)
class FrozenTree:
    """Rigid bodies in one pose.

    Attributes:
        mechanism: of rigid bodies.
        motion: joints at one instant.
        kind: "rigid-body" everything outboard, "point-mass" its mass alone, "none" nothing.
    """

    mechanism: Mechanism
    motion: RigidMotion
    kind: str

    @cached_property
    def _steps(self) -> list[np.ndarray]:
        """Motion of every body's frame by that of the interface that it hangs on (6, 6)."""
        none, units = np.zeros((1, 0)), np.eye(6)[:, :, None]
        found = []
        for link in outward_pass(self.mechanism, self.motion, (none, none, none)):
            found.append(link.joint.load_on_carrier(units)[:, :, 0].T)
        return found

    def _shift(self, body: int, interface: int) -> np.ndarray:
        """Return the motion of a body's interface by that of its frame (6, 6)."""
        shift = np.eye(6)
        shift[:3, 3:] = -skew(self.mechanism.bodies[body].points[interface])
        return shift

    def _beyond(self, body: int, interface: int) -> list[tuple[int, np.ndarray]]:
        """Return the bodies outboard of an interface, and their motion by that of it."""
        found: list[tuple[int, np.ndarray]] = []
        for i in self.mechanism.hanging.get((body, interface), ()):
            own = self._steps[i]
            found.append((i, own))
            for s in self.mechanism.sites[i]:
                shift = self._shift(i, s) @ own
                found += [(j, T @ shift) for j, T in self._beyond(i, s)]
        return found

    def _loads_beyond(
        self, body: int, interface: int
    ) -> Iterator[tuple[ShapeIntegrals, np.ndarray]]:
        """Yield what is carried at an interface and outboard of it, and its motion likewise."""
        sites = [((body, interface), np.eye(6))]
        for i, T in self._beyond(body, interface):
            sites += [((i, s), self._shift(i, s) @ T) for s in self.mechanism.sites[i]]
        for site, T in sites:
            if site in self.mechanism.loads:
                yield self.mechanism.loads[site].body, T
            for k in self.mechanism.hanging[site]:
                if (rotor := self._rotor(k)) is not None:
                    yield rotor, T

    def _rotor(self, body: int) -> ShapeIntegrals | None:
        """Return the rotor of a body's joint in the frame of the interface that carries it."""
        joint = self.mechanism.joints[body]
        if joint.rotor is None:
            return None
        n = joint.rotation @ joint.axis
        x, y, z = np.outer(n, n) * joint.rotor.inertia
        return rigid_spatial_body(0.0, np.zeros(3), (x[0], y[1], z[2], x[1], x[2], y[2]))

    def carried(self) -> list[CarriedInertia]:
        """Return what every body carries, about its interfaces' points, in its own frame."""
        found = []
        for k, body in enumerate(self.mechanism.bodies):
            size = 6 * len(body.points)
            whole = np.zeros((size, size))
            for s in self.mechanism.sites[k]:
                M = np.zeros((6, 6))
                for i, T in self._beyond(k, s):
                    M += T.T @ mass_matrix(self.mechanism.bodies[i]) @ T
                for load, T in self._loads_beyond(k, s):
                    M += T.T @ mass_matrix(load) @ T
                place = slice(6 * s, 6 * s + 6)
                whole[place, place] = self._kept(M)
            found.append(CarriedInertia(tuple(whole.ravel().tolist())))
        return found

    def _kept(self, M: np.ndarray) -> np.ndarray:
        if self.kind == "rigid-body":
            return M
        out = np.zeros((6, 6))
        if self.kind == "point-mass":
            out[:3, :3] = M[0, 0] * ONE
        return out

    def _kept_transposed(self, by_kept: np.ndarray) -> np.ndarray:
        if self.kind == "rigid-body":
            return by_kept
        out = np.zeros((6, 6))
        if self.kind == "point-mass":
            out[0, 0] = np.trace(by_kept[:3, :3])
        return out

    def cotangents(self, by_carried: Sequence[np.ndarray]) -> list[ShapeIntegrals]:
        """Return the derivatives by every body's integrals from those by `carried` (b, b)."""
        by_matrix: dict[int, np.ndarray] = {}
        for k, by in enumerate(by_carried):
            for s in self.mechanism.sites[k] if by.any() else ():
                place = slice(6 * s, 6 * s + 6)
                inner = self._kept_transposed(by[place, place])
                for i, T in self._beyond(k, s):
                    by_matrix[i] = by_matrix.get(i, np.zeros((6, 6))) + T @ inner @ T.T
        zero, bodies = np.zeros((6, 6)), range(len(self.mechanism.bodies))
        return [by_integrals(by_matrix.get(i, zero)) for i in bodies]


def rigid_integrals_in_space(arm: ElasticArm) -> ShapeIntegrals:
    """Integrate the mass of a solid arm's design (collective on its ranks)."""
    MX = arm.rigid_inertia[:, :, 1]
    parts = np.concatenate(
        [[arm.rigid_inertia[:, 0, 0].sum()], MX.sum(axis=0), (arm.points.T @ MX).ravel()]
    )
    parts = arm.comm.allreduce(parts)
    second = parts[4:].reshape(3, 3)
    second = 0.5 * (second + second.T)
    centred = np.trace(second) * ONE - second  # about the origin, its mass there
    inertia = centred[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    points = arm.mesh.outboard_point, arm.mesh.further_points
    body = rigid_spatial_body(0.0, np.zeros(3), inertia, *points)
    return replace(body, mass=float(parts[0]), w=parts[1:4, None])


# -- buckling of one arm under the static stress of an instant -------------------------------


@dataclass(frozen=True, eq=False)
class BucklingModes:
    """The first modes to buckle.

    Attributes:
        inverse: (k,) mu = 1 / lambda = -phi'K0 phi, descending; negative where nothing buckles.
        field: (n_nodes, d, k) phi, phi'K phi = 1.
    """

    inverse: np.ndarray
    field: np.ndarray


# Residuals of mu, relative to the energy of a mode: of a first search, and of what counts. Under
# tension alone all mu crowd below zero: of 100 x 10 cells the first takes 22 solves for four modes,
# the second 2 266. Modes that follow far behind crowd as well.
ROUGHLY, TOLERANCE = 1e-4, 1e-9
COUNTS = 0.4  # of the largest mu, above which others count


def buckling_modes(stress: Prestress, count: int, least: float = 0.0) -> BucklingModes:
    """Return the first modes of K phi + lambda K0 phi = 0 (collective on the arm's ranks).

    The largest mu of -K0 phi = mu K phi, with the factor of the interior at hand; those that are
    much smaller than the largest are left out.

    Args:
        stress: of one instant.
        count: number of modes at most.
        least: mu below which nothing buckles: modes are rough then.

    Raises:
        ConvergenceError: they do not converge.
    """
    arm, pencil = stress.arm, Pencil(stress.arm, is_free=True)
    K0, D = stress.matrix(), stress.rotation[:, 0]
    dim = arm.mesh.dim

    def softened(rows: np.ndarray) -> np.ndarray:
        """Return -T'K0T times columns."""
        field, outboard = pencil.field(rows), pencil.split(rows)[1]
        flat = field.reshape(len(field), -1)  # K0 is the same in all directions
        inner, lower = arm.restrict((K0 @ flat).reshape(field.shape))
        turned = np.zeros((len(D), len(outboard) // len(D), outboard.shape[1]))
        turned[:, dim:] = D @ outboard.reshape(turned.shape)[:, dim:]
        return -pencil.joined(inner, lower + turned.reshape(outboard.shape))

    inverse, rows = largest_eigenpairs(pencil, softened, count, ROUGHLY)
    counts = int(np.count_nonzero(inverse > max(COUNTS * inverse[0], least)))
    if counts:
        near = rows[:, :counts]
        inverse, rows = largest_eigenpairs(pencil, softened, counts, TOLERANCE, near)
    return BucklingModes(inverse, pencil.field(rows))
