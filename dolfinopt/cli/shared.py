"""Steps that several commands share."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path

import click
from mpi4py import MPI

from dolfinopt.cli.begin import warn
from dolfinopt.errors import InputError
from dolfinopt.loading import doubts, load_scene
from dolfinopt.mesh.budget import check_budget
from dolfinopt.optimization.result import Result
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.output.design import ArmView, designed
from dolfinopt.output.folders import (
    CHECKPOINT,
    RUN_FILES,
    check_sources,
    check_unused,
    stale_parts,
)
from dolfinopt.parallel import on_root
from dolfinopt.progress import SlowWork
from dolfinopt.responses.order_selection import OrderSelection
from dolfinopt.scene.load import Scene, scene_from_dict
from dolfinopt.scene.messages import assumed
from dolfinopt.scene.schema import found_again


def load(world: MPI.Comm, path: Path, overrides: Sequence[str]) -> Scene:
    """Return the scene as the root read and checked it."""

    def load() -> Scene:
        scene = load_scene(path, overrides)
        warn(doubts(scene))
        if path.name == "part.toml" and (stale := stale_parts(path.parent)):
            warn([stale])
        return scene

    scene = on_root(world, load)
    check_budget(world, scene)
    return scene


def claim(
    world: MPI.Comm,
    folder: Path,
    overwrite: bool,
    names: Collection[str] = RUN_FILES,
    *,
    resume: str = "",
    scene: Scene | None = None,
) -> None:
    """Raise InputError if the folder holds results, unless they are to be overwritten.

    Or files that `scene` reads: these are not replaced even so.
    """
    if scene is not None:
        on_root(world, check_sources, folder, names, scene)
    if not overwrite:
        on_root(world, partial(check_unused, resume=resume), folder, names)


def scene_of(folder: Path, overrides: Sequence[str] = ()) -> Scene:
    """Return the scene of a run, with the coordinates and stiffening that it came to."""
    path = folder / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        data = found_again(summary["scene"], folder, summary.get("files", {}))
        reduction = summary.get("reduction", data["reduction"])
        data["reduction"]["coordinates"] = reduction["coordinates"]
        decided = summary.get("stiffening")
        if decided is not None and data["simulation"]["stiffening"] == "auto":
            data["simulation"]["stiffening"] = decided["on"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: cannot be read ({type(error).__name__}); {_instead(folder)}"
        ) from None
    return scene_from_dict(data, str(path), overrides)


def _instead(folder: Path) -> str:
    """Return what to do about a folder without the summary of a run."""
    if (folder / CHECKPOINT).exists():
        return (
            "this optimisation has not come to its end: go on with dolfinopt optimize SCENE --out "
            f"{folder} --resume"
        )
    if (folder / "cases").is_dir():
        return f"this is a study: name the folder of one of its cases, {folder / 'cases'}/..."
    return "name the folder of a finished optimize or simulate run"


def draw(result: Result, folder: Path, views: list[ArmView], *, animation: bool = False) -> None:
    """Draw all pictures of a run (root only); the animation where it is asked for."""
    from dolfinopt.plots.curves import (
        deviation_figure,
        drives_figure,
        history_figure,
        law_figure,
        limits_figure,
    )
    from dolfinopt.plots.design import design_figure, stress_figure
    from dolfinopt.plots.machine import draw_motion, machine_figure, make_film
    from dolfinopt.plots.style import save

    scene, trajectory = result.scene, result.trajectory
    assert trajectory is not None
    title, bodies = scene.name, trajectory.mechanism.arms
    if arms := designed(views):
        masses = {view.name: body.mass for view, body in zip(views, bodies, strict=True)}
        save(design_figure(arms, title, masses), folder / "design.png")
    if stressed := [view for view in views if view.stress is not None]:
        save(stress_figure(stressed, title), folder / "stress.png")
    save(machine_figure(views, trajectory, title), folder / "machine.png")
    if result.rows:
        save(history_figure(result), folder / "history.png")
        if (limits := limits_figure(result)) is not None:
            save(limits, folder / "limits.png")
    if not scene.is_pinned:
        save(deviation_figure(trajectory, result.initial_deviation), folder / "deviation.png")
    if trajectory.is_machine:
        save(drives_figure(trajectory), folder / "drives.png")
    if scene.motion.coefficients:
        save(law_figure(scene), folder / "law.png")
    if animation:
        draw_motion(folder / "motion.gif", views, make_film(trajectory))


def tell(choice: OrderSelection | None) -> None:
    if choice is not None:
        click.echo(chosen(choice.coordinates, choice.error))


def tell_assumed(scene: Scene) -> None:
    """Print in one line what the scene does not state and its results depend on."""
    if line := assumed(scene):
        click.echo(line)


def chosen(coordinates: int, error: float) -> str:
    return f"reduction: {coordinates} coordinates an arm, estimated error {error:.2g}"


# -- how far a command is: a line every few seconds ----------------------------------------------

Say = Callable[[str], None]


def progress(world: MPI.Comm, command: str) -> Say:
    """Return a function that takes what is being done, of which the root tells."""
    return SlowWork(command).tell if world.rank == 0 else lambda _: None


def in_words(row: HistoryRow, iterations: int) -> str:
    """Return a row of the history of a run of at most so many iterations."""
    return (
        f"{row.iteration}/{iterations} objective {row.objective:.4g} "
        f"dev {1e3 * row.max_deviation:.3g} mm gray {row.grayness:.3f} "
        f"vol {row.volume_fraction:.4f} change {row.change:.4f}"
        + (f", {row.tightest}" if row.tightest else "")
    )
