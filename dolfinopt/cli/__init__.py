"""The `dolfinopt` command: one file a command, what they share in options.py and shared.py."""

from dolfinopt.cli.main import commands, main

__all__ = ["commands", "main"]
