"""`dolfinopt sweep`, `compare`, `uncertainty`, `reproduce` and `bench`: commands of many cases."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.cli.shared import (
    load,
    options,
    prepare,
    progress,
    scene_argument,
    start,
)
from dolfinopt.disk import write_text
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.output.folders import listed_files, read_record, remove_stale
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import file_digest, with_digests

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.study.cases import Steps
    from dolfinopt.study.tables import Study

PRESETS = ("payload", "flattening", "coordinates")
# Preset by the command's word; members of uniform section are a study of their own.
COMPARED = {"objectives": "objective", "reductions": "reduction"}
SECTIONS, MOTIONS = "sections", "motions"
# Variants of the paper's scene; and to demand its main statements of these, too.
COARSE, FITTED, CHECK = "coarse", "fitted", "check"

# What a command asks: name of the study's files, design.npz files, the study's steps in a folder,
# and what else it asks, but for the values it goes through, which may grow.
Question = tuple[str, Sequence[Path], Callable[[Path], "Steps[Study]"], dict[str, Any]]


def study_command(ask: Callable[..., Question]) -> Callable[..., None]:
    """Make a command of a function of the scene; it writes, draws and prints what the study found.

    The same question in the same folder goes on: cases that were computed are taken from there. One
    of another scene or other designs under the same name is refused, InputError. ConvergenceError
    says that a case failed; all others are written.
    """

    @wraps(ask)
    def command(
        scene: Path, out: Path | None, overwrite: bool, overrides: Any, plots: bool, **own: Any
    ) -> None:
        world, loaded = load(scene, overrides)
        keep = own.pop("keep", True)
        name, designs, study, question = ask(loaded, **own)
        from dolfinopt.parallel import on_root
        from dolfinopt.study.cases import Runner
        from dolfinopt.study.studies import carry_out
        from dolfinopt.study.tables import write_study

        # One folder for all studies of a scene, which share the optimised design.
        folder = out or Path("results") / f"{scene.stem}-study"
        known = [file_digest(path) if path.is_file() else str(path) for path in designs]
        asked = {"scene": with_digests(loaded.to_dict()), "designs": known} | question
        if not overwrite:
            on_root(world, _check_question, folder, name, asked)
        done = carry_out(study(folder), Runner(folder, world, keep=keep))

        def conclude() -> None:
            remove_stale(folder, listed_files(folder / f"{name}.json"))
            written = write_study(done, folder)
            if plots:
                from dolfinopt.study.figures import draw_study

                written += draw_study(done, folder)
            _write_question(folder, name, asked, [path.name for path in written])
            click.echo(done.markdown())
            click.echo(f"{done.computed} cases computed; tables and pictures in {folder}")

        on_root(world, conclude)  # a rank that raised below meanwhile would end its writing
        if done.failures:
            more = f" (and {len(done.failures) - 1} more)" if len(done.failures) > 1 else ""
            raise ConvergenceError(f"{done.failures[0]}{more}")

    decorated: Callable[..., None] = options("study")(command)
    return decorated


def _check_question(folder: Path, name: str, question: Mapping[str, Any]) -> None:
    """Raise InputError if the folder's files of this name answer another question."""
    known = read_record(folder / f"{name}.json").get("question")
    question = json.loads(json.dumps(question))
    if known is None or known == question:
        return
    parts = [part for part in question if known.get(part) != question[part]]
    what = f"other {' and '.join(parts)}".replace("other scene", "another scene")
    raise InputError(
        f"{folder}: {name}.* there belong to {what}; --overwrite to replace them, or another --out"
    )


def _write_question(
    folder: Path, name: str, question: Mapping[str, Any], files: Sequence[str]
) -> None:
    """Write what a study asked, and its files, as FOLDER/NAME.json."""

    text = json.dumps({"question": question, "files": sorted(files)}, indent=1)
    write_text(folder / f"{name}.json", text + "\n")


@click.command()
@scene_argument
@click.argument("preset", required=False, type=click.Choice(PRESETS))
@options("sweep")
@study_command
def sweep(
    scene: Scene,
    preset: Any,
    vary: tuple[str, ...],
    designs: tuple[Path, ...],
    reoptimize: bool,
) -> Question:
    """Simulate designs of SCENE for a range of values: tables and curves of what they do.

    Values are those of the payload's mass, the path's flattening, the number of coordinates, or
    whatever --vary names. What is computed is kept in DIR: a sweep that was interrupted, or that
    grows, takes it from there.
    """
    from dolfinopt.study.studies import study, sweep_name

    name = sweep_name(preset, vary)
    return name, designs, lambda _: study(scene, preset, vary, designs, reoptimize=reoptimize), {}


@click.command()
@scene_argument
@click.argument("what", type=click.Choice([*COMPARED, SECTIONS, MOTIONS]))
@click.argument("kinds", nargs=-1, metavar="[KIND...]")
@options("compare")
@study_command
def compare(
    scene: Scene,
    what: str,
    kinds: tuple[str, ...],
    designs: tuple[Path, ...],
) -> Question:
    """Optimise SCENE for every objective or with every reduction, and compare the designs.

    KINDs are words of objective.kind, by default all, or numbers of coordinates, by default 4 and
    12. With sections: compare its design with straight tubes and bars, of the same mass and the
    lightest that hold the limits. With motions: compare joints on the rigid path, input shapers
    and feed-forward, with the machine as it is and with other payloads, stiffness, damping.

    What is computed is kept in DIR and taken from there the next time; a call that was
    interrupted goes on.
    """
    if kinds and what in (SECTIONS, MOTIONS):
        raise InputError(f"{kinds[0]}: expected nothing behind compare SCENE {what}")
    if what == SECTIONS:
        from dolfinopt.study.sections import NAME, study_sections

        return NAME, designs, partial(study_sections, scene, designs), {}
    if what == MOTIONS:
        from dolfinopt.study.motions import study_motions

        return MOTIONS, designs, partial(study_motions, scene, designs), {}
    from dolfinopt.study.studies import study

    preset: Any = COMPARED[what]
    vary = []
    if kinds and what == "reductions":
        vary, kinds = [f"reduction.coordinates={','.join(kinds)}"], ()
    return preset, designs, lambda _: study(scene, preset, vary, designs, kinds=kinds), {}


@click.command()
@scene_argument
@options("uncertainty")
@study_command
def uncertainty(
    scene: Scene, random: tuple[str, ...], designs: tuple[Path, ...], samples: int, seed: int
) -> Question:
    """Simulate designs of SCENE with random values: statistics and Sobol' indices.

    What is computed is kept in DIR and taken from there the next time; a call that was
    interrupted goes on.
    """
    from dolfinopt.study.uncertainty import random_name, study_random

    name, asked = random_name(random), {"distributions": sorted(random)}
    return name, designs, lambda _: study_random(scene, random, designs, samples, seed), asked


@click.command()
@click.argument("variants", nargs=-1, type=click.Choice([COARSE, FITTED, CHECK]))
@options("reproduce")
def reproduce(
    variants: tuple[str, ...],
    out: Path | None,
    overrides: tuple[str, ...],
    plots: bool,
) -> None:
    """Recreate figures 3 to 15 of the paper, and a page that compares its statements with ours.

    The exit status is 1 if one of the main statements does not hold. Variants: "coarse" takes
    100 x 6 cells, a filter of two of them and 60 iterations, a minute; "fitted" fits the values
    that the paper does not state to its statements. Their exit status is 0 without "check".

    What is computed is kept in DIR/cases and taken from there the next time; a call that was
    interrupted goes on.
    """
    world = start()
    from dolfinopt.paper import reproduction as paper
    from dolfinopt.paper.reproduction import check_paper, failed_checks
    from dolfinopt.parallel import on_root

    coarse, fitted = COARSE in variants, FITTED in variants
    folder = out or Path("results") / ("paper-fitted" if fitted else "paper")
    overrides = (*(paper.FITTED if fitted else ()), *overrides)
    scene = on_root(world, paper.load_paper, coarse, overrides)
    plan = paper.Plan(scene)
    results, outcomes = paper.reproduce(plan, folder, world)
    checks = check_paper(results)

    def conclude() -> None:
        paper.write_report(plan, results, outcomes, checks, folder, plots=plots)
        for item in checks:
            click.echo(f"{item.name} (paper: {item.paper}). {item.sentence}")
        click.echo(f"{sum(entry.holds for entry in checks)} of {len(checks)} statements hold")
        page = " and report.html" if plots else ""
        click.echo(f"{outcomes.computed} cases computed; figures{page} in {folder}")

    on_root(world, conclude)  # a rank that raised below meanwhile would end the root at its writing
    failures = [f"{o.case.label}: {o.failure}" for o in outcomes.failures]
    wrong = [
        *failures,
        *(failed_checks(checks) if CHECK in variants or not (coarse or overrides) else ()),
    ]
    if wrong:
        raise ConvergenceError("; ".join(wrong))


FIELD, QUICK = "field", "quick"


@click.command()
@click.argument("names", metavar="[quick] [DIAGRAM... | field [CASE...]]", nargs=-1)
@options("bench")
def bench(names: tuple[str, ...], out: Path | None) -> None:
    """Measure run time against error, or check the benchmark of the field.

    Diagrams of integrators, iterations, elements and errors, beside other programs; or those named
    alone: time, iteration, mesh, tolerance; with "quick" on coarse meshes, some minutes. Two run
    only when they are named: solid measures solid links up to a million degrees of freedom (needs
    14 GB), optimiser solves thirteen problems from three starts (half an hour).

    What is measured is kept in DIR; a call that was interrupted goes on.

    `dolfinopt bench field` runs the published problems of the folder benchmarks and prints every
    value beside its reference, with difference, limit and verdict; exit status 1 where a limit is
    missed. By default the quick cases, some ten seconds; those named alone; "all" with the long
    ones; with CASE=DIR one that reads measured records which cannot be copied: ur10e.
    """
    world, quick = start(), QUICK in names
    names = tuple(name for name in names if name != QUICK)
    if names[:1] == (FIELD,):
        if quick:
            raise InputError("bench field: quick does not go with it")
        measured = dict(name.split("=", 1) for name in names[1:] if "=" in name)
        records = next(map(Path, measured.values()), None)
        cases = tuple(name for name in names[1:] if "=" not in name)
        _check_field(world, out, cases if cases == ("all",) else (*cases, *measured), records)
        return
    if world.size > 1:
        raise InputError("bench: starts its ranks itself; call it without mpirun")
    _measure(names, out, quick)


def _check_field(
    world: MPI.Comm, out: Path | None, names: tuple[str, ...], records: Path | None
) -> None:
    """Run cases of the benchmark on the root; print each one's values when it is done."""
    from dolfinopt.bench.field import check, chosen_cases, table_of
    from dolfinopt.parallel import on_root

    result = []
    for case in chosen_cases(names, records is not None):
        checked = on_root(world, check, case, records)
        result += checked
        if world.rank == 0:
            table = table_of(checked).drop(columns="case").to_string(index=False)
            click.echo(f"{case.title} ({case.name})\n{table}\n")
    if out is not None:
        prepare(world, out)
        on_root(world, write_text, out / "field.csv", table_of(result).to_csv(index=False))
    missed = [item for item in result if not item.met]
    if missed:
        named = ", ".join(f"{item.case.name}: {item.of.what}" for item in missed)
        raise ConvergenceError(
            f"bench field: {len(missed)} of {len(result)} limits missed: {named}"
        )
    if world.rank == 0:
        click.echo(f"{len(result)} values within their limits")


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
    say = progress(world, "bench")
    failures = run(plan, folder, chosen, say, partial(click.echo, err=True))
    seconds = time.perf_counter() - begun
    click.echo(f"diagrams in {folder}, summary in {folder / 'bench.md'}; {seconds:.0f} s")
    if failures:
        raise ConvergenceError("; ".join(failures))
