"""The table of a part's check on the screen."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.shared import warn

if TYPE_CHECKING:
    from dolfinopt.part.check import Check


def tell(check: Check) -> None:
    """Print the table of a check and what it says."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    against = "part/density" if check.crisp is None else "part/crisp"
    for name in ("", "density", "crisp", "part", "unit", against):
        table.add_column(name, justify="left" if name in ("", "unit") else "right")
    for name, row in check.table().iterrows():
        values = [f"{row[form]:.4g}" for form in ("density", "crisp", "part")]
        ratio = f"{100.0 * row[against]:+.2f} %"
        cells = [str(name).replace("_", " "), *values, row["unit"], ratio]
        table.add_row(*("-" if "nan" in cell else cell for cell in cells))
    Console(highlight=False, width=None if sys.stdout.isatty() else 100).print(table)
    for line in (check.loss, *check.notes):
        click.echo(line)
    for limit in check.part.limits:
        click.echo(f"limit {'met' if limit.met else 'missed'}: {limit.sentence}")
    warn(check.warnings)
