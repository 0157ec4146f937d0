"""Cached and resumable cases, spread over the ranks: what all studies compute.

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

import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np

from dolfinopt.disk import make_folder
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.scene.load import Scene
from dolfinopt.study import variants
from dolfinopt.study.cases import Case, Outcome, Outcomes
from dolfinopt.study.progress import Progress
from dolfinopt.study.tasks import do_tasks

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.optimization.history import HistoryRow
    from dolfinopt.output.run_folder import Simulated

CASES = "cases"  # folder of all cases
SUMMARY, FAILURE, BATCH = "summary.json", "failure.json", "batch.json"


# -- the run ---------------------------------------------------------------------------------


# Cases that are done at once, in an order that depends on nothing but what they are.
Batch = tuple[Case, ...]


@dataclass(frozen=True)
class _Place:
    """Where the cases of this run are kept.

    Attributes:
        folder: of all cases.
        run: what tells this run's failures from those of earlier ones.
        nominal: the design in its nominal scene that samples of this rank last set out from.
    """

    folder: Path
    run: str
    nominal: dict[str, Simulated | ConvergenceError] = field(default_factory=dict, compare=False)

    def __getitem__(self, case: Case) -> Path:
        return self.folder / case.key

    def failure(self, case: Case) -> str:
        """Return why the case failed in this run, "" if it did not."""
        return str(self.failure_data(case).get("message", ""))

    def failure_data(self, case: Case) -> dict[str, Any]:
        """Return what the case left when it failed in this run, nothing if it did not."""
        try:
            data = json.loads((self[case] / FAILURE).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return data if data.get("run") == self.run else {}

    def fail(self, case: Case, message: str, **more: Any) -> None:
        """Keep why a case failed."""
        from dolfinopt.disk import write_text

        make_folder(self[case])
        data = {"run": self.run, "message": message, **more}
        write_text(self[case] / FAILURE, json.dumps(data) + "\n")

    def has(self, case: Case) -> bool:
        """Tell whether the case is done, or has failed in this run."""
        return (self[case] / SUMMARY).exists() or bool(self.failure(case))


@dataclass(frozen=True)
class _Job:
    """What one rank does in one go: an optimisation, one design in many scenes, or its samples."""

    batches: tuple[Batch, ...]
    place: _Place

    @property
    def first(self) -> Case:
        """All others have its action and its design."""
        return self.batches[0][0]

    @property
    def key(self) -> str:
        """That of its first case."""
        return self.first.key

    @property
    def cost(self) -> float:
        """Rough measure of the time it takes; the reduced equations' cost grows with q^2."""
        if self.first.action == "sample":  # all alike: those of one design stay together
            return 1.0
        steps = self.first.scene.optimizer.max_iterations
        found = [case.scene.reduction.coordinates for batch in self.batches for case in batch]
        counts = [variants.REFERENCE if count == "auto" else count for count in found]
        total = sum(1.0 + (count / 10.0) ** 2 for count in counts)
        return total * (steps if self.first.action == "optimize" else 1)

    @property
    def missing(self) -> list[Case]:
        """Cases that have neither been done nor failed."""
        return [case for batch in self.batches for case in batch if not self.place.has(case)]

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
                    self.place.fail(case, f"{label}: {reason}")
                    progress.tell(case.title, text="its design is missing", finished=1)
                return
            given = self.place[given] / "design.npz"
        if self.first.action == "optimize":
            for case in missing:
                make_folder(self.place[case])
                _optimise(case, self.place, progress)
        elif self.first.action == "sample":
            for case in missing:
                _sample(case, given, self.place, progress)
        else:
            batches = [one for one in self.batches if not set(missing).isdisjoint(one)]
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
    batches = [tuple(wanted[i] for i in batch) for batch in found]
    missing = [case for case, there in zip(wanted, done, strict=True) if not there]
    jobs = _jobs(batches, place, world)
    do_tasks(jobs, place.folder, world, len(missing), shown=shown)
    with together(world):
        outcomes = {case: _read(case, place) for case in wanted}
    return Outcomes(outcomes, sum(max(1, len(case.samples)) for case in missing))


def _with_dependencies(cases: Iterable[Case]) -> list[Case]:
    """Return every case once, after the one it needs."""
    found: dict[Case, None] = {}
    for case in cases:
        if isinstance(case.design, Case):
            found.setdefault(case.design)
        found.setdefault(case)
    return list(found)


def _batches(missing: Sequence[Case], wanted: Sequence[Case], place: _Place) -> list[Batch]:
    """Return what is to be done at once, and keep it beside the cases (root only).

    Those that an earlier run had begun together stay so if all of them are wanted again.
    """
    from dolfinopt.disk import write_text

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


def _jobs(batches: Iterable[Batch], place: _Place, world: MPI.Comm) -> list[_Job]:
    """Return the jobs, optimisations first, as others wait for them, and longest first.

    Batches of the same arms and design are one job, so that these are built once, unless that
    leaves a rank without. Every rank begins with other samples: with several designs each rank
    reduces those it needs.
    """
    groups: dict[str, list[Batch]] = {}
    for batch in batches:
        groups.setdefault(batch[0].arms_key, []).append(batch)
    jobs = []
    for group in groups.values():
        parts = world.size if len(groups) < world.size else 1
        cuts = np.linspace(0, len(group), min(parts, len(group)) + 1).astype(int)
        jobs += [_Job(tuple(group[a:b]), place) for a, b in pairwise(cuts)]
    jobs.sort(key=lambda job: (job.first.action != "optimize", -job.cost))
    samples = [job for job in jobs if job.first.action == "sample"]
    begin = len(samples) * world.rank // world.size
    return [job for job in jobs if job not in samples] + samples[begin:] + samples[:begin]


# -- what is done ----------------------------------------------------------------------------


def _optimise(case: Case, place: _Place, progress: Progress) -> None:
    """Optimise, from the checkpoint of an interrupted run if there is one."""
    from mpi4py import MPI

    from dolfinopt.output import checkpoint
    from dolfinopt.output.design import read_history
    from dolfinopt.output.run import optimize
    from dolfinopt.output.run_folder import write_result

    begun, folder = time.perf_counter(), place[case]
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
        result = optimize(
            scene,
            folder,
            resume=resume,
            overwrite=not resume,
            world=MPI.COMM_SELF,
            report=report,
        )
    except ConvergenceError as error:
        place.fail(case, str(error))
        progress.tell(case.label, text=f"failed: {error}", finished=1)
        return
    wall = earlier + time.perf_counter() - begun
    write_result(scene, folder, result, wall, paraview=False)
    end = result.evaluation
    text = f"{result.iterations} iterations, {_figures(end.compliance, end.max_deviation)}"
    progress.tell(case.label, text=f"{text}, {wall:.1f} s", finished=1)


def _examine(
    batches: Sequence[Batch],
    missing: Sequence[Case],
    design: Path | None,
    place: _Place,
    progress: Progress,
) -> None:
    """Simulate or compare one design in many scenes; write what is missing."""
    from dolfinopt.output.run_folder import write_simulation
    from dolfinopt.study.simulate import compare, simulate_scenarios

    cases = [case for batch in batches for case in batch]
    progress.tell(missing[0].label, text="...")
    scenes = [_unnamed(case) for case in cases]
    examine: Any = simulate_scenarios if cases[0].action == "simulate" else compare
    results = examine(scenes, design)
    begun = time.perf_counter()
    for case, scene, found in zip(cases, scenes, results, strict=True):
        if case not in missing:  # it is there already, and shares the steps of those that are not
            continue
        folder, wall = place[case], time.perf_counter() - begun
        make_folder(folder)
        if isinstance(found, ConvergenceError):
            place.fail(case, str(found))
            text = f"failed: {found}"
        elif isinstance(found, tuple):
            _write_table(folder, scene, wall, {"bases": [vars(one) for one in found]})
            text = "compared"
        else:
            write_simulation(folder, found, wall, paraview=False)
            text = _figures(found.evaluation.compliance, found.evaluation.max_deviation)
        progress.tell(case.label, text=f"{text}, {wall:.1f} s", finished=1)
        begun = time.perf_counter()


def _sample(case: Case, design: Path | None, place: _Place, progress: Progress) -> None:
    """Simulate one design at samples of its scene's values."""
    from dolfinopt.responses.motion import worst_instants
    from dolfinopt.study.simulate import (
        scales_bodies,
        simulate_samples,
        simulate_scenarios,
        with_sample,
    )

    begun = time.perf_counter()
    progress.tell(case.title, text="...")
    scenes = [with_sample(case.scene, one, k) for k, one in enumerate(case.samples, case.first)]
    scaled = scales_bodies(
        case.scene, (change.partition("=")[0] for one in case.samples for change in one)
    )
    nominal = Case(case.scene, "simulate", design).key
    if scaled and nominal not in place.nominal:
        place.nominal.clear()
        (place.nominal[nominal],) = simulate_scenarios([case.scene], design)
    rows, messages = [], {}
    found = simulate_samples(place.nominal.get(nominal), scenes, design, scaled)
    for number, trajectory in enumerate(found, case.first):
        if isinstance(trajectory, ConvergenceError):
            messages[number] = str(trajectory)
            rows.append((math.nan, math.nan, math.nan))
        else:
            worst = worst_instants(trajectory, trajectory.scene.objective.load_cases)
            compliance = float(trajectory.compliance[worst].sum())
            rows.append((compliance, *trajectory.max_deviation))
        progress.tell(case.title, len(rows), len(scenes))
    wall = time.perf_counter() - begun
    names = ("compliance", "max_deviation", "max_deviation_time")
    samples = {name: list(values) for name, values in zip(names, zip(*rows), strict=True)}
    if messages:
        place.fail(case, f"{len(messages)} samples", samples=samples, messages=messages)
    else:
        make_folder(place[case])
        _write_table(place[case], case.scene, wall, {"samples": samples})
    progress.tell(case.title, text=f"{1e3 * wall / len(scenes):.0f} ms each", finished=1)


def _unnamed(case: Case) -> Scene:
    """Return the scene under the case's key, so that a checkpoint does not depend on a name."""
    return case.scene.model_copy(update={"name": case.key})


def _figures(compliance: float, deviation: float) -> str:
    return f"compliance {compliance:.4g} N m, deviation {1e3 * deviation:.4g} mm"


# -- files -----------------------------------------------------------------------------------


def _write_table(folder: Path, scene: Scene, wall: float, results: Mapping[str, Any]) -> None:
    """Write the summary of a case that has no other files."""
    from dolfinopt.output.summary import versions, write_summary

    more = {"seconds": {"total": wall}, "versions": versions(), "scene": scene.to_dict()}
    write_summary(folder, {"name": scene.name, **results, **more})


def _is_done(folder: Path) -> bool:
    """Tell whether the folder holds a complete result; a damaged one is done anew."""
    try:
        json.loads((folder / SUMMARY).read_text(encoding="utf-8"))["seconds"]["total"]
    except (OSError, ValueError, KeyError, TypeError):
        with suppress(OSError):
            (folder / SUMMARY).unlink()
        return False
    return True


def _read(case: Case, place: _Place) -> Outcome:
    """Read a case back."""
    folder = place[case]
    if failed := place.failure_data(case):
        messages = {int(number): text for number, text in failed.get("messages", {}).items()}
        samples = _arrays(failed.get("samples", {}))
        return Outcome(case, folder, failed["message"], samples=samples, messages=messages)
    data = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    seconds = data["seconds"]["total"]
    if case.action == "sample":
        return Outcome(case, folder, seconds=seconds, samples=_arrays(data["samples"]))
    if case.action == "compare":
        from dolfinopt.study.simulate import BasisFigures

        bases = tuple(BasisFigures(**one) for one in data["bases"])
        return Outcome(case, folder, seconds=seconds, bases=bases)
    names = ("objective", "compliance", "max_deviation", "max_deviation_time", "grayness",
             "iterations", "stop_reason")  # fmt: skip
    return Outcome(case, folder, seconds=seconds, **{name: data[name] for name in names})


def _arrays(samples: Mapping[str, Sequence[float]]) -> dict[str, np.ndarray]:
    return {name: np.array(values, dtype=float) for name, values in samples.items()}
