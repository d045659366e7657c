"""How a run begins in a folder: anew, where it was interrupted, or not at all: it is complete."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from gvo.bounded_text import read_text
from gvo.errors import ResumeError
from gvo.io.run_folder.writer import JOURNAL, SUMMARY, RunFolder
from gvo.resuming.header import find_difference
from gvo.resuming.journal import Journal
from gvo.resuming.record_file import refuse_busy

State: TypeAlias = Literal["running", "interrupted", "complete"]

_CONFIGURATION = "configuration"
_ANEW = "run without --resume to replace it, or give another --out"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Beginning:
    """The files of a run that begins or goes on; both are to be closed.

    Parameters
    ----------
    folder : RunFolder
    journal : Journal
    """

    folder: RunFolder
    journal: Journal


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Complete:
    """A run that is complete.

    Parameters
    ----------
    summary : dict
        As in its `summary.json`.
    """

    summary: dict[str, Any]


def identity(header: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a summary holds of a header: all but the configuration, which it has anyway."""
    return {name: value for name, value in header.items() if name != _CONFIGURATION}


def begin(path: Path, header: dict[str, Any], *, resume: bool) -> Beginning | Complete:
    """Open the files of a run.

    Parameters
    ----------
    path : Path
        The run folder.
    header : dict
        Of the run that is asked for, see `describe_run`.
    resume : bool
        Go on where a run in the folder was interrupted; else it is replaced.

    Raises
    ------
    OutputError
        When the folder cannot be written.
    ResumeError
        When it holds another run, or one that another process is writing.
    """
    found = _find(path, header) if resume else None
    if isinstance(found, Complete):
        return found
    with ExitStack() as stack:
        if found is None:
            refuse_busy(path / JOURNAL)
        else:
            stack.callback(found.close)
        folder = RunFolder(path, goes_on=found is not None)
        stack.callback(folder.close)
        journal = found or Journal.create(path / JOURNAL, header)
        stack.pop_all()
    return Beginning(folder=folder, journal=journal)


def _find(path: Path, header: dict[str, Any]) -> Journal | Complete | None:
    """Return what there is of the run in its folder."""
    summary = _read_summary(path / SUMMARY)
    has_journal = (path / JOURNAL).exists()
    if summary and (summary.get("state") == "complete" or not has_journal):
        there = summary.get("run")
        if not isinstance(there, dict):
            raise ResumeError(f"{path}: holds no run of `gvo run` that could go on; {_ANEW}")
        _refuse_other(path, {**there, _CONFIGURATION: summary.get(_CONFIGURATION)}, header)
        return Complete(summary=summary)
    journal = Journal.open(path / JOURNAL)
    if journal is not None:
        try:
            _refuse_other(path, journal.header, header)
        except ResumeError:
            journal.close()
            raise
    return journal


def _refuse_other(path: Path, there: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    if difference := find_difference(there, asked):
        raise ResumeError(f"{path}: holds another run: {difference}; {_ANEW}")


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        summary = json.loads(read_text(path))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise ResumeError(f"{path}: cannot be read: {error}; {_ANEW}") from error
    return summary if isinstance(summary, dict) else {}
