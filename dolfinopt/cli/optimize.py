"""`dolfinopt optimize`, `simulate`, `gradient` and `plot`: what is done with one scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
from mpi4py import MPI

from dolfinopt.cli.begin import elapsed, warn
from dolfinopt.cli.shared import (
    chosen,
    claim,
    draw,
    in_words,
    load,
    progress,
    scene_of,
    tell,
    tell_assumed,
)
from dolfinopt.data import filled
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.gradient_check import STEPS, check_exact, taylor_test
from dolfinopt.optimization.measured import PASSING_RATE
from dolfinopt.optimization.result import RankResult, Result
from dolfinopt.optimization.stopping import StopCode
from dolfinopt.output import checkpoint, run_folder
from dolfinopt.output.design import Designed, arms_with_design, read_history, write_gradient
from dolfinopt.output.folders import check_unused, prepare_folder, remove_stale, working_alone
from dolfinopt.output.summary import is_grey
from dolfinopt.output.trajectory import read_initial_deviation
from dolfinopt.parallel import on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.progress import with_unit
from dolfinopt.responses import evaluation
from dolfinopt.responses.constraints import limits_of
from dolfinopt.responses.order_selection import choose_coordinates
from dolfinopt.responses.response import needs, objective_of
from dolfinopt.scene.load import Scene


def optimize(
    world: MPI.Comm,
    scene: Path,
    out: Path | None,
    resume: bool,
    overwrite: bool,
    overrides: Sequence[str],
    plots: bool,
    verbose: bool,
) -> None:
    """Optimise the arms of SCENE for the loads of their motion."""
    loaded = load(world, scene, overrides)
    loaded.check_designed()
    tell_assumed(loaded)
    folder = out or Path("results") / scene.stem
    if resume:
        on_root(world, checkpoint.check, folder, loaded)
    else:
        claim(world, folder, overwrite, resume=checkpoint.NAME, scene=loaded)
    if loaded.is_spatial and not resume and loaded.optimizer.max_iterations:
        _tell_ahead(world, loaded)
    with working_alone(world, folder):  # until all files of the run are written
        try:
            say, most = progress(world, "optimize"), loaded.optimizer.max_iterations
            result = run_folder.optimize(
                loaded,
                folder,
                resume=resume,
                overwrite=overwrite,
                world=world,
                report=lambda row: say(in_words(row, most)),
                compared=True,
            )
            _conclude(folder, result, plots, verbose)
        except KeyboardInterrupt:
            instead = " in place of --overwrite" if overwrite else ""
            raise KeyboardInterrupt(f"to go on, add --resume{instead}") from None
    if result.violated:  # known to all ranks
        raise ConvergenceError(f"the design is not feasible: {result.violated}")


def _tell_ahead(world: MPI.Comm, scene: Scene) -> None:
    """Print what straight tubes and bars reach in place of solid links (collective)."""
    from dolfinopt.study.cases import Runner  # with pandas
    from dolfinopt.study.sections import ahead

    with TemporaryDirectory() as own:
        folder = Path(world.bcast(own, root=0))
        lines = Runner(folder, world, shown=False).follow(ahead(scene, folder))
        with together(world):  # until all ranks are done with the folder
            for line in lines:
                click.echo(line)


def _conclude(folder: Path, result: RankResult, plots: bool, verbose: bool) -> None:
    """Write all that a result leaves behind, and tell of it (collective)."""
    pictures = partial(draw, result) if plots else None
    summary = run_folder.write_result(folder, result, elapsed(), pictures=pictures)
    if summary is not None:
        _tell(result, summary, folder, verbose)


# -- what a run tells at its end: why it ended, what it gained, which limits hold ----------------


def _tell(result: Result, summary: Mapping[str, Any], folder: Path, verbose: bool) -> None:
    """Print the run's warnings, what the deviation comes from, and what came of it (root only)."""
    warn(summary["warnings"])
    optimizer = result.scene.optimizer
    report = filled(
        "report.txt.jinja",
        {"with_unit": with_unit},
        result=result,
        summary=summary,
        folder=folder,
        verbose=verbose,
        chosen=chosen,
        # Uniform arms with solid ends exceed their volume: an optimisation begins by taking that
        # away.
        limits=[o for o in result.limits if result.optimised or o.quantity != "volume_fraction"],
        turned=objective_of(result.scene).turned,
        gained=list(_gained(result)) if result.optimised else [],
        grey=is_grey(result.scene, summary["grayness"]),
        spent=result.stop_code is StopCode.ITERATIONS,
        more=2 * optimizer.max_iterations or type(optimizer)().max_iterations,
    )
    click.echo(report, nl=False)


def _gained(result: Result) -> Iterator[str]:
    """Yield how the objective stands to that of the start, and of bars."""
    value = result.evaluation.objective
    yield _against(value, result.rows[0].objective, "the starting design")
    if result.bars is not None:
        yield _against_bars(result, value)


def _against(value: float, other: float, what: str) -> str:
    """Return e.g. "64 % below the starting design"."""
    percent = 100.0 * (value / other - 1.0) if other else 0.0
    if abs(percent) < 0.05:
        return f"as {what}"
    return f"{abs(percent):.2g} % {'below' if percent < 0.0 else 'above'} {what}"


def _against_bars(result: Result, value: float) -> str:
    """Compare a design with straight solid bars of the same mass."""
    assert result.bars is not None
    bars = "straight solid bars of the same mass"
    exceeded = [
        limit
        for limit in limits_of(result.scene, result.bars)
        if limit.excess > 0.01 and not limit.of_mass
    ]
    missed = ", ".join(item.usage for item in exceeded)
    if result.scene.objective.kind == "mass":
        return f"{bars} have {missed}" if missed else f"as {bars}, which keep the limits, too"
    text = _against(value, result.bars.objective, bars)
    return f"{text} (which have {missed})" if missed else text


# -- `dolfinopt simulate` ------------------------------------------------------------------------


def simulate(
    world: MPI.Comm,
    scene: Path,
    design: Path | None,
    out: Path | None,
    overwrite: bool,
    overrides: Sequence[str],
    plots: bool,
    verbose: bool,
) -> None:
    """Simulate a scene with a given design, and tell what it does."""
    loaded = load(world, scene, overrides)
    tell_assumed(loaded)
    folder = out or Path("results") / f"{scene.stem}-simulation"
    claim(world, folder, overwrite, scene=loaded)
    profile = Profile()
    arms = arms_with_design(world, loaded, design, profile)
    with working_alone(world, folder, None if overwrite else partial(check_unused, folder)):
        result = run_folder.simulated(arms, profile)
        on_root(world, remove_stale, folder)
        _conclude(folder, result, plots, verbose)


# -- `dolfinopt gradient` ------------------------------------------------------------------------


def gradient(
    world: MPI.Comm,
    scene: Path,
    design: Path | None,
    kind: str | None,
    out: Path | None,
    check: bool,
    overwrite: bool,
    overrides: Sequence[str],
) -> None:
    """Write the gradient with respect to the physical densities to FILE."""
    out = out or Path("results") / f"{scene.stem}-gradient" / "gradient.npz"
    if out.is_dir():
        raise InputError(f"{out}: --out is a folder; name a file, e.g. {out / 'gradient.npz'}")
    if kind is not None:
        overrides = (*overrides, f'objective.gradient="{kind}"')
    loaded = load(world, scene, overrides)
    loaded.check_designed()
    claim(world, out.parent, overwrite, [out.name])
    if check:
        check_exact(loaded)
    profile = Profile()
    place = arms_with_design(world, loaded, design, profile)
    on_root(world, prepare_folder, out.parent)
    if needs(loaded, "motion"):
        tell(choose_coordinates(*place, profile))
    result, trajectory = evaluation.evaluate(*place, profile, simulated=False)
    by_cell = evaluation.gradient(*place[:3], trajectory, profile)
    write_gradient(out, *place[:3], by_cell, result.objective)
    name = loaded.objective.gradient if loaded.objective.has_esl_gradient else "exact"
    value = with_unit(f"{result.objective:.6g}", loaded.objective.response.unit)
    click.echo(f"objective {value}; {name} gradient in {out}")
    if check:
        _check_gradient(place, profile)


def _check_gradient(place: Designed, profile: Profile) -> None:
    """Print the Taylor test; raise ConvergenceError where a rate is too low."""
    test = taylor_test(Evaluator(*place[:3], profile), place.x_phys)
    steps = "".join(f"{f'h = {h:.2g}':>12}" for h in STEPS)
    click.echo(f"{'direction':<22}{'exact slope':>13}{'frozen':>13}{steps}{'rate':>7}")
    for row in test.rows:
        remainders = "".join(f"{r:12.2e}" for r in row.remainders)
        slopes = f"{row.slope:13.4e}{row.slope_frozen:13.4e}"
        click.echo(f"{row.direction:<22}{slopes}{remainders}{row.rate:7.2f}")
    if place.scene.objective.has_esl_gradient:
        click.echo(
            f"gradient with frozen loads: {test.angle:.1f} degrees from the exact one, "
            f"{test.ratio:.3f} times as long"
        )
    if not test.passed:
        raise ConvergenceError(
            f"the Taylor remainders fall at a rate below {PASSING_RATE}: the gradient is not exact "
            "here; repeat with a smaller simulation.tolerance to see whether the simulation is "
            "the cause"
        )


# -- `dolfinopt plot` ----------------------------------------------------------------------------


def plot(world: MPI.Comm, folder: Path, animation: bool) -> None:
    """Redraw the pictures of a finished run in DIR."""
    loaded, profile = on_root(world, scene_of, folder), Profile()
    arms = arms_with_design(world, loaded, folder / "design.npz", profile)
    result = run_folder.simulated(arms, profile)
    views, _ = run_folder.views_of(result)
    if result.trajectory is None:
        return
    history = folder / "history.csv"
    rows = read_history(history) if history.exists() else []
    initial = read_initial_deviation(folder / "trajectory.npz", result.trajectory.t)
    result = replace(result, rows=rows, initial_deviation=initial)
    draw(result, folder, views, animation=animation)
    click.echo(f"pictures in {folder}")
