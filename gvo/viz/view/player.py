"""Plays odometry over a recording, forward as it is computed and backward as it was; or a run."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import TypeAlias

import numpy as np

from gvo.config import Config
from gvo.errors import GvoError
from gvo.io.excerpt import Excerpt
from gvo.io.frames import one_opencv_thread
from gvo.io.recording import Source
from gvo.types import IntArray
from gvo.viz.view.history import FrameView, History
from gvo.viz.view.tracking import OpenSource, Tracking

Subscriber: TypeAlias = Callable[[FrameView], None]
_LOGGER = logging.getLogger(__name__)

# A gap of the stamps is not waited for longer, seconds of the recording.
_MAX_GAP_S = 1.0


class Player(AbstractContextManager["Player"]):
    """Runs odometry over a recording on a thread of its own.

    Nothing is computed before `play`, `step` or `seek`. Frames that were computed are shown again
    as they were; odometry is never rewound. All methods may be called from any thread and return
    at once; what they ask for begins after the frame under way.

    Parameters
    ----------
    open_source : callable
        Opens the recording with a configuration; called again by `restart`, and where parameters
        of reading change (`sync`, `images`, `runtime`, `depth.scale`).
    config : Config
    excerpt : Excerpt, optional
        The part that is played; the whole recording where omitted.

    Attributes
    ----------
    config : Config
        Of the next frame.
    history : History
        The frames since the start or the last restart.
    is_playing : bool
        Frames follow by themselves.
    is_finished : bool
        The recording is read to its end, or as far as it can be.
    fault : str
        The last error, in one line; empty after a restart or another configuration.

    Raises
    ------
    GvoError
        When the recording cannot be opened.

    Examples
    --------
    >>> from gvo.io.synthetic import SyntheticRecording
    >>> recording = SyntheticRecording("handheld", "rgbd", n_frames=3, scale=0.25)
    >>> with Player(lambda config: recording, Config()) as player:
    ...     player.seek(2)
    ...     player.wait(), player.index, len(player.history.path("raw")[0])
    (True, 2, 3)
    """

    def __init__(
        self, open_source: OpenSource, config: Config, *, excerpt: Excerpt | None = None
    ) -> None:
        self._open_source = open_source
        self._excerpt = excerpt or Excerpt()
        self._tracking = Tracking(open_source, config, self._excerpt)
        self.history = History()
        # Guards all below and wakes the thread.
        self._changed = threading.Condition()
        self.config = config
        self._speed: float | None = 1.0
        self.is_playing = False
        self._is_stepping = False
        self._goal: int | None = None
        self._restart_index: int | None = None
        self._is_closed = False
        self._is_working = False
        self.is_finished = False
        self.fault = ""
        self._due_s = -math.inf  # when the frame shown was due, by the clock of `monotonic`
        self._subscribers: list[Subscriber] = []
        self._thread = threading.Thread(target=self._work, name="player", daemon=True)
        self._thread.start()

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Change what the thread waits for."""
        with self._changed:
            yield
            self._changed.notify_all()

    # Commands

    def play(self) -> None:
        """Go on from the frame shown, at the speed that is set."""
        with self._changing():
            self.is_playing = True
            self._due_s = -math.inf

    def pause(self) -> None:
        """Stop, also on the way to a frame."""
        with self._changing():
            self.is_playing = self._is_stepping = False
            self._goal = None

    def step(self) -> None:
        """Show the next frame and pause; calls add up."""
        with self._changing():
            base = self._goal if self._is_stepping and self._goal is not None else self.index
            self._goal = base + 1
            self._is_stepping, self.is_playing = True, False

    def seek(self, index: int) -> None:
        """Show a frame, as soon as all frames up to it are computed; playing goes on from there.

        Parameters
        ----------
        index : int
            Of the frame in the recording; clipped to the first and the last one.
        """
        with self._changing():
            self._goal = max(int(index), self.first_index)
            self._is_stepping = False

    def set_speed(self, factor: float | None) -> None:
        """Play by the recording's stamps, or as fast as possible; no frame is left out.

        Parameters
        ----------
        factor : float or None
            1: as recorded, 2: in half the time; None: as fast as possible.

        Raises
        ------
        ValueError
            When the factor is not positive.
        """
        if factor is not None and not (math.isfinite(factor) and factor > 0):
            raise ValueError(f"the speed must be positive or None, got {factor}")
        with self._changing():
            self._speed = factor

    def reconfigure(self, config: Config) -> None:
        """Compute with another configuration from the next frame on.

        Where the recording must be opened again for it and cannot be, `fault` tells why and the
        former configuration stays.

        Raises
        ------
        ValueError
            When it is no Config.
        """
        if not isinstance(config, Config):
            raise ValueError(f"config must be a gvo.Config, got {type(config).__name__}")
        with self._changing():
            self.config, self.fault = config, ""

    def restart(self, index: int | None = None) -> None:
        """Drop what was computed and begin anew, with the present configuration.

        The first frame that is tracked is the world; frames keep their numbers.

        Parameters
        ----------
        index : int, optional
            First frame: 0, or one that is done; the one that is shown where omitted.

        Raises
        ------
        ValueError
            When the frame is not known yet.
        """
        with self._changing():
            index = max(self.index, 0) if index is None else int(index)
            if index != 0 and not self.first_index <= index < self.n_done:
                raise ValueError(f"frame {index} is not known: {self.n_done} are done")
            self._restart_index = index
            self._goal, self._is_stepping = None, False

    def subscribe(self, callback: Subscriber) -> Callable[[], None]:
        """Call back with each frame that is shown, on the thread of the player.

        Returns
        -------
        callable
            Unsubscribes.
        """
        with self._changed:
            self._subscribers.append(callback)
        return partial(self._unsubscribe, callback)

    def _unsubscribe(self, callback: Subscriber) -> None:
        with self._changed:
            if callback in self._subscribers:
                self._subscribers.remove(callback)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until nothing is left to do; False on timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: not self.is_busy, timeout_s)

    def close(self) -> None:
        """End the thread after the frame under way; the history can still be read."""
        with self._changing():
            self._is_closed = True
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    # State

    @property
    def n_frames(self) -> int:
        """Frames that the recording announces; those that were read, once it is finished."""
        if self.is_finished:
            return self.n_done
        return max(self._excerpt.n_expected(self.source.info.n_images), self.n_done)

    @property
    def n_done(self) -> int:
        """Frames that are done: the index of the last one, and 1."""
        return self.history.n_done

    @property
    def index(self) -> int:
        """Index of the frame shown; one less than `first_index` before there is any."""
        return self.history.shown

    @property
    def first_index(self) -> int:
        """Where odometry began."""
        return self.history.first_index

    @property
    def is_busy(self) -> bool:
        """Whether something is under way or left to do."""
        if self._is_closed:
            return self._is_working
        return self.is_playing or self._is_working or self._is_asked()

    @property
    def source(self) -> Source:
        """The recording."""
        return self._tracking.source

    @property
    def frame_view(self) -> FrameView | None:
        """The frame shown; None before there is any."""
        history = self.history
        return history.frame_view() if history.shown >= history.first_index else None

    # On the thread

    def _work(self) -> None:
        with one_opencv_thread():
            while self._wait_for_work():
                if not self._guarded(self._turn):
                    with self._changed:
                        self.is_playing = self._is_stepping = False
                        self._goal = self._restart_index = None
                    self._publish()
        self._guarded(self._tracking.close)

    def _wait_for_work(self) -> bool:
        """Return whether there is work; False at the end of the thread."""
        with self._changed:
            self._is_working = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_closed or self.is_busy)
            self._is_working = not self._is_closed
            return self._is_working

    def _guarded(self, work: Callable[[], None]) -> bool:
        """Call; keep an error as `fault`: the thread must go on."""
        try:
            work()
        except GvoError as error:
            self.fault = str(error)
        except Exception as error:
            _LOGGER.exception("the player failed")
            self.fault = f"{type(error).__name__}: {error}"
        else:
            return True
        return False

    def _publish(self) -> None:
        """Tell all subscribers of the frame shown."""
        with self._changed:
            subscribers = tuple(self._subscribers)
        view = self.frame_view if subscribers else None
        if view is not None:
            for callback in subscribers:
                self._guarded(partial(callback, view))

    def _turn(self) -> None:
        """Carry out one command: start anew, or show or compute one frame."""
        with self._changed:
            restart_index, goal = self._restart_index, self._goal
        if restart_index is not None:
            self._start_anew(restart_index)
        elif goal is not None:
            self._approach(goal)
        elif self._wait_until_due() and not self._show_next():
            with self._changed:
                self.is_playing = False

    def _start_anew(self, index: int) -> None:
        from_ns = None if index == 0 else self.history.stamp_ns(index)
        tracking = Tracking(self._open_source, self.config, self._excerpt, from_ns=from_ns)
        self._tracking.close()
        with self._changed:
            self._tracking, self.history = tracking, History(index)
            self.is_finished, self.fault = False, ""
            if self._restart_index == index:
                self._restart_index = None
            if self._goal is None:
                self._goal = index

    def _approach(self, goal: int) -> None:
        """Show a frame, or the next one on the way to it."""
        if goal < self.n_done:
            self._show(goal)
        elif not self._advance() and self.index < self.n_done - 1:
            self._show(self.n_done - 1)
        with self._changed:
            is_arrived = self.index == goal or self.is_finished
            if is_arrived and self._goal == goal:  # not another one by now
                self._goal, self._is_stepping = None, False
            self._due_s = time.monotonic()

    def _wait_until_due(self) -> bool:
        """Wait until the next frame is due; False where another command came."""
        gap_s = self._gap_s()
        with self._changed:
            while self.is_playing and not (self._is_asked() or self._is_closed):
                pause_s = 0.0 if self._speed is None else gap_s / self._speed
                now_s, due_s = time.monotonic(), self._due_s + pause_s
                if now_s >= due_s:
                    # A delay of more than a frame is not caught up.
                    self._due_s = due_s if now_s - due_s <= pause_s else now_s
                    return True
                self._changed.wait(due_s - now_s)
        return False

    def _is_asked(self) -> bool:
        return self._goal is not None or self._restart_index is not None

    def _gap_s(self) -> float:
        """Return how long after the frame shown the next one was recorded."""
        if self.index < self.first_index:
            return 0.0
        if self.index + 1 < self.n_done:
            next_ns = self.history.stamp_ns(self.index + 1)
        elif (item := self._tracking.peek()) is not None:
            next_ns = item.stamp_ns
        else:
            return 0.0
        gap_s = 1e-9 * (next_ns - self.history.stamp_ns(self.index))
        return min(max(gap_s, 0.0), _MAX_GAP_S)

    def _show_next(self) -> bool:
        if self.index + 1 < self.n_done:
            self._show(self.index + 1)
            return True
        return self._advance()

    def _show(self, index: int) -> None:
        self.history.show(index)
        self._publish()

    def _advance(self) -> bool:
        """Compute and show the next frame; return False at the end."""
        if self.is_finished:
            return False
        try:
            self._take_configuration()
            record = self._tracking.advance(self.n_done)
            if record is not None:
                self.history.add(record)
                self._show(self.n_done - 1)
                self._tracking.peek()  # is it the last one?
        finally:
            if self._tracking.is_finished:
                self._finish()
        return record is not None

    def _take_configuration(self) -> None:
        config = self.config
        if config is self._tracking.config:
            return
        try:
            self._tracking.reconfigure(config)
        except GvoError as error:
            with self._changed:
                self.fault = str(error)
                if self.config is config:
                    self.config = self._tracking.config

    def _finish(self) -> None:
        """Add the smoothed poses of the frames that the window still holds."""
        self.is_finished = True
        if self.n_done > self.first_index:
            self.history.finish(self._tracking.finish())
            self._publish()


class RunPlayer:
    """Plays frames by their stamps.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Of the frames, nanoseconds.
    show : callable
        Called with the index of each frame to be shown.
    period_s : float
        How often it looks whether the next frame is due.

    Attributes
    ----------
    index : int
        Frame that is shown.
    is_playing : bool
        Frames follow by themselves.
    """

    def __init__(
        self, stamps_ns: IntArray, show: Callable[[int], None], *, period_s: float = 0.02
    ) -> None:
        self._stamps_ns, self._period_s, self._show = stamps_ns, period_s, show
        self._lock = threading.RLock()
        self.index = 0
        self.is_playing = False
        self._speed: float | None = 1.0
        self._ahead_ns = 0.0
        self._is_closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gvo run player", daemon=True)
        self._thread.start()

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self._stamps_ns)

    def play(self) -> None:
        """Let frames follow by themselves; from the end, begin again."""
        with self._lock:
            if self.index >= self.n_frames - 1:
                self.seek(0)
            self._ahead_ns = 0.0
            self.is_playing = True

    def pause(self) -> None:
        """Stay at the frame."""
        self.is_playing = False

    def step(self) -> None:
        """Show the next frame and pause."""
        self.pause()
        self.seek(self.index + 1)

    def seek(self, index: int) -> None:
        """Show a frame; the index is clipped."""
        with self._lock:
            self.index = int(np.clip(index, 0, max(0, self.n_frames - 1)))
            self._ahead_ns = 0.0
            self._show(self.index)

    def set_speed(self, factor: float | None) -> None:
        """Play as recorded (1), faster, slower, or frame by frame without waiting (None)."""
        self._speed = factor

    def advance(self, elapsed_s: float) -> None:
        """Play on by some time."""
        with self._lock:
            if not self.is_playing:
                return
            if self._speed is None:
                self.seek(self.index + 1)
            else:
                self._advance_by(1e9 * elapsed_s * self._speed)
            if self.index >= self.n_frames - 1:
                self.is_playing = False

    def _advance_by(self, span_ns: float) -> None:
        ahead_ns = self._ahead_ns + span_ns
        now_ns = int(self._stamps_ns[self.index]) + int(ahead_ns)
        index = int(np.searchsorted(self._stamps_ns, now_ns, side="right")) - 1
        if index > self.index:
            self.seek(index)
            ahead_ns = float(now_ns - int(self._stamps_ns[index]))
        self._ahead_ns = ahead_ns

    def close(self) -> None:
        """End the thread."""
        self._is_closing.set()
        self._thread.join()

    def _run(self) -> None:
        before = time.monotonic()
        while not self._is_closing.wait(self._period_s):
            now = time.monotonic()
            self.advance(now - before)
            before = now
