"""`dolfinopt init`."""

from __future__ import annotations

import json
import os
from pathlib import Path

import click

from dolfinopt.cli.options import PATH
from dolfinopt.cli.start import led_by_another
from dolfinopt.data import template_folder
from dolfinopt.errors import InputError

TEMPLATES = {
    "two-arm": "two arms on a cart, half a circle (default)",
    "pick-and-place": "two arms on a fixed base, a path through points, gravity",
    "single-arm": "one arm on a fixed joint lifts a payload against gravity",
    "step": "arms of your own shape, from a STEP file",
}


@click.command(
    help="Write a commented scene, NAME.toml (default: scene.toml).\n\n"
    "\b\nTemplates:\n" + "\n".join(f"  {name:<16}{what}" for name, what in TEMPLATES.items())
)
@click.argument("name", default="scene", type=PATH)
@click.option(
    "--template", type=click.Choice(list(TEMPLATES)), default="two-arm", help="what to start from"
)
def init(name: Path, template: str) -> None:
    if led_by_another():
        return
    from dolfinopt.output.folders import write_new
    from dolfinopt.scene.json_schema import SCHEMA_FILE, scene_schema
    from dolfinopt.scene.schema import check_scene_name
    from dolfinopt.scene.tables.base import Refusal

    path = name if name.suffix == ".toml" else name.with_name(f"{name.name}.toml")
    try:
        title = check_scene_name(path.stem)
    except Refusal as error:
        raise InputError(f"{path.stem}: the name of a scene: {error.reason}") from None
    texts = {}
    for source in sorted(template_folder().glob(f"{template}.*"), reverse=True):
        text = source.read_text(encoding="utf-8")
        for mark, value in (("@NAME@", title), ("@STEM@", path.stem)):
            text = text.replace(f'"{mark}', '"' + json.dumps(value, ensure_ascii=False)[1:-1])
        texts[path.with_suffix(source.suffix)] = text
    schema = path.with_name(SCHEMA_FILE)
    write_new(texts, {schema: json.dumps(scene_schema(), indent=2) + "\n"})
    written = ", ".join(os.fspath(one) for one in texts)
    click.echo(f"{written}: edit the values that differ for your machine")
    click.echo(f"{schema}: completes the keys in editors that know JSON schema (Taplo and others)")
    if template == "step":
        click.echo(f"put your STEP file beside it, as {path.with_name('arm.step')}")
    click.echo("then:")
    click.echo(f"  dolfinopt simulate {path}    # what the machine does with half the material")
    click.echo(f"  dolfinopt optimize {path}")
