"""`dolfinopt part`, of plane and of solid arms."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
from mpi4py import MPI

from dolfinopt.cli.begin import elapsed, warn
from dolfinopt.cli.shared import Say, claim, progress, scene_of
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.output.design import designed
from dolfinopt.output.folders import prepare_folder
from dolfinopt.parallel import on_root, together
from dolfinopt.part.folder import SHAPES, Saved, checkpoint_of_search, file_names, write_parts
from dolfinopt.part.part import Curves, Meshes, make_parts, mesh_parts
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.design import Part as Asked

if TYPE_CHECKING:
    from dolfinopt.part.check import Check
    from dolfinopt.part.optimize import Keep, Optimized
    from dolfinopt.part.part import Part


def part(
    world: MPI.Comm,
    folder: Path,
    out: Path | None,
    tool_radius: float | None,
    tolerance: float | None,
    rounds: bool,
    check: bool,
    optimize: bool | None,
    iterations: int | None,
    starts: int | None,
    overrides: Sequence[str],
    resume: bool,
    overwrite: bool,
    plots: bool,
) -> None:
    """Make parts for the workshop of a run's arms; options go before the scene's table [part]."""
    if other := [override for override in overrides if not override.startswith("part.")]:
        raise InputError(f"--set {other[0]}: expected keys of [part], as part.starts=3")
    if resume and overwrite:
        raise InputError("--resume, --overwrite: expected only one of them")
    scene: Scene = on_root(world, scene_of, folder, overrides)
    target = out or folder / "part"
    scene.check_designed()
    searched = bool(scene.part.optimize) if optimize is None else optimize
    if iterations and not searched:
        raise InputError("--iterations: limits --optimize, which is not asked for")
    given = {
        "tool_radius": tool_radius,
        "tolerance": tolerance,
        "optimize": iterations or optimize,
        "starts": starts,
    }
    asked = scene.part.unchecked_copy({k: v for k, v in given.items() if v is not None})
    if resume and not asked.optimize:
        raise InputError("--resume: goes on with --optimize, which is not asked for")
    names = [*file_names(scene), SHAPES]
    claim(world, target, overwrite or resume, names, resume=SHAPES, scene=scene)
    kept = on_root(world, checkpoint_of_search, target, folder, scene, asked)
    known = on_root(world, kept.read) if resume else ()
    say = progress(world, "part")
    say("outlines and surfaces")
    wanted = Curves(asked.tool_radius, asked.tolerance, rounds)
    parts = make_parts(scene, folder, wanted, world)
    with together(world):
        if world.rank == 0:
            warn(dict.fromkeys(text for item in parts.values() for text in item.warnings))
            meshes = _meshes(parts, check or bool(asked.optimize), say)
            done = PartsJob(scene, folder, say, parts, meshes)
            if check:
                done.simulate()
            if asked.optimize and done.meshes is not None:
                done.optimize(asked, kept.replace, known)
                if check:
                    done.simulate()
            say("files")
            done.write(target, plots)
            if done.shape is None or not done.shape.interrupted:
                kept.remove()
    if world.rank == 0:
        done.tell(target)
        if done.meshes is None:
            raise ConvergenceError("a part cannot be meshed: there is no part.toml")
        if done.shape is not None and done.shape.interrupted:
            raise KeyboardInterrupt(
                f"the best parts so far are in {target}; to go on, add --resume"
            )


@contextmanager
def _ended_as_interrupted() -> Iterator[None]:
    """Let what ends a job in a queue (SIGTERM) raise KeyboardInterrupt, as Ctrl-C does."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _meshes(parts: Mapping[int, Part], coarse: bool, say: Say) -> Meshes | None:
    """Return the meshes of all parts; None, and a warning, where one cannot be meshed."""
    say("meshes")
    try:
        return mesh_parts(parts, coarse)
    except InputError as error:
        warn([f"no part.toml: {error}"])
        return None


@dataclass(eq=False)
class PartsJob:
    """What the command has come to so far, on the root.

    Attributes:
        scene: of the run.
        run: its folder.
        say: is told what is done next.
        parts: by their place in the chain.
        meshes: of the parts; None: there are none.
        check: what the parts do; None: it is not known.
        shape: what optimising their shape brought; None: it was not asked for.
    """

    scene: Scene
    run: Path
    say: Say
    parts: Mapping[int, Part]
    meshes: Meshes | None
    check: Check | None = None
    shape: Optimized | None = None

    def simulate(self) -> None:
        """Find what the parts do, beside those before; warn where that cannot be simulated."""
        from dolfinopt.part.check import check_parts  # a second's imports

        if self.meshes is None:
            return
        known, self.check = self.check, None
        try:
            self.check = check_parts(self.scene, self.run, self.parts, self.meshes, self.say, known)
        except ConvergenceError as error:
            warn([f"the machine with the parts cannot be compared: {error}"])

    def optimize(self, asked: Asked, keep: Keep, known: Sequence[Saved]) -> None:
        """Optimise the shapes."""
        from dolfinopt.part.optimize import optimize_parts

        self.say("shapes")
        before = None if self.check is None else self.check.part
        tell = partial(click.echo, err=True)
        with _ended_as_interrupted():
            self.shape = optimize_parts(
                self.scene, self.parts, asked.iterations, tell, asked.starts, keep, known, before
            )
        click.echo("\n".join(self.shape.sentences))
        self.parts, self.meshes = self.shape.parts, self.shape.meshes

    def write(self, target: Path, plots: bool) -> None:
        """Write the files, all or none."""
        prepare_folder(target)
        meshes = None if self.meshes is None else self.meshes.fine
        if self.check is not None:
            meshes = self.check.meshes
        drawn = self.draw if plots else None
        design = self.run / "design.npz"
        write_parts(target, self.scene, self.parts, meshes, self.check, self.shape, drawn, design)

    def draw(self, folder: Path) -> None:
        """Write the picture of the parts, and those of what they do if that is known."""
        from dolfinopt.part.optimize import TRUSSES
        from dolfinopt.plots.curves import check_figure
        from dolfinopt.plots.design import parts_figure, stress_figure
        from dolfinopt.plots.style import save

        scene = self.scene
        masses = [scene.material_of(k).density * item.volume for k, item in self.parts.items()]
        own = self.shape is not None and self.shape.best.start.startswith(TRUSSES)
        picture = parts_figure(list(self.parts.values()), scene.name, masses, own)
        save(picture, folder / "part.png")
        if self.check is not None:
            save(check_figure(self.check, scene), folder / "deviation.png")
            title = f"{scene.name}: stress of the parts"
            stressed = [view for view in designed(self.check.views) if view.stress is not None]
            if stressed:
                save(stress_figure(stressed, title), folder / "stress.png")

    def tell(self, target: Path) -> None:
        """Print what was made."""
        from dolfinopt.part.solid.part import SolidPart

        scene, rough, bodies = self.scene, [], []
        for arm, owner in zip(scene.arms, scene.owners, strict=True):
            if owner is None:
                bodies.append(arm.name)
                continue
            part = self.parts[owner]
            mass = scene.material_of(owner).density * part.volume
            click.echo(f"{arm.name}: {mass:.4g} kg, {part.sentence}")
            if isinstance(part, SolidPart) and part.flat is None:
                rough.append(arm.name)
        if bodies:
            click.echo(f"no part of {', '.join(bodies)}: rigid or from a file")
        if self.check is not None:
            tell(self.check)
        if rough:
            click.echo(
                f"no STEP of {', '.join(rough)}: a free-form surface, in triangles (STL, 3MF); "
                'arms.symmetric = "extruded" makes plates, which have curves'
            )
        machine = ", the machine with these parts in part.toml" if self.meshes is not None else ""
        click.echo(f"{elapsed():.1f} s; files in {target}{machine}")


# -- the table of the check ----------------------------------------------------------------------


def tell(check: Check) -> None:
    """Print the table of a check and what it says."""
    against = "part/density" if check.crisp is None else "part/crisp"
    figures = check.table()
    forms = [name for name in figures.columns if name != "unit" and "/" not in name]
    shown = figures[[*forms, "unit", against]].rename_axis(None)
    shown = shown.rename(lambda name: name.replace("_", " "))
    words = {against: lambda share: "-" if share != share else f"{100.0 * share:+.2f} %"}
    click.echo(shown.to_string(float_format="{:.4g}".format, formatters=words, na_rep="-"))
    for line in (check.loss, *check.notes):
        click.echo(line)
    for limit in check.part.limits:
        click.echo(f"limit {'met' if limit.met else 'missed'}: {limit.usage}")
    warn(check.warnings)
