"""Error of the simulated motion against CPU seconds: this package's integrators and SciPy's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from dolfinopt.bench.common import (
    Diagram,
    Goal,
    Plan,
    Row,
    Tell,
    bodies_of,
    curves,
    designs,
    timed,
)
from dolfinopt.dynamics import generalized_alpha, radau
from dolfinopt.dynamics.build import build_mechanism
from dolfinopt.dynamics.collocation import even_steps
from dolfinopt.dynamics.elastic_system import ElasticSystem, modes_of
from dolfinopt.dynamics.system import relative_error
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.end_effector import deviation
from dolfinopt.multibody.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.motion import breakpoints, rigid_motion
from dolfinopt.multibody.tangent import linearise
from dolfinopt.profiling import Profile
from dolfinopt.study.tables import Panel
from dolfinopt.study.variants import reduced

# One stage more than the methods compared: of order 11, theirs is 9 at most.
REFERENCE_STAGES, REFERENCE_TOLERANCE = 6, 1e-8
SAMPLES = 3001  # instants at which errors are taken, 1 ms apart
TOLERANCES = 1e-2, 1e-3, 1e-4, 1e-5, 1e-6  # the points of a curve
QUICK_TOLERANCES, QUICK_REFERENCE = TOLERANCES[:3], 1e-6
# CPU seconds that the next finer setting may take, by guess, in a quick bench and a full one.
PATIENCE = 1.0, 20.0
SHORT = 0.3  # what takes less is timed several times
GOAL = 1e-4  # the default of simulation.tolerance
USUAL = "Radau, 4 stages", f"tolerance {GOAL:g}"  # a simulation as scenes have it by default
LIMITS = (4, 0.03), (48, 0.3)  # seconds that it should take at most, by coordinates per arm
FASTER = 50.0  # times as fast as SciPy
MANY, QUICK_MANY = 48, 12  # coordinates per arm, beside the scene's usual 4


def diagram() -> Diagram:
    """Return the diagram of the time integrators."""
    return Diagram(
        "time",
        "Simulating the motion: error against time",
        (
            "design",
            "coordinates per arm",
            "method",
            "setting",
            "seconds [s]",
            "error of elastic coordinates [-]",
            "error of deviation [-]",
        ),
        _measure,
        _panels,
        _notes,
        abreast=2,
        goals=_goals,
    )


# -- problems --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Reference:
    """A problem and what its solutions are measured against.

    Attributes:
        problem: in its own coordinates.
        t: (n,) instants at which solutions are compared, s.
        q: (n, N) of the reference.
    """

    problem: ElasticSystem
    t: np.ndarray
    q: np.ndarray

    def errors(self, q: np.ndarray) -> tuple[float, float]:
        """Return the largest error of q (n, N), energy norm, and of the deviation, relative."""
        mechanism, motion = self.problem.mechanism, self.problem.motion(self.t)
        right = deviation(mechanism, motion, self.q)
        wrong = deviation(mechanism, motion, q) - right
        size = np.linalg.norm(right, axis=1).max()
        far = float(np.linalg.norm(wrong, axis=1).max() / size)
        return relative_error(mechanism, q - self.q, self.q), far


def find_reference(problem: ElasticSystem, tolerance: float = REFERENCE_TOLERANCE) -> Reference:
    """Solve by Radau of six stages to `tolerance`, or to what rounding leaves of it."""
    while True:
        try:
            solution = radau.integrate(problem, tolerance, REFERENCE_STAGES, Profile())
            break
        except ConvergenceError:
            if tolerance > 1e-7:
                raise
            tolerance *= 10.0
    t = np.linspace(0.0, problem.breakpoints[-1], SAMPLES)
    return Reference(problem, t, solution.sample(t))


def accelerations(problem: ElasticSystem, t: float, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return qdd (N,) from M(q, t) qdd = -rows(q, qd, 0): the rows are affine in qdd.

    Args:
        problem: N elastic coordinates.
        t: s.
        q, qd: (N,).
    """
    rest = np.zeros((1, len(q)))
    state = (q[None], qd[None], rest)
    motion = problem.motion(np.array([t]))
    rows = inverse_dynamics(problem.mechanism, motion, *state)[0][0]
    mass = linearise(problem.mechanism, motion, *state).dense()[0, :, 2 * len(q) :]
    return np.linalg.solve(mass, -rows)


def jacobian(problem: ElasticSystem, t: float, y: np.ndarray) -> np.ndarray:
    """Return the derivative (2N, 2N) of [qd, qdd] by y = [q, qd], exact."""
    size = len(y) // 2
    q, qd = y[:size], y[size:]
    qdd = accelerations(problem, t, q, qd)
    motion = problem.motion(np.array([t]))
    tangent = linearise(problem.mechanism, motion, q[None], qd[None], qdd[None]).dense()[0]
    lower = np.linalg.solve(tangent[:, 2 * size :], -tangent[:, : 2 * size])
    upper = np.hstack([np.zeros((size, size)), np.eye(size)])
    return np.vstack([upper, lower])


def scipy_motion(problem: ElasticSystem, method: str, tolerance: float, t: np.ndarray,
                 scales: tuple[float, float]) -> np.ndarray:  # fmt: skip
    """Return q (n, N) at t by SciPy's `solve_ivp`, piece by piece between the breakpoints.

    Args:
        problem: best in the arms' vibrations, where one absolute tolerance suits all.
        method: "Radau", "BDF", "LSODA".
        tolerance: rtol; atol is the same times the `scales`.
        t: ascending, the first 0, s.
        scales: sizes of q and qd.

    Raises:
        ConvergenceError: SciPy gave up.
    """
    start = problem.initial_state()[0][0]
    size = len(start)
    y = np.concatenate([start, np.zeros(size)])
    q = np.empty((len(t), size))
    atol = tolerance * np.repeat(scales, size)

    def derivative(now: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[size:], accelerations(problem, now, y[:size], y[size:])])

    ends = problem.breakpoints
    for first, last in pairwise(ends):
        here = (t >= first) & (t <= last)
        done = solve_ivp(
            derivative,
            (first, last),
            y,
            method,
            dense_output=True,
            rtol=tolerance,
            atol=atol,
            jac=partial(jacobian, problem),
        )
        if not done.success:
            raise ConvergenceError(f"solve_ivp: {done.message}")
        q[here] = done.sol(t[here])[:size].T
        y = done.y[:, -1]
    return q


# -- methods ---------------------------------------------------------------------------------

Solver = Callable[[], np.ndarray]


def _ours(reference: Reference, plan: Plan) -> Iterator[tuple[str, list[tuple[str, Solver]]]]:
    """Yield this package's methods: name, settings and solvers, coarse to fine."""
    problem, t = reference.problem, reference.t
    tolerances = QUICK_TOLERANCES if plan.quick else TOLERANCES

    def collocated(stages: int, tolerance: float) -> np.ndarray:
        return radau.integrate(problem, tolerance, stages, Profile()).sample(t)

    def stepped(rho_inf: float, count: int) -> np.ndarray:
        edges = even_steps(problem, count)
        return generalized_alpha.on_grid(problem, edges, 1e-6, rho_inf).sample(t)

    for stages in (2, 3, 4, 5):
        yield (
            f"Radau, {stages} stages",
            [(f"tolerance {tol:g}", partial(collocated, stages, tol)) for tol in tolerances],
        )
    counts = [250 * 3**k for k in range(3)] if plan.quick else [500 * 2**k for k in range(5)]
    for name, rho_inf in (
        ("generalised-alpha, 0.5", 0.5),
        ("generalised-alpha, 0.8", 0.8),
        ("Newmark", 1.0),
    ):
        yield name, [(f"{n} steps", partial(stepped, rho_inf, n)) for n in counts]


def _scipys(reference: Reference, plan: Plan) -> Iterator[tuple[str, list[tuple[str, Solver]]]]:
    """Yield SciPy's methods, in the coordinates that suit them."""
    modes = modes_of(reference.problem)
    z = modes.to_modes(reference.q)
    rates = np.gradient(z, reference.t, axis=0)
    scales = float(np.abs(z).max()), float(np.abs(rates).max())

    def solved(method: str, tolerance: float) -> np.ndarray:
        found = scipy_motion(modes.system, method, tolerance, reference.t, scales)
        return modes.from_modes(found)

    for method in ("Radau", "BDF", "LSODA"):
        tolerances = QUICK_TOLERANCES if plan.quick else TOLERANCES
        yield (
            f"SciPy {method}",
            [(f"rtol {tol:g}", partial(solved, method, tol)) for tol in tolerances],
        )


def _measure(plan: Plan, tell: Tell) -> list[Row]:
    rows: list[Row] = []
    for label, (arms, x_phys) in designs(plan, tell).items():
        for coordinates in (4, QUICK_MANY if plan.quick else MANY):
            scene = reduced(plan.scene, "craig-bampton", coordinates)
            mechanism = build_mechanism(scene, bodies_of(scene, arms, x_phys))
            motion = partial(rigid_motion, scene=scene)
            tell(f"reference, {label}, q = {coordinates}")
            reference = find_reference(
                ElasticSystem(mechanism, motion, breakpoints(scene)),
                QUICK_REFERENCE if plan.quick else REFERENCE_TOLERANCE,
            )
            for method, solvers in (*_ours(reference, plan), *_scipys(reference, plan)):
                tell(f"{method}, {label}, q = {coordinates}")
                found = _timed_all(solvers, reference, plan)
                rows += [(label, coordinates, method, *one) for one in found]
    return rows


def _timed_all(
    solvers: Sequence[tuple[str, Solver]], reference: Reference, plan: Plan
) -> Iterator[tuple[str, float, float, float]]:
    """Yield setting, seconds and errors; stops where the next one would take too long."""
    patience = PATIENCE[0] if plan.quick else PATIENCE[1]
    for setting, solver in solvers:
        try:
            seconds, q = timed(solver, 1)
        except ConvergenceError:
            continue  # no point of the curve
        if seconds < SHORT and plan.repeats > 1:
            seconds = min(seconds, timed(solver, plan.repeats - 1)[0])
        yield setting, seconds, *reference.errors(q)
        if 2.0 * seconds > patience:
            return


# -- presented -------------------------------------------------------------------------------


def _panels(rows: Sequence[Row]) -> tuple[Panel, ...]:
    kinds = dict.fromkeys((row[0], row[1]) for row in rows)
    return tuple(
        Panel(
            f"{design}, {q} coordinates per arm",
            "CPU time [s]",
            "error of elastic coordinates [-]",
            curves((row for row in rows if row[:2] == (design, q)), 2, 4, 5),
        )
        for design, q in kinds
    )


def _notes(rows: Sequence[Row]) -> list[str]:
    notes = [
        f"Reference: Radau with {REFERENCE_STAGES} stages, order {2 * REFERENCE_STAGES - 1}, to "
        f"{REFERENCE_TOLERANCE:g} ({QUICK_REFERENCE:g} in a quick bench); the methods have at most "
        f"{REFERENCE_STAGES - 1} stages and order {2 * REFERENCE_STAGES - 3}. Errors of the "
        "elastic coordinates in the energy norm, largest in time over the largest value.",
        "Radau from cold, its error estimate and refinements included; the other methods on "
        "given steps or tolerances, without an estimate of the global error. SciPy solves the "
        "same rows, with their exact Jacobian, in the arms' own vibrations, between breakpoints. A "
        f"method's finer settings are left out where the next one would take over "
        f"{PATIENCE[1]:g} s ({PATIENCE[0]:g} s in a quick bench).",
        "Newmark is the trapezoidal rule, beta = 1/4 and gamma = 1/2: generalised-alpha with "
        "rho_inf = 1, whose rows are taken at midpoints.",
    ]
    for design, q in dict.fromkeys((row[0], row[1]) for row in rows):
        here = [row for row in rows if row[:2] == (design, q)]
        ours, theirs = ((fastest(here, start)) for start in ("Radau", "SciPy"))
        if ours is None:
            continue
        note = f"{design}, q = {q}: to {GOAL:g} {ours[0]} takes {ours[1]:.3g} s"
        if theirs is None:
            note += ", no SciPy method that was tried gets there"
        else:
            ratio = theirs[1] / ours[1]
            note += f", {theirs[0]} {theirs[1]:.3g} s: {ratio:.0f} times as long"
        notes.append(f"{note}.")
    return notes


def _goals(rows: Sequence[Row]) -> list[Goal]:
    """Return the goals of a usual simulation, by the slower and the less superior design."""
    seconds, ratios = [], []
    for q, limit in LIMITS:
        usual = [row for row in rows if row[1] == q and row[2:4] == USUAL]
        times = [float(row[4]) for row in usual]
        shown = "; ".join(
            f"{row[0]} {float(row[4]):.3g}, error {float(row[5]):.1e}" for row in usual
        )
        what = f"simulation to {GOAL:g}, {q} coordinates per arm, from cold [s]"
        seconds.append(Goal(what, limit, max(times, default=np.nan), remark=shown))
        faster = [superiority(rows, row) for row in usual]
        shown = "; ".join(
            f"{row[0]} {ratio:.0f}{'' if sure else ' or more: SciPy stopped short of that error'}"
            for row, (ratio, sure) in zip(usual, faster, strict=True)
        )
        what = (
            f"the same, times as fast as solve_ivp at the same error, {q} coordinates per arm [-]"
        )
        least = min((ratio for ratio, _ in faster), default=np.nan)
        if least < FASTER and not all(sure for _, sure in faster):
            least = np.nan  # a bound that is too low tells nothing
        ratios.append(Goal(what, FASTER, least, least=True, remark=shown))
    return [*seconds, *ratios]


def superiority(rows: Sequence[Row], ours: Row) -> tuple[float, bool]:
    """Return how many times as long SciPy takes to the error of `ours`; or a bound, and False.

    A method that did not get there takes longer than its finest setting did.
    """
    error, seconds = float(ours[5]), float(ours[4])
    theirs = [row for row in rows if row[:2] == ours[:2] and str(row[2]).startswith("SciPy")]
    there = fastest(theirs, "SciPy", error)
    best, sure = (np.nan, False) if there is None else (there[1], True)
    for line in curves(theirs, 2, 4, 5):
        if line.y.min() > error and not line.x[-1] >= best:
            best, sure = float(line.x[-1]), False
    return best / seconds, sure


def fastest(rows: Sequence[Row], start: str, goal: float = GOAL) -> tuple[str, float] | None:
    """Return which method named `start...` first meets the error `goal`, and its seconds.

    Interpolated along its curve, log over log; None where no curve reaches it.
    """
    best: tuple[str, float] | None = None
    for line in curves((row for row in rows if str(row[2]).startswith(start)), 2, 4, 5):
        error, seconds = np.minimum.accumulate(line.y), line.x
        below = np.flatnonzero(error <= goal)
        if not len(below):
            continue
        k = int(below[0])
        at = float(seconds[k])
        if k > 0 and error[k] < error[k - 1]:
            share = np.log(error[k - 1] / goal) / np.log(error[k - 1] / error[k])
            at = float(seconds[k - 1] * (seconds[k] / seconds[k - 1]) ** share)
        if best is None or at < best[1]:
            best = line.label, at
    return best
