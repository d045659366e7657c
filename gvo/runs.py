"""One recording, one run folder: what `gvo run`, the scripts and batches call."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gvo import __version__
from gvo.config import Config
from gvo.errors import GvoError, RecordingError
from gvo.evaluation import Evaluation
from gvo.output_frame import OutputFrame
from gvo.outputs.plots import plot_trajectories
from gvo.outputs.run_bag import RunBag
from gvo.outputs.run_folder import PICTURE, TRAJECTORIES, RunFolder
from gvo.outputs.smoothings import SmoothingComparison
from gvo.outputs.tables import evaluations_json
from gvo.run_inputs import initial_pose, own_truth
from gvo.run_loop import Output, RunLoop, name_frames
from gvo.run_tally import Progress
from gvo.sources.excerpt import Excerpt
from gvo.sources.recording import Source
from gvo.sources.truth_frames import FramedTruth
from gvo.trajectory import Trajectory
from gvo.trajectory_alignment import MAX_DIFFERENCE_NS
from gvo.trajectory_files import read_trajectory
from gvo.truth_comparison import TruthComparison
from gvo.types import Failure, Status

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
    ground_truth: Trajectory | FramedTruth | None = None,
    frame: OutputFrame | None = None,
    starts_at_truth: bool = False,
    excerpt: Excerpt | None = None,
    bag: str | Path | None = None,
    world: str = "world",
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
    ground_truth : Trajectory or FramedTruth, optional
        Poses of the frame asked for; the recording's own where omitted.
    frame : OutputFrame, optional
        Whose poses are written, and where they start; the camera's, from the identity, where
        omitted.
    starts_at_truth : bool
        Take the first true pose for the initial one.
    excerpt : Excerpt, optional
        Which frames are read; all where omitted.
    bag : str or Path, optional
        A `.mcap` or `.bag` to write as well: transforms, odometry, paths, points, overlays.
    world : str
        The fixed frame in that bag.
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
        When no frame is usable, or what is to be written cannot be.
    """
    config = config or Config()
    frame = frame or OutputFrame(source.info.frame_id)
    truth, fault = _find_truth(source, ground_truth, frame)
    loop = RunLoop(
        source,
        config,
        frame,
        excerpt=excerpt,
        comparison=SmoothingComparison() if compare_smoothing else None,
        first_pose=partial(initial_pose, truth) if starts_at_truth else None,
    )
    with ExitStack() as stack:
        outputs: list[Output] = []
        if bag is not None:
            is_placed = frame.is_placed or starts_at_truth
            names = name_frames(source, frame, is_placed=is_placed, world=world)
            outputs.append(stack.enter_context(RunBag(bag, names)))
        folder = stack.enter_context(RunFolder(Path(out)))
        loop.run([folder, *outputs], on_progress)
    return _conclude(loop, folder, truth, fault, is_asked=ground_truth is not None)


def _find_truth(
    source: Source, given: Trajectory | FramedTruth | None, frame: OutputFrame
) -> tuple[FramedTruth | Failure, str]:
    """Return the truth, and what is wrong with that of the recording."""
    if isinstance(given, Trajectory):
        return FramedTruth(trajectory=given, T_frame_point=np.eye(4), decision="given"), ""
    if given is not None:
        return given, ""
    try:
        return own_truth(source, frame=frame), ""
    except GvoError as error:
        # What was not asked for must not keep the run from being made.
        return Failure(reason=str(error)), str(error)


def _conclude(
    loop: RunLoop, folder: RunFolder, truth: FramedTruth | Failure, fault: str, *, is_asked: bool
) -> RunResult:
    tally = loop.tally
    if tally.n_with_pose == 0:
        reason = (
            tally.broken_off or tally.first_fault or tally.first_unpaired or "it holds no image"
        )
        raise RecordingError(f"{loop.source.info.name}: no usable frame: {reason}")
    estimates = {name: read_trajectory(folder.path / f"{name}.txt") for name in TRAJECTORIES}
    warnings = tally.warnings()
    compared: TruthComparison | None = None
    try:
        if isinstance(truth, FramedTruth):
            compared = TruthComparison.of(_within(truth, folder, loop), estimates)
            warnings += [f"ground truth: {text}" for text in compared.warnings()]
    except GvoError as error:
        fault = str(error)
    if fault:
        warnings.append(f"not compared with the ground truth: {fault}")
    summary = _summary(loop, compared, warnings)
    if isinstance(truth, Failure) or compared is None:
        reason = truth.reason if isinstance(truth, Failure) else fault
        summary["ground_truth"] = f"none: {reason}"
    if loop.comparison is not None:
        summary["smoothing"] = loop.comparison.conclude(
            folder.path,
            measure=None if compared is None else compared.measure,
            place=loop.frame.place,
        )
    folder.write_summary(summary)
    _plot(folder.path / PICTURE, compared, estimates)
    is_partly = tally.is_partly or (is_asked and compared is None)
    return RunResult(
        summary=summary,
        evaluations=() if compared is None else compared.evaluations,
        exit_code=EXIT_PARTLY if is_partly else EXIT_COMPLETE,
        warnings=tuple(warnings),
    )


def _plot(path: Path, compared: TruthComparison | None, estimates: dict[str, Trajectory]) -> None:
    if compared is None:
        plot_trajectories(path, None, estimates)
    else:
        plot_trajectories(path, compared.truth.trajectory, compared.estimates)


def _within(truth: FramedTruth, folder: RunFolder, loop: RunLoop) -> FramedTruth:
    """Give poses without stamps, one for each frame, their stamps; cut the truth to an excerpt."""
    stamps_ns = folder.frame_stamps_ns()
    trajectory = truth.trajectory
    if trajectory.stamps_from == "rows" and len(trajectory) == len(stamps_ns):
        trajectory = Trajectory(stamps_ns=stamps_ns, T_world_cam=trajectory.T_world_cam)
    if loop.is_excerpt and trajectory.stamps_from != "rows":
        first, last = stamps_ns.min() - MAX_DIFFERENCE_NS, stamps_ns.max() + MAX_DIFFERENCE_NS
        start, end = np.searchsorted(trajectory.stamps_ns, [first, last])
        trajectory = trajectory.select(slice(int(start), int(end)))
    return replace(truth, trajectory=trajectory)


def _frame_text(frame: OutputFrame) -> str:
    return ", ".join(text for text in (frame.name or "camera", frame.origin) if text)


def _summary(
    loop: RunLoop, compared: TruthComparison | None, warnings: list[str]
) -> dict[str, Any]:
    info, tally = loop.source.info, loop.tally
    medians = {stage: durations.median() for stage, durations in tally.stages.items()}
    return {
        "gvo_version": __version__,
        "recording": info.name,
        "sensor": info.sensor,
        "decisions": list(info.decisions),
        "frame": _frame_text(loop.frame),
        "ground_truth": "" if compared is None else compared.truth.decision,
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
        "errors": evaluations_json(() if compared is None else compared.evaluations)["estimates"],
        "warnings": warnings,
        "configuration": loop.config.model_dump(),
    }


def peak_memory_mb() -> float:
    """Return the largest resident memory of this process so far, in 10^6 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 1024
    return peak * unit / 1e6
