"""Many problems of the same bodies at once against each of them alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import beam, random_cloud
from machines import distance

from dolfinopt.dynamics import batch, radau
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.body_motion import Constants, Scale
from dolfinopt.multibody.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.mechanism import plane_chain
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, of_material, rigid_bar
from dolfinopt.multibody.tangent import linearise
from dolfinopt.paths import quintic
from dolfinopt.profiling import Profile

pytestmark = pytest.mark.serial  # arrays of one process

TOLERANCE = 1e-4
LEFT = 2.0 * batch.BATCH_NEWTON_SHARE * TOLERANCE  # by Newton's method, of either of two
DAMPING = 1e-3  # s


def two_arms(
    payload=1.0, inertia=0.01, duration=0.6, horizon=1.0, size=1.0, gravity=(0.0, 0.0),
    factors=(1.0, 1.0, DAMPING), bending=10.0,
) -> ElasticSystem:  # fmt: skip
    """Return two slender arms of 1 to 50 Hz; factors of mass, stiffness, and the damping, s."""
    body = beam(bending=bending, axial=300.0, damping=DAMPING).body()
    bodies = tuple(of_material(body, *factors) for _ in range(2))
    mechanism = plane_chain(bodies, payload, inertia, gravity, 0.0)

    def motion(t: np.ndarray) -> RigidMotion:
        s, sd, sdd = (np.outer(x, size * np.array([0.2, 1.0, -0.8])) for x in quintic(t, duration))
        return RigidMotion(np.array([0.0, 0.6, 0.8]) + s, sd, sdd)

    return ElasticSystem(mechanism, motion, (0.0, duration, horizon))


def various() -> list[ElasticSystem]:
    """Return problems that differ in all that a batch knows."""
    return [
        two_arms(),
        two_arms(payload=0.7, inertia=0.02),
        two_arms(duration=0.7, horizon=1.3),
        two_arms(size=0.5, gravity=(0.0, -2.0)),
        two_arms(factors=(1.1, 0.9, 0.0)),
        two_arms(factors=(0.9, 1.2, 2.0 * DAMPING)),
    ]


def solve(problems: list[ElasticSystem], starts_: list[Solution | None] | None = None):
    """Return the solutions and the profile; nothing may have been left to the single method."""
    profile = Profile()
    found = batch.integrate(problems, TOLERANCE, 3, profile, starts_ or [None] * len(problems))
    return found, profile


@pytest.fixture
def alone(monkeypatch) -> list[ElasticSystem]:
    """Return what the batch leaves to the single method."""
    left: list[ElasticSystem] = []
    single = batch.attempted

    def counted(solve, problem: ElasticSystem, *rest):
        left.append(problem)
        return single(solve, problem, *rest)

    monkeypatch.setattr(batch, "attempted", counted)
    return left


def test_scales_are_those_of_scaled_bodies():
    """Instant by instant other payloads, gravity and materials: as each mechanism by itself."""
    rng = np.random.default_rng(3)
    clouds = [random_cloud(rng, 3).body() for _ in range(2)]
    bodies = [replace(body, D=body.K) for body in clouds]
    factors = rng.uniform(0.5, 2.0, (4, 2, 3))
    payload = rng.uniform(0.5, 2.0, (4, 4))
    q, qd, qdd = rng.normal(size=(3, 4, 6))
    motion = RigidMotion(*rng.normal(size=(3, 4, 3)))
    many = plane_chain(tuple(bodies), *payload.T[:2], tuple(payload.T[2:]), 0.0)
    many = replace(many, scales=tuple(Scale(*factors[:, k].T.copy()) for k in range(2)))
    rows, drives = inverse_dynamics(many, motion, q, qd, qdd)
    slopes = linearise(many, motion, q, qd, qdd)
    change = rng.normal(size=(3, 4, 6))
    felt = slopes.times(*change, np.arange(6))
    for n in range(4):
        own = (of_material(b, f[0], f[1], f[2] / f[1]) for b, f in zip(bodies, factors[n]))
        gravity = (payload[n, 2], payload[n, 3])
        one = plane_chain(tuple(own), payload[n, 0], payload[n, 1], gravity, 0.0)
        at, (q1, qd1, qdd1) = motion[n : n + 1], (x[n : n + 1] for x in (q, qd, qdd))
        # The same sums in another order: rounding.
        alone = inverse_dynamics(one, at, q1, qd1, qdd1)
        matrix = linearise(one, at, q1, qd1, qdd1).dense()[0]
        moved = matrix @ np.concatenate([x[n] for x in change])
        pairs = (rows, alone[0][0]), (drives, alone[1][0]), (slopes.dense(), matrix), (felt, moved)
        for found, expected in pairs:
            np.testing.assert_allclose(found[n], expected, rtol=1e-10, atol=1e-10)


def test_batch_is_each_of_them_alone(alone):
    """To the tolerance with steps of its own, and to Newton's remainder on the same steps."""
    problems = various()
    found, profile = solve(problems)
    assert not alone  # all of them in the batch
    assert profile.counts.newton_iterations > 0
    assert len({len(one.a) for one in found}) == 2  # without damping it takes more of them
    for problem, one in zip(problems, found, strict=True):
        single = radau.integrate(problem, TOLERANCE, 3, Profile())
        assert one.error <= TOLERANCE
        assert distance(problem, one, single) <= 2.0 * TOLERANCE
        same = radau.on_grid(problem, one.time_grid, TOLERANCE, 3)
        assert distance(problem, one, same) <= LEFT
        # Of a single answer: more by what its contraction may leave, up to a quarter.
        assert 0.9 <= one.error / same.error <= 1.3


def test_order_does_not_matter():
    problems = various()
    here, _ = solve(problems)
    there, _ = solve(problems[::-1])
    for one, other in zip(here, there[::-1], strict=True):
        assert np.array_equal(one.time_grid, other.time_grid) and np.array_equal(one.a, other.a)


def test_a_start_keeps_its_steps(alone):
    """From its own solution the same steps, and less work."""
    problems = various()
    cold, first = solve(problems)
    warm, second = solve(problems, cold)
    assert not alone
    assert second.counts.newton_iterations < first.counts.newton_iterations
    for problem, one, other in zip(problems, cold, warm, strict=True):
        assert np.array_equal(one.time_grid, other.time_grid)
        assert distance(problem, one, other) <= LEFT


def test_one_problem_is_solved_as_ever(alone):
    problem = two_arms()
    (one,), _ = solve([problem])
    single = radau.integrate(problem, TOLERANCE, 3, Profile())
    assert np.array_equal(one.a, single.a) and len(alone) == 1


def with_elbow(system: ElasticSystem) -> ElasticSystem:
    """Return the system with a motor on its elbow, 2 kg."""
    loads = {(0, 0): Constants.of_point(2.0, 0.01), **system.mechanism.loads}
    return replace(system, mechanism=replace(system.mechanism, loads=loads))


@pytest.mark.parametrize(
    "other", [two_arms(bending=40.0), with_elbow(two_arms())], ids=["stiffer", "joint mass"]
)
def test_other_machines_are_solved_alone(alone, other):
    """A stiffer arm, or another motor, is no scaled one: it does not spoil the others' batch."""
    problems = [two_arms(), other, two_arms(payload=1.2)]
    found, _ = solve(problems)
    assert alone == [other]
    for problem, one in zip(problems, found, strict=True):
        single = radau.integrate(problem, TOLERANCE, 3, Profile())
        assert distance(problem, one, single) <= 2.0 * TOLERANCE


def test_failure_stays_alone():
    """Arms spun too fast for their stiffness fail; the others do not notice."""
    soft = two_arms(factors=(1.0, 1e-2, DAMPING), size=300.0)
    with pytest.raises(ConvergenceError) as error:
        radau.integrate(soft, TOLERANCE, 3, Profile())
    good = [two_arms(), two_arms(payload=1.3)]
    found, _ = solve([good[0], soft, good[1]])
    assert isinstance(found[1], ConvergenceError) and str(found[1]) == str(error.value)
    without, _ = solve(good)
    for problem, one, other in zip(good, (found[0], found[2]), without, strict=True):
        assert np.array_equal(one.time_grid, other.time_grid)
        assert distance(problem, one, other) <= LEFT  # the matrix is renewed at other times


def test_fallback_of_one_that_does_not_converge(monkeypatch, alone):
    """Whom Newton's method in the batch gives up is solved by itself."""
    problems = [two_arms(), two_arms(payload=1.3), two_arms(payload=1.6)]
    newton = batch.newton_batch

    def refuses(stages, *rest):
        found = newton(stages, *rest)
        heavy = stages.preconditioner.system.payload[:, 0] == 1.6
        return replace(found, converged=found.converged & ~heavy)

    monkeypatch.setattr(batch, "newton_batch", refuses)
    found, _ = solve(problems)
    assert alone == [problems[2]]
    assert all(one.error <= TOLERANCE for one in found)


def test_bodies_without_coordinates(alone):
    """A rigid arm among them."""
    bar = rigid_bar(0.5, 0.05, 0.675)

    def problem(payload: float) -> ElasticSystem:
        whole = two_arms(payload=payload)
        bodies: tuple[ShapeIntegrals, ...] = (bar, whole.mechanism.bodies[1])
        return replace(whole, mechanism=replace(whole.mechanism, bodies=bodies))

    problems = [problem(1.0), problem(1.5)]
    found, _ = solve(problems)
    assert not alone
    for one, each in zip(found, problems, strict=True):
        same = radau.on_grid(each, one.time_grid, TOLERANCE, 3)
        assert distance(each, one, same) <= LEFT
