"""Modes with what an arm carries: dense solves, beams in closed form, crossings, gradients."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
from bodies import changed, random_chain, random_tree
from mpi4py import MPI
from remainders import Field, arm_of, build, dense_matrices, rates, uneven, wave
from runs import TWO_ARM
from scipy.optimize import brentq

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.arms.modes import FrozenTree, LoadedModes, loaded_modes
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.tangent import linearise
from dolfinopt.responses.frequency import Eigenfrequency
from dolfinopt.responses.sensitivity import period_gradient


def design_of(arm: Arm, field: Field = wave) -> np.ndarray:
    """Return the field on the arm's cells."""
    return field(0, *(arm.mesh.centroid.T / arm.mesh.outboard_point[0]))


@pytest.mark.serial
@pytest.mark.parametrize("d", [2, 3])
def test_carried_inertia_of_a_frozen_machine(d: int) -> None:
    """What body 1 carries is what its rows feel of the others, which are held."""
    rng = np.random.default_rng(7)
    machine = random_tree(rng, interfaces=2) if d == 3 else random_chain(rng, 3)
    mechanism = machine.mechanism()
    pose = RigidMotion(*rng.normal(size=(3, 1, mechanism.num_rigid)))
    size, own = mechanism.num_coordinates, mechanism.slices[1]
    rest = np.zeros((1, size))
    rows = linearise(mechanism, pose, rest, rest, rest).dense()[0, own, 2 * size :]
    rigid = mechanism.rigid
    frozen = FrozenTree(rigid, pose, "rigid-body")
    carried, B = frozen.carried()[1], mechanism.bodies[1].outboard
    expected = mechanism.bodies[1].M + B.T @ carried @ B
    assert np.abs(rows[:, own] - expected).max() < 1e-12 * np.abs(expected).max()
    # The derivative by the last body, whose inertia is not stretched linearly.
    last, (b,) = len(rigid.bodies) - 1, carried.shape[:1]
    weights = rng.normal(size=(b, b))
    zero = [np.zeros((len(one.outboard), len(one.outboard))) for one in mechanism.bodies]
    for kind in ("rigid-body", "point-mass", "none"):
        frozen = FrozenTree(rigid, pose, kind)
        before = frozen.carried()[1]
        light = {"point-mass": carried[0, 0] * np.diag(np.arange(b) % mechanism.dim.b < d)}
        if kind != "rigid-body" and len(mechanism.sites[1]) == 1:
            np.testing.assert_allclose(before, light.get(kind, 0.0 * carried), rtol=1e-12)
        by = frozen.cotangents([zero[0], weights, *zero[2:]])[last]
        for name in ("mass", "w", "W"):
            change = 0.1 * np.asarray(getattr(rigid.bodies[last], name)) + 0.01
            if name == "W":
                change = 0.5 * (change + mechanism.dim.transposed(change))
            other = changed(rigid, last, name, change)
            after = FrozenTree(other, pose, kind).carried()[1]
            found = np.sum(getattr(by, name) * change)
            assert found == pytest.approx(np.sum(weights * (after - before)), rel=1e-9, abs=1e-12)


def test_rigid_body_of_a_bar() -> None:
    """Solid, and with the outer half empty; Gmsh places nodes to 1e-12 of the length."""
    arm = arm_of((20, 2), "interpolation.floor=1e-12")
    for share in (1.0, 0.5):
        body = arm.state(np.where(arm.mesh.centroid[:, 0] < share, 1.0, 0.0)).rigid_body
        m = 2700.0 * 0.06 * 0.01 * share
        assert body.mass == pytest.approx(m, rel=1e-10)
        np.testing.assert_allclose(body.w[:, 0], [0.5 * m * share, 0.0], atol=1e-10)
        expected = m * (share**2 / 3.0 + 0.06**2 / 12.0)
        assert body.W[0, 0, 0] == pytest.approx(expected, rel=1e-10)


def carried_by(mass: float, x: float, y: float, inertia: float) -> np.ndarray:
    """Return the inertia (3, 3) of a body with its centre at (x, y), about the origin."""
    cx, cy = mass * x, mass * y
    inertia += mass * (x * x + y * y)
    return np.array([[mass, 0.0, -cy], [0.0, mass, cx], [-cy, cx, inertia]])


NOTHING, BODY = np.zeros((3, 3)), carried_by(3.0, 0.4, -0.8 / 3.0, 0.8)


@pytest.mark.parametrize(
    "carried",
    [NOTHING, carried_by(6.0, 0.0, 0.0, 0.0), BODY],
    ids=["nothing", "point", "body"],
)
def test_dense_eigenproblem(carried: np.ndarray) -> None:
    """Any design on a small mesh; unit modal mass, carried mass included."""
    arm = arm_of((9, 3), "arms.height=0.2")
    arm.state(design_of(arm))
    modes = loaded_modes(arm.elastic, carried, 5, None)
    young, density = arm.solid.young_modulus, arm.solid.density
    K, M = dense_matrices(
        arm.elastic, young * arm.current.material.stiffness, density * arm.current.material.mass
    )
    M[-3:, -3:] += carried
    expected = scipy.linalg.eigh(K, M, eigvals_only=True)[:5]
    # LAPACK is right to 1e-16 of the largest eigenvalue, some 1e6 times the lowest.
    np.testing.assert_allclose(modes.values, expected, rtol=1e-8)
    assert modes.frequency == pytest.approx(np.sqrt(expected[0]) / (2.0 * np.pi), rel=1e-8)
    flat = modes.field.reshape(-1, 5)
    mass = flat.T @ arm.elastic.mass_times(modes.field).reshape(-1, 5)
    mass += modes.outboard.T @ carried @ modes.outboard
    np.testing.assert_allclose(mass, np.eye(5), atol=1e-9)


def test_an_arm_cut_in_two() -> None:
    """The same on the ranks that share an arm, also of solids that float."""
    values, floating = [], []
    for comm in (MPI.COMM_SELF, MPI.COMM_WORLD):
        arm = arm_of((24, 3), comm=comm)
        arm.state(design_of(arm))
        values.append(loaded_modes(arm.elastic, BODY, 3, None).values)
        arm = arm_of((60, 6), "interpolation.floor=1e-9", comm=comm)
        stripes = design_of(arm, lambda k, x, y: np.floor(12.0 * x) % 2.0 == 0.0)
        arm.state(stripes.astype(float))
        floating.append(np.linalg.inv(arm.elastic.constraint_modes.stiffness))
    np.testing.assert_allclose(values[1], values[0], rtol=1e-9)
    scale = np.sqrt(np.outer(np.diag(floating[0]), np.diag(floating[0])))
    np.testing.assert_allclose(floating[1] / scale, floating[0] / scale, atol=1e-4)


STUBBY = ("arms.length=0.3", "arms.height=0.9")
MASS = 20.0  # kg


def symmetric(k: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a design symmetric about the axis, whose axial and bending modes do not mix."""
    return 0.5 + 0.2 * np.cos(3.0 * x) * np.cos(2.0 * y)


def stubby() -> Arm:
    """Return an arm three times as high as long, of the symmetric design."""
    arm = arm_of((8, 8), *STUBBY)
    arm.state(design_of(arm, symmetric))
    return arm


FIRST_MOMENT = carried_by(1.0, 1.0, 0.0, -1.0) - carried_by(1.0, 0.0, 0.0, 0.0)  # 1 kg m along x


@cache
def coinciding() -> np.ndarray:
    """Return what the stubby arm carries when its two lowest frequencies are equal."""
    # They repel each other unless two numbers are right, by Newton's method: a change dM gives the
    # pair's matrix -lambda phi' dM phi, which has to close the gap and must not mix them.
    arm, moment, inertia = stubby(), -0.15 * MASS, 2.5 + 0.15**2 * MASS
    for _ in range(20):
        carried = carried_by(MASS, 0.0, 0.0, inertia) + moment * FIRST_MOMENT
        modes = loaded_modes(arm.elastic, carried, 2, None)
        (low, high), phi = modes.values, modes.outboard
        if high - low < 1e-11 * high:
            return carried
        changes = []
        for unit in (FIRST_MOMENT, carried_by(0.0, 0.0, 0.0, 1.0)):
            pair = -high * phi.T @ unit @ phi
            changes.append([pair[0, 0] - pair[1, 1], 2.0 * pair[0, 1]])
        step = np.linalg.solve(np.transpose(changes), [high - low, 0.0])
        moment, inertia = moment + step[0], inertia + step[1]
    raise AssertionError((moment, inertia, low, high))


def slopes_at(
    arm: Arm, carried: np.ndarray, exponent: float, follow: bool
) -> tuple[Callable[[np.ndarray], LoadedModes], np.ndarray]:
    """Return the modes of a design, and the gradient of the squared period at the present one."""
    start = loaded_modes(arm.elastic, carried, 3, None).start

    def modes(x: np.ndarray) -> LoadedModes:
        arm.state(x)
        return loaded_modes(arm.elastic, carried, 3, start)

    x = design_of(arm, symmetric)
    found = modes(x)
    _, by_values = squared_period(found, exponent, follow)
    return modes, period_gradient(arm.current, found, by_values)[0]


def squared_period(modes: LoadedModes, exponent: float, follow: bool) -> tuple[float, np.ndarray]:
    options = SimpleNamespace(exponent=exponent, follow=follow)
    return Eigenfrequency(options).squared_period(modes)


@pytest.mark.serial  # ranks: test_an_arm_cut_in_two
@pytest.mark.parametrize("exponent", [4.0, 20.0])
@pytest.mark.parametrize("direction", [uneven, wave])
def test_p_mean_where_modes_coincide(direction: Field, exponent: float) -> None:
    """The gradient of equal eigenvalues is one, of either mode alone it is none: rates 2 and 1."""
    arm, carried = stubby(), coinciding()
    x, d = design_of(arm, symmetric), design_of(arm, direction)
    orders = []  # with small steps, beside which the part of second order is 3 % of the first
    for follow, steps in ((False, (1e-3, 2.5e-4)), (True, (4e-5, 1e-5))):
        modes, slope = slopes_at(arm, carried, exponent, follow)

        def value(h: float, modes=modes, follow: bool = follow) -> float:
            return squared_period(modes(x + h * d), exponent, follow)[0]

        orders.append(rates(value, float(slope @ d), steps))
    assert orders[0] == pytest.approx(2.0, abs=0.1)
    assert orders[1] == pytest.approx(1.0, abs=0.25)


def test_following_a_mode_through_a_crossing() -> None:
    """Rotary inertia lowers bending below the axial mode, which it does not touch: MAC keeps it."""
    arm, seen = stubby(), []

    def carried(inertia: float) -> np.ndarray:
        return carried_by(MASS, -0.15, 0.0, inertia)

    first = loaded_modes(arm.elastic, carried(0.5), 3, None)
    axial = int(np.argmax(np.abs(first.outboard[0]) / np.abs(first.outboard[1])))
    start = first.start[:, [axial, *np.delete(range(3), axial)]]
    for inertia in np.linspace(0.5, 3.0, 11):
        modes = loaded_modes(arm.elastic, carried(inertia), 3, start)
        start = modes.start
        seen.append((modes.followed, modes.values[modes.followed]))
    followed, values = zip(*seen, strict=True)
    assert sorted(set(followed)) == [1, 2] and followed[0] == axial == 1 and followed[-1] == 2
    np.testing.assert_allclose(values, first.values[1], rtol=1e-9)
    period, by_values = squared_period(modes, 20.0, True)
    assert period == pytest.approx(4.0 * np.pi**2 / values[0], rel=1e-9)
    assert np.flatnonzero(by_values).tolist() == [2]


# Scene, keys, and by how much static modes alone are too stiff, measured: three of a plane arm, six
# of a solid one, which bends in both planes with one frequency.
CASES = {
    "slender": ("two_arm", ["arms.cells=[40,6]"], 4.9e-3),
    "short": ("two_arm", ["arms.cells=[12,12]", "arms.height=1.0"], 0.04),
    "modal": ("two_arm", ["arms.cells=[40,6]", "reduction.method=modal"], 0.0),
    "solid": ("spatial_arm", ["arms.cells=[12,2,2]", "reduction.coordinates=6"], 4e-3),
}


@pytest.mark.parametrize("name", CASES)
def test_first_frequency_is_that_of_all_elements(name: str) -> None:
    """Beside the eigensolver's clamped-free modes, and not the reduced model's, which is higher."""
    demo, overrides, excess = CASES[name]
    path = TWO_ARM.with_name(f"{demo}.toml")
    scene = do.load_scene(path, ["reduction.coordinates=3"] * (demo == "two_arm") + overrides)
    index = next(iter(scene.cell_counts))
    arm = Arm(scene, index, MPI.COMM_WORLD, do.Profile())
    arm.state(arm.uniform(0.5))
    nothing = np.zeros((arm.current.elastic.rigid.shape[2],) * 2)
    expected = loaded_modes(arm.elastic, nothing, 1, None).frequency
    assert arm.current.body.first_frequency / expected - 1.0 >= excess - 1e-9
    assert arm.current.first_frequency == pytest.approx(expected, rel=1e-10)


def euler_value(mass: float, inertia: float, height: float) -> float:
    """Return the lowest squared frequency of Euler's beam, 1 m long, with a tip body."""
    # w = A (cosh bx - cos bx) + B (sinh bx - sin bx), EI w_xx = s^2 J w_x, EI w_xxx = -s^2 m w.
    bending, line = 70e9 * 0.01 * height**3 / 12.0, 2700.0 * 0.01 * height  # N m2, kg/m

    def determinant(b: float) -> float:
        ch, sh, co, si = np.cosh(b), np.sinh(b), np.cos(b), np.sin(b)
        w, w1 = np.array([ch - co, sh - si]), b * np.array([sh + si, ch - co])
        w2, w3 = b**2 * np.array([ch + co, sh + si]), b**3 * np.array([sh - si, ch + co])
        load = b**4 / line
        return float(np.linalg.det([w2 - load * inertia * w1, w3 + load * mass * w]))

    grid = np.linspace(0.05, 2.0, 40)
    first = np.flatnonzero(np.diff(np.sign([determinant(b) for b in grid])))[0]
    root = brentq(determinant, grid[first], grid[first + 1], xtol=1e-14)
    return root**4 * bending / line


@pytest.mark.parametrize("key", ["eigenfrequency", "first_frequency"])
@pytest.mark.parametrize(("mass", "inertia"), [(0.0, 0.0), (5.0, 0.0), (5.0, 0.3)])
def test_a_motor_at_the_elbow_lowers_the_frequency(key: str, mass: float, inertia: float) -> None:
    """Objective and limit against a slender beam with that body at its end, in closed form."""
    light = "arms.arm2.rigid=true", "arms.arm2.mass=1e-6", "arms.arm2.inertia=0.0"
    motor = f"arms.arm1.joint_mass={mass}", f"arms.arm1.joint_inertia={inertia}"
    limit = key == "first_frequency"
    asked = "constraints.first_frequency=1.0" if limit else "objective.kind=eigenfrequency"
    none = "arms.arm2.joint_mass=0.0", "arms.arm2.joint_inertia=0.0", "payload.mass=0.0"
    linear = "arms.arm1.height=0.02", "simulation.stiffening=false"
    built = build(*light, *motor, *none, asked, *linear, cells=(100, 2))
    solid = {k: np.ones(arm.mesh.num_cells) for k, arm in built.arms.items()}
    evaluation, _ = built.evaluate(solid)
    (found,) = evaluation.values_of("eigenfrequency")
    expected = euler_value(mass, inertia, 0.02)
    # Shear, the beam's own and that of its elements: measured 2.4e-4.
    assert found == pytest.approx(np.sqrt(expected) / (2.0 * np.pi), rel=5e-4)
