"""The summary of a run, while it runs and at its end."""

from __future__ import annotations

import errno
import hashlib
import json
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from gvo._version import __version__
from gvo.errors import GvoError, OutputError
from gvo.geometry.imu import ImuStream
from gvo.io.excerpt import Excerpt
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.poses.truth import TruthComparison
from gvo.io.recording import Source
from gvo.io.rig_file import rig_json
from gvo.io.run_folder.writer import RunFolder
from gvo.trajectory.evaluation import evaluations_json
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, Optimum, Progress

if TYPE_CHECKING:
    from gvo.runs.loop import RunLoop
    from gvo.runs.statistics import RunStatistics

State: TypeAlias = Literal["running", "interrupted", "complete"]


def summarize(
    loop: RunLoop,
    compared: TruthComparison | Failure,
    warnings: list[str],
    *,
    state: State = "complete",
) -> dict[str, Any]:
    """Return what `summary.json` holds of a run."""
    info, frame = loop.source.info, loop.base_frame
    offsets = loop.statistics.rig_offsets
    learnt = None if offsets is None else offsets.learnt
    return {
        "gvo_version": __version__,
        "state": state,
        "recording": info.name,
        "sensor": info.sensor,
        "decisions": list(info.decisions),
        "base_frame": ", ".join(filter(None, (frame.name or "camera", frame.origin))),
        **_truth_json(compared),
        **loop.statistics.as_json(),
        **_imu_json(info.imu, loop.statistics),
        "rig": None if learnt is None else rig_json(info.camera, learnt),
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "warnings": warnings,
        "configuration": loop.config.model_dump(),
    }


def _truth_json(compared: TruthComparison | Failure) -> dict[str, Any]:
    if isinstance(compared, Failure):
        absent = dict.fromkeys(("T_base_truth", "ground_truth_stamps_from"))
        return {"ground_truth": f"none: {compared.reason}", **absent, "errors": []}
    truth = compared.truth
    return {
        "ground_truth": truth.decision,
        "T_base_truth": truth.T_base_point.tolist(),
        "ground_truth_stamps_from": truth.trajectory.stamps_from,
        "errors": evaluations_json(compared.evaluations)["estimates"],
    }


def _imu_json(stream: ImuStream | None, statistics: RunStatistics) -> dict[str, Any]:
    """Return what `summary.json` holds of an IMU; nothing where none is used."""
    inertial, state, gaps_s = statistics.inertial, statistics.inertial_state, statistics.gaps_s
    if stream is None or inertial is None:
        return {}
    T, delay_s = inertial.imu.T_camera_imu, inertial.imu.delay_s
    has_failed = state is None or inertial.n_restarts > 0
    found = {
        "name": stream.name,
        "has_started": state is not None,
        "n_carried": statistics.n_carried,
        "carried_s": round(sum(gaps_s, 0.0), 3),
        "n_gaps": len(gaps_s),
        "longest_s": round(max(gaps_s, default=0.0), 3),
        "n_restarts": inertial.n_restarts,
        "reason": inertial.reason if has_failed else "",
        "T_camera_imu": None if T is None else T.tolist(),
        "is_rotation_learnt": stream.imu.T_camera_imu is None and T is not None,
        "delay_ms": None if delay_s is None else 1e3 * delay_s,
        "is_delay_learnt": stream.imu.delay_s is None and delay_s is not None,
        "gyro_bias": None if state is None else state.gyro_bias.tolist(),
        "acceleration_bias": None if state is None else state.acceleration_bias.tolist(),
    }
    return {"imu": found}


def optimum_json(optimum: Optimum | None) -> dict[str, Any] | None:
    """Return what `summary.json` holds of the global poses; None without them."""
    if optimum is None:
        return None
    refused = Counter(loop.reason for loop in optimum.loops)
    return {
        "frames": len(optimum.frames_ns),
        "edges": len(optimum.edges),
        "loops": {
            "found": len(optimum.loops),
            "counted": refused.pop("", 0),
            "refused": dict(refused),
        },
        "error_before": optimum.error_before,
        "error": optimum.error,
        "iterations": optimum.n_iterations,
    }


def peak_memory_mb() -> float:
    """Return the largest resident memory of this process so far, in 10^6 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 1024
    return peak * unit / 1e6


def run_identity(
    source: Source,
    base_frame: BaseFrame,
    excerpt: Excerpt | None,
    *,
    start: Trajectory | None = None,
    is_live: bool = False,
) -> dict[str, Any]:
    """Return what a run depends on besides its configuration, to recognise it again.

    Parameters
    ----------
    source : Source
        The first image is read.
    base_frame : BaseFrame
        As before the first frame.
    excerpt : Excerpt or None
    start : Trajectory, optional
        The true poses, if the run starts at one of them.
    is_live : bool
        Read no image.

    Returns
    -------
    dict
        Values that are the same after writing and reading JSON.
    """
    info, view = source.info, source.info.depth_view
    known: list[object] = [*map(asdict, info.calibrations), view and asdict(view)]
    known += [asdict(info.rig)] if info.rig is not None else []
    known += [info.masks] if info.masks else []
    return {
        "version of gvo": __version__,
        "recording": {
            "sensor": info.sensor,
            "number of images": info.n_images,
            "frame_id": info.frame_id,
            "calibration": digest(known),
            "first image": "" if is_live else _first_image(source),
        },
        "excerpt": asdict(excerpt or Excerpt()),
        "output": {
            "frame": base_frame.name,
            "mount": digest(base_frame.fixed_mount),
            "initial pose": digest(base_frame.T_initial),
            "true start": digest(None if start is None else start.T_world_frame),
        },
    }


def digest(value: object) -> str:
    """Return a digest of arrays, numbers and texts, in lists and dictionaries."""
    text = json.dumps(value, sort_keys=True, default=_plain)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else str(value)


def _first_image(source: Source) -> str:
    """Return the stamp of the first image, and a digest of its pixels."""
    try:
        for image in source.images():
            pixels = hashlib.blake2b(image.load().tobytes(), digest_size=8)
            return f"{image.stamp_ns} {pixels.hexdigest()}"
    except GvoError:
        return "faulty"  # the run itself will say so
    return ""


_EVERY_S = 3.0
_NOT_YET = Failure(reason="the run has not ended")


class RunningSummary(AbstractContextManager["RunningSummary"]):
    """Writes `summary.json` every few seconds, and when a run is interrupted."""

    def __init__(
        self,
        loop: RunLoop,
        folder: RunFolder,
        identity: dict[str, Any],
        on_progress: Callable[[Progress], None] | None = None,
    ) -> None:
        self._loop, self._folder, self._identity = loop, folder, identity
        self._on_progress = on_progress
        self._written_s: float | None = None

    def __call__(self, progress: Progress) -> None:
        """Pass progress on, and write the summary if it is old."""
        if self._on_progress is not None:
            self._on_progress(progress)
        if self._written_s is None or time.monotonic() - self._written_s > _EVERY_S:
            self._loop.count()
            self.write("running")

    def write(self, state: State, *warnings: str) -> None:
        """Write how far the run came."""
        lines = [*warnings, *self._loop.statistics.warnings()]
        summary = summarize(self._loop, _NOT_YET, lines, state=state)
        self._folder.write_summary(summary | {"run": self._identity})
        self._written_s = time.monotonic()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Write how far an interrupted run came."""
        if not isinstance(error, GvoError | KeyboardInterrupt):
            return
        is_output = isinstance(error, OutputError)
        if is_output and getattr(error.__cause__, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
            self._loop.discard_files()  # so that there is room for the summary
        with suppress(OutputError):
            self.write("interrupted", str(error) if is_output else "interrupted")
        if is_output:
            statistics = self._loop.statistics
            text = f"{error}; {statistics.n_frames} frames stand whole in {self._folder.path}"
            raise OutputError(text, is_partly=statistics.n_with_pose > 0) from error
