"""`dolfinopt optimize`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.options import (
    animation_option,
    out_option,
    overwrite_option,
    plots_option,
    scene_argument,
    set_option,
)
from dolfinopt.cli.shared import claim, conclude, draw, elapsed, load, progress
from dolfinopt.errors import ConvergenceError, InputError

if TYPE_CHECKING:
    from dolfinopt.optimization.result import Result
    from dolfinopt.output.views import ArmView
    from dolfinopt.scene.load import Scene


@click.command()
@scene_argument
@out_option("the results; default: results/SCENE")
@click.option("--resume", is_flag=True, help="continue from the checkpoint in DIR")
@overwrite_option
@set_option
@plots_option
@animation_option
def optimize(
    scene: Path,
    out: Path | None,
    resume: bool,
    overwrite: bool,
    overrides: tuple[str, ...],
    plots: bool,
    animation: bool,
) -> None:
    """Optimise the arms of SCENE for the loads of their motion."""
    if resume and overwrite:
        raise InputError("--resume, --overwrite: expected only one of them")
    world, loaded = load(scene, overrides)
    folder = out or Path("results") / scene.stem
    from dolfinopt.output import checkpoint
    from dolfinopt.output.folders import working_alone
    from dolfinopt.output.run import optimize as run
    from dolfinopt.parallel import on_root

    if resume:
        on_root(world, checkpoint.check, folder, loaded)
    else:
        claim(world, folder, overwrite, resume=True, scene=loaded)
    with working_alone(world, folder):  # until all files of the run are written
        try:
            with progress(world, loaded) as report:
                result = run(
                    loaded, folder, resume=resume, overwrite=overwrite, world=world, report=report
                )
        except KeyboardInterrupt:
            instead = " in place of --overwrite" if overwrite else ""
            raise KeyboardInterrupt(f"to go on, add --resume{instead}") from None
        _write_result(loaded, folder, result, plots, animation)


def _write_result(scene: Scene, folder: Path, result: Result, plots: bool, animation: bool) -> None:
    """Write everything an optimisation leaves behind (collective).

    Raises:
        ConvergenceError: the design does not meet a constraint; everything is written.
    """
    from dolfinopt.output.run_folder import write_result

    def pictures(views: list[ArmView]) -> None:
        assert result.trajectory is not None
        history, initial = result.history, result.initial_deviation
        draw(folder, scene, views, result.trajectory, history, initial, animation=animation)

    drawn = pictures if plots or animation else None
    written = write_result(scene, folder, result, elapsed(), pictures=drawn)
    if written is not None:
        conclude(written.summary, folder)
        if not scene.is_spatial:  # parts are outlines of plane arms
            click.echo(_next(scene, folder, written.summary["grayness"]))
    if result.violated:  # known to all ranks
        raise ConvergenceError(f"the design is not feasible: {result.violated}")


def _next(scene: Scene, folder: Path, grayness: float) -> str:
    """Return how to go on from a design."""
    from dolfinopt.part.part import GRAY

    if scene.design.projection or grayness <= GRAY:
        return f"parts for the workshop: dolfinopt part {folder}"
    return (
        f"no design for the workshop: with a grayness of {grayness:.2g} parts would be another "
        'design; optimise with design.projection = "robust", then dolfinopt part'
    )
