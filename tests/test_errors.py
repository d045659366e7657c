"""The line that installs what is missing; faults of the system by name."""

import importlib.metadata
import json
from pathlib import Path
from types import SimpleNamespace

import pytest

import gvo.errors
from gvo.errors import (
    GvoError,
    OutputError,
    flags_named,
    missing_extra,
    named_faults,
    said,
    write_faults,
)


@pytest.mark.parametrize(
    ("words", "in_python"),
    [
        ("give --left TOPIC --right TOPIC (or --depth)", "give left=TOPIC right=TOPIC (or depth)"),
        ("by --out, or --force to replace it", "by out, or force=True to replace it"),
        ("--ground-truth /robot: of base_link", "ground_truth /robot: of base_link"),
        ("(--set depth.scale=5000 if right)", '(settings=["depth.scale=5000"] if right)'),
        ("see `gvo config --all`; a--b, /x/--force", "see `gvo config --all`; a--b, /x/--force"),
    ],
)
def test_python_is_told_parameters_and_the_command_line_flags(
    monkeypatch: pytest.MonkeyPatch, words: str, in_python: str
) -> None:
    monkeypatch.setattr(GvoError, "names_flags", False)
    assert str(OutputError(words)) == said(words) == in_python
    with flags_named():
        assert str(OutputError(words)) == words
    assert str(OutputError(words)) == in_python


def test_in_a_clone_the_clone_is_installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    clone = tmp_path
    (clone / "pyproject.toml").write_text("")
    monkeypatch.setattr(gvo.errors, "__file__", str(clone / "gvo/errors.py"))
    assert str(missing_extra("gvo view needs viser", "view")).endswith(f"'{clone}[view]'")


@pytest.mark.parametrize("is_local", [True, False])
def test_an_installed_gvo_is_taken_from_where_it_came_from(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_local: bool
) -> None:
    folder = tmp_path / "a clone"
    folder.mkdir()
    url = folder.as_uri() if is_local else "https://example.org/gvo.whl"
    found = SimpleNamespace(read_text=lambda name: json.dumps({"url": url}))
    monkeypatch.setattr(gvo.errors, "__file__", str(tmp_path / "site-packages/gvo/errors.py"))
    monkeypatch.setattr(importlib.metadata, "distribution", lambda name: found)
    wanted = f"{folder}[batch]" if is_local else "gvo[batch]"
    assert str(missing_extra("batches need pandas", "batch")).endswith(f"pip install '{wanted}'")
    found.read_text = lambda name: None
    assert str(missing_extra("batches need pandas", "batch")).endswith("pip install 'gvo[batch]'")


@pytest.mark.parametrize("error", [BrokenPipeError(32, "Broken pipe"), OSError(28, "No space")])
def test_what_cannot_be_written_is_named(error: OSError) -> None:
    said = rf"^a: cannot be written: {error.strerror}$"
    with pytest.raises(OutputError, match=said), write_faults(OutputError, "a"):
        raise error


def test_a_pipe_that_nobody_reads_ends_what_is_not_written_to_a_file() -> None:
    with pytest.raises(BrokenPipeError), named_faults(GvoError, "gvo"):
        raise BrokenPipeError
    with pytest.raises(GvoError, match=r"^b: No such file"), named_faults(GvoError, "a"):
        raise FileNotFoundError(2, "No such file", "b")
