"""MBDyn's plain-ASCII .fem file of a modal element.

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
Source: Masarati, MBDyn input file format, and the reader in MBDyn's mbdyn/struct/modal.cc, of
group 19 modalad.cc.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dolfinopt.data import filled
from dolfinopt.disk import write_text


class Invariants(NamedTuple):
    """Integrals over the mass that couple q modes to the motion of the frame, see the module."""

    three: np.ndarray  # (3, q)
    four: np.ndarray  # (3, q)
    eight: np.ndarray  # (3, 3, q)
    five: np.ndarray  # (3, q, q)
    nine: np.ndarray  # (3, 3, q, q)


@dataclass(frozen=True, eq=False)
class ModalElement:
    """A flexible body as MBDyn reads it.

    Attributes:
        labels: (n,) of the nodes, without blanks.
        points: (n, 3) m.
        modes: (n, 6, q) three translations and three rotations of every node.
        M, K, D: (q, q) modal mass, stiffness and damping.
        lumped: (n, 6) mass (three times, kg) and moments of inertia (kg m2) of every node; or None.
        mass: kg.
        centre: (3,) of mass, m.
        inertia: (3, 3) about the centre of mass, kg m2.
        loads: (k,) places of the loads that stiffen the body in group 19's list, ascending; none
            of a linear body.
        stiffening: (k, q, q) their matrices, MBDyn's signs.
        invariants: in place of the lumped masses, or None.
    """

    labels: tuple[str, ...]
    points: np.ndarray
    modes: np.ndarray
    M: np.ndarray
    K: np.ndarray
    D: np.ndarray
    lumped: np.ndarray | None
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    loads: np.ndarray
    stiffening: np.ndarray
    invariants: Invariants | None = None


# -- writing ---------------------------------------------------------------------------------


def write_fem(path: Path, element: ModalElement) -> None:
    """Write the file; its numbers lose no digit."""
    write_text(path, fem_text(element))


def fem_text(element: ModalElement) -> str:
    """Return the content of the file, numbers with 17 digits."""
    return filled("modal_element.fem.jinja", {"rows": _rows}, element=element)


def _rows(values: np.ndarray) -> str:
    """Return values (..., n), n on a line."""
    rows = np.asarray(values).reshape(-1, np.shape(values)[-1]).tolist()
    return "\n".join(" ".join(f"{v: .16e}" if v != 0.0 else " 0." for v in row) for row in rows)
