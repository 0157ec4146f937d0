"""Exact gradients: trajectories by differences, what a wrong one does, the cost."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bodies import CONSTANTS, Chain, assert_close, beam, change_of, changed, derivative
from mpi4py import MPI
from remainders import taylor, wave
from runs import TWO_ARM, demo, environment, overrides, refused, run, scene
from scipy.optimize import brentq
from spatial_beams import DURATION, quintic_motion, reference_chain

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.dynamics import radau
from dolfinopt.dynamics.adjoint import Adjoint, add_gradients
from dolfinopt.dynamics.collocation import even_steps
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.simulation import DriveForces
from dolfinopt.multibody.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import scaled
from dolfinopt.optimization.gradient_check import TaylorTest
from dolfinopt.reduction import METHODS, AdjointFields, Method

WORLD = MPI.COMM_WORLD


# -- a trajectory ----------------------------------------------------------------------------


def swing(arms: int):
    """Return a motion that sets out from rest with an acceleration: the start is loaded."""
    size = np.array([0.1, 0.5, -0.4, 0.3])[: 1 + arms]
    rate = np.array([5.0, 4.0, 6.0, 3.0])[: 1 + arms]  # rad/s

    def motion(t: np.ndarray) -> RigidMotion:
        s, c = np.sin(np.outer(t, rate)), np.cos(np.outer(t, rate))
        return RigidMotion(size * (1.0 - c), size * rate * s, size * rate**2 * c)

    return motion


def plane_system(arms: int, gravity: tuple[float, float]) -> ElasticSystem:
    """Return beams in bases with M = I, which stays positive definite when its entries change."""
    arm = beam(axial=300.0, damping=1e-3)
    T = np.linalg.inv(np.linalg.cholesky(arm.body().M)).T
    K, D = T.T @ arm.K @ T, T.T @ arm.D @ T
    arm = replace(arm, modes=arm.modes @ T, K=K, D=D, outboard=arm.outboard @ T)
    chain = Chain((arm,) * arms, 0.5, 0.01, gravity, 0.0)
    return ElasticSystem(chain.mechanism(), swing(arms), (0.0, 0.1, 0.25))


SYSTEMS = {  # with steps and stages
    "1 arm": (lambda: plane_system(1, (1.0, -9.81)), 15, 3),
    "2 arms": (lambda: plane_system(2, (0.0, 0.0)), 15, 3),
    "3 arms": (lambda: plane_system(3, (1.0, -9.81)), 15, 2),
    "space": (
        lambda: ElasticSystem(reference_chain(2), quintic_motion, (0.0, DURATION)), 30, 3,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("name", SYSTEMS)
def test_gradient_of_a_trajectory(name: str) -> None:
    """Quadratic functions of coordinates, rates and drives, on and between the steps' ends."""
    make, steps, stages = SYSTEMS[name]
    system, rng = make(), np.random.default_rng(5)
    grid = even_steps(system, steps)
    t = np.linspace(0.0, system.breakpoints[-1], 18)
    base = radau.on_grid(system, grid, 1e-12, stages)

    def seen(system: ElasticSystem, solution) -> dict[str, np.ndarray]:
        rates = np.stack([solution.sample(t, k) for k in range(3)])
        drives = inverse_dynamics(system.mechanism, system.motion(t), *rates)[1]
        return {"coordinates": rates[:1], "rates": rates, "forces": drives[None]}

    weights, slopes, here = {}, {}, seen(system, base)
    for what, x in here.items():
        # Coordinates, rates and accelerations count as much.
        weights[what] = rng.uniform(0.5, 1.5, size=x.shape) * (x[0] ** 2).sum()
        weights[what] /= (x**2).sum(axis=(1, 2), keepdims=True)
        by = weights[what] * x
        if what == "forces":
            rates = base.sample(t, 0), base.sample(t, 1), base.sample(t, 2)
            by_rates, bodies = DriveForces(system, t, rates).gradient(by[0])
            slopes[what] = add_gradients(Adjoint(system, base).gradient(t, by_rates), bodies)
        else:
            slopes[what] = Adjoint(system, base).gradient(t, by[0] if len(by) == 1 else by)

    def values(model) -> list[float]:
        other = replace(system, mechanism=model)
        found = seen(other, radau.on_grid(other, grid, 1e-12, stages, base))
        return [0.5 * float(np.sum(w * found[what] ** 2)) for what, w in weights.items()]

    value = values(system.mechanism)
    bodies = system.mechanism.bodies
    for constant in CONSTANTS:
        if not any(np.size(getattr(body, constant)) for body in bodies):
            continue  # linear bodies have no geometric stiffness
        changes = []
        for body in bodies:
            one = np.asarray(getattr(body, constant))
            # Every entry moves by the constant's size; of K and D by the softest mode's.
            soft = constant in ("K", "D") and one.size
            size = np.linalg.norm(one, -2) if soft else np.abs(one).max(initial=0.0)
            changes.append(max(float(size), 1e-3) * change_of(rng, body, constant))

        def along(h: float, constant: str = constant, changes: list = changes) -> list[float]:
            model = system.mechanism
            for arm, change in enumerate(changes):
                model = changed(model, arm, constant, h * change)
            return values(model)

        # Newton leaves 1e-12 of the value, of which this step makes 1e-8.
        expected = derivative(along, 1e-4)
        for k, what in enumerate(here):
            pairs = zip(slopes[what], changes, strict=True)
            found = sum(np.sum(getattr(slope, constant) * change) for slope, change in pairs)
            close = pytest.approx(expected[k], rel=5e-6, abs=1e-7 * value[k])
            assert found == close, (what, constant)


# -- the whole chain -------------------------------------------------------------------------

QUICK = (
    "arms.cells=[24,3]",
    "motion.horizon=2.2",
    "simulation.tolerance=1e-3",
    "simulation.sample=0.01",
)
# At random designs of undamped arms the remainder's cubic part outweighs its square at 0.01.
FINER = tuple(0.00125 / 4.0**k for k in range(3))
LOADED = ["motion.gravity=[0.5,-9.81]", "payload.inertia=0.05"]


def rates(test: TaylorTest) -> dict[str, float]:
    return {row.direction: round(row.rate, 3) for row in test.rows}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("reduction.method=balanced", ("reduction.method", "balanced", "craig-bampton")),
        (
            "simulation.integrator=generalized-alpha",
            ("simulation.integrator", "generalized-alpha", '"radau"'),
        ),
    ],
)
def test_nothing_to_check(change: str, words: tuple[str, ...]) -> None:
    """Where there is no exact gradient, one line says so and what to choose."""
    with refused(str(TWO_ARM), *words):
        taylor(scene(*QUICK, change), wave, FINER)


@pytest.mark.serial  # ranks have no part in it
def test_frozen_deviation_stands_beside_the_exact_one() -> None:
    """Static loads tell most of a heavy payload's deviation, but not its sign everywhere."""
    test = taylor(scene(*QUICK, "objective.kind=deviation"), wave, FINER)
    assert test.passed, rates(test)
    assert 0.1 < test.angle < 45.0 and 0.5 < test.ratio < 1.0
    slopes = {row.direction: (row.slope, row.slope_frozen) for row in test.rows}
    exact, frozen = slopes["tip of the last arm"]
    assert exact > 0.0 > frozen


# -- what a wrong gradient does --------------------------------------------------------------


def no_modes(patch: pytest.MonkeyPatch) -> None:
    def nothing(_: object, basis, *__: object) -> AdjointFields:
        return AdjointFields(0.0 * basis.V, 0.0 * basis.V)

    frozen = {name: Method(method.reduce, nothing) for name, method in METHODS.items()}
    patch.setattr("dolfinopt.responses.sensitivity.METHODS", frozen)


def no_trajectory(patch: pytest.MonkeyPatch) -> None:
    def none(adjoint: Adjoint, *_: object):
        return [
            replace(scaled(body, 0.0, 0.0, 0.0), outboard=np.zeros_like(body.outboard))
            for body in adjoint.system.mechanism.bodies
        ]

    patch.setattr(Adjoint, "gradient", none)


def no_start(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("dolfinopt.dynamics.adjoint.add_gradients", lambda first, _: first)


def no_filter(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("dolfinopt.arms.arm.Arm.backward", lambda arm, slope, _: arm._active(slope))


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("fault", [no_modes, no_trajectory, no_start, no_filter])
def test_a_wrong_gradient_is_found(monkeypatch: pytest.MonkeyPatch, fault) -> None:
    """Each part of the chain left out alone: the remainders become of first order, or less."""
    fault(monkeypatch)
    test = taylor(scene(*QUICK, "design.filter_radius=0.05", *LOADED), wave, FINER)
    assert not test.passed
    assert min(row.rate for row in test.rows) < 1.3


# -- repeated frequencies --------------------------------------------------------------------


@cache
def fixed_frequencies(height: float) -> tuple[float, float]:
    """Return lambda of the first axial and the second bending mode, interfaces fixed, rad2/s2.

    The axial one is the only mode with a mean displacement along the arm.
    """
    loaded = scene(*QUICK, "reduction.coordinates=6", f"arms.height={height!r}")
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
    assert gap(height) == pytest.approx(0.0, abs=1e-10)  # eigenvalues are right to about 1e-12
    changes = ["reduction.coordinates=6", "design.filter_radius=0", "payload.mass=1.0"]
    # Softer: as many time steps as a slender arm takes; the ratio of frequencies is the same.
    changes += [f"arms.height={height!r}", "material.young_modulus=7e8"]
    test = taylor(scene(*QUICK, *changes), lambda k, x, y: np.full_like(x, 0.5), FINER)
    assert test.passed, rates(test)
    assert np.isfinite([row.slope for row in test.rows]).all()


# -- cost and ranks --------------------------------------------------------------------------


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
def test_same_gradient_on_any_number_of_ranks(tmp_path, method: str, ranks: int) -> None:
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


@pytest.mark.slow
@pytest.mark.serial
def test_payload_demo(shared_tmp_path, capsys) -> None:
    """Runs, tables and draws on few cells; a light payload gains by the exact gradient."""
    rows = demo("demo_payload").main(shared_tmp_path, (20, 2), (0.2,), 15)
    if WORLD.rank == 0:
        frozen, exact = rows
        assert (frozen["gradient"], exact["gradient"]) == ("esl", "exact")
        assert exact["compliance [N m]"] < 0.8 * frozen["compliance [N m]"]  # 0.70
        assert exact["material [-]"] < 0.45 < frozen["material [-]"]  # 0.397, 0.500
        lines = (shared_tmp_path / "payload.csv").read_text(encoding="utf-8").splitlines()
        assert len(lines) == 3 and lines[0] == ",".join(frozen)
        assert (shared_tmp_path / "payload.png").read_bytes().startswith(b"\x89PNG")
        assert "exact" in capsys.readouterr().out
