"""Bodies in the standard's format, of plane and space: round trips, forces by its numbers."""

from dataclasses import replace

import numpy as np
import pytest
from bodies import random_cloud, random_tree
from bodies import stiffened as bent
from readers import forces_of_sid, random_state
from runs import refused

from dolfinopt.exchange.in_space import in_space
from dolfinopt.exchange.standard_input import from_sid, load_body, to_sid
from dolfinopt.multibody.body import BodyMotion, Constants
from dolfinopt.multibody.frames import Interface
from dolfinopt.multibody.newton_euler import inverse_dynamics
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import TABLE
from dolfinopt.scene.sid import (
    Taylor,
    read_sid,
    write_sid,
)

pytestmark = pytest.mark.serial  # ranks have no part in it

# Sums of some dozens of products of numbers of size one; measured: 1e-15.
ROUNDING = 1e-12


def assert_close(found, expected, tolerance=ROUNDING, size=1.0):
    scale = max(size, float(np.abs(expected).max(initial=0.0)))
    assert np.abs(np.asarray(found) - expected).max(initial=0.0) < tolerance * scale


def stiffened(body, seed):
    """Return the body with geometric stiffness, but what the inertia of the modes stiffens.

    The format does not hold that.
    """
    found = bent(np.random.default_rng(seed), body)
    return replace(found, along_modes=np.zeros((0, body.num_modes, body.num_modes)))


def body_of(dimension, seed, q):
    """Return a body with matrices that are symmetric or skew in all bits, as arms have them."""
    body = random_cloud(np.random.default_rng(seed), q, dimension).body()
    if dimension == 3:
        return body
    W = body.W + np.array([1.0, -1.0])[:, None, None] * body.W.swapaxes(1, 2)
    return replace(body, W=0.5 * W, K=0.5 * (body.K + body.K.T), D=0.5 * (body.D + body.D.T))


PLANE_AND_SPACE = pytest.mark.parametrize("dimension", [2, 3])
STIFF = pytest.mark.parametrize("stiff", [False, True])


def sid_of(body, comment=""):
    return to_sid(body if len(body.w) == 3 else in_space(body), comment)


def same(found, body):
    """Assert that a plane body is back in every bit, one in space to rounding."""
    for one in TABLE:
        a, b = (np.asarray(getattr(x, one.name), dtype=float) for x in (found, body))
        if one.name == "along_modes" and len(body.w) == 2:
            continue  # a file does not hold what the inertia of the modes stiffens
        if len(body.w) == 2:
            assert a.shape == b.shape and np.array_equal(a, b), one.name
        elif b.size:
            assert_close(a, b)


@pytest.mark.parametrize("q", [1, 4])
@PLANE_AND_SPACE
def test_round_trip(tmp_path, dimension, q):
    body = body_of(dimension, q, q)
    path, data = tmp_path / "a.sid", sid_of(body, "a cloud")
    write_sid(path, data)
    again = read_sid(path)
    same(from_sid(again, dimension), body)
    assert [node.name for node in again.nodes] == ["1", "2"]
    assert again.comment == "a cloud" and len(again.names) == q


@STIFF
def test_body_of_a_file_in_a_machine(tmp_path, stiff):
    """The same inverse dynamics, though inertia and stiffness are told apart by a guess."""
    rng = np.random.default_rng(7)
    body = random_cloud(rng, 4, 3).body()
    body = stiffened(body, 2) if stiff else body
    write_sid(tmp_path / "a.sid", to_sid(body))
    tree = random_tree(rng).mechanism
    motion, rates = RigidMotion(*rng.normal(size=(3, 5, 4))), 0.3 * rng.normal(size=(3, 5, 9))

    def forces(one):
        bodies = (*tree.bodies[:1], one, *tree.bodies[2:])
        return inverse_dynamics(replace(tree, bodies=bodies), motion, *rates)

    again = load_body(tmp_path / "a.sid", 3)
    assert again.is_stiffened == stiff
    for found, expected in zip(forces(again), forces(body), strict=True):
        assert_close(found, expected)


@STIFF
def test_several_interfaces(tmp_path, stiff):
    """A node each, the outboard one last; loads on all of them stiffen."""
    rng = np.random.default_rng(9)
    body = random_cloud(rng, 4, 3, 2).body()
    body = stiffened(body, 9) if stiff else body
    data = to_sid(body)
    assert [node.name for node in data.nodes] == ["1", "3", "2"]
    write_sid(tmp_path / "a.sid", data)
    again = load_body(tmp_path / "a.sid", 3, further={"3": (0.4, 0.3, 0.2)})
    for name in ("outboard", "points", "K0_outboard"):
        assert np.array_equal(getattr(again, name), getattr(body, name)), name
    with refused("'tool'", "1, 3, 2"):
        from_sid(data, 3, further=["tool"])


def moving(body, s):
    frame = tuple(x[:, None] for x in (s.a, s.w, s.g))
    return BodyMotion(Constants(body), frame, np.stack([s.q, s.qd, s.qdd], axis=1)[:, :, None])


@pytest.mark.parametrize("seed", range(3))
@STIFF
@PLANE_AND_SPACE
def test_forces_of_the_file(tmp_path, dimension, stiff, seed):
    """The standard's equations with the file's numbers; any motion, all loads' stiffness."""
    body = body_of(dimension, 1, 4)
    body = stiffened(body, 2) if stiff else body
    write_sid(tmp_path / "a.sid", sid_of(body))
    data, s = read_sid(tmp_path / "a.sid"), random_state(np.random.default_rng(seed), 4)
    force, moment, rows = forces_of_sid(data, s)
    expected = moving(body if dimension == 3 else in_space(body), s)
    size = 10.0 * float(np.abs(rows).max())
    assert_close(force, expected.load[:3, 0], size=size)
    assert_close(moment, expected.load[3:, 0], size=size)
    assert_close(rows + data.Ke.M0 @ s.q + data.De.M0 @ s.qd, expected.rows({})[:, 0], size=size)


@STIFF
@PLANE_AND_SPACE
def test_outboard_node(dimension, stiff):
    """Loads on the node do work on phi(q) and psi(q); its frame is turned by psi to first order."""
    body = body_of(dimension, 1, 4)
    body = stiffened(body, 2) if stiff else body
    data, s = sid_of(body), random_state(np.random.default_rng(3), 4)
    body = body if dimension == 3 else in_space(body)
    held, tip = data.nodes
    assert not (held.phi.M0.any() or held.psi.M0.any() or held.origin.M0.any())
    moved = moving(body, s)
    B = moved.V[Interface(moved).places][:, :, 0]
    assert_close(np.concatenate([tip.phi.at(s.q), tip.psi.at(s.q)]), B)
    assert_close(tip.origin.at(s.q)[:, 0], body.outboard_point + body.outboard[:3] @ s.q)
    small = 1e-7 * s.q
    turned = Interface(moving(body, replace(s, q=small))).turning.R[:, :, 0]
    assert np.abs(tip.AP.at(small) - turned).max() < 1e-13


def swap(data, name, which="M0", **entries):
    """Return the data with entries of one matrix replaced, e.g. r31=1.0."""
    matrix = getattr(data, name)
    values = getattr(matrix, which).copy()
    for place, value in entries.items():
        values[tuple(int(digit) - 1 for digit in place[1:])] = value
    order = 1 if which == "M1" else matrix.order
    return replace(data, **{name: replace(matrix, **{which: values, "order": order})})


def node(data, place, name, which="M0", **entries):
    nodes = list(data.nodes)
    nodes[place] = swap(nodes[place], name, which, **entries)
    return replace(data, nodes=tuple(nodes))


def foreign(rng):
    """Return a plane body's data as of another program: its own nodes, J 3 x 3."""
    body = body_of(2, rng, 2)
    data = sid_of(body)
    J, J_q = data.inertia(np.zeros(2)), np.zeros((3, 2, 3))
    held, tip = data.nodes
    mid = replace(tip, name="9")
    nodes = (replace(held, name="7"), mid, replace(tip, name="4"))
    return body, replace(data, nodes=nodes, J=Taylor(J, J_q, 1, 2))


def test_a_body_of_another_program():
    body, data = foreign(np.random.default_rng(5))
    same(from_sid(data, 2), body)


def test_noise_of_another_program_is_no_motion_out_of_the_plane():
    body, data = foreign(np.random.default_rng(6))
    noisy = swap(swap(data, "Ct", r13=1e-9), "mdCM", r31=1e-12)
    same(from_sid(noisy, 2), body)


def test_a_plane_file_may_leave_out_what_the_plane_does_not_feel():
    body = body_of(2, 8, 2)
    data = sid_of(body)
    Oe = replace(data.Oe, order=0)
    same(from_sid(replace(swap(data, "J", r11=0.0, r21=0.0, r41=0.0), Oe=Oe), 2), body)


# What is changed of a body's data, of which dimensions, and the words that must be told.
REFUSED = {
    "one node": (lambda d: replace(d, nodes=d.nodes[:1]), (2, 3), "an outboard node", "1"),
    "no node": (lambda d: replace(d, nodes=()), (2, 3), "lacks an outboard node", "none"),
    "inboard away": (lambda d: node(d, 0, "origin", r11=0.1), (2, 3), "origin of node 1"),
    "inboard moves": (lambda d: node(d, 0, "phi", r21=0.1), (2, 3), "phi of node 1", "held"),
    "inboard turns": (lambda d: node(d, 0, "psi", r31=0.1), (2, 3), "psi of node 1", "held"),
    "out of plane": (lambda d: node(d, 1, "phi", r31=0.1), (2,), "node 2", "outboard", "plane"),
    "twists": (lambda d: node(d, 1, "psi", r11=0.1), (2,), "psi of node 2", "plane"),
    "raised": (lambda d: node(d, 1, "origin", r31=0.1), (2,), "origin of node 2", "z"),
    "turned": (lambda d: node(d, 1, "AP", r12=0.1), (2, 3), "AP of node 2", "parallel"),
    "no length": (lambda d: node(d, 1, "origin", r11=0.0, r21=0.0, r31=0.0), (2, 3),
                  "node 2 is at the origin"),
    "mdCM": (lambda d: swap(d, "mdCM", r31=0.1), (2,), "row 3 of mdCM", "x-y plane"),
    "J": (lambda d: swap(d, "J", r51=0.1), (2,), "J(1, 3)", "x-y plane"),
    "Ct": (lambda d: swap(d, "Ct", r13=0.1), (2,), "column 3 of Ct"),
    "Cr": (lambda d: swap(d, "Cr", r11=0.1), (2,), "columns 1, 2 of Cr"),
    "stress": (lambda d: swap(d, "ksigma", r11=1.0), (2, 3), "ksigma", "initial stresses"),
    "stiffness": (lambda d: swap(d, "Ke", "M1", r111=1.0), (2, 3), "m1 of Ke", "not constant"),
    "push alone": (lambda d: swap(d, "Ct", "M1", r113=1.0), (3,),
                   "m1 of Ct holds geometric stiffening, which m1 of phi of node 2 lacks"),
    "rotation alone": (lambda d: swap(d, "Oe", "M1", r113=0.2), (2,),
                       "m1 of Oe beyond -Me holds geometric stiffening, which m1 of Ct lacks"),
    "rotation alone in space": (lambda d: swap(d, "Oe", "M1", r112=9.0), (3,),
                                "do not add up to -2 Me", "m1 of Ct and phi lack"),
    "without rotation": (
        lambda d: node(swap(d, "Ct", "M1", r111=0.2), 1, "phi", "M1", r111=0.2), (2,),
        "m1 of Ct holds geometric stiffening", "m1 of Oe beyond -Me lacks"),
    "without forces": (
        lambda d: swap(swap(d, "Oe", "M1", r113=0.2), "Ct", "M1", r111=0.2), (2, 3),
        "m1 of Ct holds geometric stiffening", "m1 of phi of node 2 lacks"),
    "rotation": (lambda d: swap(d, "Oe", "M1", r124=9.0), (3,), "m1 of Oe", "symmetric"),
    "push": (lambda d: swap(sid_of(stiffened(from_sid(d, 2), 1)), "Ct", "M1", r121=9.0), (2,),
             "m1 of Ct", "symmetric"),
    "outboard load": (
        lambda d: node(swap(d, "Ct", "M1", r113=1.0), 1, "phi", "M1", r112=1.0), (3,),
        "m1 of phi, psi of node 2", "symmetric"),
    "no order": (lambda d: replace(d, Oe=replace(d.Oe, order=0)), (3,),
                 "Oe has no m1", "matrices of order 1"),
    "Ge": (lambda d: swap(d, "Ge", r13=0.2), (2, 3), "Ge", "skew"),
    "massless": (lambda d: replace(d, mass=0.0), (2, 3), "mass = 0", "> 0"),
    "inertia": (lambda d: swap(d, "J", r31=-1.0), (2,), "J(3, 3) = -1"),
    "a moment": (lambda d: swap(d, "J", r21=-9.0), (3,), "J has a moment of -"),
    "modal mass": (lambda d: swap(d, "Me", r22=-1.0), (2, 3), "Me", "definite"),
    "loose": (lambda d: swap(d, "Ke", r11=0.0, r12=0.0, r21=0.0), (2, 3), "Ke", "held"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "dimension"), [(name, d) for name, one in REFUSED.items() for d in one[1]]
)
def test_what_is_no_body_is_refused(name, dimension):
    change, _, *words = REFUSED[name]
    data = sid_of(body_of(dimension, 3, 2))
    from_sid(data, dimension)
    with refused("tip.sid: ", *words):
        from_sid(change(data), dimension, source="tip.sid")


@pytest.mark.parametrize(
    ("dimension", "place", "wanted"),
    [(2, "(1, 0.2) m", "(1, 0) m"), (3, "(1, 0.2, -0.1) m", "(1, 0, 0) m")],
)
def test_length_must_agree(tmp_path, dimension, place, wanted):
    body = body_of(dimension, 1, 4)
    write_sid(tmp_path / "a.sid", sid_of(body))
    with refused("a.sid: ", place, wanted, "arms.length"):
        load_body(tmp_path / "a.sid", dimension, length=1.0)
    point = np.zeros(dimension)
    point[0] = 0.5
    write_sid(tmp_path / "b.sid", sid_of(replace(body, outboard_point=point)))
    assert load_body(tmp_path / "b.sid", dimension, length=0.5).outboard_point[0] == 0.5


def test_interfaces_must_agree(tmp_path):
    cloud = random_cloud(np.random.default_rng(1), 4, 3, 2)
    straight = replace(cloud, ends=np.array([[1.0, 0.0, 0.0], [0.4, 0.3, 0.2]])).body()
    write_sid(tmp_path / "b.sid", to_sid(straight))
    assert len(load_body(tmp_path / "b.sid", 3, 1.0, {"3": (0.4, 0.3, 0.2)}).points) == 2
    with refused("node 3", "(0.4, 0.3, 0.2) m"):
        load_body(tmp_path / "b.sid", 3, 1.0, {"3": (0.4, 0.3, 0.0)})
