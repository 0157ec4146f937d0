"""`dolfinopt simulate`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.options import (
    animation_option,
    design_option,
    out_option,
    overwrite_option,
    plots_option,
    scene_argument,
    set_option,
)
from dolfinopt.cli.shared import claim, conclude, design_of, draw, elapsed, load

if TYPE_CHECKING:
    from dolfinopt.output.views import ArmView


@click.command()
@scene_argument
@design_option
@out_option("the results; default: results/SCENE-simulation")
@overwrite_option
@set_option
@plots_option
@animation_option
def simulate(
    scene: Path,
    design: Path | None,
    out: Path | None,
    overwrite: bool,
    overrides: tuple[str, ...],
    plots: bool,
    animation: bool,
) -> None:
    """Simulate SCENE with a given design.

    Writes the trajectory, and prints compliance and deviation.
    """
    world, loaded = load(scene, overrides)
    folder = out or Path("results") / f"{scene.stem}-simulation"
    from dolfinopt.output.folders import check_unused, remove_stale, working_alone
    from dolfinopt.output.run_folder import Simulated, write_simulation
    from dolfinopt.parallel import on_root
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.evaluation import evaluate
    from dolfinopt.responses.order_selection import choose_coordinates

    claim(world, folder, overwrite, scene=loaded)
    profile = Profile()
    partition, arms, x_phys = design_of(world, loaded, design, profile)
    with working_alone(world, folder, None if overwrite else partial(check_unused, folder)):
        choice = choose_coordinates(loaded, partition, arms, x_phys, profile)
        evaluation, trajectory = evaluate(loaded, partition, arms, x_phys, profile)
        simulated = Simulated(
            loaded, partition, arms, x_phys, evaluation, trajectory, profile, choice
        )

        def pictures(views: list[ArmView]) -> None:
            assert trajectory is not None
            draw(folder, loaded, views, trajectory, [], None, animation=animation)

        drawn = pictures if plots or animation else None
        on_root(world, remove_stale, folder)
        written = write_simulation(folder, simulated, elapsed(), pictures=drawn)
    if written is not None:
        conclude(written.summary, folder)
