"""Plays odometry over a recording, as it is computed."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from gvo.config import Config
from gvo.errors import GvoError
from gvo.io.frames import one_opencv_thread
from gvo.io.recording import Source
from gvo.viz.view.newest import Newest
from gvo.viz.view.tracking import OpenSource, Tracking

_LOGGER = logging.getLogger(__name__)

# A gap of the stamps is not waited for longer, seconds of the recording.
_MAX_GAP_S = 1.0


class Player(AbstractContextManager["Player"]):
    """Runs odometry over a recording on a thread of its own, forward.

    Nothing is computed before `play`, `step` or `restart`. All methods may be called from any
    thread and return at once; what they ask for begins after the frame under way.

    Parameters
    ----------
    open_source : callable
        Opens the recording with a configuration; called again by `restart`, and where parameters
        of reading change (`sync`, `images`, `runtime`, `depth.scale`).
    config : Config

    Attributes
    ----------
    config : Config
        Of the next frame.
    newest : Newest
        The newest frame, and the history since the start or the last restart.
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
    ...     player.set_speed(None)
    ...     player.play()
    ...     player.wait(), player.newest.n_done
    (True, 3)
    """

    def __init__(self, open_source: OpenSource, config: Config) -> None:
        self._open_source = open_source
        self._tracking = Tracking(open_source, config)
        # Guards all below and wakes the thread.
        self._changed = threading.Condition()
        self.config = config
        self._speed: float | None = 1.0
        self.is_playing = False
        self._n_steps = 0
        self._restart_index: int | None = None
        self._is_closed = False
        self._is_working = False
        self.is_finished = False
        self.fault = ""
        self._due_s = -math.inf  # when the frame shown was due, by the clock of `monotonic`
        self._thread = threading.Thread(target=self._work, name="player", daemon=True)
        self._thread.start()

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Change what the thread waits for."""
        with self._changed:
            yield
            self._changed.notify_all()

    def play(self) -> None:
        """Go on, at the speed that is set."""
        with self._changing():
            self.is_playing = True
            self._due_s = -math.inf

    def pause(self) -> None:
        """Stop after the frame under way."""
        with self._changing():
            self.is_playing, self._n_steps = False, 0

    def step(self) -> None:
        """Track the next frame and pause; calls add up."""
        with self._changing():
            self.is_playing = False
            self._n_steps += 1

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
        """
        with self._changing():
            self.config, self.fault = config, ""

    def restart(self, index: int = 0) -> None:
        """Begin anew at a frame of the recording, with the present configuration.

        It is the world, and is shown; frames keep their numbers. Where there is no such frame,
        `fault` tells so and nothing changes.
        """
        with self._changing():
            self._restart_index, self._n_steps = max(int(index), 0), 0

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until nothing is left to do; False on timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: not self.is_busy, timeout_s)

    def close(self) -> None:
        """End the thread after the frame under way."""
        with self._changing():
            self._is_closed = True
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    @property
    def newest(self) -> Newest:
        """The newest frame, and what led to it."""
        return self._tracking.newest

    @property
    def n_frames(self) -> int:
        """Frames that the recording announces; those that were read, once it is finished."""
        n_done = self.newest.n_done
        return n_done if self.is_finished else max(self.source.info.n_images, n_done)

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

    # On the thread

    def _work(self) -> None:
        with one_opencv_thread():
            while self._wait_for_work():
                if not self._guarded(self._turn):
                    with self._changed:
                        self.is_playing, self._n_steps, self._restart_index = False, 0, None
        self._guarded(self._tracking.close)

    def _wait_for_work(self) -> bool:
        """Return whether there is work; False at the end of the thread."""
        with self._changed:
            self._is_working = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_closed or self.is_busy)
            self._is_working = not self._is_closed
            return self._is_working

    def _guarded(self, work: Callable[[], object]) -> bool:
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

    def _turn(self) -> None:
        """Carry out one command: start anew, or track one frame."""
        with self._changed:
            restart_index, is_stepping = self._restart_index, self._n_steps > 0
            self._restart_index = None
            if restart_index is None and is_stepping:
                self._n_steps -= 1
        if restart_index is not None:
            self._start_anew(restart_index)
        elif (is_stepping or self._wait_until_due()) and not self._advance():
            with self._changed:
                self.is_playing, self._n_steps = False, 0

    def _start_anew(self, index: int) -> None:
        tracking = Tracking(self._open_source, self.config, index)
        self._tracking.close()
        with self._changed:
            self._tracking = tracking
            self.is_finished, self.fault = False, ""
        self._advance()

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
        return self._n_steps > 0 or self._restart_index is not None

    def _gap_s(self) -> float:
        """Return how long after the newest frame the next one was recorded."""
        item, last_ns = self._tracking.peek(), self._tracking.last_ns
        if item is None or last_ns is None:
            return 0.0
        return min(max(1e-9 * (item.stamp_ns - last_ns), 0.0), _MAX_GAP_S)

    def _advance(self) -> bool:
        """Track and show the next frame; return False at the end."""
        if self.is_finished:
            return False
        try:
            self._take_configuration()
            is_tracked = self._tracking.advance()
            self._tracking.peek()  # is it the last one?
        finally:
            if self._tracking.is_finished:
                self._finish()
        return is_tracked

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
        if self.newest.n_done > self.newest.first_index:
            self.newest.finish(self._tracking.finish())
