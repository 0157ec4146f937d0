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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.fem.frames import rigid_motions
from dolfinopt.fem.stress import Prestress
from dolfinopt.multibody.dimension import DIMENSIONS, components
from dolfinopt.multibody.newton_euler import outward_pass
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.tree import Mechanism
from dolfinopt.reduction.eigenproblem import Pencil, largest_eigenpairs, lowest_eigenpairs

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
    arm: ElasticArm, carried: np.ndarray, count: int, start: np.ndarray | None
) -> LoadedModes:
    """Return the lowest modes of T'KT phi = lambda (T'MT + carried mass) phi.

    Modes are matched with the first of the design before by the modal assurance criterion
    MAC = (phi' M psi)^2 / ((phi' M phi) (psi' M psi)), so that a mode can be followed when others
    cross it. Source: Allemang & Brown (1982), Proc. 1st IMAC, 110-116.

    Args:
        arm: with its design set.
        carried: inertia (b, b) about the outboard points.
        count: number of modes.
        start: `LoadedModes.start` of a nearby design, or None.
    """
    pencil = Pencil(arm, is_free=True, carried=carried)
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


# -- a machine frozen in one pose: what every body carries at its interfaces ----------------------


def _motions(d: int) -> np.ndarray:
    """Return the tensor A (1 + d, d, b) of the rigid motions sum_p A_p (1, X)_p of points X."""
    A = rigid_motions(np.eye(1 + d, d, k=-1))
    A[1:] -= A[0]
    return A


def mass_matrix(body: ShapeIntegrals) -> np.ndarray:
    """Return the inertia (b, b) of a rigid body under displacement and rotation of its origin."""
    moments = np.tensordot(body.W[:, 0, 0], components(DIMENSIONS[len(body.w)].E), 1)
    rigid = np.block([[np.full((1, 1), body.mass), body.w[:, :1].T], [body.w[:, :1], moments]])
    A = _motions(len(body.w))
    return np.einsum("pik,qil,pq->kl", A, A, rigid)


def by_integrals(body: ShapeIntegrals, by_matrix: np.ndarray) -> ShapeIntegrals:
    """Return the derivatives by a rigid body's integrals from those by its `mass_matrix`."""
    A = _motions(len(body.w))
    by = np.einsum("pik,qil,kl->pq", A, A, by_matrix)
    by_W = np.einsum("cab,ab->c", components(DIMENSIONS[len(body.w)].E), by[1:, 1:])
    by_w = by[1:, :1] + by[:1, 1:].T
    return replace(body, mass=float(by[0, 0]), w=by_w, W=by_W[:, None, None])


@dataclass(frozen=True, eq=False)
class FrozenTree:
    """Rigid bodies in one pose, in the plane or in space; b = 3 or 6 motions of an interface.

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
        """Motion of every body's frame by that of the interface that it hangs on (b, b)."""
        none, units = np.zeros((1, 0)), np.eye(self.mechanism.dim.b)[:, :, None]
        links = outward_pass(self.mechanism, self.motion, (none, none, none))
        return [link.joint.load_on_carrier(units)[:, :, 0].T for link in links]

    def _shift(self, body: int, interface: int) -> np.ndarray:
        """Return the motion of a body's interface by that of its frame (b, b)."""
        dim, points = self.mechanism.dim, self.mechanism.constants[body].points
        shift = np.eye(dim.b)
        shift[: dim.d] = rigid_motions(points[interface : interface + 1])[0]
        return shift

    def _beyond(self, body: int, interface: int) -> list[tuple[int, np.ndarray]]:
        """Return the bodies outboard of an interface, and their motion by that of it."""
        result: list[tuple[int, np.ndarray]] = []
        for i in self.mechanism.hanging.get((body, interface), ()):
            own = self._steps[i]
            result.append((i, own))
            for s in self.mechanism.sites[i]:
                shift = self._shift(i, s) @ own
                result += [(j, T @ shift) for j, T in self._beyond(i, s)]
        return result

    def _loads_beyond(self, body: int, interface: int) -> Iterator[np.ndarray]:
        """Yield the inertia (b, b) of all loads and rotors at an interface and outboard of it."""
        mechanism = self.mechanism
        sites = [((body, interface), np.eye(mechanism.dim.b))]
        for i, T in self._beyond(body, interface):
            sites += [((i, s), self._shift(i, s) @ T) for s in mechanism.sites[i]]
        for site, T in sites:
            if site in mechanism.loads:
                yield T.T @ mass_matrix(mechanism.loads[site].body) @ T
            for joint in (mechanism.joints[k] for k in mechanism.hanging[site]):
                if joint.rotor is not None:
                    turn = mechanism.dim.rotated(joint.rotation, joint.axis) @ T[mechanism.dim.d :]
                    yield joint.rotor.inertia * np.outer(turn, turn)

    def carried(self) -> list[np.ndarray]:
        """Return the inertia that every body carries, about its interfaces, in its own frame.

        Matrices (n b, n b) under displacements and rotations of its n interfaces; kg, kg m, kg m2.
        """
        result = []
        for k, body in enumerate(self.mechanism.bodies):
            matrix = np.zeros(2 * (len(body.outboard),))
            for s in self.mechanism.sites[k]:
                M = sum(self._loads_beyond(k, s), np.zeros(2 * (self.mechanism.dim.b,)))
                for i, T in self._beyond(k, s):
                    M += T.T @ mass_matrix(self.mechanism.bodies[i]) @ T
                place = self._place(s)
                matrix[place, place] = self._kept(M)
            result.append(matrix)
        return result

    def _place(self, interface: int) -> slice:
        b = self.mechanism.dim.b
        return slice(b * interface, b * interface + b)

    def _kept(self, M: np.ndarray) -> np.ndarray:
        if self.kind == "rigid-body":
            return M
        mass = M[0, 0] if self.kind == "point-mass" else 0.0
        return mass * np.diag(np.arange(len(M)) < self.mechanism.dim.d)

    def _kept_transposed(self, by_kept: np.ndarray) -> np.ndarray:
        if self.kind == "rigid-body":
            return by_kept
        out, d = np.zeros_like(by_kept), self.mechanism.dim.d
        if self.kind == "point-mass":
            out[0, 0] = np.trace(by_kept[:d, :d])
        return out

    def cotangents(self, by_carried: Sequence[np.ndarray]) -> list[ShapeIntegrals]:
        """Return the derivatives by every body's integrals from those by `carried`."""
        b, bodies = self.mechanism.dim.b, self.mechanism.bodies
        by_matrix = np.zeros((len(bodies), b, b))
        for k, by in enumerate(by_carried):
            for s in self.mechanism.sites[k] if by.any() else ():
                inner = self._kept_transposed(by[self._place(s), self._place(s)])
                for i, T in self._beyond(k, s):
                    by_matrix[i] += T @ inner @ T.T
        return list(map(by_integrals, bodies, by_matrix))


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
