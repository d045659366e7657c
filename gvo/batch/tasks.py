"""One task of a batch: one recording, run with one configuration on a worker."""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from gvo._text import read_text
from gvo._version import __version__
from gvo.batch.rows import BatchRow, RunStatus, Value, measures_of
from gvo.batch.storage import fetch, fetch_file, is_url, store
from gvo.config import Config
from gvo.errors import ConfigurationError, GvoError, OutputError, RunBusyError
from gvo.io.excerpt import Excerpt
from gvo.io.opening import RecordingOptions, open_recording
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import Source
from gvo.io.run_folder.writer import SUMMARY
from gvo.runs.outputs.options import RunOutputs
from gvo.runs.run import RunResult, run_recording
from gvo.runs.summary import run_identity
from gvo.types import Progress

MARK = "batch.json"
# How long to wait for another process that writes the folder of the run.
_BUSY_S = 30.0
_BUSY_TICK_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchOptions:
    """What all runs of a batch have in common.

    Parameters
    ----------
    recording : RecordingOptions
        Topics and calibration.
    excerpt : Excerpt, optional
        Which frames are read; all if omitted.
    report : bool
        Draw the picture and the page of each run; those of the batch are always drawn.
    force : bool
        Run what an earlier batch has finished again.
    plots : Path, optional
        Folder for each plot of the batch's report as PNG and PDF; one that holds something is
        refused, unless `force` is set or the batch is one that goes on.
    """

    recording: RecordingOptions = field(default_factory=RecordingOptions)
    excerpt: Excerpt | None = None
    report: bool = True
    force: bool = False
    plots: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskOptions:
    """What all tasks of a batch have in common.

    Parameters
    ----------
    out : str
        Folder of the batch, as an absolute path or a URL.
    mark : str
        Token in its `batch.json`: a worker that does not read it there has another disk.
    batch : BatchOptions
    gvo_version : str
        Of the client; a worker with another version refuses the task.
    """

    out: str
    mark: str
    batch: BatchOptions = field(default_factory=BatchOptions)
    gvo_version: str = __version__


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A recording and a configuration.

    Parameters
    ----------
    recording, variant : str
        Names of the recording and of the configuration.
    source : str
        Absolute path or URL of the recording.
    folder : str
        Run folder, relative to the batch's.
    config : Config
    parameters : dict of str to value
        Those in which the configurations of the batch differ.
    """

    recording: str
    variant: str
    source: str
    folder: str
    config: Config
    parameters: Mapping[str, Value] = field(default_factory=dict)

    def row(self, status: RunStatus, reason: str = "") -> BatchRow:
        """Return the task's row of the table, without measures."""
        return BatchRow(
            recording=self.recording,
            variant=self.variant,
            status=status,
            reason=reason,
            source=self.source,
            folder=self.folder,
            parameters=self.parameters,
            gvo_version=__version__,
            configuration_hash=digest(self.config.model_dump(mode="json")),
        )


def run_task(
    task: Task,
    options: TaskOptions,
    *,
    scratch: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> BatchRow:
    """Run a recording, unless its folder holds the finished run; replace any other there.

    Parameters
    ----------
    task : Task
    options : TaskOptions
    scratch : Path, optional
        Folder for copies from and to URLs; the system's temporary folder if omitted.
    on_progress : callable, optional
        Called after each frame.

    Returns
    -------
    BatchRow
        Failed, with its reason, wherever a `GvoError` was raised.
    """
    start = time.perf_counter()
    try:
        if options.gvo_version != __version__:
            raise ConfigurationError(
                f"the worker has gvo {__version__}, the client {options.gvo_version}: install one"
            )
        with tempfile.TemporaryDirectory(prefix="gvo-", dir=scratch) as copies:
            result, is_found = _run(task, options, Path(copies), on_progress)
    except GvoError as error:
        return task.row("failed", str(error))
    status: RunStatus = "complete" if result.is_complete else "partly"
    return replace(
        task.row(status, "" if status == "complete" else "; ".join(result.warnings)),
        **measures_of(result.summary),
        run_s=None if is_found else time.perf_counter() - start,
        is_found=is_found,
        run_hash=digest([result.summary["run"], result.summary["configuration"]]),
    )


def digest(values: object) -> str:
    """Return a digest of values that JSON can hold."""
    text = json.dumps(values, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _run(
    task: Task, options: TaskOptions, copies: Path, on_progress: Callable[[Progress], None] | None
) -> tuple[RunResult, bool]:
    """Return the run, and whether it was found finished."""
    path = fetch(task.source, copies) if is_url(task.source) else Path(task.source)
    source = open_recording(path, config=task.config, options=options.batch.recording)

    if not is_url(options.out):
        out = Path(options.out)
        _check_same_disk(out, options.mark)
        return _when_free(
            lambda: _find_or_run(out / task.folder, source, task, options, on_progress)
        )
    folder, url = copies / "run", f"{options.out.rstrip('/')}/{task.folder}"
    folder.mkdir()
    fetch_file(f"{url}/{SUMMARY}", folder / SUMMARY)
    result, is_found = _find_or_run(folder, source, task, options, on_progress)
    if not is_found:
        store(folder, url)
    return result, is_found


def _find_or_run(
    folder: Path,
    source: Source,
    task: Task,
    options: TaskOptions,
    on_progress: Callable[[Progress], None] | None,
) -> tuple[RunResult, bool]:
    found = None if options.batch.force else _find_finished(folder, source, task, options)
    if found is not None:
        return found, True
    outputs = RunOutputs(report=options.batch.report)
    result = run_recording(
        source,
        folder,
        config=task.config,
        excerpt=options.batch.excerpt,
        outputs=outputs,
        force=True,
        on_progress=on_progress,
    )
    return result, False


def _find_finished(
    folder: Path, source: Source, task: Task, options: TaskOptions
) -> RunResult | None:
    """Return the complete run in the folder of a task, if it is the task's own."""
    try:
        summary = json.loads(read_text(folder / SUMMARY))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(summary, dict) or summary.get("state") != "complete":
        return None
    identity = run_identity(source, BaseFrame(source.info.frame_id), options.batch.excerpt)
    there = summary.get("run"), summary.get("configuration")
    if there != (identity, task.config.model_dump(mode="json")):
        return None
    return RunResult(
        summary=summary,
        evaluations=(),
        is_complete=summary.get("is_complete") is True,
        warnings=tuple(summary.get("warnings", ())),
    )


def _when_free(run: Callable[[], tuple[RunResult, bool]]) -> tuple[RunResult, bool]:
    """Run as soon as no other process writes the folder.

    A worker that was given up, or whose batch was stopped, may still write for a while.
    """
    end_s = time.monotonic() + _BUSY_S
    while True:
        try:
            return run()
        except RunBusyError:
            if time.monotonic() > end_s:
                raise
            time.sleep(_BUSY_TICK_S)


def _check_same_disk(out: Path, mark: str) -> None:
    try:
        is_there = json.loads((out / MARK).read_text(encoding="utf-8"))["mark"] == mark
    except (OSError, ValueError, KeyError, TypeError):
        is_there = False
    if not is_there:
        raise OutputError(
            f"{out}: the worker does not see the client's folder there; give --out on a disk that "
            "both share, or a URL; and run one batch at a time in it"
        )
