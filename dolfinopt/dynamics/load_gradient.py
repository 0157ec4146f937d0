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

import numpy as np

from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.multibody.dimension import DIMENSIONS
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals


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


def load_gradient(
    system: MachineSystem,
    t: np.ndarray,
    rates: Rates,
    by_coefficients: Sequence[np.ndarray],
    is_corrected: bool,
) -> tuple[np.ndarray, np.ndarray | None, list[ShapeIntegrals]]:
    """Differentiate a function of `load_coefficients`, given its derivatives by them.

    Args:
        system: what moves.
        t: (n,) instants, s.
        rates: its unknowns and their derivatives there, each (n, S).
        by_coefficients: (n, 7 + 2 q or 18 + 9 q) of every body.
        is_corrected: whether the motion of the joints follows the bodies.

    Returns:
        By the unknowns and their derivatives (3, n, S); by the rigid coordinates that the motion
        prescribes and theirs (3, n, R) where these are corrected; by every body's integrals,
        unknowns held.
    """
    probed = ProbedSystem(system)
    multipliers = np.zeros((len(t), probed.system.num_coordinates))
    for part, by in zip(probed.places, by_coefficients, strict=True):
        multipliers[:, part] = -by
    y, yd, ydd = (probed.spread(x) for x in rates)
    instants = probed.system.at(t)
    by_rates = np.stack(instants.linearise(y, yd, ydd).transposed(multipliers))
    state = instants.state(y, yd, ydd)
    by_motion = None
    if is_corrected:
        by_command = state.by_command(np.arange(system.mechanism.num_rigid))
        by_motion = np.einsum("ns,nsrk->knr", multipliers, by_command)
    wide = state.body_gradient(multipliers)
    by_bodies = [
        by.in_basis(np.eye(by.num_modes)[:, : body.num_modes])
        for by, body in zip(wide, system.mechanism.bodies, strict=True)
    ]
    return by_rates[:, :, probed.own], by_motion, by_bodies


class ProbedSystem:
    """A system whose bodies have a coordinate more for every load, which stays at zero.

    Attributes:
        system: with these coordinates.
        places: of the added ones of every body among all.
        own: (S,) places of the coordinates that it had.
    """

    def __init__(self, system: MachineSystem) -> None:
        """Add them behind every body's own."""
        bodies = tuple(map(_with_probes, system.mechanism.bodies))
        self.system = replace(system, mechanism=replace(system.mechanism, bodies=bodies))
        pairs = zip(self.system.body_columns, system.mechanism.bodies, strict=True)
        self.places = [slice(part.start + body.num_modes, part.stop) for part, body in pairs]
        added = np.zeros(self.system.num_coordinates, dtype=bool)
        for part in self.places:
            added[part] = True
        self.own = np.flatnonzero(~added)

    def spread(self, x: np.ndarray) -> np.ndarray:
        """Return the larger system's unknowns (n, S + ...) of the system's (n, S)."""
        out = np.zeros((len(x), self.system.num_coordinates))
        out[:, self.own] = x
        return out


def _with_probes(body: ShapeIntegrals) -> ShapeIntegrals:
    """Return the body with one coordinate more for every entry of c, which alone loads it."""
    q, counts, (d, _) = body.num_modes, load_counts(body), body.w.shape
    dim, b = DIMENSIONS[d], counts.outboard
    wide = body.in_basis(np.eye(q, q + counts.total))
    w, W, outboard, K = wide.w.copy(), wide.W.copy(), wide.outboard.copy(), wide.K.copy()
    k = 1 + q + np.arange(counts.total)  # beside the reference position and the modes
    frame, on_interfaces, elastic = np.split(k, [counts.frame, counts.frame + b])
    by_component = np.empty_like(frame)
    by_component[dim.loads] = frame
    w[np.arange(d), by_component[:d]] = 1.0
    # W_c of a coordinate and the rest is that of the rest and the coordinate, transposed.
    transposed, columns = dim.transposed(np.eye(dim.g)), np.arange(1 + q)
    for c, own in enumerate(elastic.reshape(dim.g, q)):
        rows = np.append(by_component[d + c], own)
        W[c, rows, columns] = 1.0
        W[:, columns, rows] += transposed[:, c, None]
    outboard[np.arange(b), on_interfaces - 1] = 1.0
    K[k - 1, k - 1] = 1.0  # nothing moves them, but K is to be regular
    return replace(wide, w=w, W=W, outboard=outboard, K=K)
