"""MBDyn's plain-ASCII .fem file of a modal element.

Record groups 1, 2 and 5 to 13 of MBDyn's input manual, "Modal element": header, node labels, nodal
coordinates, mode shapes, modal mass and stiffness, diagonal of the lumped mass matrix, global
inertia, modal damping. MBDyn makes its coupling invariants of the lumped masses; total mass, centre
of mass and inertia (group 12), modal mass, stiffness and damping are the consistent ones.

Group 19, of stiffened bodies, has their number and then one matrix K_i for every load, each behind
the load's place in this list, counted from one: products of the angular velocity w1^2, w2^2, w3^2,
w1 w2, w2 w3, w3 w1, angular acceleration 1 to 3, acceleration 1 to 3 (less gravity), then force and
moment 1 to 3 of every interface node in the order of the joint's input. All in the body's frame.
MBDyn's modal rows become (M qdd + ... + K q) + sum_i p_i K_i q of its motion and - f_i K_i q of the
force and moment f that the joint exerts on the interface node. With the loads and signs of
`ShapeIntegrals` that is, in the plane,

    3: w3^2, K0_-ww   9: w3', -K0_wd   10, 11: a, -K0_ax, -K0_ay   13, 14, 18: f, K0_Fx, K0_Fy, K0_T

The outboard interface, node 2, must be the joint's first interface node; the inboard one is the
modal node itself. MBDyn uses the group with `use automatic differentiation;` in the control data,
and needs the joint's `use invariant 9` for the -w^2 M q that stiffening outweighs. Its interface
moves linearly in q: the displacement of the second order, -1/2 q'K0 q, is not in this format.
Source: Masarati, MBDyn input file format, and the reader in MBDyn's mbdyn/struct/modal.cc, of
group 19 modalad.cc.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.disk import write_atomically
from dolfinopt.errors import InputError
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.standard_input import SpatialMoments

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm
    from dolfinopt.reduction import Basis

# Nodes of two ranks that coincide to this, relative to the arm's extent, are one.
SAME_PLACE = 1e-9
_TITLES = {
    1: "HEADER",
    2: "FINITE ELEMENT NODE LIST",
    5: "NODAL X COORDINATES",
    6: "NODAL Y COORDINATES",
    7: "NODAL Z COORDINATES",
    8: "MODE SHAPES",
    9: "MODAL MASS MATRIX",
    10: "MODAL STIFFNESS MATRIX",
    11: "DIAGONAL OF LUMPED MASS MATRIX",
    12: "GLOBAL INERTIA",
    13: "MODAL DAMPING MATRIX",
    19: "MODAL STRESS STIFFENING MATRIX",
}
STIFFENING = 19  # the group that linear bodies do not have
# Place in MBDyn's list and sign of K0 and K0_outboard: a_x, a_y, wd, -w^2, F_x, F_y, T.
_LOADS = ((10, -1.0), (11, -1.0), (9, -1.0), (3, 1.0), (13, 1.0), (14, 1.0), (18, 1.0))


@dataclass(frozen=True, eq=False)
class ModalElement:
    """A flexible body as MBDyn reads it.

    Attributes:
        labels: (n,) of the nodes, without blanks.
        points: (n, 3) m.
        modes: (n, 6, q) three translations and three rotations of every node.
        M, K, D: (q, q) modal mass, stiffness and damping.
        lumped: (n, 6) mass (three times, kg) and moments of inertia (kg m2) of every node.
        mass: kg.
        centre: (3,) of mass, m.
        inertia: (3, 3) about the centre of mass, kg m2.
        loads: (k,) places of the loads that stiffen the body in group 19's list, ascending; none
            of a linear body.
        stiffening: (k, q, q) their matrices, MBDyn's signs.
    """

    labels: tuple[str, ...]
    points: np.ndarray
    modes: np.ndarray
    M: np.ndarray
    K: np.ndarray
    D: np.ndarray
    lumped: np.ndarray
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    loads: np.ndarray
    stiffening: np.ndarray


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


# -- writing ---------------------------------------------------------------------------------


def write_fem(path: Path, element: ModalElement) -> None:
    """Write the file; `read_fem` gets the same numbers back."""
    write_atomically(path, lambda stream: stream.write(fem_text(element).encode("ascii")))


def fem_text(element: ModalElement) -> str:
    """Return the content of the file, numbers with 17 digits."""
    count, q = len(element.labels), len(element.M)
    lines = ["** MBDyn MODAL DATA FILE", '** NODE SET "ALL"', "**"]

    def group(number: int, rows: Iterable[str]) -> None:
        lines.append(f"** RECORD GROUP {number}, {_TITLES[number]}")
        lines.extend(rows)
        lines.append("**")

    header = "**   REVISION,  NODE,  NORMAL, ATTACHMENT, CONSTRAINT, REJECTED MODES."
    group(1, [header, f"      REV0{count:10d}{q:10d}{0:10d}{0:10d}{0:10d}"])
    labels = element.labels
    group(2, (" ".join(f"{name:>9}" for name in labels[k : k + 6]) for k in range(0, count, 6)))
    for axis in range(3):
        group(5 + axis, _rows(element.points[:, [axis]]))
    shapes: list[str] = []
    for k in range(q):
        shapes += [f"**    NORMAL MODE SHAPE #  {k + 1}", *_rows(element.modes[:, :, k])]
    group(8, shapes)
    group(9, _rows(element.M))
    group(10, _rows(element.K))
    group(11, _rows(element.lumped))
    inertia = [*_rows(np.array([[element.mass]])), *_rows(element.centre[None])]
    group(12, [*inertia, *_rows(element.inertia)])
    group(13, _rows(element.D))
    if len(element.loads):
        matrices = [str(len(element.loads))]
        for load, matrix in zip(element.loads, element.stiffening, strict=True):
            matrices += [str(load), *_rows(matrix)]
        group(STIFFENING, matrices)
    return "\n".join(lines) + "\n"


def _rows(values: np.ndarray) -> list[str]:
    return [" ".join(f"{v: .16e}" if v != 0.0 else " 0." for v in row) for row in values]


# -- reading ---------------------------------------------------------------------------------


def read_fem(path: Path) -> ModalElement:
    """Read a .fem file with the record groups that `write_fem` writes.

    Groups may come in any order after the first; others are passed over. Without group 19 the body
    is linear.

    Raises:
        InputError: one line with the file, the group and what is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a .fem file") from None
    groups: dict[int, list[str]] = {}
    number = 0
    for line in text.splitlines():
        title = re.match(r"\*\* RECORD GROUP\s+(\d+)", line)
        if title:
            number = int(title[1])
            if number in groups:
                raise InputError(f"{path}: record group {number} appears twice")
            groups[number] = []
        elif number and not line.startswith("**"):
            groups[number] += line.split()
    missing = [k for k in _TITLES if k not in groups and k != STIFFENING]
    if missing:
        raise InputError(f"{path}: record group {missing[0]}, {_TITLES[missing[0]]}, is missing")
    return _element(path, groups)


def _element(path: Path, groups: dict[int, list[str]]) -> ModalElement:
    sizes = groups[1][1:]
    if len(sizes) != 5 or not all(word.isdecimal() for word in sizes):
        raise InputError(
            f"{path}: record group 1 has {' '.join(groups[1])!r}, expected REV0 and five integers"
        )
    count = int(sizes[0])
    q = int(sizes[1]) + int(sizes[2]) + int(sizes[3]) - int(sizes[4])
    if len(groups[2]) != count:
        raise InputError(f"{path}: record group 2 has {len(groups[2])} labels, expected {count}")

    def numbers(group: int, *shape: int) -> np.ndarray:
        words = groups[group]
        if len(words) != np.prod(shape):
            raise InputError(
                f"{path}: record group {group} has {len(words)} numbers, expected {np.prod(shape)}"
            )
        try:
            values = np.array([float(word) for word in words])
        except ValueError as error:
            raise InputError(f"{path}: record group {group}: {error}") from None
        return values.reshape(shape)

    stride = 1 + q * q
    loads, stiffening = np.zeros(0, dtype=int), np.zeros((0, q, q))
    if STIFFENING in groups:
        words = groups[STIFFENING]
        known = int(words[0]) if words and words[0].isdecimal() else 0
        table = numbers(STIFFENING, 1 + known * stride)[1:].reshape(known, stride)
        loads, stiffening = table[:, 0].astype(int), table[:, 1:].reshape(known, q, q)
        if not known or (loads != table[:, 0]).any() or loads.min() < 1:
            raise InputError(
                f"{path}: record group {STIFFENING} must hold a number of matrices >= 1 and, "
                "before each of them, the place of its load, an integer >= 1"
            )
    inertia = numbers(12, 13)
    return ModalElement(
        labels=tuple(groups[2]),
        points=np.column_stack([numbers(5 + axis, count) for axis in range(3)]),
        modes=numbers(8, q, count, 6).transpose(1, 2, 0),
        M=numbers(9, q, q),
        K=numbers(10, q, q),
        D=numbers(13, q, q),
        lumped=numbers(11, count, 6),
        mass=float(inertia[0]),
        centre=inertia[1:4],
        inertia=inertia[4:].reshape(3, 3),
        loads=loads,
        stiffening=stiffening,
    )
