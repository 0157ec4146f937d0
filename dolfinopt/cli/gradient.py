"""`dolfinopt gradient`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.cli.options import PATH, design_option, overwrite_option, scene_argument, set_option
from dolfinopt.cli.shared import claim, design_of, load, prepare, tell
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.units import with_unit

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.arms.arm import Arm
    from dolfinopt.parallel import Partition
    from dolfinopt.scene.load import Scene


@click.command()
@scene_argument
@design_option
@click.option(
    "--kind",
    type=click.Choice(["esl", "exact"]),
    help="which gradient; default: the scene's objective.gradient",
)
@click.option(
    "--out",
    type=PATH,
    metavar="FILE",
    help="gradient.npz; default: results/SCENE-gradient/gradient.npz",
)
@click.option(
    "--check",
    is_flag=True,
    help="compare with differences of the whole simulation",
)
@overwrite_option
@set_option
def gradient(
    scene: Path,
    design: Path | None,
    kind: str | None,
    out: Path | None,
    check: bool,
    overwrite: bool,
    overrides: tuple[str, ...],
) -> None:
    """Write the gradient by the physical densities to FILE."""
    out = out or Path("results") / f"{scene.stem}-gradient" / "gradient.npz"
    if out.is_dir():
        raise InputError(f"{out}: --out is a folder; name a file, e.g. {out / 'gradient.npz'}")
    if kind is not None:
        overrides = (*overrides, f'objective.gradient="{kind}"')
    world, loaded = load(scene, overrides)
    from dolfinopt.optimization.gradient_check import check_exact
    from dolfinopt.output.design import write_gradient
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.evaluation import evaluate
    from dolfinopt.responses.evaluation import gradient as slopes
    from dolfinopt.responses.order_selection import choose_coordinates
    from dolfinopt.responses.response import needs, objective_of

    claim(world, out.parent, overwrite, [out.name])
    if check:
        check_exact(loaded)
    profile = Profile()
    partition, arms, x_phys = design_of(world, loaded, design, profile)
    prepare(world, out.parent)
    moves = needs(loaded, "motion")
    if moves:
        tell(world, choose_coordinates(loaded, partition, arms, x_phys, profile))
    evaluation, trajectory = evaluate(loaded, partition, arms, x_phys, profile, simulated=False)
    by_cell = slopes(loaded, partition, arms, trajectory, profile)
    write_gradient(out, loaded, partition, arms, by_cell, evaluation.objective)
    if world.rank == 0:
        unit = objective_of(loaded).unit
        name = loaded.objective.gradient if loaded.objective.has_esl_gradient else "exact"
        value = with_unit(f"{evaluation.objective:.6g}", unit)
        click.echo(f"objective {value}; {name} gradient in {out}")
    if check:
        _check_gradient(world, loaded, partition, arms, x_phys, profile)


def _check_gradient(
    world: MPI.Comm,
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    x: Mapping[int, Any],
    profile: Any,
) -> None:
    """Print the Taylor test; raise ConvergenceError where a rate is too low."""
    from dolfinopt.optimization.gradient_check import PASSES, STEPS, taylor_test

    test = taylor_test(scene, partition, arms, x, profile)
    if world.rank == 0:
        steps = "".join(f"{f'h = {h:.2g}':>12}" for h in STEPS)
        click.echo(f"{'direction':<22}{'exact slope':>13}{'frozen':>13}{steps}{'rate':>7}")
        for row in test.rows:
            remainders = "".join(f"{r:12.2e}" for r in row.remainders)
            slopes = f"{row.slope:13.4e}{row.slope_frozen:13.4e}"
            click.echo(f"{row.direction:<22}{slopes}{remainders}{row.rate:7.2f}")
        if scene.objective.has_esl_gradient:
            click.echo(
                f"gradient with frozen loads: {test.angle:.1f} degrees from the exact one, "
                f"{test.ratio:.3f} times as long"
            )
    if not test.passed:
        raise ConvergenceError(
            f"the Taylor remainders fall at a rate below {PASSES}: the gradient is not exact here; "
            "repeat with a smaller simulation.tolerance to see whether the simulation is the cause"
        )
