"""Cases done once, shared out over the ranks: what all studies compute.

The results of a case are the usual files in DIR/cases/<key>/; that the summary is there tells that
the case is done. Every case runs on one rank alone: its bits do not depend on how many there are.

The ranks are the pool: each takes the next job whose design is there, by creating the job's file in
a folder of this run (`_Place`). Progress is read from the files that appear.

All that a run lacks of one design with one basis is simulated at once. Such a batch shares its
steps, which each of its cases depends on within the tolerance; its folders are put in place when
all of them are written, so that an interrupted batch is computed anew as a whole.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from mpi4py import MPI

from dolfinopt.disk import make_folder, write_text
from dolfinopt.errors import ConvergenceError, InputError, OthersFailed
from dolfinopt.output import checkpoint
from dolfinopt.output.design import read_history
from dolfinopt.output.folders import working_alone
from dolfinopt.output.run_folder import optimize, write_result, write_simulation
from dolfinopt.output.summary import versions, write_summary
from dolfinopt.parallel import on_root, together
from dolfinopt.responses.motion import worst_instants
from dolfinopt.scene.load import Scene
from dolfinopt.study.cases import (
    Case,
    Outcome,
    Outcomes,
    scales_bodies,
    simulate_samples,
    simulate_scenarios,
    with_sample,
)

CASES, WORK = "cases", ".work-"  # folders in DIR: of all cases; of a run, followed by its name
SUMMARY, HISTORY = "summary.json", "history.csv"
IDLE = 0.02  # s between two looks for a job
SAMPLED = ("compliance", "max_deviation", "max_deviation_time")
FIGURES = (*SAMPLED, "objective", "grayness", "iterations", "stop_reason")

# Cases of the same arms and design, which one rank does in one go: batches, each done at once.
Job = Sequence[Sequence[Case]]


@dataclass(frozen=True)
class _Place:
    """Folder of all cases, and of this run: jobs taken, why cases failed, what is not complete."""

    cases: Path
    work: Path
    untold: list[Case] = field(default_factory=list)  # this rank tells when they end, by any rank

    def __getitem__(self, case: Case) -> Path:
        return self.cases / case.key

    def has(self, case: Case) -> bool:
        """Tell whether the case is done, or has failed in this run."""
        return (self[case] / SUMMARY).exists() or bool(self.failure(case))

    def fail(self, case: Case, message: str, **more: Any) -> None:
        """Keep why a case failed, for this run."""
        write_text(self.work / f"{case.key}.json", json.dumps({"message": message, **more}))

    def failure(self, case: Case) -> dict[str, Any]:
        """Return what the case left when it failed in this run, nothing if it did not."""
        path = self.work / f"{case.key}.json"
        return dict(json.loads(path.read_text("utf-8"))) if path.exists() else {}

    def tell(self) -> None:
        """Tell of cases that have ended meanwhile, a line each."""
        for case in [case for case in self.untold if self.has(case)]:
            self.untold.remove(case)
            print(f"{_read(case, self)}; {len(self.untold)} to go", file=sys.stderr, flush=True)

    def check(self) -> None:
        """Tell what has ended; raise OthersFailed if another rank has failed."""
        self.tell()
        if (self.work / "stop").exists():
            raise OthersFailed("another rank failed")


def run_cases(
    cases: Iterable[Case], folder: Path, world: MPI.Comm, *, shown: bool = True
) -> Outcomes:
    """Do all cases that are not done yet, and those they depend on (collective).

    A case that fails to converge is reported in its outcome, and so are those that need its
    design; it is tried again in the next run. Ranks share a file system; `shown`: the root tells
    of every case on its standard error. InputError where a scene or design cannot be used, the
    others stay unfinished; another run works in the folder DIR, or it cannot be written.
    """
    both = (one for case in cases for one in (case.design, case))
    wanted = list(dict.fromkeys(one for one in both if isinstance(one, Case)))
    with working_alone(world, folder):
        place = _Place(folder / CASES, folder / (WORK + on_root(world, lambda: uuid4().hex)))
        try:
            done = on_root(world, _begin, place, wanted)
            missing = [case for case, there in zip(wanted, done, strict=True) if not there]
            place.untold.extend(missing * (shown and world.rank == 0))
            with together(world):
                _share(_jobs(missing, world.size), place, world)
            with together(world):
                outcomes = {case: _read(case, place) for case in wanted}
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
    done = [_is_complete(place[case]) for case in wanted]
    for case, there in zip(wanted, done, strict=True):
        if not there and case.action == "optimize":
            (place[case] / SUMMARY).unlink(missing_ok=True)  # its checkpoint stays
        elif not there:
            shutil.rmtree(place[case], ignore_errors=True)
    return done


def _is_complete(folder: Path) -> bool:
    try:
        json.loads((folder / SUMMARY).read_text("utf-8"))["seconds"]["total"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return True


# -- who does what ---------------------------------------------------------------------------


def _jobs(missing: Iterable[Case], ranks: int) -> list[Job]:
    """Return the jobs, optimisations first, as others wait for them."""
    # All of the same arms and design is one job for each rank, which builds these once.
    batches: dict[str, list[Case]] = {}
    for case in missing:
        batches.setdefault(case.batch_key, []).append(case)
    groups: dict[str, list[list[Case]]] = {}
    for batch in batches.values():
        batch.sort(key=lambda case: case.key)  # whatever the order in which they were asked for
        groups.setdefault(batch[0].arms_key, []).append(batch)
    jobs = [group[k::ranks] for group in groups.values() for k in range(min(ranks, len(group)))]
    return sorted(jobs, key=lambda job: job[0][0].action != "optimize")


def _share(jobs: Sequence[Job], place: _Place, world: MPI.Comm) -> None:
    """Do one job after the other that no other rank has taken; end when all ranks do."""
    left = list(jobs)
    try:
        while left:
            place.check()
            job = next((one for one in left if _is_ready(one[0][0], place)), None)
            if job is None:
                time.sleep(IDLE)
                continue
            left.remove(job)
            try:
                (place.work / f"{job[0][0].key}.taken").touch(exist_ok=False)
            except FileExistsError:  # by another rank
                continue
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
        place.tell()


def _is_ready(case: Case, place: _Place) -> bool:
    """Tell whether the design is there, or will not be."""
    return not isinstance(case.design, Case) or place.has(case.design)


def _do(job: Job, place: _Place) -> None:
    """Do a job; without their design its cases fail."""
    cases = [case for batch in job for case in batch]
    action, design = cases[0].action, cases[0].design
    if isinstance(design, Case):
        if failed := place.failure(design):
            for case in cases:
                place.fail(case, f"{design.label or design.key}: {failed['message']}")
            return
        design = place[design] / "design.npz"
    if action == "optimize":
        _optimise(cases[0], place)
    elif action == "sample":
        _sample(cases, design, place)
    else:
        _simulate(job, design, place)


# -- what is done ----------------------------------------------------------------------------


def _optimise(case: Case, place: _Place) -> None:
    """Optimise, from the checkpoint of an interrupted run if there is one."""
    begun, folder, scene = time.perf_counter(), place[case], _unnamed(case)
    resume = True
    try:
        checkpoint.check(folder, scene)
    except InputError:  # none, damaged, or made when a file of the scene was elsewhere
        resume = False
    rows = read_history(folder / HISTORY) if resume and (folder / HISTORY).exists() else []
    how: dict[str, Any] = {"resume": resume, "overwrite": not resume, "world": MPI.COMM_SELF}
    try:
        result = optimize(scene, folder, **how, report=lambda row: place.check())
    except ConvergenceError as error:
        place.fail(case, str(error))
        return
    earlier = rows[-1].seconds if rows else 0.0
    write_result(scene, folder, result, earlier + time.perf_counter() - begun, paraview=False)


def _simulate(job: Job, design: Path | None, place: _Place) -> None:
    """Simulate one design in many scenes."""
    found = simulate_scenarios([_unnamed(case) for batch in job for case in batch], design)
    for batch in job:
        place.check()
        for case in batch:
            begun = time.perf_counter()
            result = next(found)
            wall = time.perf_counter() - begun
            part = place.work / case.key
            if isinstance(result, ConvergenceError):
                place.fail(case, str(result))
            else:
                make_folder(part)
                write_simulation(part, result, wall, paraview=False)
        for case in batch:
            with suppress(FileNotFoundError):  # it failed
                os.rename(place.work / case.key, place[case])


def _sample(cases: Sequence[Case], design: Path | None, place: _Place) -> None:
    """Simulate one design at samples of its scene's values."""
    nominal = None
    for case in cases:
        place.check()
        begun, scene = time.perf_counter(), case.scene
        scenes = [with_sample(scene, one, k) for k, one in enumerate(case.samples, case.first)]
        keys = (change.partition("=")[0] for one in case.samples for change in one)
        scaled = scales_bodies(scene, keys)
        if scaled and nominal is None:
            (nominal,) = simulate_scenarios([scene], design)
        rows, messages = [], {}
        found = simulate_samples(nominal if scaled else None, scenes, design)
        for number, trajectory in enumerate(found, case.first):
            if isinstance(trajectory, ConvergenceError):
                messages[number] = str(trajectory)
                rows.append((math.nan,) * len(SAMPLED))
            else:
                worst = worst_instants(trajectory, trajectory.scene.objective.load_cases)
                compliance = float(trajectory.compliance[worst].sum())
                rows.append((compliance, *trajectory.max_deviation))
        samples = dict(zip(SAMPLED, np.transpose(rows).tolist(), strict=True))
        if messages:
            place.fail(case, f"{len(messages)} samples", samples=samples, messages=messages)
        else:
            folder, wall = place[case], time.perf_counter() - begun
            make_folder(folder)
            more = {"seconds": {"total": wall}, "versions": versions(), "scene": scene.to_dict()}
            write_summary(folder, {"name": case.key, "samples": samples, **more})


def _unnamed(case: Case) -> Scene:
    """Return the scene under the case's key, so that a checkpoint does not depend on a name."""
    return case.scene.model_copy(update={"name": case.key})


def _read(case: Case, place: _Place) -> Outcome:
    """Read a case back."""
    failed = place.failure(case)
    data = failed or json.loads((place[case] / SUMMARY).read_text("utf-8"))
    found: dict[str, Any] = {"failure": failed.get("message", "")}
    if case.action == "sample":
        samples = data.get("samples", {})
        found["samples"] = {name: np.array(values, float) for name, values in samples.items()}
        found["messages"] = {int(k): text for k, text in data.get("messages", {}).items()}
    elif not failed:
        found |= {name: data[name] for name in FIGURES}
    if not failed:
        found["seconds"] = data["seconds"]["total"]
    return Outcome(case, place[case], **found)
