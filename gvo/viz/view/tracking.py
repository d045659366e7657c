"""Odometry over a recording for the page, a frame at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from dataclasses import replace
from typing import TypeAlias

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames, is_lost, paired
from gvo.io.recording import Source
from gvo.io.sync import Paired
from gvo.odometry.odometry import Odometry
from gvo.types import FaultyFrame, Frame
from gvo.viz.view.newest import Newest

OpenSource: TypeAlias = Callable[[Config], Source]
_Frames: TypeAlias = Generator[Frame | FaultyFrame]
# A gap of the stamps is not waited for longer, seconds of the recording.
_MAX_GAP_S = 1.0


class Tracking:
    """Reads the frames of a recording from some frame on, and tracks them one by one.

    Attributes
    ----------
    is_finished : bool
        The recording is read to its end, or as far as it can be.
    gap_s : float
        How long after the newest frame the next one was recorded, seconds.
    """

    def __init__(self, open_source: OpenSource, config: Config, first_index: int = 0) -> None:
        self._open_source, self.config = open_source, config
        self.source = source = open_source(config)
        self.newest = Newest(source.info.camera, first_index)
        self._odometry = Odometry(source.info.camera, config)
        self._last_ns = _stamp_of(source, config, first_index) - 1 if first_index > 0 else None
        self._items = _frames_after(self._last_ns, source, config)
        self._next: Frame | FaultyFrame | None = None
        self._read_ms = 0.0
        self.is_finished = False
        self.gap_s = 0.0

    def reconfigure(self, config: Config) -> None:
        """Change the configuration of the next frame; where needed, open the recording again."""
        if _is_read_differently(self.config, config) and not self.is_finished:
            items = _frames_after(self._last_ns, self._open_source(config), config)
            following = next(items, None)
            self.close()
            self._items, self._next = items, following
        self._odometry.reconfigure(config)
        self.config = config

    def advance(self) -> None:
        """Track the next frame; after the last one, or a failure, take the poses of the window."""
        if self.is_finished:
            return
        is_finished = True  # also where something fails
        try:
            frame = self._read() if self._next is None else self._next
            if frame is None:
                return
            self._track(frame)
            self._next = self._read()
            if self._next is not None:
                is_finished = False
                gap_s = 1e-9 * (self._next.stamp_ns - frame.stamp_ns)
                self.gap_s = min(max(gap_s, 0.0), _MAX_GAP_S)
        finally:
            self.is_finished = is_finished
            if is_finished and self.newest.n_done > self.newest.first_index:
                self.newest.finish(self._odometry.finish())

    def _read(self) -> Frame | FaultyFrame | None:
        start_s = time.perf_counter()
        frame = next(self._items, None)
        self._read_ms = 1e3 * (time.perf_counter() - start_s)
        return frame

    def _track(self, frame: Frame | FaultyFrame) -> None:
        result = None
        if not isinstance(frame, FaultyFrame):
            result = self._odometry.track(frame)
            result = replace(result, stage_ms={"read": self._read_ms, **result.stage_ms})
        self.newest.add(frame, result, self._odometry.window, self.config.depth)
        self._last_ns = frame.stamp_ns

    def close(self) -> None:
        """Close threads and files of the reading."""
        self._items.close()


def _is_read_differently(former: Config, config: Config) -> bool:
    """Tell whether another configuration asks for reading the recording anew."""
    return former.depth.scale != config.depth.scale or any(
        getattr(former, name) != getattr(config, name) for name in ("sync", "images", "runtime")
    )


def _frames_after(last_ns: int | None, source: Source, config: Config) -> _Frames:
    """Read the frames after a stamp; those before are not decoded."""
    excerpt = None
    if last_ns is not None:
        first = next(paired(source.images(), source.info.sensor, config.sync))
        excerpt = Excerpt(start_s=max(1e-9 * (last_ns - _stamp_ns(first)), 0.0))
    for frame in frames(source, config, excerpt, with_unpaired=False):
        if last_ns is None or frame.stamp_ns > last_ns:
            yield frame


def _stamp_of(source: Source, config: Config, index: int) -> int:
    """Return the stamp of a frame by its number; nothing is decoded."""
    sensor, n = source.info.sensor, 0
    for item in paired(source.images(), sensor, config.sync):
        if not isinstance(item, FaultyFrame) or is_lost(item, sensor):
            if n == index:
                return _stamp_ns(item)
            n += 1
    raise RecordingError(f"{source.info.name}: there is no frame {index}, only 0 to {n - 1}")


def _stamp_ns(item: Paired) -> int:
    return item.stamp_ns if isinstance(item, FaultyFrame) else item[0].stamp_ns
