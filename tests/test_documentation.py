"""What the documentation shows is run: code, commands, the list of parameters."""

import doctest
import importlib
import pkgutil
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import gvo
from gvo.config import Config, describe_configuration

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MODULES = [name for _, name, _ in pkgutil.walk_packages(gvo.__path__, "gvo.")]


def blocks(language: str) -> list[tuple[str, str]]:
    """Return the fenced blocks of a language with the page that holds them."""
    return [
        (page.name, block)
        for page in PAGES
        for block in re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)
    ]


@pytest.fixture
def workplace(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, drive_bag: Path, room_bag: Path
) -> Path:
    """Return a working folder with the recordings that the documentation names."""
    shutil.copy(drive_bag, tmp_path / "drive.mcap")
    shutil.copy(room_bag, tmp_path / "room.bag")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_list_of_parameters_is_up_to_date() -> None:
    page = (ROOT / "docs/configuration.md").read_text()
    assert describe_configuration(Config()) in page


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name: str) -> None:
    assert doctest.testmod(importlib.import_module(name)).failed == 0


@pytest.mark.parametrize(("page", "code"), blocks("python"))
def test_python_in_the_documentation_runs(workplace: Path, page: str, code: str) -> None:
    exec(compile(code, page, "exec"), {})


@pytest.mark.parametrize(("page", "text"), blocks("sh"))
def test_commands_in_the_documentation_run(
    workplace: Path, command: Callable[..., Any], page: str, text: str
) -> None:
    lines = [line for line in text.splitlines() if line.startswith("gvo ")]
    for line in lines:
        arguments = shlex.split(line)[1:]
        if any(argument.isupper() for argument in arguments):
            continue  # a placeholder for a file of the reader's own
        answer = command(*arguments)
        assert answer.code == 0, f"{page}: {line}: {answer.err}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


def test_the_public_names_can_be_imported() -> None:
    for name in gvo.__all__:
        assert getattr(gvo, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = gvo.nothing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_placeholder_is_left(page: Path) -> None:
    assert re.findall(r"\b(?:TODO|TBD|XXX|RAW|SMO|BENCH)[A-Z0-9]+\b", page.read_text()) == []
