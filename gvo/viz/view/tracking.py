"""Odometry over a recording for a page, a frame at a time."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import replace
from typing import TypeAlias

import cv2
import numpy as np

from gvo.backend.window import SlidingWindow
from gvo.config import Config, DepthConfig
from gvo.frontend.klt import image_of
from gvo.geometry.camera import PinholeCamera
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames, paired
from gvo.io.recording import Source
from gvo.odometry.odometry import Odometry
from gvo.types import Estimate, FaultyFrame, Frame, FrameResult, ImageArray
from gvo.viz.overlay import compose_overlay, draw_matches
from gvo.viz.view.clouds import empty_cloud, frame_cloud
from gvo.viz.view.history import FrameRecord

OpenSource: TypeAlias = Callable[[Config], Source]
# Newest poses of the window that are kept with each frame; the window may hold all.
_N_POSES = 24
_RATE_SHARE = 0.1  # of the newest frame in the mean rate
_SECTIONS = ("sync", "images", "runtime")

_MAX_WIDTH_PX = 480


class Tracking:
    """Reads frames, tracks them, and gathers what a page shows of each.

    Parameters
    ----------
    open_source : callable
        Opens the recording as a configuration says.
    config : Config
    excerpt : Excerpt
        The part of the recording that is wanted.
    from_ns : int, optional
        Stamp of the frame to start with.

    Attributes
    ----------
    config : Config
        Of the next frame.
    is_finished : bool
        The recording was read to its end, or something went wrong for good.

    Raises
    ------
    GvoError
        When the recording cannot be opened.
    """

    def __init__(
        self, open_source: OpenSource, config: Config, excerpt: Excerpt, from_ns: int | None = None
    ) -> None:
        self._open_source, self._excerpt, self.config = open_source, excerpt, config
        self.is_finished = False
        source = self.source = open_source(config)
        self.camera = source.info.camera
        self._odometry = Odometry(self.camera, config)
        self._items: Iterator[Frame | FaultyFrame] = self._read(source, config, from_ns)
        self._from_ns = from_ns
        self._last_ns: int | None = None
        self._next: Frame | FaultyFrame | None = None
        self._read_ms = 0.0
        self._recorder = FrameRecorder(self.camera)

    def peek(self) -> Frame | FaultyFrame | None:
        """Return the next frame; None at the end.

        Raises
        ------
        RecordingError
            When the recording breaks off; it is finished then.
        """
        if self._next is None and not self.is_finished:
            self.is_finished = True  # unless there is one
            start = time.perf_counter()
            self._next = next(self._items, None)
            self._read_ms = 1e3 * (time.perf_counter() - start)
            self.is_finished = self._next is None
        return self._next

    def reconfigure(self, config: Config) -> None:
        """Change the configuration of the next frame; where needed, open the recording again.

        Raises
        ------
        GvoError
            When that fails; the former configuration stays.
        """
        if _is_read_differently(self.config, config) and not self.is_finished:
            self._reopen(config)
        self._odometry.reconfigure(config)
        self.config = config

    def _reopen(self, config: Config) -> None:
        last_ns = self._last_ns
        source = self._open_source(config)
        from_ns = self._from_ns if last_ns is None else last_ns
        items = self._read(source, config, from_ns)
        coming = (item for item in items if last_ns is None or item.stamp_ns > last_ns)
        following = next(coming, None)
        self.close()
        self._items, self._next = coming, following
        self.is_finished = following is None

    def _read(
        self, source: Source, config: Config, from_ns: int | None
    ) -> Iterator[Frame | FaultyFrame]:
        """Read frames from a stamp on; those before are not decoded."""
        excerpt = self._excerpt
        if from_ns is not None:
            excerpt = _excerpt_from(from_ns, source, config, excerpt)
        yield from frames(source, config, excerpt, with_unpaired=False)

    def advance(self, index: int) -> FrameRecord | None:
        """Track the next frame; None at the end.

        Parameters
        ----------
        index : int
            Of the frame, for the overlay.

        Raises
        ------
        RecordingError
            When the recording breaks off; it is finished then.
        """
        item = self.peek()
        if item is None:
            return None
        self.is_finished = True  # unless all goes well
        result = None
        if not isinstance(item, FaultyFrame):
            result = self._odometry.track(item)
            result = replace(result, stage_ms={"read": self._read_ms, **result.stage_ms})
            self._recorder.note(result)
        poses = self._recorder.read(self._odometry.window)
        depth = self.config.depth
        record = self._recorder.record(item, result, poses, index=index, depth=depth)
        self._last_ns, self._next, self.is_finished = item.stamp_ns, None, False
        return record

    def finish(self) -> tuple[Estimate, ...]:
        """Return the smoothed poses that the window still holds."""
        return self._odometry.finish()

    def close(self) -> None:
        """Close threads and files of the reading."""
        if isinstance(self._items, Generator):
            self._items.close()


class FrameRecorder:
    """Makes of frames what a page shows of them.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera
    """

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera = camera
        self._frame_ms: float | None = None
        self._stamps_ns: deque[int] = deque(maxlen=_N_POSES)
        self._keyframes_ns: tuple[int, ...] = ()

    def note(self, result: FrameResult) -> None:
        """Note what a frame gave, in the order of the frames."""
        self._stamps_ns.append(result.stamp_ns)
        self._keyframes_ns = result.keyframes_ns

    def read(self, window: SlidingWindow) -> dict[int, Estimate]:
        """Return the newest poses in the window, and those of its keyframes, by stamp."""
        known = [ns for ns in sorted({*self._keyframes_ns, *self._stamps_ns}) if ns in window]
        return {ns: window.estimate(ns) for ns in known}

    def record(
        self,
        frame: Frame | FaultyFrame,
        result: FrameResult | None,
        poses: Mapping[int, Estimate],
        *,
        index: int,
        depth: DepthConfig,
    ) -> FrameRecord:
        """Return the record of a frame; without a result where it is faulty."""
        if isinstance(frame, FaultyFrame) or result is None:
            reason = getattr(frame, "reason", "")
            image = overlay = _draw_fault(self._camera, reason)
            cloud = empty_cloud()
        else:
            reason = result.reason
            image = image_of(frame)
            rate_hz = self._rate_hz(result)
            overlay = compose_overlay(frame, result, self._camera, index=index, rate_hz=rate_hz)
            cloud = frame_cloud(frame, result.registration, self._camera, depth)
        return FrameRecord(
            stamp_ns=frame.stamp_ns,
            result=result,
            reason=reason,
            image=_small_picture(image),
            overlay=overlay,
            cloud=cloud,
            window_poses={ns: estimate.T_world_frame for ns, estimate in poses.items()},
            window_covariances={ns: estimate.covariance for ns, estimate in poses.items()},
        )

    def _rate_hz(self, result: FrameResult) -> float:
        spent_ms = sum(result.stage_ms.values())
        before_ms = spent_ms if self._frame_ms is None else self._frame_ms
        self._frame_ms = (1.0 - _RATE_SHARE) * before_ms + _RATE_SHARE * spent_ms
        return 1e3 / max(self._frame_ms, 1e-3)


def _is_read_differently(former: Config, config: Config) -> bool:
    """Tell whether another configuration asks for reading the recording anew."""
    return former.depth.scale != config.depth.scale or any(
        getattr(former, name) != getattr(config, name) for name in _SECTIONS
    )


def _excerpt_from(from_ns: int, source: Source, config: Config, excerpt: Excerpt) -> Excerpt:
    """Return the rest of an excerpt from one of its frames on."""
    first = next(paired(source.images(), source.info.sensor, config.sync))
    first_ns = first.stamp_ns if isinstance(first, FaultyFrame) else first[0].stamp_ns
    start_s = max(1e-9 * (from_ns - first_ns), 0.0)
    duration_s = None
    if excerpt.duration_s is not None:
        duration_s = max(excerpt.start_s + excerpt.duration_s - start_s, 1e-9)
    return replace(excerpt, start_s=start_s, duration_s=duration_s)


def _draw_fault(camera: PinholeCamera, reason: str) -> ImageArray:
    """Return a dark picture that tells why there is no frame, BGR."""
    none = np.zeros((0, 2))
    dark = np.full((camera.height, camera.width), 40, dtype=np.uint8)
    return draw_matches(dark, none, none, np.zeros(0, np.bool_), lines=[f"no frame: {reason}"])


def _small_picture(image: ImageArray) -> ImageArray:
    """Return a grey or BGR image as BGR, at most 480 pixels wide."""
    height, width = image.shape[:2]
    if width > _MAX_WIDTH_PX:
        size = _MAX_WIDTH_PX, max(round(height * _MAX_WIDTH_PX / width), 1)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    return image
