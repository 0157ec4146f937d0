"""One design under many samples of its scene's values, cached in chunks and spread over the ranks.

Every sample starts from the nominal scene's solution, which every rank finds for itself: its bits
depend neither on the number of ranks nor on what was computed before. A chunk is known by the
scene's content, the design, its samples and the program; its file comes when it is complete.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

import numpy as np

from dolfinopt.disk import make_folder
from dolfinopt.dynamics.simulation import Trajectory, simulate_batch
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.profiling import Profile
from dolfinopt.responses.motion import worst_instants
from dolfinopt.responses.scenarios import bodies_in
from dolfinopt.scene.load import Scene
from dolfinopt.study.progress import Progress
from dolfinopt.study.store import Case, simulate_scenarios
from dolfinopt.study.tasks import do_tasks
from dolfinopt.study.variants import changed

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.output.run_folder import Simulated

FOLDER = "samples"
# Keys that leave the reduced bodies as they are, or scale them: in plane stress mass and stiffness
# are linear in the thickness.
SCALING = r"(motion|payload|damping)\..+|(material|arms|arms\..+)\.(young_modulus|density)"
SCALING += r"|arms\.(.+\.)?thickness"
CHUNK = 25  # samples that an interruption may cost
REDUCED = 5  # of those that are meshed and reduced anew, which take longer


@dataclass(frozen=True, eq=False)
class Samples:
    """A scene as it is, number 0, and samples 1 to n of its values.

    Attributes:
        scene: with the nominal values.
        keys: what differs.
        values: (n, d).
    """

    scene: Scene
    keys: tuple[str, ...]
    values: np.ndarray

    def changes(self, index: int) -> tuple[str, ...]:
        """Return what makes a sample of the scene, as "key=value"."""
        if index == 0:
            return ()
        pairs = zip(self.keys, self.values[index - 1].tolist(), strict=True)
        return tuple(f"{key}={value!r}" for key, value in pairs)

    @property
    def scaling(self) -> bool:
        """Whether one reduction serves all samples."""
        return all(re.fullmatch(SCALING, key) for key in self.keys)


@dataclass(frozen=True, eq=False)
class Responses:
    """What one design does in the scene and at every sample; nan where its simulation failed.

    Attributes:
        compliance: (1 + n,) of the load cases, N m.
        max_deviation, max_deviation_time: (1 + n,) m, s.
        failures: messages by sample.
    """

    compliance: np.ndarray
    max_deviation: np.ndarray
    max_deviation_time: np.ndarray
    failures: Mapping[int, str]


# -- one rank --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Nominal:
    """One design reduced and simulated in the nominal scene, on this rank alone."""

    scene: Scene
    design: Path | None
    scaling: bool

    @cached_property
    def _found(self) -> Simulated | ConvergenceError:
        (found,) = simulate_scenarios([self.scene], self.design)
        return found

    def simulate(self, scenes: Sequence[Scene]) -> Iterator[Trajectory | ConvergenceError]:
        """Simulate the design in scenes."""
        found = self._found if self.scaling else None
        if isinstance(found, ConvergenceError):
            yield from [found] * len(scenes)
        elif found is not None:
            assert found.trajectory is not None  # on a single rank
            owned = {k: found.trajectory.mechanism.bodies[k] for k in found.arms}
            bodies = [bodies_in(self.scene, scene, owned) for scene in scenes]
            # At once: less than half the time of one after the other.
            starts = [found.trajectory.solution] * len(scenes)
            yield from simulate_batch(scenes, bodies, Profile(), starts)
        else:
            for scene in scenes:
                for anew in simulate_scenarios([scene], self.design):
                    if not isinstance(anew, ConvergenceError):
                        anew = anew.trajectory
                    assert anew is not None
                    yield anew


# -- chunks ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Chunk:
    """Some samples of one design."""

    samples: Samples
    design: Path | None
    label: str
    first: int
    last: int

    @cached_property
    def key(self) -> str:
        """Sixteen hexadecimal digits that stand for everything the chunk computes."""
        case = Case(self.samples.scene, "simulate", self.design)
        content = [case.key, [self.samples.changes(i) for i in range(self.first, self.last)]]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]

    def scenes(self) -> list[Scene]:
        """Return the scene with every sample.

        Raises:
            InputError: a scene cannot have such values.
        """
        return [posed(self.samples, i) for i in range(self.first, self.last)]


def posed(samples: Samples, index: int) -> Scene:
    """Return the scene with a sample's values.

    Raises:
        InputError: it cannot have them.
    """
    try:
        return changed(samples.scene, *samples.changes(index))
    except InputError as error:
        values = ", ".join(samples.changes(index))
        raise InputError(f"--random, sample {index} ({values}): {error}") from None


def respond(
    samples: Samples,
    designs: Sequence[tuple[str, Path | None]],
    folder: Path,
    world: MPI.Comm,
    *,
    shown: bool = True,
) -> tuple[list[Responses], int]:
    """Simulate every design at every sample that is not known yet (collective).

    Args:
        samples: of one scene.
        designs: labels, and design.npz files or None, the initial design.
        folder: DIR; can be written.
        world: all ranks, which share a file system.
        shown: draw progress on the root's standard error.

    Returns:
        One response a design, and how many simulations were not there before.

    Raises:
        InputError: a scene cannot have a sample's values, or a design does not fit.
    """
    from dolfinopt.parallel import on_root, together

    size = CHUNK if samples.scaling else REDUCED
    count = 1 + len(samples.values)
    chunks = [
        _Chunk(samples, design, label, first, min(first + size, count))
        for label, design in designs
        for first in range(0, count, size)
    ]
    place = folder / FOLDER

    def look() -> tuple[list[bool], str]:
        make_folder(place)
        return [_read(place, chunk, "") is not None for chunk in chunks], uuid4().hex

    done, run = on_root(world, look)
    missing = [chunk for chunk, there in zip(chunks, done, strict=True) if not there]
    nominal = _Nominals()
    tasks = [_ChunkTask(chunk, place, run, nominal) for chunk in missing]
    # Every rank begins elsewhere: with several designs each reduces those it needs.
    begin = len(tasks) * world.rank // world.size
    tasks = [*tasks[begin:], *tasks[:begin]]
    do_tasks(tasks, place, world, len(missing), shown=shown)
    responses = []
    with together(world):
        found = {chunk: _read(place, chunk, run) for chunk in chunks}
        for label, design in designs:
            parts = [(c, found[c]) for c in chunks if (c.label, c.design) == (label, design)]
            responses.append(_joined(parts))
    return responses, sum(chunk.last - chunk.first for chunk in missing)


class _Nominals:
    """The design that this rank has at hand; owns its reduction and simulation."""

    def __init__(self) -> None:
        self._last: _Nominal | None = None

    def of(self, chunk: _Chunk) -> _Nominal:
        """Return the chunk's design in the nominal scene, the last one's if it is the same."""
        if self._last is None or self._last.design != chunk.design:
            self._last = _Nominal(chunk.samples.scene, chunk.design, chunk.samples.scaling)
        return self._last


@dataclass(frozen=True, eq=False)
class _ChunkTask:
    """A chunk to simulate, see `tasks.Task`."""

    chunk: _Chunk
    place: Path
    run: str
    nominals: _Nominals

    @property
    def key(self) -> str:
        """That of the chunk."""
        return self.chunk.key

    def is_done(self) -> bool:
        """Tell whether this run need not simulate it any more."""
        return _read(self.place, self.chunk, self.run) is not None

    def is_ready(self) -> bool:
        """A chunk needs nothing but its design, which is there."""
        return True

    def do(self, progress: Progress) -> None:
        """Simulate it."""
        _do(self.chunk, self.nominals.of(self.chunk), self.place, self.run, progress)


def _do(chunk: _Chunk, nominal: _Nominal, place: Path, run: str, progress: Progress) -> None:
    """Simulate a chunk's samples and write what they gave."""
    from dolfinopt.output.files import write_arrays

    begun = time.perf_counter()
    label = f"{chunk.label}, samples {chunk.first} to {chunk.last - 1}"
    scenes = chunk.scenes()
    progress.tell(label, text="...")
    rows, messages = [], []
    for done, found in enumerate(nominal.simulate(scenes), 1):
        if isinstance(found, ConvergenceError):
            messages.append(str(found))
            rows.append((np.nan, np.nan, np.nan))
        else:
            messages.append("")
            rows.append(_response(found))
        progress.tell(label, done, len(scenes))
    compliance, deviation, when = np.array(rows).T
    arrays = {
        "compliance": compliance,
        "max_deviation": deviation,
        "max_deviation_time": when,
        "failures": np.array(messages),
        "run": np.array(run),
    }
    write_arrays(place / f"{chunk.key}.npz", arrays)
    each = 1e3 * (time.perf_counter() - begun) / len(scenes)
    progress.tell(label, text=f"{each:.0f} ms each", finished=1)


def _response(trajectory: Trajectory) -> tuple[float, float, float]:
    """Return compliance of the load cases, N m, maximal deviation, m, and its instant, s."""
    worst = worst_instants(trajectory, trajectory.scene.objective.load_cases)
    return (float(trajectory.compliance[worst].sum()), *trajectory.max_deviation)


def _read(place: Path, chunk: _Chunk, run: str) -> Responses | None:
    """Return what a chunk gave, None if it is to be done (anew).

    One with failures is done anew by the next run.
    """
    try:
        with np.load(place / f"{chunk.key}.npz", allow_pickle=False) as data:
            failures = {i: str(text) for i, text in enumerate(data["failures"]) if text}
            if failures and str(data["run"]) != run:
                return None
            return Responses(
                data["compliance"], data["max_deviation"], data["max_deviation_time"], failures
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _joined(parts: Sequence[tuple[_Chunk, Responses | None]]) -> Responses:
    """Put the chunks of one design together."""
    found = [part for _, part in parts if part is not None]
    assert len(found) == len(parts), "a chunk's file has gone"
    failures = {
        chunk.first + i: text
        for chunk, part in parts
        if part is not None
        for i, text in part.failures.items()
    }
    return Responses(
        np.concatenate([part.compliance for part in found]),
        np.concatenate([part.max_deviation for part in found]),
        np.concatenate([part.max_deviation_time for part in found]),
        failures,
    )
