"""Whether `simulation.tolerance` is met: estimated and true error of random designs and motions."""

from __future__ import annotations

import math
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.special import ndtr

from dolfinopt.arms.arm import Arm
from dolfinopt.bench.common import Diagram, Goal, Plan, Row, Tell, arms_of, bodies_of, timed
from dolfinopt.bench.time import scipy_motion
from dolfinopt.dynamics import radau
from dolfinopt.dynamics.build import build_mechanism
from dolfinopt.dynamics.collocation import Solution, even_steps
from dolfinopt.dynamics.elastic_system import ElasticSystem, modes_of
from dolfinopt.dynamics.system import relative_error
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.multibody.motion import breakpoints, rigid_motion
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene
from dolfinopt.study.tables import Line, Panel
from dolfinopt.study.variants import changed, reduced

SEED, CASES, QUICK_CASES = 3, 50, 8
CELLS = 48, 6
TOLERANCES, FINEST = (1e-2, 1e-3, 1e-4), 1e-6
EVERY = 10  # of so many cases one is solved to the finest tolerance
STAGES = 4  # as scenes have by default
# The reference: another order, other steps, and a hundredth of the finest tolerance.
REFERENCE_STAGES, FINER, MOST_STEPS = 5, 100.0, 5000
INSTANTS = 10_001
# References of the shortest motions, of one vibration an arm, are checked by SciPy's explicit
# method, as its Radau takes too long with all coordinates.
CHECKED, QUICK_CHECKED, CHECK_METHOD, CHECK_TOLERANCE = 5, 1, "DOP853", 1e-10
DESIGNS = "uniform", "smooth", "void and solid", "weak tips"
PATHS, LAWS = ("arc", "line", "joints"), ("quintic", "septic")
WAVES = 64  # random waves that make a smooth design
# Radians w T of the slowest vibration during the motion: the quintic's largest acceleration, 5.8 of
# the path's length over T^2, bends the arms by 5.8 / (w T)^2 of it. With fewer it is no small bend.
LEAST_SWING = 10.0
LONE = 20  # points a line that the picture still marks, with a gap behind each


def diagram() -> Diagram:
    """Return the diagram of the error control."""
    return Diagram(
        "tolerance",
        "Random designs and motions: true error against tolerance and estimate",
        (
            "case",
            "design",
            "path",
            "duration [s]",
            "payload [kg]",
            "damping [s]",
            "coordinates per arm",
            "tolerance [-]",
            "estimate [-]",
            "true error [-]",
            "true error over estimate [-]",
            "steps",
            "seconds [s]",
            "error of the reference by its estimate [-]",
            "error of one vibration an arm by SciPy [-]",
            "failure",
        ),
        _measure,
        _panels,
        _notes,
        goals=_goals,
    )


# -- random cases ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Case:
    """A random design that moves in a random scene.

    Attributes:
        number: its seed, with `SEED`.
        design: one of `DESIGNS`.
        scene: its motion, payload, damping and coordinates.
        x_phys: physical densities of every arm.
        problem: the elastic rows.
    """

    number: int
    design: str
    scene: Scene
    x_phys: dict[int, np.ndarray]
    problem: ElasticSystem

    def cells(self) -> Row:
        """Return what tells the case from others, as the rows begin."""
        scene = self.scene
        return (
            self.number,
            self.design,
            scene.motion.path,
            scene.motion.duration,
            scene.payload.mass,
            scene.damping.stiffness_proportional,
            scene.reduction.coordinates,
        )


def random_case(scene: Scene, arms: dict[int, Arm], number: int, folder: Path) -> Case:
    """Draw a design and a motion that the arms can follow, by a seed of its own.

    Kinds of design take turns; whatever else is drawn anew until the path is within reach and the
    arms are stiff enough for it, see `LEAST_SWING`.

    Args:
        scene: whose arms move; two of them, for the tables of joints.
        arms: of the scene.
        number: of the case.
        folder: for its table of joints, which must outlive the case.
    """
    rng = np.random.default_rng((SEED, number))
    design = DESIGNS[number % len(DESIGNS)]
    while True:
        x_phys = {k: random_design(design, arm, rng) for k, arm in arms.items()}
        words = *_load(rng), *_motion(scene, rng, folder / f"{number}.csv")
        try:
            found = changed(scene, *words)
        except InputError:
            continue  # out of reach
        mechanism = build_mechanism(found, bodies_of(found, arms, x_phys))
        motion = partial(rigid_motion, scene=found)
        problem = ElasticSystem(mechanism, motion, breakpoints(found))
        if modes_of(problem).frequencies.min() * found.motion.duration >= LEAST_SWING:
            return Case(number, design, found, x_phys, problem)


def random_design(kind: str, arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return physical densities (n_cells,) of one of `DESIGNS`.

    The upper and the lower sixth are nearly solid, as those of optimised designs, so that the arm
    holds together; weak tips thin out over the outer 10 to 30 %, as modal truncation's optima do.
    """
    if kind == "uniform":
        return np.full(arm.mesh.num_cells, rng.uniform(0.3, 1.0))
    along, up = arm.mesh.centroid.T
    length, height = float(arm.mesh.outboard_point[0]), 2.0 * float(np.abs(up).max())
    field = _random_field(arm.mesh.centroid, height * 10.0 ** rng.uniform(-0.5, 0.5), rng)
    if kind == "void and solid":
        x = (field >= np.quantile(field, rng.uniform(0.2, 0.8))).astype(float)
        flange = 1.0
    else:
        x, flange = ndtr(field), rng.uniform(0.5, 1.0)
    x = np.where(np.abs(up) > height / 3.0, np.maximum(x, flange), x)
    if kind == "weak tips":
        part, least = rng.uniform(0.1, 0.3), 10.0 ** rng.uniform(-2.0, -0.5)
        x *= np.clip((1.0 - along / length) / part, least, 1.0)
    return x


def _random_field(points: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
    """Return a normal random field (n,) at points (n, 2), of mean 0 and variance 1.

    Its covariance is exp(-d^2 / (2 scale^2)) at a distance d, by random waves: Rahimi & Recht,
    Random Features for Large-Scale Kernel Machines (2007).
    """
    waves = rng.normal(size=(2, WAVES)) / scale
    phases = rng.uniform(0.0, 2.0 * np.pi, WAVES)
    return np.sqrt(2.0 / WAVES) * np.cos(points @ waves + phases).sum(axis=1)


def _load(rng: np.random.Generator) -> tuple[str, ...]:
    """Return payload, damping, none in half of the cases, and coordinates, as "key=value"."""
    damping = 0.0 if rng.random() < 0.5 else 10.0 ** rng.uniform(-6.0, -3.5)
    return (
        f"payload.mass={rng.uniform(0.0, 50.0)!r}",
        f"damping.stiffness_proportional={damping!r}",
        f"reduction.coordinates={rng.choice((4, 12))}",
    )


def _motion(scene: Scene, rng: np.random.Generator, file: Path) -> tuple[str, ...]:
    """Return an arc, a line or a spline of joint angles, as "key=value"; `file` is for these."""
    path, duration = rng.choice(PATHS), rng.uniform(0.5, 6.0)
    words = (
        f"motion.path={path}",
        f"motion.law={rng.choice(LAWS)}",
        f"motion.duration={duration!r}",
        f"motion.horizon={duration * rng.uniform(1.0, 1.5)!r}",
    )
    if path == "joints":
        names = ("cart", *(arm.name for arm in scene.arms))
        steps = rng.normal(size=(rng.integers(2, 6), len(names))) * [0.3, 0.5, 0.5]
        rows = np.array([0.0, 1.5, -1.5]) + np.cumsum(steps, axis=0)
        lines = [",".join(names), *(",".join(map(repr, row)) for row in rows.tolist())]
        file.write_text("\n".join(lines), encoding="utf-8")
        return (*words, f"motion.file={file}")
    words += (
        f"motion.joint_height={rng.uniform(-1.0, 0.0)!r}",
        f"motion.cart_follow={rng.uniform(0.0, 1.0)!r}",
        f"motion.elbow={rng.choice((-1, 1))}",
    )
    if path == "arc":
        flattening = rng.uniform(0.0, 1.0)
        return *words, f"motion.radius={rng.uniform(0.5, 1.5)!r}", f"motion.flattening={flattening}"
    start, end = (list(map(float, p)) for p in rng.uniform((-1.0, -0.5), (1.0, 1.0), (2, 2)))
    return *words, f"motion.start={start}", f"motion.end={end}"


# -- measured --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """A case simulated to a tolerance: CPU seconds, and the solution or why there is none."""

    tolerance: float
    seconds: float
    found: Solution | ConvergenceError


def _measure(plan: Plan, tell: Tell) -> list[Row]:
    scene = changed(plan.scene, f"arms.cells={list(CELLS)}")
    arms = arms_of(scene)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        count = QUICK_CASES if plan.quick else CASES
        cases = [random_case(scene, arms, number, Path(folder)) for number in range(count)]
        short = sorted(cases, key=lambda case: case.scene.motion.horizon)
        short = short[: QUICK_CHECKED if plan.quick else CHECKED]
        for case in cases:
            tell(f"case {case.number + 1} of {count}")
            check = checked(_slowest(case, arms)) if case in short else math.nan
            rows += compared(case, check)
    return rows


def _slowest(case: Case, arms: dict[int, Arm]) -> ElasticSystem:
    """Return the case with nothing but every arm's slowest vibration."""
    scene = reduced(case.scene, "modal", 1)
    mechanism = build_mechanism(scene, bodies_of(scene, arms, case.x_phys))
    return replace(case.problem, mechanism=mechanism)


def compared(case: Case, check: float = math.nan) -> list[Row]:
    """Return a row for every tolerance: the case's estimated and true error.

    Args:
        case: what is simulated.
        check: what SciPy found of its reference.
    """
    tolerances = (*TOLERANCES, FINEST) if case.number % EVERY == 0 else TOLERANCES
    runs = [run(case.problem, tolerance) for tolerance in tolerances]
    solved = [one for one in runs if isinstance(one.found, Solution)]
    right, failure = None, ""
    if solved:
        try:
            right = reference(case.problem, solved[-1])
        except ConvergenceError as error:
            failure = f"reference: {error}"
    return [(*case.cells(), *_cells(one, case.problem, right, check, failure)) for one in runs]


def run(problem: ElasticSystem, tolerance: float) -> Run:
    """Simulate from cold to a tolerance, as `simulate` does."""

    def solve() -> Solution | ConvergenceError:
        try:
            return radau.integrate(problem, tolerance, STAGES, Profile())
        except ConvergenceError as error:
            return error

    return Run(tolerance, *timed(solve, 1))


def reference(problem: ElasticSystem, run: Run) -> Solution:
    """Return the motion to a hundredth of the tolerance of a run, by its own steps and order.

    Steps are doubled until the estimate is below the goal, from one more than the run has: not by
    the expected order, so that what the run has overlooked has another chance to show.

    Raises:
        ConvergenceError: that many steps are not enough, or Newton fails.
    """
    if isinstance(run.found, ConvergenceError):
        raise run.found
    goal = run.tolerance / FINER
    start, count = run.found, len(run.found.a) + 1
    while count <= MOST_STEPS:
        start = radau.on_grid(problem, even_steps(problem, count), goal, REFERENCE_STAGES, start)
        if start.error <= goal:
            return start
        count *= 2
    raise ConvergenceError(f"an error of {start.error:.2g} with {len(start.a)} steps")


def checked(problem: ElasticSystem) -> float:
    """Return the relative difference of a problem's reference from SciPy's explicit solution.

    In the arms' vibrations, where one absolute tolerance suits all coordinates. nan if either
    fails.
    """
    modes, t = modes_of(problem), _instants(problem)
    first = run(problem, FINEST)
    try:
        right = reference(problem, first)
        sizes = [np.abs(modes.to_modes(right.sample(t, k))).max() for k in (0, 1)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # it is given a Jacobian in vain
            z = scipy_motion(modes.system, CHECK_METHOD, CHECK_TOLERANCE, t, (sizes[0], sizes[1]))
    except ConvergenceError:
        return math.nan
    q = right.sample(t)
    return relative_error(problem.mechanism, modes.from_modes(z) - q, q)


def _instants(problem: ElasticSystem) -> np.ndarray:
    return np.linspace(0.0, problem.breakpoints[-1], INSTANTS)


def _cells(
    one: Run, problem: ElasticSystem, right: Solution | None, other: float, failure: str
) -> Row:
    """Return the rest of a row, from the tolerance on."""
    found = one.found
    if isinstance(found, ConvergenceError):
        return one.tolerance, *[math.nan] * 3, 0, one.seconds, math.nan, other, str(found)
    true = known = math.nan
    if right is not None:
        t = _instants(problem)
        q = right.sample(t)
        true, known = relative_error(problem.mechanism, found.sample(t) - q, q), right.error
    return (
        one.tolerance,
        found.error,
        true,
        true / found.error,
        len(found.a),
        one.seconds,
        known,
        other,
        failure,
    )


# -- presented -------------------------------------------------------------------------------

TOLERANCE, ESTIMATE, TRUE, RATIO, REFERENCE, SCIPY, FAILURE = 7, 8, 9, 10, 13, 14, 15


def _panels(rows: Sequence[Row]) -> tuple[Panel, ...]:
    known = [row for row in rows if math.isfinite(float(row[TRUE]))]
    return (
        Panel("over the cases", "tolerance [-]", "true error [-]", tuple(_ranges(known))),
        Panel(
            "every case and tolerance",
            "estimated error [-]",
            "true error [-]",
            (*_points(known), *_diagonal("true = estimated", known, ESTIMATE)),
        ),
    )


def _ranges(rows: Sequence[Row]) -> Iterator[Line]:
    """Yield the largest, the median and the least true error by tolerance, and what is allowed."""
    tolerances = np.array(sorted({float(row[TOLERANCE]) for row in rows}))
    true = [[float(row[TRUE]) for row in rows if row[TOLERANCE] == tol] for tol in tolerances]
    for label, pick in (("largest", np.max), ("median", np.median), ("least", np.min)):
        yield Line(label, tolerances, np.array([pick(here) for here in true]))
    yield Line("allowed", tolerances, tolerances)


def _points(rows: Sequence[Row]) -> Iterator[Line]:
    """Yield true over estimated errors: nan behind every point keeps it from being joined."""
    for label, damped in (("undamped", False), ("damped", True)):
        here = [row for row in rows if (float(row[5]) > 0.0) is damped]
        for first in range(0, len(here), LONE):
            few = np.array([[row[ESTIMATE], row[TRUE]] for row in here[first : first + LONE]])
            apart = np.insert(few.astype(float), np.arange(len(few)) + 1, math.nan, axis=0)
            yield Line(label, *apart.T)


def _diagonal(label: str, rows: Sequence[Row], column: int) -> Iterator[Line]:
    ends = sorted(float(row[column]) for row in rows)
    if ends:
        yield Line(label, np.array([ends[0], ends[-1]]), np.array([ends[0], ends[-1]]))


def _notes(rows: Sequence[Row]) -> list[str]:
    notes = [
        f"Radau with {STAGES} stages from cold; {CELLS[0]} x {CELLS[1]} cells an arm. Errors of "
        f"the elastic coordinates in the energy norm at {INSTANTS} instants, largest in time over "
        "the largest value, against Radau with "
        f"{REFERENCE_STAGES} stages on other steps to a hundredth of a case's finest tolerance; "
        f"{FINEST:g} in every {EVERY}th case.",
    ]
    for tolerance in dict.fromkeys(float(row[TOLERANCE]) for row in rows):
        notes.append(_judgement(tolerance, [row for row in rows if row[TOLERANCE] == tolerance]))
    checks = {int(row[0]): row for row in rows if math.isfinite(float(row[SCIPY]))}
    if checks:
        most = max(float(row[SCIPY]) for row in checks.values())
        notes.append(
            f"References of the {len(checks)} shortest cases, with one vibration an arm and to "
            f"{FINEST / FINER:g}, differ from SciPy's {CHECK_METHOD}, rtol {CHECK_TOLERANCE:g}, by "
            f"at most {most:.2g}."
        )
    return notes


def _judgement(tolerance: float, rows: Sequence[Row]) -> str:
    """Return how often a tolerance is met, and by how much."""
    known = [row for row in rows if math.isfinite(float(row[TRUE]))]
    text = f"To {tolerance:g}: {len(rows)} cases"
    if known:
        true = np.array([float(row[TRUE]) for row in known]) / tolerance
        ratio = np.array([float(row[RATIO]) for row in known])
        met = int((true <= 1.0).sum())
        text += (
            f", met in {met} of {len(known)}; largest true error {true.max():.3g} times the "
            f"tolerance; true over estimated error {np.median(ratio):.3g} in the median, "
            f"{ratio.min():.3g} to {ratio.max():.3g}"
        )
    failures = [f"case {row[0]}: {row[FAILURE]}" for row in rows if row[FAILURE]]
    return f"{text}. Failures: {'; '.join(failures) or 'none'}."


def _goals(rows: Sequence[Row]) -> list[Goal]:
    """Return the goal that every tolerance is met."""
    over = [float(row[TRUE]) / float(row[TOLERANCE]) for row in rows]
    known = [value for value in over if math.isfinite(value)]
    missed = sum(value > 1.0 for value in known)
    remark = f"{missed} of {len(known)} random simulations miss it; {len(over) - len(known)} failed"
    return [
        Goal(
            "largest true error over simulation.tolerance [-]",
            1.0,
            max(known, default=math.nan),
            remark=remark,
        )
    ]
