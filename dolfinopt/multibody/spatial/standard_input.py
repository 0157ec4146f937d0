"""A body in space as standard input data; see `dolfinopt.exchange.sid` for the equations.

With a frame that accelerates by a + A X, A = wd~ + w~ w~, all that the matrices of the elastic
coordinates hold are sums of

    Y_ab(q)_k = int Phi_ak p_b - (K0_ab q)_k,   p = X + Phi q,

    Cr_kc = e_cab Y_ba,k       Oe_k = (Y_aa - tr Y)_k for w_a^2, (Y_ab + Y_ba)_k for w_a w_b
    Gr_k = 2 (tr Y 1 - Y)_k    Ct_k = int Phi_k - K0_a q    J = tr G 1 - G, dG_ab / dq = Y_ab + Y_ba

    phi(q) = B_u - q'K0_F, psi(q) = B_theta - q'K0_M of every outboard node

so that geometric stiffness K0 of the 18 loads stands in matrices of the first order (Wallrapp 1994,
doi:10.1080/08905459408905214: K0t in Ct, K0r in Cr, K0omega in Oe and Gr, K0F and K0M in the
nodes). As in the plane the motion of the second order is not in the format: mdCM(q) and origin(q)
lack -1/2 q'K0_p q, force and moment -qd'K0_p qd; a body read back (`body_of_sid`) has them again.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dolfinopt.exchange.sid import (
    GENERAL,
    SYMMETRIC,
    UNIT,
    ZERO,
    Node,
    StandardInputData,
    Taylor,
    structure_of,
    taylor,
)
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.kinematics import PERMUTATION
from dolfinopt.multibody.spatial.mechanism import ONE, skew
from dolfinopt.multibody.standard_input import coordinate_names

# Entries of J, and products of the angular velocity in the columns of Oe.
INERTIA = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
PRODUCTS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


def to_sid(body: ShapeIntegrals, comment: str = "") -> StandardInputData:
    """Return a body in space as standard input data.

    The first node, "1", is the inboard joint, the last one, "2", the outboard interface; further
    interfaces, "3", "4", ..., stand between them. A coordinate's name holds sqrt(K_kk / M_kk) in
    Hz, as other programs expect.

    Args:
        body: tangent frame at the inboard joint.
        comment: for the file's first line.
    """
    q = body.num_modes
    none = np.zeros((0, q, q))
    held = _node("1", np.zeros(3), np.zeros((6, q)), none)
    interfaces = enumerate(outboard_interfaces(body), start=2)
    tip, *further = (_node(str(k), *interface) for k, interface in interfaces)
    return StandardInputData(
        mass=body.mass,
        names=coordinate_names(body),
        nodes=(held, *further, tip),
        comment=comment,
        Me=taylor(body.M, nq=q, structure=SYMMETRIC),
        ksigma=taylor(np.zeros((q, 1)), nq=q, structure=ZERO),
        Ke=taylor(body.K, nq=q, structure=SYMMETRIC),
        De=taylor(body.D, nq=q, structure=structure_of(body.D)),
        **_inertia_matrices(body),
    )


def outboard_interfaces(
    body: ShapeIntegrals,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield point (3,), modes (6, q) and K0 (6, q, q) or (0, q, q) of every outboard interface."""
    for k, point in enumerate(body.points):
        rows = slice(6 * k, 6 * k + 6)
        yield point, body.outboard[rows], body.K0_outboard[rows]


def _node(name: str, point: np.ndarray, modes: np.ndarray, K0: np.ndarray) -> Node:
    """Return a node from its place, its displacements and rotations (6, q) and their K0."""
    q = modes.shape[1]
    phi, psi = modes[:3], modes[3:]
    phi_q, psi_q = (_clean(-K0[:3]), _clean(-K0[3:])) if len(K0) else (None, None)
    turn = _clean(skew(psi.T)).transpose(1, 0, 2)  # row, coordinate, column
    return Node(
        name=name,
        rframe="body ref",
        origin=taylor(point[:, None], phi[:, :, None].copy(), nq=q, structure=GENERAL),
        phi=taylor(phi, phi_q, nq=q, structure=GENERAL),
        psi=taylor(psi, psi_q, nq=q, structure=GENERAL),
        AP=taylor(ONE, turn, nq=q, structure=GENERAL if turn.any() else UNIT),
    )


def _inertia_matrices(body: ShapeIntegrals) -> dict[str, Taylor]:
    """Return what moves the frame, and what that does to the coordinates."""
    q = body.num_modes
    W = body.W.reshape(3, 3, 1 + q, 1 + q)
    Y, Y_q = W[:, :, 1:, 0], W[:, :, 1:, 1:].copy()  # a, b, k and a, b, k, l
    push_q = None
    if body.is_stiffened:
        Y_q -= body.K0[3:].reshape(3, 3, q, q)
        push_q = -body.K0[:3].transpose(1, 2, 0)
    G, G_q = W[:, :, 0, 0], Y + Y.swapaxes(0, 1)
    coriolis = np.einsum("abc,abkl->klc", -2.0 * PERMUTATION, W[:, :, 1:, 1:])
    found = {
        "mdCM": (body.w[:, :1], body.w[:, 1:, None]),
        "J": (_moments(G)[:, None], _moments(G_q)[:, :, None]),
        "Ct": (body.w[:, 1:].T, push_q),
        "Cr": (turning(Y), turning(Y_q)),
        "Gr": (_gyroscopic(Y).reshape(3, -1), _gyroscopic(Y_q).transpose(0, 2, 1, 3)),
        "Ge": (coriolis.reshape(q, -1), None),
        "Oe": (centrifugal(Y), centrifugal(Y_q)),
    }
    return {
        name: taylor(
            _clean(value),
            None if more is None else _clean(more).reshape(len(value), q, -1),
            nq=q,
            structure=GENERAL,
        )
        for name, (value, more) in found.items()
    }


def _clean(values: np.ndarray) -> np.ndarray:
    """Return the values without negative zeros, which the file would spell out."""
    return values + 0.0


def _moments(G: np.ndarray) -> np.ndarray:
    """Return tr G 1 - G (3, 3, ...) as xx, yy, zz, xy, xz, yz (6, ...)."""
    trace = np.einsum("aa...->...", G)
    return np.stack([(a == b) * trace - G[a, b] for a, b in INERTIA])


def turning(Y: np.ndarray) -> np.ndarray:
    """Return e_cab Y_ba (..., 3)."""
    return np.einsum("cab,ba...->...c", PERMUTATION, Y)


def _gyroscopic(Y: np.ndarray) -> np.ndarray:
    """Return 2 (tr Y 1 - Y) with rows first and columns last."""
    trace = np.einsum("aa...,ij->ij...", Y, ONE)
    return np.moveaxis(2.0 * (trace - Y), 1, -1)


def centrifugal(Y: np.ndarray) -> np.ndarray:
    """Return what w1^2, w2^2, w3^2, w1 w2, w2 w3, w1 w3 do (..., 6)."""
    trace = np.einsum("aa...->...", Y)
    columns = [Y[a, a] - trace if a == b else Y[a, b] + Y[b, a] for a, b in PRODUCTS]
    return np.stack(columns, axis=-1)
