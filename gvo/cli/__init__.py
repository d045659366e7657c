"""The `gvo` command."""

from gvo.cli.main import main as main
