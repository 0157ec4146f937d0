"""Plane bodies in the spatial format: exact round trips, forces against point masses in space."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies import Cloud, assert_close, beam, random_cloud
from mpi4py import MPI
from standard_input import State, forces_of_sid, random_state

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.errors import InputError
from dolfinopt.exchange.sid import Taylor, read_sid, read_sid_npz, write_sid, write_sid_npz
from dolfinopt.fem.elasticity import Substructure
from dolfinopt.fem.elements import LagrangeElement
from dolfinopt.fem.geometric_stiffness import unit_loads
from dolfinopt.mesh.arm_mesh import structured_arm
from dolfinopt.multibody.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import (
    TABLE,
    ShapeIntegrals,
    SpatialMoments,
    linear_part,
    shape_integrals,
    slender_moments,
    spatial_moments,
)
from dolfinopt.multibody.standard_input import PlaneNode, from_sid, load_body, to_sid
from dolfinopt.profiling import Profile
from dolfinopt.reduction import Options, craig_bampton

pytestmark = pytest.mark.serial  # ranks have no part in it

COMM = MPI.COMM_WORLD
# Sums of some dozens of products of numbers of size one; measured: 1e-15.
ROUNDING = 1e-12
THICKNESS = 0.02  # m


def symmetric(body):
    """Return the body with matrices that are symmetric or skew in all bits, as arms have them."""
    W = body.W + np.array([1.0, -1.0])[:, None, None] * body.W.swapaxes(1, 2)
    return replace(body, W=0.5 * W, K=0.5 * (body.K + body.K.T), D=0.5 * (body.D + body.D.T))


def cloud_moments(cloud: Cloud, depth: float) -> SpatialMoments:
    m, X, Phi = cloud.masses, cloud.points, cloud.modes
    return SpatialMoments(
        second=np.einsum("n,ni,nj->ij", m, X, X),
        depth=m.sum() * depth**2,
        first=np.einsum("n,ni,njk->ijk", m, X, Phi),
        mixed=np.einsum("n,nik,njl->ijkl", m, Phi, Phi),
    )


def same(body: ShapeIntegrals, other: ShapeIntegrals) -> None:
    """Assert equality in every bit; a file does not hold what the inertia of the modes stiffens."""
    for one in TABLE:
        if one.name == "along_modes":
            continue
        a, b = (np.asarray(getattr(x, one.name), dtype=float) for x in (body, other))
        assert a.shape == b.shape and np.array_equal(a, b), one.name


def stiffened(body: ShapeIntegrals, seed: int) -> ShapeIntegrals:
    """Return the body with some geometric stiffness by all seven loads."""
    q = body.num_modes
    K0 = np.random.default_rng(seed).normal(size=(7, q, q))
    K0 += K0.swapaxes(1, 2)
    return replace(body, K0=K0[:4], K0_outboard=K0[4:])


def close(body: ShapeIntegrals, other: ShapeIntegrals) -> None:
    """Assert equality but for the rounding of K0, which Oe and Cr hold in a sum."""
    linear = {"K0": other.K0, "K0_outboard": other.K0_outboard}
    same(replace(body, **linear), other)
    scale = max(np.abs(other.M).max(), np.abs(other.K0).max())
    assert_close(body.K0, other.K0, ROUNDING, size=float(scale))
    assert np.array_equal(body.K0_outboard, other.K0_outboard)


@pytest.fixture(scope="module")
def arm():
    mesh = structured_arm(COMM, "arm", 1.2, 0.3, (10, 3))
    substructure = Substructure(mesh, LagrangeElement().operators(mesh, THICKNESS, 0.33), Profile())
    place = np.round(mesh.centroid, 9)
    x = 0.5 + 0.49 * np.sin(300.0 * place[:, 0] + 1700.0 * place[:, 1])
    elastic = substructure.at(70e9 * x**3, 2700.0 * x)
    basis = craig_bampton(elastic, Options(5))
    return elastic, basis, shape_integrals(elastic, basis, 2e-4, unit_loads(elastic))


@pytest.mark.parametrize("q", [1, 4])
@pytest.mark.parametrize("known", [True, False])
def test_round_trip_is_exact(tmp_path, q, known):
    cloud = random_cloud(np.random.default_rng(q), q)
    body = symmetric(cloud.body())
    further = [PlaneNode("mid", np.array([0.3, 0.1]), np.arange(3.0 * q).reshape(3, q))]
    data = to_sid(body, cloud_moments(cloud, 0.1) if known else None, further, "a cloud")
    same(from_sid(data), body)
    write_sid(tmp_path / "a.sid", data)
    same(load_body(tmp_path / "a.sid"), body)
    write_sid_npz(tmp_path / "a.sid.npz", data)
    same(from_sid(read_sid_npz(tmp_path / "a.sid.npz")), body)
    again = read_sid(tmp_path / "a.sid")
    assert [node.name for node in again.nodes] == ["1", "mid", "2"]
    assert again.comment == "a cloud" and len(again.names) == q


def test_round_trip_of_an_arm_is_exact(tmp_path, arm):
    elastic, basis, body = arm
    data = to_sid(body, spatial_moments(elastic, basis, THICKNESS))
    write_sid(tmp_path / "arm.sid", data)
    close(load_body(tmp_path / "arm.sid", length=1.2), body)


@pytest.mark.parametrize("q", [1, 4])
@pytest.mark.parametrize("known", [True, False])
def test_round_trip_of_geometric_stiffness(tmp_path, q, known):
    cloud = random_cloud(np.random.default_rng(q), q)
    body = stiffened(symmetric(cloud.body()), q)
    data = to_sid(body, cloud_moments(cloud, 0.1) if known else None)
    close(from_sid(data), body)
    write_sid(tmp_path / "a.sid", data)
    close(load_body(tmp_path / "a.sid"), body)
    write_sid_npz(tmp_path / "a.sid.npz", data)
    close(from_sid(read_sid_npz(tmp_path / "a.sid.npz")), body)


# -- forces ----------------------------------------------------------------------------------


def forces_of_points(cloud: Cloud, depth: float, s: State):
    """Return force, moment and elastic rows, point by point; half the mass at z = -+ depth."""
    force, moment, rows = np.zeros(3), np.zeros(3), np.zeros(len(s.q))
    for X, mass, modes in zip(cloud.points, cloud.masses, cloud.modes, strict=True):
        Phi = np.vstack([modes, np.zeros(len(s.q))])
        for z in (-depth, depth):
            p = np.append(X, z) + Phi @ s.q
            acceleration = (
                s.a
                + np.cross(s.g, p)
                + np.cross(s.w, np.cross(s.w, p))
                + 2.0 * np.cross(s.w, Phi @ s.qd)
                + Phi @ s.qdd
            )
            load = 0.5 * mass * acceleration
            force, moment, rows = force + load, moment + np.cross(p, load), rows + Phi.T @ load
    return force, moment, rows


@pytest.mark.parametrize("seed", range(4))
def test_spatial_forces_are_those_of_the_points(seed):
    """Any motion of the frame in space, a body without symmetry, mass off the middle plane."""
    rng = np.random.default_rng(seed)
    cloud, depth = random_cloud(rng, 3), 0.3
    data = to_sid(cloud.body(), cloud_moments(cloud, depth))
    state = random_state(rng, 3, plane=False)
    found, expected = forces_of_sid(data, state), forces_of_points(cloud, depth, state)
    for ours, theirs in zip(found, expected, strict=True):
        assert_close(ours, theirs, ROUNDING)


@pytest.mark.parametrize("known", [True, False])
def test_plane_forces_are_the_planar_ones(known):
    """Against the point masses, the design's planar formulas and the mechanism of one arm."""
    rng = np.random.default_rng(7)
    cloud = random_cloud(rng, 3)
    body = cloud.body()
    data = to_sid(body, cloud_moments(cloud, 0.3) if known else None)
    s = random_state(rng, 3, plane=True)
    force, moment, rows = forces_of_sid(data, s)
    by_points = forces_of_points(cloud, 0.0, s)
    for ours, theirs in zip((force, moment, rows), by_points, strict=True):
        assert_close(ours, theirs, ROUNDING)
    assert force[2] == 0.0 and np.array_equal(moment[:2], [0.0, 0.0])

    S, a, w, g = np.array([[0.0, -1.0], [1.0, 0.0]]), s.a[:2], s.w[2], s.g[2]
    centre = body.moment + body.C @ s.q
    planar_force = body.mass * a + g * S @ centre - w**2 * centre
    planar_force += 2.0 * w * S @ body.C @ s.qd + body.C @ s.qdd
    inertia = body.inertia + 2.0 * body.j @ s.q + s.q @ body.M @ s.q
    planar_moment = (S @ centre) @ a + inertia * g
    planar_moment += 2.0 * w * (body.j + body.M @ s.q) @ s.qd + (body.r + body.G @ s.q) @ s.qdd
    assert_close(force[:2], planar_force, ROUNDING)
    assert_close(moment[2], planar_moment, ROUNDING)

    # One arm on a fixed cart, at angle zero, gravity instead of the frame's acceleration.
    mechanism = Mechanism((from_sid(to_sid(symmetric(body))),), 0.0, 0.0, (-a[0], -a[1]), 0.0)
    none = np.zeros((1, 2))
    motion = RigidMotion(none, np.array([[0.0, w]]), np.array([[0.0, g]]))
    elastic, drives = inverse_dynamics(mechanism, motion, s.q[None], s.qd[None], s.qdd[None])
    springs = body.K @ s.q + body.D @ s.qd
    assert_close(elastic[0] - springs, rows, ROUNDING, size=float(np.abs(springs).max()))
    assert_close(drives[0], [force[0], moment[2]], ROUNDING)


def test_stiffened_forces_are_the_planar_ones():
    """Rows of any motion and outboard load; force and moment but for -qd'K0 qd and -1/2 q'K0 q.

    The format has no place for them: they vanish in a body that moves about q = 0 with qd = 0.
    """
    rng = np.random.default_rng(11)
    cloud, s = random_cloud(rng, 3), random_state(rng, 3, plane=True)
    body = stiffened(symmetric(cloud.body()), 5)
    data = to_sid(body, cloud_moments(cloud, 0.3))
    a, w, g = s.a[:2], s.w[2], s.g[2]
    none = np.zeros((1, 2))
    motion = RigidMotion(none, np.array([[0.0, w]]), np.array([[0.0, g]]))

    def planar(q, qd, payload=0.0):
        gravity = (-a[0], -a[1])
        machine = Mechanism((from_sid(data),), payload, 0.0, gravity, 0.0)
        rows, drives = inverse_dynamics(machine, motion, q[None], qd[None], s.qdd[None])
        return rows[0] - body.K @ q - body.D @ qd, drives[0]

    _, _, rows = forces_of_sid(data, s)
    found = planar(s.q, s.qd)[0]
    assert_close(found, rows, ROUNDING, size=10.0 * float(np.abs(rows).max()))
    # A force at the node does work on phi(q): what the payload's adds to the rows.
    tip = data.nodes[-1]
    phi, psi = tip.phi.at(s.q)[:2], tip.psi.at(s.q)[2]
    stretched = body.outboard - np.einsum("pkl,k->pl", body.K0_outboard, s.q)
    assert_close(np.vstack([phi, psi]), stretched, ROUNDING)
    # The linear terms of force and moment: small coordinates at rest.
    rest, small = np.zeros(3), 1e-7 * s.q
    state = replace(s, q=small, qd=rest)
    force, moment, _ = forces_of_sid(data, state)
    assert_close(planar(small, rest)[1], [force[0], moment[2]], 1e-11)


def test_stiffened_body_of_a_file_moves_the_same(tmp_path):
    """A beam that is spun up, from its file: the motion of the body that was written."""
    mesh = structured_arm(MPI.COMM_SELF, "beam", 1.0, 0.01, (40, 2))
    operators = LagrangeElement().operators(mesh, 0.01, 0.0)
    one = np.ones(mesh.num_cells)
    elastic = Substructure(mesh, operators, Profile()).at(70e9 * one, 2700.0 * one)
    basis = craig_bampton(elastic, Options(4))
    body = shape_integrals(elastic, basis, 1e-3, unit_loads(elastic))
    write_sid(tmp_path / "beam.sid", to_sid(body))

    def deflection(body):
        def motion(t):
            zero = np.zeros_like(t)
            columns = [np.stack([zero, 20.0 * t**k / k], axis=1) for k in (2, 1)]
            return RigidMotion(columns[0], columns[1], np.stack([zero, 20.0 + zero], axis=1))

        machine = Mechanism((body,), 0.1, 0.0, (0.0, 0.0), 0.0)
        system = ElasticSystem(machine, motion, (0.0, 1.0))
        return radau.integrate(system, 1e-6, 4, Profile()).sample(np.linspace(0.0, 1.0, 101), 0)

    written = deflection(body)
    assert_close(deflection(load_body(tmp_path / "beam.sid")), written, 1e-9)
    linear = deflection(linear_part(body))
    assert np.abs(linear - written).max() > 0.1 * np.abs(written).max()


def test_names_hold_frequencies():
    """sqrt(K / M) of a bar in bending and in tension; other programs read it in Hz."""
    body = beam().body()
    data = to_sid(body)
    found = [float(name.split(":")[1].split("Hz")[0]) for name in data.names]
    expected = np.sqrt(np.diag(body.K) / np.diag(body.M)) / (2.0 * np.pi)
    assert found == pytest.approx(expected, abs=5e-4)  # three decimals
    assert data.names[0].startswith("Eigen Mode    1 : ")


# -- moments ---------------------------------------------------------------------------------


def test_moments_of_an_arm_agree_with_its_planar_integrals(arm):
    elastic, basis, body = arm
    moments = spatial_moments(elastic, basis, THICKNESS)
    first, mixed = moments.first, moments.mixed
    checks = {
        "inertia": np.trace(moments.second),
        "j": first[0, 0] + first[1, 1],
        "r": first[0, 1] - first[1, 0],
        "M": mixed[0, 0] + mixed[1, 1],
        "G": mixed[1, 0] - mixed[0, 1],
    }
    for name, value in checks.items():
        expected = getattr(body, name)
        assert_close(value, expected, ROUNDING, size=float(np.abs(expected).max()))
    assert moments.depth == pytest.approx(body.mass * THICKNESS**2 / 12.0, rel=1e-14)
    guess = slender_moments(body)
    assert np.trace(guess.second) == body.inertia
    assert_close(guess.mixed[1, 0] - guess.mixed[0, 1], body.G, ROUNDING)


def test_moments_of_a_plate_in_closed_form():
    """A uniform 1.2 m x 0.3 m plate of 2 cm under rigid motions: cuboid's moments of inertia."""
    mesh = structured_arm(COMM, "arm", 1.2, 0.3, (6, 2))
    substructure = Substructure(mesh, LagrangeElement().operators(mesh, THICKNESS, 0.33), Profile())
    elastic = substructure.at(np.full(mesh.num_cells, 70e9), np.full(mesh.num_cells, 2700.0))
    basis = craig_bampton(elastic, Options(3))
    data = to_sid(shape_integrals(elastic, basis, 0.0), spatial_moments(elastic, basis, THICKNESS))
    mass, (a, b, c) = 2700.0 * 1.2 * 0.3 * THICKNESS, (1.2, 0.3, THICKNESS)
    expected = mass / 12.0 * np.diag([b * b + c * c, 4 * a * a + c * c, 4 * a * a + b * b])
    # Gmsh places points to 2e-12 of the length.
    assert_close(data.inertia(np.zeros(3)), expected, 1e-10)


# -- data of other programs ------------------------------------------------------------------


def foreign(rng):
    """Return a body's data as another program may give them: its own nodes, J 3 x 3, Ct of M1."""
    body = symmetric(random_cloud(rng, 2).body())
    data = to_sid(body, further=[PlaneNode("9", np.ones(2), np.ones((3, 2)))])
    J, J_q = data.inertia(np.zeros(2)), np.zeros((3, 2, 3))
    held, mid, tip = data.nodes
    nodes = (replace(tip, name="4"), mid, replace(held, name="7"))
    return body, replace(data, nodes=nodes, J=Taylor(J, J_q, 1, 2))


def test_nodes_by_name():
    body, data = foreign(np.random.default_rng(5))
    same(from_sid(data, inboard="7", outboard="4"), body)
    mid = from_sid(data, "7", "9")
    assert np.array_equal(mid.outboard, np.ones((3, 2)))
    assert np.array_equal(mid.outboard_point, [1.0, 1.0])


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


REFUSED = {
    "one node": (lambda d: replace(d, nodes=d.nodes[:1]), ["lacks an outboard node", "1"]),
    "no node": (lambda d: replace(d, nodes=()), ["lacks an outboard node", "none"]),
    "inboard away": (lambda d: node(d, 0, "origin", r11=0.1), ["origin of node 1", "inboard"]),
    "inboard moves": (lambda d: node(d, 0, "phi", r21=0.1), ["phi of node 1", "held"]),
    "inboard turns": (lambda d: node(d, 0, "psi", r31=0.1), ["psi of node 1", "held"]),
    "out of plane": (lambda d: node(d, 1, "phi", r31=0.1), ["phi of node 2", "outboard", "plane"]),
    "twists": (lambda d: node(d, 1, "psi", r11=0.1), ["psi of node 2", "plane"]),
    "raised": (lambda d: node(d, 1, "origin", r31=0.1), ["origin of node 2", "z = 0"]),
    "turned": (lambda d: node(d, 1, "AP", r12=0.1), ["AP of node 2", "parallel"]),
    "no length": (lambda d: node(d, 1, "origin", r11=0.0, r21=0.0), ["node 2 is at the origin"]),
    "mdCM": (lambda d: swap(d, "mdCM", r31=0.1), ["row 3 of mdCM", "x-y plane"]),
    "J": (lambda d: swap(d, "J", r51=0.1), ["J(1, 3)", "x-y plane"]),
    "Ct": (lambda d: swap(d, "Ct", r13=0.1), ["column 3 of Ct"]),
    "Cr": (lambda d: swap(d, "Cr", r11=0.1), ["columns 1, 2 of Cr"]),
    "stress": (lambda d: swap(d, "ksigma", r11=1.0), ["ksigma", "initial stresses"]),
    "stiffness": (lambda d: swap(d, "Ke", "M1", r111=1.0), ["m1 of Ke", "not constant"]),
    "rotation alone": (
        lambda d: swap(d, "Oe", "M1", r113=0.2),
        ["m1 of Oe beyond -Me holds geometric stiffening, which m1 of Ct lacks"],
    ),
    "without rotation": (
        lambda d: node(swap(d, "Ct", "M1", r111=0.2), 1, "phi", "M1", r111=0.2),
        ["m1 of Ct holds geometric stiffening", "m1 of Oe beyond -Me lacks"],
    ),
    "without forces": (
        lambda d: swap(swap(d, "Oe", "M1", r113=0.2), "Ct", "M1", r111=0.2),
        ["m1 of Ct holds geometric stiffening", "m1 of phi of node 2 lacks"],
    ),
    "skew": (
        lambda d: swap(to_sid(stiffened(from_sid(d), 1)), "Ct", "M1", r121=9.0),
        ["m1 of Ct", "symmetric"],
    ),
    "Ge": (lambda d: swap(d, "Ge", r13=0.2), ["Ge", "skew"]),
    "massless": (lambda d: replace(d, mass=0.0), ["mass = 0", "> 0"]),
    "inertia": (lambda d: swap(d, "J", r31=-1.0), ["J(3, 3) = -1"]),
    "modal mass": (lambda d: swap(d, "Me", r22=-1.0), ["Me", "definite"]),
    "loose": (lambda d: swap(d, "Ke", r11=0.0, r12=0.0, r21=0.0), ["Ke", "held"]),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bodies_that_are_no_arm(name):
    change, words = REFUSED[name]
    data = to_sid(symmetric(random_cloud(np.random.default_rng(3), 2).body()))
    from_sid(data)
    with pytest.raises(InputError) as caught:
        from_sid(change(data), source="tip.sid")
    message = str(caught.value)
    assert message.startswith("tip.sid: ") and "\n" not in message
    for word in words:
        assert word in message, message


def test_noise_of_another_program_is_no_motion_out_of_the_plane():
    body, data = foreign(np.random.default_rng(6))
    noisy = swap(swap(data, "Ct", r13=1e-9), "mdCM", r31=1e-12)
    same(from_sid(noisy, "7", "4"), body)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("5",), ["no inboard node '5'", "4, 9, 7"]),
        (("7", "x"), ["no outboard node 'x'"]),
        (("7", "7"), ["node 7 cannot be both"]),
        (("7", None), ["node 7 cannot be both"]),  # the last one of this file
    ],
)
def test_nodes_that_are_not_there(arguments, words):
    _, data = foreign(np.random.default_rng(5))
    with pytest.raises(InputError) as caught:
        from_sid(data, *arguments)
    for word in words:
        assert word in str(caught.value)


def test_length_must_agree(tmp_path):
    path = Path(tmp_path) / "bar.sid"
    write_sid(path, to_sid(symmetric(beam(length=0.5).body())))
    assert load_body(path, length=0.5).outboard_point[0] == 0.5
    with pytest.raises(InputError, match=r"bar\.sid: .*\(0\.5, 0\) m, .* 0\.6 m"):
        load_body(path, length=0.6)
