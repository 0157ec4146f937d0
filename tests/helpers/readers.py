"""Forces of one body by standard input data and by MBDyn's modal element, as programs read them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.scene.sid import StandardInputData

Forces = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class State:
    """Motion of a frame in space and of the coordinates in it, components in the frame."""

    a: np.ndarray
    w: np.ndarray
    g: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


def random_state(rng: np.random.Generator, q: int) -> State:
    """Return any state."""
    return State(*rng.normal(size=(3, 3)), *rng.normal(scale=0.5, size=(3, q)))


def forces_of_sid(data: StandardInputData, s: State) -> Forces:
    """Return force, moment about the origin and elastic rows, by the floating frame's equations."""
    q, w = len(s.q), s.w
    Gr, Ge = data.Gr.at(s.q).reshape(3, q, 3), data.Ge.at(s.q).reshape(q, q, 3)
    Ct, Cr, Oe = data.Ct.at(s.q), data.Cr.at(s.q), data.Oe.at(s.q)
    centre = data.mdCM.at(s.q)[:, 0] + 0.5 * np.einsum("klc,k,l->c", data.Ct.M1, s.q, s.q)
    quadratic = np.einsum("k,l,ilkj->ij", s.q, s.q, data.Gr.M1.reshape(3, q, q, 3))
    J = data.inertia(s.q) + 0.25 * (quadratic + quadratic.T)
    products = np.array([w[0] ** 2, w[1] ** 2, w[2] ** 2, w[0] * w[1], w[1] * w[2], w[0] * w[2]])
    force = (
        data.mass * s.a
        + np.cross(s.g, centre)
        + np.cross(w, np.cross(w, centre))
        + 2.0 * np.cross(w, Ct.T @ s.qd)
        + Ct.T @ s.qdd
        + np.einsum("klc,k,l->c", data.Ct.M1, s.qd, s.qd)
    )
    moment = (
        np.cross(centre, s.a)
        + J @ s.g
        + np.cross(w, J @ w)
        + np.einsum("ikj,k,j->i", Gr, s.qd, w)
        + Cr.T @ s.qdd
        + np.einsum("klc,k,l->c", data.Cr.M1, s.qd, s.qd)
    )
    rows = (
        Ct @ s.a
        + Cr @ s.g
        + np.einsum("ikj,k,j->i", Ge, s.qd, w)
        + Oe @ products
        + data.Me.at(s.q) @ s.qdd
    )
    return force, moment, rows


# -- MBDyn's modal element, as modal.cc and modalad.cc read and evaluate it -------------------


def read_as_mbdyn_does(text: str) -> dict[int, Any]:
    """Return the numbers of every record group, by the steps of MBDyn's reader."""
    position = 0

    def line():
        nonlocal position
        end = text.index("\n", position)
        found, position = text[position:end], end + 1
        return found

    def words(count):
        nonlocal position
        found = []
        for _ in range(count):
            while text[position].isspace():
                position += 1
            start = position
            while not text[position].isspace():
                position += 1
            found.append(text[start:position])
        return found

    def numbers(*shape):
        return np.array(words(int(np.prod(shape))), dtype=float).reshape(shape)

    groups = {}
    while position < len(text):
        title = line()
        if not title.startswith("** RECORD GROUP "):
            continue
        group = int(title[len("** RECORD GROUP ") :].split(",")[0])
        if group == 1:
            line()
            revision, *sizes = words(6)
            count, modes, *others = map(int, sizes)
            assert revision == "REV0" and others == [0, 0, 0]
            groups[1] = (count, modes)
        elif group == 2:
            groups[2] = words(count)
        elif group == 8:
            shapes = []
            for _ in range(modes):
                assert line().startswith("**")
                shapes.append(numbers(count, 6))
                assert not line().strip()
            groups[8] = np.array(shapes)
        else:
            square, nodal = (modes, modes), (count,)
            if group == 19:
                count = int(words(1)[0])
                groups[19] = [(int(words(1)[0]), numbers(*square)) for _ in range(count)]
                continue
            shapes = {5: nodal, 6: nodal, 7: nodal, 11: (count, 6), 12: (13,)}
            # Rows outermost; then the modes; then the columns of a 3 x 3 matrix.
            shapes |= {14: (3, modes), 15: (3, modes), 16: (3, modes, 3)}
            shapes |= {17: (3, modes, modes), 18: (3, modes, modes, 3)}
            groups[group] = numbers(*shapes.get(group, square))
    return groups


def mbdyn_stiffening(groups, a, w, wd, force, moment):
    """Return what MBDyn adds to the modal stiffness (left-hand side), by the steps of modalad.cc.

    By acceleration less gravity, angular velocity and acceleration, body frame, and the joint's
    force and moment on its first interface node, (3,) each.
    """
    products = [w[0] ** 2, w[1] ** 2, w[2] ** 2, w[0] * w[1], w[1] * w[2], w[2] * w[0]]
    factors = np.concatenate([products, wd, a, -force, -moment])
    return sum(factors[load - 1] * matrix for load, matrix in groups[19])


def mbdyn_forces(groups: dict[int, Any], s: State) -> Forces:
    """Return force, moment and rows of a body without lumped masses: MBDyn's residual, negative."""
    mass, centre, about_centre = groups[12][0], groups[12][1:4], groups[12][4:].reshape(3, 3)
    K, D = groups[10], groups[13]
    inv3, inv4, inv8, inv5, inv9 = (groups[k] for k in (14, 15, 16, 17, 18))
    a, b, w = s.q, s.qd, s.w
    J = about_centre + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    inv8_a, inv8_b = (np.einsum("ijc,j->ic", inv8, x) for x in (a, b))
    inv9_aa, inv9_ab = (np.einsum("ijkc,j,k->ic", inv9, a, x) for x in (a, b))
    J = J + inv8_a + inv8_a.T - inv9_aa
    S = mass * centre + inv3 @ a
    force = mass * s.a + np.cross(s.g, S) + np.cross(w, np.cross(w, S))
    force = force + inv3 @ s.qdd + 2.0 * np.cross(w, inv3 @ b)
    moment = np.cross(S, s.a) + J @ s.g + np.cross(w, J @ w) + inv4 @ s.qdd
    moment = moment + np.einsum("ijk,j,k->i", inv5, a, s.qdd) + 2.0 * (inv8_b - inv9_ab) @ w
    rows = groups[9] @ s.qdd + D @ b + K @ a
    for j in range(len(a)):
        turned = inv4[:, j] + inv5[:, :, j] @ a
        coupled = inv8[:, j].T - np.einsum("ikc,k->ic", inv9[:, j], a)
        rows[j] += inv3[:, j] @ s.a + turned @ s.g + 2.0 * (inv5[:, :, j] @ b) @ w
        rows[j] -= w @ coupled @ w
    if 19 in groups:
        still = np.zeros(3)
        rows = rows + mbdyn_stiffening(groups, s.a, w, s.g, still, still) @ a
    return force, moment, rows


def check_npz(path: Path, data: StandardInputData) -> None:
    """Assert that an .npz file holds these data to the bit, array by array."""
    with np.load(path, allow_pickle=False) as found:
        nodes = [(node.name, node.rframe) for node in data.nodes]
        assert float(found["mass"]) == data.mass and tuple(found["names"]) == data.names
        assert str(found["comment"]) == data.comment
        assert list(zip(found["node_names"], found["node_rframes"], strict=True)) == nodes
        matrices = [name.split("/") for name in found.files if "/" in name]
        for *node, matrix, field in matrices:
            owner = data.nodes[int(node[0][4:]) - 1] if node else data
            value = np.asarray(getattr(getattr(owner, matrix), field))
            assert found["/".join([*node, matrix, field])].tobytes() == value.tobytes()
        sigmas = sum(node.sigma is not None for node in data.nodes)
        assert len(matrices) == 5 * (11 + 4 * len(data.nodes) + sigmas)
