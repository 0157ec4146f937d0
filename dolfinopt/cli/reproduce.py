"""`dolfinopt reproduce`."""

from __future__ import annotations

from pathlib import Path

import click

from dolfinopt.cli.shared import out_option, plots_option, set_option, start, warn
from dolfinopt.errors import ConvergenceError


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
    from dolfinopt.paper.statements import check_paper, failed_checks
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
