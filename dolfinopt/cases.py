"""Cached and resumable cases, spread over the ranks: optimisations, simulations, comparisons.

A case is known by what it computes: a hash of the scene's content and of the design, never a name,
a path or a date. Its results are the usual files in DIR/cases/<key>/; the summary comes last and
tells that the case is done. Every case runs on one rank alone, so that its bits do not depend on
how many there are. Ranks take cases by locking their folders: a lock ends with its process, and
several runs may work on the same DIR.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

import numpy as np

from dolfinopt.board import IDLE, Board, open_board
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.scene import FILE_KEYS, Scene

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.arm import Arm
    from dolfinopt.files import HistoryRow
    from dolfinopt.ledger import Ledger
    from dolfinopt.parallel import ArmShare
    from dolfinopt.results import Simulated

Action = Literal["optimize", "simulate", "compare"]

CASES = "cases"  # folder of all cases
SUMMARY, FAILURE, LOCK = "summary.json", "failure.json", ".lock"
# Craig-Bampton with this many coordinates stands for the unreduced arm.
REFERENCE_METHOD, REFERENCE = "craig-bampton", 48
MODES = 3  # natural modes that "compare" looks at
# Scenes that differ in nothing but these tables have the same arms: they are meshed, assembled
# and factorised once.
SCENARIO = (
    "motion",
    "payload",
    "damping",
    "reduction",
    "simulation",
    "objective",
    "constraints",
    "optimizer",
    "scenarios",
)


@dataclass(frozen=True, eq=False)
class Case:
    """One thing to compute. Two cases are equal when they compute the same.

    Attributes:
        scene: complete; its name does not matter.
        action: "optimize" finds a design, "simulate" moves a given one, "compare" says what its
            reduced basis misses of `REFERENCE` Craig-Bampton coordinates.
        design: of the last two: that of an optimising case, of a file, or None, the initial one.
        label: what progress and messages call it.
    """

    scene: Scene
    action: Action = "simulate"
    design: Case | Path | None = None
    label: str = field(default="", compare=False)

    @cached_property
    def key(self) -> str:
        """Sixteen hexadecimal digits that stand for everything the case computes."""
        parts: list[Any] = [self.action, scene_content(self.scene), self.design_key]
        if self.action == "compare":
            parts += [REFERENCE_METHOD, REFERENCE, MODES]
        return _digest(parts)

    @cached_property
    def design_key(self) -> str:
        """What stands for the given design in the key."""
        if isinstance(self.design, Case):
            return self.design.key
        return "initial" if self.design is None else _file_digest(self.design)

    @cached_property
    def arms_key(self) -> str:
        """Equal where the same arms with the same design are simulated or compared."""
        content = scene_content(self.scene)
        kept = {table: value for table, value in content.items() if table not in SCENARIO}
        return _digest([self.action, kept, self.design_key])

    @property
    def basis_key(self) -> str:
        """Equal where the same basis and damping can be used again, with equal `arms_key`."""
        return repr((self.scene.reduction, self.scene.damping))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Case) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


@dataclass(frozen=True)
class BasisFigures:
    """What one arm's basis misses, see `reduction.BasisErrors`; first `MODES` modes.

    Attributes:
        arm: its name.
        frequency: relative excess of the natural frequencies.
        mac: modal assurance criterion of the modes that belong to them.
        compliance: relative loss under unit loads at the outboard interface, F_x, F_y, moment.
        angle: rad, between the reference's modes and the basis.
    """

    arm: str
    frequency: tuple[float, ...]
    mac: tuple[float, ...]
    compliance: tuple[float, ...]
    angle: tuple[float, ...]


@dataclass(frozen=True)
class Outcome:
    """What came out of a case, read back from its folder. What it does not have is nan.

    Attributes:
        case, folder: which, and where its files are.
        failure: message, "" where it succeeded.
        objective: N m, N m s, m or s2.
        compliance: of the load cases, N m.
        max_deviation, max_deviation_time: m, s.
        grayness: over all arms.
        volume_fraction: mean of the arms.
        iterations, stop_reason: of an optimisation.
        seconds: that it took.
        bases: of a comparison, one an arm with a design of its own.
    """

    case: Case
    folder: Path
    failure: str = ""
    objective: float = math.nan
    compliance: float = math.nan
    max_deviation: float = math.nan
    max_deviation_time: float = math.nan
    grayness: float = math.nan
    volume_fraction: float = math.nan
    iterations: int = 0
    stop_reason: str = ""
    seconds: float = math.nan
    bases: tuple[BasisFigures, ...] = ()

    @property
    def design(self) -> Path:
        """Path of the design.npz."""
        return self.folder / "design.npz"

    def deviation(self) -> tuple[np.ndarray, np.ndarray]:
        """Return sample instants (n,), s, and the end-effector's distance from its path (n,), m."""
        with np.load(self.folder / "trajectory.npz", allow_pickle=False) as data:
            return data["t"], np.hypot(*data["deviation"].T)

    def history(self) -> list[HistoryRow]:
        """Return the optimisation's history."""
        from dolfinopt.files import read_history

        return read_history(self.folder / "history.csv")


@dataclass(frozen=True)
class Outcomes:
    """All cases of a run.

    Attributes:
        by_case: in the order asked for.
        computed: how many were not there before.
    """

    by_case: Mapping[Case, Outcome]
    computed: int

    def __getitem__(self, case: Case) -> Outcome:
        """Return what came out of a case, under its label."""
        return replace(self.by_case[case], case=case)

    @property
    def failures(self) -> list[Outcome]:
        """Those that failed."""
        return [outcome for outcome in self.by_case.values() if outcome.failure]


# -- keys ------------------------------------------------------------------------------------


def scene_content(scene: Scene) -> dict[str, Any]:
    """Return everything that a scene computes with: its values, and its files' content."""
    data = scene.to_dict()
    del data["name"]
    for table, key in FILE_KEYS:
        rows = data[table] if isinstance(data[table], list) else [data[table]]
        for row in rows:
            if row[key] is not None:
                row[key] = _file_digest(Path(row[key]))
    return data


def _file_digest(path: Path) -> str:
    """Hash a file's content, and that of the files which a .geo merges or includes."""
    known: dict[Path, str] = {}

    def take(path: Path, asked: bool) -> None:
        try:
            content = path.read_bytes()
        except OSError as error:
            if asked:
                raise InputError(f"{path}: cannot be read ({error.strerror})") from None
            return  # Gmsh will say so
        known[path] = hashlib.sha256(content).hexdigest()
        if path.suffix.lower() == ".geo":
            for name in re.findall(r'(?:Merge|Include)\s*\(?\s*"([^"]+)"', content.decode()):
                if path.parent / name not in known:
                    take(path.parent / name, False)

    take(path, True)
    return _digest(list(known.values()))


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# -- the run ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Job:
    """Cases one rank does in one go: an optimisation, or one design in many scenes."""

    cases: tuple[Case, ...]

    @property
    def cost(self) -> float:
        """Rough measure of the time it takes; the reduced equations' cost grows with q^2."""
        steps = [
            case.scene.optimizer.max_iterations if case.action == "optimize" else 1
            for case in self.cases
        ]
        sizes = [1.0 + (case.scene.reduction.coordinates / 10.0) ** 2 for case in self.cases]
        return sum(step * size for step, size in zip(steps, sizes, strict=True))


def run_cases(
    cases: Iterable[Case], folder: Path, world: MPI.Comm, *, shown: bool = True
) -> Outcomes:
    """Do all cases that are not done yet, and those they depend on (collective).

    A case that fails to converge is reported in its outcome, and so are those that need its
    design; it is tried again in the next run.

    Args:
        cases: any number, in any order, also repeated.
        folder: DIR; can be written.
        world: all ranks, which share a file system.
        shown: draw progress on the root's standard error.

    Raises:
        InputError: a scene or design cannot be used; the others stay unfinished.
    """
    from dolfinopt.parallel import on_root

    wanted = _with_dependencies(cases)
    place = folder / CASES
    done, run = on_root(world, lambda: ([_is_done(place / c.key) for c in wanted], uuid4().hex))
    missing = [case for case, there in zip(wanted, done, strict=True) if not there]
    with open_board(world, len(missing), shown) as board:
        _work(_jobs(missing, world.size), place, run, board)
        board.wait_for_all()
    world.barrier()
    outcomes = {case: _read(case, place, run) for case in wanted}
    return Outcomes(outcomes, len(missing))


def _with_dependencies(cases: Iterable[Case]) -> list[Case]:
    """Return every case once, after the one it needs."""
    found: dict[Case, None] = {}
    for case in cases:
        if isinstance(case.design, Case):
            found.setdefault(case.design)
        found.setdefault(case)
    return list(found)


def _jobs(cases: Sequence[Case], ranks: int) -> list[_Job]:
    """Return the jobs, optimisations first, as others wait for them, and longest first."""
    groups: dict[str, list[Case]] = {}
    for case in cases:
        name = case.key if case.action == "optimize" else case.arms_key
        groups.setdefault(name, []).append(case)
    jobs = []
    for group in groups.values():
        ordered = sorted(group, key=lambda case: case.basis_key)
        parts = ranks if len(groups) < ranks else 1
        cuts = np.linspace(0, len(ordered), min(parts, len(ordered)) + 1).astype(int)
        jobs += [_Job(tuple(ordered[a:b])) for a, b in pairwise(cuts)]
    return sorted(jobs, key=lambda job: (job.cases[0].action != "optimize", -job.cost))


def _work(jobs: Sequence[_Job], place: Path, run: str, board: Board) -> None:
    """Take jobs until none is left; the other ranks do the same."""
    left = list(jobs)
    while left:
        for job in left:
            if _is_finished(job, place, run) or _do(job, place, run, board):
                left.remove(job)
                break
        else:
            board.listen()
            time.sleep(IDLE)


def _is_finished(job: _Job, place: Path, run: str) -> bool:
    return all(
        (place / case.key / SUMMARY).exists() or _failure(place / case.key, run)
        for case in job.cases
    )


def _do(job: _Job, place: Path, run: str, board: Board) -> bool:
    """Do a job if it is ready and nobody else is at it; return whether it is done."""
    given = job.cases[0].design
    if isinstance(given, Case):
        if reason := _failure(place / given.key, run):
            for case in job.cases:
                _fail(place / case.key, run, f"{given.label or given.key}: {reason}")
                board.tell(case.label, text="its design is missing", finished=1)
            return True
        if not (place / given.key / SUMMARY).exists():
            return False
        given = place / given.key / "design.npz"
    with _claim(place / job.cases[0].key) as mine:
        if not mine:
            return False
        missing = [
            case
            for case in job.cases
            if not ((place / case.key / SUMMARY).exists() or _failure(place / case.key, run))
        ]
        if job.cases[0].action == "optimize":
            for case in missing:
                _optimise(case, place / case.key, run, board)
        elif missing:
            _examine(missing, given, place, run, board)
    return True


@contextmanager
def _claim(folder: Path) -> Iterator[bool]:
    """Yield whether this process has the folder's lock, which ends with the block or with it."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / LOCK, "w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
            return
        yield True


# -- what is done ----------------------------------------------------------------------------


def _optimise(case: Case, folder: Path, run: str, board: Board) -> None:
    """Optimise, from the checkpoint of an interrupted run if there is one."""
    from mpi4py import MPI

    from dolfinopt import checkpoint
    from dolfinopt.files import read_history
    from dolfinopt.optimization import optimize
    from dolfinopt.results import write_result

    begun = time.perf_counter()
    scene = _unnamed(case)
    limit = scene.optimizer.max_iterations
    resume, earlier = True, 0.0
    try:
        checkpoint.check(folder, scene)
    except InputError:  # none, damaged, or made when a file of the scene was elsewhere
        resume = False
    if resume and (folder / "history.csv").exists():
        rows = read_history(folder / "history.csv")
        earlier = rows[-1].seconds if rows else 0.0

    def report(row: HistoryRow) -> None:
        text = f"{row.iteration}/{limit} objective {row.objective:.4g}"
        board.tell(case.label, row.iteration, limit, text)

    try:
        result = optimize(scene, folder, resume=resume, world=MPI.COMM_SELF, report=report)
    except ConvergenceError as error:
        _fail(folder, run, str(error))
        board.tell(case.label, text=f"failed: {error}", finished=1)
        return
    wall = earlier + time.perf_counter() - begun
    write_result(scene, folder, result, wall, paraview=False)
    end = result.evaluation
    text = f"{result.iterations} iterations, {_figures(end.compliance, end.max_deviation)}"
    board.tell(case.label, text=f"{text}, {wall:.1f} s", finished=1)


def _examine(
    cases: Sequence[Case], design: Path | None, place: Path, run: str, board: Board
) -> None:
    """Simulate or compare one design in many scenes."""
    from dolfinopt.results import write_simulation

    board.tell(cases[0].label, text="...")
    kind = cases[0].action
    scenes = [_unnamed(case) for case in cases]
    results = simulate_scenarios(scenes, design) if kind == "simulate" else compare(scenes, design)
    begun = time.perf_counter()
    for case, scene, found in zip(cases, scenes, results):
        folder, wall = place / case.key, time.perf_counter() - begun
        folder.mkdir(parents=True, exist_ok=True)
        if isinstance(found, ConvergenceError):
            _fail(folder, run, str(found))
            text = f"failed: {found}"
        elif isinstance(found, tuple):
            _write_comparison(folder, scene, found, wall)
            text = "compared"
        else:
            write_simulation(folder, found, wall, paraview=False)
            text = _figures(found.evaluation.compliance, found.evaluation.max_deviation)
        board.tell(case.label, text=f"{text}, {wall:.1f} s", finished=1)
        begun = time.perf_counter()


def simulate_scenarios(
    scenes: Sequence[Scene], design: Path | None
) -> Iterator[Simulated | ConvergenceError]:
    """Simulate one design in many scenes, on this rank alone.

    Arms are meshed, assembled and factorised once, and reduced once for every change of
    `reduction` between neighbours. A scene whose simulation fails yields its error.

    Args:
        scenes: that differ in `SCENARIO` alone.
        design: design.npz, or None, the initial one.

    Raises:
        InputError: the design does not fit the arms.
    """
    from dolfinopt.evaluation import evaluate
    from dolfinopt.ledger import Ledger
    from dolfinopt.results import Simulated

    ledger = Ledger()
    share, arms, x_phys = _posed(scenes[0], design, ledger)
    for scene in scenes:
        arms = {k: arm.under(scene) for k, arm in arms.items()}
        try:
            evaluation, trajectory = evaluate(scene, share, arms, x_phys, ledger)
        except ConvergenceError as error:
            yield error
        else:
            yield Simulated(scene, share, arms, x_phys, evaluation, trajectory, ledger)
        _clear(ledger)


def compare(
    scenes: Sequence[Scene], design: Path | None
) -> Iterator[tuple[BasisFigures, ...] | ConvergenceError]:
    """Compare one design's bases with `REFERENCE` Craig-Bampton coordinates, on this rank alone.

    Args:
        scenes: that differ in `SCENARIO` alone; their reduction counts.
        design: design.npz, or None, the initial one.

    Raises:
        InputError: the design does not fit the arms.
    """
    from dolfinopt.ledger import Ledger
    from dolfinopt.reduction import METHODS, Options, basis_errors

    _, arms, x_phys = _posed(scenes[0], design, Ledger())
    richer = {}
    for k, arm in arms.items():
        arm.set_design(x_phys[k])
        most = min(REFERENCE, arm.elastic.num_dofs)
        richer[k] = METHODS[REFERENCE_METHOD].reduce(arm.elastic, Options(most), None)
    for scene in scenes:
        figures = []
        try:
            for k in arms:
                arm = arms[k] = arms[k].under(scene)
                arm.reduce(x_phys[k])
                assert arm.basis is not None
                errors = basis_errors(arm.elastic, arm.basis, richer[k], MODES)
                values = (errors.frequency, errors.mac, errors.compliance, errors.angle)
                figures.append(BasisFigures(scene.arms[k].name, *(tuple(v) for v in values)))
        except ConvergenceError as error:
            yield error
        else:
            yield tuple(figures)


def _posed(
    scene: Scene, design: Path | None, ledger: Ledger
) -> tuple[ArmShare, dict[int, Arm], dict[int, np.ndarray]]:
    """Build the arms on this rank; return them with the physical densities of the design."""
    from mpi4py import MPI

    from dolfinopt.arm import build_arms
    from dolfinopt.files import read_design
    from dolfinopt.parallel import share_arms

    share = share_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = build_arms(scene, share, ledger)
    if design is not None:
        return share, arms, read_design(design, share, arms)
    return share, arms, {k: arm.uniform(scene.design.initial) for k, arm in arms.items()}


def _clear(ledger: Ledger) -> None:
    """Begin the account of the next scene; its ledger is known to the arms."""
    from dolfinopt.ledger import Counts

    ledger.seconds.clear()
    ledger.counts = Counts()


def _unnamed(case: Case) -> Scene:
    """Return the scene under the case's key, so that a checkpoint does not depend on a name."""
    return case.scene.model_copy(update={"name": case.key})


def _figures(compliance: float, deviation: float) -> str:
    return f"compliance {compliance:.4g} N m, deviation {1e3 * deviation:.4g} mm"


# -- files -----------------------------------------------------------------------------------


def _write_comparison(
    folder: Path, scene: Scene, figures: Sequence[BasisFigures], wall: float
) -> None:
    from dolfinopt.files import versions, write_summary

    summary = {
        "name": scene.name,
        "bases": [vars(one) for one in figures],
        "seconds": {"total": wall},
        "versions": versions(),
        "scene": scene.to_dict(),
    }
    write_summary(folder, summary)


def _is_done(folder: Path) -> bool:
    """Tell whether the folder holds a complete result; a damaged one is done anew."""
    try:
        json.loads((folder / SUMMARY).read_text(encoding="utf-8"))["seconds"]["total"]
    except (OSError, ValueError, KeyError, TypeError):
        with suppress(OSError):
            (folder / SUMMARY).unlink()
        return False
    return True


def _fail(folder: Path, run: str, message: str) -> None:
    from dolfinopt.files import write_text

    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / FAILURE, json.dumps({"run": run, "message": message}) + "\n")


def _failure(folder: Path, run: str) -> str:
    """Return why the case failed in this run, "" if it did not."""
    try:
        data = json.loads((folder / FAILURE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ""
    return str(data["message"]) if data.get("run") == run else ""


def _read(case: Case, place: Path, run: str) -> Outcome:
    """Read a case back."""
    folder = place / case.key
    if message := _failure(folder, run):
        return Outcome(case, folder, failure=message)
    data = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    seconds = data["seconds"]["total"]
    if case.action == "compare":
        fields = ("frequency", "mac", "compliance", "angle")
        bases = tuple(
            BasisFigures(one["arm"], *(tuple(one[key]) for key in fields)) for one in data["bases"]
        )
        return Outcome(case, folder, seconds=seconds, bases=bases)
    return Outcome(
        case,
        folder,
        objective=data["objective"],
        compliance=data["compliance"],
        max_deviation=data["max_deviation"],
        max_deviation_time=data["max_deviation_time"],
        grayness=data["grayness"],
        volume_fraction=float(np.mean(list(data["volume_fraction"].values()))),
        iterations=data["iterations"],
        stop_reason=data["stop_reason"],
        seconds=seconds,
    )
