"""One recording, one run folder: what `gvo run`, the scripts and batches call."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gvo.config import Config
from gvo.errors import GvoError, RecordingError, said
from gvo.io.bag.source import CAMERA_CHANGED, describe_camera_changes
from gvo.io.excerpt import Excerpt
from gvo.io.frames import Through
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.poses.inputs import recorded_truth
from gvo.io.poses.truth import Truth, TruthComparison, initial_pose
from gvo.io.recording import OTHER_SIZE, Source
from gvo.io.run_folder.reader import read_estimates, read_run
from gvo.io.run_folder.writer import GLOBAL, PICTURE, REPORT, RunFolder, save_summary, written_alone
from gvo.runs.gravity import align_with_gravity
from gvo.runs.loop import Output, RunLoop, motions_of_window
from gvo.runs.outputs.file import FileOutput
from gvo.runs.outputs.options import RunOutputs
from gvo.runs.result import RunResult
from gvo.runs.summary import RunningSummary, optimum_json, run_identity, summarize
from gvo.trajectory.alignment import MAX_DIFFERENCE_NS
from gvo.trajectory.consistency import judged
from gvo.trajectory.evaluation import Evaluation
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray, Optimum, Progress

_LOGGER = logging.getLogger(__name__)


def run_recording(
    source: Source,
    out: str | Path,
    *,
    config: Config | None = None,
    ground_truth: Trajectory | Truth | None = None,
    base_frame: BaseFrame | None = None,
    starts_at_truth: bool = False,
    gravity_aligned: bool = False,
    excerpt: Excerpt | None = None,
    outputs: RunOutputs | None = None,
    force: bool = False,
    through: Through | None = None,
    on_start: Callable[[RunLoop, Callable[[], Future[int]]], Iterable[Output]] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    on_written: Callable[[], None] | None = None,
) -> RunResult:
    """Run odometry over a recording and write a run folder.

    Parameters
    ----------
    source : Source
        From `open_recording`, or a rendered one.
    out : str or Path
        Folder for the trajectories, covariances, tables, summary and report.
    config : Config, optional
    ground_truth : Trajectory or Truth, optional
        Poses of the base frame; those of the recording if omitted.
    base_frame : BaseFrame, optional
        The frame whose poses are written, and its first pose; if omitted, the camera's, beginning
        at the identity.
    starts_at_truth : bool
        Start at the true pose of the first frame.
    gravity_aligned : bool
        Turn the world so that z points up, by the IMU; the first position and heading stay.
    excerpt : Excerpt, optional
        The frames to read; all if omitted.
    outputs : RunOutputs, optional
        What to write besides the tables; the report if omitted.
    force : bool
        Replace an earlier run in the folder, and plots.
    through : callable, optional
        Queues the frames of a running camera; see `gvo.frames`.
    on_start : callable, optional
        Called before the first frame with the loop and a function `save`; returns outputs that
        get each frame first. `save`, called between frames, writes the summary, and in a thread
        the global poses so far. It returns a future: the number of frames, or `SmoothingError` if
        the global poses fail.
    on_progress : callable, optional
        Called after each frame.
    on_written : callable, optional
        Called when everything but the report is written.

    Returns
    -------
    RunResult

    Raises
    ------
    ConfigurationError
        If the recording has no IMU, where the world is to be aligned with gravity.
    RecordingError
        If no frame is usable.
    OutputError
        If the folder holds an earlier run, or a file cannot be written; what was written stays.
    RunBusyError
        If another process is writing to the folder.
    """
    config = config or Config()
    base_frame = base_frame or BaseFrame(source.info.frame_id)
    outputs = outputs or RunOutputs()
    outputs.check(force=force)
    truth = _find_truth(source, ground_truth, base_frame)
    _LOGGER.debug("ground truth: %s", truth.decision if isinstance(truth, Truth) else truth.reason)
    first_pose = partial(initial_pose, truth) if starts_at_truth else None
    start = truth.trajectory if starts_at_truth and isinstance(truth, Truth) else None
    identity = run_identity(source, base_frame, excerpt, start=start, is_live=through is not None)
    loop = RunLoop(
        *(source, config, base_frame), excerpt=excerpt, first_pose=first_pose, through=through
    )
    if gravity_aligned:
        identity["output"]["z is up"] = True
        align_with_gravity(loop, on_progress)
    with ExitStack() as stack, ExitStack() as files:
        stack.enter_context(written_alone(Path(out), force=force))
        others = outputs.open(loop, files)
        folder = files.enter_context(RunFolder(Path(out)))
        stack.push(partial(_draw_if_interrupted, Path(out), outputs))
        with RunningSummary(loop, folder, identity, on_progress) as summary:
            with ThreadPoolExecutor(1) as pool:  # what is being saved is written to its end
                save = partial(_begin_save, loop, folder, summary, pool)
                first = on_start(loop, save) if on_start else ()
                loop.run([*first, folder, *others], summary)
            optimum = loop.optimize()
            faults = [*dict.fromkeys([*loop.output_faults, *_close([folder, *others])])]
            files.pop_all()  # nothing is left to close
        _LOGGER.debug("all frames are tracked; comparing and writing the summary")
        is_asked = ground_truth is not None
        identity = {GLOBAL: optimum_json(optimum), "run": identity}
        result = _conclude(loop, folder, identity, truth, faults, is_asked=is_asked)
    if on_written is not None:
        on_written()
    return drawn(result, Path(out), plots=outputs.plots) if outputs.report else result


def _begin_save(
    loop: RunLoop, folder: RunFolder, summary: RunningSummary, pool: ThreadPoolExecutor
) -> Future[int]:
    """Write the summary, and in a thread the global poses so far; they may fail."""
    loop.count()
    summary.write("running")
    return pool.submit(_save, folder, loop.begin_optimum(), loop.statistics.n_frames)


def _save(folder: RunFolder, compute: Callable[[], Optimum | None], n_frames: int) -> int:
    optimum = compute()
    if optimum is not None:
        folder.add_optimum(optimum)
    return n_frames


def _close(files: Iterable[RunFolder | FileOutput]) -> list[str]:
    """Close the files; return the reasons why some could not be completed."""
    faults: list[str] = []
    for file in files:
        try:
            file.close()
        except RecordingError as error:
            faults.append(str(error))
    return faults


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fault(Failure):
    """A truth exists, but cannot be read or compared."""


def _find_truth(
    source: Source, given: Trajectory | Truth | None, base_frame: BaseFrame
) -> Truth | Failure:
    if isinstance(given, Trajectory):
        return Truth(trajectory=given, decision="given")
    if given is not None:
        return given
    try:
        return recorded_truth(source, base_frame=base_frame)
    except GvoError as error:
        # Nobody asked for this truth: the run goes on without it.
        return _Fault(reason=str(error))


def _conclude(
    loop: RunLoop,
    folder: RunFolder,
    known: dict[str, Any],
    truth: Truth | Failure,
    faults: list[str],
    *,
    is_asked: bool,
) -> RunResult:
    """Compare with the truth, and write the truth and the summary."""
    if loop.statistics.n_with_pose == 0:
        folder.discard()
        raise RecordingError(
            f"{loop.source.info.name}: no usable frame: {loop.statistics.reason()}"
        )
    compared = _compare(truth, folder, loop)
    warnings = [*loop.statistics.warnings(), *_warnings_of_camera(loop.source)]
    warnings = [*map(said, warnings), *faults, *map(said, _warnings_of_truth(compared))]
    evaluations: tuple[Evaluation, ...] = ()
    if isinstance(compared, TruthComparison):
        folder.write_truth(compared.truth.trajectory)
        evaluations = compared.evaluations
    is_complete = loop.statistics.is_complete and not faults and bool(compared or not is_asked)
    summary = summarize(loop, compared, warnings)
    summary |= {"is_complete": is_complete, **known}
    summary |= _measure(folder, loop, compared)
    folder.write_summary(summary)
    return RunResult(
        summary=summary, evaluations=evaluations, is_complete=is_complete, warnings=tuple(warnings)
    )


def _measure(
    folder: RunFolder, loop: RunLoop, compared: TruthComparison | Failure
) -> dict[str, Any]:
    """Return path length, extent, and how the covariances fit the truth, if there is one."""
    smoothed = read_trajectory(folder.path / "smoothed.txt")
    T_base_cam = loop.base_frame.T_base_cam(int(smoothed.stamps_ns[0]))
    found = {
        "path_m": float(smoothed.distances()[-1]),
        "extent_m": float(np.linalg.norm(np.ptp(smoothed.positions, axis=0))),
        "heading_deg": _heading_deg(smoothed, T_base_cam[:3, 2]),
    }
    if not isinstance(compared, TruthComparison):
        return found | {"truth_jump_m": None, "nees": {}, "reference": None}
    window = {span_s: motions_of_window(edges) for span_s, edges in loop.edges.items()}
    return found | judged(compared.truth.trajectory, compared.estimates["raw"], window)


def _heading_deg(trajectory: Trajectory, axis: FloatArray) -> float:
    """Return the angle between the way and an axis of the frame, forward or back, in the mean."""
    axes, steps = (
        trajectory.T_world_frame[:-1, :3, :3] @ axis,
        np.diff(trajectory.positions, axis=0),
    )
    share = np.abs(np.sum(axes * steps, axis=1)).sum() / max(trajectory.distances()[-1], 1e-9)
    return float(np.rad2deg(np.arccos(min(share, 1.0))))


def _compare(truth: Truth | Failure, folder: RunFolder, loop: RunLoop) -> TruthComparison | Failure:
    if isinstance(truth, Failure):
        return truth
    estimates = read_estimates(folder.path)
    try:
        return TruthComparison.of(_within(truth, folder, loop), estimates)
    except GvoError as error:
        return _Fault(reason=str(error))


def _within(truth: Truth, folder: RunFolder, loop: RunLoop) -> Truth:
    """Give a truth without stamps those of the frames; cut a truth with stamps to the excerpt."""
    stamps_ns = folder.frame_stamps_ns()
    trajectory = truth.trajectory
    if trajectory.stamps_from == "rows" and len(trajectory) == len(stamps_ns):
        trajectory = Trajectory(stamps_ns=stamps_ns, T_world_frame=trajectory.T_world_frame)
    if not loop.excerpt.is_everything and trajectory.stamps_from != "rows":
        first, last = stamps_ns.min() - MAX_DIFFERENCE_NS, stamps_ns.max() + MAX_DIFFERENCE_NS
        start, end = np.searchsorted(trajectory.stamps_ns, [first, last])
        trajectory = trajectory.select(slice(int(start), int(end)))
    return replace(truth, trajectory=trajectory)


def _warnings_of_camera(source: Source) -> Iterator[str]:
    if source.info.doubt:
        yield f"{source.info.doubt}; {OTHER_SIZE}"
    if changes := describe_camera_changes(source):
        yield f"CameraInfo changes on the way ({changes}): {CAMERA_CHANGED}"


def _warnings_of_truth(compared: TruthComparison | Failure) -> list[str]:
    if isinstance(compared, TruthComparison):
        return [f"ground truth: {text}" for text in compared.warnings()]
    if isinstance(compared, _Fault):
        return [f"not compared with the ground truth: {compared.reason}"]
    return []


def drawn(result: RunResult, folder: Path, *, plots: Path | None = None) -> RunResult:
    """Draw the report of a run; if that fails, return the result with a warning."""
    try:
        _draw(folder, plots=plots)
    except (GvoError, OSError) as error:
        warnings = (*result.warnings, f"not all was drawn: {error}")
        summary = result.summary | {"is_complete": False, "warnings": list(warnings)}
        with suppress(OSError):
            save_summary(folder, summary)
        result = replace(result, summary=summary, is_complete=False, warnings=warnings)
    page = folder / REPORT
    return replace(result, report=page if page.exists() else None)


def _draw_if_interrupted(folder: Path, outputs: RunOutputs, kind: object, *_: object) -> None:
    """Draw the report of an interrupted run; a second interrupt ends the drawing."""
    if kind is KeyboardInterrupt and outputs.report:
        with suppress(GvoError, OSError):
            _draw(folder, plots=outputs.plots)


def _draw(folder: Path, *, plots: Path | None) -> None:
    """Draw the picture and write the report."""
    _LOGGER.debug("drawing %s and %s", folder / PICTURE, folder / REPORT)
    from gvo.viz.plots import plot_trajectories
    from gvo.viz.report import write_run_report

    record = read_run(folder)
    plot_trajectories(folder / PICTURE, record.truth, record.comparable(), loops=record.loops)
    write_run_report(folder / REPORT, record, plots=plots)
