"""Counts, times and warnings of a run, frame by frame."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from gvo.backend.batch import BatchResult
from gvo.backend.inertial import InertialEstimator
from gvo.backend.window import WindowCounts
from gvo.frontend.offsets import RigOffsets
from gvo.frontend.zoom import HARDEST_MPS2
from gvo.types import (
    Estimate,
    FaultyFrame,
    FrameResult,
    InertialState,
    Progress,
    SegmentJoin,
    Status,
)

# A run with a larger share of untracked poses is not complete.
_MAX_UNTRACKED_SHARE = 0.1
# The moving head or arm of a robot displaces its camera by less.
_MAX_MOUNT_TRAVEL_M = 2.0
# What moves by less than this share of its speed before stands still, for so many frames at least.
_STILL_SHARE, _N_STILL = 0.1, 10


@dataclass(slots=True, kw_only=True)
class Segment:
    """Frames whose relative poses are known; a loss of the camera begins another segment."""

    id: int
    first_stamp_ns: int
    last_stamp_ns: int
    n_frames: int = 0
    n_tracked: int = 0
    joined_to: int | None = None
    joined_at_ns: int | None = None


@dataclass(slots=True, kw_only=True)
class RunStatistics:
    """Counts, times and segments of a run.

    `gaps_s` are the times for which an IMU led the camera, one after the other.
    """

    statuses: Counter[Status] = field(default_factory=Counter)
    first_fault: str = ""
    n_unpaired: int = 0
    first_unpaired: str = ""
    first_untracked: str = ""
    broken_off: str = ""
    n_guessed: int = 0
    mount_travel_m: float = 0.0
    window: WindowCounts = field(default_factory=WindowCounts)
    batch_result: BatchResult | None = None
    rig_offsets: RigOffsets | None = None
    inertial: InertialEstimator | None = None
    inertial_state: InertialState | None = None
    n_carried: int = 0
    gaps_s: list[float] = field(default_factory=list)
    stages: dict[str, array[float]] = field(default_factory=dict)
    segments: dict[int, Segment] = field(default_factory=dict)
    standstill: dict[str, float] | None = None
    _raws: list[Estimate] = field(default_factory=list)
    _last: FrameResult | None = None

    @property
    def n_frames(self) -> int:
        """Frames, also faulty ones."""
        return sum(self.statuses.values())

    @property
    def n_tracked(self) -> int:
        """Frames registered to earlier ones."""
        return self.statuses[Status.OK] + self.statuses[Status.RESUMED]

    @property
    def n_with_pose(self) -> int:
        """Frames that have a pose."""
        return self.n_frames - self.statuses[Status.SKIPPED]

    @property
    def n_made_up(self) -> int:
        """Frames whose pose rests on nothing but the last velocity."""
        return self.n_with_pose - self.n_tracked - self.n_carried

    @property
    def n_faulty(self) -> int:
        """Frames without a pose."""
        return self.statuses[Status.SKIPPED]

    @property
    def coverage_percent(self) -> float:
        """Share of the frames that are tracked."""
        return round(100.0 * self.n_tracked / max(self.n_frames, 1), 3)

    @property
    def unjoined(self) -> list[Segment]:
        """The segments with tracked frames that are not joined to an earlier one."""
        tracked = [segment for segment in self.segments.values() if segment.n_tracked > 0]
        return [segment for segment in tracked if segment.joined_to is None]

    def as_json(self) -> dict[str, Any]:
        """Return what `summary.json` holds of it."""
        return {
            "frames": self.n_frames,
            "tracked": self.n_tracked,
            "coverage_percent": self.coverage_percent,
            "segments": [asdict(segment) for segment in self.segments.values()],
            "status_counts": {status.value: self.statuses[status] for status in Status},
            "unpaired_images": self.n_unpaired,
            "window": asdict(self.window),
            "standstill": self.standstill,
            "batch": None if self.batch_result is None else self.batch_result.as_json(),
            "rig_offsets": None if self.rig_offsets is None else self.rig_offsets.as_json(),
            "median_ms": {
                stage: round(float(np.median(values)), 3) for stage, values in self.stages.items()
            },
        }

    @property
    def is_complete(self) -> bool:
        """Tell whether no frame is missing, and all but a few are tracked."""
        is_tracked = self.n_made_up <= _MAX_UNTRACKED_SHARE * self.n_with_pose
        is_tracked &= self.n_with_pose < 2 or self.n_tracked >= 2
        is_whole = not (self.n_faulty or self.broken_off or self.statuses[Status.LOST])
        return is_whole and is_tracked

    def progress(self, n_images: int) -> Progress:
        """Return the progress of a run over `n_images` images."""
        n_done = self.n_frames + self.n_unpaired
        return Progress(n_done=n_done, n_total=n_images, n_tracked=self.n_tracked)

    def add_result(self, result: FrameResult) -> None:
        """Count a frame."""
        self.statuses[result.status] += 1
        self._add_to_segment(result)
        self._look_for_standstill(result.raw)
        self._follow_imu(result)
        for join in result.joins:
            self._join(join)
        self.first_untracked = self.first_untracked or result.reason
        for stage, elapsed_ms in result.stage_ms.items():
            self.add_duration(stage, elapsed_ms)

    def _add_to_segment(self, result: FrameResult) -> None:
        stamp_ns = result.stamp_ns
        new = Segment(id=result.segment, first_stamp_ns=stamp_ns, last_stamp_ns=stamp_ns)
        segment = self.segments.setdefault(result.segment, new)
        segment.last_stamp_ns = stamp_ns
        segment.n_frames += 1
        segment.n_tracked += result.status in (Status.OK, Status.RESUMED)

    def _follow_imu(self, result: FrameResult) -> None:
        self.inertial_state = result.inertial or self.inertial_state
        last, self._last = self._last, result
        if last is not None and result.is_carried:
            self.n_carried += 1
            if not last.is_carried:
                self.gaps_s.append(0.0)
            self.gaps_s[-1] += 1e-9 * (result.stamp_ns - last.stamp_ns)

    def _look_for_standstill(self, raw: Estimate) -> None:
        """Tell images that stand still after two steps at a speed that no brake takes away."""
        self._raws = [*self._raws[-_N_STILL - 2 :], raw] if raw.status is Status.OK else []
        if self.standstill is not None or len(self._raws) < _N_STILL + 3:
            return
        elapsed_s = 1e-9 * np.diff([each.stamp_ns for each in self._raws])
        positions = np.array([each.T_world_frame[:3, 3] for each in self._raws])
        speeds_mps = np.linalg.norm(np.diff(positions, axis=0), axis=1) / elapsed_s
        lasting_mps = speeds_mps[:2].min()
        is_halt = lasting_mps - speeds_mps[2] > HARDEST_MPS2 * elapsed_s[2]
        if is_halt and speeds_mps[2:].max() < _STILL_SHARE * lasting_mps:
            speed_mps = round(float(speeds_mps[1]), 2)
            self.standstill = {"frame": self.n_frames - _N_STILL, "speed_mps": speed_mps}

    def _join(self, join: SegmentJoin) -> None:
        """Let the later one of two groups of segments point to the earlier one."""
        first, second = self._root(join.segment), self._root(join.to_segment)
        if first is second:
            return
        is_later = first.id > second.id
        later = first if is_later else second
        later.joined_to = join.to_segment if is_later else join.segment
        later.joined_at_ns = join.stamp_ns

    def _root(self, number: int) -> Segment:
        segment = self.segments[number]
        while segment.joined_to is not None:
            segment = self.segments[segment.joined_to]
        return segment

    def add_duration(self, stage: str, elapsed_ms: float) -> None:
        """Count the time of one frame in a stage, milliseconds."""
        self.stages.setdefault(stage, array("f")).append(elapsed_ms)

    def add_faulty(self, frame: FaultyFrame, *, is_loss: bool) -> None:
        """Count a lost frame, or an image without partner."""
        reason = f"frame at {frame.stamp_ns} ns: {frame.reason}"
        if is_loss:
            self.statuses[Status.SKIPPED] += 1
            self.first_fault = self.first_fault or reason
        else:
            self.n_unpaired += 1
            self.first_unpaired = self.first_unpaired or reason

    def reason(self) -> str:
        """Return why there is no frame with a pose."""
        return self.broken_off or self.first_fault or self.first_unpaired or "it holds no image"

    def warnings(self) -> list[str]:
        """Return one line for each thing that went wrong."""
        return [*self._warnings()]

    def _warnings(self) -> Iterator[str]:
        if self.broken_off:
            yield (f"not all could be read, {self.n_frames} frames were: {self.broken_off}")
        if self.n_faulty:
            yield (
                f"{self.n_faulty} of {self.n_frames} frames are faulty and were skipped; "
                f"the first: {self.first_fault}"
            )
        if self.n_unpaired:
            yield (
                f"{self.n_unpaired} images have no partner and make no frame "
                "(sync.max_difference_ms)"
            )
        yield from self._warnings_of_poses()
        yield from self._warnings_of_segments()
        yield from self._warnings_of_window()

    def _warnings_of_poses(self) -> Iterator[str]:
        if self.n_made_up and self.n_tracked < 2:
            yield (
                "no frame could be registered against another (are left and right exchanged, is "
                "the calibration or depth.scale wrong, are the images dark?); the first: "
                f"{self.first_untracked}"
            )
        elif self.n_made_up:
            yield (
                f"{self.n_made_up} of {self.n_with_pose} poses continue the last velocity, without "
                "a registration (frames.csv: coasting, lost)"
            )
        if self.mount_travel_m > _MAX_MOUNT_TRAVEL_M:
            yield (
                f"tf moves the camera by {self.mount_travel_m:.1f} m in the base frame: a "
                "frame that stands in the world has no trajectory; ask for one of the robot, and "
                "name the fixed one by --world"
            )
        if self.n_guessed:
            yield (
                f"tf does not say where the camera is on the base frame at {self.n_guessed} "
                "stamps: what it says at the nearest one was taken"
            )

    def _warnings_of_segments(self) -> Iterator[str]:
        joined = [segment for segment in self.segments.values() if segment.joined_to is not None]
        if joined:
            text = ", ".join(f"{segment.id} to {segment.joined_to}" for segment in joined)
            yield (
                f"the camera was lost; where a kept keyframe was seen again, segments were joined "
                f"({text}): before that, raw and causal poses of a joined one are of a guessed "
                "place (frames.csv: segment)"
            )
        if len(self.unjoined) > 1:
            yield (
                f"the camera was lost; {len(self.unjoined)} segments are not joined: their "
                "relative poses are unknown, errors over several of them mean little (frames.csv: "
                "segment)"
            )

    def _warnings_of_window(self) -> Iterator[str]:
        if self.window.n_restored:
            n = self.window.n_restored
            yield f"{n} updates of the window failed and were done again with less"
        # Gated edges are normal, and counted in the summary; others should not have been given.
        n_faulty = self.window.n_rejected - self.window.n_gated
        if n_faulty:
            yield f"{n_faulty} edges were refused; the first refusal: {self.window.first_rejected}"
