"""What a run tells of itself in `summary.json`."""

from __future__ import annotations

import resource
import sys
from dataclasses import asdict
from typing import Any

from gvo.io.poses.base_frame import OutputFrame
from gvo.io.poses.truth import TruthComparison
from gvo.resuming.beginning import State
from gvo.run_loop import RunLoop
from gvo.trajectory.evaluation import Evaluation, evaluations_json
from gvo.types import Failure, Status
from gvo.version import __version__


def summarize(
    loop: RunLoop,
    compared: TruthComparison | Failure,
    warnings: list[str],
    *,
    state: State = "complete",
) -> dict[str, Any]:
    """Return what `summary.json` holds of a run.

    Parameters
    ----------
    loop : RunLoop
        After its run, or in the middle of it.
    compared : TruthComparison or Failure
        The errors, or why there are none.
    warnings : list of str
        A line each.
    state : {"running", "interrupted", "complete"}
        How far the run is.
    """
    info, tally = loop.source.info, loop.tally
    evaluations: tuple[Evaluation, ...] = ()
    point: list[list[float]] | None = None
    stamps_from: str | None = None
    if isinstance(compared, Failure):
        truth = f"none: {compared.reason}"
    else:
        truth, evaluations = compared.truth.decision, compared.evaluations
        point = compared.truth.T_frame_point.tolist()
        stamps_from = compared.truth.trajectory.stamps_from
    medians = {stage: durations.median() for stage, durations in tally.stages.items()}
    return {
        "gvo_version": __version__,
        "state": state,
        "recording": info.name,
        "sensor": info.sensor,
        "decisions": list(info.decisions),
        "frame": _frame_text(loop.frame),
        "ground_truth": truth,
        "T_frame_truth": point,
        "ground_truth_stamps_from": stamps_from,
        "frames": tally.n_frames,
        "tracked": tally.n_tracked,
        "coverage_percent": tally.coverage_percent,
        "segments": tally.segments_json(),
        "status_counts": {status.value: tally.statuses[status] for status in Status},
        "unpaired_images": tally.n_unpaired,
        "window": asdict(tally.window),
        "polish": None if tally.polish is None else tally.polish.as_json(),
        "rig_offsets": None if tally.rig_offsets is None else tally.rig_offsets.as_json(),
        "median_ms": medians,
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "errors": evaluations_json(evaluations)["estimates"],
        "warnings": warnings,
        "configuration": loop.config.model_dump(),
    }


def peak_memory_mb() -> float:
    """Return the largest resident memory of this process so far, in 10^6 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 1024
    return peak * unit / 1e6


def _frame_text(frame: OutputFrame) -> str:
    return ", ".join(text for text in (frame.name or "camera", frame.origin) if text)
