"""Exact gradients: every link of the chain against differences, the whole chain by Taylor tests."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from bodies import (
    CONSTANTS,
    Chain,
    Cloud,
    assert_close,
    beam,
    changed,
    derivative,
    random_cloud,
    unit_changes,
)
from mpi4py import MPI
from runs import ROOT, TWO_ARM, environment, overrides, run
from scipy.optimize import brentq

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.dynamics import radau
from dolfinopt.dynamics.adjoint import Adjoint, add_gradients
from dolfinopt.dynamics.build import check_motion
from dolfinopt.dynamics.collocation import Solution, even_steps
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.simulation import DriveForces
from dolfinopt.errors import InputError
from dolfinopt.multibody.end_effector import end_effector, end_effector_gradient
from dolfinopt.multibody.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, scaled
from dolfinopt.multibody.tangent import body_gradient
from dolfinopt.optimization.gradient_check import TaylorTest, taylor_test
from dolfinopt.parallel import sum_over_arms
from dolfinopt.reduction import METHODS, AdjointFields, Basis, Method
from dolfinopt.scene.load import Scene

WORLD = MPI.COMM_WORLD

ARMS = pytest.mark.parametrize("arms", [1, 2, 3])
DIFFERENCES = 1e-11  # relative: what those of sixth order leave on functions of size one


@pytest.fixture
def rng() -> np.random.Generator:
    """Return the same random numbers on all ranks."""
    return np.random.default_rng(5)


# -- one instant -----------------------------------------------------------------------------


def random_chain(rng: np.random.Generator, arms: int, bent: bool = False) -> Mechanism:
    """Return random bodies with payload and gravity in both directions."""
    clouds = tuple(random_cloud(rng, q) for q in (2, 3, 1)[:arms])
    model = Chain(clouds, 0.8, 0.3, (1.0, -2.0), -0.4).mechanism()
    if not bent:
        return model
    bodies = []
    for body in model.bodies:
        K0 = rng.normal(scale=0.1, size=(7 + body.num_modes, body.num_modes, body.num_modes))
        K0 = K0 + K0.swapaxes(1, 2)
        parts = {"K0": K0[:4], "K0_outboard": K0[4:7], "along_modes": 0.1 * K0[7:]}
        bodies.append(replace(body, **parts))
    return replace(model, bodies=tuple(bodies))


def random_instants(
    rng: np.random.Generator, model: Mechanism, count: int
) -> tuple[RigidMotion, np.ndarray]:
    """Return a motion and q, qd, qdd, multipliers (4, count, N)."""
    rigid = rng.normal(scale=0.7, size=(3, count, 1 + len(model.bodies)))
    return RigidMotion(*rigid), rng.normal(scale=0.7, size=(4, count, model.num_coordinates))


@pytest.mark.serial  # ranks have no part in it
@ARMS
@pytest.mark.parametrize("name", CONSTANTS)
def test_body_slopes_are_those_of_the_rows(rng: np.random.Generator, arms: int, name: str) -> None:
    """Every entry of every constant of every body, payload and gravity included."""
    model = random_chain(rng, arms)
    motion, (q, qd, qdd, multipliers) = random_instants(rng, model, 4)
    slopes = body_gradient(model, motion, q, qd, qdd, multipliers)
    for arm, body in enumerate(model.bodies):
        changes = list(unit_changes(body, name))

        def work(t: float, arm: int = arm, changes: list[np.ndarray] = changes) -> np.ndarray:
            models = [changed(model, arm, name, t * change) for change in changes]
            rows = [inverse_dynamics(one, motion, q, qd, qdd)[0] for one in models]
            return np.array([np.sum(multipliers * row) for row in rows])

        found = [np.sum(getattr(slopes[arm], name) * change) for change in changes]
        # A single coordinate has no G; the virtual work is of size one in all units here.
        assert_close(found, derivative(work), 10.0 * DIFFERENCES, size=10.0)


@pytest.mark.serial  # ranks have no part in it
@ARMS
@pytest.mark.parametrize("bent", [False, True], ids=["linear", "bent"])
def test_end_effector_slopes(rng: np.random.Generator, arms: int, bent: bool) -> None:
    """By the coordinates, by the outboard modes and by their geometric stiffness."""
    model = random_chain(rng, arms, bent)
    motion, (q, _, _, _) = random_instants(rng, model, 3)
    weights = rng.normal(size=(3, 2))
    by_q, by_outboard = end_effector_gradient(model, motion, q, weights)

    def place(one: Mechanism, coordinates: np.ndarray) -> float:
        return float(np.sum(weights * end_effector(one, motion, coordinates)))

    unit = np.eye(q.size).reshape(-1, *q.shape)
    expected = derivative(lambda t: [place(model, q + t * e) for e in unit])
    assert_close(by_q.ravel(), expected, DIFFERENCES)
    for arm, body in enumerate(model.bodies):
        assert set(by_outboard[arm]) == ({"outboard", "K0_outboard"} if bent else {"outboard"})
        for name, found in by_outboard[arm].items():
            changes = list(unit_changes(body, name))

            def moved(
                t: float, arm: int = arm, name: str = name, all_of: list[np.ndarray] = changes
            ) -> list[float]:
                return [place(changed(model, arm, name, t * c), q) for c in all_of]

            products = [np.sum(found * change) for change in changes]
            assert_close(products, derivative(moved), DIFFERENCES)


# -- a trajectory ----------------------------------------------------------------------------


def swing(arms: int) -> Callable[[np.ndarray], RigidMotion]:
    """Return a motion that sets out from rest with an acceleration: the start is loaded."""
    size = np.array([0.1, 0.5, -0.4, 0.3])[: 1 + arms]
    rate = np.array([5.0, 4.0, 6.0, 3.0])[: 1 + arms]  # rad/s

    def motion(t: np.ndarray) -> RigidMotion:
        phase = np.outer(t, rate)
        return RigidMotion(
            size * (1.0 - np.cos(phase)),
            size * rate * np.sin(phase),
            size * rate**2 * np.cos(phase),
        )

    return motion


def orthonormal(cloud: Cloud) -> Cloud:
    """Return the same body with M = I, which stays positive definite when its entries change."""
    T = np.linalg.inv(np.linalg.cholesky(cloud.body().M)).T
    K, D = T.T @ cloud.K @ T, T.T @ cloud.D @ T
    return replace(cloud, modes=cloud.modes @ T, K=K, D=D, outboard=cloud.outboard @ T)


LOOKED_AT = ("coordinates", "rates", "forces")


def seen(problem: ElasticSystem, solution: Solution, t: np.ndarray, what: str) -> np.ndarray:
    """Return what a function looks at, (k, n, m): coordinates, these with rates, or forces."""
    rates = np.stack([solution.sample(t, k) for k in range(3)])
    if what == "coordinates":
        return rates[:1]
    if what == "rates":
        return rates
    return inverse_dynamics(problem.mechanism, problem.motion(t), *rates)[1][None]


def seen_gradient(
    problem: ElasticSystem, solution: Solution, t: np.ndarray, what: str, by: np.ndarray
) -> list[ShapeIntegrals]:
    """Return the gradient by the bodies of a function of `seen`, by its derivative (k, n, m)."""
    if what != "forces":
        return Adjoint(problem, solution).gradient(t, by[0] if len(by) == 1 else by)
    rates = (solution.sample(t, 0), solution.sample(t, 1), solution.sample(t, 2))
    by_rates, bodies = DriveForces(problem, t, rates).gradient(by[0])
    return add_gradients(Adjoint(problem, solution).gradient(t, by_rates), bodies)


@pytest.mark.slow
@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize(
    ("arms", "gravity", "stages"),
    [(1, (1.0, -9.81), 3), (2, (0.0, 0.0), 3), (3, (1.0, -9.81), 2)],
)
def test_trajectory_slopes(
    rng: np.random.Generator, arms: int, gravity: tuple[float, float], stages: int
) -> None:
    """Quadratic functions of the motion, of drives too, on and between the steps' ends.

    All of them are looked at in the same motions.
    """
    arm = orthonormal(beam(axial=300.0, damping=1e-3))
    chain = Chain((arm,) * arms, 0.5, 0.01, gravity, 0.0)
    problem = ElasticSystem(chain.mechanism(), swing(arms), (0.0, 0.1, 0.25))
    edges = even_steps(problem, 15)
    t = np.linspace(0.0, 0.25, 18)

    base = radau.on_grid(problem, edges, 1e-12, stages)
    here = {what: seen(problem, base, t, what) for what in LOOKED_AT}
    weights = {}
    for what, x in here.items():
        # Coordinates, rates and accelerations count as much.
        weights[what] = rng.uniform(0.5, 1.5, size=x.shape) * (x[0] ** 2).sum()
        weights[what] /= (x**2).sum(axis=(1, 2), keepdims=True)

    def solve(model: Mechanism) -> list[float]:
        changed_problem = replace(problem, mechanism=model)
        solution = radau.on_grid(changed_problem, edges, 1e-12, stages, base)
        return [
            0.5 * float(np.sum(w * seen(changed_problem, solution, t, what) ** 2))
            for what, w in weights.items()
        ]

    slopes = {
        what: seen_gradient(problem, base, t, what, weights[what] * x) for what, x in here.items()
    }
    value = np.array([0.5 * np.sum(weights[what] * x**2) for what, x in here.items()])
    bodies = problem.mechanism.bodies
    for name in CONSTANTS:
        if np.size(getattr(bodies[0], name)) == 0:  # a linear body has no geometric stiffness
            continue
        # One direction, in which every entry of every body moves by the constant's size; of the
        # stiffness by its softest mode's.
        changes = []
        for body in bodies:
            value_of = getattr(body, name)
            size = np.linalg.norm(value_of, -2) if name == "K" else np.abs(value_of).max()
            size = max(float(size), 1e-3)
            changes.append(size * sum(rng.uniform(-1.0, 1.0) * c for c in unit_changes(body, name)))

        def function(
            t_: float, name: str = name, changes: list[np.ndarray] = changes
        ) -> list[float]:
            model = problem.mechanism
            for arm, change in enumerate(changes):
                model = changed(model, arm, name, t_ * change)
            return solve(model)

        # Newton leaves 1e-12 of the value, of which this step makes 1e-8. Squares of rates and
        # accelerations are less smooth in the bodies than those of coordinates.
        expected = derivative(function, 1e-4)
        for k, what in enumerate(LOOKED_AT):
            pairs = zip(slopes[what], changes, strict=True)
            found = sum(np.sum(getattr(slope, name) * change) for slope, change in pairs)
            assert found == pytest.approx(expected[k], rel=1e-6, abs=1e-7 * value[k]), (what, name)


# -- the whole chain -------------------------------------------------------------------------


# The gradient is that of the motion as it is solved, whose steps the Taylor test keeps.
ROUGHLY = ("simulation.tolerance=1e-3", "simulation.sample=0.01")


def scene(*overrides: str) -> Scene:
    """Return the two-arm scene on few cells, to 0.3 s after the motion's end."""
    return do.load_scene(TWO_ARM, ("arms.cells=[24,3]", "motion.horizon=2.2", *ROUGHLY, *overrides))


def noise(arm: Arm, index: int) -> np.ndarray:
    """Return random variables in [0.1, 0.9] that depend on the place alone."""
    x, y = arm.mesh.centroid.T * 1e3
    return 0.1 + 0.8 * (np.abs(np.sin(12.9 * x + 78.2 * y + index) * 43758.5) % 1.0)


def wave(arm: Arm, index: int) -> np.ndarray:
    """Return variables that vary smoothly along and across the arm."""
    x, y = arm.mesh.centroid.T / arm.mesh.outboard_point[0]
    return 0.5 + 0.3 * np.sin(7.0 * x + index) + 2.0 * y


# From finer steps than the command's: at random designs of undamped arms the remainder's cubic
# part outweighs its square at 0.01, and where the two cancel no rate can be read.
FINER = tuple(0.00125 / 4.0**k for k in range(3))


@pytest.fixture(autouse=True)
def _finer_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dolfinopt.optimization.gradient_check.STEPS", FINER)


def taylor(loaded: Scene, design: Callable[[Arm, int], np.ndarray] = noise) -> TaylorTest:
    """Run the Taylor test at a design."""
    profile = do.Profile()
    partition = do.partition_arms(WORLD, loaded.cell_counts)
    arms = do.build_arms(loaded, partition, profile)
    return taylor_test(loaded, partition, arms, {k: design(a, k) for k, a in arms.items()}, profile)


def rates(test: TaylorTest) -> dict[str, float]:
    """Return the rate of every direction, for messages."""
    return {row.direction: round(row.rate, 3) for row in test.rows}


def assert_passed(test: TaylorTest) -> None:
    """Assert second-order remainders; a direction whose remainders are all rounding shows none."""
    assert test.passed, rates(test)
    assert sum(np.isfinite(row.rate) for row in test.rows) >= 3, rates(test)


LOADED = ["motion.gravity=[0.5,-9.81]", "payload.inertia=0.05"]
EFFORT = ["objective.kind=effort", "constraints.compliance=1e6"]


@pytest.mark.serial
@pytest.mark.parametrize(
    "overrides",
    [
        ["reduction.coordinates=3"],
        ["reduction.coordinates=4", "objective.kind=compliance"],
        ["reduction.coordinates=6", *LOADED],
        ["reduction.method=modal", "reduction.coordinates=1"],
        ["reduction.method=modal", "reduction.coordinates=4", *LOADED],
        ["damping.stiffness_proportional=0.0", "motion.horizon=2.2"],
        ["objective.kind=deviation", "objective.gradient=exact", *LOADED],
        ["objective.kind=compliance", "payload.mass=0.2", "arms.passive=0.05", *LOADED],
        [*EFFORT, "payload.mass=0.5"],
        [*EFFORT, "reduction.method=modal", "simulation.stiffening=true", *LOADED],
    ],
    ids=" ".join,
)
def test_gradient_is_one(overrides: list[str]) -> None:
    """Second-order remainders along every direction."""
    assert_passed(taylor(scene(*overrides), wave))


@pytest.mark.parametrize("kind", ["static", pytest.param("compliance", marks=pytest.mark.serial)])
def test_gradient_on_skew_triangles(kind: str, shared_tmp_path: Path) -> None:
    """Gmsh's transfinite triangles, where the filter couples cells through their facets."""
    path = shared_tmp_path / "skew.geo"
    if WORLD.rank == 0:
        path.write_text(TRANSFINITE)
    WORLD.barrier()
    test = taylor(
        do.load_scene(
            TWO_ARM,
            (f"arms.mesh='{path}'", "design.filter_radius=0.02", f"objective.kind={kind}"),
        )
    )
    assert_passed(test)


TRANSFINITE = """Point(1) = {0, -0.03, 0}; Point(2) = {1, -0.03, 0}; Point(3) = {1, 0.03, 0};
Point(4) = {0, 0.03, 0}; Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
Transfinite Curve {1, 3} = 25; Transfinite Curve {2, 4} = 4; Transfinite Surface {1};
Physical Curve("inboard") = {4}; Physical Curve("outboard") = {2};
"""


@pytest.mark.parametrize(
    "overrides",
    [
        ["objective.kind=static"],
        ["objective.kind=static", "reduction.method=balanced"],
        ["objective.kind=eigenfrequency"],
        ["objective.kind=eigenfrequency", "simulation.integrator=generalized-alpha"],
        ["objective.kind=eigenfrequency", "arms.arm1.rigid=true"],
        ["objective.kind=static", "arms.arm2.design=arm1"],
    ],
    ids=" ".join,
)
def test_gradient_of_objectives_without_a_motion(overrides: list[str]) -> None:
    """Nothing moves, nothing is frozen, and neither basis nor integrator matters."""
    test = taylor(scene(*overrides), wave)
    assert_passed(test)
    assert all(row.slope != 0.0 for row in test.rows)  # the boxes are on designed arms
    assert np.isnan([test.angle, test.ratio, *(row.slope_frozen for row in test.rows)]).all()


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["reduction.method=balanced"], 'reduction.method = "balanced": .* has no adjoint'),
        (["simulation.integrator=generalized-alpha"], 'integrator = "generalized-alpha": .*radau'),
    ],
)
def test_nothing_to_check(overrides: list[str], expected: str) -> None:
    """Where there is no exact gradient, one line says so and what to choose."""
    with pytest.raises(InputError, match=expected) as caught:
        taylor(scene(*overrides))
    assert "\n" not in str(caught.value) and str(TWO_ARM) in str(caught.value)


@pytest.mark.serial  # ranks have no part in it
def test_frozen_deviation_stands_beside_the_exact_one() -> None:
    """Static loads tell most of a heavy payload's deviation, but not its sign everywhere."""
    test = taylor(scene("objective.kind=deviation"), wave)
    assert_passed(test)
    assert 0.1 < test.angle < 45.0 and 0.5 < test.ratio < 1.0
    slopes = {row.direction: (row.slope, row.slope_frozen) for row in test.rows}
    exact, frozen = slopes["tip of the last arm"]
    assert exact > 0.0 > frozen


def random_scene(seed: int) -> Scene:
    """Return a scene whose every part that the gradient passes through is drawn anew."""
    rng = np.random.default_rng(seed)
    while True:
        kind = str(rng.choice(["esl", "compliance", "deviation"]))
        method = str(rng.choice(["craig-bampton", "modal"]))
        least = 3 if method == "craig-bampton" else 1
        values = {
            "objective.kind": kind,
            "objective.gradient": "exact",
            "reduction.method": method,
            "reduction.coordinates": rng.integers(least, 7),
            "payload.mass": 10.0 ** rng.uniform(-1.0, 1.0),
            "payload.inertia": rng.choice([0.0, 0.02]),
            "motion.radius": rng.uniform(0.6, 1.1),
            "motion.flattening": rng.uniform(0.0, 1.0),
            "motion.duration": rng.uniform(1.2, 2.5),
            "motion.horizon": rng.uniform(1.8, 2.4),
            "motion.gravity": [0.0, float(rng.choice([0.0, -9.81]))],
            "arms.cells": [int(rng.integers(16, 31)), int(rng.integers(2, 5))],
            "arms.0.height": rng.uniform(0.04, 0.12),
            "arms.1.height": rng.uniform(0.04, 0.12),
            "arms.passive": rng.choice([0.0, 0.06]),
            "design.filter_radius": rng.choice([0.0, 0.01, 0.05]),
            "damping.stiffness_proportional": rng.choice([0.0, 2e-4, 1e-3]),
            "interpolation.floor": 10.0 ** rng.uniform(-6.0, -2.0),
        }
        try:
            changes = [f"{key}={value}" for key, value in values.items()]
            drawn = do.load_scene(TWO_ARM, [*ROUGHLY, *changes])
            check_motion(drawn)
        except InputError:  # out of the arms' reach: draw again
            continue
        return drawn


@pytest.mark.serial
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_gradient_is_one_in_random_scenes(seed: int) -> None:
    """Payload, path, geometry, mesh, reduction, filter, damping, floor and objective drawn."""
    assert_passed(taylor(random_scene(seed)))


# -- what a wrong gradient does --------------------------------------------------------------


def no_modes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hold the modes."""

    def nothing(_: object, basis: Basis, *__: object) -> AdjointFields:
        return AdjointFields(0.0 * basis.V, 0.0 * basis.V)

    frozen = {name: Method(method.reduce, nothing) for name, method in METHODS.items()}
    monkeypatch.setattr("dolfinopt.responses.sensitivity.METHODS", frozen)


def no_trajectory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hold the coordinates."""

    def none(adjoint: Adjoint, *_: object) -> list[ShapeIntegrals]:
        bodies = adjoint.system.mechanism.bodies
        return [
            replace(scaled(body, 0.0, 0.0, 0.0), outboard=np.zeros_like(body.outboard))
            for body in bodies
        ]

    monkeypatch.setattr(Adjoint, "gradient", none)


def no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hold the equilibrium that the motion starts from."""
    monkeypatch.setattr("dolfinopt.dynamics.adjoint.add_gradients", lambda first, _: first)


def no_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the slopes by the physical densities for those by the variables."""
    monkeypatch.setattr("dolfinopt.arms.arm.Arm.backward", lambda arm, slope, _: arm._active(slope))


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("fault", [no_modes, no_trajectory, no_start, no_filter])
def test_a_wrong_gradient_is_found(
    monkeypatch: pytest.MonkeyPatch, fault: Callable[[pytest.MonkeyPatch], None]
) -> None:
    """Each part of the chain left out alone: the remainders become of first order, or less."""
    fault(monkeypatch)
    test = taylor(scene("design.filter_radius=0.05", *LOADED), wave)
    assert not test.passed
    assert min(row.rate for row in test.rows) < 1.3


# -- repeated frequencies --------------------------------------------------------------------


@cache
def fixed_frequencies(height: float) -> tuple[float, float]:
    """Return lambda of the first axial and the second bending mode, interfaces fixed, rad2/s2.

    The axial one is the only mode with a mean displacement along the arm.
    """
    loaded = scene("reduction.coordinates=6", f"arms.height={height!r}")
    arm = Arm(loaded, 0, MPI.COMM_SELF, do.Profile())
    body = arm.reduce(arm.uniform(0.5))
    values = np.diag(body.K)[3:]
    axial = int(np.argmax(np.abs(body.C[0, 3:])))
    return float(values[axial]), float(np.delete(values, axial)[1])


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("apart", [0.0, 1e-6], ids=["equal", "close"])
def test_repeated_frequencies(apart: float) -> None:
    """Bending and axial modes of one frequency mix anyhow, and the gradient does not care."""

    def gap(height: float) -> float:
        axial, bending = fixed_frequencies(height)
        return bending / axial - 1.0 - apart

    height = float(brentq(gap, 0.47, 0.51, xtol=1e-15, rtol=1e-14))
    # Eigenvalues are right to about 1e-12.
    assert gap(height) == pytest.approx(0.0, abs=1e-10)
    loaded = scene(
        "reduction.coordinates=6",
        f"arms.height={height!r}",
        "design.filter_radius=0",
        "payload.mass=1.0",
        # Softer: as many time steps as a slender arm takes; the ratio of frequencies is the same.
        "material.young_modulus=7e8",
    )
    test = taylor(loaded, lambda arm, _: np.full(arm.mesh.num_cells, 0.5))
    assert_passed(test)
    assert np.isfinite([row.slope for row in test.rows]).all()


# -- cost and ranks --------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["craig-bampton", "modal"])
def test_exact_gradient_factorises_nothing(method: str) -> None:
    """Beside the ESL one: a few more solves, with the factors at hand."""
    counts = {}
    for kind in ("esl", "exact"):
        loaded = scene(f"reduction.method={method}", f"objective.gradient={kind}")
        profile = do.Profile()
        partition = do.partition_arms(WORLD, loaded.cell_counts)
        arms = do.build_arms(loaded, partition, profile)
        x_phys = {k: arm.physical(wave(arm, k)) for k, arm in arms.items()}
        _, trajectory = do.evaluate(loaded, partition, arms, x_phys, profile)
        slopes = do.gradient(loaded, partition, arms, trajectory, profile)
        assert sum_over_arms(partition, {k: np.array(g @ g) for k, g in slopes.items()}) > 0.0
        counts[kind] = profile.counts
    solves = counts["exact"].solves - counts["esl"].solves
    adjoint = {"solves": 0, "adjoints": 0, "energy_fields": 0}
    assert replace(counts["exact"], **adjoint) == replace(counts["esl"], **adjoint)
    # Three for the constraint modes; conjugate gradients take some ten for each normal mode.
    arms_here = len(arms)
    assert 3 * arms_here <= solves <= 200 * arms_here


# The command with even small arms cut in pieces where there are more ranks than arms.
SPLIT = """
from dolfinopt import parallel
parallel.SPLIT_CELLS = 1
from dolfinopt.cli import main
main()
"""


@pytest.mark.serial
@pytest.mark.slow
@pytest.mark.parametrize(("method", "ranks"), [("craig-bampton", 2), ("modal", 3)])
def test_same_gradient_on_any_number_of_ranks(tmp_path: Path, method: str, ranks: int) -> None:
    """Whole arms dealt out to two ranks; an arm cut in two on three."""
    found = []
    for count in (1, ranks):
        out = tmp_path / f"{count}.npz"
        line = ["gradient", str(TWO_ARM), "--kind", "exact", "--out", str(out)]
        line += overrides("arms.cells=[20,4]", "motion.horizon=2.0", f"reduction.method={method}")
        if count == 1:
            run(*line)
        else:
            line = ["mpirun", "-n", str(count), sys.executable, "-c", SPLIT, *line]
            subprocess.run(line, env=environment(), check=True, capture_output=True, timeout=120)
        with np.load(out) as data:
            found.append({key: data[key] for key in data.files})
    assert found[1].keys() == found[0].keys()
    for key, values in found[0].items():
        if values.dtype.kind == "U":  # names of the scene and of the objective
            assert np.array_equal(found[1][key], values)
        else:
            assert_close(found[1][key], values, 1e-8)


# -- demo ------------------------------------------------------------------------------------


def demo() -> ModuleType:
    """Import the demo by its path."""
    spec = importlib.util.spec_from_file_location("demo_payload", ROOT / "demos/demo_payload.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.serial
def test_payload_demo(shared_tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Runs, tables and draws on few cells; a light payload gains by the exact gradient."""
    rows = demo().main(shared_tmp_path, (20, 2), (0.2,), 15)
    if WORLD.rank == 0:
        frozen, exact = rows
        assert (frozen["gradient"], exact["gradient"]) == ("esl", "exact")
        assert exact["compliance [N m]"] < 0.8 * frozen["compliance [N m]"]  # 0.70
        assert exact["material [-]"] < 0.45 < frozen["material [-]"]  # 0.397, 0.500
        lines = (shared_tmp_path / "payload.csv").read_text(encoding="utf-8").splitlines()
        assert len(lines) == 3 and lines[0] == ",".join(frozen)
        assert (shared_tmp_path / "payload.png").read_bytes().startswith(b"\x89PNG")
        assert "exact" in capsys.readouterr().out
