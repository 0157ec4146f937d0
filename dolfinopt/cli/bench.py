"""`dolfinopt bench`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.shared import out_option, prepare, start
from dolfinopt.errors import InputError

if TYPE_CHECKING:
    pass


@click.command()
@click.argument("names", metavar="[DIAGRAM]...", nargs=-1)
@out_option("diagrams and bench.md; default: results/bench")
@click.option("--quick", is_flag=True, help="coarse meshes, fewer points: some two minutes")
def bench(names: tuple[str, ...], out: Path | None, quick: bool) -> None:
    """Measure run time against error.

    Diagrams of integrators, meshes, reductions and iterations, beside other programs; or those
    named alone: time, peers, whole, mesh, reduction, tolerance, solvers, and solid, which measures
    solid links up to a million degrees of freedom (needs 14 GB) and runs only when it is named.

    What is measured is kept in DIR; a call that was interrupted goes on.
    """
    world = start()
    if world.size > 1:
        raise InputError("bench: starts its ranks itself; call it without mpirun")
    from dolfinopt.bench import QUICKLY, Plan, named
    from dolfinopt.bench import bench as run
    from dolfinopt.bench.progress import live_diagrams
    from dolfinopt.paper.reproduction import load_paper

    chosen = named(names)
    begun = time.perf_counter()
    folder = out or Path("results") / "bench"
    prepare(world, folder)
    scene = load_paper(False, QUICKLY if quick else ())
    with live_diagrams(len(chosen)) as (tell, done):
        summary = run(Plan(scene, quick), folder, tell, chosen, done)
    seconds = time.perf_counter() - begun
    click.echo(f"diagrams in {folder}, summary in {summary}; {seconds:.0f} s")
