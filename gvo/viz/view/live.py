"""A run that goes on elsewhere, shown as it goes: the newest frame wins."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, Protocol

import numpy as np

from gvo.backend.window import SlidingWindow
from gvo.config import Config, values_by_name
from gvo.io.recording import Source
from gvo.types import Estimate, FaultyFrame, FloatArray, Frame, FrameResult
from gvo.viz.view.clouds import Cloud, KeyframeClouds, accumulate, frame_cloud
from gvo.viz.view.history import FrameView, Path
from gvo.viz.view.tracking import FrameRecorder

# Poses of a path that are kept; for one more every second is dropped.
_N_POSES = 4096
_PATHS = ("raw", "causal", "smoothed")


class Adjustable(Protocol):
    """Parameters of a run, which others change too."""

    @property
    def config(self) -> Config:
        """The present configuration."""

    def set(self, values: Mapping[str, object]) -> Config:
        """Change parameters by `section.key`, or raise `ConfigurationError`."""

    def follow(self, callback: Callable[[Config], None]) -> None:
        """Call back after each change."""


class _Shown(NamedTuple):
    """A frame that may be shown, with the window as it was then."""

    number: int
    frame: Frame | FaultyFrame
    result: FrameResult | None
    T_world_frame: FloatArray
    poses: dict[int, Estimate]


class LivePlayer:
    """What a page shows of a run, and what it changes.

    The thread of the run calls `begin` and `add`, which only note; pictures are drawn in the
    thread of the page, and not at all where nobody looks.

    Parameters
    ----------
    source : Source
        The camera.
    parameters : Adjustable

    Attributes
    ----------
    is_watched : callable
        Whether anybody looks at the page.
    """

    fault = ""
    is_busy = is_finished = False

    def __init__(self, source: Source, parameters: Adjustable) -> None:
        self.source = source
        self._camera = source.info.camera
        self.parameters = parameters
        self.is_watched: Callable[[], bool] = lambda: True
        self.is_playing = True
        self.n_done = self.first_index = 0
        self.history = LiveHistory()
        self._recorder = FrameRecorder(self._camera)
        self._window: SlidingWindow | None = None
        self._newest: _Shown | None = None
        self._view: FrameView | None = None
        self._callbacks: list[Callable[[object], object]] = []

    def begin(self, window: SlidingWindow) -> None:
        """Forget what was shown: a new run begins, with its own window."""
        self.history, self._recorder = LiveHistory(), FrameRecorder(self._camera)
        self._window, self.first_index = window, self.n_done

    def add(self, frame: Frame | FaultyFrame, result: FrameResult | None) -> None:
        """Note a frame, and what it gave: poses of the camera; None of a faulty frame."""
        index, self.n_done = self.n_done, self.n_done + 1
        if result is not None and not isinstance(frame, FaultyFrame):
            self._recorder.note(result)
            self.history.add(result)
            if frame.stamp_ns in result.keyframes_ns:
                cloud = frame_cloud(frame, result.registration, self._camera, self.config.depth)
                self.history.add_keyframe(index, result.causal, cloud)
        if self._window is None or not (self.is_playing and self.is_watched()):
            return
        poses = self._recorder.read(self._window)
        self.history.correct(poses.values())
        self._newest = _Shown(index, frame, result, self.history.T_world_frame, poses)
        for callback in self._callbacks:
            callback(None)

    @property
    def n_frames(self) -> int:
        """Frames that came so far."""
        return self.n_done

    @property
    def index(self) -> int:
        """Number of the frame shown."""
        return -1 if self._view is None else self._view.index

    @property
    def frame_view(self) -> FrameView | None:
        """The newest frame, drawn; None before there is any."""
        shown = self._newest
        if shown is not None and shown.number != self.index:
            record = self._recorder.record(
                *(shown.frame, shown.result, shown.poses),
                index=shown.number,
                depth=self.config.depth,
            )
            self._view = FrameView.of(record, shown.number, shown.T_world_frame)
        return self._view

    def subscribe(self, callback: Callable[[object], object]) -> Callable[[], None]:
        """Call back where there is a frame to be shown, in the thread of the run."""
        self._callbacks.append(callback)
        return lambda: self._callbacks.remove(callback)

    def play(self) -> None:
        """Show the newest frames as they come."""
        self.is_playing = True

    def pause(self) -> None:
        """Stay at the frame that is shown; the run goes on."""
        self.is_playing = False

    @property
    def config(self) -> Config:
        """Of the next frame."""
        return self.parameters.config

    def reconfigure(self, config: Config) -> None:
        """Change what differs from the present configuration.

        Raises
        ------
        ConfigurationError
            When the run refuses it.
        """
        now, wanted = values_by_name(self.config), values_by_name(config)
        self.parameters.set({name: value for name, value in wanted.items() if value != now[name]})


class LiveHistory:
    """The paths and points of a run so far, in bounded memory.

    Of a long path every second, fourth, ... pose is kept; the newest always.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._n = self._n_frames = 0
        self._stride = 1
        self._stamps_ns = np.zeros(_N_POSES, dtype=np.int64)
        # Of each frame that is kept its position on each path, the smoothed one as best known.
        self._positions = np.zeros((_N_POSES, 3, 3))
        self._keyframes: dict[int, tuple[int, FloatArray]] = {}  # index and best pose, by stamp
        self._clouds = KeyframeClouds()
        self._loops_ns: list[tuple[int, int]] = []
        self.T_world_frame = np.eye(4)

    def add(self, result: FrameResult) -> None:
        """Take the poses of the next frame."""
        raw, causal = result.raw.T_world_frame, result.causal.T_world_frame
        with self._lock:
            if self._n_frames % self._stride == 0:
                self._stamps_ns[self._n] = result.stamp_ns
                self._positions[self._n] = raw[:3, 3], causal[:3, 3], causal[:3, 3]
                self._n += 1
            self._n_frames += 1
            self._loops_ns += [(loop.reference_ns, loop.stamp_ns) for loop in result.loops]
            self.T_world_frame = causal
            if self._n == _N_POSES:
                self._thin()
        self.correct(result.finished)

    def _thin(self) -> None:
        half = _N_POSES // 2
        self._stamps_ns[:half] = self._stamps_ns[::2]
        self._positions[:half] = self._positions[::2]
        self._n, self._stride = half, 2 * self._stride

    def add_keyframe(self, index: int, estimate: Estimate, cloud: Cloud) -> None:
        """Keep the points of a frame."""
        with self._lock:
            self._keyframes[estimate.stamp_ns] = index, estimate.T_world_frame
            self._clouds.add(index, cloud)

    def correct(self, estimates: Iterable[Estimate]) -> None:
        """Take better poses of frames before."""
        with self._lock:
            for estimate in estimates:
                stamp_ns, T = estimate.stamp_ns, estimate.T_world_frame
                row = int(np.searchsorted(self._stamps_ns[: self._n], stamp_ns))
                if row < self._n and self._stamps_ns[row] == stamp_ns:
                    self._positions[row, 2] = T[:3, 3]
                if stamp_ns in self._keyframes:
                    self._keyframes[stamp_ns] = self._keyframes[stamp_ns][0], T

    def path(self, name: str) -> Path:
        """Return stamps (n,) and positions (n, 3).

        Parameters
        ----------
        name : {"raw", "causal", "smoothed"}
            The raw chain; poses as they were known when each frame came; as they are known now.
        """
        with self._lock:
            positions = self._positions[: self._n, _PATHS.index(name)]
            return self._stamps_ns[: self._n].copy(), positions.copy()

    def loop_lines(self) -> FloatArray:
        """Return both ends of the loops so far, shape (n, 2, 3), metres."""
        stamps_ns, positions = self.path("smoothed")
        rows = np.searchsorted(stamps_ns, np.array(self._loops_ns, dtype=np.int64).reshape(-1, 2))
        return positions[np.minimum(rows, len(stamps_ns) - 1)]

    def accumulated_cloud(self) -> Cloud:
        """Return the points of all keyframes in the world, metres, and their colours, RGB."""
        with self._lock:
            clouds = self._clouds.select(dict(self._keyframes.values()))
        return accumulate(clouds)
