"""The `dolfinopt` command: a file for the commands of one kind, what they share in shared.py."""

from dolfinopt.cli.main import commands, main

__all__ = ["commands", "main"]
