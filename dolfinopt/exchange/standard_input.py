"""Bodies as standard input data and back; see `dolfinopt.scene.sid`.

With a frame that accelerates by a + A X, A = wd~ + w~ w~, all that the matrices of the elastic
coordinates hold are sums of

    Y_ab(q)_k = int Phi_ak p_b - (K0_ab q)_k,   p = X + Phi q,

    Cr_kc = e_cab Y_ba,k       Oe_k = (Y_aa - tr Y)_k for w_a^2, (Y_ab + Y_ba)_k for w_a w_b
    Gr_k = 2 (tr Y 1 - Y)_k    Ct_k = int Phi_k - K0_a q    J = tr G 1 - G, dG_ab / dq = Y_ab + Y_ba

    phi(q) = B_u - q'K0_F, psi(q) = B_theta - q'K0_M of every outboard node

so that geometric stiffness K0 of the 18 loads stands in matrices of the first order (Wallrapp 1994,
doi:10.1080/08905459408905214: K0t in Ct, K0r in Cr, K0omega in Oe and Gr, K0F and K0M in the
nodes). Motion of the second order is not in the format: mdCM(q) and origin(q) lack -1/2 q'K0_p q,
force and moment -qd'K0_p qd; a body read back has them again.

A plane body is written as the body in space that `in_space` makes of it. It is read from the
columns that motion in x-y about z feels: they are its integrals bit by bit, and files may leave out
the rest. In space Oe and Gr hold the symmetric parts of int Phi_a Phi_b and of K0_ab as a
difference, which is all that inverse dynamics depends on. Of a stiffened file they are told apart
by Me = sum_a int Phi_a Phi_a and by taking K0_ab with b = y, z, of loads A_ab X_b at places across
the link, for zero as far as the rest of the file allows it: exact in the limit of a slender link.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.measured import CENTRIFUGAL_EXCESS_SHARE, FILE_ROUNDING_SHARE
from dolfinopt.multibody.rotations import ONE, PERMUTATION, skew
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, linear_part
from dolfinopt.scene import sid

# Rows and columns of the entries of J, and of the products of the angular velocity that Oe's
# columns are of; how often a product stands in w w'.
INERTIA = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)
PRODUCTS = (0, 1, 2, 0, 1, 0), (0, 1, 2, 1, 2, 2)
TWICE = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])

Place = tuple[float, float, float]


# -- to SID ----------------------------------------------------------------------------------


def to_sid(body: ShapeIntegrals, comment: str = "") -> sid.StandardInputData:
    """Return a body in space as standard input data; a plane one is brought there by `in_space`.

    The first node, "1", is the inboard joint, the last one, "2", the outboard interface; further
    interfaces, "3", "4", ..., stand between them. A coordinate's name holds sqrt(K_kk / M_kk) in
    Hz, as other programs expect.

    Args:
        body: tangent frame at the inboard joint.
        comment: for the file's first line.
    """
    q = body.num_modes
    frequency = np.sqrt(np.diag(body.K) / np.diag(body.M)) / (2.0 * np.pi)
    held = _node("1", np.zeros(3), np.zeros((6, q)), np.zeros((0, q, q)))
    each = (np.split(item, len(body.points)) for item in (body.outboard, body.K0_outboard))
    interfaces = zip(count(2), body.points, *each)
    tip, *further = (_node(str(number), *interface) for number, *interface in interfaces)
    return sid.StandardInputData(
        mass=body.mass,
        names=tuple(f"Eigen Mode {k:4d} : {f:12.3f} Hz" for k, f in enumerate(frequency, 1)),
        nodes=(held, *further, tip),
        comment=comment,
        Me=sid.taylor(q, body.M, structure=sid.SYMMETRIC),
        ksigma=sid.taylor(q, np.zeros((q, 1))),
        Ke=sid.taylor(q, body.K, structure=sid.SYMMETRIC),
        De=sid.taylor(q, body.D, structure=sid.structure_of(body.D)),
        **_inertia_matrices(body),
    )


def _node(name: str, point: np.ndarray, modes: np.ndarray, K0: np.ndarray) -> sid.Node:
    """Return a node from its place, its displacements and rotations (6, q) and their K0."""
    q, (phi, psi) = modes.shape[1], np.split(modes, 2)
    matrix = partial(sid.taylor, q)
    phi_q, psi_q = np.split(_clean(-K0), 2) if len(K0) else (None, None)
    turn = _clean(skew(psi.T)).transpose(1, 0, 2)  # row, coordinate, column
    return sid.Node(
        name=name,
        rframe="body ref",
        origin=matrix(point[:, None], phi[:, :, None].copy()),
        phi=matrix(phi, phi_q),
        psi=matrix(psi, psi_q),
        AP=matrix(ONE, turn, sid.GENERAL if turn.any() else sid.UNIT),
    )


def _inertia_matrices(body: ShapeIntegrals) -> dict[str, sid.Taylor]:
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
    result = {
        "mdCM": (body.w[:, :1], body.w[:, 1:, None]),
        "J": (about(G)[INERTIA][:, None], about(G_q)[INERTIA][:, :, None]),
        "Ct": (body.w[:, 1:].T, push_q),
        "Cr": (turning(Y), turning(Y_q)),
        "Gr": (_gyroscopic(Y).reshape(3, 3 * q), _gyroscopic(Y_q).transpose(0, 2, 1, 3)),
        "Ge": (coriolis.reshape(q, 3 * q), None),
        "Oe": (centrifugal(Y), centrifugal(Y_q)),
    }
    return {
        name: sid.taylor(
            q,
            _clean(value),
            None if more is None else _clean(more).reshape(len(value), q, value.shape[1]),
        )
        for name, (value, more) in result.items()
    }


def _clean(values: np.ndarray) -> np.ndarray:
    """Return the values without negative zeros, which the file would spell out."""
    return values + 0.0


def about(Y: np.ndarray, share: float = 1.0) -> np.ndarray:
    """Return tr Y 1 - Y (3, 3, ...): of int x x' the inertia; by half the trace back again."""
    return share * np.einsum("cc...,ab->ab...", Y, ONE) - Y


def turning(Y: np.ndarray) -> np.ndarray:
    """Return e_cab Y_ba (..., 3)."""
    return np.einsum("cab,ba...->...c", PERMUTATION, Y)


def _gyroscopic(Y: np.ndarray) -> np.ndarray:
    """Return 2 (tr Y 1 - Y) with rows first and columns last."""
    return np.moveaxis(2.0 * about(Y), 1, -1)


def centrifugal(Y: np.ndarray) -> np.ndarray:
    """Return what w1^2, w2^2, w3^2, w1 w2, w2 w3, w1 w3 do (..., 6)."""
    turned = about(0.5 * (Y + Y.swapaxes(0, 1)))
    return np.moveaxis(-turned[PRODUCTS], 0, -1) * TWICE


# -- from SID --------------------------------------------------------------------------------


def load_body(
    path: Path,
    dimension: int,
    length: float | None = None,
    further: Mapping[str, Place] | None = None,
) -> ShapeIntegrals:
    """Read an SID file and return its body, see `from_sid`.

    Args:
        path: of the file; its first node is the inboard, its last one the outboard node.
        dimension: 2 for a body in the plane, 3 in space.
        length: joint axis to joint axis, m, with which the file must agree.
        further: names of the nodes that are further interfaces, and where they must be, m.

    Raises:
        InputError: the file is damaged, its body is not of that kind, of another length or with
            other interfaces.
    """
    further = further or {}
    body = from_sid(sid.read_sid(path), dimension, tuple(further), str(path))
    if length is None:
        return body
    names = ["the outboard node", *(f"node {name}" for name in further)]
    places = np.array([(length, 0.0, 0.0), *further.values()])[:, :dimension]
    for where, point, expected in zip(names, body.points, places, strict=True):
        if np.linalg.norm(point - expected) > FILE_ROUNDING_SHARE * length:
            found, wanted = (", ".join(f"{x:.7g}" for x in at) for at in (point, expected))
            raise InputError(
                f"{path}: {where} is at ({found}) m, which the scene has at ({wanted}) m; correct "
                "arms.length, arms.interfaces or the file"
            )
    return body


def without_stiffening(body: ShapeIntegrals, source: str) -> ShapeIntegrals:
    """Return the body of a file without its geometric stiffness.

    Raises:
        InputError: in space, where it is not told from inertia.
    """
    if len(body.w) == 3:
        raise InputError(
            f"{source}: holds geometric stiffness, which simulation.stiffening = false is to leave "
            "out; that of a body in space is not told from its inertia in such a file: write it "
            "without, or take true or 'auto'"
        )
    return linear_part(body)


def from_sid(
    data: sid.StandardInputData,
    dimension: int,
    further: Sequence[str] = (),
    source: str = "SID",
) -> ShapeIntegrals:
    """Return the body of standard input data.

    The frame must be the tangent frame at the inboard node, the first one; the last one is the
    outboard interface. In the plane all motion must be in x-y; entries that such motion does not
    feel (J about x and y, ...) are dropped.

    Args:
        data: of any program.
        dimension: 2 for a body in the plane, 3 in space.
        further: names of the nodes that are further interfaces.
        source: what messages call the data.

    Raises:
        InputError: one line: no such node, a frame that is not held at the inboard node, motion out
            of the plane, initial stresses, geometric stiffening by some loads only, no matrices of
            the first order in Oe of a body in space, matrices that are no mechanical body's.
    """
    _refuse(_unlike_arms(data, further), source)
    by_name = {node.name.casefold(): node for node in data.nodes}
    tips = [data.nodes[-1], *(by_name[name.casefold()] for name in further)]
    _refuse(_misplaced(data.nodes[0], tips, dimension), source)
    _refuse(_impossible(data, dimension), source)
    _refuse(_half_stiffened(data, tips, dimension), source)
    q, along, about = data.num_modes, *_axes(dimension)
    K0, K0_outboard = np.zeros((0, q, q)), np.zeros((0, q, q))
    moments = _plane_moments if dimension == 2 else _spatial_moments
    W, rotation = moments(data, bool(data.Ct.M1[:, :, along].any()))
    if len(rotation):
        push = -data.Ct.M1.transpose(2, 0, 1)[along]
        own = [
            -matrix.M1[rows]
            for tip in tips
            for matrix, rows in ((tip.phi, along), (tip.psi, about))
        ]
        K0, K0_outboard = np.concatenate([push, rotation]), np.concatenate(own)
        names = ", ".join(tip.name for tip in tips)
        loads = {"Ct": push, f"phi, psi of node {names}": K0_outboard}
        _refuse(_asymmetric(loads), source)
    points = np.stack([tip.origin.M0[along, 0] for tip in tips])
    modes = [rows for tip in tips for rows in (tip.phi.M0[along], tip.psi.M0[about])]
    return ShapeIntegrals(
        mass=data.mass,
        w=np.column_stack([data.mdCM.M0[along, 0], data.Ct.M0.T[along]]),
        W=W,
        K=0.5 * (data.Ke.M0 + data.Ke.M0.T),
        D=data.De.M0.copy(),
        outboard=np.concatenate(modes),
        outboard_point=points[0],
        K0=0.5 * (K0 + K0.swapaxes(1, 2)),
        K0_outboard=0.5 * (K0_outboard + K0_outboard.swapaxes(1, 2)),
        further_points=points[1:],
        along_modes=np.zeros((0, q, q)),
    )


def _axes(dimension: int) -> tuple[slice, slice]:
    """Return the axes along which a body moves, and about which it turns."""
    return slice(dimension), slice(2 if dimension == 2 else 0, 3)


def _plane_moments(data: sid.StandardInputData, stiffened: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return W (2, 1 + q, 1 + q), and K0 (2, q, q) by wd and -w^2 or none."""
    q = data.num_modes
    r, j, G = data.Cr.M0[:, 2], 0.0 - data.Oe.M0[:, 2], 0.5 * data.Ge.M0[:, 2::3]
    W = np.empty((2, 1 + q, 1 + q))
    W[:, 0, 0] = data.inertia(np.zeros(q))[2, 2], 0.0
    W[:, 1:, 0], W[:, 0, 1:] = (j, r), (j, 0.0 - r)
    W[:, 1:, 1:] = 0.5 * (data.Me.M0 + data.Me.M0.T), 0.5 * (G - G.T)
    if not stiffened:
        return W, np.zeros((0, q, q))
    turn = data.Cr.M1[:, :, 2]  # its skew part is G
    return W, np.stack([-turn, _centrifugal_excess(data, 2)])


def _spatial_moments(data: sid.StandardInputData, stiffened: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return W (9, 1 + q, 1 + q), and K0_ab (9, q, q) or none; told apart as above."""
    q = data.num_modes
    symmetric, turned = _from_rows(data.Oe.M1, data.Cr.M1)
    K0 = np.zeros_like(symmetric)
    if stiffened:
        # The part of Y_ab - Y_ba that is symmetric in the coordinates is K0_ba - K0_ab.
        skewed = -0.5 * (turned + turned.swapaxes(2, 3))
        K0[0, 0] = _centrifugal_excess(data, 3)
        K0[1, 0], K0[2, 0] = skewed[1, 0], skewed[2, 0]
        K0[1, 2], K0[2, 1] = 0.5 * skewed[1, 2], 0.5 * skewed[2, 1]
        symmetric = symmetric + 0.5 * (K0 + K0.swapaxes(0, 1))
    first, turned = _from_rows(data.Oe.M0, data.Cr.M0)
    Y = first + 0.5 * turned  # int Phi_a X_b
    coriolis = data.Ge.M0.reshape(q, q, 3)
    skewed = np.einsum("abc,klc->abkl", -0.25 * PERMUTATION, coriolis)
    modes = symmetric + 0.5 * (skewed - skewed.swapaxes(2, 3))
    W = np.empty((3, 3, 1 + q, 1 + q))
    W[:, :, 0, 0] = about(data.inertia(np.zeros(q)), 0.5)
    W[:, :, 1:, 0], W[:, :, 0, 1:] = Y, Y.swapaxes(0, 1)
    # int Phi_a Phi_b with its coordinates exchanged is int Phi_b Phi_a.
    W[:, :, 1:, 1:] = 0.5 * (modes + modes.transpose(1, 0, 3, 2))
    return W.reshape(9, 1 + q, 1 + q), K0.reshape(9, q, q)[: 9 * stiffened]


def _from_rows(Oe: np.ndarray, Cr: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (Y_ab + Y_ba) / 2 and Y_ab - Y_ba, both (3, 3, ...), of Oe (..., 6), Cr (..., 3)."""
    turned = np.empty((3, 3, *Oe.shape[:-1]))
    rows, columns = PRODUCTS
    turned[rows, columns] = turned[columns, rows] = np.moveaxis(-Oe / TWICE, -1, 0)
    return about(turned, 0.5), np.einsum("abc,...c->ab...", -PERMUTATION, Cr)


def _centrifugal_excess(data: sid.StandardInputData, dimension: int) -> np.ndarray:
    """Return sum_a K0_aa (q, q): what Oe has beyond the inertia Me of rotation, a = x, y (, z)."""
    if data.Oe.order == 0:
        return np.zeros_like(data.Me.M0)
    if dimension == 2:
        return data.Me.M0 + data.Oe.M1[:, :, 2]
    return data.Me.M0 + 0.5 * data.Oe.M1[:, :, :3].sum(axis=-1)


# -- what standard input data must fulfil: a sentence for everything that it does not --------------


def _refuse(faults: Iterable[str], source: str) -> None:
    """Raise InputError for the first of the faults."""
    for fault in faults:
        raise InputError(f"{source}: {fault}")


def _unlike_arms(data: sid.StandardInputData, further: Sequence[str]) -> Iterator[str]:
    """Yield why a body is none that bends between an inboard and an outboard node."""
    if data.num_modes == 0:
        yield (
            "nelastq = 0, a body that does not bend; state rigid = true, mass and inertia in "
            "place of the file"
        )
    names = [node.name for node in data.nodes]
    if len(names) < 2:
        yield (
            f"lacks an outboard node, its nodes are: {', '.join(names) or 'none'}; an arm needs "
            "an inboard node at the origin and an outboard node"
        )
    known = {name.casefold() for name in names}
    for name in further:
        if name.casefold() not in known:
            yield f"no node {name!r}; it has {', '.join(names)}"


def _off(what: str, values: np.ndarray, of: np.ndarray | float, must: str) -> Iterator[str]:
    """Yield what must be, where values that must be zero are not: to the rounding of `of`."""
    if (most := np.abs(values).max(initial=0.0)) > FILE_ROUNDING_SHARE * np.max(np.abs(of)):
        yield f"{what}: off by {most:.3g}; {must}"


def _misplaced(first: sid.Node, tips: Sequence[sid.Node], dimension: int) -> Iterator[str]:
    """Yield where the frame is not held at the first node, or the others not parallel to it."""
    last = tips[0]
    length = np.abs(last.origin.M0).max()
    if not length > 0.0:
        yield f"the outboard node {last.name} is at the origin"
    # The largest displacement by a coordinate, of the interface or by its rotation over the length.
    moved = max(np.abs(last.phi.M0).max(), length * np.abs(last.psi.M0).max())
    held = "the inboard node must be at the origin and held in the frame"
    for name, scale, out_of_plane in (
        ("origin", length, [2]),
        ("phi", moved, [2]),
        ("psi", moved / length, [0, 1]),
    ):
        yield from _off(f"{name} of node {first.name}", getattr(first, name).M0, scale, held)
        if dimension == 2:
            values = getattr(last, name).M0[out_of_plane]
            flat = "the outboard node must be in the plane z = 0"
            yield from _off(f"{name} of node {last.name}", values, scale, flat)
    for node in (first, *tips):
        parallel = "the node must be parallel to the frame"
        yield from _off(f"AP of node {node.name}", node.AP.M0 - ONE, ONE, parallel)


def _impossible(data: sid.StandardInputData, dimension: int) -> Iterator[str]:
    """Yield what no mechanical body has, and what would be left out."""
    inertia = data.inertia(np.zeros(data.num_modes))
    coriolis = data.Ge.M0.reshape(data.num_modes, -1, 3)
    if dimension == 2:
        yield from _out_of_plane(data, inertia)
        moment, coriolis = {"J(3, 3)": inertia[2, 2]}, coriolis[:, :, 2:]
    else:
        principal = np.linalg.eigvalsh(inertia)
        # 0 of a thin bar about its axis.
        if principal[0] < -FILE_ROUNDING_SHARE * np.abs(principal).max():
            yield f"J has a moment of {principal[0]:g} kg m2; none can be negative"
        moment = {"the largest moment of J": principal[-1]}
    for name, number in ({"mass": data.mass} | moment).items():
        if not number > 0.0:
            yield f"{name} = {number:g} must be > 0"
    for name, matrix in (("Me", data.Me.M0), ("Ke", data.Ke.M0)):
        if np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0] <= 0.0:
            yield (
                f"{name} must be positive definite; the body must be held at its inboard node "
                "and its coordinates be independent"
            )
    for name, values in (("ksigma", data.ksigma.M0), ("m1 of Ke", data.Ke.M1)):
        constant = (
            "initial stresses or a stiffness that is not constant are nothing that arms have here; "
            "write the file without"
        )
        yield from _off(name, values, 0.0, constant)
    if dimension == 3 and data.Oe.order == 0:
        yield (
            "Oe has no m1, by which deflections feel the rotation of the frame; write the file "
            "with matrices of order 1"
        )
    blocks = (
        "every third column of Ge must make a skew matrix: a block of three columns for each "
        "coordinate, not one of all coordinates for each axis"
    )
    yield from _off("Ge", coriolis + coriolis.swapaxes(0, 1), 2.0 * data.Me.M0, blocks)
    if dimension == 3:
        yield from _asymmetric({"Oe": data.Oe.M1.transpose(2, 0, 1)})


def _out_of_plane(data: sid.StandardInputData, inertia: np.ndarray) -> Iterator[str]:
    """Yield by what plane motion would leave the plane."""
    for name, values, matrix in (
        ("row 3 of mdCM", data.mdCM.M0[2], data.mdCM.M0),
        ("J(1, 3), J(2, 3)", inertia[:2, 2], inertia),
        ("column 3 of Ct", data.Ct.M0[:, 2], data.Ct.M0),
        ("columns 1, 2 of Cr", data.Cr.M0[:, :2], data.Cr.M0),
    ):
        yield from _off(name, values, matrix, "an arm must move in the x-y plane only")


def _half_stiffened(
    data: sid.StandardInputData, tips: Sequence[sid.Node], dimension: int
) -> Iterator[str]:
    """Yield which matrices lack the geometric stiffness that others hold."""
    # A body that its own inertia stiffens, but no load at its outboard node, or the other way
    # round, is taken for one whose file lacks matrices. In space a stubby link's rotation may do
    # little.
    along, _ = _axes(dimension)
    excess, Me = _centrifugal_excess(data, dimension), data.Me.M0
    rotation = bool(np.abs(excess).max() > CENTRIFUGAL_EXCESS_SHARE * np.abs(Me).max())
    result = {"m1 of Ct": bool(data.Ct.M1[:, :, along].any())}
    if dimension == 2:
        result["m1 of Oe beyond -Me"] = rotation
    for tip in tips:
        result[f"m1 of phi of node {tip.name}"] = bool(tip.phi.M1[along].any())
    present = [name for name in result if result[name]]
    lacking = [name for name in result if not result[name]]
    if present and lacking:
        yield (
            f"{present[0]} holds geometric stiffening, which {lacking[0]} lacks; write the file "
            "with that of all accelerations and of the outboard node's forces, or with none"
        )
    if rotation and not present:
        yield (
            "columns 1 to 3 of m1 of Oe do not add up to -2 Me: either they hold geometric "
            "stiffness, which m1 of Ct and phi lack, or nodes have moments of inertia of their "
            "own, which bodies do not have here"
        )


def _asymmetric(matrices: Mapping[str, np.ndarray]) -> Iterator[str]:
    """Yield what one load or rotation does to the coordinates (loads, q, q) without symmetry."""
    symmetric = (
        "must be symmetric in coordinates and rows or columns: it is what one load or rotation "
        "does to the stiffness"
    )
    # Relative to the largest under the same name: of a load that does nothing rounding is left.
    for name, loads in matrices.items():
        yield from _off(f"m1 of {name}", loads - loads.swapaxes(1, 2), loads, symmetric)
