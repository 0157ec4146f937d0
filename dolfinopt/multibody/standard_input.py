"""A plane body as standard input data of the spatial format, and back.

Motion is in x-y, rotation about z. What the planar equations know goes into its places in the
spatial matrices bit by bit, so that body -> SID -> body is exact. What only a spatial code asks for
(rotation about x and y, centrifugal forces of such rotation) comes from `SpatialMoments`.

Geometric stiffness K0_p of the loads p = (a_x, a_y, wd, -w^2, F_x, F_y, T), see `ShapeIntegrals`,
is what the matrices of the first order lose: with every load's work C q, r q, ..., 1/2 q'K0_p q,

    Ct(q)  = C' - K0_ax q, K0_ay q in columns 1, 2        Cr(q)  = r + G q - K0_wd q in column 3
    Oe(q)  = -j - M q + K0_-ww q in column 3              Gr(q)  = 2 (j + M q - K0_-ww q) at (3, 3)
    phi(q) = B - q'K0_Fx, q'K0_Fy of the outboard node    psi(q) = theta - q'K0_T of its rotation

(Wallrapp 1994, doi:10.1080/08905459408905214: K0t, K0r, K0omega, K0F and K0M; `ksigma`,
stresses without a load, is zero.) Motion of the second order is not in the format: mdCM(q) and
origin(q) lack -1/2 q'K0_p q, force and moment -qd'K0_p qd; a body read back has them again. Nor
does a plane body know what stiffens it out of its plane: by a_z, rotation about x and y, F_z, T_x
and T_y the matrices are those of a linear body, as those of all nodes but the outboard one are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.sid import (
    GENERAL,
    SYMMETRIC,
    UNIT,
    ZERO,
    Node,
    StandardInputData,
    read_sid,
    structure_of,
    taylor,
)
from dolfinopt.multibody.shape_integrals import (
    ShapeIntegrals,
    SpatialMoments,
    plane_body,
    slender_moments,
)
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


@dataclass(frozen=True, eq=False)
class PlaneNode:
    """A further node of the body.

    Attributes:
        name: other than "1" and "2".
        point: (2,) reference position, m.
        motion: (3, q) u_x, u_y, theta by each coordinate.
        K0: (3, q, q) geometric stiffness by unit forces and moment at the node; None, or
            (0, q, q), of a linear body.
    """

    name: str
    point: np.ndarray
    motion: np.ndarray
    K0: np.ndarray | None = None


# -- to SID ----------------------------------------------------------------------------------


def to_sid(
    body: ShapeIntegrals,
    moments: SpatialMoments | None = None,
    further: Sequence[PlaneNode] = (),
    comment: str = "",
) -> StandardInputData:
    """Return a plane body as standard input data.

    The first node, "1", is the inboard joint, the last one, "2", the outboard interface. A
    coordinate's name holds sqrt(K_kk / M_kk) in Hz, as other programs expect.

    Args:
        body: tangent frame at the inboard joint.
        moments: for spatial codes; by default those of `slender_moments`.
        further: nodes between the two.
        comment: for the file's first line.
    """
    q = body.num_modes
    held = PlaneNode("1", np.zeros(2), np.zeros((3, q)))
    tip = PlaneNode("2", body.outboard_point, body.outboard, body.K0_outboard)
    nodes = (held, *further, tip)
    moments = moments or slender_moments(body)
    none = np.zeros((q, 1))
    return StandardInputData(
        mass=body.mass,
        names=coordinate_names(body),
        nodes=tuple(_node(node, q) for node in nodes),
        comment=comment,
        Me=taylor(body.M, nq=q, structure=SYMMETRIC),
        ksigma=taylor(none, nq=q, structure=ZERO),
        Ke=taylor(body.K, nq=q, structure=SYMMETRIC),
        De=taylor(body.D, nq=q, structure=structure_of(body.D)),
        **_rigid_matrices(body, moments),
        **_elastic_matrices(body, moments),
    )


def coordinate_names(body: ShapeIntegrals) -> tuple[str, ...]:
    """Return names that hold sqrt(K_kk / M_kk) in Hz."""
    frequency = np.sqrt(np.diag(body.K) / np.diag(body.M)) / (2.0 * np.pi)
    return tuple(f"Eigen Mode {k:4d} : {f:12.3f} Hz" for k, f in enumerate(frequency, 1))


def _node(node: PlaneNode, q: int) -> Node:
    origin, phi, psi = np.zeros((3, 1)), np.zeros((3, q)), np.zeros((3, q))
    origin[:2, 0], phi[:2], psi[2] = node.point, node.motion[:2], node.motion[2]
    turn = np.zeros((3, q, 3))  # tilde(psi_k)
    turn[0, :, 1], turn[1, :, 0] = 0.0 - psi[2], psi[2]
    phi_q = psi_q = None
    if node.K0 is not None and len(node.K0):
        phi_q, psi_q = np.zeros((3, q, q)), np.zeros((3, q, q))
        phi_q[:2], psi_q[2] = 0.0 - node.K0[:2], 0.0 - node.K0[2]
    return Node(
        name=node.name,
        rframe="body ref",
        origin=taylor(origin, phi[:, :, None].copy(), nq=q, structure=GENERAL),
        phi=taylor(phi, phi_q, nq=q, structure=GENERAL),
        psi=taylor(psi, psi_q, nq=q, structure=GENERAL),
        AP=taylor(np.eye(3), turn, nq=q, structure=GENERAL if turn.any() else UNIT),
    )


def _rigid_matrices(body: ShapeIntegrals, moments: SpatialMoments) -> dict:
    """Return what moves the frame: mdCM, J and Gr."""
    q, (xx, yy) = body.num_modes, np.diag(moments.second)
    centre, centre_q = np.zeros((3, 1)), np.zeros((3, q, 1))
    centre[:2, 0], centre_q[:2, :, 0] = body.moment, body.C
    inertia, inertia_q = np.zeros((6, 1)), np.zeros((6, q, 1))
    xy = moments.second[0, 1]
    inertia[:4, 0] = yy + moments.depth, xx + moments.depth, body.inertia, 0.0 - xy
    first = moments.first
    inertia_q[:4, :, 0] = (
        2.0 * first[1, 1],
        2.0 * first[0, 0],
        2.0 * body.j,
        0.0 - (first[0, 1] + first[1, 0]),
    )
    # -2 int tilde(r) tilde(Phi_k) = 2 int (r . Phi_k) I - Phi_k r', and the same with r = Phi_l.
    gyroscopic = np.zeros((3, q, 3))  # row, k, column
    gyroscopic_q = np.zeros((3, q, q, 3))  # row, l, k, column
    mixed = moments.mixed
    for i, other in ((0, 1), (1, 0)):
        gyroscopic[i, :, i] = 2.0 * first[other, other]
        gyroscopic[i, :, other] = 0.0 - 2.0 * first[other, i]
        gyroscopic_q[i, :, :, i] = 2.0 * mixed[other, other]
        gyroscopic_q[i, :, :, other] = 0.0 - 2.0 * mixed[other, i]
    gyroscopic[2, :, 2] = 2.0 * body.j
    gyroscopic_q[2, :, :, 2] = 2.0 * body.M
    if body.is_stiffened:
        gyroscopic_q[2, :, :, 2] -= 2.0 * body.K0[3]
    return {
        "mdCM": taylor(centre, centre_q, nq=q, structure=GENERAL),
        "J": taylor(inertia, inertia_q, nq=q, structure=GENERAL),
        "Gr": taylor(
            gyroscopic.reshape(3, 3 * q),
            gyroscopic_q.reshape(3, q, 3 * q),
            nq=q,
            structure=GENERAL,
        ),
    }


def _elastic_matrices(body: ShapeIntegrals, moments: SpatialMoments) -> dict:
    """Return what moves the coordinates: Ct, Cr, Ge and Oe."""
    q, first, mixed = body.num_modes, moments.first, moments.mixed
    push = np.zeros((q, 3))
    push[:, :2] = body.C.T
    turn, turn_q = np.zeros((q, 3)), np.zeros((q, q, 3))
    turn[:, 2], turn_q[:, :, 2] = body.r, body.G
    coriolis = np.zeros((q, q, 3))  # row, block, column
    coriolis[:, :, 2] = 2.0 * body.G
    # int (Phi.w)(w.r) - w^2 (Phi.r), and the same with r = Phi_l.
    centrifugal, centrifugal_q = np.zeros((q, 6)), np.zeros((q, q, 6))
    columns = (first[1, 1], first[0, 0], body.j)
    columns_q = (mixed[1, 1], mixed[0, 0], body.M)
    for c in range(3):
        centrifugal[:, c] = 0.0 - columns[c]
        centrifugal_q[:, :, c] = 0.0 - columns_q[c]
    centrifugal[:, 3] = first[0, 1] + first[1, 0]
    centrifugal_q[:, :, 3] = mixed[0, 1] + mixed[1, 0]
    push_q = None
    if body.is_stiffened:
        push_q = np.zeros((q, q, 3))
        push_q[:, :, :2] = 0.0 - body.K0[:2].transpose(1, 2, 0)
        turn_q[:, :, 2] -= body.K0[2]
        centrifugal_q[:, :, 2] += body.K0[3]
    return {
        "Ct": taylor(push, push_q, nq=q, structure=GENERAL),
        "Cr": taylor(turn, turn_q, nq=q, structure=GENERAL),
        "Ge": taylor(coriolis.reshape(q, 3 * q), nq=q, structure=GENERAL),
        "Oe": taylor(centrifugal, centrifugal_q, nq=q, structure=GENERAL),
    }


# -- from SID --------------------------------------------------------------------------------


def load_body(path: Path, length: float | None = None) -> ShapeIntegrals:
    """Read an SID file and return its plane body, see `from_sid`.

    Args:
        path: of the file; its first node is the inboard, its last one the outboard node.
        length: joint axis to joint axis, m, with which the file must agree.

    Raises:
        InputError: the file is damaged, its body is not of that kind or of another length.
    """
    body = from_sid(read_sid(path), source=str(path))
    if length is not None:
        x, y = body.outboard_point
        if np.hypot(x - length, y) > SMALL * length:
            raise InputError(
                f"{path}: the outboard node is at ({x:.7g}, {y:.7g}) m, but the arm's length is "
                f"{length:.7g} m; it must be at (length, 0)"
            )
    return body


def from_sid(
    data: StandardInputData,
    inboard: str | None = None,
    outboard: str | None = None,
    source: str = "SID",
) -> ShapeIntegrals:
    """Return the plane body of standard input data.

    The frame must be the tangent frame at the inboard node, all motion in x-y. Entries that plane
    motion does not feel (J about x and y, ...) are dropped.

    Args:
        data: of any program.
        inboard: name of the inboard node, by default the first.
        outboard: name of the outboard node, by default the last.
        source: what messages call the data.

    Raises:
        InputError: one line: no such node, a frame that is not held at the inboard node, motion
            out of the plane, initial stresses, geometric stiffening by some loads only, matrices
            that are no mechanical body's.
    """
    first, last = ends(data, inboard, outboard, source)
    _check_nodes(first, last, source)
    _check_plane(data, source)
    inertia = data.inertia(np.zeros(data.num_modes))[2, 2]
    check_definite(data, {"mass": data.mass, "J(3, 3)": inertia}, source)
    check_stresses(data, source)
    G, M = 0.5 * data.Ge.M0[:, 2::3], data.Me.M0
    if np.abs(G + G.T).max() > SMALL * np.abs(M).max():
        raise InputError(f"{source}: the columns 3, 6, ... of Ge must be a skew matrix")
    return plane_body(
        mass=data.mass,
        moment=data.mdCM.M0[:2, 0].copy(),
        inertia=float(inertia),
        C=data.Ct.M0[:, :2].T.copy(),
        j=0.0 - data.Oe.M0[:, 2],
        r=data.Cr.M0[:, 2].copy(),
        M=0.5 * (M + M.T),
        G=0.5 * (G - G.T),
        K=0.5 * (data.Ke.M0 + data.Ke.M0.T),
        D=data.De.M0.copy(),
        outboard=np.vstack([last.phi.M0[:2], last.psi.M0[2]]),
        outboard_point=last.origin.M0[:2, 0].copy(),
        K0=_geometric_stiffness(data, last, source),
    )


def _check_nodes(first: Node, last: Node, source: str) -> None:
    """Check that the frame is held at the first node, and that the last moves in the plane."""
    if not np.abs(last.origin.M0).max() > 0.0:
        raise InputError(f"{source}: the outboard node {last.name} is at the origin")
    length, push, turn = scales(last)
    checks = [
        (first, "origin", first.origin.M0, length, "at the origin"),
        (first, "phi", first.phi.M0, push, "held in the frame"),
        (first, "psi", first.psi.M0, turn, "held in the frame"),
        (last, "origin", last.origin.M0[2], length, "in the plane z = 0"),
        (last, "phi", last.phi.M0[2], push, "in the plane"),
        (last, "psi", last.psi.M0[:2], turn, "in the plane"),
    ]
    checks += [(node, "AP", node.AP.M0 - np.eye(3), 1.0, "parallel") for node in (first, last)]
    check_deviations(checks, first, source)


def _check_plane(data: StandardInputData, source: str) -> None:
    """Check that plane motion stays in the plane."""
    inertia = data.inertia(np.zeros(data.num_modes))
    spatial: Iterable[tuple[str, np.ndarray, np.ndarray]] = (
        ("row 3 of mdCM", data.mdCM.M0[2], data.mdCM.M0),
        ("J(1, 3), J(2, 3)", inertia[:2, 2], inertia),
        ("column 3 of Ct", data.Ct.M0[:, 2], data.Ct.M0),
        ("columns 1, 2 of Cr", data.Cr.M0[:, :2], data.Cr.M0),
    )
    for name, values, whole in spatial:
        if np.abs(values).max() > SMALL * np.abs(whole).max():
            raise InputError(
                f"{source}: {name} reach(es) {np.abs(values).max():.3g}; an arm must move in the "
                "x-y plane only"
            )


def _geometric_stiffness(data: StandardInputData, last: Node, source: str) -> np.ndarray | None:
    """Return K0 (7, q, q) of the seven loads in the plane, None if the body is linear."""
    q = data.num_modes
    excess = data.Oe.M1[:, :, 2] + data.Me.M0 if data.Oe.order > 0 else np.zeros((q, q))
    rotation = np.abs(excess).max(initial=0.0) > CENTRIFUGAL * np.abs(data.Me.M0).max(initial=0.0)
    found = {
        "m1 of Ct": bool(data.Ct.M1[:, :, :2].any()),
        "m1 of Oe beyond -Me": bool(rotation),
        f"m1 of phi of node {last.name}": bool(last.phi.M1[:2].any()),
    }
    if not is_stiffened(found, source):
        return None
    push = list(data.Ct.M1.transpose(2, 0, 1)[:2])
    tip = [*last.phi.M1[:2], last.psi.M1[2] if last.psi.order else np.zeros((q, q))]
    check_symmetric({"Ct": push, f"phi, psi of node {last.name}": tip}, source)
    turn = data.Cr.M1[:, :, 2] if data.Cr.order else np.zeros((q, q))  # its skew part is G
    K0 = 0.0 - np.array([*push, turn, 0.0 - excess, *tip])
    return 0.5 * (K0 + K0.transpose(0, 2, 1))
