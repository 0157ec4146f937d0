"""`dolfinopt sweep`, `compare`, `uncertainty`, `reproduce` and `bench`: commands of many cases."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click
from mpi4py import MPI

from dolfinopt.cli.begin import elapsed
from dolfinopt.cli.shared import load, progress
from dolfinopt.disk import write_text
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.output.folders import listed_files, prepare_folder, read_record, remove_stale
from dolfinopt.parallel import on_root
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import file_digest, with_digests
from dolfinopt.study.cases import Runner, Steps
from dolfinopt.study.studies import study, sweep_name
from dolfinopt.study.tables import Study, write_study

# What a command asks: name of the study's files, design.npz files, the study's steps in a folder,
# and what else it asks, but for the values it goes through, which may grow.
Question = tuple[str, Sequence[Path], Callable[[Path], Steps[Study]], dict[str, Any]]


def study_command(ask: Callable[..., Question]) -> Callable[..., None]:
    """Make a command of a function of the scene; it writes, draws and prints what the study found.

    The same question in the same folder goes on: cases that were computed are taken from there. One
    of another scene or other designs under the same name is refused, InputError. ConvergenceError
    says that a case failed; all others are written.
    """

    def command(
        world: MPI.Comm,
        scene: Path,
        out: Path | None,
        overwrite: bool,
        overrides: Sequence[str],
        plots: bool,
        keep: bool = True,
        **own: Any,
    ) -> None:
        loaded = load(world, scene, overrides)
        name, designs, steps, question = ask(loaded, **own)
        # One folder for all studies of a scene, which share the optimised design.
        folder = out or Path("results") / f"{scene.stem}-study"
        known = [file_digest(path) if path.is_file() else str(path) for path in designs]
        asked = {"scene": with_digests(loaded.to_dict()), "designs": known} | question
        if not overwrite:
            on_root(world, _check_question, folder, name, asked)
        runner = Runner(folder, world, keep=keep)
        done = runner.follow(steps(folder))

        def conclude() -> None:
            remove_stale(folder, listed_files(folder / f"{name}.json"))
            written = write_study(done, name, folder)
            if plots:
                from dolfinopt.study.figures import draw_all

                written += draw_all(done.files(name), folder)
            _write_question(folder, name, asked, [path.name for path in written])
            click.echo(done.markdown())
            click.echo(f"{runner.computed} cases computed; tables and pictures in {folder}")

        on_root(world, conclude)  # a rank that raised below meanwhile would end its writing
        if done.failures:
            more = f" (and {len(done.failures) - 1} more)" if len(done.failures) > 1 else ""
            raise ConvergenceError(f"{done.failures[0]}{more}")

    return command


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


@study_command
def sweep(
    scene: Scene,
    preset: Any,
    vary: Sequence[str],
    designs: Sequence[Path],
    reoptimize: bool,
) -> Question:
    """Simulate designs of a scene for a range of values."""
    name = sweep_name(preset, vary)
    return name, designs, lambda _: study(scene, preset, vary, designs, reoptimize=reoptimize), {}


@study_command
def compare(
    scene: Scene,
    what: str,
    kinds: Sequence[str],
    designs: Sequence[Path],
) -> Question:
    """Compare designs of a scene: by objectives, reductions, with sections, on motions."""
    if what in ("sections", "motions"):
        if kinds:
            raise InputError(f"{kinds[0]}: expected nothing behind compare SCENE {what}")
        from dolfinopt.study.motions import study_motions
        from dolfinopt.study.sections import study_sections

        steps = study_sections if what == "sections" else study_motions
        return what, designs, partial(steps, scene, designs), {}
    preset: Any = what.removesuffix("s")
    vary = []
    if kinds and what == "reductions":
        vary, kinds = [f"reduction.coordinates={','.join(kinds)}"], ()
    return preset, designs, lambda _: study(scene, preset, vary, designs, kinds=kinds), {}


@study_command
def uncertainty(
    scene: Scene, random: Sequence[str], designs: Sequence[Path], samples: int, seed: int
) -> Question:
    """Simulate designs of a scene with random values: statistics and Sobol' indices."""
    from dolfinopt.study.uncertainty import random_name, study_random

    name, asked = random_name(random), {"distributions": sorted(random)}
    return name, designs, lambda _: study_random(scene, random, designs, samples, seed), asked


def reproduce(
    world: MPI.Comm,
    variants: Sequence[str],
    out: Path | None,
    overrides: Sequence[str],
    plots: bool,
) -> None:
    """Recreate figures of the paper, and a page that compares its statements with ours."""
    from dolfinopt.paper import reproduction as paper

    coarse, fitted, check = (word in variants for word in ("coarse", "fitted", "check"))
    folder = out or Path("results") / ("paper-fitted" if fitted else "paper")
    overrides = (*(paper.FITTED if fitted else ()), *overrides)
    scene = on_root(world, paper.load_paper, coarse, overrides)
    plan = paper.Plan(scene)
    results, outcomes = Runner(folder, world).follow(paper.reproduce(plan))
    checks = paper.check_paper(results)

    def conclude() -> None:
        paper.write_report(plan, results, outcomes, checks, folder, plots=plots)
        for item in checks:
            click.echo(f"{item.name} (paper: {item.paper}). {item.sentence}")
        click.echo(f"{sum(entry.holds for entry in checks)} of {len(checks)} statements hold")
        page = " and report.html" if plots else ""
        click.echo(f"{outcomes.computed} cases computed; figures{page} in {folder}")

    on_root(world, conclude)  # a rank that raised below meanwhile would end the root at its writing
    judged = check or not (coarse or overrides)
    if wrong := [*outcomes.failures, *(paper.failed_checks(checks) if judged else ())]:
        raise ConvergenceError("; ".join(wrong))


def bench(world: MPI.Comm, names: Sequence[str], out: Path | None) -> None:
    """Measure run time against error, or check the benchmark of the field."""
    quick = "quick" in names
    names = tuple(name for name in names if name != "quick")
    if names[:1] == ("field",):
        if quick:
            raise InputError("bench field: quick does not go with it")
        measured = dict(name.split("=", 1) for name in names[1:] if "=" in name)
        records = next(map(Path, measured.values()), None)
        cases = tuple(name for name in names[1:] if "=" not in name)
        _check_field(world, out, cases if cases == ("all",) else (*cases, *measured), records)
        return
    if world.size > 1:
        raise InputError("bench: starts its ranks itself; call it without mpirun")
    _measure(world, names, out, quick)


def _check_field(
    world: MPI.Comm, out: Path | None, names: Sequence[str], records: Path | None
) -> None:
    """Run cases of the benchmark on the root; print each one's values when it is done."""
    from dolfinopt.bench.field import check, chosen_cases, table_of

    result = []
    for case in chosen_cases(names, records is not None):
        checked = on_root(world, check, case, records)
        result += checked
        table = table_of(checked).drop(columns="case").to_string(index=False)
        click.echo(f"{case.title} ({case.name})\n{table}\n")
    if out is not None:
        on_root(world, prepare_folder, out)
        on_root(world, write_text, out / "field.csv", table_of(result).to_csv(index=False))
    missed = [item for item in result if not item.met]
    if missed:
        named = ", ".join(f"{item.case.name}: {item.of.what}" for item in missed)
        raise ConvergenceError(
            f"bench field: {len(missed)} of {len(result)} limits missed: {named}"
        )
    click.echo(f"{len(result)} values within their limits")


def _measure(world: MPI.Comm, names: Sequence[str], out: Path | None, quick: bool) -> None:
    """Measure and draw diagrams."""
    from dolfinopt.bench.run import QUICKLY, Plan, named
    from dolfinopt.bench.run import bench as run
    from dolfinopt.paper.reproduction import load_paper

    chosen = named(names)
    folder = out or Path("results") / "bench"
    prepare_folder(folder)
    plan = Plan(load_paper(overrides=QUICKLY if quick else ()), quick)
    say = progress(world, "bench")
    failures = run(plan, folder, chosen, say, partial(click.echo, err=True))
    click.echo(f"diagrams in {folder}, summary in {folder / 'bench.md'}; {elapsed():.0f} s")
    if failures:
        raise ConvergenceError("; ".join(failures))
