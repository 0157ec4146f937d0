"""`dolfinopt simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.options import (
    animation_option,
    design_option,
    out_option,
    plots_option,
    scene_argument,
    set_option,
)
from dolfinopt.cli.shared import conclude, design_of, draw, elapsed, load, prepare

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.files import ArmView


@click.command()
@scene_argument
@design_option
@out_option("the results; default: results/SCENE-simulation")
@set_option
@plots_option
@animation_option
@click.pass_obj
def simulate(
    world: MPI.Comm,
    scene: Path,
    design: Path | None,
    out: Path | None,
    overrides: tuple[str, ...],
    plots: bool,
    animation: bool,
) -> None:
    """Simulate SCENE with a given design and report compliance and deviation."""
    from dolfinopt.coordinates import choose_coordinates
    from dolfinopt.evaluation import evaluate
    from dolfinopt.ledger import Ledger
    from dolfinopt.results import Simulated, write_simulation

    loaded = load(world, scene, overrides)
    folder = out or Path("results") / f"{scene.stem}-simulation"
    ledger = Ledger()
    share, arms, x_phys = design_of(world, loaded, design, ledger)
    prepare(world, folder)
    choice = choose_coordinates(loaded, share, arms, x_phys, ledger)
    evaluation, trajectory = evaluate(loaded, share, arms, x_phys, ledger)
    simulated = Simulated(loaded, share, arms, x_phys, evaluation, trajectory, ledger, choice)

    def pictures(views: list[ArmView]) -> None:
        assert trajectory is not None
        draw(folder, loaded, views, trajectory, [], None, animation=animation)

    drawn = pictures if plots or animation else None
    written = write_simulation(folder, simulated, elapsed(), pictures=drawn)
    if written is None:
        return
    conclude(written.summary, folder)
