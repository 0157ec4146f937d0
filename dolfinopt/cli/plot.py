"""`dolfinopt plot`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.options import PATH, animation_option
from dolfinopt.cli.shared import design_of, draw, scene_of
from dolfinopt.cli.start import start

if TYPE_CHECKING:
    pass


@click.command()
@click.argument("folder", metavar="DIR", type=PATH)
@animation_option
def plot(folder: Path, animation: bool) -> None:
    """Redraw the pictures of a finished run in DIR."""
    world = start()
    from dolfinopt.output.history import read_history
    from dolfinopt.output.trajectory import read_initial_deviation
    from dolfinopt.output.views import gather_views
    from dolfinopt.parallel import on_root
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.evaluation import evaluate
    from dolfinopt.responses.stress_report import stress_report

    loaded = on_root(world, scene_of, folder)
    profile = Profile()
    partition, arms, x_phys = design_of(world, loaded, folder / "design.npz", profile)
    _, trajectory = evaluate(loaded, partition, arms, x_phys, profile)
    stress = stress_report(partition, arms, trajectory, profile)
    views = gather_views(loaded, partition, arms, x_phys, stress)
    if trajectory is None:
        return
    history = read_history(folder / "history.csv") if (folder / "history.csv").exists() else []
    initial = read_initial_deviation(folder / "trajectory.npz", trajectory.t)
    draw(folder, loaded, views, trajectory, history, initial, animation=animation)
    click.echo(f"pictures in {folder}")
