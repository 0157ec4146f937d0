"""Options that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click


class GivenPath(click.Path):
    """A path that is not empty: `--out ""` would be the current folder."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("expected a path, found nothing", param, ctx)
        return super().convert(value, param, ctx)


PATH = GivenPath()


scene_argument = click.argument("scene", type=PATH)


set_option = click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="override a scene value"
)


design_option = click.option("--design", type=PATH, help="design.npz; default: the initial design")


plots_option = click.option("--plots/--no-plots", default=True, help="draw pictures")


animation_option = click.option(
    "--animation", is_flag=True, help="also draw the moving machine: motion.gif"
)


overwrite_option = click.option("--overwrite", is_flag=True, help="replace existing results")


def out_option(what: str) -> Callable[..., Any]:
    """Return the --out option of a command that writes a folder."""
    return click.option("--out", type=PATH, metavar="DIR", help=f"folder for {what}")
