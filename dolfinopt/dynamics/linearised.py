"""A machine's equations linearised about its motion at one instant.

The equations of motion r(y, y', y'', t) = u, with y the free rigid coordinates, those of the arms
and of motors behind springs, give M dy'' + D dy' + K dy = du with the derivatives of r at the
simulated motion. In a closed loop g(y) = 0 the motion has fewer coordinates z,

    dy = N dz,   N = (1, S) of independent and dependent coordinates,   G_d S = -G_i,   G = dg/dy,

and N moves with it: dy' = N dz' + N' dz, dy'' = N dz'' + 2 N' dz' + N'' dz. The multipliers drop
out of N^T times the equations. Of redundant equations G_d has more rows than columns.
Source: Shabana, Dynamics of Multibody Systems (2020), ch. 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import qr

from dolfinopt.dynamics.machine_instants import MachineState
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.measured import POLE_STEP
from dolfinopt.errors import InputError
from dolfinopt.multibody.closures import ClosedLoops
from dolfinopt.multibody.ranks import rank

# Differences of sixth order: a function's value and first two derivatives from those at OFFSETS.
OFFSETS = np.arange(-3.0, 4.0)
POWERS = np.vander(OFFSETS, 3, increasing=True) / [1.0, 1.0, 2.0]
DIFFERENCES = np.linalg.inv(np.vander(OFFSETS, increasing=True))[:3] * [[1.0], [1.0], [2.0]]


@dataclass(frozen=True, eq=False)
class Linearised:
    """M dy'' + D dy' + K dy = du of a machine at one instant, and the motions that loops leave.

    Attributes:
        system: with free rigid coordinates.
        t: the instant (1,), s.
        rates: y, y', y'' (3, S).
        K, D, M: (S, S) over all unknowns, those of multipliers included.
    """

    system: MachineSystem
    t: np.ndarray
    rates: np.ndarray
    K: np.ndarray
    D: np.ndarray
    M: np.ndarray

    @cached_property
    def state(self) -> MachineState:
        """The machine there."""
        return self.system.at(self.t).state(*self.rates[:, None])

    @cached_property
    def motion(self) -> np.ndarray:
        """All coordinates of the mechanism, their rates and accelerations (3, C)."""
        motion = self.state.motion
        rigid = np.concatenate([motion.q, motion.qd, motion.qdd])
        return np.hstack([rigid, np.concatenate(self.state.elastic)])

    def loops(self, poses: np.ndarray) -> ClosedLoops:
        """Return the closed loops at poses (n, C)."""
        assert self.system.loops is not None
        rigid = self.system.mechanism.num_rigid
        return self.system.loops.at(self.system.mechanism, poses[:, :rigid], poses[:, rigid:])

    @cached_property
    def to_rates(self) -> tuple[np.ndarray, np.ndarray]:
        """Weights (7, 3) that move coordinates by rates, (3, 7) that differentiate, in time."""
        rigid = self.system.mechanism.num_rigid
        speed, rate = self._size(self.motion[1:, :rigid].T, self.motion[1:, rigid:].T)
        step = POLE_STEP / max(speed + np.sqrt(rate), POLE_STEP)  # s
        powers = step ** np.arange(3.0)
        return POWERS * powers, DIFFERENCES / powers[:, None]

    @cached_property
    def constraints(self) -> np.ndarray:
        """G = dg/dy and its first and second rate along the motion (3, m, S)."""
        _, moving, last = self.system.ends
        result = np.zeros((3, last - moving, self.system.num_coordinates))
        if self.system.loops is not None:
            move, differentiate = self.to_rates
            G = self.loops(move @ self.motion).jacobian[:, :, self.system.columns]
            result[:, :, :moving] = np.tensordot(differentiate, G, 1)
        return result

    @cached_property
    def dependent(self) -> np.ndarray:
        """As many unknowns as G has independent rows, which follow from the others."""
        # Joints without a drive first; loops that rigid arms would lock take elastic coordinates.
        R, joints = self.system.ends[0], np.flatnonzero(~self.system.drives.driven)
        G = self.constraints[0]
        elastic = G[:, self.system.elastic_columns]
        scale = np.abs(elastic).max(initial=0.0) or 1.0
        missing = rank(np.hstack([G[:, :R], elastic / scale])) - len(joints)
        if missing <= 0:
            return joints
        left = np.linalg.qr(G[:, joints], mode="complete")[0][:, len(joints) :]
        order = qr(left.T @ elastic, mode="r", pivoting=True)[1]
        return np.concatenate([joints, R + order[:missing]])

    @cached_property
    def independent(self) -> np.ndarray:
        """The others (n,), without multipliers."""
        _, moving, last = self.system.ends
        every = np.arange(self.system.num_coordinates)
        return np.setdiff1d(every, [*range(moving, last), *self.dependent])

    @cached_property
    def directions(self) -> np.ndarray:
        """N, N' and N'' (3, S, n), see the module; the identity without a loop."""
        d, i = self.dependent, self.independent
        result = np.zeros((3, self.system.num_coordinates, len(i)))
        result[0, i, np.arange(len(i))] = 1.0
        G, Gd, Gdd = self.constraints
        N, Nd, Ndd = result
        inverse = np.linalg.pinv(G[:, d])
        N[d] = -inverse @ G @ N
        Nd[d] = -inverse @ Gd @ N
        Ndd[d] = -inverse @ (Gdd @ N + 2.0 * Gd @ Nd)
        return result

    @cached_property
    def reduced(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stiffness, damping and mass (n, n) of the independent coordinates."""
        N, Nd, Ndd = self.directions
        K = self.M @ Ndd + self.D @ Nd + self.K @ N
        return N.T @ K, N.T @ (2.0 * self.M @ Nd + self.D @ N), N.T @ self.M @ N

    def accelerations(self, forces: np.ndarray) -> np.ndarray:
        """Return those of the independent coordinates by forces on them, (n, k) both.

        Raises:
            InputError: a coordinate has no mass.
        """
        M = self.reduced[2]
        scale = 1.0 / np.sqrt(np.abs(np.diag(M)) + np.finfo(float).tiny)
        scaled = scale[:, None] * M * scale
        if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e14:
            raise InputError(
                f"linearised at {self.t[0]:g} s a coordinate has no mass, so that its acceleration "
                "is not determined; give motors behind springs a rotor_inertia, carts before a "
                "bearing a cart_mass, and bearings no stiffness about their joint's own axis: "
                "gear_stiffness is the spring there"
            )
        result: np.ndarray = scale[:, None] * np.linalg.solve(scaled, scale[:, None] * forces)
        return result

    @cached_property
    def A(self) -> np.ndarray:
        """The matrix (2 n, 2 n) of dx' = A dx."""
        K, D, _ = self.reduced
        return np.vstack(
            [np.eye(len(K), 2 * len(K), len(K)), -self.accelerations(np.hstack([K, D]))]
        )

    def size(self, displaced: np.ndarray) -> np.ndarray:
        """Return how far columns of displacements (S, k) move or turn frames, m or rad."""
        R, moving, last = self.system.ends
        rigid = np.concatenate([displaced[:R], displaced[last:]])
        return self._size(rigid, displaced[R:moving])

    def _size(self, rigid: np.ndarray, elastic: np.ndarray) -> np.ndarray:
        mechanism = self.system.mechanism
        parts = zip(mechanism.bodies, mechanism.slices, strict=True)
        moved = [rigid, *(body.outboard @ elastic[part] for body, part in parts)]
        return np.abs(np.concatenate(moved)).max(axis=0, initial=0.0)


def linearised(system: MachineSystem, t: float, rates: tuple[np.ndarray, ...]) -> Linearised:
    """Return the derivatives of a machine's equations at an instant t, s; rates (1, S) each."""
    at = np.array([t])
    matrix = system.at(at).linearise(*rates).dense()[0]
    return Linearised(system, at, np.concatenate(rates), *np.split(matrix, 3, axis=1))
