"""A plane body as MBDyn's modal element, see `dolfinopt.exchange.mbdyn`.

MBDyn makes its coupling invariants of the lumped masses; total mass, centre of mass and inertia
(group 12), modal mass, stiffness and damping are the consistent ones. With the loads and signs of
`ShapeIntegrals` group 19 is, in the plane,

    3: w3^2, K0_-ww   9: w3', -K0_wd   10, 11: a, -K0_ax, -K0_ay   13, 14, 18: f, K0_Fx, K0_Fy, K0_T

It needs the joint's `use invariant 9` for the -w^2 M q that stiffening outweighs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.exchange.mbdyn import ModalElement
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, SpatialMoments

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm
    from dolfinopt.reduction import Basis

# Nodes of two ranks that coincide to this, relative to the arm's extent, are one.
SAME_PLACE = 1e-9
# Place in MBDyn's list and sign of K0 and K0_outboard: a_x, a_y, wd, -w^2, F_x, F_y, T.
_LOADS = ((10, -1.0), (11, -1.0), (9, -1.0), (3, 1.0), (13, 1.0), (14, 1.0), (18, 1.0))


@dataclass(frozen=True, eq=False)
class LumpedNodes:
    """A whole arm's mesh nodes in the order of their places, the same on any partition.

    Attributes:
        points: (n, 2) m.
        masses: (n,) row sums of the mass matrix, kg.
        modes: (n, 2, q).
    """

    points: np.ndarray
    masses: np.ndarray
    modes: np.ndarray


def lumped_nodes(arm: ElasticArm, basis: Basis) -> LumpedNodes | None:
    """Collect an arm's nodes on the first of its ranks (collective there); None elsewhere."""
    masses = arm.mass_times(np.ones((len(arm.points), 2, 1)))[:, 0, 0]
    pieces = arm.comm.gather((arm.points, masses, basis.V), root=0)
    if pieces is None:
        return None
    points, masses, modes = (np.concatenate(part) for part in zip(*pieces, strict=True))
    rounded = np.round(points / (SAME_PLACE * np.ptp(points, axis=0).max())) + 0.0  # no -0
    # Sorted by x, then y. Nodes that ranks share have several shares of mass and the same motion.
    _, kept, place = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    total = np.bincount(place.ravel(), weights=masses)
    return LumpedNodes(points[kept], total, modes[kept])


def modal_element(
    body: ShapeIntegrals, moments: SpatialMoments, nodes: LumpedNodes, thickness: float
) -> ModalElement:
    """Return the element: node 1 is the inboard joint, 2 the outboard interface, then the mesh.

    The interfaces are points without mass that move as the interfaces do. Mesh nodes have the row
    sums of the mass matrix, and t^2 / 12 of it about x and y; plane elements have no rotations.

    Args:
        body: reduced.
        moments: of the same design.
        nodes: the same.
        thickness: t, m.
    """
    count, q = len(nodes.points) + 2, body.num_modes
    points, modes, lumped = np.zeros((count, 3)), np.zeros((count, 6, q)), np.zeros((count, 6))
    points[1, :2], points[2:, :2] = body.outboard_point, nodes.points
    modes[1, [0, 1, 5]], modes[2:, :2] = body.outboard, nodes.modes
    lumped[2:, :3] = nodes.masses[:, None]
    lumped[2:, 3:5] = nodes.masses[:, None] * thickness**2 / 12.0
    centre = np.array([*(body.moment / body.mass), 0.0])
    (xx, xy), (_, yy) = moments.second
    inertia = np.diag([yy + moments.depth, xx + moments.depth, body.inertia])
    inertia[0, 1] = inertia[1, 0] = -xy
    inertia -= body.mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    loads, stiffening = _stiffening(body)
    return ModalElement(
        labels=tuple(str(k) for k in range(1, count + 1)),
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
    )


def _stiffening(body: ShapeIntegrals) -> tuple[np.ndarray, np.ndarray]:
    """Return places (k,) and matrices (k, q, q) of group 19; k = 0 of a linear body."""
    K0 = np.concatenate([body.K0, body.K0_outboard])
    places, signs = np.array(_LOADS[: len(K0)]).reshape(-1, 2).T
    order = np.argsort(places)
    return places[order].astype(int), (signs[:, None, None] * K0)[order]
