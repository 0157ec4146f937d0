"""What a study computes: cases, known by what they compute, and what came out of them."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dolfinopt.multibody.end_effector import lengths
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.output.design import read_history
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import file_digest, program, with_digests
from dolfinopt.study.simulate import SCALING

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
