"""One task: a recording, run with a configuration, and the row of the table that it gives."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

from gvo._text import read_text
from gvo._version import __version__
from gvo.config import Config
from gvo.errors import ConfigurationError, GvoError, OutputError, RunBusyError, flags_named
from gvo.io.excerpt import Excerpt
from gvo.io.opening import RecordingOptions, open_recording
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import Source
from gvo.io.run_folder.reader import MAX_SUMMARY_BYTES
from gvo.io.run_folder.writer import SUMMARY
from gvo.runs.outputs.options import RunOutputs
from gvo.runs.result import RunResult
from gvo.runs.run import run_recording
from gvo.runs.summary import digest, run_identity
from gvo.types import Progress

# A value of a parameter, as YAML gives it.
Value: TypeAlias = float | int | bool | str | None
RunStatus: TypeAlias = Literal["complete", "partly", "failed"]
# Of a summary, as they are there.
_TAKEN_OVER = ("sensor", "frames", "tracked", "coverage_percent", "gvo_version")
_STAGES = ("extract", "register", "links", "window")
MARK = "batch.json"
# How long to wait for another process that writes the folder of the run.
_BUSY_S = 30.0
_BUSY_TICK_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchRow:
    """One recording, run with one configuration.

    Missing values are None: errors without ground truth, all measures of a failed run.

    Parameters
    ----------
    recording : str
        Its name, unique in the batch.
    variant : str
        Name of the configuration, unique; `default` if there is only one.
    status : {"complete", "partly", "failed"}
        Exit codes 0, 3, 2 of `gvo run`.
    reason : str
        Why the run is not complete.
    source : str
        Path of the recording.
    folder : str
        Run folder, relative to the batch's.
    parameters : dict of str to value
        Those in which the configurations of the batch differ, by `section.key`.
    sensor : str
    frames, tracked : int
        Frames read, and frames tracked.
    coverage_percent : float
        Share of the frames with a pose.
    segments : int
        Segments of the trajectory; one if the camera was never lost.
    ate_raw_m, ate_causal_m, ate_smoothed_m, ate_global_m : float
        Absolute trajectory errors, metres.
    rpe_smoothed_m, rpe_smoothed_deg : float
        Relative pose errors from frame to frame.
    t_smoothed_percent, r_smoothed_deg_per_100m : float
        Errors over KITTI's segments.
    frame_ms : float
        Time from decoded images to the causal pose, the sum of the stages' medians.
    run_s : float
        Elapsed time; None if an earlier batch finished the run.
    is_found : bool
        An earlier batch finished the run.
    gvo_version : str
    configuration_hash, run_hash : str
        Digests of the configuration, and of recording, configuration and version.
    """

    recording: str
    variant: str
    status: RunStatus
    source: str
    folder: str
    reason: str = ""
    parameters: Mapping[str, Value] = field(default_factory=dict)
    sensor: str | None = None
    frames: int | None = None
    tracked: int | None = None
    coverage_percent: float | None = None
    segments: int | None = None
    ate_raw_m: float | None = None
    ate_causal_m: float | None = None
    ate_smoothed_m: float | None = None
    ate_global_m: float | None = None
    rpe_smoothed_m: float | None = None
    rpe_smoothed_deg: float | None = None
    t_smoothed_percent: float | None = None
    r_smoothed_deg_per_100m: float | None = None
    frame_ms: float | None = None
    run_s: float | None = None
    is_found: bool = False
    gvo_version: str = ""
    configuration_hash: str = ""
    run_hash: str = ""


def _measures_of(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the measures of a row from the `summary.json` of its run."""
    errors = {each["name"]: each for each in summary["errors"]}
    smoothed = errors.get("smoothed", {})
    medians = summary["median_ms"]
    return {
        **{name: summary[name] for name in _TAKEN_OVER},
        "segments": len(summary["segments"]),
        **{f"ate_{name}_m": each["ate_m"] for name, each in errors.items()},
        "rpe_smoothed_m": smoothed.get("rpe_m"),
        "rpe_smoothed_deg": smoothed.get("rpe_deg"),
        "t_smoothed_percent": smoothed.get("t_pct"),
        "r_smoothed_deg_per_100m": smoothed.get("r_deg_per_100m"),
        "frame_ms": sum(medians[stage] for stage in _STAGES),
    }


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
        Draw the picture and the report of each run; the batch's own report is always drawn.
    force : bool
        Also run what an earlier batch has finished, and replace other results.
    """

    recording: RecordingOptions = field(default_factory=RecordingOptions)
    excerpt: Excerpt | None = None
    report: bool = True
    force: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskOptions:
    """What all tasks of a batch share; by `mark` a worker sees whether `out` is the same disk."""

    out: Path
    mark: str
    batch: BatchOptions = field(default_factory=BatchOptions)
    gvo_version: str = __version__


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A recording and a configuration; the run's folder is relative to the batch's."""

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


@flags_named()
def run_task(
    task: Task, options: TaskOptions, *, on_progress: Callable[[Progress], None] | None = None
) -> BatchRow:
    """Run a recording unless its folder holds the finished run; replace any other run there."""
    start = time.perf_counter()
    try:
        _check_worker(options)
        source = open_recording(
            Path(task.source), config=task.config, options=options.batch.recording
        )
        result, is_found = _when_free(lambda: _find_or_run(source, task, options, on_progress))
    except GvoError as error:
        return task.row("failed", str(error))
    status: RunStatus = "complete" if result.is_complete else "partly"
    return replace(
        task.row(status, "" if status == "complete" else "; ".join(result.warnings)),
        **_measures_of(result.summary),
        run_s=None if is_found else time.perf_counter() - start,
        is_found=is_found,
        run_hash=digest([result.summary["run"], result.summary["configuration"]]),
    )


def _check_worker(options: TaskOptions) -> None:
    """Refuse a worker of another version, or one that does not see the folder of the batch."""
    if options.gvo_version != __version__:
        raise ConfigurationError(
            f"the worker has gvo {__version__}, the client {options.gvo_version}: install one"
        )
    try:
        mark = json.loads((options.out / MARK).read_text(encoding="utf-8"))["mark"]
    except (OSError, ValueError, KeyError, TypeError):
        mark = None
    if mark != options.mark:
        raise OutputError(
            f"{options.out}: the worker does not see the client's folder there; give --out on a "
            "disk that both share, and run one batch at a time in it"
        )


def _find_or_run(
    source: Source,
    task: Task,
    options: TaskOptions,
    on_progress: Callable[[Progress], None] | None,
) -> tuple[RunResult, bool]:
    """Return the run, and whether it was found finished."""
    folder = options.out / task.folder
    found = None if options.batch.force else _find_finished(folder, source, task, options)
    if found is not None:
        return found, True
    result = run_recording(
        source,
        folder,
        config=task.config,
        excerpt=options.batch.excerpt,
        outputs=RunOutputs(report=options.batch.report),
        force=True,
        on_progress=on_progress,
    )
    return result, False


def _find_finished(
    folder: Path, source: Source, task: Task, options: TaskOptions
) -> RunResult | None:
    """Return the complete run in the folder of a task, if it is the task's own."""
    try:
        summary = json.loads(read_text(folder / SUMMARY, max_bytes=MAX_SUMMARY_BYTES))
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
