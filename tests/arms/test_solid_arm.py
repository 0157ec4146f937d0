"""Solid arms: their bodies against closed forms, gradients by Taylor tests, averages of designs."""

import numpy as np
import pytest
from mpi4py import MPI
from solids import DENSITY, HEIGHT, LENGTH, THICKNESS, solid_arm, solid_scene

from dolfinopt.arms.arm import Arm
from dolfinopt.errors import InputError
from dolfinopt.multibody.shape_integrals import TABLE, ShapeIntegrals
from dolfinopt.output.design import read_design
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.responses.sensitivity import exact_gradient
from dolfinopt.scene.tables.joints import Interface

COMM = MPI.COMM_WORLD
MASS = DENSITY * LENGTH * HEIGHT * THICKNESS


def rough(arm):
    """Return densities without symmetry, by place."""
    x, y, z = arm.mesh.centroid.T
    return 0.6 + 0.3 * np.sin(70.0 * x + 160.0 * y + 210.0 * z)


def test_inertia_of_a_box():
    """Mass, first and second moments to rounding; and the modes' of a beam to shear and clamp."""
    arm = solid_arm(cells=(30, 4, 2))
    body = arm.reduce(np.ones(arm.mesh.num_cells))
    assert body.mass == pytest.approx(MASS, rel=1e-13)
    assert np.allclose(body.w[:, 0], [0.5 * MASS * LENGTH, 0.0, 0.0], atol=1e-14)
    second = MASS * np.diag([LENGTH**2 / 3.0, HEIGHT**2 / 12.0, THICKNESS**2 / 12.0])
    assert np.allclose(body.W[:, 0, 0].reshape(3, 3), second, rtol=1e-12, atol=1e-15)
    assert np.array_equal(body.outboard, np.eye(6))
    # Craig and Bampton's body of a beam with Hermite's cubics.
    modes = body.W.reshape(3, 3, 7, 7)[range(3), range(3), 1:, 1:].sum(axis=0) / MASS
    L = LENGTH
    beam = {
        (0, 0): 1.0 / 3.0, (1, 1): 13.0 / 35.0, (2, 2): 13.0 / 35.0,
        (1, 5): -11.0 / 210.0 * L, (2, 4): 11.0 / 210.0 * L,
        (4, 4): L**2 / 105.0 + THICKNESS**2 / 36.0, (5, 5): L**2 / 105.0 + HEIGHT**2 / 36.0,
        (3, 3): (HEIGHT**2 + THICKNESS**2) / 36.0,
    }  # fmt: skip
    for at, value in beam.items():
        assert modes[at] == pytest.approx(value, rel=0.025), at
    assert body.w[:, 1:4] == pytest.approx(0.5 * MASS * np.eye(3), rel=0.01, abs=1e-10)


@pytest.mark.serial
def test_a_design_file_of_a_solid_is_read_by_place(tmp_path):
    """By all three coordinates, in any order; another box's is refused."""
    scene = solid_scene(cells=(10, 3, 2))
    arm = Arm(scene, 0, MPI.COMM_SELF, Profile())
    partition = partition_arms(MPI.COMM_SELF, scene.cell_counts)
    expected, order = rough(arm), np.random.default_rng(0).permutation(60)
    path, name = tmp_path / "design.npz", scene.arms[0].name
    arrays = {f"{name}/centroid": arm.mesh.centroid[order], f"{name}/density": expected[order]}
    np.savez(path, **arrays)
    assert np.array_equal(read_design(path, partition, {0: arm})[0], expected)
    np.savez(path, **arrays | {f"{name}/centroid": arm.mesh.centroid[order] + [0.0, 0.0, 0.1]})
    with pytest.raises(InputError, match=r"z 0.095..0.105 m, its mesh .*z -0.005..0.005 m"):
        read_design(path, partition, {0: arm})


def response(weights):
    """Return the weighted sum of a body's integrals."""
    pairs = [(one.name, getattr(weights, one.name)) for one in TABLE]
    return lambda body: sum(float(np.sum(by * getattr(body, name))) for name, by in pairs)


def remainders(arm, function, by):
    """Return rates at which the remainder of first order falls on halved steps."""
    comm, x = arm.mesh.comm, arm.mesh.keep(rough(arm))
    along = np.where(arm.mesh.fixed, 0.0, np.cos(90.0 * arm.mesh.centroid @ [1.0, 2.0, -3.0]))
    slope = comm.allreduce(exact_gradient(arm.state(x), by) @ along)
    value, steps = function(arm.state(x).body), 0.01 * 0.5 ** np.arange(3)
    left = [abs(function(arm.state(x + h * along).body) - value - h * slope) for h in steps]
    return np.log2(np.array(left[:-1]) / left[1:])


# On the sides of a box of ten cells along, one above and one below.
FORK = tuple(
    Interface(name=name, point=(0.225, y, 0.0), radius=0.012)
    for name, y in (("up", 0.5 * HEIGHT), ("down", -0.5 * HEIGHT))
)


@pytest.mark.parametrize("radius", [0.001, 0.3])
def test_refused_interfaces(radius):
    """Of no side, and with nodes of another one: one line on all ranks."""
    one = Interface(name="up", point=(0.2, 0.02, 0.0), radius=radius)
    text = r"middle 0\.0255 m away; change its point" if radius < 0.1 else "belong to another|share"
    with pytest.raises(InputError, match=text):
        solid_arm(cells=(10, 4, 2), coordinates=12, interfaces=(one,))


@pytest.mark.parametrize(
    ("cells", "stiffening", "interfaces"),
    [((8, 3, 2), False, ()), ((8, 3, 2), True, ()), ((10, 4, 2), True, FORK[:1])],
)
def test_gradient_of_a_body(cells, stiffening, interfaces):
    """Every integral of a body at once, K0 of 18 or 24 loads among them: rate 2."""
    count = 6 + 6 * len(interfaces)
    arm = solid_arm(cells=cells, coordinates=count, stiffening=stiffening, interfaces=interfaces)
    body = arm.state(arm.mesh.keep(rough(arm))).body
    assert len(body.K0) + len(body.K0_outboard) == (12 + count if stiffening else 0)
    rng = np.random.default_rng(3)
    parts = {one.name: np.asarray(getattr(body, one.name)) for one in TABLE}
    scale = {name: np.abs(part).max(initial=1e-30) for name, part in parts.items()}
    weights = {name: rng.normal(size=part.shape) / scale[name] for name, part in parts.items()}
    weights["outboard_point"] *= 0.0
    by = ShapeIntegrals(**weights)
    assert remainders(arm, response(by), by)[-1] == pytest.approx(2.0, abs=0.06)


@pytest.mark.skipif(COMM.size == 1, reason="needs two ranks")
def test_ranks_agree():
    """One arm on all ranks and on one: body and gradient by place, to 1e-8."""

    def found(comm):
        arm = solid_arm(comm, cells=(8, 3, 2), stiffening=True, filter_radius=0.02)
        state = arm.state(arm.physical(rough(arm)))
        gradient = arm.backward(exact_gradient(state, state.body))
        rows = np.column_stack([np.rint(1e4 * arm.mesh.centroid), gradient])
        rows = np.concatenate(comm.allgather(rows))
        return state.body, rows[np.lexsort(rows[:, :3].T)][:, 3]

    (one, by_one), (all_, by_all) = found(MPI.COMM_SELF), found(COMM)
    for each in TABLE:
        a, b = np.asarray(getattr(one, each.name)), np.asarray(getattr(all_, each.name))
        assert np.allclose(a, b, rtol=0.0, atol=1e-8 * np.abs(a).max(initial=1e-30)), each.name
    assert np.allclose(by_one, by_all, rtol=0.0, atol=1e-8 * np.abs(by_one).max())


def test_averages_of_a_design():
    """Symmetric about both planes, or the same over the thickness; derivatives are transposes."""
    for keys in ({"symmetric": "yz"}, {"symmetric": "extruded"}):
        arm = solid_arm(cells=(10, 4, 4), filter_radius=0.02, **keys)
        x = rough(arm)
        y = arm.physical(x)
        field = {}
        for part in COMM.allgather((np.rint(1e4 * arm.mesh.centroid).astype(int), y)):
            field.update({tuple(place): value for place, value in zip(*part, strict=True)})
        for (i, j, k), value in field.items():
            mirrored = keys["symmetric"] == "yz"
            others = [(i, -j, k), (i, j, -k)] if mirrored else [(i, j, 75), (i, j, -25)]
            assert all(field[at] == pytest.approx(value, abs=1e-12) for at in others)
        w = np.where(arm.mesh.fixed, 0.0, np.cos(300.0 * arm.mesh.centroid @ [1.0, 2.0, 3.0]))
        along = np.where(arm.mesh.fixed, 0.0, np.roll(w, 3))
        change = w @ (arm.physical(x + 0.01 * along) - y) / 0.01
        sums = COMM.allreduce(np.array([change, arm.backward(w) @ along]))
        assert sums[0] == pytest.approx(sums[1], rel=1e-9)
