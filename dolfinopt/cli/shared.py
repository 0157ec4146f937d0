"""Steps that several commands share."""

from __future__ import annotations

import json
import sys
import time
import traceback
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import ExitStack, redirect_stdout
from functools import partial
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from dolfinopt.data import tables_of
from dolfinopt.errors import ConvergenceError, InputError, MissingLibrary, line_of
from dolfinopt.interrupt import (
    INTERRUPTED,
    end_at_once,
    end_with_launcher,
    launched_rank,
    raise_again,
)
from dolfinopt.output.folders import (
    CHECKPOINT,
    RUN_FILES,
    check_sources,
    check_unused,
    prepare_folder,
    stale_parts,
)
from dolfinopt.progress import SlowWork, show_slow_work
from dolfinopt.scene.load import Scene, read_scene, scene_from_dict
from dolfinopt.scene.messages import assumed
from dolfinopt.scene.schema import found_again

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.optimization.result import Result
    from dolfinopt.optimization.state import HistoryRow
    from dolfinopt.output.design import ArmView
    from dolfinopt.responses.order_selection import OrderSelection


def load(path: Path, overrides: tuple[str, ...]) -> tuple[MPI.Comm, Scene]:
    """Start MPI; return all ranks, and the scene as the root read and checked it.

    A process alone finds a wrong key before MPI and the solvers are loaded.
    """

    if launched_rank() is None:
        read_scene(path, overrides)
    world = start()
    # On all ranks: DOLFINx ends PETSc together with the others that have imported it.
    from dolfinopt.loading import doubts, load_scene
    from dolfinopt.parallel import on_root

    def load() -> Scene:
        scene = load_scene(path, overrides)
        warn(doubts(scene))
        if path.name == "part.toml" and (stale := stale_parts(path.parent)):
            warn([stale])
        return scene

    from dolfinopt.mesh.budget import check_budget

    scene = on_root(world, load)
    check_budget(world, scene)
    return world, scene


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
    from dolfinopt.parallel import on_root

    if scene is not None:
        on_root(world, check_sources, folder, names, scene)
    if not overwrite:
        on_root(world, partial(check_unused, resume=resume), folder, names)


_told: set[str] = set()


def warn(warnings: Iterable[str]) -> None:
    """Print the warnings that this command has not told yet."""
    for warning in warnings:
        if warning not in _told:
            _told.add(warning)
            click.echo(f"dolfinopt: warning: {warning}", err=True)


def prepare(world: MPI.Comm, folder: Path) -> None:
    from dolfinopt.parallel import on_root

    on_root(world, prepare_folder, folder)


def scene_of(folder: Path, overrides: tuple[str, ...] = ()) -> Scene:
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
    from dolfinopt.output.design import designed
    from dolfinopt.plots.curves import (
        deviation_of,
        drives_figure,
        history_of,
        law_figure,
        limits_figure,
    )
    from dolfinopt.plots.design import design_figure, stress_figure
    from dolfinopt.plots.machine import draw_motion, machine_figure, make_film
    from dolfinopt.plots.style import save

    scene, trajectory, history = result.scene, result.trajectory, result.rows
    assert trajectory is not None
    title, bodies = scene.name, trajectory.mechanism.arms
    if arms := designed(views):
        masses = {view.name: body.mass for view, body in zip(views, bodies, strict=True)}
        save(design_figure(arms, title, masses), folder / "design.png")
    if stressed := [view for view in views if view.stress is not None]:
        save(stress_figure(stressed, title), folder / "stress.png")
    save(machine_figure(views, trajectory, title), folder / "machine.png")
    if history:
        save(history_of(scene, history), folder / "history.png")
        if (limits := limits_figure(scene, history)) is not None:
            save(limits, folder / "limits.png")
    if not scene.is_pinned:
        save(deviation_of(trajectory, result.initial_deviation), folder / "deviation.png")
    if trajectory.is_machine:
        save(drives_figure(trajectory), folder / "drives.png")
    if scene.motion.coefficients:
        save(law_figure(scene), folder / "law.png")
    if animation:
        draw_motion(folder / "motion.gif", views, make_film(trajectory))


def tell(world: MPI.Comm, choice: OrderSelection | None) -> None:
    if choice is not None and world.rank == 0:
        click.echo(chosen(choice.coordinates, choice.error))


def tell_assumed(world: MPI.Comm, scene: Scene) -> None:
    """Print in one line what the scene does not state and its results depend on."""

    if world.rank == 0 and (line := assumed(scene)):
        click.echo(line)


def chosen(coordinates: int, error: float) -> str:
    return f"reduction: {coordinates} coordinates an arm, estimated error {error:.2g}"


BEGUN = time.perf_counter()


def elapsed() -> float:
    """Return the seconds since the command line began."""
    return time.perf_counter() - BEGUN


# -- options ---------------------------------------------------------------------------------


class GivenPath(click.Path):
    """A path that is not empty: `--out ""` would be the current folder."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("expected a path, found nothing", param, ctx)
        return super().convert(value, param, ctx)


PATH = GivenPath()
scene_argument = click.argument("scene", type=PATH)
OPTIONS = tables_of("cli/options.toml")
TYPES = {
    "path": PATH,
    "folder": click.Path(exists=True, file_okay=False),
    "float": float,
    "int": int,
    "positive": click.FloatRange(min=0.0, min_open=True),
}
Command = TypeVar("Command", bound=Callable[..., Any])


def options(command: str) -> Callable[[Command], Command]:
    """Give a command the options that options.toml lists for it, in that order."""

    def decorate(function: Command) -> Command:
        for name, entry in reversed(OPTIONS[command].items()):
            function = _option(name, **OPTIONS["shared"].get(name, {}) | entry)(function)
        return function

    return decorate


def _option(
    name: str,
    option: str = "",
    type: str = "",
    choices: Sequence[str] = (),
    least: int | None = None,
    usual: bool | None = None,
    **rules: Any,
) -> Callable[[Command], Command]:
    """Return the option of a parameter, see options.toml; `rules` are those of click."""
    if usual is not None:
        rules["default"] = partial(_given_before, name, usual)
    elif "/" in option:
        rules.setdefault("default", None)  # neither of both
    kind: Any = click.Choice(choices) if choices else TYPES.get(type)
    kind = kind if least is None else click.IntRange(least)
    return click.option(option or f"--{name.replace('_', '-')}", name, type=kind, **rules)


def _given_before(name: str, usual: bool) -> bool:
    """Return what an option before the command says, `dolfinopt --no-plots optimize SCENE`."""
    return bool(click.get_current_context().find_root().params.get(name, usual))


# -- when MPI and PETSc are loaded: by a command that has something to compute, not before -------
#
# Whatever can be answered from the words alone (help, completion, a wrong word) is answered without
# them. A launcher's ranks then know one another only by the environment.

NEEDED = ("petsc4py", "slepc4py", "mpi4py", "dolfinx", "gmsh")


class Start:
    """Loads MPI when a command asks for the ranks; from then on all ranks end together."""

    def __init__(self) -> None:
        self._ending = ExitStack()
        self._world: MPI.Comm | None = None

    def __enter__(self) -> Start:
        if launched_rank():
            self._ending.enter_context(redirect_stdout(StringIO()))  # the root speaks
        return self

    def __exit__(self, *error: object) -> bool | None:
        return self._ending.__exit__(*error)  # type: ignore[arg-type]

    @property
    def world(self) -> MPI.Comm:
        """All ranks; the first access starts MPI (collective)."""
        if self._world is None:
            missing = [name for name in NEEDED if find_spec(name) is None]
            if missing:
                raise MissingLibrary(
                    f"{', '.join(missing)} not installed; on Debian 12 or 13 run ./dolfinopt.sh, "
                    "elsewhere: conda install -c conda-forge fenics-dolfinx slepc4py python-gmsh"
                )
            end_with_launcher()
            import petsc4py

            # PETSc would turn a closed pipe or Ctrl-C into an abort with a page of advice.
            petsc4py.init(["dolfinopt", "-no_signal_handler"])
            from mpi4py import MPI

            from dolfinopt.parallel import abort_together

            self._world = MPI.COMM_WORLD
            show_slow_work()
            if raise_again():
                self._ending.callback(end_at_once)
            self._ending.enter_context(abort_together(self._world))
            if self._world.rank > 0:
                self._ending.enter_context(redirect_stdout(StringIO()))
        return self._world


def start() -> MPI.Comm:
    """Return all ranks for the command at work, and start MPI unless that was done."""
    given = click.get_current_context().obj
    return given.world if isinstance(given, Start) else given


def end_before_start(error: BaseException) -> int:
    """Report an error that came before MPI was started; return the exit status.

    What all ranks found wrong alike is printed by the first one. The others end with status 0: a
    launcher kills all ranks as soon as one fails, which could be before the first has spoken.
    """
    told_by_another = (launched_rank() or 0) > 0
    if isinstance(error, InputError | ConvergenceError | KeyboardInterrupt) and told_by_another:
        return 0
    if line := line_of(error):
        print(line, file=sys.stderr)
    else:
        traceback.print_exception(error)
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    return 2 if isinstance(error, InputError) else 1


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
