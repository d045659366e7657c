"""Odometry over a recording for the page, a frame at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from typing import TypeAlias

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames, is_lost, paired
from gvo.io.recording import Source
from gvo.io.sync import Paired
from gvo.odometry.odometry import Odometry
from gvo.types import Estimate, FaultyFrame, Frame
from gvo.viz.view.newest import Newest

OpenSource: TypeAlias = Callable[[Config], Source]
_SECTIONS = ("sync", "images", "runtime")


class Tracking:
    """Reads the frames of a recording from some frame on, and tracks them one by one."""

    def __init__(self, open_source: OpenSource, config: Config, first_index: int = 0) -> None:
        self._open_source, self.config = open_source, config
        self.is_finished = False
        source = self.source = open_source(config)
        self.newest = Newest(source.info.camera, first_index)
        self._odometry = Odometry(source.info.camera, config)
        self._last_ns = _stamp_of(source, config, first_index) - 1 if first_index > 0 else None
        self._items: Iterator[Frame | FaultyFrame] = self._read(source, config)
        self._next: Frame | FaultyFrame | None = None
        self._read_ms = 0.0

    def peek(self) -> Frame | FaultyFrame | None:
        """Return the next frame; None at the end."""
        if self._next is None and not self.is_finished:
            self.is_finished = True  # set back below where there is one
            start = time.perf_counter()
            self._next = next(self._items, None)
            self._read_ms = 1e3 * (time.perf_counter() - start)
            self.is_finished = self._next is None
        return self._next

    def reconfigure(self, config: Config) -> None:
        """Change the configuration of the next frame; where needed, open the recording again."""
        if _is_read_differently(self.config, config) and not self.is_finished:
            coming = self._read(self._open_source(config), config)
            following = next(coming, None)
            self.close()
            self._items, self._next = coming, following
            self.is_finished = following is None
        self._odometry.reconfigure(config)
        self.config = config

    def _read(self, source: Source, config: Config) -> Iterator[Frame | FaultyFrame]:
        """Read the frames after the last stamp; those before are not decoded."""
        last_ns = self._last_ns
        excerpt = None if last_ns is None else _excerpt_from(last_ns, source, config)
        for item in frames(source, config, excerpt, with_unpaired=False):
            if last_ns is None or item.stamp_ns > last_ns:
                yield item

    def advance(self) -> bool:
        """Track the next frame; return False at the end."""
        item = self.peek()
        if item is None:
            return False
        self.is_finished = True  # set back below where all goes well
        result = None
        if not isinstance(item, FaultyFrame):
            result = self._odometry.track(item)
            result = replace(result, stage_ms={"read": self._read_ms, **result.stage_ms})
        self.newest.add(item, result, self._odometry.window, self.config.depth)
        self._last_ns, self._next, self.is_finished = item.stamp_ns, None, False
        return True

    def finish(self) -> tuple[Estimate, ...]:
        """Return the smoothed poses that the window still holds."""
        return self._odometry.finish()

    @property
    def last_ns(self) -> int | None:
        """Stamp of the last frame, nanoseconds."""
        return self._last_ns

    def close(self) -> None:
        """Close threads and files of the reading."""
        if isinstance(self._items, Generator):
            self._items.close()


def _is_read_differently(former: Config, config: Config) -> bool:
    """Tell whether another configuration asks for reading the recording anew."""
    return former.depth.scale != config.depth.scale or any(
        getattr(former, name) != getattr(config, name) for name in _SECTIONS
    )


def _stamp_ns(item: Paired) -> int:
    return item.stamp_ns if isinstance(item, FaultyFrame) else item[0].stamp_ns


def _stamp_of(source: Source, config: Config, index: int) -> int:
    """Return the stamp of a frame by its number; nothing is decoded."""
    sensor, n = source.info.sensor, 0
    for item in paired(source.images(), sensor, config.sync):
        if not isinstance(item, FaultyFrame) or is_lost(item, sensor):
            if n == index:
                return _stamp_ns(item)
            n += 1
    raise RecordingError(f"{source.info.name}: there is no frame {index}, only 0 to {n - 1}")


def _excerpt_from(stamp_ns: int, source: Source, config: Config) -> Excerpt:
    """Return the rest of a recording from a stamp on."""
    first = next(paired(source.images(), source.info.sensor, config.sync))
    return Excerpt(start_s=max(1e-9 * (stamp_ns - _stamp_ns(first)), 0.0))
