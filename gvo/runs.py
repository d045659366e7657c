"""One recording, one run folder: what `gvo run`, the scripts and batches call."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2

from gvo import __version__
from gvo.config import Config
from gvo.errors import GvoError, RecordingError, TrajectoryError
from gvo.evaluation import Evaluation, evaluate
from gvo.odometry import Odometry
from gvo.outputs.plots import plot_trajectories
from gvo.outputs.run_folder import PICTURE, TRAJECTORIES, RunFolder
from gvo.outputs.smoothings import SmoothingComparison
from gvo.outputs.tables import evaluations_json
from gvo.run_tally import Progress, RunTally
from gvo.sources.frames import frames
from gvo.sources.opening import BAG_SUFFIXES, open_recording
from gvo.sources.recording import Sensor, Source
from gvo.trajectory import Trajectory
from gvo.trajectory_files import read_trajectory
from gvo.types import FaultyFrame, Frame, Status

EXIT_COMPLETE = 0
EXIT_PARTLY = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunResult:
    """What a run left.

    Parameters
    ----------
    summary : dict
        As written to `summary.json`.
    evaluations : tuple of Evaluation
        Of raw, causal and smoothed; empty without ground truth.
    exit_code : int
        0 complete, 3 partly.
    warnings : tuple of str
        What was skipped or broke off, a line each.
    """

    summary: dict[str, Any]
    evaluations: tuple[Evaluation, ...]
    exit_code: int
    warnings: tuple[str, ...]


def run_recording(
    source: Source,
    out: str | Path,
    *,
    config: Config | None = None,
    ground_truth: Trajectory | None = None,
    compare_smoothing: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
) -> RunResult:
    """Run odometry over a recording and write a run folder.

    Parameters
    ----------
    source : Source
        From `open_recording`, or a rendered one.
    out : str or Path
        Folder for the trajectories, covariances, table of frames, summary and picture.
    config : Config, optional
    ground_truth : Trajectory, optional
        Poses of the recording's camera; the recording's own where omitted.
    compare_smoothing : bool
        Smooth the same edges also by full iSAM2 and in a batch, and tell the difference; keeps
        all of them in memory.
    on_progress : callable, optional
        Called after each frame.

    Returns
    -------
    RunResult

    Raises
    ------
    RecordingError
        When no frame is usable, or the folder cannot be written.
    """
    config = config or Config()
    tally = RunTally()
    comparison = SmoothingComparison() if compare_smoothing else None
    odometry = Odometry(
        source.info.camera, config, log=None if comparison is None else comparison.log
    )
    with (
        RunFolder(Path(out), watch=None if comparison is None else comparison.add) as folder,
        one_opencv_thread(),
    ):
        try:
            for item in _read_frames(source, config, tally):
                _take(item, odometry, folder, tally, sensor=source.info.sensor)
                if on_progress is not None:
                    on_progress(tally.progress(source.info.n_images))
        finally:
            # Also where the run is interrupted: what the window holds was computed.
            folder.add_smoothed(odometry.finish())
    tally.window, tally.polish = odometry.window.counts, odometry.window.polish
    tally.rig_offsets = odometry.rig_offsets
    return _conclude(
        source, folder, tally, config=config, ground_truth=ground_truth, comparison=comparison
    )


def read_ground_truth(path: str | Path) -> Trajectory:
    """Read the true poses of a recording's camera.

    Parameters
    ----------
    path : str or Path
        A file of poses (TUM, KITTI, EuRoC), a recording's folder, or a bag that holds them.

    Raises
    ------
    TrajectoryError
        When the file holds no poses, or the recording no ground truth.
    """
    path = Path(path)
    if (path / "groundtruth.txt").is_file():
        return read_trajectory(path / "groundtruth.txt")
    if path.is_file() and path.suffix not in BAG_SUFFIXES:
        return read_trajectory(path)
    truth = open_recording(path).ground_truth()
    if truth is None:
        raise TrajectoryError(f"{path}: this recording holds no ground truth")
    return truth


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Keep OpenCV, inside the context, from splitting single calls over threads.

    Images are worked on side by side already; splitting the small ones as well costs a tenth more
    CPU time and gains nothing.
    """
    n_before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(n_before)


def _read_frames(source: Source, config: Config, tally: RunTally) -> Iterator[Frame | FaultyFrame]:
    """Yield frames, timing the reading; where the recording breaks off, note it and end."""
    iterator = frames(source, config)
    while True:
        start = time.perf_counter()
        try:
            item = next(iterator)
        except StopIteration:
            return
        except RecordingError as error:
            tally.broken_off = str(error)
            return
        tally.add_duration("read", 1e3 * (time.perf_counter() - start))
        yield item


def _take(
    item: Frame | FaultyFrame,
    odometry: Odometry,
    folder: RunFolder,
    tally: RunTally,
    *,
    sensor: Sensor,
) -> None:
    if isinstance(item, FaultyFrame):
        # Colour and depth of a free-running sensor need not pair; the images of a stereo
        # camera are taken together, and one without the other is a loss.
        is_loss = not item.is_unpaired or sensor == "stereo"
        tally.add_faulty(item, is_loss=is_loss)
        if is_loss:
            folder.add_faulty(item)
        return
    result = odometry.track(item)
    tally.add_result(result)
    folder.add_frame(result)


def _conclude(
    source: Source,
    folder: RunFolder,
    tally: RunTally,
    *,
    config: Config,
    ground_truth: Trajectory | None,
    comparison: SmoothingComparison | None,
) -> RunResult:
    if tally.n_with_pose == 0:
        reason = (
            tally.broken_off or tally.first_fault or tally.first_unpaired or "it holds no image"
        )
        raise RecordingError(f"{source.info.name}: no usable frame: {reason}")
    estimates = {name: read_trajectory(folder.path / f"{name}.txt") for name in TRAJECTORIES}
    warnings = tally.warnings()
    truth: Trajectory | None = None
    evaluations: tuple[Evaluation, ...] = ()
    try:
        truth = (
            source.ground_truth() if ground_truth is None else _with_stamps(ground_truth, folder)
        )
        evaluations = _evaluate(truth, estimates)
    except GvoError as error:
        warnings.append(f"not compared with the ground truth: {error}")
    is_partly = tally.is_partly or (ground_truth is not None and not evaluations)
    summary = _summary(source, tally, config=config, evaluations=evaluations, warnings=warnings)
    if comparison is not None:
        summary["smoothing"] = comparison.conclude(folder.path, truth if evaluations else None)
    folder.write_summary(summary)
    plot_trajectories(folder.path / PICTURE, truth if evaluations else None, estimates)
    return RunResult(
        summary=summary,
        evaluations=evaluations,
        exit_code=EXIT_PARTLY if is_partly else EXIT_COMPLETE,
        warnings=tuple(warnings),
    )


def _with_stamps(truth: Trajectory, folder: RunFolder) -> Trajectory:
    """Give poses without stamps, one for each frame, the stamps of the frames."""
    stamps_ns = folder.frame_stamps_ns()
    if truth.stamps_from != "rows" or len(truth) != len(stamps_ns):
        return truth
    return Trajectory(stamps_ns=stamps_ns, T_world_cam=truth.T_world_cam)


def _evaluate(truth: Trajectory | None, estimates: dict[str, Trajectory]) -> tuple[Evaluation, ...]:
    if truth is None:
        return ()
    return tuple(evaluate(truth, estimate, name=name) for name, estimate in estimates.items())


def _summary(
    source: Source,
    tally: RunTally,
    *,
    config: Config,
    evaluations: tuple[Evaluation, ...],
    warnings: list[str],
) -> dict[str, Any]:
    info = source.info
    medians = {stage: durations.median() for stage, durations in tally.stages.items()}
    return {
        "gvo_version": __version__,
        "recording": info.name,
        "sensor": info.sensor,
        "decisions": list(info.decisions),
        "frames": tally.n_frames,
        "tracked": tally.n_tracked,
        "coverage": tally.n_with_pose / tally.n_frames,
        "status_counts": {status.value: tally.statuses[status] for status in Status},
        "unpaired_images": tally.n_unpaired,
        "window": asdict(tally.window),
        "polish": None if tally.polish is None else tally.polish.as_json(),
        "rig_offsets": None if tally.rig_offsets is None else tally.rig_offsets.as_json(),
        "median_ms": medians,
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "errors": evaluations_json(evaluations)["estimates"],
        "warnings": warnings,
        "configuration": config.model_dump(),
    }


def peak_memory_mb() -> float:
    """Return the largest resident memory of this process so far, in 10^6 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 1024
    return peak * unit / 1e6
