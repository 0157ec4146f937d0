"""`dolfinopt optimize`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.options import out_option, plots_option, scene_argument, set_option
from dolfinopt.cli.shared import BEGUN, conclude, draw, load, prepare, progress
from dolfinopt.scene import Scene

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.optimization import Result


@click.command()
@scene_argument
@out_option("the results; default: results/SCENE")
@click.option("--resume", is_flag=True, help="go on from the folder's checkpoint")
@set_option
@plots_option
@click.pass_obj
def optimize(
    world: MPI.Comm,
    scene: Path,
    out: Path | None,
    resume: bool,
    overrides: tuple[str, ...],
    plots: bool,
) -> None:
    """Optimise the arms of SCENE for the loads of their motion."""
    from dolfinopt import checkpoint
    from dolfinopt.optimization import optimize as run
    from dolfinopt.parallel import on_root

    loaded = load(world, scene, overrides)
    folder = out or Path("results") / scene.stem
    if resume:
        on_root(world, checkpoint.check, folder, loaded)
    prepare(world, folder)
    with progress(world, loaded) as report:
        result = run(loaded, folder, resume=resume, world=world, report=report)
    _write_result(loaded, folder, result, plots)


def _write_result(scene: Scene, folder: Path, result: Result, plots: bool) -> None:
    """Write everything an optimisation leaves behind (collective)."""
    from dolfinopt.results import write_result

    written = write_result(scene, folder, result, time.perf_counter() - BEGUN)
    if written is None or result.trajectory is None:
        return
    if plots:
        history, initial = result.history, result.initial_deviation
        draw(folder, scene, written.views, result.trajectory, history, initial)
    conclude(written.summary, folder)
