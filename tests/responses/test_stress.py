"""Stress along the motion: against the full model, by finite differences, and as a limit."""

import numpy as np
import pytest
from mpi4py import MPI
from remainders import build, built_of, wave
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.dynamics.load_gradient import ProbedSystem
from dolfinopt.fem.stress import places_of, stress_operator
from dolfinopt.multibody.newton_euler import outward_pass
from dolfinopt.responses.response import Analysis, find
from dolfinopt.responses.stress import (
    arm_loads,
    cell_stress,
    maxima,
    motions_of,
    screen,
)
from dolfinopt.responses.stress_report import stress_report
from dolfinopt.scene.load import scene_from_dict

# Ranks: limits of the stress in test_every_option_gives_the_same_bits_on_any_number_of_ranks.

ALUMINIUM = 70e9  # Pa
QUICK = ("motion.horizon=2.2", "simulation.tolerance=1e-7", "objective.gradient=exact")


class Analysed:
    """A design, analysed for its stress."""

    def __init__(self, built, x):
        _, self.trajectory = built.evaluate(x, simulated=True)
        designs = {k: arm.current for k, arm in built.arms.items()}
        self.analysis = Analysis(
            built.scene, built.partition, designs, self.trajectory, built.profile
        )
        self.response = find("stress")(built.scene.objective)

    def measure(self):
        return self.response.measure(self.analysis)

    def gradient(self):
        [row] = self.response.gradients(self.analysis)
        return row


def all_loads(arm, body, rates_at, outboard, n):
    """Return all loads of an instant on nodes and outboard interface, from the frame's motion."""
    # -M (a + S X wd - X w^2 + ...), and what `outboard` (3,) takes away.
    V, X = arm.current.basis.V, arm.current.elastic.points
    u, ud, udd = (V @ x[n] for x in rates_at)
    a, w, wd = body.a[:, n], body.w[0, n], body.wd[0, n]

    def turned(field):
        return np.stack([-field[:, 1], field[:, 0]], axis=1)

    acceleration = a + wd * turned(X + u) - w * w * (X + u)
    acceleration += 2.0 * w * turned(ud) + udd
    elastic = arm.current.elastic
    interior, end = elastic.restrict(-elastic.mass_times(acceleration[:, :, None]))
    return interior, end + outboard[:, None]


def lengths(cells, field):
    """Return the relaxed stress of a nodal field (n_nodes, 2)."""
    elastic = cells.fields.arm
    found = (elastic.substructure.stress_operator @ field.ravel()).reshape(3, -1)
    return ALUMINIUM * cells.root * np.linalg.norm(found, axis=0)


def agree_with_rows(trajectory, tolerance):
    """What loads the bodies is what the rows of coordinates say that never move."""
    probe = ProbedSystem(trajectory.problem)
    at = (probe.spread(x) for x in trajectory.unknowns)
    rows = probe.system.at(trajectory.t).residual(*at)
    for part, found in zip(probe.places, trajectory.load_coefficients, strict=True):
        scale = np.abs(found).max(axis=0).clip(1e-300)
        np.testing.assert_allclose(-rows[:, part] / scale, found / scale, atol=tolerance)


@pytest.mark.serial
def test_both_ways_to_the_loads_agree():
    """From the passes of inverse dynamics, and from the rows of coordinates that never move."""
    built = build("simulation.stiffening=true", "motion.gravity=[0,-9.81]", "arms.joint_mass=0.3")
    agree_with_rows(Analysed(built, built.fields(wave)).trajectory, 1e-12)


def analysed_arms(built):
    """Yield every arm, its cells, c, q; stress by mode acceleration and loads at an instant."""
    trajectory = Analysed(built, built.fields(wave)).trajectory
    y, yd, ydd = trajectory.unknowns
    links = outward_pass(trajectory.mechanism, trajectory.motion, (y, yd, ydd))
    for k, arm in built.arms.items():
        part, c = trajectory.mechanism.slices[k], trajectory.load_coefficients[k]
        cells = cell_stress(arm.current, arm.current.load_fields)
        rates_at = y[:, part], yd[:, part], ydd[:, part]
        [loads] = arm_loads(built.scene, [trajectory])[k]

        def found(n, cells=cells, loads=loads):
            return np.linalg.norm(cells.A @ loads.coefficients[n], axis=0)

        def right(n, arm=arm, body=links[k].body, rates_at=rates_at, c=c):
            return all_loads(arm, body, rates_at, c[n, 4:7], n)

        yield arm, cells, c, y[:, part], found, right


@pytest.mark.serial
@pytest.mark.slow
@pytest.mark.parametrize("element", ["incompatible", "quadratic"])
@pytest.mark.parametrize("method", ["craig-bampton", "modal"])
def test_static_solution_of_all_loads(method, element):
    """Without damping and stiffening mode acceleration is the full model's static solution."""
    # The loads are those of the frame's motion, put together node by node. Mode displacement misses
    # it by what the modes cannot show.
    built = build(
        "simulation.stiffening=false", f"reduction.method={method}", "simulation.tolerance=1e-7",
        "damping.stiffness_proportional=0", f"arms.element={element}", "motion.gravity=[0,-9.81]",
    )  # fmt: skip
    worst = 0.0
    for arm, cells, _, q, found, right in analysed_arms(built):
        for n in (300, 1200, 2500):
            full = lengths(cells, arm.current.elastic.static_response(*right(n))[:, :, 0])
            assert np.abs(found(n) - full).max() < 1e-6 * full.max()
            modal = lengths(cells, arm.current.basis.V @ q[n])
            worst = max(worst, float(np.abs(modal - full).max() / full.max()))
    assert worst > (0.05 if method == "modal" else 1e-4)


@pytest.mark.serial
def test_largest_of_all_samples_and_cells():
    """The true value is the largest of all, however few instants are looked at; so is the map."""
    built = build("simulation.sample=0.002")
    one = Analysed(built, built.fields(wave))
    report = stress_report(built.partition, built.arms, one.trajectory, built.profile)
    largest = 0.0
    for k, arm in built.arms.items():
        cells = cell_stress(arm.current, arm.current.load_fields)
        [loads] = arm_loads(built.scene, motions_of(one.trajectory))[k]
        s = np.linalg.norm(np.moveaxis(cells.A @ loads.coefficients.T, 0, 2), axis=2)
        largest = max(largest, float(s.max()))
        e, n = np.unravel_index(np.argmax(s), s.shape)
        peak = report[k].peak
        assert peak.value == pytest.approx(s.max(), rel=1e-9)
        assert peak.place == pytest.approx(arm.mesh.centroid[e])
        assert peak.instant == one.trajectory.t[n]
        assert report[k].peak_at_points.value > peak.value  # nearer to the edge
        np.testing.assert_allclose(report[k].by_cell, s.max(axis=1), atol=1.5e-3 * s.max())
    measured = one.measure()
    assert measured.values[0] == pytest.approx(largest, rel=1e-9)
    assert 0.05 * largest < measured.smooth[0] < largest


@pytest.mark.serial
def test_cells_near_an_interface_may_be_left_out():
    """The stress grows at the clamped corners; objective.stress_margin takes them out."""
    built = build("objective.stress_margin=0.1", cells=(40, 4))
    near = build(cells=(40, 4))
    even = built.fields(lambda k, x, y: np.full(len(x), 0.7))
    inner, whole = Analysed(built, even), Analysed(near, even)
    assert inner.measure().values[0] < whole.measure().values[0]
    report = stress_report(built.partition, built.arms, inner.trajectory, built.profile)
    length = built.scene.arms[0].length
    for one in report.values():
        assert 0.1 <= one.peak.place[0] <= length - 0.1


@pytest.mark.serial
def test_void_has_no_stress():
    """Nor an infinite derivative."""
    built = build(*QUICK)
    x = built.fields(lambda k, x, y: np.where((x > 0.4) & (x < 0.6) & (abs(y) < 0.02), 0.0, 1.0))
    one = Analysed(built, x)
    report = stress_report(built.partition, built.arms, one.trajectory, built.profile)
    for k in x:
        assert not report[k].by_cell[x[k] == 0.0].any()
        assert report[k].by_cell[x[k] == 1.0].all()
    assert all(np.isfinite(g).all() for g in one.gradient().values())


@pytest.mark.serial
def test_stress_in_python():
    """Asked for, a simulation knows it and draws it; an optimisation knows it anyway."""
    model = do.Model(do.load_scene(TWO_ARM, ["arms.cells=[20,3]", "simulation.sample=0.01"]))
    plain, asked = model.simulate(), model.simulate(stress=True)
    assert np.isnan(plain.max_stress) and plain.plot_stress() is None
    assert 1e6 < asked.max_stress < 1e9
    assert asked.plot_stress() is not None


# -- stress of a turning arm against beam theory, and of a hole in it against Heywood's factor  ---


YOUNG, DENSITY = 70e9, 2700.0  # Pa, kg/m3
HEIGHT, THICKNESS, PAYLOAD = 0.06, 0.01, 1.0  # m, m, kg
AREA, INERTIA = HEIGHT * THICKNESS, THICKNESS * HEIGHT**3 / 12.0  # m2, m4


def turned(arm, speed, duration, damping):
    """Return a solid arm that spins up about its joint, and its motion."""
    motion = {"path": "rotation", "base": "fixed", "speed": speed, "duration": duration,
              "horizon": duration + 0.1}  # fmt: skip
    shape = {"name": "arm", "height": HEIGHT, "thickness": THICKNESS}
    scene = scene_from_dict({
        "material": {"young_modulus": YOUNG, "poisson_ratio": 0.33, "density": DENSITY},
        "arms": [shape | arm],
        "motion": motion,
        "payload": {"mass": PAYLOAD},
        "damping": {"stiffness_proportional": damping},
        "design": {"initial": 1.0, "volume_fraction": 1.0},
        "simulation": {"tolerance": 1e-6, "stiffening": True},
    })  # fmt: skip
    built = built_of(scene)
    _, trajectory = built.evaluate({0: np.ones(built.arms[0].mesh.num_cells)})
    return built.arms[0], trajectory


def stress_at(arm, trajectory, points, sample):
    """Return places (k, 2), m, and stress (k,), Pa, at points of the reference cell."""
    state = arm.current
    operator = stress_operator(state.elastic.operators, points)
    A = state.load_fields.stress(YOUNG * operator)
    [loads] = arm_loads(arm.scene, [trajectory])[0]
    places = places_of(state.elastic.operators, points).reshape(-1, 2)
    return places, np.linalg.norm(A @ loads.coefficients[sample], axis=0)


@pytest.mark.serial
@pytest.mark.parametrize("when", [1.0, 1.3, 2.05])
def test_beam(when):
    """M y / I and N / A of payload and the arm's own inertia, a height away from the root."""
    # At the clamped edge itself corners are singular. The motion takes long beside the vibration's
    # 80 ms; speeding up at 1 s, up and round at 1.3 s, round alone at 2.05 s, where Saint-Venant's
    # rest of the clamping shows.
    length = 1.0
    entry = {"length": length, "cells": [100, 6], "element": "incompatible"}
    arm, trajectory = turned(entry, 12.0, 2.0, 2e-4)
    n = round(when / arm.scene.simulation.sample)
    w, wd = trajectory.motion.qd[n, 1], trajectory.motion.qdd[n, 1]
    places, stress = stress_at(arm, trajectory, np.array([[0.5, 0.5]]), n)
    line = DENSITY * AREA
    outer = np.isclose(np.abs(places[:, 1]), 2.5 / 6.0 * HEIGHT)  # the outermost cells' centres
    for x in (0.065, 0.205, 0.505):
        here = outer & np.isclose(places[:, 0], x)
        own = length**2 - x**2
        bending = wd * (PAYLOAD * length * (length - x)
                        + line * ((length**3 - x**3) / 3.0 - 0.5 * x * own))  # fmt: skip
        shear, pull = (
            wd * (PAYLOAD * length + 0.5 * line * own),
            w**2 * (PAYLOAD * length + 0.5 * line * own),
        )
        y = places[here, 1]
        normal = pull / AREA + bending * y / INERTIA
        along = 1.5 * shear / AREA * (1.0 - (2.0 * y / HEIGHT) ** 2)
        assert here.sum() == 2
        np.testing.assert_allclose(stress[here], np.hypot(normal, 3**0.5 * along), rtol=4e-3)


# -- the search for the largest stress misses nothing, and looks at few instants  -----------------


def norms(A, a):
    """Return |A_e a_n| (points, n)."""
    return np.sqrt(np.square(A @ a.T).sum(axis=0))


def vibration(rng, n, m):
    """Return coefficients of slow and fast vibrations that decay."""
    t = np.linspace(0.0, 1.0, n)[:, None]
    slow = np.sin(2.0 * np.pi * rng.uniform(0.5, 8.0, m) * t + rng.uniform(0.0, 6.0, m))
    fast = np.sin(2.0 * np.pi * rng.uniform(50.0, 400.0, m) * t) * np.exp(-5.0 * t)
    return slow + 0.2 * fast * rng.uniform(0.0, 1.0, m)


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("seed", range(12))
def test_no_maximum_is_missed(seed):
    """Against all points at all instants; with columns that cancel, and ones without stress."""
    rng = np.random.default_rng(seed)
    n, points, m = 901, 300, 9
    components = 5 if seed % 2 else 3  # in space, in the plane
    A = rng.normal(size=(components, points, m)) * 10.0 ** rng.uniform(-8.0, 8.0, m)
    A[:, :, 3] = 2.0 * A[:, :, 1]  # the same twice
    A[:, :, 5] = 0.0
    a = vibration(rng, n, m) / np.linalg.norm(A, axis=(0, 1)).clip(1e-300)
    cancelled = 1e3 * np.abs(a[:, 1]).max() * np.sin(np.arange(n))
    a[:, 1] += cancelled
    a[:, 3] -= 0.5 * cancelled
    a[:, 5] = 1.0
    if seed % 3 == 0:  # a single sample that sticks out
        a[rng.integers(n)] *= 3.0
    truth = norms(A, a)
    found = screen(MPI.COMM_SELF, A, a)
    assert found.largest == pytest.approx(truth.max(), rel=1e-9)
    assert truth[found.point, found.instant] == pytest.approx(truth.max(), rel=1e-9)
    by_point, when = maxima(MPI.COMM_SELF, A, a)
    np.testing.assert_allclose(by_point, truth.max(axis=1), atol=2e-3 * truth.max())
    np.testing.assert_allclose(truth[np.arange(points), when], by_point, atol=2e-3 * truth.max())


def test_nothing_is_loaded():
    found = screen(MPI.COMM_SELF, np.zeros((3, 4, 2)), np.zeros((7, 2)))
    assert found.largest == 0.0


def test_ranks_without_points():
    """Ranks share the points, one has none; all know the largest, one has the point."""
    rng = np.random.default_rng(5)
    A, a = rng.normal(size=(3, 40, 4)), vibration(rng, 200, 4)
    comm = MPI.COMM_WORLD
    mine = A if comm.rank == 0 else A[:, :0]
    found = screen(comm, mine, a)
    assert found.largest == pytest.approx(norms(A, a).max(), rel=1e-12)
    assert (found.point >= 0) == (comm.rank == 0)
