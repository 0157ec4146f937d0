"""`dolfinopt schema`."""

from __future__ import annotations

import json

import click


@click.command()
def schema() -> None:
    """Print the JSON schema of scene files, for editors."""
    from dolfinopt.scene.json_schema import scene_schema

    click.echo(json.dumps(scene_schema(), indent=2))
