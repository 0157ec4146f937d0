"""Cached and resumable cases, spread over the ranks: optimisations, simulations, comparisons.

A case is known by what it computes: a hash of the scene's content, of the design and of the program
that computes, never a name, a path or a date. Its results are the usual files in DIR/cases/<key>/;
the summary comes last and tells that the case is done. Every case runs on one rank alone, so that
its bits do not depend on how many there are.

All that a run lacks of one design with one reduction is simulated at once. Such a batch shares its
steps, which each of its cases depends on within the tolerance. Which cases were in it is kept
beside each: after an interruption the missing ones are computed with the same others, to the same
bits. What is done is done: a study that grows computes the new cases alone.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

import numpy as np

from dolfinopt.disk import make_folder
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.scene.contents import file_digest, program, with_digests
from dolfinopt.scene.load import Scene
from dolfinopt.study.progress import Progress
from dolfinopt.study.tasks import do_tasks

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.arms.arm import Arm
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.optimization.history import HistoryRow
    from dolfinopt.output.run_folder import Simulated
    from dolfinopt.parallel import Partition
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.evaluation import Evaluation

Action = Literal["optimize", "simulate", "compare"]

CASES = "cases"  # folder of all cases
SUMMARY, FAILURE, BATCH = "summary.json", "failure.json", "batch.json"
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


# These values of material and arms do no more to the reduced arms than scale their integrals, where
# the basis does not depend on them: Krylov's shifts and the Gramian's band are frequencies.
SCALING = ("young_modulus", "density", "thickness")
SCALABLE = ("craig-bampton", "modal")


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
        parts: list[Any] = [program(), self.action, scene_content(self.scene), self.design_key]
        if self.action == "compare":
            parts += [REFERENCE_METHOD, REFERENCE, MODES]
        return _digest(parts)

    @cached_property
    def design_key(self) -> str:
        """What stands for the given design in the key."""
        if isinstance(self.design, Case):
            return self.design.key
        return "initial" if self.design is None else file_digest(self.design)

    @cached_property
    def arms_key(self) -> str:
        """Equal where the same arms with the same design are simulated or compared."""
        content = scene_content(self.scene)
        kept = {table: value for table, value in content.items() if table not in SCENARIO}
        return _digest([self.action, kept, self.design_key])

    @cached_property
    def batch_key(self) -> str:
        """Equal where cases are done at once: simulations of the same arms and basis."""
        scene, content = self.scene, scene_content(self.scene)
        if self.action != "simulate" or scene.reduction.coordinates == "auto":  # each its own
            return self.key
        free = {*SCENARIO} - {"reduction"}
        if scene.reduction.method == "balanced":  # the Gramian knows the damping
            free.remove("damping")
        kept = {table: value for table, value in content.items() if table not in free}
        motion_alone = scene.objective.simulated and not any(vars(scene.constraints).values())
        if motion_alone and scene.reduction.method in SCALABLE:
            for row in (kept["material"], *kept["arms"]):
                for key in SCALING:
                    row.pop(key, None)
        return _digest([kept, self.design_key])

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
        from dolfinopt.output.files import read_history

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
    data = with_digests(scene.to_dict())
    del data["name"]
    return data


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# -- the run ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Batch:
    """Cases that are done at once, in an order that depends on nothing but what they are."""

    cases: tuple[Case, ...]

    @property
    def cost(self) -> float:
        """Rough measure of the time it takes; the reduced equations' cost grows with q^2."""
        first = self.cases[0]
        steps = first.scene.optimizer.max_iterations if first.action == "optimize" else 1
        coordinates = first.scene.reduction.coordinates
        size = 1.0 + ((REFERENCE if coordinates == "auto" else coordinates) / 10.0) ** 2
        return steps * size * len(self.cases)


@dataclass(frozen=True)
class _Place:
    """Where the cases of this run are kept.

    Attributes:
        folder: of all cases.
        run: what tells this run's failures from those of earlier ones.
    """

    folder: Path
    run: str

    def __getitem__(self, case: Case) -> Path:
        return self.folder / case.key

    def failure(self, case: Case) -> str:
        """Return why the case failed in this run, "" if it did not."""
        return _failure(self[case], self.run)

    def has(self, case: Case) -> bool:
        """Tell whether the case is done, or has failed in this run."""
        return (self[case] / SUMMARY).exists() or bool(self.failure(case))


@dataclass(frozen=True)
class _Job:
    """What one rank does in one go: an optimisation, or one design in many scenes."""

    batches: tuple[_Batch, ...]
    place: _Place

    @property
    def first(self) -> Case:
        """All others have its action and its design."""
        return self.batches[0].cases[0]

    @property
    def key(self) -> str:
        """That of its first case."""
        return self.first.key

    @property
    def cost(self) -> float:
        """See `_Batch.cost`."""
        return sum(batch.cost for batch in self.batches)

    @property
    def missing(self) -> list[Case]:
        """Cases that have neither been done nor failed."""
        return [case for batch in self.batches for case in batch.cases if not self.place.has(case)]

    def is_done(self) -> bool:
        """Tell whether no case is missing."""
        return not self.missing

    def is_ready(self) -> bool:
        """Tell whether the design is there, or will not be."""
        given = self.first.design
        return not isinstance(given, Case) or self.place.has(given)

    def do(self, progress: Progress) -> None:
        """Do the cases that are missing; without their design they fail."""
        given, missing = self.first.design, self.missing
        if isinstance(given, Case):
            if reason := self.place.failure(given):
                for case in missing:
                    label = given.label or given.key
                    _fail(self.place[case], self.place.run, f"{label}: {reason}")
                    progress.tell(case.label, text="its design is missing", finished=1)
                return
            given = self.place[given] / "design.npz"
        if self.first.action == "optimize":
            for case in missing:
                make_folder(self.place[case])
                _optimise(case, self.place[case], self.place.run, progress)
        else:
            batches = [one for one in self.batches if not set(missing).isdisjoint(one.cases)]
            _examine(batches, missing, given, self.place, progress)


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
    from dolfinopt.parallel import on_root, together

    wanted = _with_dependencies(cases)
    place = _Place(folder / CASES, on_root(world, lambda: uuid4().hex))

    def look() -> tuple[list[bool], list[list[int]]]:
        done = [_is_done(place[case]) for case in wanted]
        batches = _batches([c for c, there in zip(wanted, done) if not there], wanted, place)
        numbers = {case: i for i, case in enumerate(wanted)}
        return done, [[numbers[case] for case in batch] for batch in batches]

    done, found = on_root(world, look)
    batches = [_Batch(tuple(wanted[i] for i in batch)) for batch in found]
    missing = len(done) - sum(done)
    do_tasks(_jobs(batches, place, world.size), place.folder, world, missing, shown=shown)
    with together(world):
        outcomes = {case: _read(case, place) for case in wanted}
    return Outcomes(outcomes, missing)


def _with_dependencies(cases: Iterable[Case]) -> list[Case]:
    """Return every case once, after the one it needs."""
    found: dict[Case, None] = {}
    for case in cases:
        if isinstance(case.design, Case):
            found.setdefault(case.design)
        found.setdefault(case)
    return list(found)


def _batches(
    missing: Sequence[Case], wanted: Sequence[Case], place: _Place
) -> list[tuple[Case, ...]]:
    """Return what is to be done at once, and keep it beside the cases (root only).

    Those that an earlier run had begun together stay so if all of them are wanted again.
    """
    from dolfinopt.output.files import write_text

    known = {case.key: case for case in wanted}
    groups: dict[tuple[str, ...] | str, list[Case]] = {}
    for case in missing:
        before = _read_batch(place[case])
        again = case.key in before and known.keys() >= {*before}
        groups.setdefault(before if again else case.batch_key, []).append(case)
    batches = []
    for name, group in groups.items():
        keys = list(name) if isinstance(name, tuple) else sorted(case.key for case in group)
        batches.append(tuple(known[key] for key in keys))
        if isinstance(name, str) and len(keys) > 1:
            for case in group:
                make_folder(place[case])
                write_text(place[case] / BATCH, json.dumps(keys) + "\n")
    return batches


def _read_batch(folder: Path) -> tuple[str, ...]:
    """Return the keys of the cases that this one was begun with, none where it was not."""
    try:
        return tuple(map(str, json.loads((folder / BATCH).read_text(encoding="utf-8"))))
    except (OSError, ValueError, TypeError):
        return ()


def _jobs(batches: Iterable[_Batch], place: _Place, ranks: int) -> list[_Job]:
    """Return the jobs, optimisations first, as others wait for them, and longest first.

    Batches of the same arms and design are one job, so that these are built once, unless that
    leaves a rank without.
    """
    groups: dict[str, list[_Batch]] = {}
    for batch in batches:
        first = batch.cases[0]
        name = first.key if first.action == "optimize" else first.arms_key
        groups.setdefault(name, []).append(batch)
    jobs = []
    for group in groups.values():
        parts = ranks if len(groups) < ranks else 1
        cuts = np.linspace(0, len(group), min(parts, len(group)) + 1).astype(int)
        jobs += [_Job(tuple(group[a:b]), place) for a, b in pairwise(cuts)]
    return sorted(jobs, key=lambda job: (job.first.action != "optimize", -job.cost))


# -- what is done ----------------------------------------------------------------------------


def _optimise(case: Case, folder: Path, run: str, progress: Progress) -> None:
    """Optimise, from the checkpoint of an interrupted run if there is one."""
    from mpi4py import MPI

    from dolfinopt.output import checkpoint
    from dolfinopt.output.files import read_history
    from dolfinopt.output.run import optimize
    from dolfinopt.output.run_folder import write_result

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
        progress.tell(case.label, row.iteration, limit, text)

    try:
        result = optimize(scene, folder, resume=resume, world=MPI.COMM_SELF, report=report)
    except ConvergenceError as error:
        _fail(folder, run, str(error))
        progress.tell(case.label, text=f"failed: {error}", finished=1)
        return
    wall = earlier + time.perf_counter() - begun
    write_result(scene, folder, result, wall, paraview=False)
    end = result.evaluation
    text = f"{result.iterations} iterations, {_figures(end.compliance, end.max_deviation)}"
    progress.tell(case.label, text=f"{text}, {wall:.1f} s", finished=1)


def _examine(
    batches: Sequence[_Batch],
    missing: Sequence[Case],
    design: Path | None,
    place: _Place,
    progress: Progress,
) -> None:
    """Simulate or compare one design in many scenes; write what is missing."""
    from dolfinopt.output.run_folder import write_simulation

    cases = [case for batch in batches for case in batch.cases]
    progress.tell(missing[0].label, text="...")
    scenes = [_unnamed(case) for case in cases]
    results: Iterator[Simulated | tuple[BasisFigures, ...] | ConvergenceError]
    if cases[0].action == "simulate":
        results = simulate_scenarios(scenes, design)
    else:
        results = compare(scenes, design)
    begun = time.perf_counter()
    for case, scene, found in zip(cases, scenes, results, strict=True):
        if case not in missing:  # it is there already, and shares the steps of those that are not
            continue
        folder, wall = place[case], time.perf_counter() - begun
        make_folder(folder)
        if isinstance(found, ConvergenceError):
            _fail(folder, place.run, str(found))
            text = f"failed: {found}"
        elif isinstance(found, tuple):
            _write_comparison(folder, scene, found, wall)
            text = "compared"
        else:
            write_simulation(folder, found, wall, paraview=False)
            text = _figures(found.evaluation.compliance, found.evaluation.max_deviation)
        progress.tell(case.label, text=f"{text}, {wall:.1f} s", finished=1)
        begun = time.perf_counter()


def simulate_scenarios(
    scenes: Sequence[Scene], design: Path | None
) -> Iterator[Simulated | ConvergenceError]:
    """Simulate one design in many scenes, on this rank alone.

    Arms are meshed, assembled and factorised once; neighbours with the same `reduction` share it
    and are simulated in one batch, whose time and counts the first of them bears.

    Args:
        scenes: that differ in `SCENARIO` alone; neighbours also in what `Case.batch_key` allows.
        design: design.npz, or None, the initial one.

    Returns:
        In the scenes' order; of one that fails its error.

    Raises:
        InputError: the design does not fit the arms.
    """
    from dolfinopt.output.run_folder import Simulated
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.evaluation import evaluate_batch
    from dolfinopt.responses.order_selection import choose_coordinates

    profile = Profile()
    partition, arms, x_phys = _posed(scenes[0], design, profile)
    for batch in _neighbours(scenes):
        arms = {k: arm.under(batch[0]) for k, arm in arms.items()}
        every: Sequence[tuple[Evaluation, Trajectory | None] | ConvergenceError]
        choice = None
        try:
            choice = choose_coordinates(batch[0], partition, arms, x_phys, profile)
            every = evaluate_batch(batch, partition, arms, x_phys, profile)
        except ConvergenceError as error:
            every = [error]
        for scene, found in zip(batch, every, strict=True):
            if isinstance(found, ConvergenceError):
                yield found
            else:
                yield Simulated(scene, partition, arms, x_phys, *found, profile, choice)
            _clear(profile)


def _neighbours(scenes: Sequence[Scene]) -> Iterator[list[Scene]]:
    """Yield neighbours with one basis; where it is chosen, "auto", each scene alone."""
    for reduction, group in groupby(scenes, key=lambda scene: scene.reduction):
        if reduction.coordinates == "auto":
            yield from ([scene] for scene in group)
        else:
            yield list(group)


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
    from dolfinopt.profiling import Profile
    from dolfinopt.reduction import METHODS, Options, basis_errors
    from dolfinopt.responses.order_selection import choose_coordinates

    profile = Profile()
    partition, arms, x_phys = _posed(scenes[0], design, profile)
    richer = {}
    for k, arm in arms.items():
        arm.set_design(x_phys[k])
        most = min(REFERENCE, arm.elastic.num_dofs)
        richer[k] = METHODS[REFERENCE_METHOD].reduce(arm.elastic, Options(most), None)
    for scene in scenes:
        figures = []
        try:
            arms = {k: arm.under(scene) for k, arm in arms.items()}
            choose_coordinates(scene, partition, arms, x_phys, profile)
            for k, arm in arms.items():
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
    scene: Scene, design: Path | None, profile: Profile
) -> tuple[Partition, dict[int, Arm], dict[int, np.ndarray]]:
    """Build the arms on this rank; return them with the physical densities of the design."""
    from mpi4py import MPI

    from dolfinopt.arms.arm import build_arms
    from dolfinopt.output.files import read_design
    from dolfinopt.parallel import partition_arms

    partition = partition_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = build_arms(scene, partition, profile)
    if design is not None:
        return partition, arms, read_design(design, partition, arms)
    return partition, arms, {k: arm.uniform(scene.design.initial) for k, arm in arms.items()}


def _clear(profile: Profile) -> None:
    """Begin the account of the next scene; its profile is known to the arms."""
    from dolfinopt.profiling import Counts

    profile.seconds.clear()
    profile.counts = Counts()


def _unnamed(case: Case) -> Scene:
    """Return the scene under the case's key, so that a checkpoint does not depend on a name."""
    return case.scene.model_copy(update={"name": case.key})


def _figures(compliance: float, deviation: float) -> str:
    return f"compliance {compliance:.4g} N m, deviation {1e3 * deviation:.4g} mm"


# -- files -----------------------------------------------------------------------------------


def _write_comparison(
    folder: Path, scene: Scene, figures: Sequence[BasisFigures], wall: float
) -> None:
    from dolfinopt.output.files import versions, write_summary

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
    from dolfinopt.output.files import write_text

    make_folder(folder)
    write_text(folder / FAILURE, json.dumps({"run": run, "message": message}) + "\n")


def _failure(folder: Path, run: str) -> str:
    """Return why the case failed in this run, "" if it did not."""
    try:
        data = json.loads((folder / FAILURE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ""
    return str(data["message"]) if data.get("run") == run else ""


def _read(case: Case, place: _Place) -> Outcome:
    """Read a case back."""
    folder = place[case]
    if message := place.failure(case):
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
