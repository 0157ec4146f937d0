"""Derivatives of what loads every body along a motion.

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
from typing import Any

import numpy as np

from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.multibody.dimension import SPACE
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals
from dolfinopt.multibody.tree import Mechanism


@dataclass(frozen=True)
class LoadCounts:
    """How many entries of c a body has, in their order.

    Attributes:
        frame: of the frame's acceleration and rotation: 4, in space 12.
        outboard: force and moment at the outboard interfaces: 3, in space 6 of each.
        elastic: of the inertia of the elastic motion: 2 q, in space 9 q.
    """

    frame: int
    outboard: int
    elastic: int

    @property
    def total(self) -> int:
        """All of them: 7 + 2 q, in space 18 + 9 q."""
        return self.frame + self.outboard + self.elastic


def load_counts(body: ShapeIntegrals) -> LoadCounts:
    """Return the numbers of entries of c of a body."""
    (d, _), g = body.w.shape, len(body.W)
    return LoadCounts(d + g, len(body.outboard), g * body.num_modes)


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
    system: MachineSystem,
    t: np.ndarray,
    rates: Rates,
    by_coefficients: Sequence[np.ndarray],
) -> LoadGradient:
    """Differentiate a function of `load_coefficients`, given its derivatives by them.

    Args:
        system: what moves.
        t: (n,) instants, s.
        rates: its unknowns and their derivatives there, each (n, S).
        by_coefficients: (n, 7 + 2 q or 18 + 9 q) of every body.
    """
    probe = _Probe(system)
    at = tuple(probe.spread(x) for x in rates)
    multipliers = np.zeros((len(t), probe.system.num_coordinates))
    for part, by in zip(probe.places, by_coefficients, strict=True):
        multipliers[:, part] = -by
    instants = probe.system.at(t)
    tangent = instants.linearise(*at)
    by_rates = np.stack(tangent.transposed(multipliers))[:, :, probe.own]
    wide = instants.state(*at).body_gradient(multipliers)
    parts = [
        by.in_basis(np.eye(by.num_modes)[:, : body.num_modes])
        for by, body in zip(wide, system.mechanism.bodies, strict=True)
    ]
    return LoadGradient(by_rates, parts)


class _Probe:
    """A system whose bodies have a coordinate more for every load, which stays at zero."""

    def __init__(self, system: MachineSystem):
        mechanism: Mechanism = system.mechanism
        first = system.elastic_columns.start or 0
        own = list(range(first))
        self.places: list[slice] = []
        end = first
        for body in mechanism.bodies:
            q, more = body.num_modes, load_counts(body).total
            own += range(end, end + q)
            self.places.append(slice(end + q, end + q + more))
            end += q + more
        rest = system.num_coordinates - first - mechanism.num_coordinates
        # (S,) places of the system's unknowns among its; `places` are the added ones of every body.
        self.own = np.array([*own, *range(end, end + rest)], dtype=int)
        self._size = end + rest
        bodies = tuple(map(_with_probes, mechanism.bodies))
        change: dict[str, Any] = {"mechanism": replace(mechanism, bodies=bodies)}
        self.system: Any = replace(system, **change)

    def spread(self, x: np.ndarray) -> np.ndarray:
        """Return the larger system's unknowns (n, S + ...) of the system's (n, S)."""
        out = np.zeros((len(x), self._size))
        out[:, self.own] = x
        return out


def _with_probes(body: ShapeIntegrals) -> ShapeIntegrals:
    """Return the body with one coordinate more for every entry of c, which alone loads it."""
    q, more = body.num_modes, load_counts(body).total
    wide = body.in_basis(np.eye(q, q + more))
    w, W, outboard, K = wide.w.copy(), wide.W.copy(), wide.outboard.copy(), wide.K.copy()
    k = 1 + q + np.arange(more)  # beside the reference position and the modes
    if len(body.W) == SPACE.g:
        _probe_space(w, W, outboard, k)
        K[k - 1, k - 1] = 1.0  # nothing moves them, but K is to be regular
        return replace(wide, w=w, W=W, outboard=outboard, K=K)
    w[0, k[0]] = w[1, k[1]] = 1.0  # C
    W[1, k[2], 0], W[1, 0, k[2]] = 1.0, -1.0  # r
    W[0, k[3], 0] = W[0, 0, k[3]] = 1.0  # j
    outboard[[0, 1, 2], q + np.array([4, 5, 6])] = 1.0
    modes, radial, around = 1 + np.arange(q), k[7 : 7 + q], k[7 + q :]
    W[0, radial, modes] = W[0, modes, radial] = 1.0  # M
    W[1, around, modes], W[1, modes, around] = 1.0, -1.0  # G
    K[k - 1, k - 1] = 1.0  # nothing moves them, but K is to be regular
    return replace(wide, w=w, W=W, outboard=outboard, K=K)


def _probe_space(w: np.ndarray, W: np.ndarray, outboard: np.ndarray, k: np.ndarray) -> None:
    """Give the coordinates k of a spatial body one load each, in the order of c."""
    b = len(outboard)
    q = (len(k) - 12 - b) // 9
    partners = np.arange(9).reshape(3, 3).T.ravel()  # W_ba = W_ab'
    w[np.arange(3), k[:3]] = 1.0
    for ab in range(9):
        at = k[3 + ab]
        W[ab, at, 0] = W[partners[ab], 0, at] = 1.0
        first = 12 + b + ab * q
        own, modes = k[first : first + q], 1 + np.arange(q)
        W[ab, own, modes] = W[partners[ab], modes, own] = 1.0
    outboard[np.arange(b), k[12 : 12 + b] - 1] = 1.0
