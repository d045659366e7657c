"""What the pages name of gvo is there: commands, options, and what the comparison claims."""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.main import get_command

import gvo
from gvo.cli.main import app

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def commands() -> dict[str, set[str]]:
    """Return each command with its options."""
    group = get_command(app)
    return {
        name: {"--help", "-h"}.union(*([*p.opts, *p.secondary_opts] for p in command.params))
        for name, command in getattr(group, "commands").items()  # noqa: B009 - untyped
    }


COMMANDS = commands()


def spans(page: Path) -> list[str]:
    """Return what stands between back-ticks within the sentences of a page."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]


def unknown(span: str) -> list[str]:
    """Return what gvo has not of a command line within a sentence."""
    found = re.match(r"gvo ([a-z][\w-]*)(.*)", span)
    if found is None:
        return []
    if found[1] not in COMMANDS:
        return [found[1]]
    return sorted({*re.findall(r"(?<!\S)--?[a-zA-Z][\w-]*", found[2])} - COMMANDS[found[1]])


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.name
)
def test_commands_and_options_within_sentences_are_there(page: Path) -> None:
    assert [span for span in spans(page) if unknown(span)] == []


def claims(cell: str) -> set[str]:
    return {*re.split(r"[,;] ", cell)}


def has(*names: str) -> Callable[[], bool]:
    """Return whether commands, public names and files are there."""

    def is_there(name: str) -> bool:
        if "/" in name:
            return (ROOT / name).exists()
        return name in COMMANDS or name in dir(gvo)

    return lambda: all(map(is_there, names))


@pytest.mark.parametrize("page", ["README.md", "docs/installation.md"])
def test_every_extra_that_a_page_names_is_there(page: str) -> None:
    named = re.findall(r"pip install (?:-e )?'\.\[(.*?)\]'", (ROOT / page).read_text())
    extras = {extra for names in named for extra in names.split(",")}
    assert extras
    assert extras <= set(PROJECT["optional-dependencies"])
