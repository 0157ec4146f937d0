"""Error of the simulated motion against CPU seconds: this package's integrators and SciPy's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from dolfinopt.bench.measure import DESIGNS, Arms, Densities, Plan, bodies_of, designs, timed
from dolfinopt.bench.panel import Diagram, Panel, Rows, Steps
from dolfinopt.dynamics import generalized_alpha, radau
from dolfinopt.dynamics.build import build_system
from dolfinopt.dynamics.collocation import even_steps
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.system import relative_error
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.end_effector import deviation
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene
from dolfinopt.study.variants import reduced

# One stage more than the methods compared: of order 11, theirs is 9 at most.
REFERENCE_STAGES, REFERENCE_TOLERANCE, QUICK_REFERENCE = 6, 1e-8, 1e-6
SAMPLES = 3001  # instants at which errors are taken, 1 ms apart
TOLERANCES = 1e-2, 1e-3, 1e-4, 1e-5, 1e-6  # the points of a curve
# CPU seconds that the next finer setting may take, by guess, in a quick bench and a full one.
QUICK_PATIENCE, PATIENCE = 1.0, 20.0
SHORT = 0.3  # s; what takes less is timed several times
FEW, MANY, QUICK_MANY = 4, 48, 12  # coordinates per arm
SECONDS, ERROR = "seconds [s]", "error of elastic coordinates [-]"
# A simulation as scenes have it by default.
USUAL = {"method": "Radau, 4 stages", "setting": "tolerance 0.0001"}


@dataclass(frozen=True, eq=False)
class Reference:
    """A problem, instants t (n,) s, and q (n, N) that solutions are measured against."""

    problem: ElasticSystem
    t: np.ndarray
    q: np.ndarray

    def errors(self, q: np.ndarray) -> tuple[float, float]:
        """Return the largest error of q (n, N), energy norm, and of the deviation, relative."""
        mechanism, motion = self.problem.mechanism, self.problem.motion(self.t)
        right = deviation(mechanism, motion, self.q)
        wrong = deviation(mechanism, motion, q) - right
        far = np.linalg.norm(wrong, axis=1).max() / np.linalg.norm(right, axis=1).max()
        return relative_error(mechanism, q - self.q, self.q), float(far)


def problem_of(scene: Scene, arms: Arms, x_phys: Densities) -> ElasticSystem:
    """Return the elastic rows of a scene's motion with these densities."""
    found = build_system(scene, bodies_of(scene, arms, x_phys))
    assert isinstance(found, ElasticSystem)
    return found


def find_reference(problem: ElasticSystem, tolerance: float) -> Reference:
    """Solve by Radau of six stages to `tolerance`, or to what rounding leaves of it."""
    t = np.linspace(0.0, problem.breakpoints[-1], SAMPLES)
    while True:
        try:
            solution = radau.integrate(problem, tolerance, REFERENCE_STAGES, Profile())
            return Reference(problem, t, solution.sample(t))
        except ConvergenceError:
            if tolerance > 1e-7:
                raise
            tolerance *= 10.0


# -- SciPy -----------------------------------------------------------------------------------


def accelerations(problem: ElasticSystem, t: float, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return qdd (N,) from M(q, t) qdd = -residual(q, qd, 0), t in s; q and qd are (N,)."""
    now, state = problem.at(np.array([t])), (q[None], qd[None], np.zeros((1, len(q))))
    mass = now.linearise(*state).dense()[0, :, 2 * len(q) :]
    return np.linalg.solve(mass, -now.residual(*state)[0])


def jacobian(problem: ElasticSystem, t: float, y: np.ndarray) -> np.ndarray:
    """Return the derivative (2N, 2N) of [qd, qdd] by y = [q, qd], exact."""
    size = len(y) // 2
    q, qd = y[:size], y[size:]
    qdd = accelerations(problem, t, q, qd)
    tangent = problem.at(np.array([t])).linearise(q[None], qd[None], qdd[None]).dense()[0]
    lower = np.linalg.solve(tangent[:, 2 * size :], -tangent[:, : 2 * size])
    return np.vstack([np.eye(size, 2 * size, size), lower])


def scipy_motion(
    problem: ElasticSystem, method: str, tolerance: float, t: np.ndarray, sizes: list[float]
) -> np.ndarray:
    """Return q (n, N) at t by SciPy's `solve_ivp`, piece by piece between the breakpoints.

    Best in the arms' vibrations, where one absolute tolerance suits all: the relative one times the
    `sizes` of q and qd.

    Raises:
        ConvergenceError: SciPy gave up.
    """
    start = problem.initial_state()[0][0]
    size = len(start)
    y, q = np.concatenate([start, np.zeros(size)]), np.empty((len(t), size))
    options = {"rtol": tolerance, "atol": tolerance * np.repeat(sizes, size)}
    options |= {"jac": partial(jacobian, problem), "dense_output": True}

    def rate(now: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[size:], accelerations(problem, now, y[:size], y[size:])])

    for ends in pairwise(problem.breakpoints):
        done = solve_ivp(rate, ends, y, method, **options)
        if not done.success:
            raise ConvergenceError(f"solve_ivp: {done.message}")
        here = (t >= ends[0]) & (t <= ends[1])
        q[here], y = done.sol(t[here])[:size].T, done.y[:, -1]
    return q


# -- measured --------------------------------------------------------------------------------

Solver = Callable[[Any, Any, Reference], np.ndarray]


def _radau(stages: int, tolerance: float, to: Reference) -> np.ndarray:
    return radau.integrate(to.problem, tolerance, stages, Profile()).sample(to.t)


def _alpha(rho_inf: float, steps: int, to: Reference) -> np.ndarray:
    time_grid = even_steps(to.problem, steps)
    return generalized_alpha.on_grid(to.problem, time_grid, 1e-6, rho_inf).sample(to.t)


def _scipy(method: str, tolerance: float, to: Reference) -> np.ndarray:
    modes = to.problem.preconditioner()
    z = modes.to_modes(to.q)
    sizes = [float(np.abs(each).max()) for each in (z, np.gradient(z, to.t, axis=0))]
    return modes.from_modes(scipy_motion(modes.system, method, tolerance, to.t, sizes))


# Name of a method, what it takes its name from, how its settings are called.
METHODS: tuple[tuple[str, Any, Solver, str], ...] = (
    *((f"Radau, {stages} stages", stages, _radau, "tolerance {:g}") for stages in (2, 3, 4, 5)),
    *((f"generalised-alpha, {rho}", rho, _alpha, "{} steps") for rho in (0.5, 0.8)),
    ("Newmark", 1.0, _alpha, "{} steps"),
    *((f"SciPy {name}", name, _scipy, "rtol {:g}") for name in ("Radau", "BDF", "LSODA")),
)


def _steps(plan: Plan) -> Steps:
    tolerance = QUICK_REFERENCE if plan.quick else REFERENCE_TOLERANCE
    patience = QUICK_PATIENCE if plan.quick else PATIENCE
    tolerances = TOLERANCES[:3] if plan.quick else TOLERANCES  # coarse to fine
    counts = [250 * 3**k for k in range(3)] if plan.quick else [500 * 2**k for k in range(5)]

    @cache
    def reference(design: str, q: int) -> Reference:
        scene = reduced(plan.scene, "craig-bampton", q)
        return find_reference(problem_of(scene, *designs(plan)[design]), tolerance)

    def curve(design: str, q: int, method: str, of: Any, solver: Solver, words: str) -> Rows:
        right = reference(design, q)
        for setting in counts if solver is _alpha else tolerances:
            solve = partial(solver, of, setting, right)
            try:
                seconds, _, found = timed(solve)
            except ConvergenceError:
                continue  # no point of the curve
            if seconds < SHORT and plan.repeats > 1:
                seconds = min(seconds, timed(solve, plan.repeats - 1)[0])
            yield design, q, method, words.format(setting), seconds, *right.errors(found)
            if 2.0 * seconds > patience:
                return

    for design in DESIGNS:
        for q in (FEW, QUICK_MANY if plan.quick else MANY):
            for method in METHODS:
                yield f"{method[0]}, {design}, q = {q}", partial(curve, design, q, *method)


DIAGRAM = Diagram(
    "time",
    "Simulating the motion: error against time",
    f"design | coordinates per arm | method | setting | {SECONDS} | {ERROR} | "
    "error of deviation [-]",
    _steps,
    (
        Panel(SECONDS, ERROR, "method", each=("design", "coordinates per arm"),
              errors=(1e-2, 1e-4)),
    ),
    f"Reference: Radau with {REFERENCE_STAGES} stages to {REFERENCE_TOLERANCE:g} (quick: "
    f"{QUICK_REFERENCE:g}). Errors in the energy norm, largest in time over the largest value. "
    "Radau from cold, estimate and refinements included; the others on given steps or tolerances. "
    "SciPy solves the same residual, with its exact Jacobian, in the arms' own vibrations. No "
    f"finer setting where it would take over {PATIENCE:g} s ({QUICK_PATIENCE:g}).",
)  # fmt: skip
