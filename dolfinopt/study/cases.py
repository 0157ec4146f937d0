"""What studies compute: cases, known by what they compute, done once, shared out over the ranks.

The results of a case are in DIR/cases/<key>/: the usual files of an optimisation, and of a
simulation where they are to be kept; else figures and the deviation alone, in half of the time.
That the summary is there tells that the case is done. Every case runs on one rank alone: its bits
do not depend on how many there are.

The ranks are the pool: each takes the next job whose design is there, by creating the job's file in
a folder of this run (`_Place`). Progress is read from the files that appear.

A folder is put in place when all of it is written.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import time
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar
from uuid import uuid4

import numpy as np
from mpi4py import MPI

from dolfinopt.disk import make_folder, write_arrays, write_text
from dolfinopt.dynamics.build import Trajectory, simulate_all
from dolfinopt.errors import ConvergenceError, InputError, OthersFailed
from dolfinopt.multibody.kinematics import lengths
from dolfinopt.optimization.result import RankResult
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.output import checkpoint
from dolfinopt.output.design import arms_with_design, read_history, under_law_of
from dolfinopt.output.folders import read_record, working_alone
from dolfinopt.output.run_folder import optimize, simulated, write_result
from dolfinopt.output.summary import figures, versions, write_summary
from dolfinopt.parallel import on_root, together
from dolfinopt.profiling import Counts, Profile
from dolfinopt.progress import log
from dolfinopt.responses.motion import worst_instants
from dolfinopt.responses.response import bodies_in
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import file_digest, program, scene_content
from dolfinopt.study import variants

Action = Literal["optimize", "simulate", "sample"]

# Scenes that differ in these tables alone have the same arms, which are built and factorised once.
SCENARIO = frozenset(
    "motion control closures payload forces damping reduction simulation objective constraints "
    "optimizer scenarios".split()
)


@dataclass(frozen=True, eq=False)
class Case:
    """One thing to compute. Two cases are equal when they compute the same.

    The key is a hash of the scene's content, of the design and of the program that computes, never
    of a name, a path or a date. A design is found, moved, or moved at samples of scene values.
    """

    scene: Scene  # complete; its name does not matter
    action: Action = "simulate"
    design: Case | Path | None = None  # given; of an optimising case, of a file, or the initial one
    label: str = ""  # what progress and messages call it
    samples: Sequence[Sequence[str]] = ()  # what each changes, "key.path=value" each
    first: int = 0  # number of the first sample, for messages

    @cached_property
    def key(self) -> str:
        """Sixteen hexadecimal digits that stand for everything the case computes."""
        content = scene_content(self.scene)
        return _digest([program(), self.action, content, self.design_key, self.samples])

    @property
    def title(self) -> str:
        """Its label, with the numbers of its samples."""
        samples = f", samples {self.first} to {self.first + len(self.samples) - 1}"
        return self.label + samples * bool(self.samples)

    @cached_property
    def design_key(self) -> str:
        """What stands for the given design in the key."""
        if isinstance(self.design, Case):
            return self.design.key
        return "initial" if self.design is None else file_digest(self.design)

    @cached_property
    def arms_key(self) -> str:
        """Equal where the same arms with the same design are simulated or sampled."""
        if self.action == "optimize":
            return self.key
        free = frozenset() if self.action == "sample" else SCENARIO  # samples are of one scene
        return _digest([self.action, scene_content(self.scene, free), self.design_key])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Case) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came out of a case: figures of its summary in SI units, nan for what it has not."""

    case: Case
    folder: Path  # of its files
    failure: str = ""  # message, "" where it succeeded
    failures: Sequence[str] = ()  # what failed, a line each
    objective: float = math.nan
    compliance: float = math.nan
    max_deviation: float = math.nan
    max_deviation_time: float = math.nan
    grayness: float = math.nan
    iterations: int = 0
    stop_reason: str = ""
    seconds: float = math.nan
    samples: Mapping[str, Sequence[float]] = field(default_factory=dict)  # of `SAMPLED`
    summary: Mapping[str, Any] = field(default_factory=dict)  # content of summary.json

    def __str__(self) -> str:
        if self.failure:
            return f"{self.case.title}: failed: {self.failure}"
        result = (
            f"compliance {self.compliance:.4g} N m, deviation {1e3 * self.max_deviation:.4g} mm"
        )
        if self.case.action == "optimize":
            result = f"{self.iterations} iterations, {result}"
        elif self.case.action != "simulate":
            result = f"{len(self.case.samples)} samples"
        return f"{self.case.title}: {result}, {self.seconds:.1f} s"

    @property
    def design(self) -> Path:
        """Path of the design.npz."""
        return self.folder / "design.npz"

    def deviation(self) -> tuple[np.ndarray, np.ndarray]:
        """Return sample instants (n,), s, and the end-effector's distance from its path (n,), m."""
        brief, complete = self.folder / DEVIATION, self.folder / TRAJECTORY
        with np.load(brief if brief.exists() else complete, allow_pickle=False) as data:
            return data["t"], lengths(data["deviation"])

    def history(self) -> list[HistoryRow]:
        """Return the optimisation's history."""
        return read_history(self.folder / "history.csv")


@dataclass(frozen=True)
class Outcomes:
    """All cases of a run, and how many were computed in it; every sample counts."""

    by_case: Mapping[Case, Outcome]
    computed: int

    def __getitem__(self, case: Case) -> Outcome:
        """Return what came out of a case, under its label."""
        return replace(self.by_case[case], case=case)

    @property
    def failures(self) -> list[str]:
        """What failed, a line each."""
        return [line for outcome in self.by_case.values() for line in outcome.failures]


T = TypeVar("T")
# What a study asks for, set by set of cases, each by what came of the sets before; and its end.
Steps = Generator[Sequence[Case], Outcomes, T]


@dataclass
class Runner:
    """Where a study does its cases, see `run_cases`, and how many were computed."""

    folder: Path
    world: MPI.Comm
    shown: bool = True
    keep: bool = True
    computed: int = 0

    def follow(self, steps: Steps[T]) -> T:
        """Do the cases that steps ask for (collective); return their end on all ranks.

        The root alone goes through them: what they read, write and decide is done once.
        """
        outcomes: Outcomes | None = None
        while True:
            cases, end = on_root(self.world, _advance, steps, outcomes)
            if cases is None:
                return end
            outcomes = run_cases(cases, self.folder, self.world, shown=self.shown, keep=self.keep)
            self.computed += outcomes.computed


def _advance(steps: Steps[T], outcomes: Outcomes) -> tuple[Sequence[Case] | None, Any]:
    """Return the next cases of steps, or None and their end."""
    try:
        return steps.send(outcomes), None
    except StopIteration as stop:
        return None, stop.value


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# -- simulating them -------------------------------------------------------------------------


APART = "motion payload forces damping".split()  # tables that leave the reduced bodies alone


def simulate_scenarios(
    scenes: Sequence[Scene], design: Path | None
) -> Iterator[RankResult | ConvergenceError]:
    """Simulate one design in many scenes, on this rank alone; of one that fails yield its error.

    Arms are meshed, assembled and factorised once; neighbours share the basis as long as it is the
    same. Scenes differ in `cases.SCENARIO` alone. No design.npz is the initial design; InputError
    where one does not fit the arms.
    """
    profile = Profile()
    designed = arms_with_design(MPI.COMM_SELF, scenes[0], design, profile)
    for given in scenes:
        scene = under_law_of(given, design)
        arms = {k: arm.under(scene) for k, arm in designed.arms.items()}
        designed = designed._replace(scene=scene, arms=arms)
        try:
            result: RankResult | ConvergenceError = simulated(designed, profile)
        except ConvergenceError as error:
            result = error
        yield result
        profile.seconds.clear()  # the account of the next scene; the arms know the profile
        profile.counts = Counts()


# -- samples ---------------------------------------------------------------------------------


def scales_bodies(scene: Scene, keys: Iterable[str]) -> bool:
    """Return whether one reduction serves all values of these keys."""
    parts = [key.split(".") for key in keys]
    return all(
        table in APART or (table in ("material", "arms") and rest[-1] in scene.scaling_keys)
        for table, *rest in parts
    )


def with_sample(scene: Scene, changes: Sequence[str], number: int) -> Scene:
    """Return the scene with a sample's values, "key.path=value" each.

    InputError where the scene cannot have them; it names the sample's number.
    """
    with variants.asked_by(f"--random, sample {number} ({', '.join(changes)})"):
        return variants.changed(scene, *changes)


def simulate_samples(
    nominal: RankResult | ConvergenceError | None, scenes: Sequence[Scene], design: Path | None
) -> Iterator[Trajectory | ConvergenceError]:
    """Simulate a design (design.npz, or None, the initial one) in scenes, on this rank alone.

    The bodies are scaled from those of `nominal`, the design in the nominal scene, and every sample
    starts from its solution: the bits depend on no other sample. None: they are reduced anew.
    """
    if isinstance(nominal, ConvergenceError):
        yield from [nominal] * len(scenes)
    elif nominal is None:
        for scene in scenes:
            (result,) = simulate_scenarios([scene], design)
            yield result if isinstance(result, ConvergenceError) else _trajectory(result)
    else:
        start = _trajectory(nominal)
        owned = {k: start.mechanism.bodies[k] for k in nominal.arms}
        bodies = [bodies_in(nominal.scene, scene, owned) for scene in scenes]
        yield from simulate_all(scenes, bodies, Profile(), [start.solution] * len(scenes))


def _trajectory(result: RankResult) -> Trajectory:
    assert result.trajectory is not None  # on a single rank
    return result.trajectory


CASES, WORK = "cases", ".work-"  # folders in DIR: of all cases; of a run, followed by its name
SUMMARY, TRAJECTORY = "summary.json", "trajectory.npz"
DEVIATION = "deviation.npz"  # t and deviation of a simulation whose other files are not kept
IDLE = 0.02  # s between two looks for a job
SAMPLED = ("compliance", "max_deviation", "max_deviation_time")

Job = Sequence[Case]  # of the same arms and design, which one rank builds once


@dataclass(frozen=True)
class _Place:
    """Folder of all cases, and of this run: jobs taken, why cases failed, what is not complete."""

    cases: Path
    work: Path
    keep: bool  # all files of simulations
    untold: list[Case] = field(default_factory=list)  # this rank tells when they end, by any rank

    def __getitem__(self, case: Case) -> Path:
        return self.cases / case.key

    def has(self, case: Case) -> bool:
        """Tell whether the case is done, or has failed in this run."""
        return (self[case] / SUMMARY).exists() or self._failure(case).exists()

    def _failure(self, case: Case) -> Path:
        return self.work / f"{case.key}.json"

    def takes(self, job: Job) -> bool:
        """Take a job; False if another rank has it."""
        try:
            (self.work / f"{job[0].key}.taken").touch(exist_ok=False)
        except FileExistsError:
            return False
        return True

    def fail(self, case: Case, message: str, **more: Any) -> None:
        """Keep why a case failed, for this run: in a few words, and a line for all that failed."""
        known = {"failure": message, "failures": [f"{case.title}: {message}"]}
        write_text(self._failure(case), json.dumps(known | more))

    def read(self, case: Case) -> Outcome:
        """Read a case back."""
        failed = self._failure(case)
        path = failed if failed.exists() else self[case] / SUMMARY
        data = json.loads(path.read_text("utf-8"))
        known = {item.name: data[item.name] for item in fields(Outcome) if item.name in data}
        known["seconds"] = data.get("seconds", {}).get("total", math.nan)
        return Outcome(case, self[case], **known, summary=data)

    def check(self) -> None:
        """Tell of cases that have ended; raise OthersFailed if another rank has failed."""
        for case in [case for case in self.untold if self.has(case)]:
            self.untold.remove(case)
            log.info("%s; %d to go", self.read(case), len(self.untold))
        if (self.work / "stop").exists():
            raise OthersFailed("another rank failed")


def run_cases(
    cases: Iterable[Case],
    folder: Path,
    world: MPI.Comm,
    *,
    shown: bool = True,
    keep: bool = True,
) -> Outcomes:
    """Do all cases that are not done yet, and those they depend on (collective).

    A case that fails to converge is reported in its outcome, and so are those that need its
    design; it is tried again in the next run. Ranks share a file system; `shown`: the root tells
    of every case on its standard error; `keep`: simulations leave all their files. InputError
    where a scene or design cannot be used, the others stay unfinished; another run works in the
    folder DIR, or it cannot be written.
    """
    both = (item for case in cases for item in (case.design, case))
    wanted = list(dict.fromkeys(item for item in both if isinstance(item, Case)))
    with working_alone(world, folder):
        work = folder / (WORK + on_root(world, lambda: uuid4().hex))
        place = _Place(folder / CASES, work, keep)
        try:
            done = on_root(world, _begin, place, wanted)
            missing = [case for case, there in zip(wanted, done, strict=True) if not there]
            place.untold.extend(missing * (shown and world.rank == 0))
            with together(world):
                _share(_jobs(missing, world.size), place, world)
            with together(world):
                outcomes = {case: place.read(case) for case in wanted}
        finally:
            if world.rank == 0:  # all ranks have met
                shutil.rmtree(place.work, ignore_errors=True)
    return Outcomes(outcomes, sum(max(1, len(case.samples)) for case in missing))


def _begin(place: _Place, wanted: Sequence[Case]) -> list[bool]:
    """Make the folders, remove what killed runs left; return which cases are done (root only)."""
    for left in place.work.parent.glob(f"{WORK}*"):
        shutil.rmtree(left, ignore_errors=True)
    make_folder(place.cases)
    make_folder(place.work)
    done = []
    for case in wanted:
        folder = place[case]
        brief = place.keep and (folder / DEVIATION).exists()
        done.append(not brief and "seconds" in read_record(folder / SUMMARY))
        if not done[-1] and case.action == "optimize":
            (folder / SUMMARY).unlink(missing_ok=True)  # its checkpoint stays
        elif not done[-1]:
            shutil.rmtree(folder, ignore_errors=True)
    return done


# -- who does what ---------------------------------------------------------------------------


def _jobs(missing: Iterable[Case], ranks: int) -> list[Job]:
    """Return the jobs, optimisations first, as others wait for them."""
    # All of the same arms and design is one job for each rank, which builds these once.
    groups: dict[str, list[Case]] = {}
    for case in sorted(missing, key=lambda case: case.key):  # however they were asked for
        groups.setdefault(case.arms_key, []).append(case)
    jobs = [group[k::ranks] for group in groups.values() for k in range(min(ranks, len(group)))]
    return sorted(jobs, key=lambda job: job[0].action != "optimize")


def _share(jobs: Sequence[Job], place: _Place, world: MPI.Comm) -> None:
    """Do one job after the other that no other rank has taken; end when all ranks do."""
    try:
        for job in jobs:
            place.check()
            if place.takes(job):
                design = job[0].design
                while isinstance(design, Case) and not place.has(design):  # another rank makes it
                    time.sleep(IDLE)
                    place.check()
                _do(job, place)
    except OthersFailed:
        raise
    except BaseException:
        with suppress(OSError):
            (place.work / "stop").touch()
        raise
    finally:
        ended = world.Ibarrier()
        while not ended.Test():  # asleep: waiting in MPI would keep the processor busy
            time.sleep(IDLE)
    place.check()


def _do(job: Job, place: _Place) -> None:
    """Do a job; without their design its cases fail."""
    action, design = job[0].action, job[0].design
    if isinstance(design, Case):
        if failure := place.read(design).failure:
            for case in job:
                place.fail(case, f"{design.label or design.key}: {failure}")
            return
        design = place[design] / "design.npz"
    if action == "optimize":
        _optimise(job[0], place)
    elif action == "sample":
        _sample(job, design, place)
    else:
        _simulate(job, design, place)


# -- what is done ----------------------------------------------------------------------------


def _optimise(case: Case, place: _Place) -> None:
    """Optimise, from the checkpoint of an interrupted run if there is one."""
    begun, folder, scene = time.perf_counter(), place[case], case.scene
    resume = True
    try:
        checkpoint.check(folder, scene)
    except InputError:  # none, damaged, or made when a file of the scene was elsewhere
        resume = False
    how: dict[str, Any] = {"resume": resume, "overwrite": not resume, "world": MPI.COMM_SELF}
    try:
        result = optimize(scene, folder, **how, report=lambda row: place.check())
    except ConvergenceError as error:
        place.fail(case, str(error))
        return
    wall = max(time.perf_counter() - begun, result.rows[-1].seconds)  # before a resume, too
    write_result(folder, result, wall, paraview=False)


def _simulate(job: Job, design: Path | None, place: _Place) -> None:
    """Simulate one design in many scenes."""
    results = simulate_scenarios([case.scene for case in job], design)
    for case in job:
        place.check()
        begun = time.perf_counter()
        result = next(results)
        wall = time.perf_counter() - begun
        if isinstance(result, ConvergenceError):
            place.fail(case, str(result))
            continue
        part = place.work / case.key
        make_folder(part)
        if place.keep:
            write_result(part, result, wall, paraview=False)
        else:
            sampled = _trajectory(result).sampled
            write_arrays(part / DEVIATION, {"t": sampled.t, "deviation": sampled.deviation})
            write_summary(part, figures(result, wall))
        os.rename(part, place[case])


def _sample(cases: Sequence[Case], design: Path | None, place: _Place) -> None:
    """Simulate one design at samples of its scene's values."""
    nominal = None
    for case in cases:
        place.check()
        begun, scene = time.perf_counter(), case.scene
        scenes = [
            with_sample(scene, sample, k) for k, sample in enumerate(case.samples, case.first)
        ]
        keys = (change.partition("=")[0] for sample in case.samples for change in sample)
        scaled = scales_bodies(scene, keys)
        if scaled and nominal is None:
            (nominal,) = simulate_scenarios([scene], design)
        rows, failures = [], []
        result = simulate_samples(nominal if scaled else None, scenes, design)
        for number, trajectory in enumerate(result, case.first):
            if isinstance(trajectory, ConvergenceError):
                sample = f"{number} ({', '.join(case.samples[number - case.first])})"
                failures.append(f"{case.label}, sample {sample}: {trajectory}")
                rows.append((math.nan,) * len(SAMPLED))
            else:
                worst = worst_instants(trajectory, trajectory.scene.objective.load_cases)
                compliance = float(trajectory.compliance[worst].sum())
                rows.append((compliance, *trajectory.max_deviation))
        samples = dict(zip(SAMPLED, np.transpose(rows).tolist(), strict=True))
        if failures:
            place.fail(case, f"{len(failures)} samples", samples=samples, failures=failures)
        else:
            folder, wall = place[case], time.perf_counter() - begun
            make_folder(folder)
            more = {"seconds": {"total": wall}, "versions": versions(), "scene": scene.to_dict()}
            write_summary(folder, {"name": scene.name, "samples": samples, **more})
