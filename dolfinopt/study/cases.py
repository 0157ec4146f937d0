"""What a study computes: cases, known by what they compute, their simulation, and its outcome."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
from mpi4py import MPI

from dolfinopt.dynamics.simulation import Trajectory, simulate_batch
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.kinematics import lengths
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.output.design import arms_with_design, read_history
from dolfinopt.output.run_folder import Simulated
from dolfinopt.profiling import Counts, Profile
from dolfinopt.responses.evaluation import Evaluation, evaluate_batch
from dolfinopt.responses.order_selection import choose_coordinates
from dolfinopt.responses.response import bodies_in
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import file_digest, program, with_digests
from dolfinopt.study import variants

Action = Literal["optimize", "simulate", "sample"]

# Scenes that differ in these tables alone have the same arms, which are built and factorised once.
SCENARIO = frozenset(
    "motion control closure payload forces damping reduction simulation objective constraints "
    "optimizer scenarios".split()
)
# Bases that do not depend on `SCALING`: Krylov's shifts and the Gramian's band are frequencies.
SCALABLE = ("craig-bampton", "modal")


@dataclass(frozen=True, eq=False)
class Case:
    """One thing to compute. Two cases are equal when they compute the same.

    The key is a hash of the scene's content, of the design and of the program that computes, never
    of a name, a path or a date. A design is found, moved, or moved at samples of scene values.
    """

    scene: Scene  # complete; its name does not matter
    action: Action = "simulate"
    design: Case | Path | None = None  # given; of an optimising case, of a file, or the initial one
    label: str = field(default="", compare=False)  # what progress and messages call it
    samples: tuple[tuple[str, ...], ...] = ()  # what each changes, "key.path=value" each
    first: int = field(default=0, compare=False)  # number of the first sample, for messages

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

    @cached_property
    def batch_key(self) -> str:
        """Equal where cases are done at once: simulations of the same arms and basis."""
        scene = self.scene
        if self.action != "simulate" or scene.reduction.coordinates == "auto":  # each its own
            return self.key
        # The balanced reduction's Gramian knows the damping.
        fixed = {"reduction", "damping"} if scene.reduction.method == "balanced" else {"reduction"}
        kept = scene_content(scene, SCENARIO - fixed)
        motion_alone = scene.objective.needs("motion") and not scene.constraints.limits
        if motion_alone and scene.reduction.method in SCALABLE:
            for row in (kept["material"], *kept["arms"]):
                for key in set(SCALING) - set(scene.arm_sizes):
                    row.pop(key, None)
        return _digest([kept, self.design_key])

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
    objective: float = math.nan
    compliance: float = math.nan
    max_deviation: float = math.nan
    max_deviation_time: float = math.nan
    grayness: float = math.nan
    iterations: int = 0
    stop_reason: str = ""
    seconds: float = math.nan
    samples: Mapping[str, np.ndarray] = field(default_factory=dict)  # (n,) of `store.SAMPLED`
    messages: Mapping[int, str] = field(default_factory=dict)  # of samples that failed, by number

    def __str__(self) -> str:
        if self.failure:
            return f"{self.case.title}: failed: {self.failure}"
        found = f"compliance {self.compliance:.4g} N m, deviation {1e3 * self.max_deviation:.4g} mm"
        if self.case.action == "optimize":
            found = f"{self.iterations} iterations, {found}"
        elif self.case.action != "simulate":
            found = f"{len(self.case.samples)} samples"
        return f"{self.case.title}: {found}, {self.seconds:.1f} s"

    @property
    def failures(self) -> list[str]:
        """What failed, a line each."""
        if not self.messages:
            return [f"{self.case.title}: {self.failure}"] if self.failure else []
        case = self.case
        names = {k: f"{k} ({', '.join(one)})" for k, one in enumerate(case.samples, case.first)}
        return [f"{case.label}, sample {names[k]}: {text}" for k, text in self.messages.items()]

    @property
    def stopped(self) -> str:
        """Why an optimisation stopped."""
        return self.stop_reason if self.case.action == "optimize" else ""

    @property
    def design(self) -> Path:
        """Path of the design.npz."""
        return self.folder / "design.npz"

    def deviation(self) -> tuple[np.ndarray, np.ndarray]:
        """Return sample instants (n,), s, and the end-effector's distance from its path (n,), m."""
        with np.load(self.folder / "trajectory.npz", allow_pickle=False) as data:
            return data["t"], lengths(data["deviation"])

    def summary(self) -> dict[str, Any]:
        """Return the content of summary.json."""
        return dict(json.loads((self.folder / "summary.json").read_text("utf-8")))

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
    def failures(self) -> list[Outcome]:
        """Those that failed."""
        return [outcome for outcome in self.by_case.values() if outcome.failure]


def scene_content(scene: Scene, but: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Return what a scene computes with: its values and its files' content, `but` some tables."""
    data = with_digests(scene.to_dict())
    without = {"name", "part", *but}
    return {table: value for table, value in data.items() if table not in without}


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# -- simulating them -------------------------------------------------------------------------


# These values of material and arms scale the integrals of the reduced arms; the thickness in the
# plane alone: in space it is one of the cells' sides.
SCALING = ("young_modulus", "density", "thickness")
APART = (
    "motion",
    "payload",
    "forces",
    "damping",
)  # tables that leave the reduced bodies as they are


def simulate_scenarios(
    scenes: Sequence[Scene], design: Path | None
) -> Iterator[Simulated | ConvergenceError]:
    """Simulate one design in many scenes, on this rank alone; of one that fails yield its error.

    Arms are meshed, assembled and factorised once; neighbours with the same basis share it and are
    simulated in one batch, whose time and counts the first of them bears. Scenes differ in
    `cases.SCENARIO` alone, neighbours also in what `Case.batch_key` allows. No design.npz is the
    initial design; InputError where one does not fit the arms.
    """
    profile = Profile()
    partition, arms, x_phys = arms_with_design(MPI.COMM_SELF, scenes[0], design, profile)
    for _, neighbours in groupby(enumerate(scenes), key=lambda numbered: _basis(*numbered)):
        batch = [scene for _, scene in neighbours]
        arms = {k: arm.under(batch[0]) for k, arm in arms.items()}
        every: Sequence[tuple[Evaluation, Trajectory | None] | ConvergenceError]
        choice = None
        try:
            choice = choose_coordinates(batch[0], partition, arms, x_phys, profile)
            every = evaluate_batch(batch, partition, arms, x_phys, profile)
        except ConvergenceError as error:
            every = [error] * len(batch)
        for scene, found in zip(batch, every, strict=True):
            if isinstance(found, ConvergenceError):
                yield found
            else:
                yield Simulated(scene, partition, arms, x_phys, *found, profile, choice)
            profile.seconds.clear()  # the account of the next scene; the arms know the profile
            profile.counts = Counts()


def _basis(number: int, scene: Scene) -> Any:
    """Return what is equal for scenes with one basis; each has its own where it is chosen."""
    reduction = scene.reduction
    if reduction.coordinates == "auto":
        return number
    return reduction, scene.damping if reduction.method == "balanced" else None


# -- samples ---------------------------------------------------------------------------------


def scales_bodies(scene: Scene, keys: Iterable[str]) -> bool:
    """Return whether one reduction serves all values of these keys."""
    scaling = set(SCALING) - set(scene.arm_sizes)
    parts = [key.split(".") for key in keys]
    return all(
        one[0] in APART or (one[0] in ("material", "arms") and one[-1] in scaling) for one in parts
    )


def with_sample(scene: Scene, changes: Sequence[str], number: int) -> Scene:
    """Return the scene with a sample's values, "key.path=value" each.

    InputError where the scene cannot have them; it names the sample's number.
    """
    with variants.asked_by(f"--random, sample {number} ({', '.join(changes)})"):
        return variants.changed(scene, *changes)


def simulate_samples(
    nominal: Simulated | ConvergenceError | None, scenes: Sequence[Scene], design: Path | None
) -> Iterator[Trajectory | ConvergenceError]:
    """Simulate a design (design.npz, or None, the initial one) in scenes, on this rank alone.

    The bodies are scaled from those of `nominal`, the design in the nominal scene, and every sample
    starts from its solution: the bits depend on no other sample. None: they are reduced anew.
    """
    if nominal is None:
        for scene in scenes:
            (found,) = simulate_scenarios([scene], design)
            trajectory = found if isinstance(found, ConvergenceError) else found.trajectory
            assert trajectory is not None  # on a single rank
            yield trajectory
    elif isinstance(nominal, ConvergenceError):
        yield from [nominal] * len(scenes)
    else:
        assert nominal.trajectory is not None
        owned = {k: nominal.trajectory.mechanism.bodies[k] for k in nominal.arms}
        bodies = [bodies_in(nominal.scene, scene, owned) for scene in scenes]
        # At once: less than half the time of one after the other.
        starts = [nominal.trajectory.solution] * len(scenes)
        yield from simulate_batch(scenes, bodies, Profile(), starts)
