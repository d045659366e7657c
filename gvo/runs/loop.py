"""The loop of a run: frames in, poses out to all outputs."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from gvo.backend.window import SlidingWindow
from gvo.config import Config
from gvo.errors import OutputError, RecordingError, SmoothingError
from gvo.geometry.imu import ImuSamples
from gvo.io.excerpt import Excerpt
from gvo.io.frames import Through, frames, is_lost, one_opencv_thread
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import Source
from gvo.odometry.odometry import Odometry
from gvo.runs.outputs.file import FileOutput
from gvo.runs.statistics import RunStatistics
from gvo.trajectory.consistency import SPANS_S, Motions
from gvo.types import Edge, Estimate, FaultyFrame, FloatArray, Frame, FrameResult, Optimum, Progress

_LOGGER = logging.getLogger(__name__)

_MOST_OFF_NS = 500_000_000
# Samples are read so far ahead of the frames: an IMU may be late by less.
_AHEAD_NS = 200_000_000
# And from so long before the first frame on.
_BEFORE_NS = 2_000_000_000


class Output(Protocol):
    """Writes a run as it goes; all poses are of the base frame."""

    def add_frame(self, frame: Any, result: FrameResult) -> None:  # noqa: ANN401
        """Write the result of a frame, with the smoothed poses that became final."""

    def add_faulty(self, frame: FaultyFrame) -> None:
        """Write that a frame has no pose."""

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        """Write smoothed poses that will not change any more."""

    def add_optimum(self, optimum: Optimum) -> None:
        """Write the global poses and the loops, at the end."""


class RunLoop:
    """Odometry over a recording, or a part of it.

    Parameters
    ----------
    source : Source
        The recording.
    config : Config
    base_frame : BaseFrame
        The frame whose poses are written.
    excerpt : Excerpt, optional
        The frames to read; all if omitted.
    first_pose : callable, optional
        Returns T_world_base, shape (4, 4), of the first frame by its stamp.
    through : callable, optional
        See `gvo.frames`.

    Attributes
    ----------
    excerpt : Excerpt
        Which frames are read.
    first_pose : callable or None
        As given; another one may be set before the run.
    statistics : RunStatistics
        Counts so far.
    edges : dict of int to list of (int, Edge)
        Motions of the base frame as the window had them, by their span in seconds, one per span:
        the stamp of a frame, and the edge to it from a frame about so much earlier.
    output_faults : list of str
        Why outputs could not be written completely.
    imu_until : callable or None
        Yields samples of the IMU up to a stamp of the camera, nanoseconds, and later ones; None
        where there is no IMU. A running camera has another one than that of a recording.
    waited_s : callable
        Returns how long reading has waited for frames of a running camera so far, seconds.
    on_tracked : callable or None
        Called after the outputs with each frame and its result (poses of the camera), or with a
        faulty frame and None.
    """

    def __init__(
        self,
        source: Source,
        config: Config,
        base_frame: BaseFrame,
        *,
        excerpt: Excerpt | None = None,
        first_pose: Callable[[int], FloatArray] | None = None,
        through: Through | None = None,
    ) -> None:
        self.source, self.config, self.base_frame = source, config, base_frame
        self.statistics = RunStatistics()
        self.excerpt = excerpt or Excerpt()
        self.first_pose, self._through = first_pose, through
        self._read_ms = 0.0
        self._first_ns: int | None = None
        self._previous_ns: int | None = None
        self._outputs: list[Output] = []
        self.edges: dict[int, list[tuple[int, Edge]]] = {span_s: [] for span_s in SPANS_S}
        self._given_ns = dict[int, int]()
        self.output_faults: list[str] = []
        self.waited_s: Callable[[], float] = lambda: 0.0
        self.on_tracked: Callable[[Frame | FaultyFrame, FrameResult | None], None] | None = None
        stream = source.info.imu if config.imu.enabled else None
        self._odometry = Odometry(
            source.info.camera, config, imu=None if stream is None else stream.imu
        )
        self.imu_until: Callable[[int], Iterator[ImuSamples]] | None = None
        if stream is not None:
            self.imu_until = ImuFeed(stream.samples, delay_ns=self.imu_delay_ns).until

    @property
    def window(self) -> SlidingWindow:
        """The window of the odometry, for `on_tracked` to read."""
        return self._odometry.window

    @property
    def imu_delay_ns(self) -> int:
        """What is added to stamps of the IMU, as far as it is known by now."""
        inertial = self._odometry.inertial
        return 0 if inertial is None else round(1e9 * (inertial.imu.delay_s or 0.0))

    @property
    def is_placed(self) -> bool:
        """Tell whether the first pose was given, so that it is not the identity."""
        return self.base_frame.is_placed or self.first_pose is not None

    def run(
        self, outputs: Iterable[Output], on_progress: Callable[[Progress], None] | None
    ) -> None:
        """Track all frames; if the recording breaks off, note it and end.

        Parameters
        ----------
        outputs : iterable of Output
            Get all poses; if the run is interrupted, also those still in the window. An output that
            raises `OutputError` ends the run; one that raises another error gets no more poses.
        on_progress : callable, optional
            Called after each frame.
        """
        self._outputs = list(outputs)
        with one_opencv_thread():
            is_writable = True
            try:
                for item in self._read():
                    self._take(item)
                    if on_progress is not None:
                        on_progress(self.statistics.progress(self._n_expected(item.stamp_ns)))
            except OutputError:
                is_writable = False
                raise
            finally:
                finished = self._placed(self._odometry.finish())
                self.count()
                if is_writable:
                    self._give(lambda output: output.add_smoothed(finished))

    def reconfigure(self, config: Config) -> None:
        """Change the configuration from the next frame on, see `Odometry.reconfigure`."""
        self._odometry.reconfigure(config)
        self.config = config

    def optimize(self) -> Optimum | None:
        """Give the outputs the optimum of all measurements, at the end of a run.

        Returns
        -------
        Optimum or None
            As of `begin_optimum`; also None if GTSAM fails, and then `output_faults` says so.
        """
        try:
            optimum = self.begin_optimum()()
        except SmoothingError as error:
            self.output_faults.append(f"no global poses: {error}")
            return None
        if optimum is not None:
            self._give(lambda output: output.add_optimum(optimum))
        return optimum

    def begin_optimum(self) -> Callable[[], Optimum | None]:
        """Return a function that computes the optimum of the frames so far, in any thread.

        Returns
        -------
        callable
            Returns an Optimum with poses of the base frame; None if `loops.enabled` is off or no
            frame has a pose. Raises `SmoothingError` if GTSAM fails.
        """
        if not self.config.loops.enabled or self.statistics.n_with_pose == 0:
            return lambda: None
        graph = self._odometry.snapshot()
        return lambda: self._placed_optimum(graph.optimize())

    def _placed_optimum(self, optimum: Optimum) -> Optimum:
        place = self.base_frame.apply_to_edge
        return replace(
            optimum,
            estimates=self._placed(optimum.estimates),
            edges=tuple((stamp_ns, place(stamp_ns, edge)) for stamp_ns, edge in optimum.edges),
            loops=tuple(map(self.base_frame.apply_to_loop, optimum.loops)),
        )

    def count(self) -> None:
        """Copy the counts of window, front-end and base frame into the statistics."""
        window = self._odometry.window
        self.statistics.window, self.statistics.batch_result = window.counts, window.batch_result
        self.statistics.rig_offsets = self._odometry.rig_offsets
        self.statistics.inertial = self._odometry.inertial
        self.statistics.n_guessed = self.base_frame.n_guessed
        self.statistics.mount_travel_m = self.base_frame.mount_travel_m

    def _n_expected(self, stamp_ns: int) -> int:
        """Estimate the number of images in all, from the stamps so far."""
        n_images = self.source.info.n_images
        n_done = self.statistics.n_frames + self.statistics.n_unpaired
        if self._first_ns is None:
            self._first_ns = stamp_ns
        if n_done < 2:
            return self.excerpt.n_expected(n_images)
        period_s = 1e-9 * (stamp_ns - self._first_ns) / (n_done - 1) / self.excerpt.every
        length_s = max(period_s, 0.0) * n_images
        return self.excerpt.n_expected(n_images, length_s=length_s or None)

    def _read(self) -> Iterator[Frame | FaultyFrame]:
        items = frames(self.source, self.config, self.excerpt, through=self._through)
        iterator = iter(items)
        while True:
            start, waited_s = time.perf_counter(), self.waited_s()
            try:
                item = next(iterator)
            except StopIteration:
                return
            except RecordingError as error:
                self.statistics.broken_off = str(error)
                return
            waited_s = self.waited_s() - waited_s
            self._read_ms = 1e3 * (time.perf_counter() - start - waited_s)
            yield item

    def _take(self, item: Frame | FaultyFrame) -> None:
        """Track a frame, count it, and give its poses of the base frame to the outputs."""
        if isinstance(item, FaultyFrame):
            self._take_faulty(item)
            return
        if self.first_pose is not None and self.base_frame.first_stamp_ns is None:
            self.base_frame.start(item.stamp_ns, self.first_pose(item.stamp_ns))
        self._feed_imu(item.stamp_ns)
        result = self._odometry.track(item)
        result = replace(result, stage_ms={"read": self._read_ms, **result.stage_ms})
        placed = self._placed_result(result)
        text = f"{result.n_matches} matches, {result.n_inliers} inliers, {result.n_links} links"
        _LOGGER.debug("frame at %d: %s, %s %s", item.stamp_ns, result.status, text, result.reason)
        self.statistics.add_result(placed)
        self._ask_window(item.stamp_ns)
        self._give(lambda output: output.add_frame(item, placed))
        if self.on_tracked is not None:
            self.on_tracked(item, result)

    def _feed_imu(self, stamp_ns: int) -> None:
        """Give odometry the samples up to a frame; note where they cannot be read on."""
        if self.imu_until is None:
            return
        try:
            for samples in self.imu_until(stamp_ns):
                self._odometry.add_imu(samples.stamps_ns, samples.gyro, samples.acceleration)
        except RecordingError as error:
            self.imu_until = None
            self.statistics.broken_off = str(error)

    def discard_files(self) -> None:
        """Give up the bag and the like, which take most of the disk."""
        for output in self._outputs:
            if isinstance(output, FileOutput):
                output.discard()

    def _give(self, write: Callable[[Output], None]) -> None:
        for output in tuple(self._outputs):
            try:
                write(output)
            except OutputError:
                raise
            except RecordingError as error:
                self._outputs.remove(output)
                self.output_faults.append(str(error))
                if isinstance(output, FileOutput):
                    output.discard()

    def _ask_window(self, stamp_ns: int) -> None:
        """Once per span, keep the motion over it as the window has it, as soon as it has one."""
        for span_s, edges in self.edges.items():
            span_ns = span_s * 10**9
            if stamp_ns - self._given_ns.setdefault(span_s, stamp_ns) < span_ns:
                continue
            if (edge := edge_over(self._odometry.window, stamp_ns, span_ns)) is not None:
                self._given_ns[span_s] = stamp_ns
                edges.append((stamp_ns, self.base_frame.apply_to_edge(stamp_ns, edge)))

    def _take_faulty(self, item: FaultyFrame) -> None:
        is_loss = is_lost(item, self.source.info.sensor)
        _LOGGER.debug("frame at %d: skipped: %s", item.stamp_ns, item.reason)
        self.statistics.add_duration("read", self._read_ms)
        self.statistics.add_faulty(item, is_loss=is_loss)
        if is_loss:
            self._give(lambda output: output.add_faulty(item))
            if self.on_tracked is not None:
                self.on_tracked(item, None)

    def _placed_result(self, result: FrameResult) -> FrameResult:
        """Return a result as one of the base frame."""
        step, start_ns = result.T_previous_frame, self._previous_ns
        if step is not None and start_ns is not None:
            step = self.base_frame.apply_to_step(start_ns, result.stamp_ns, step)
        self._previous_ns = result.stamp_ns
        return replace(
            result,
            raw=self.base_frame.apply(result.raw),
            causal=self.base_frame.apply(result.causal),
            finished=self._placed(result.finished),
            loops=tuple(map(self.base_frame.apply_to_loop, result.loops)),
            T_previous_frame=step,
            T_map_world=self.base_frame.apply_to_world(result.T_map_world),
            inertial=self.base_frame.apply_to_inertial(result.inertial),
        )

    def _placed(self, estimates: tuple[Estimate, ...]) -> tuple[Estimate, ...]:
        return tuple(self.base_frame.apply(estimate) for estimate in estimates)


class ImuFeed:
    """Hands out the samples of a recording in step with its frames.

    Parameters
    ----------
    samples : callable
        As of `ImuStream`.
    delay_ns : int
        Of the IMU, as far as it is known.
    """

    def __init__(
        self, samples: Callable[[int], Iterator[ImuSamples]], *, delay_ns: int = 0
    ) -> None:
        self._open, self._delay_ns = samples, delay_ns
        self._samples: Iterator[ImuSamples] | None = None
        self._last_ns: int | None = None

    def until(self, stamp_ns: int) -> Iterator[ImuSamples]:
        """Yield samples until some are later than a stamp of the camera."""
        stamp_ns -= self._delay_ns
        if self._samples is None:
            self._samples = self._open(stamp_ns - _BEFORE_NS)
        while self._last_ns is None or self._last_ns < stamp_ns + _AHEAD_NS:
            samples = next(self._samples, None)
            if samples is None:
                return
            if len(samples) > 0:
                self._last_ns = int(samples.stamps_ns[-2:].min())  # one may be damaged
                yield samples


def edge_over(window: SlidingWindow, stamp_ns: int, span_ns: int) -> Edge | None:
    """Return the edge to the newest pose from one about `span_ns` older.

    Parameters
    ----------
    window : SlidingWindow
        Of odometry: stamps name its poses.
    stamp_ns : int
        Of the newest pose, nanoseconds.
    span_ns : int
        Nanoseconds.

    Returns
    -------
    Edge or None
        None if no pose of the window has that age within half a second, or if the newest pose is
        not in the window.
    """
    if stamp_ns not in window:
        return None
    ages_ns = {pose: stamp_ns - window.stamp_ns(pose) for pose in window.poses()}
    start = min(ages_ns, key=lambda pose: abs(ages_ns[pose] - span_ns))
    if abs(ages_ns[start] - span_ns) > _MOST_OFF_NS:
        return None
    return window.relative_pose(start, stamp_ns)


def motions_of_window(edges: Sequence[tuple[int, Edge]]) -> Motions:
    """Return edges as motions, to be compared with the true ones.

    Parameters
    ----------
    edges : sequence of (int, Edge)
        Stamps and edges, as `RunLoop.edges` of one span.
    """
    return Motions(
        start_ns=np.array([edge.reference_id for _, edge in edges], dtype=np.int64),
        end_ns=np.array([stamp_ns for stamp_ns, _ in edges], dtype=np.int64),
        T_start_end=np.array([edge.T_reference_frame for _, edge in edges]).reshape(-1, 4, 4),
        covariances=np.array([edge.covariance for _, edge in edges]).reshape(-1, 6, 6),
    )
