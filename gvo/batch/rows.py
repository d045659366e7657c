"""A run of a batch: one row of its table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

# A value of a parameter, as YAML gives it.
Value: TypeAlias = float | int | bool | str | None
RunStatus: TypeAlias = Literal["complete", "partly", "failed"]
STAGES = ("extract", "register", "links", "window")


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
        Path or URL of the recording.
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


def measures_of(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the measures of a row from the `summary.json` of its run."""
    errors = {each["name"]: each for each in summary["errors"]}
    smoothed = errors.get("smoothed", {})
    medians = summary["median_ms"]
    return {
        "sensor": summary["sensor"],
        "frames": summary["frames"],
        "tracked": summary["tracked"],
        "coverage_percent": summary["coverage_percent"],
        "segments": len(summary["segments"]),
        **{f"ate_{name}_m": each["ate_m"] for name, each in errors.items()},
        "rpe_smoothed_m": smoothed.get("rpe_m"),
        "rpe_smoothed_deg": smoothed.get("rpe_deg"),
        "t_smoothed_percent": smoothed.get("t_pct"),
        "r_smoothed_deg_per_100m": smoothed.get("r_deg_per_100m"),
        "frame_ms": sum(medians[stage] for stage in STAGES),
        "gvo_version": summary["gvo_version"],
    }
