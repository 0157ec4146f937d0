"""What a run tells at its end: why it ended, what it gained, which limits hold, what is next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from dolfinopt.cli.shared import chosen, warn
from dolfinopt.data import filled
from dolfinopt.optimization.result import Result
from dolfinopt.optimization.stopping import StopCode
from dolfinopt.output.summary import is_grey
from dolfinopt.progress import with_unit
from dolfinopt.responses.constraints import limits_of
from dolfinopt.responses.response import objective_of


def conclude(
    result: Result, summary: Mapping[str, Any], folder: Path, verbose: bool = False
) -> None:
    """Print the run's warnings, what the deviation comes from, and what came of it (root only)."""
    warn(summary["warnings"])
    optimizer = result.scene.optimizer
    report = filled(
        "report.txt.jinja",
        {"with_unit": with_unit},
        result=result,
        summary=summary,
        folder=folder,
        verbose=verbose,
        chosen=chosen,
        # Uniform arms with solid ends exceed their volume: an optimisation begins by taking that
        # away.
        limits=[o for o in result.limits if result.optimised or o.quantity != "volume_fraction"],
        turned=objective_of(result.scene).turned,
        gained=list(_gained(result)) if result.optimised else [],
        grey=is_grey(result.scene, summary["grayness"]),
        spent=result.stop_code is StopCode.ITERATIONS,
        more=2 * optimizer.max_iterations or type(optimizer)().max_iterations,
    )
    click.echo(report, nl=False)


def _gained(result: Result) -> Iterator[str]:
    """Yield how the objective stands to that of the start, and of bars."""
    value = result.evaluation.objective
    yield _against(value, result.rows[0].objective, "the starting design")
    if result.bars is not None:
        yield _against_bars(result, value)


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
