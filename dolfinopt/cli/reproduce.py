"""`dolfinopt reproduce` and `dolfinopt bench`: the paper's results, run time against error."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.shared import PATH, out_option, plots_option, prepare, set_option, start, warn
from dolfinopt.errors import ConvergenceError, InputError

if TYPE_CHECKING:
    from mpi4py import MPI


@click.command()
@out_option("figures, report.html and cases; default: results/paper")
@click.option("--check", is_flag=True, help="end with status 1 if one of the main checks fails")
@click.option(
    "--coarse",
    is_flag=True,
    help="100 x 6 cells, a filter of two of them and 60 iterations: a minute",
)
@set_option
@plots_option
def reproduce(
    out: Path | None,
    check: bool,
    coarse: bool,
    overrides: tuple[str, ...],
    plots: bool,
) -> None:
    """Recreate figures 3 to 15 of the paper, and a page that compares its statements with ours.

    What is computed is kept in DIR/cases and taken from there the next time; a call that was
    interrupted goes on.
    """
    world = start()
    from dolfinopt.output.summary import filter_warnings
    from dolfinopt.paper import reproduction as paper
    from dolfinopt.paper.reproduction import check_paper, failed_checks
    from dolfinopt.parallel import on_root

    folder = out or Path("results") / "paper"
    scene = on_root(world, paper.load_paper, coarse, overrides)
    if world.rank == 0:
        warn(filter_warnings(scene, paper.cell_sizes(scene)))
    plan = paper.Plan(scene)
    results, outcomes = paper.reproduce(plan, folder, world)
    checks = check_paper(results)

    def conclude() -> None:
        paper.write_report(plan, results, outcomes, checks, folder, plots=plots)
        for check in checks:
            click.echo(f"{check.name} (paper: {check.paper}). {check.sentence}")
        page = " and report.html" if plots else ""
        click.echo(f"{outcomes.computed} cases computed; figures{page} in {folder}")

    on_root(world, conclude)  # a rank that raised below meanwhile would end the root at its writing
    failures = [f"{o.case.label}: {o.failure}" for o in outcomes.failures]
    wrong = [*failures, *(failed_checks(checks) if check else ())]
    if wrong:
        raise ConvergenceError("; ".join(wrong))


# -- dolfinopt bench -------------------------------------------------------------------------


FIELD = "field"


@click.command()
@click.argument("names", metavar="[DIAGRAM]...", nargs=-1)
@out_option("diagrams and bench.md, or field.csv; default: results/bench, for field none")
@click.option("--quick", is_flag=True, help="coarse meshes, fewer points: some minutes")
@click.option("--case", "cases", metavar="NAME", multiple=True, help="of field: this case alone")
@click.option("--all", "everything", is_flag=True, help="of field: the long cases, too")
@click.option(
    "--records", type=PATH, metavar="DIR", help="of field: measured records that a case reads"
)
def bench(
    names: tuple[str, ...],
    out: Path | None,
    quick: bool,
    cases: tuple[str, ...],
    everything: bool,
    records: Path | None,
) -> None:
    """Measure run time against error, or check the benchmark of the field.

    Diagrams of integrators, iterations, elements and errors, beside other programs; or those named
    alone: time, iteration, mesh, tolerance. Two run only when they are named: solid measures solid
    links up to a million degrees of freedom (needs 14 GB), optimiser solves thirteen problems from
    three starts (half an hour).

    What is measured is kept in DIR; a call that was interrupted goes on.

    `dolfinopt bench field` runs the published problems of the folder benchmarks and prints every
    value beside its reference, with difference, limit and verdict; exit status 1 where a limit is
    missed. By default the quick cases, some ten seconds; with --records DIR those, too, that read
    measured records which cannot be copied: ur10e.
    """
    world = start()
    if FIELD in names:
        if len(names) > 1 or quick:
            other = "--quick" if quick else next(name for name in names if name != FIELD)
            raise InputError(f"bench field: {other} does not go with it; call it alone")
        _check_field(world, out, cases, everything, records)
        return
    if world.size > 1:
        raise InputError("bench: starts its ranks itself; call it without mpirun")
    if cases or everything or records:
        raise InputError("bench: --case, --all and --records belong to dolfinopt bench field")
    _measure(names, out, quick)


def _check_field(
    world: MPI.Comm,
    out: Path | None,
    names: tuple[str, ...],
    everything: bool,
    records: Path | None,
) -> None:
    """Run cases of the benchmark on the root; print each one's values when it is done."""
    from dolfinopt.bench.field import check, chosen_cases, table_of
    from dolfinopt.disk import write_text
    from dolfinopt.parallel import on_root

    if names and everything:
        raise InputError("bench field: --case and --all: give one of them")
    found = []
    for case in chosen_cases(names, everything, records is not None):
        checked = on_root(world, check, case, records)
        found += checked
        if world.rank == 0:
            table = table_of(checked).drop(columns="case").to_string(index=False)
            click.echo(f"{case.title} ({case.name})\n{table}\n")
    if out is not None:
        prepare(world, out)
        on_root(world, write_text, out / "field.csv", table_of(found).to_csv(index=False))
    missed = [one for one in found if not one.met]
    if missed:
        named = ", ".join(f"{one.case.name}: {one.of.what}" for one in missed)
        raise ConvergenceError(f"bench field: {len(missed)} of {len(found)} limits missed: {named}")
    if world.rank == 0:
        click.echo(f"{len(found)} values within their limits")


def _measure(names: tuple[str, ...], out: Path | None, quick: bool) -> None:
    """Measure and draw diagrams."""
    from dolfinopt.bench.run import QUICKLY, Plan, named
    from dolfinopt.bench.run import bench as run
    from dolfinopt.paper.reproduction import load_paper

    world = start()
    chosen = named(names)
    begun = time.perf_counter()
    folder = out or Path("results") / "bench"
    prepare(world, folder)
    plan = Plan(load_paper(overrides=QUICKLY if quick else ()), quick)
    with _progress(len(chosen)) as (tell, done):
        failures = run(plan, folder, chosen, tell, done)
    seconds = time.perf_counter() - begun
    click.echo(f"diagrams in {folder}, summary in {folder / 'bench.md'}; {seconds:.0f} s")
    if failures:
        raise ConvergenceError("; ".join(failures))


@contextmanager
def _progress(count: int) -> Iterator[tuple[Callable[[str], None], Callable[[str], None]]]:
    """Yield what shows a step on a live line, or prints it, and what prints a finished diagram."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True, highlight=False, markup=False)

    def line(text: str) -> None:
        console.print(text, soft_wrap=True)

    if not console.is_terminal:
        yield line, line
        return
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("starting", total=count)

        def done(text: str) -> None:
            line(text)
            progress.advance(task)

        yield lambda text: progress.update(task, description=text.replace("[", r"\[")), done
