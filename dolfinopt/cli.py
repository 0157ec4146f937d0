"""The `dolfinopt` command: parse, call, exit code."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt import __version__
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.scene import Scene, load_scene, scene_from_dict

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.arm import Arm
    from dolfinopt.coordinates import Choice
    from dolfinopt.files import ArmView, HistoryRow
    from dolfinopt.optimization import Result
    from dolfinopt.parallel import ArmShare
    from dolfinopt.simulation import Trajectory

UNITS = {
    "esl": "N m",
    "compliance": "N m s",
    "deviation": "m",
    "static": "N m",
    "eigenfrequency": "s2",
}
BEGUN = time.perf_counter()


def main() -> None:
    """Run the command line on every rank and exit: 0, 1 (failed), 2 (bad input)."""
    import petsc4py

    # PETSc would turn a closed pipe or Ctrl-C into an abort with a page of advice.
    petsc4py.init(["dolfinopt", "-no_signal_handler"])
    from mpi4py import MPI

    from dolfinopt.parallel import one_ending

    world = MPI.COMM_WORLD
    with one_ending(world):
        try:
            commands.main(
                args=sys.argv[1:], prog_name="dolfinopt", standalone_mode=False, obj=world
            )
        except click.ClickException as error:
            raise InputError(f"{error.format_message()} (see dolfinopt --help)") from None
        except click.Abort:
            raise KeyboardInterrupt from None


class _Quiet(click.Group):
    """A group whose help is printed by the root alone."""

    def main(self, *args: Any, **kwargs: Any) -> Any:  # type: ignore[override]
        world: MPI.Comm = kwargs["obj"]
        silent = nullcontext() if world.rank == 0 else _no_output()
        with silent:
            return super().main(*args, **kwargs)


def _no_output() -> AbstractContextManager[Any]:
    from contextlib import redirect_stdout
    from io import StringIO

    return redirect_stdout(StringIO())


@click.group(cls=_Quiet, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="dolfinopt")
def commands() -> None:
    """Stiffen the flexible arms of a moving machine by topology optimisation.

    Every command also runs under mpirun, with the same result.
    """


scene_argument = click.argument("scene", type=click.Path(path_type=Path))
set_option = click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="override a scene value"
)
design_option = click.option(
    "--design", type=click.Path(path_type=Path), help="design.npz; default: the initial design"
)
plots_option = click.option("--plots/--no-plots", default=True, help="draw pictures")


def out_option(what: str) -> Callable[..., Any]:
    """Return the --out option of a command that writes a folder."""
    return click.option(
        "--out", type=click.Path(path_type=Path), metavar="DIR", help=f"folder for {what}"
    )


@commands.command()
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

    loaded = _load(world, scene, overrides)
    folder = out or Path("results") / scene.stem
    if resume:
        on_root(world, checkpoint.check, folder, loaded)
    _prepare(world, folder)
    with _progress(world, loaded) as report:
        result = run(loaded, folder, resume=resume, world=world, report=report)
    _write_result(loaded, folder, result, plots)


@commands.command()
@scene_argument
@design_option
@out_option("the results; default: results/SCENE-simulation")
@set_option
@plots_option
@click.pass_obj
def simulate(
    world: MPI.Comm,
    scene: Path,
    design: Path | None,
    out: Path | None,
    overrides: tuple[str, ...],
    plots: bool,
) -> None:
    """Simulate SCENE with a given design and report compliance and deviation."""
    from dolfinopt.coordinates import choose_coordinates
    from dolfinopt.evaluation import evaluate
    from dolfinopt.ledger import Ledger
    from dolfinopt.results import Simulated, write_simulation

    loaded = _load(world, scene, overrides)
    folder = out or Path("results") / f"{scene.stem}-simulation"
    ledger = Ledger()
    share, arms, x_phys = _design(world, loaded, design, ledger)
    _prepare(world, folder)
    choice = choose_coordinates(loaded, share, arms, x_phys, ledger)
    evaluation, trajectory = evaluate(loaded, share, arms, x_phys, ledger)
    simulated = Simulated(loaded, share, arms, x_phys, evaluation, trajectory, ledger, choice)
    written = write_simulation(folder, simulated, time.perf_counter() - BEGUN)
    if written is None or trajectory is None:
        return
    if plots:
        _draw(folder, loaded, written.views, trajectory, [], None)
    _conclude(written.summary, folder)


@commands.command()
@scene_argument
@design_option
@click.option("--kind", type=click.Choice(["esl", "exact"]), default="esl", help="which gradient")
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, metavar="FILE", help="gradient.npz"
)
@click.option("--check", is_flag=True, help="Taylor test along the complete chain")
@set_option
@click.pass_obj
def gradient(
    world: MPI.Comm,
    scene: Path,
    design: Path | None,
    kind: str,
    out: Path,
    check: bool,
    overrides: tuple[str, ...],
) -> None:
    """Write the objective's gradient with respect to the physical densities to FILE."""
    from dolfinopt.coordinates import choose_coordinates
    from dolfinopt.evaluation import evaluate
    from dolfinopt.evaluation import gradient as slopes
    from dolfinopt.files import write_gradient
    from dolfinopt.ledger import Ledger
    from dolfinopt.taylor import check_exact

    if out.is_dir():
        raise InputError(f"{out}: --out is a folder; name a file, e.g. {out / 'gradient.npz'}")
    loaded = _load(world, scene, (*overrides, f'objective.gradient="{kind}"'))
    if check:
        check_exact(loaded)
    ledger = Ledger()
    share, arms, x_phys = _design(world, loaded, design, ledger)
    _prepare(world, out.parent)
    if loaded.objective.simulated:
        _tell(world, choose_coordinates(loaded, share, arms, x_phys, ledger))
    evaluation, trajectory = evaluate(loaded, share, arms, x_phys, ledger, simulated=False)
    by_cell = slopes(loaded, share, arms, trajectory, ledger)
    write_gradient(out, loaded, share, arms, by_cell, evaluation.objective)
    if world.rank == 0:
        unit = UNITS[loaded.objective.kind]
        name = kind if loaded.objective.simulated else "exact"
        click.echo(f"objective {evaluation.objective:.6g} {unit}; {name} gradient in {out}")
    if check:
        _check_gradient(world, loaded, share, arms, x_phys, ledger)


# -- export ----------------------------------------------------------------------------------


@commands.command()
@scene_argument
@design_option
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    metavar="DIR",
    help="folder for the bodies",
)
@set_option
@click.pass_obj
def export(
    world: MPI.Comm, scene: Path, design: Path | None, out: Path, overrides: tuple[str, ...]
) -> None:
    """Write the reduced arms of SCENE for other multibody codes: SID, .npz of it, MBDyn's .fem."""
    from dolfinopt.coordinates import choose_coordinates
    from dolfinopt.files import write_arrays, write_text
    from dolfinopt.ledger import Ledger
    from dolfinopt.mbdyn import fem_text
    from dolfinopt.parallel import gather_arms
    from dolfinopt.sid import sid_arrays, sid_text

    loaded = _load(world, scene, overrides)
    share, arms, x_phys = _design(world, loaded, design, Ledger())
    _prepare(world, out)
    _tell(world, choose_coordinates(loaded, share, arms, x_phys, Ledger()))
    exported = {k: _exported(arm, loaded.arms[k].thickness, x_phys[k]) for k, arm in arms.items()}
    bodies = gather_arms(share, exported)
    if world.rank != 0:
        return
    for arm, owner in zip(loaded.arms, loaded.owners, strict=True):
        if owner is None:
            click.echo(f"{arm.name}: not exported, it is rigid or comes from a file")
            continue
        data, element = bodies[owner]
        write_text(out / f"{arm.name}.sid", sid_text(data))
        write_arrays(out / f"{arm.name}.sid.npz", sid_arrays(data))
        write_text(out / f"{arm.name}.fem", fem_text(element))
        click.echo(
            f"{arm.name}: {data.mass:.6g} kg, {data.coordinates} coordinates, "
            f"{len(element.labels)} nodes; in {out / arm.name}.sid, .sid.npz, .fem"
        )


def _exported(arm: Arm, thickness: float, x_phys: Any) -> Any:
    """Return an arm's SID and MBDyn element on the first of its ranks (collective there)."""
    from dolfinopt.mbdyn import lumped_nodes, modal_element
    from dolfinopt.standard_input import spatial_moments, to_sid

    body = arm.reduce(x_phys)
    assert arm.basis is not None
    moments = spatial_moments(arm.elastic, arm.basis, thickness)
    nodes = lumped_nodes(arm.elastic, arm.basis)
    if nodes is None:
        return None
    title = f"{arm.mesh.name} of {arm.scene.name}"
    return to_sid(body, moments, comment=title), modal_element(body, moments, nodes, thickness)


# -- study -----------------------------------------------------------------------------------


class _Listing(click.Command):
    """A command whose --designs takes all words up to the next option."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put --designs before every one of them."""
        spread: list[str] = []
        listing = False
        for word in args:
            if word == "--designs":
                listing = True
                continue
            listing = listing and not word.startswith("-")
            spread += ["--designs", word] if listing else [word]
        return super().parse_args(ctx, spread)


@commands.command(cls=_Listing)
@scene_argument
@click.argument(
    "topic",
    required=False,
    type=click.Choice(["payload", "flattening", "coordinates", "objective", "reduction"]),
)
@click.option(
    "--vary",
    multiple=True,
    metavar="KEY=VALUES",
    help="a scene value and start:stop:count or a,b,c; two make a grid",
)
@click.option(
    "--designs",
    multiple=True,
    metavar="FILE ...",
    type=click.Path(path_type=Path),
    help="design.npz files; default: the initial and the optimised design",
)
@click.option("--reoptimize", is_flag=True, help="optimise a design for every value, too")
@click.option(
    "--random",
    multiple=True,
    metavar="KEY=LAW",
    help="a scene value's distribution: normal:MEAN:DEVIATION, uniform:LOW:HIGH, "
    "triangular:LOW:MODE:HIGH or lognormal:MEDIAN:SIGMA; several are independent",
)
@click.option("--samples", type=int, help="of the random values; default: 1000")
@click.option("--seed", type=int, help="of the samples; default: 1")
@click.option(
    "--sampler",
    type=click.Choice(["sobol", "latin-hypercube"]),
    help="how they fill the space; default: sobol",
)
@click.option(
    "--indices",
    type=click.Choice(["polynomial", "saltelli"]),
    help="Sobol' indices of a polynomial fitted to the samples (default), or of more simulations",
)
@out_option("tables, pictures and cases; default: results/SCENE-study")
@set_option
@plots_option
@click.pass_obj
def study(
    world: MPI.Comm,
    scene: Path,
    topic: Any,
    vary: tuple[str, ...],
    designs: tuple[Path, ...],
    reoptimize: bool,
    random: tuple[str, ...],
    samples: int | None,
    seed: int | None,
    sampler: Any,
    indices: Any,
    out: Path | None,
    overrides: tuple[str, ...],
    plots: bool,
) -> None:
    """Vary what SCENE rests on: tables and curves of what its designs then do.

    Without TOPIC whatever --vary names, or --random scatters. What is computed is kept in DIR and
    taken from there the next time; a study that was interrupted goes on.
    """
    from dolfinopt.findings import write_study
    from dolfinopt.study import study as run

    options = {"samples": samples, "seed": seed, "sampler": sampler, "indices": indices}
    given = {name: value for name, value in options.items() if value is not None}
    _check_random(bool(random), bool(topic or vary or reoptimize), given)
    loaded = _load(world, scene, overrides)
    folder = out or Path("results") / f"{scene.stem}-study"
    if random:
        from dolfinopt.random_study import Plan, study_random

        done = study_random(loaded, random, designs, folder, world, Plan(**given))
    else:
        done = run(loaded, topic, vary, designs, folder, world, reoptimize=reoptimize)
    if world.rank == 0:
        write_study(done, folder)
        if plots:
            from dolfinopt.study_plots import draw_study

            draw_study(done, folder)
        click.echo(done.markdown())
        click.echo(f"{done.computed} cases computed; tables and pictures in {folder}")
    if done.failures:
        more = f" (and {len(done.failures) - 1} more)" if len(done.failures) > 1 else ""
        raise ConvergenceError(f"{done.failures[0]}{more}")


def _check_random(random: bool, others: bool, options: Mapping[str, Any]) -> None:
    """Raise InputError unless the options of a study go together."""
    if random and others:
        raise InputError("--random: a study of its own, without topic, --vary and --reoptimize")
    if options and not random:
        raise InputError(f"--{next(iter(options))}: expected only with --random")


@commands.command()
@out_option("figures, report.html and cases; default: results/paper")
@click.option("--check", is_flag=True, help="end with status 1 where a main finding fails")
@click.option("--coarse", is_flag=True, help="100 x 6 cells and 60 iterations: a minute")
@set_option
@plots_option
@click.pass_obj
def reproduce(
    world: MPI.Comm,
    out: Path | None,
    check: bool,
    coarse: bool,
    overrides: tuple[str, ...],
    plots: bool,
) -> None:
    """Recreate figures 3 to 15 of the paper, and a page that compares the findings.

    What is computed is kept in DIR/cases and taken from there the next time; a call that was
    interrupted goes on.
    """
    from dolfinopt.claims import broken
    from dolfinopt.paper import Plan, load_paper
    from dolfinopt.paper import reproduce as run
    from dolfinopt.parallel import on_root
    from dolfinopt.report import write_reproduction

    folder = out or Path("results") / "paper"
    done = run(Plan(on_root(world, load_paper, coarse, overrides)), folder, world)
    if world.rank == 0:
        write_reproduction(done, folder, plots=plots)
        for finding in done.findings:
            click.echo(f"{finding.name} (paper: {finding.paper}). {finding.sentence}")
        page = " and report.html" if plots else ""
        click.echo(f"{done.outcomes.computed} cases computed; figures{page} in {folder}")
    failures = [f"{o.case.label}: {o.failure}" for o in done.outcomes.failures]
    wrong = [*failures, *(broken(done.findings) if check else ())]
    if wrong:
        raise ConvergenceError("; ".join(wrong))


@commands.command()
@out_option("diagrams and bench.md; default: results/bench")
@click.option("--quick", is_flag=True, help="coarse meshes, fewer points: some two minutes")
@click.pass_obj
def bench(world: MPI.Comm, out: Path | None, quick: bool) -> None:
    """Measure run time against error: integrators, meshes, reductions, iterations, other programs.

    What is measured is kept in DIR; a call that was interrupted goes on.
    """
    if world.size > 1:
        raise InputError("bench: starts its ranks itself; call it without mpirun")
    from dolfinopt.bench import QUICKLY, Plan, diagrams
    from dolfinopt.bench import bench as run
    from dolfinopt.bench.progress import live_diagrams
    from dolfinopt.paper import load_paper

    begun = time.perf_counter()
    folder = out or Path("results") / "bench"
    _prepare(world, folder)
    scene = load_paper(False, QUICKLY if quick else ())
    with live_diagrams(len(diagrams())) as (tell, done):
        summary = run(Plan(scene, quick), folder, tell, done=done)
    seconds = time.perf_counter() - begun
    click.echo(f"diagrams in {folder}, summary in {summary}; {seconds:.0f} s")


@commands.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.pass_obj
def plot(world: MPI.Comm, folder: Path) -> None:
    """Draw the pictures of a finished run in DIR anew."""
    from dolfinopt.evaluation import evaluate
    from dolfinopt.files import gather_views, read_history, read_initial_deviation
    from dolfinopt.ledger import Ledger
    from dolfinopt.parallel import on_root

    loaded = on_root(world, _scene_of, folder)
    ledger = Ledger()
    share, arms, x_phys = _design(world, loaded, folder / "design.npz", ledger)
    _, trajectory = evaluate(loaded, share, arms, x_phys, ledger)
    views = gather_views(loaded, share, arms, x_phys)
    if trajectory is None:
        return
    history = read_history(folder / "history.csv") if (folder / "history.csv").exists() else []
    initial = read_initial_deviation(folder / "trajectory.npz")
    _draw(folder, loaded, views, trajectory, history, initial)
    click.echo(f"pictures in {folder}")


def _check_gradient(
    world: MPI.Comm,
    scene: Scene,
    share: ArmShare,
    arms: Mapping[int, Arm],
    x: Mapping[int, Any],
    ledger: Any,
) -> None:
    """Print the Taylor test; raise ConvergenceError where a rate is too low."""
    from dolfinopt.taylor import PASSES, STEPS, taylor_test

    test = taylor_test(scene, share, arms, x, ledger)
    if world.rank == 0:
        steps = "".join(f"{f'h = {h:.2g}':>12}" for h in STEPS)
        click.echo(f"{'direction':<22}{'exact slope':>13}{'frozen':>13}{steps}{'rate':>7}")
        for row in test.rows:
            remainders = "".join(f"{r:12.2e}" for r in row.remainders)
            slopes = f"{row.slope:13.4e}{row.slope_frozen:13.4e}"
            click.echo(f"{row.direction:<22}{slopes}{remainders}{row.rate:7.2f}")
        if scene.objective.simulated:
            click.echo(
                f"gradient with frozen loads: {test.angle:.1f} degrees from the exact one, "
                f"{test.ratio:.3f} times as long"
            )
    if not test.passed:
        raise ConvergenceError(
            f"the remainders fall at a rate below {PASSES}: the gradient is not exact here; a "
            "tighter simulation.tolerance tells whether the simulation is to blame"
        )


# -- steps the commands share ----------------------------------------------------------------


def _load(world: MPI.Comm, path: Path, overrides: tuple[str, ...]) -> Scene:
    """Read the scene on the root, check what can be checked, and hand it to all ranks."""
    from dolfinopt.parallel import on_root

    def load() -> Scene:
        from dolfinopt.motion import check_motion

        scene = load_scene(path, overrides)
        check_motion(scene)
        for index, arm in enumerate(scene.arms):
            if arm.sid is not None:
                from dolfinopt.arm import fixed_body

                fixed_body(scene, index)
        return scene

    return on_root(world, load)


def _prepare(world: MPI.Comm, folder: Path) -> None:
    from dolfinopt.files import prepare_folder
    from dolfinopt.parallel import on_root

    on_root(world, prepare_folder, folder)


def _scene_of(folder: Path) -> Scene:
    """Return the scene of a run, with the coordinates that "auto" came to."""
    path = folder / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        data = summary["scene"]
        if data["reduction"]["coordinates"] == "auto":
            data["reduction"]["coordinates"] = summary["reduction"]["coordinates"]
            del data["reduction"]["tolerance"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: cannot be read ({type(error).__name__}); name the folder of a finished "
            "optimize or simulate run"
        ) from None
    return scene_from_dict(data, source=str(path))


def _design(
    world: MPI.Comm, scene: Scene, design: Path | None, ledger: Any
) -> tuple[ArmShare, dict[int, Arm], dict[int, Any]]:
    """Build the arms and return them with the physical densities of a file or the initial ones."""
    from dolfinopt.arm import build_arms
    from dolfinopt.files import read_design
    from dolfinopt.parallel import share_arms

    share = share_arms(world, scene.cell_counts)
    arms = build_arms(scene, share, ledger)
    if design is not None:
        return share, arms, read_design(design, share, arms)
    return share, arms, {k: arm.uniform(scene.design.initial) for k, arm in arms.items()}


def _write_result(scene: Scene, folder: Path, result: Result, plots: bool) -> None:
    """Write everything an optimisation leaves behind (collective)."""
    from dolfinopt.results import write_result

    written = write_result(scene, folder, result, time.perf_counter() - BEGUN)
    if written is None or result.trajectory is None:
        return
    if plots:
        history, initial = result.history, result.initial_deviation
        _draw(folder, scene, written.views, result.trajectory, history, initial)
    _conclude(written.summary, folder)


def _draw(
    folder: Path,
    scene: Scene,
    views: list[ArmView],
    trajectory: Trajectory,
    history: list[HistoryRow],
    initial: Any,
) -> None:
    """Draw all pictures of a run (root only)."""
    from dolfinopt import plots
    from dolfinopt.files import designed

    labels = {
        "esl": "compliance of the load cases [N m]",
        "compliance": "integral of the compliance [N m s]",
        "deviation": "p-mean of the deviation [m]",
        "static": "compliance under static loads [N m]",
        "eigenfrequency": "squared longest periods [s2]",
    }
    plots.draw_design(folder / "design.png", designed(views), scene.name)
    if history:
        plots.draw_history(folder / "history.png", history, labels[scene.objective.kind])
    plots.draw_deviation(folder / "deviation.png", trajectory.t, trajectory.deviation, initial)
    plots.draw_motion(
        folder / "motion.gif",
        views,
        trajectory.mechanism,
        trajectory.t,
        trajectory.q_r,
        trajectory.q_e,
    )


def _conclude(summary: Mapping[str, Any], folder: Path) -> None:
    """Print the run's warnings, and its figures in one line."""
    for warning in summary["warnings"]:
        click.echo(f"dolfinopt: warning: {warning}", err=True)
    found = summary["reduction"]
    if found["error_estimate"] is not None:
        click.echo(_chosen(found["coordinates"], found["error_estimate"]))
    click.echo(
        f"{summary['name']}: {summary['iterations']} iterations ({summary['stop_reason']}), "
        f"compliance {summary['compliance']:.4g} N m, "
        f"maximal deviation {1e3 * summary['max_deviation']:.4g} mm "
        f"at {summary['max_deviation_time']:.3f} s, "
        f"grayness {summary['grayness']:.3f}, {summary['seconds']['total']:.1f} s; results in "
        f"{folder}"
    )


def _tell(world: MPI.Comm, choice: Choice | None) -> None:
    if choice is not None and world.rank == 0:
        click.echo(_chosen(choice.coordinates, choice.error))


def _chosen(coordinates: int, error: float) -> str:
    return (
        f'reduction.coordinates = "auto": {coordinates} coordinates an arm, estimated error '
        f"{error:.2g}"
    )


def _progress(
    world: MPI.Comm, scene: Scene
) -> AbstractContextManager[Callable[[HistoryRow], None] | None]:
    """Return a live line an iteration on the root's terminal, nothing elsewhere."""
    if world.rank != 0 or not sys.stderr.isatty():
        return nullcontext(None)
    from dolfinopt.progress import live_line

    return live_line(scene.optimizer.max_iterations)
