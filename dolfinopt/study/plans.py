"""What every study is made of: cases to do, and tables and figures to make of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene
from dolfinopt.study.store import Case, Outcome, Outcomes
from dolfinopt.study.tables import DesignFigure, Figure, Line, Panel, Table

Item = TypeVar("Item")
Take = Callable[[Outcome], float]
QUANTITIES: tuple[tuple[str, Take], ...] = (
    ("compliance [N m]", lambda outcome: outcome.compliance),
    ("maximal deviation [mm]", lambda outcome: 1e3 * outcome.max_deviation),
)

Report = tuple[list[Table], list[Figure]]


@dataclass(frozen=True)
class Plan:
    """Cases to do, and what to make of them."""

    name: str

    @property
    def cases(self) -> list[Case]:
        """All of them; what they depend on may be left out."""
        raise NotImplementedError

    def report(self, outcomes: Outcomes) -> Report:
        """Return tables and figures."""
        raise NotImplementedError


# -- designs ---------------------------------------------------------------------------------


def given_designs(
    scene: Scene, designs: Sequence[Path]
) -> tuple[tuple[str, Case | Path | None], ...]:
    """Return label and design of the files, or else of the initial and the optimised design."""
    _check_designs(scene, designs)
    if designs:
        names = [path.parent.name if path.stem == "design" else path.stem for path in designs]
        plain = len(set(names)) == len(names)
        return tuple((n if plain else str(p), p) for n, p in zip(names, designs, strict=True))
    return (
        ("initial design", None),
        ("optimised design", Case(scene, "optimize", label="optimised design")),
    )


def _check_designs(scene: Scene, designs: Sequence[Path]) -> None:
    """Raise InputError unless all designs can be read and fit the scene's arms."""
    if not designs:
        return
    from mpi4py import MPI

    from dolfinopt.arms.arm import build_arms
    from dolfinopt.output.files import read_design
    from dolfinopt.parallel import partition_arms
    from dolfinopt.profiling import Profile

    for path in designs:
        if not path.is_file():
            raise InputError(f"{path}: --design: no such file; give design.npz files")
    partition = partition_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = build_arms(scene, partition, Profile())
    for path in designs:
        read_design(path, partition, arms)


# -- tables and figures ----------------------------------------------------------------------


def ended(outcome: Outcome) -> str:
    if outcome.failure:
        return f"failed: {outcome.failure}"
    return "" if outcome.case.action != "optimize" else outcome.stop_reason


def deviation_panels(title: str, found: Sequence[Outcome]) -> list[tuple[Panel, ...]]:
    """Return the deviation over time; designs of another magnitude get a panel of their own."""
    rows: list[tuple[Panel, ...]] = []
    for group in magnitudes(found, lambda outcome: outcome.max_deviation, 10.0)[::-1]:
        lines = []
        for outcome in group:
            t, distance = outcome.deviation()
            lines.append(Line(outcome.case.label, t, 1e3 * distance))
        rows.append((Panel(title, "time [s]", "deviation [mm]", tuple(lines)),))
    return rows


def design_figure(name: str, title: str, found: Sequence[Outcome]) -> DesignFigure:
    return DesignFigure(
        name,
        title,
        tuple(
            (
                f"{o.case.label}: {o.compliance:.4g} N m, {1e3 * o.max_deviation:.4g} mm",
                o.case.scene,
                o.design,
            )
            for o in found
        ),
    )


def magnitudes(
    items: Sequence[Item], size: Callable[[Item], float], ratio: float
) -> list[list[Item]]:
    """Group what a panel can show on one scale: sizes within a factor, the largest group first."""
    groups: list[list[Item]] = []
    for item in sorted(items, key=lambda item: -size(item)):
        if groups and size(groups[-1][0]) <= ratio * size(item):
            groups[-1].append(item)
        else:
            groups.append([item])
    return [[item for item in items if item in group] for group in groups]
