"""What a study computes: cases, known by what they compute, and what came out of them."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dolfinopt.multibody.end_effector import lengths
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import file_digest, program, with_digests
from dolfinopt.study import variants

if TYPE_CHECKING:
    from dolfinopt.optimization.history import HistoryRow
    from dolfinopt.study.simulate import BasisFigures

Action = Literal["optimize", "simulate", "compare", "sample"]

# Scenes that differ in nothing but these tables have the same arms: they are meshed, assembled
# and factorised once.
SCENARIO = (
    "motion",
    "control",
    "closure",
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
# the basis does not depend on them: Krylov's shifts and the Gramian's band are frequencies. The
# thickness in the plane alone: in space it is one of the cells' sides.
SCALING = ("young_modulus", "density", "thickness")
SCALABLE = ("craig-bampton", "modal")


@dataclass(frozen=True, eq=False)
class Case:
    """One thing to compute. Two cases are equal when they compute the same.

    Attributes:
        scene: complete; its name does not matter.
        action: "optimize" finds a design, "simulate" moves a given one, "compare" says what its
            reduced basis misses of `variants.REFERENCE` Craig-Bampton coordinates, "sample" moves
            it at several samples of the scene's values, one after the other.
        design: given; that of an optimising case, of a file, or None, the initial one.
        label: what progress and messages call it.
        samples: what each sample changes, "key.path=value" each.
        first: number of the first sample, for messages.
    """

    scene: Scene
    action: Action = "simulate"
    design: Case | Path | None = None
    label: str = field(default="", compare=False)
    samples: tuple[tuple[str, ...], ...] = ()
    first: int = field(default=0, compare=False)

    @cached_property
    def key(self) -> str:
        """Sixteen hexadecimal digits that stand for everything the case computes."""
        parts: list[Any] = [program(), self.action, scene_content(self.scene), self.design_key]
        if self.action == "compare":
            from dolfinopt.study.simulate import MODES

            parts += [variants.REFERENCE_METHOD, variants.REFERENCE, MODES]
        return _digest([*parts, self.samples])

    @property
    def title(self) -> str:
        """Its label, with the numbers of its samples."""
        if not self.samples:
            return self.label
        return f"{self.label}, samples {self.first} to {self.first + len(self.samples) - 1}"

    @cached_property
    def design_key(self) -> str:
        """What stands for the given design in the key."""
        if isinstance(self.design, Case):
            return self.design.key
        return "initial" if self.design is None else file_digest(self.design)

    @cached_property
    def arms_key(self) -> str:
        """Equal where the same arms with the same design are simulated or compared.

        Optimisations and samples share nothing.
        """
        if self.action in ("optimize", "sample"):
            return self.key
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
        motion_alone = scene.objective.needs("motion") and not any(vars(scene.constraints).values())
        if motion_alone and scene.reduction.method in SCALABLE:
            for row in (kept["material"], *kept["arms"]):
                for key in SCALING[:2] if scene.is_spatial else SCALING:
                    row.pop(key, None)
        return _digest([kept, self.design_key])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Case) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came out of a case, read back from its folder. What it does not have is nan.

    Attributes:
        case, folder: which, and where its files are.
        failure: message, "" where it succeeded.
        objective: N m, N m s, m or s2.
        compliance: of the load cases, N m.
        max_deviation, max_deviation_time: m, s.
        grayness: over all arms.
        iterations, stop_reason: of an optimisation.
        seconds: that it took.
        bases: of a comparison, one an arm with a design of its own.
        samples: compliance, max_deviation and max_deviation_time (n,) of samples.
        messages: of the samples that failed, by number.
    """

    case: Case
    folder: Path
    failure: str = ""
    objective: float = math.nan
    compliance: float = math.nan
    max_deviation: float = math.nan
    max_deviation_time: float = math.nan
    grayness: float = math.nan
    iterations: int = 0
    stop_reason: str = ""
    seconds: float = math.nan
    bases: tuple[BasisFigures, ...] = ()
    samples: Mapping[str, np.ndarray] = field(default_factory=dict)
    messages: Mapping[int, str] = field(default_factory=dict)

    @property
    def failures(self) -> list[str]:
        """What failed, a line each."""
        if not self.messages:
            return [f"{self.case.title}: {self.failure}"] if self.failure else []
        return [
            f"{self.case.label}, sample {number} "
            f"({', '.join(self.case.samples[number - self.case.first])}): {message}"
            for number, message in self.messages.items()
        ]

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
        found: dict[str, Any] = json.loads((self.folder / "summary.json").read_text("utf-8"))
        return found

    def history(self) -> list[HistoryRow]:
        """Return the optimisation's history."""
        from dolfinopt.output.design import read_history

        return read_history(self.folder / "history.csv")


@dataclass(frozen=True)
class Outcomes:
    """All cases of a run.

    Attributes:
        by_case: in the order asked for.
        computed: how many were not there before; every sample counts.
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
