"""Studies of a scene: objectives, reductions, and sweeps over any numeric value.

A study plans cases, has those done that its folder does not hold yet, and makes tables and figures
of the data frame of all results.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene
from dolfinopt.study.plans import Plan, tabulated
from dolfinopt.study.presets import coordinates_plan, objective_plan, reduction_plan
from dolfinopt.study.store import run_cases
from dolfinopt.study.sweep import sweep_plan
from dolfinopt.study.tables import Study, file_name
from dolfinopt.study.variants import COORDINATES, Vary, parse_vary

if TYPE_CHECKING:
    from mpi4py import MPI

Preset = Literal["payload", "flattening", "coordinates", "objective", "reduction"]

# What a preset varies unless told otherwise.
RANGES = {"payload": "payload.mass=4:8:9", "flattening": "motion.flattening=0:1:9"}


def study(
    scene: Scene,
    preset: Preset | None,
    vary: Sequence[str],
    designs: Sequence[Path],
    folder: Path,
    world: MPI.Comm,
    *,
    reoptimize: bool = False,
    kinds: Sequence[str] = (),
    shown: bool = True,
) -> Study:
    """Do a study (collective); the result is complete on the root.

    Args:
        scene: what is varied.
        preset: which study; None: a sweep over `vary` alone.
        vary: values to sweep over, see `parse_vary`; in place of the preset's own.
        designs: design.npz files to simulate in place of the initial and the optimised design.
        folder: DIR, where the cases are kept.
        world: all ranks.
        reoptimize: optimise for every scenario, too.
        kinds: of objectives to compare; by default all.
        shown: draw progress.

    Raises:
        InputError: something asked for is not possible; nothing was computed.
    """
    from dolfinopt.parallel import on_root

    plan = on_root(world, _plan, scene, preset, tuple(vary), tuple(designs), reoptimize, kinds)
    return carry_out(plan, folder, world, shown=shown)


def carry_out(plan: Plan, folder: Path, world: MPI.Comm, *, shown: bool = True) -> Study:
    """Do what is planned (collective); the result is complete on the root.

    Args:
        plan: the same on all ranks.
        folder: DIR, where the cases are kept.
        world: all ranks.
        shown: draw progress.
    """
    from dolfinopt.output.run_folder import prepare_folder
    from dolfinopt.parallel import on_root, together

    on_root(world, prepare_folder, folder)
    outcomes = run_cases([case for _, case in plan.rows], folder, world, shown=shown)
    with together(world):
        tables, figures = plan.report(tabulated(plan, outcomes))
    failures = tuple(line for outcome in outcomes.failures for line in outcome.failures)
    return Study(plan.name, tuple(tables), tuple(figures), failures, outcomes.computed)


def _plan(
    scene: Scene,
    preset: Preset | None,
    vary: tuple[str, ...],
    designs: tuple[Path, ...],
    reoptimize: bool,
    kinds: Sequence[str],
) -> Plan:
    """Check what is asked and plan it (root only)."""
    asked = [parse_vary(text) for text in vary]
    keys = [one.key for one in asked]
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f"--vary {key} twice; give all its values in one")
    if preset in ("objective", "reduction", "coordinates"):
        return _preset_plan(scene, preset, asked, designs, reoptimize, kinds)
    if preset is None and not asked:
        raise InputError("sweep: name payload, flattening or coordinates, or what to --vary")
    if preset is not None:
        own = parse_vary(RANGES[preset])
        if own.key not in keys:
            asked.insert(0, own)
    return sweep_plan(scene, sweep_name(preset, vary), asked, designs, reoptimize)


def sweep_name(preset: Preset | None, vary: Sequence[str]) -> str:
    """Return the name of a sweep's files: the preset, and the keys that it varies besides."""
    own = RANGES.get(preset or "", "=").partition("=")[0]
    own = COORDINATES if preset == "coordinates" else own
    keys = [text.partition("=")[0].strip() for text in vary]
    return file_name(*([preset] if preset else []), *(key for key in keys if key != own))


def _preset_plan(
    scene: Scene,
    preset: Preset,
    asked: Sequence[Vary],
    designs: tuple[Path, ...],
    reoptimize: bool,
    kinds: Sequence[str],
) -> Plan:
    """Plan a preset that has its own variants."""
    command = f"sweep {preset}" if preset == "coordinates" else f"compare {preset}s"
    for one in asked:
        if preset == "objective" or one.key != COORDINATES:
            only = "none" if preset == "objective" else f"only {COORDINATES}"
            raise InputError(f"--vary {one.text}: expected {only} with {command}")
    if preset != "coordinates" and designs:
        raise InputError(f"--design: expected none with {command}, which makes its own")
    if reoptimize:
        raise InputError(f"--reoptimize: not with {command}; see compare reductions")
    if preset == "objective":
        return objective_plan(scene, kinds)
    counts = asked[0].whole_numbers if asked else None
    if preset == "coordinates":
        return coordinates_plan(scene, preset, designs, counts)
    return reduction_plan(scene, counts)
