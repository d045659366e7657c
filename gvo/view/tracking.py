"""Odometry over a recording for a view, a frame at a time."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from typing import TypeAlias

from gvo.config import Config
from gvo.io.excerpt import Excerpt
from gvo.io.recording import Source
from gvo.odometry.odometry import Odometry
from gvo.types import Estimate, FaultyFrame, FloatArray, Frame, FrameResult, StereoFrame
from gvo.view.clouds import empty_cloud, frame_cloud
from gvo.view.moments import Entry
from gvo.view.pictures import draw_fault, small_picture
from gvo.view.reading import is_read_differently, read_frames
from gvo.viz.overlay import compose_overlay

OpenSource: TypeAlias = Callable[[Config], Source]

# Newest poses of the window that are written down with each frame; it may keep all there are.
_N_POSES = 24
_RATE_SHARE = 0.1  # of the newest frame in the rate that is told


class Tracking:
    """Reads frames, tracks them, and gathers what a view shows of each.

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
        self,
        open_source: OpenSource,
        config: Config,
        excerpt: Excerpt,
        *,
        from_ns: int | None = None,
    ) -> None:
        self._open_source = open_source
        self._excerpt = excerpt
        self.config = config
        self.is_finished = False
        source = self.source = open_source(config)
        self.info = source.info
        self.camera = source.info.camera
        self._odometry = Odometry(self.camera, config)
        self._items: Iterator[Frame | FaultyFrame] = read_frames(
            source, config, excerpt, from_ns=from_ns
        )
        self._from_ns = from_ns
        self._last_ns: int | None = None
        self._next: Frame | FaultyFrame | None = None
        self._read_ms = 0.0
        self._frame_ms: float | None = None
        self._stamps_ns: deque[int] = deque(maxlen=_N_POSES)
        self._keyframes_ns: tuple[int, ...] = ()

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
        """Take another configuration for the next frame; open the recording again if it must be.

        Raises
        ------
        GvoError
            When that fails; the configuration is the former one then.
        """
        if is_read_differently(self.config, config) and not self.is_finished:
            self._reopen(config)
        self._odometry.reconfigure(config)
        self.config = config

    def _reopen(self, config: Config) -> None:
        last_ns = self._last_ns
        source = self._open_source(config)
        from_ns = self._from_ns if last_ns is None else last_ns
        items = read_frames(source, config, self._excerpt, from_ns=from_ns)
        coming = (item for item in items if last_ns is None or item.stamp_ns > last_ns)
        following = next(coming, None)
        self.close()
        self._items, self._next = coming, following
        self.is_finished = following is None

    def advance(self, index: int) -> Entry | None:
        """Track the next frame and return what there is to show of it; None at the end.

        Parameters
        ----------
        index : int
            Of the frame, to be told in the overlay.

        Raises
        ------
        RecordingError
            When the recording breaks off; it is finished then.
        """
        item = self.peek()
        if item is None:
            return None
        self.is_finished = True  # unless all goes well
        entry = self._faulty(item) if isinstance(item, FaultyFrame) else self._track(item, index)
        self._last_ns, self._next, self.is_finished = item.stamp_ns, None, False
        return entry

    def finish(self) -> tuple[Estimate, ...]:
        """Return the smoothed poses that the window still holds."""
        return self._odometry.finish()

    def close(self) -> None:
        """Give threads and files of the reading back."""
        if isinstance(self._items, Generator):
            self._items.close()

    def _faulty(self, frame: FaultyFrame) -> Entry:
        picture = draw_fault(self.camera, frame.reason)
        poses, covariances = self._window()
        return Entry(
            stamp_ns=frame.stamp_ns,
            result=None,
            reason=frame.reason,
            image=small_picture(picture),
            overlay=picture,
            cloud=empty_cloud(),
            window_poses=poses,
            window_covariances=covariances,
        )

    def _track(self, frame: Frame, index: int) -> Entry:
        result = self._odometry.track(frame)
        result = replace(result, stage_ms={"read": self._read_ms, **result.stage_ms})
        self._stamps_ns.append(frame.stamp_ns)
        self._keyframes_ns = result.keyframes_ns
        poses, covariances = self._window()
        image = frame.left if isinstance(frame, StereoFrame) else frame.image
        return Entry(
            stamp_ns=frame.stamp_ns,
            result=result,
            reason=result.reason,
            image=small_picture(image),
            overlay=compose_overlay(
                frame, result, self.camera, index=index, rate_hz=self._rate_hz(result)
            ),
            cloud=frame_cloud(frame, result.registration, self.camera, self.config.depth),
            window_poses=poses,
            window_covariances=covariances,
        )

    def _window(self) -> tuple[dict[int, FloatArray], dict[int, FloatArray]]:
        """Return poses and covariances of the newest frames in the window and of keyframes."""
        window = self._odometry.window
        known = [ns for ns in sorted({*self._keyframes_ns, *self._stamps_ns}) if ns in window]
        estimates = {ns: window.estimate(ns) for ns in known}
        return (
            {ns: estimate.T_world_cam for ns, estimate in estimates.items()},
            {ns: estimate.covariance for ns, estimate in estimates.items()},
        )

    def _rate_hz(self, result: FrameResult) -> float:
        spent_ms = sum(result.stage_ms.values())
        before_ms = spent_ms if self._frame_ms is None else self._frame_ms
        self._frame_ms = (1.0 - _RATE_SHARE) * before_ms + _RATE_SHARE * spent_ms
        return 1e3 / max(self._frame_ms, 1e-3)
