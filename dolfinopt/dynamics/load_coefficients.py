"""What loads every body along a motion: by its frame's acceleration, from outboard, by its modes.

With the stiffness K u = f of one arm in nodal displacements, the loads of an instant are

    f = L c,   L = [M 1_x, M 1_y, M S X, M X, F_x, F_y, T, M V, M S V],
    c = -(a_x, a_y, wd, -w^2, F_x, F_y, T, qdd - w^2 q, wd q + 2 w qd),

the inertia of the frame's acceleration and rotation, unit force and moment at the outboard
interface, and the inertia of the elastic motion, its Coriolis and centrifugal parts included. An
elastic coordinate that never moves feels any of them through its own row: it is given that one
load alone, and its residual is -c. So c, and its derivatives, follow from the equations of motion
as they are, whatever drives or closes the machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.multibody.inverse_dynamics import Rates, body_loads
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, in_basis

UNIT_LOADS = 7  # of frame and outboard interface, in the plane


def num_loads(num_modes: int) -> int:
    """Return the number of entries of c of a body with so many modes."""
    return UNIT_LOADS + 2 * num_modes


def load_coefficients(
    system: ElasticSystem | MachineSystem,
    t: np.ndarray,
    rates: Rates,
    motion: RigidMotion | None = None,
) -> list[np.ndarray]:
    """Return c (n, 7 + 2 q) of every body, see above; m/s2, 1/s2, N, N m and modes per s2.

    Args:
        system: what moves.
        t: (n,) instants, s.
        rates: its unknowns and their derivatives there, each (n, S).
        motion: its rigid coordinates there, if they are known: of prescribed ones a short cut.
    """
    if isinstance(system, ElasticSystem) and motion is not None:
        found = []
        loads = body_loads(system.mechanism, motion, rates)
        for (p, w), part in zip(loads, system.mechanism.slices, strict=True):
            (q, qd, qdd), w, wd = (x[:, part] for x in rates), w[:, None], p[:, 2, None]
            found.append(-np.hstack([p, qdd - w * w * q, wd * q + 2.0 * w * qd]))
        return found
    probe = _Probe(system)
    rows = probe.system.at(t).residual(*(probe.spread(x) for x in rates))
    return [-rows[:, part] for part in probe.places]


@dataclass(frozen=True, eq=False)
class LoadGradient:
    """Derivatives of a function of the load coefficients.

    Attributes:
        by_rates: (3, n, S) by the system's unknowns and their derivatives.
        by_bodies: by the shape integrals of every body, unknowns held.
    """

    by_rates: np.ndarray
    by_bodies: list[ShapeIntegrals]


def load_gradient(
    system: ElasticSystem | MachineSystem,
    t: np.ndarray,
    rates: Rates,
    by_coefficients: Sequence[np.ndarray],
) -> LoadGradient:
    """Differentiate a function of `load_coefficients`, given its derivatives by them.

    Args:
        system, t, rates: as there.
        by_coefficients: (n, 7 + 2 q) of every body.
    """
    probe = _Probe(system)
    at = tuple(probe.spread(x) for x in rates)
    multipliers = np.zeros((len(t), probe.system.num_coordinates))
    for part, by in zip(probe.places, by_coefficients, strict=True):
        multipliers[:, part] = -by
    tangent = probe.system.at(t).linearise(*at)
    by_rates = np.stack(tangent.transposed(multipliers))[:, :, probe.own]
    y, yd, ydd = at
    wide = probe.system.body_gradient(t, y, yd, ydd, multipliers)
    parts = [
        in_basis(by, np.eye(by.num_modes)[:, : body.num_modes])
        for by, body in zip(wide, system.mechanism.bodies, strict=True)
    ]
    return LoadGradient(by_rates, parts)


class _Probe:
    """A system whose bodies have a coordinate more for every load, which stays at zero.

    Attributes:
        system: the larger one.
        own: (S,) places of the system's unknowns among its.
        places: of the added coordinates of every body.
    """

    def __init__(self, system: ElasticSystem | MachineSystem):
        mechanism = system.mechanism
        first = system.elastic_columns.start or 0
        own = list(range(first))
        self.places: list[slice] = []
        end = first
        for body in mechanism.bodies:
            q, more = body.num_modes, num_loads(body.num_modes)
            own += range(end, end + q)
            self.places.append(slice(end + q, end + q + more))
            end += q + more
        rest = system.num_coordinates - first - mechanism.num_coordinates
        self.own = np.array([*own, *range(end, end + rest)], dtype=int)
        self._size = end + rest
        wide = replace(mechanism, bodies=tuple(map(_with_probes, mechanism.bodies)))
        self.system = replace(system, mechanism=wide)

    def spread(self, x: np.ndarray) -> np.ndarray:
        """Return the larger system's unknowns (n, S + ...) of the system's (n, S)."""
        out = np.zeros((len(x), self._size))
        out[:, self.own] = x
        return out


def _with_probes(body: ShapeIntegrals) -> ShapeIntegrals:
    """Return the body with one coordinate more for every entry of c, which alone loads it."""
    q, more = body.num_modes, num_loads(body.num_modes)
    wide = in_basis(body, np.eye(q, q + more))
    w, W, outboard, K = wide.w.copy(), wide.W.copy(), wide.outboard.copy(), wide.K.copy()
    k = 1 + q + np.arange(more)  # beside the reference position and the modes
    w[0, k[0]] = w[1, k[1]] = 1.0  # C
    W[1, k[2], 0], W[1, 0, k[2]] = 1.0, -1.0  # r
    W[0, k[3], 0] = W[0, 0, k[3]] = 1.0  # j
    outboard[[0, 1, 2], q + np.array([4, 5, 6])] = 1.0
    modes, radial, around = 1 + np.arange(q), k[7 : 7 + q], k[7 + q :]
    W[0, radial, modes] = W[0, modes, radial] = 1.0  # M
    W[1, around, modes], W[1, modes, around] = 1.0, -1.0  # G
    K[k - 1, k - 1] = 1.0  # nothing moves them, but K is to be regular
    return replace(wide, w=w, W=W, outboard=outboard, K=K)
