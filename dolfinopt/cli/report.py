"""What a run tells at its end: why it ended, what it gained, which limits hold, what is next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.cli.shared import chosen, warn
from dolfinopt.optimization.stopping import StopCode
from dolfinopt.output.summary import is_grey
from dolfinopt.progress import with_unit
from dolfinopt.responses.constraints import limits_of
from dolfinopt.responses.response import objective_of

if TYPE_CHECKING:
    from dolfinopt.optimization.result import Result
    from dolfinopt.responses.constraints import Limit

Summary = Mapping[str, Any]


def conclude(result: Result, summary: Summary, folder: Path, verbose: bool = False) -> None:
    """Print what the deviation comes from, the run's warnings, and what came of it (root only)."""
    for line in _budget(summary, table=not result.optimised):
        click.echo(line)
    warn(summary["warnings"])
    for line in _choices(summary):
        click.echo(line)
    ending = (
        f"{result.iterations} iterations ({result.ending})" if result.optimised else result.ending
    )
    seconds = summary["seconds"]["total"]
    click.echo(f"{summary['name']}: {ending}, {seconds:.1f} s; results in {folder}")
    # Uniform arms with solid ends exceed their volume: an optimisation begins by taking that away.
    limits = [o for o in result.limits if result.optimised or o.quantity != "volume_fraction"]
    for line in (_objective(result, summary), _largest(summary), *_limits(limits)):
        click.echo(f"  {line}")
    for line in _details(summary) if verbose else ():
        click.echo(f"  {line}")
    if result.optimised:
        click.echo(_next(result, summary, folder))


def _budget(summary: Summary, table: bool) -> Iterator[str]:
    """Yield the shares of all kinds of parts in the deviation, and the parts as a table."""
    budget = summary["deflection_budget"]
    if budget is None:
        return
    shares = [f"{name} {100.0 * x:.3g} %" for name, x in budget["shares"].items()]
    yield f"the deviation comes from {', '.join(shares)}"
    if not table:
        return
    yield (
        f"at {budget['instant']:.3f} s, {1e3 * budget['linear']:.4g} mm to first order "
        f"({1e3 * budget['deviation']:.4g} mm simulated):"
    )
    width = max(len(item["name"]) for item in budget["parts"])
    for item in budget["parts"]:
        yield (
            f"  {item['kind']:<8} {item['name']:<{width}} {1e3 * item['deflection']:>10.4g} mm "
            f"{100.0 * item['share']:>6.1f} %"
        )


def _choices(summary: Summary) -> Iterator[str]:
    """Yield what the program has chosen by itself: branch of a loop, coordinates, stiffening."""
    if start := summary["loop_start"]:
        joints = ", ".join(f"{name} = {value:.4g}" for name, value in start.items())
        yield f"closures: loops start with {joints}; motion.initial_joints chooses the branch"
    if summary["feed_forward"]:
        yield from _feed_forward(summary)
    result = summary["reduction"]
    if result["error_estimate"] is not None:
        yield chosen(result["coordinates"], result["error_estimate"])
    loads, asked = summary["stiffening"], summary["scene"]["simulation"]["stiffening"]
    if asked == "auto" and loads is not None and loads["on"]:
        yield (
            'simulation.stiffening = "auto": on, the loads of the motion change the stiffness of '
            f"an arm by {100.0 * loads['estimate']:.2g} %"
        )


def _feed_forward(summary: Summary) -> Iterator[str]:
    """Yield what joints do about arms that bend, what that leaves, and what drives it takes."""
    moved = summary["feed_forward"]
    units = moved["units"]["corrections"].split(", ")
    pairs = zip(moved["corrections"].items(), units, strict=True)
    joints = ", ".join(f"{name} by up to {x:.3g} {unit}" for (name, x), unit in pairs)
    rate = moved["slowest_unstable_rate"]
    begun = "begun" if moved["lead"] > 0.0 else "which without lead cannot begin"
    begins = f", {begun} about {3e3 / rate:.2g} ms before it moves" if rate else ""
    yield f"feed-forward: joints {joints}{begins}; feed_forward.csv has the joints"
    finer, without = moved["deviation_left_finer"], moved["deviation_without"]
    there = (
        ""
        if finer is None
        else (
            f", {1e3 * finer:.2g} mm in a model of twice the coordinates with geometric stiffness"
        )
    )
    here = "" if without is None else f" ({1e3 * without:.4g} mm without)"
    yield f"  the tip stays {1e3 * moved['deviation_left']:.2g} mm off its path{here}{there}"
    if before := moved["drive_peak_without"]:
        after, units = summary["drive_peak"], summary["units"]["drive_peak"]
        peaks = (f"{name} {after[name]:.4g} {units[name]} ({before[name]:.4g})" for name in before)
        yield f"  peak drives, and without feed-forward: {', '.join(peaks)}"


def _objective(result: Result, summary: Summary) -> str:
    """Return name, value and unit of the objective, what it stands for, and what was gained."""
    scene, response = result.scene, result.scene.objective.response
    name, value = response.label, result.evaluation.objective
    if scene.scenarios and response.needs:  # the mass is the same in all
        how = "weighted sum" if scene.objective.scenarios == "sum" else "worst"
        name += f" ({how} of {len(scene.scenarios)} scenarios)"
    text = with_unit(f"{name} {value:.4g}", response.unit)
    if response.stands_for:
        frequencies = summary["loaded_frequency"].items()
        shown = ", ".join(f"{arm} {item:.4g} {response.limit_unit}" for arm, item in frequencies)
        text += f" ({response.stands_for} of {shown})"
    if not result.optimised:
        return text
    gained = [_against(value, result.rows[0].objective, "the starting design")]
    if result.bars is not None:
        gained.append(_against_bars(result, value))
    sought = "maximised" if objective_of(scene).turned else "minimised"
    return f"{sought} {text}: {', '.join(gained)}"


def _against(value: float, other: float, what: str) -> str:
    """Return e.g. "64 % below the starting design"."""
    percent = 100.0 * (value / other - 1.0) if other else 0.0
    if abs(percent) < 0.05:
        return f"as {what}"
    return f"{abs(percent):.2g} % {'below' if percent < 0.0 else 'above'} {what}"


def _against_bars(result: Result, value: float) -> str:
    """Compare a design with straight solid bars of the same mass."""
    assert result.bars is not None
    bars = "straight solid bars of the same mass"
    exceeded = [
        limit
        for limit in limits_of(result.scene, result.bars)
        if limit.excess > 0.01 and not limit.of_mass
    ]
    missed = ", ".join(item.usage for item in exceeded)
    if result.scene.objective.kind == "mass":
        return f"{bars} have {missed}" if missed else f"as {bars}, which keep the limits, too"
    text = _against(value, result.bars.objective, bars)
    return f"{text} (which have {missed})" if missed else text


def _largest(summary: Summary) -> str:
    """Return the largest deviation, or of a pinned end the pin's force, and the largest stress."""
    kinds, stress = [item["kind"] for item in summary["scene"]["closures"]], summary["stress"]
    if kinds == ["pin"] and "closure_force_peak" in summary:
        text = f"largest force of the pin {summary['closure_force_peak']:.4g} N"
    else:
        text = (
            f"largest deviation {1e3 * summary['max_deviation']:.4g} mm "
            f"at {summary['max_deviation_time']:.3f} s"
        )
    if stress is None:
        return text
    place = ", ".join(f"{x:.3g}" for x in stress["place"])
    return (
        f"{text}, largest stress {1e-6 * stress['value']:.4g} MPa in {stress['arm']} at ({place}) "
        f"m and {stress['instant']:.3f} s"
    )


def _limits(limits: Sequence[Limit]) -> Iterator[str]:
    """Yield which limits hold and which do not, each with the share of it that is used."""
    for words, met in (("limits kept", True), ("limits not kept", False)):
        if shown := [limit.usage for limit in limits if limit.met is met]:
            yield f"{words}: {', '.join(shown)}"


def _details(summary: Summary) -> Iterator[str]:
    """Yield grayness, contacts of the design cut at one half, and the certificate."""
    yield f"grayness {summary['grayness']:.3f}"
    for arm, item in summary["contacts"].items():
        if count := item["corners"] + item["edges"]:
            yield (
                f"cut at a density of 0.5, {arm} falls into {item['pieces']} pieces, "
                f"{count} of whose contacts are corners or edges of cells alone"
            )
    if summary["certificate"] is not None:
        yield summary["certificate"]["sentence"]


def _next(result: Result, summary: Summary, folder: Path) -> str:
    """Return how to go on from a design."""
    scene, iterations = result.scene, result.scene.optimizer.max_iterations
    more = 2 * iterations or type(scene.optimizer)().max_iterations
    longer = (
        f"dolfinopt optimize {scene.source} --out {folder} --resume "
        f"--set optimizer.max_iterations={more}"
    )
    if iterations == 0:
        return f"next: {longer}"
    if result.violated:
        spent = result.stop_code is StopCode.ITERATIONS
        return "next: relax a limit" + f", or go on with {longer}" * spent
    if is_grey(scene, summary["grayness"]):
        return (
            f"this is a grey optimum (grayness {summary['grayness']:.2g}), as in the paper: for "
            'parts use lightest_two_arm.toml or projection = "robust"'
        )
    if result.stop_code is StopCode.ITERATIONS:
        return f"next: dolfinopt part {folder}, or go on with {longer}"
    return f"next: parts for the workshop by dolfinopt part {folder}"
