"""A stream of lines, answered line by line: a window for a front-end in any language."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from gvo.backend.window import Keeping
from gvo.config import Config
from gvo.io.edges.events import EdgeEvent, InputFaults, PoseEvent
from gvo.io.edges.lines import (
    CSV_HEADER,
    LineFormat,
    Request,
    detect_format,
    format_error,
    format_estimate,
    is_header,
    parse_line,
)
from gvo.io.run_folder.writer import RunFolder
from gvo.runs import RunResult
from gvo.smoothing import POSES_HEADER, Smoother, SmoothingNotes, conclude
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Estimate, Rejected


def smooth_lines(
    lines: Iterable[str],
    answer: Callable[[str], None],
    out: str | Path,
    *,
    config: Config | None = None,
    keyframes: Keeping = "distance",
    ground_truth: Trajectory | None = None,
) -> RunResult:
    """Smooth a stream of poses and edges, answering each line at once.

    Parameters
    ----------
    lines : iterable of str
        CSV or JSON, told by the first one; see `gvo.io.edges.lines`.
    answer : callable
        Gets the answer to each line that holds anything, without its line end: the estimate of
        the line's pose, or `{"error": ...}`.
    out : str or Path
        Folder, as of `smooth_edges`.
    config : Config, optional
    keyframes : {"manual", "distance"}
        Who keeps poses beside the stream's own `keep`.
    ground_truth : Trajectory, optional
        True poses of the same frame.

    Returns
    -------
    RunResult
        Exit code 3 where a line was malformed.

    Raises
    ------
    RecordingError
        When no line held a pose, or the folder cannot be written.
    """
    config = config or Config()
    faults = InputFaults()
    with RunFolder(Path(out), columns=POSES_HEADER) as folder:
        smoother = Smoother(folder, config, keyframes=keyframes)
        try:
            _answer_all(lines, answer, smoother, faults)
        except OSError as error:
            faults.add("answers could not be written", f"the stream ends there: {error.strerror}")
        finally:
            smoother.finish()
    notes = SmoothingNotes(warnings=faults.warnings())
    return conclude(
        "standard input", folder, smoother, config=config, notes=notes, truth=ground_truth
    )


def _answer_all(
    lines: Iterable[str],
    answer: Callable[[str], None],
    smoother: Smoother,
    faults: InputFaults,
) -> None:
    line_format: LineFormat | None = None
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        if line_format is None:
            line_format = detect_format(line)
            if line_format == "csv" and is_header(line):
                answer(CSV_HEADER)
                continue
        try:
            reply = _reply(parse_line(line, line_format), smoother, line_format)
        except ValueError as error:
            faults.add("lines were not understood", f"line {number}: {error}")
            reply = format_error(f"line {number}: {error}")
        answer(reply)


def _reply(request: Request, smoother: Smoother, line_format: LineFormat) -> str:
    frame_id = request.frame_id
    if frame_id not in smoother.window:
        estimate, rejected = _add(request, smoother), list[Rejected]()
    else:
        estimate, rejected = _extend(request, smoother)
    if request.keep is not None and frame_id in smoother.window:
        (smoother.window.keep if request.keep else smoother.window.release)(frame_id)
    return format_estimate(estimate, line_format, rejected)


def _add(request: Request, smoother: Smoother) -> Estimate:
    if request.stamp_ns is None:
        raise ValueError(f"{request.frame_id!r} is not in the window; a new pose needs a stamp")
    return smoother.add_pose(
        PoseEvent(
            frame_id=request.frame_id,
            stamp_ns=request.stamp_ns,
            edges=request.edges,
            prior=request.prior,
        )
    )


def _extend(request: Request, smoother: Smoother) -> tuple[Estimate, list[Rejected]]:
    """Add edges and prior to a pose of the window; return its estimate and what was refused."""
    frame_id, window = request.frame_id, smoother.window
    if request.stamp_ns not in (None, window.stamp_ns(frame_id)):
        raise ValueError(
            f"{frame_id!r} is in the window with the stamp {window.stamp_ns(frame_id)}, got "
            f"{request.stamp_ns}"
        )
    answers: list[Estimate | Rejected] = [
        smoother.add_edge(EdgeEvent(frame_id=frame_id, edge=edge)) for edge in request.edges
    ]
    if request.prior is not None:
        answers.append(window.add_prior(frame_id, request.prior))
    rejected = [reply for reply in answers if isinstance(reply, Rejected)]
    return window.estimate(frame_id), rejected
