"""A body as MBDyn's modal element, see `dolfinopt.exchange.mbdyn`.

What couples modes and motion are, of a body in space, the invariants of its finite elements' mass,
and the nodes are its interfaces alone: the joint must not say `use invariant 9`. Of a plane body
they are the lumped masses of its mesh nodes, of which MBDyn makes its invariants; with geometric
stiffness the joint needs `use invariant 9`, for the -w^2 M q that stiffening outweighs. Total mass,
centre of mass and inertia (group 12), modal mass, stiffness and damping are the consistent ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.exchange.mbdyn import Invariants, ModalElement
from dolfinopt.multibody.measured import SAME_NODE_SHARE
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.mechanism import ONE, PERMUTATION
from dolfinopt.multibody.standard_input import centrifugal, outboard_interfaces, turning

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm
    from dolfinopt.reduction import Basis


@dataclass(frozen=True, eq=False)
class LumpedNodes:
    """A whole plane arm's mesh nodes in the order of their places, the same on any partition.

    Attributes:
        points: (n, 3) m.
        masses: (n, 6) row sums of the mass matrix, kg, and t^2 / 12 of it about x and y, kg m2;
            plane elements have no rotations.
        modes: (n, 6, q).
    """

    points: np.ndarray
    masses: np.ndarray
    modes: np.ndarray


def lumped_nodes(arm: ElasticArm, basis: Basis, thickness: float) -> LumpedNodes | None:
    """Collect an arm's nodes on the first of its ranks (collective there); None elsewhere.

    Args:
        arm: in the plane, with its design set.
        basis: of that design.
        thickness: t, m.
    """
    rows = arm.mass_times(np.ones((len(arm.points), 2, 1)))[:, 0, 0]
    pieces = arm.comm.gather((arm.points, rows, basis.V), root=0)
    if pieces is None:
        return None
    places, rows, V = (np.concatenate(part) for part in zip(*pieces, strict=True))
    rounded = np.round(places / (SAME_NODE_SHARE * np.ptp(places, axis=0).max())) + 0.0  # no -0
    # Sorted by x, then y. Nodes that ranks share have several shares of mass and the same motion.
    _, kept, place = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    total = np.bincount(place.ravel(), weights=rows)
    turning_mass = total * thickness**2 / 12.0
    points, modes = np.zeros((len(kept), 3)), np.zeros((len(kept), 6, V.shape[2]))
    points[:, :2], modes[:, :2] = places[kept], V[kept]
    masses = np.stack([total, total, total, turning_mass, turning_mass, 0.0 * total], axis=1)
    return LumpedNodes(points, masses, modes)


def modal_element(body: ShapeIntegrals, nodes: LumpedNodes | None = None) -> ModalElement:
    """Return the element: node 1 is the inboard joint, then the outboard interfaces, then `nodes`.

    The interfaces are points without mass that move as the interfaces do.

    Args:
        body: reduced, in space; a plane one is brought there by `in_space`.
        nodes: of a plane arm's mesh; None: with invariants instead.
    """
    q = body.num_modes
    places, shapes, K0 = zip(*outboard_interfaces(body), strict=True)
    points, modes = np.stack([np.zeros(3), *places]), np.stack([np.zeros((6, q)), *shapes])
    lumped = None
    if nodes is not None:
        lumped = np.concatenate([np.zeros((len(points), 6)), nodes.masses])
        points, modes = np.concatenate([points, nodes.points]), np.concatenate([modes, nodes.modes])
    centre, inertia = body.inertia_about_centre()
    loads, stiffening = _stiffening(body, np.concatenate(K0))
    return ModalElement(
        labels=tuple(str(k) for k in range(1, len(points) + 1)),
        points=points,
        modes=modes,
        M=body.M,
        K=body.K,
        D=body.D,
        lumped=lumped,
        mass=body.mass,
        centre=centre,
        inertia=inertia,
        loads=loads,
        stiffening=stiffening,
        invariants=_invariants(body) if nodes is None else None,
    )


def _invariants(body: ShapeIntegrals) -> Invariants:
    q = body.num_modes
    W = body.W.reshape(3, 3, 1 + q, 1 + q)
    first, mixed = W[:, :, 0, 1:], W[:, :, 1:, 1:]  # int X_a Phi_b, int Phi_a Phi_b
    return Invariants(
        three=body.w[:, 1:],
        four=np.einsum("cab,abj->cj", PERMUTATION, first),
        five=np.einsum("cab,abjk->cjk", PERMUTATION, mixed),
        eight=-_double_cross(first),
        nine=_double_cross(mixed),
    )


def _double_cross(moments: np.ndarray) -> np.ndarray:
    """Return int u~ v~ = int v u' - u . v of the integrals int u_a v_b (3, 3, ...)."""
    trace = np.einsum("aa...,ij->ij...", moments, ONE)
    return moments.swapaxes(0, 1) - trace


def _stiffening(body: ShapeIntegrals, outboard: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return places (k,) and matrices (k, q, q) of group 19, without those that are zero."""
    q = body.num_modes
    if not body.is_stiffened:
        return np.zeros(0, dtype=int), np.zeros((0, q, q))
    rotation = body.K0[3:].reshape(3, 3, q, q)
    inertial = [centrifugal(rotation), turning(rotation), body.K0[:3].transpose(1, 2, 0)]
    matrices = [0.0 - np.moveaxis(one, -1, 0) for one in inertial]
    found = np.concatenate([*matrices, outboard])
    acting = found.any(axis=(1, 2))
    return 1 + np.flatnonzero(acting), found[acting]
