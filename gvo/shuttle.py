"""A recording driven there and back: errors that show without a ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.excerpt import Excerpt
from gvo.io.poses.base_frame import OutputFrame
from gvo.io.recording import Source
from gvo.io.run_folder.writer import SHUTTLE_PICTURE, TRAJECTORIES, RunFolder
from gvo.run_loop import RunLoop
from gvo.run_summary import summarize
from gvo.run_tally import Progress
from gvo.runs import EXIT_COMPLETE, EXIT_PARTLY
from gvo.sources.backwards import ThereAndBack
from gvo.trajectory.formats import read_covariances, read_trajectory
from gvo.trajectory.round_trip import Closing, close
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure
from gvo.viz.plots import plot_shuttle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShuttleResult:
    """What a drive there and back left.

    Parameters
    ----------
    summary : dict
        As written to `summary.json`; `shuttle` holds the closing errors.
    closings : dict of str to Closing
        Of raw, causal and smoothed.
    turn_ns : int
        Stamp of the frame at the turn, nanoseconds.
    exit_code : int
        0 complete, 3 partly.
    warnings : tuple of str
        What was skipped or broke off, a line each.
    """

    summary: dict[str, Any]
    closings: dict[str, Closing]
    turn_ns: int
    exit_code: int
    warnings: tuple[str, ...]


def shuttle(
    source: Source,
    out: str | Path,
    *,
    config: Config | None = None,
    excerpt: Excerpt | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> ShuttleResult:
    """Drive a recording forward, then backward, and tell how far it ends from its start.

    The sequence of frames is given to odometry as one recording of twice the length, and a run
    folder is written as `run_recording` does, with `shuttle.png` beside it.

    Parameters
    ----------
    source : Source
        From `open_recording`, or a rendered one; is read again for the way back.
    out : str or Path
        Folder for the trajectories, covariances, tables, summary and picture.
    config : Config, optional
    excerpt : Excerpt, optional
        Which frames are read; all where omitted.
    on_progress : callable, optional
        Called after each frame.

    Returns
    -------
    ShuttleResult

    Raises
    ------
    RecordingError
        When fewer than two frames are usable, the recording cannot be read on the way back, or
        what is to be written cannot be.

    Notes
    -----
    A closing error is a lower bound of the drift. Both ways rest on the same images: noise of
    the images, and whatever reverses with the motion (a wrong baseline, depths that are all too
    large, a tilted rectification), gives opposite errors there and back, and cancels. So a large
    closing error shows that something is wrong, and a small one does not show that all is well.
    What it measures is what depends on the direction of the drive: bias of the estimator, lost
    tracks, chance.

    The raw chain has no memory, its closing error is that of the registrations. The window has:
    near the turn it still holds keyframes of the way there, and where the camera never loses sight
    of its start, the way back is tied to the way there directly. Then the closing error of causal
    and smoothed says how well keyframes are found again, nothing of their drift.

    References
    ----------
    Z. Kalal, K. Mikolajczyk, J. Matas, "Forward-Backward Error: Automatic Detection of Tracking
    Failures", ICPR 2010, doi:10.1109/ICPR.2010.675.
    """
    config = config or Config()
    way = ThereAndBack(source, config, excerpt)
    frame = OutputFrame(source.info.frame_id)
    loop = RunLoop(source, config, frame, excerpt=excerpt, items=way)
    with RunFolder(Path(out)) as folder:
        loop.run([folder], None if on_progress is None else _doubled(on_progress))
    turn_ns = way.turn_ns
    if turn_ns is None:
        raise RecordingError(f"{source.info.name}: no usable frame: {loop.tally.reason()}")
    closings = _close(folder.path, turn_ns, source.info.name)
    warnings = loop.tally.warnings()
    summary = _summary(loop, warnings, turn_ns, closings)
    folder.write_summary(summary)
    plot_shuttle(folder.path / SHUTTLE_PICTURE, closings)
    return ShuttleResult(
        summary=summary,
        closings=closings,
        turn_ns=turn_ns,
        exit_code=EXIT_PARTLY if loop.tally.is_partly else EXIT_COMPLETE,
        warnings=tuple(warnings),
    )


def _doubled(on_progress: Callable[[Progress], None]) -> Callable[[Progress], None]:
    """Return a callback that is told of the way back as well; the turn is there once."""

    def tell(progress: Progress) -> None:
        on_progress(replace(progress, n_total=max(2 * progress.n_total - 1, 0)))

    return tell


def _close(folder: Path, turn_ns: int, name: str) -> dict[str, Closing]:
    trajectories = {name: _read(folder, name) for name in TRAJECTORIES}
    path_m = float(trajectories["smoothed"].distances()[-1])
    closings: dict[str, Closing] = {}
    for label, trajectory in trajectories.items():
        closing = close(trajectory, turn_ns, path_m=path_m)
        if isinstance(closing, Failure):
            raise RecordingError(f"{name}: cannot be driven there and back: {closing.reason}")
        closings[label] = closing
    return closings


def _read(folder: Path, name: str) -> Trajectory:
    trajectory = read_trajectory(folder / f"{name}.txt")
    _, covariances = read_covariances(folder / f"{name}_covariance.csv")
    return replace(trajectory, covariances=covariances)


def _summary(
    loop: RunLoop, warnings: list[str], turn_ns: int, closings: dict[str, Closing]
) -> dict[str, Any]:
    summary = summarize(loop, Failure(reason="driven there and back"), warnings)
    summary["recording"] = f"{loop.source.info.name}, there and back"
    summary["shuttle"] = {
        "turn_ns": turn_ns,
        "path_m": closings["smoothed"].path_m,
        "estimates": {name: closing.as_json() for name, closing in closings.items()},
    }
    return summary
