"""Natural vibrations of one arm with what it carries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import eigh

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.reduction.eigenproblem import lowest_eigenpairs
from dolfinopt.reduction.free_arm import FreeArm, FreeOperators

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
    free, loads = FreeArm(arm), arm.mass_times(V @ vectors)
    for _ in range(SUBSPACE_ITERATIONS):
        Z = free.solve(arm.restrict(loads))
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
    operator = FreeOperators(arm, carried.matrix())
    count = min(count, arm.num_dofs)
    values, vectors = lowest_eigenpairs(operator.pencil, count, start)
    followed = 0
    if start is not None and start.shape[1] > 0:
        overlap = arm.comm.allreduce(vectors.T @ operator.mass_times(start[:, 0]))
        followed = int(np.argmax(overlap**2))
    interior, outboard = operator.split(vectors)
    order = [followed, *(k for k in range(count) if k != followed)]
    field = arm.expand(interior, outboard)
    return LoadedModes(values, field, outboard, vectors[:, order], followed)
