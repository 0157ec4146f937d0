"""A body as MBDyn's plain-ASCII .fem file of a modal element.

Record groups of MBDyn's input manual, "Modal element": header (1), node labels (2), nodal
coordinates (5 to 7), mode shapes (8), modal mass and stiffness (9, 10), global inertia (12), modal
damping (13), and what couples the modes to the motion of the frame: either the diagonal of the
lumped mass matrix (11), of which MBDyn makes its invariants, or the invariants themselves (14 to
18), never both: MBDyn would add them up.

    14: Inv3_j = int Phi_j           15: Inv4_j = int X x Phi_j       16: Inv8_j = -int X~ Phi_j~
    17: Inv5_jk = int Phi_j x Phi_k  18: Inv9_jk = int Phi_j~ Phi_k~

Group 19, of stiffened bodies, has their number and then one matrix K_i for every load, each behind
the load's place in this list, counted from one: products of the angular velocity w1^2, w2^2, w3^2,
w1 w2, w2 w3, w3 w1, angular acceleration 1 to 3, acceleration 1 to 3 (less gravity), then force and
moment 1 to 3 of every interface node in the order of the joint's input. All in the body's frame.
MBDyn's modal rows become (M qdd + ... + K q) + sum_i p_i K_i q of its motion and - f_i K_i q of the
force and moment f that the joint exerts on the interface node.

The inboard interface, node 1, is the modal node itself; the outboard ones, nodes 2, 3, ..., must be
the joint's interface nodes in this order. MBDyn uses group 19 with `use automatic differentiation;`
in the control data. Interfaces move linearly in q: the displacement of the second order,
-1/2 q'K0 q, is not in this format.

Of a body in space what couples modes and motion are the invariants of its finite elements' mass,
and the nodes are its interfaces alone: the joint must not say `use invariant 9`. Of a plane body
they are the lumped masses of its mesh nodes, of which MBDyn makes its invariants; with geometric
stiffness the joint needs `use invariant 9`, for the -w^2 M q that stiffening outweighs. Total mass,
centre of mass and inertia (group 12), modal mass, stiffness and damping are the consistent ones.
Source: Masarati, MBDyn input file format, and the reader in MBDyn's mbdyn/struct/modal.cc, of
group 19 modalad.cc.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dolfinopt.data import filled
from dolfinopt.disk import write_text
from dolfinopt.exchange.measured import SAME_NODE_SHARE
from dolfinopt.exchange.standard_input import about, centrifugal, turning
from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.multibody.rotations import PERMUTATION
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
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
    points, modes = np.zeros((len(kept), 3)), np.zeros((len(kept), 6, V.shape[2]))
    points[:, :2], modes[:, :2] = places[kept], V[kept]
    turning_share = thickness**2 / 12.0
    masses = np.outer(total, [1.0, 1.0, 1.0, turning_share, turning_share, 0.0])
    return LumpedNodes(points, masses, modes)


@dataclass(frozen=True, eq=False)
class ModalElement:
    """A flexible body as MBDyn reads it.

    Node 1 is the inboard joint, then come the outboard interfaces, points without mass that move as
    the interfaces do, then the mesh nodes of a plane arm.

    Attributes:
        body: in space.
        points: (n, 3) m, of the nodes.
        modes: (n, 6, q) three translations and three rotations of every node.
        lumped: (n, 6) mass (three times, kg) and moments of inertia (kg m2) of every node; None:
            with invariants instead.
        stiffening: (q, q) by the places of the loads in group 19's list, ascending, MBDyn's signs;
            none of a linear body.
    """

    body: ShapeIntegrals
    points: np.ndarray
    modes: np.ndarray
    lumped: np.ndarray | None
    stiffening: Mapping[int, np.ndarray]

    @property
    def invariants(self) -> dict[int, np.ndarray]:
        """Integrals over the mass that couple modes and motion, by their groups, as files have."""
        if self.lumped is not None:
            return {}
        q = self.body.num_modes
        W = self.body.W.reshape(3, 3, 1 + q, 1 + q)
        first, mixed = W[:, :, 1:, 0], W[:, :, 1:, 1:]  # int Phi_a X_b, int Phi_a Phi_b
        return {
            14: self.body.w[:, 1:],
            15: turning(first).T,
            16: about(first).transpose(0, 2, 1),
            17: np.einsum("cab,abjk->cjk", PERMUTATION, mixed),
            18: -about(mixed.swapaxes(0, 1)).transpose(0, 2, 3, 1),
        }


def modal_element(body: ShapeIntegrals, nodes: LumpedNodes | None = None) -> ModalElement:
    """Return the element of a body.

    Args:
        body: reduced, in space; a plane one is brought there by `in_space`.
        nodes: of a plane arm's mesh; None: with invariants instead.
    """
    points, q = np.vstack([np.zeros(3), body.points]), body.num_modes
    modes, lumped = np.vstack([np.zeros((6, q)), body.outboard]).reshape(len(points), 6, q), None
    if nodes is not None:
        lumped = np.concatenate([np.zeros((len(points), 6)), nodes.masses])
        points, modes = np.concatenate([points, nodes.points]), np.concatenate([modes, nodes.modes])
    return ModalElement(body, points, modes, lumped, _stiffening(body))


def _stiffening(body: ShapeIntegrals) -> dict[int, np.ndarray]:
    """Return the matrices (q, q) of group 19 by their loads, without those that are zero."""
    if not body.is_stiffened:
        return {}
    q = body.num_modes
    rotation = body.K0[3:].reshape(3, 3, q, q)
    inertial = [centrifugal(rotation), turning(rotation), body.K0[:3].transpose(1, 2, 0)]
    matrices = [0.0 - np.moveaxis(item, -1, 0) for item in inertial]
    every = enumerate(np.concatenate([*matrices, body.K0_outboard]), start=1)
    return {load: matrix for load, matrix in every if matrix.any()}


# -- writing ---------------------------------------------------------------------------------


def write_fem(path: Path, element: ModalElement) -> None:
    """Write the file; its numbers lose no digit."""
    write_text(path, fem_text(element))


def fem_text(element: ModalElement) -> str:
    """Return the content of the file, numbers with 17 digits."""
    return filled("modal_element.fem.jinja", {"rows": _rows}, element=element, body=element.body)


def _rows(values: np.ndarray) -> str:
    """Return values (..., n), n on a line."""
    rows = np.asarray(values).reshape(-1, np.shape(values)[-1]).tolist()
    return "\n".join(" ".join(f"{v: .16e}" if v != 0.0 else " 0." for v in row) for row in rows)
