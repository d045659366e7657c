"""The `gvo` command."""

from gvo.cli.main import main

__all__ = ["main"]
