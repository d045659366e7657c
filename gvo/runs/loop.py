"""The loop of a run: frames in, poses out to all outputs."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, Protocol

from gvo.config import Config
from gvo.errors import OutputError, RecordingError
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames, is_lost, one_opencv_thread
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import Source
from gvo.odometry.odometry import Odometry
from gvo.runs.statistics import RunStatistics
from gvo.types import Estimate, FaultyFrame, FloatArray, Frame, FrameResult, Progress

_LOGGER = logging.getLogger(__name__)


class Output(Protocol):
    """Writes a run as it goes; all poses are of the base frame."""

    def add_frame(self, frame: Any, result: FrameResult) -> None:  # noqa: ANN401
        """Write what one frame gave, and the smoothed poses that are final with it."""

    def add_faulty(self, frame: FaultyFrame) -> None:
        """Write that a frame has no pose."""

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        """Write smoothed poses that are final."""


class RunLoop:
    """Odometry over a recording, or a part of it.

    Parameters
    ----------
    source : Source
        The recording.
    config : Config
    base_frame : BaseFrame
        Whose poses are written.
    excerpt : Excerpt, optional
        Which frames are read; all where omitted.
    first_pose : callable, optional
        Returns T_world_base, shape (4, 4), of the first frame by its stamp.
    items : iterable of StereoFrame, RgbdFrame or FaultyFrame, optional
        The frames in another order than that of the recording.

    Attributes
    ----------
    statistics : RunStatistics
        Counts so far.
    """

    def __init__(
        self,
        source: Source,
        config: Config,
        base_frame: BaseFrame,
        *,
        excerpt: Excerpt | None = None,
        first_pose: Callable[[int], FloatArray] | None = None,
        items: Iterable[Frame | FaultyFrame] | None = None,
    ) -> None:
        self.source = source
        self.config = config
        self.base_frame = base_frame
        self.statistics = RunStatistics()
        self._excerpt = excerpt or Excerpt()
        self._first_pose = first_pose
        self._items = items
        self._read_ms = 0.0
        self._first_ns: int | None = None
        self._odometry = Odometry(source.info.camera, config)

    @property
    def is_placed(self) -> bool:
        """Tell whether an initial pose was asked for: the world is not that of the first frame."""
        return self.base_frame.is_placed or self._first_pose is not None

    @property
    def is_excerpt(self) -> bool:
        """Tell whether a part of the recording is read."""
        return not self._excerpt.is_everything

    def run(
        self, outputs: Iterable[Output], on_progress: Callable[[Progress], None] | None
    ) -> None:
        """Track all frames; where the recording breaks off, note it and end.

        Parameters
        ----------
        outputs : iterable of Output
            Get all poses, also those still in the window where the run is interrupted.
        on_progress : callable, optional
            Called after each frame.
        """
        outputs = tuple(outputs)
        with one_opencv_thread():
            is_writable = True
            try:
                for item in self._read():
                    self._take(item, outputs)
                    if on_progress is not None:
                        on_progress(self.statistics.progress(self._n_expected(item.stamp_ns)))
            except OutputError:
                is_writable = False
                raise
            finally:
                finished = self._placed(self._odometry.finish())
                for output in outputs if is_writable else ():
                    output.add_smoothed(finished)
                self.count()

    def count(self) -> None:
        """Copy the counts of window, front-end and base frame into the statistics."""
        window = self._odometry.window
        self.statistics.window, self.statistics.batch_result = window.counts, window.batch_result
        self.statistics.rig_offsets = self._odometry.rig_offsets
        self.statistics.n_guessed = self.base_frame.n_guessed
        self.statistics.mount_travel_m = self.base_frame.mount_travel_m

    def _n_expected(self, stamp_ns: int) -> int:
        """Estimate the number of images in all, from the stamps so far."""
        n_images, n_done = (
            self.source.info.n_images,
            self.statistics.n_frames + self.statistics.n_unpaired,
        )
        if self._first_ns is None:
            self._first_ns = stamp_ns
        if n_done < 2:
            return self._excerpt.n_expected(n_images)
        period_s = 1e-9 * (stamp_ns - self._first_ns) / (n_done - 1) / self._excerpt.every
        length_s = max(period_s, 0.0) * n_images
        return self._excerpt.n_expected(n_images, length_s=length_s or None)

    def _read(self) -> Iterator[Frame | FaultyFrame]:
        items = self._items
        iterator = frames(self.source, self.config, self._excerpt) if items is None else iter(items)
        while True:
            start = time.perf_counter()
            try:
                item = next(iterator)
            except StopIteration:
                return
            except RecordingError as error:
                self.statistics.broken_off = str(error)
                return
            self._read_ms = 1e3 * (time.perf_counter() - start)
            yield item

    def _take(self, item: Frame | FaultyFrame, outputs: tuple[Output, ...]) -> None:
        """Count a frame, and give the outputs its poses as those of the base frame."""
        if isinstance(item, FaultyFrame):
            self._take_faulty(item, outputs)
            return
        if self._first_pose is not None and self.base_frame.first_stamp_ns is None:
            self.base_frame.start(item.stamp_ns, self._first_pose(item.stamp_ns))
        result = self._odometry.track(item)
        placed = replace(
            result,
            raw=self.base_frame.apply(result.raw),
            causal=self.base_frame.apply(result.causal),
            finished=self._placed(result.finished),
            stage_ms={"read": self._read_ms, **result.stage_ms},
        )
        text = f"{result.n_matches} matches, {result.n_inliers} inliers, {result.n_links} links"
        _LOGGER.debug("frame at %d: %s, %s %s", item.stamp_ns, result.status, text, result.reason)
        self.statistics.add_result(placed)
        for output in outputs:
            output.add_frame(item, placed)

    def _take_faulty(self, item: FaultyFrame, outputs: tuple[Output, ...]) -> None:
        is_loss = is_lost(item, self.source.info.sensor)
        _LOGGER.debug("frame at %d: skipped: %s", item.stamp_ns, item.reason)
        self.statistics.add_duration("read", self._read_ms)
        self.statistics.add_faulty(item, is_loss=is_loss)
        for output in outputs if is_loss else ():
            output.add_faulty(item)

    def _placed(self, estimates: tuple[Estimate, ...]) -> tuple[Estimate, ...]:
        return tuple(self.base_frame.apply(estimate) for estimate in estimates)
