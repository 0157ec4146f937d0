"""The body in space of standard input data, see `dolfinopt.multibody.spatial.standard_input`.

Oe and Gr hold the symmetric parts of int Phi_a Phi_b and of K0_ab as a difference, which is all
that inverse dynamics depends on. Of a stiffened file they are told apart by Me = sum_a int
Phi_a Phi_a and by taking K0_ab with b = y, z, of loads A_ab X_b at places across the link, for
zero as far as the rest of the file allows it: exact in the limit of a slender link.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.sid import Node, StandardInputData, Taylor, read_sid
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.sid_checks import (
    CENTRIFUGAL,
    SMALL,
    check_definite,
    check_deviations,
    check_stresses,
    check_symmetric,
    ends,
    is_stiffened,
    scales,
)
from dolfinopt.multibody.spatial.kinematics import PERMUTATION
from dolfinopt.multibody.spatial.mechanism import ONE
from dolfinopt.multibody.spatial.standard_input import PRODUCTS

Place = tuple[float, float, float]


def load_body(
    path: Path, length: float | None = None, further: Mapping[str, Place] | None = None
) -> ShapeIntegrals:
    """Read an SID file and return its body in space, see `from_sid`.

    Args:
        path: of the file; its first node is the inboard, its last one the outboard node.
        length: joint axis to joint axis, m, with which the file must agree.
        further: names of the nodes that are further interfaces, and where they must be, m.

    Raises:
        InputError: the file is damaged, its body is not of that kind, of another length or with
            other interfaces.
    """
    further = further or {}
    body = from_sid(read_sid(path), further=tuple(further), source=str(path))
    if length is None:
        return body
    wanted: list[Place] = [(length, 0.0, 0.0), *further.values()]
    for name, point, expected in zip(("", *further), body.points, wanted, strict=True):
        if np.linalg.norm(point - expected) > SMALL * length:
            x, y, z = point
            if name:
                where, told = f"node {name}", f"the arm's interface {name!r} is at {expected} m"
            else:
                where, told = "the outboard node", f"the arm's length is {length:.7g} m"
                told += "; it must be at (length, 0, 0)"
            raise InputError(f"{path}: {where} is at ({x:.7g}, {y:.7g}, {z:.7g}) m, but {told}")
    return body


def from_sid(
    data: StandardInputData,
    inboard: str | None = None,
    outboard: str | None = None,
    further: Sequence[str] = (),
    source: str = "SID",
) -> ShapeIntegrals:
    """Return the body in space of standard input data.

    The frame must be the tangent frame at the inboard node.

    Args:
        data: of any program.
        inboard: name of the inboard node, by default the first.
        outboard: name of the outboard node, by default the last.
        further: names of the nodes that are further interfaces.
        source: what messages call the data.

    Raises:
        InputError: one line: no such node, a frame that is not held at the inboard node, initial
            stresses, geometric stiffening by some loads only, no matrices of the first order in
            Oe, matrices that are no mechanical body's.
    """
    first, last = ends(data, inboard, outboard, source)
    tips = [last, *(_node(data, name, source) for name in further)]
    _check_nodes(first, tips, source)
    _check_body(data, source)
    q = data.num_modes
    K0, K0_outboard = np.zeros((0, q, q)), np.zeros((0, q, q))
    symmetric, turned = _from_rows(data.Oe.M1, _first_order(data.Cr))
    if _is_stiffened(data, symmetric, tips, source):
        push = -data.Ct.M1.transpose(2, 0, 1)
        own = [-_first_order(matrix) for tip in tips for matrix in (tip.phi, tip.psi)]
        K0_outboard = np.concatenate(own)
        names = ", ".join(tip.name for tip in tips)
        loads = {"Ct": list(push), f"phi, psi of node {names}": list(K0_outboard)}
        check_symmetric(loads, source)
        rotation, symmetric = _told_apart(symmetric, turned, data.Me.M0)
        K0 = np.concatenate([push, rotation.reshape(9, q, q)])
    points = np.stack([tip.origin.M0[:, 0] for tip in tips])
    return ShapeIntegrals(
        mass=data.mass,
        w=np.column_stack([data.mdCM.M0[:, 0], data.Ct.M0.T]),
        W=_second_moments(data, symmetric),
        K=0.5 * (data.Ke.M0 + data.Ke.M0.T),
        D=data.De.M0.copy(),
        outboard=np.concatenate([matrix.M0 for tip in tips for matrix in (tip.phi, tip.psi)]),
        outboard_point=points[0],
        K0=0.5 * (K0 + K0.swapaxes(1, 2)),
        along_modes=np.zeros((0, q, q)),
        K0_outboard=0.5 * (K0_outboard + K0_outboard.swapaxes(1, 2)),
        further_points=points[1:],
    )


def _node(data: StandardInputData, name: str, source: str) -> Node:
    """Return the node of that name."""
    for node in data.nodes:
        if node.name.casefold() == name.casefold():
            return node
    names = ", ".join(node.name for node in data.nodes)
    raise InputError(f"{source}: no node {name!r}; it has {names}")


def _check_nodes(first: Node, tips: Sequence[Node], source: str) -> None:
    """Check that the frame is held at the first node, and that the others are parallel to it."""
    last = tips[0]
    if not np.abs(last.origin.M0).max() > 0.0:
        raise InputError(f"{source}: the outboard node {last.name} is at the origin")
    length, push, turn = scales(last)
    checks = [
        (first, "origin", first.origin.M0, length, "at the origin"),
        (first, "phi", first.phi.M0, push, "held in the frame"),
        (first, "psi", first.psi.M0, turn, "held in the frame"),
    ]
    checks += [(node, "AP", node.AP.M0 - ONE, 1.0, "parallel") for node in (first, *tips)]
    check_deviations(checks, first, source)


def _check_body(data: StandardInputData, source: str) -> None:
    """Check what any mechanical body fulfils, and that nothing is left out."""
    principal = np.linalg.eigvalsh(data.inertia(np.zeros(data.num_modes)))
    if principal[0] < -SMALL * np.abs(principal).max():  # 0 of a thin bar about its axis
        raise InputError(
            f"{source}: J has a moment of {principal[0]:g} kg m2; none can be negative"
        )
    check_definite(data, {"mass": data.mass, "the largest moment of J": principal[-1]}, source)
    check_stresses(data, source)
    if data.Oe.order == 0:
        raise InputError(
            f"{source}: Oe has no m1, by which deflections feel the rotation of the frame; write "
            "the file with matrices of order 1"
        )
    coriolis = data.Ge.M0.reshape(data.num_modes, -1, 3)
    if np.abs(coriolis + coriolis.swapaxes(0, 1)).max() > SMALL * np.abs(data.Me.M0).max():
        raise InputError(
            f"{source}: every third column of Ge must make a skew matrix: a block of three columns "
            "for each coordinate, not one of all coordinates for each axis"
        )
    check_symmetric({"Oe": list(data.Oe.M1.transpose(2, 0, 1))}, source)


def _first_order(matrix: Taylor) -> np.ndarray:
    """Return M1 (nrow, nq, ncol), zero of order 0."""
    nrow, ncol = matrix.M0.shape
    return matrix.M1 if matrix.order else np.zeros((nrow, matrix.M1.shape[1], ncol))


def _from_rows(Oe: np.ndarray, Cr: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (Y_ab + Y_ba) / 2 and Y_ab - Y_ba, both (3, 3, ...), of Oe (..., 6), Cr (..., 3)."""
    trace = -0.5 * Oe[..., :3].sum(axis=-1)
    symmetric = np.empty((3, 3, *Oe.shape[:-1]))
    for column, (a, b) in enumerate(PRODUCTS):
        value = Oe[..., column] + trace if a == b else 0.5 * Oe[..., column]
        symmetric[a, b] = symmetric[b, a] = value
    return symmetric, np.einsum("abc,...c->ab...", -PERMUTATION, Cr)


def _is_stiffened(
    data: StandardInputData, symmetric: np.ndarray, tips: Sequence[Node], source: str
) -> bool:
    """Return whether the body has geometric stiffness; it is the same for all loads."""
    push = bool(_first_order(data.Ct).any())
    found = {f"m1 of phi of node {tip.name}": bool(_first_order(tip.phi).any()) for tip in tips}
    if push or any(found.values()):
        return is_stiffened({"m1 of Ct": push} | found, source)
    excess = data.Me.M0 - np.einsum("aakl->kl", symmetric)
    if np.abs(excess).max() > CENTRIFUGAL * np.abs(data.Me.M0).max():
        raise InputError(
            f"{source}: columns 1 to 3 of m1 of Oe do not add up to -2 Me: either they hold "
            "geometric stiffness, which m1 of Ct and phi lack, or nodes have moments of inertia of "
            "their own, which bodies do not have here"
        )
    return False


def _told_apart(
    symmetric: np.ndarray, turned: np.ndarray, Me: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return K0_ab and the symmetric part of int Phi_a Phi_b (3, 3, q, q), see the module.

    Args:
        symmetric: of Y_ab.
        turned: Y_ab - Y_ba; the part symmetric in the coordinates is K0_ba - K0_ab.
        Me: sum_a int Phi_a Phi_a.
    """
    skewed = -0.5 * (turned + turned.swapaxes(2, 3))  # K0_ab - K0_ba
    K0 = np.zeros_like(symmetric)
    K0[0, 0] = Me - np.einsum("aakl->kl", symmetric)
    K0[1, 0], K0[2, 0] = skewed[1, 0], skewed[2, 0]
    K0[1, 2], K0[2, 1] = 0.5 * skewed[1, 2], 0.5 * skewed[2, 1]
    return K0, symmetric + 0.5 * (K0 + K0.swapaxes(0, 1))


def _second_moments(data: StandardInputData, symmetric: np.ndarray) -> np.ndarray:
    """Return W (9, 1 + q, 1 + q) with that symmetric part of int Phi_a Phi_b."""
    q = data.num_modes
    J = data.inertia(np.zeros(q))
    first, turned = _from_rows(data.Oe.M0, data.Cr.M0)
    Y = first + 0.5 * turned  # int Phi_a X_b
    coriolis = data.Ge.M0.reshape(q, q, 3)
    skewed = np.einsum("abc,klc->abkl", -0.25 * PERMUTATION, coriolis)
    modes = symmetric + 0.5 * (skewed - skewed.swapaxes(2, 3))
    W = np.empty((3, 3, 1 + q, 1 + q))
    W[:, :, 0, 0] = 0.5 * np.trace(J) * ONE - J
    W[:, :, 1:, 0], W[:, :, 0, 1:] = Y, Y.swapaxes(0, 1)
    # int Phi_a Phi_b with its coordinates exchanged is int Phi_b Phi_a.
    W[:, :, 1:, 1:] = 0.5 * (modes + modes.transpose(1, 0, 3, 2))
    return W.reshape(9, 1 + q, 1 + q)
