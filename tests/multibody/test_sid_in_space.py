"""Bodies in space as standard input data and for MBDyn: forces by the files' numbers alone."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from mbdyn_reader import mbdyn_forces, mbdyn_stiffening, read_as_mbdyn_does
from spatial_bodies import random_tree, spatial_cloud, stiffened
from standard_input import State, forces_of_sid, random_state

from dolfinopt.errors import InputError
from dolfinopt.exchange.mbdyn import Invariants, ModalElement, fem_text, read_fem, write_fem
from dolfinopt.exchange.sid import read_sid, read_sid_npz, write_sid, write_sid_npz
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import TABLE, ShapeIntegrals
from dolfinopt.multibody.spatial.body_of_sid import from_sid, load_body
from dolfinopt.multibody.spatial.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.spatial.kinematics import BodyMotion, Interface
from dolfinopt.multibody.spatial.mbdyn import modal_element
from dolfinopt.multibody.spatial.mechanism import constants_of
from dolfinopt.multibody.spatial.standard_input import to_sid

pytestmark = pytest.mark.serial  # ranks have no part in it
ROUNDING = 1e-12
q = 4


@pytest.fixture(scope="module")
def cloud():
    """Point masses without any symmetry."""
    return spatial_cloud(np.random.default_rng(1), q)


@pytest.fixture(scope="module", params=[False, True], ids=["linear", "stiffened"])
def body(request, cloud):
    """Their body, with geometric stiffness by all 18 loads or without."""
    found = cloud.body()
    if not request.param:
        return found
    # Neither format holds what the inertia of the modes stiffens.
    return replace(stiffened(np.random.default_rng(2), found), along_modes=np.zeros((0, q, q)))


def moving(body: ShapeIntegrals, s: State) -> BodyMotion:
    frame, rates = ((x[None] for x in part) for part in ((s.a, s.w, s.g), (s.q, s.qd, s.qdd)))
    return BodyMotion(constants_of(body), tuple(frame), tuple(rates))


def assert_close(found, expected) -> None:
    assert np.abs(found - expected).max() < ROUNDING * max(1.0, np.abs(expected).max())


# -- standard input data ---------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_forces_of_the_file(tmp_path, body, seed):
    """The standard's equations with the file's numbers; any motion, all 18 loads' stiffness."""
    write_sid(tmp_path / "a.sid", to_sid(body, "a cloud"))
    data, s = read_sid(tmp_path / "a.sid"), random_state(np.random.default_rng(seed), q)
    force, moment, rows = forces_of_sid(data, s)
    expected = moving(body, s)
    assert_close(force, expected.load[0][0])
    assert_close(moment, expected.load[1][0])
    assert_close(rows + data.Ke.M0 @ s.q + data.De.M0 @ s.qd, expected.rows[0])


def test_forces_of_the_points(cloud):
    """Of a linear body point by point, without the package's integrals."""
    data, s = to_sid(cloud.body()), random_state(np.random.default_rng(5), q)
    force, moment, rows = np.zeros(3), np.zeros(3), np.zeros(q)
    for X, mass, Phi in zip(cloud.points, cloud.masses, cloud.modes, strict=True):
        p = X + Phi @ s.q
        turned = np.cross(s.g, p) + np.cross(s.w, np.cross(s.w, p))
        load = mass * (s.a + turned + 2.0 * np.cross(s.w, Phi @ s.qd) + Phi @ s.qdd)
        force, moment, rows = force + load, moment + np.cross(p, load), rows + Phi.T @ load
    for found, expected in zip(forces_of_sid(data, s), (force, moment, rows), strict=True):
        assert_close(found, expected)


def test_outboard_node(body):
    """Loads on the node do work on phi(q) and psi(q); its frame is turned by psi to first order."""
    data, s = to_sid(body), random_state(np.random.default_rng(3), q)
    held, tip = data.nodes
    assert not (held.phi.M0.any() or held.psi.M0.any() or held.origin.M0.any())
    interface = Interface(moving(body, s))
    B = interface.B[0] if body.is_stiffened else interface.B
    assert_close(np.concatenate([tip.phi.at(s.q), tip.psi.at(s.q)]), B)
    assert_close(tip.origin.at(s.q)[:, 0], body.outboard_point + body.outboard[:3] @ s.q)
    small = 1e-7 * s.q
    turned = Interface(moving(body, replace(s, q=small))).turning.R[0]
    assert np.abs(tip.AP.at(small) - turned).max() < 1e-13


@pytest.mark.parametrize("kind", ["sid", "npz"])
def test_body_of_a_file(tmp_path, body, kind):
    """The same inverse dynamics in a machine; of a linear body the same integrals."""
    path, data = tmp_path / f"a.{kind}", to_sid(body)
    (write_sid if kind == "sid" else write_sid_npz)(path, data)
    again = load_body(path) if kind == "sid" else from_sid(read_sid_npz(path))
    assert again.is_stiffened == body.is_stiffened
    for one in TABLE:
        told_apart = body.is_stiffened and one.name in ("W", "K0")  # their difference is there
        expected = np.asarray(getattr(body, one.name))
        if expected.size and not told_apart:
            assert_close(getattr(again, one.name), expected)
    assert_close(again.M, body.M)
    rng = np.random.default_rng(7)
    tree = random_tree(rng).mechanism()
    motion, rates = RigidMotion(*rng.normal(size=(3, 5, 4))), 0.3 * rng.normal(size=(3, 5, 9))

    def forces(one):
        bodies = (*tree.bodies[:1], one, *tree.bodies[2:])
        return inverse_dynamics(replace(tree, bodies=bodies), motion, *rates)

    for found, expected in zip(forces(again), forces(body), strict=True):
        assert_close(found, expected)


def test_stiffness_of_a_slender_link_is_told_from_its_mass():
    """Loads that act across the link at places across it are none: the split is exact then."""
    rng = np.random.default_rng(4)
    body = stiffened(rng, spatial_cloud(rng, q).body())
    K0 = body.K0.copy()
    K0[[4, 5, 7, 8, 10, 11]] = 0.0  # A_ab with b = y, z: the columns xy, xz, yy, yz, zy, zz
    body = replace(body, K0=K0)
    again = from_sid(to_sid(body))
    assert_close(again.K0, body.K0)
    assert_close(again.W, body.W)


@pytest.mark.parametrize("stiff", [False, True])
def test_several_interfaces(tmp_path, stiff):
    """A node each, the outboard one last; loads on all of them stiffen, in MBDyn's file, too."""
    rng = np.random.default_rng(9)
    body = spatial_cloud(rng, q, interfaces=2).body()
    if stiff:
        K0 = rng.normal(size=(24, q, q))
        K0 = K0 + K0.swapaxes(1, 2)
        body = replace(body, K0=K0[:12], K0_outboard=K0[12:])
    data = to_sid(body)
    assert [node.name for node in data.nodes] == ["1", "3", "2"]
    write_sid(tmp_path / "a.sid", data)
    again = load_body(tmp_path / "a.sid", further={"3": (0.4, 0.3, 0.2)})
    for name in ("outboard", "points", "K0_outboard"):
        assert np.array_equal(getattr(again, name), getattr(body, name)), name
    element = modal_element(body)
    assert element.labels == ("1", "2", "3")
    assert np.array_equal(element.points[1:], body.points)
    assert np.array_equal(np.concatenate(element.modes[1:]), body.outboard)
    assert list(element.loads) == list(range(1, 25 if stiff else 1))
    assert np.array_equal(element.stiffening[12:], body.K0_outboard)
    with pytest.raises(InputError, match="no node 'tool'; it has 1, 3, 2"):
        from_sid(data, further=["tool"])


def changed(data, name, which, place, value):
    matrix = getattr(data, name)
    values = getattr(matrix, which).copy()
    values[place] = value
    order = 1 if which == "M1" else matrix.order
    return replace(data, **{name: replace(matrix, **{which: values, "order": order})})


def moved(data, k, name, which, place, value):
    nodes = list(data.nodes)
    nodes[k] = changed(nodes[k], name, which, place, value)
    return replace(data, nodes=tuple(nodes))


REFUSED = {
    "one node": (lambda d: replace(d, nodes=d.nodes[:1]), ["lacks an outboard node"]),
    "inboard away": (lambda d: moved(d, 0, "origin", "M0", (2, 0), 0.1), ["origin of node 1"]),
    "inboard moves": (lambda d: moved(d, 0, "psi", "M0", (0, 1), 0.1), ["psi of node 1", "held"]),
    "turned": (lambda d: moved(d, 1, "AP", "M0", (0, 2), 0.1), ["AP of node 2", "parallel"]),
    "no order": (
        lambda d: replace(d, Oe=replace(d.Oe, order=0)),
        ["Oe has no m1", "matrices of order 1"],
    ),
    "mass": (lambda d: replace(d, mass=-1.0), ["mass = -1 must be > 0"]),
    "inertia": (
        lambda d: changed(d, "J", "M0", (1, 0), -9.0),
        ["J has a moment of -"],
    ),
    "stiffness": (lambda d: changed(d, "Ke", "M0", (0, 0), -9.0), ["Ke must be positive definite"]),
    "stress": (lambda d: changed(d, "ksigma", "M0", (0, 0), 1.0), ["initial stresses"]),
    "Ge": (lambda d: changed(d, "Ge", "M0", (0, 0), 1.0), ["Ge must make a skew matrix"]),
    "push alone": (
        lambda d: changed(d, "Ct", "M1", (0, 0, 2), 1.0),
        ["m1 of Ct holds geometric stiffening, which m1 of phi of node 2 lacks"],
    ),
    "rotation alone": (
        lambda d: changed(d, "Oe", "M1", (0, 0, 1), 9.0),
        ["do not add up to -2 Me", "m1 of Ct and phi lack"],
    ),
    "rotation": (
        lambda d: changed(d, "Oe", "M1", (0, 1, 3), 9.0),
        ["m1 of Oe must be symmetric"],
    ),
    "not symmetric": (
        lambda d: moved(changed(d, "Ct", "M1", (0, 0, 2), 1.0), 1, "phi", "M1", (0, 0, 1), 1.0),
        ["m1 of phi, psi of node 2 must be symmetric"],
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_body_is_refused(cloud, name):
    change, words = REFUSED[name]
    with pytest.raises(InputError) as caught:
        from_sid(change(to_sid(cloud.body())), source="a.sid")
    assert str(caught.value).startswith("a.sid: ") and "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_length_of_a_file(tmp_path, cloud):
    write_sid(tmp_path / "a.sid", to_sid(cloud.body()))
    with pytest.raises(InputError, match=r"at \(1, 0.2, -0.1\) m, but the arm's length is 1 m"):
        load_body(tmp_path / "a.sid", length=1.0)
    straight = replace(cloud, ends=np.array([[1.0, 0.0, 0.0], [0.4, 0.3, 0.2]]))
    two = replace(straight, outboard=np.tile(cloud.outboard, (2, 1))).body()
    write_sid(tmp_path / "b.sid", to_sid(two))
    assert len(load_body(tmp_path / "b.sid", 1.0, {"3": (0.4, 0.3, 0.2)}).points) == 2
    with pytest.raises(InputError, match=r"node 3 is at \(0.4, 0.3, 0.2\) m, but the arm's inter"):
        load_body(tmp_path / "b.sid", 1.0, {"3": (0.4, 0.3, 0.0)})


# -- MBDyn -----------------------------------------------------------------------------------


def test_forces_of_mbdyn(body):
    """MBDyn's equations with the file's numbers: rows of any body, forces of a linear one."""
    groups = read_as_mbdyn_does(fem_text(modal_element(body)))
    assert sorted(groups) == [1, 2, *range(5, 11), *range(12, 19), *[19] * body.is_stiffened]
    s = random_state(np.random.default_rng(6), q)
    force, moment, rows = mbdyn_forces(groups, s)
    expected = moving(body, s)
    assert_close(rows, expected.rows[0])
    if not body.is_stiffened:  # motion of the second order is not in the format
        assert_close(force, expected.load[0][0])
        assert_close(moment, expected.load[1][0])


def test_mbdyn_stiffens_by_loads_outboard(cloud):
    """A load on the interface stiffens as in the package, in which it acts from outside."""
    body = stiffened(np.random.default_rng(2), cloud.body())
    groups = read_as_mbdyn_does(fem_text(modal_element(body)))
    load, still = np.random.default_rng(8).normal(size=(2, 3)), np.zeros(3)
    found = mbdyn_stiffening(groups, still, still, still, *load)
    assert_close(found, -np.tensordot(load.ravel(), body.K0_outboard, 1))


def test_invariants_are_sums_over_points(cloud):
    """As MBDyn would make them of lumped masses (modal.cc), were the points its nodes."""
    m, X, Phi = cloud.masses, cloud.points, np.moveaxis(cloud.modes, 2, 1)  # (n, q, 3)
    tilde = np.cross(np.eye(3), Phi[..., None, :])  # (n, q, 3, 3), v -> Phi x v
    place = np.cross(np.eye(3), X[:, None])
    v = np.array([0.3, -1.0, 2.0])
    assert_close(tilde[2, 1] @ v, np.cross(Phi[2, 1], v))
    expected = Invariants(
        three=np.einsum("n,njc->cj", m, Phi),
        four=np.einsum("n,njc->cj", m, np.cross(X[:, None], Phi)),
        five=np.einsum("n,njkc->cjk", m, np.cross(Phi[:, :, None], Phi[:, None])),
        eight=-np.einsum("n,nab,njbc->acj", m, place, tilde),
        nine=np.einsum("n,njab,nkbc->acjk", m, tilde, tilde),
    )
    element = modal_element(cloud.body())
    for field in fields(Invariants):
        assert_close(getattr(element.invariants, field.name), getattr(expected, field.name))
    centre = m @ X / m.sum()
    assert_close(element.centre, centre)
    away = X - centre
    inertia = np.einsum("n,nij->ij", m, [(x @ x) * np.eye(3) - np.outer(x, x) for x in away])
    assert_close(element.inertia, inertia)


def test_element_round_trip(tmp_path, body):
    element = modal_element(body)
    write_fem(tmp_path / "a.fem", element)
    again = read_fem(tmp_path / "a.fem")
    for field in fields(ModalElement):
        if field.name == "invariants":
            continue
        assert np.array_equal(getattr(again, field.name), getattr(element, field.name)), field.name
    for field in fields(Invariants):
        ours, theirs = (getattr(one.invariants, field.name) for one in (element, again))
        assert np.array_equal(ours, theirs), field.name
    assert again.labels == ("1", "2") and np.array_equal(again.points[1], body.outboard_point)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("GROUP 16,", "16,", ["record group 16, INVARIANT 8, is missing"]),
        ("GROUP 18,", "GROUP 11,", ["11 and 14 to 18 exclude each other", "remove one of them"]),
    ],
)
def test_damaged_element(tmp_path, cloud, old, new, words):
    path, text = tmp_path / "a.fem", fem_text(modal_element(cloud.body()))
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_fem(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)
