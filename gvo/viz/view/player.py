"""Plays odometry over a recording, as it is computed."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

from gvo.config import Config
from gvo.errors import GvoError
from gvo.io.frames import one_opencv_thread
from gvo.io.recording import Source
from gvo.viz.view.newest import Newest
from gvo.viz.view.tracking import OpenSource, Tracking

_LOGGER = logging.getLogger(__name__)


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
        self.fault = ""
        self._began_s = -math.inf  # when the last frame was begun, by the clock of `monotonic`
        self._thread = threading.Thread(target=self._work, name="player", daemon=True)
        self._thread.start()

    def rest_s(self, spent_s: float) -> float:
        """Return 0: the page may draw all the time."""
        return 0.0

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
            self._began_s = -math.inf

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
    def source(self) -> Source:
        """The recording."""
        return self._tracking.source

    @property
    def is_finished(self) -> bool:
        """Whether the recording is read to its end, or as far as it can be."""
        return self._tracking.is_finished

    @property
    def n_frames(self) -> int:
        """Frames that the recording announces; those that were read, once it is finished."""
        n_done = self.newest.n_done
        return n_done if self.is_finished else max(self.source.info.n_images, n_done)

    @property
    def is_busy(self) -> bool:
        """Whether something is under way or left to do."""
        is_asked = self.is_playing or self._n_steps > 0 or self._restart_index is not None
        return self._is_working or (is_asked and not self._is_closed)

    # On the thread

    def _work(self) -> None:
        with one_opencv_thread():
            while self._wait_for_work():
                try:
                    self._turn()
                except GvoError as error:
                    self._stop(str(error))
                except Exception as error:  # the thread must go on
                    _LOGGER.exception("the player failed")
                    self._stop(f"{type(error).__name__}: {error}")
        self._tracking.close()

    def _wait_for_work(self) -> bool:
        """Wait for a command, or until the next frame is due; return False once closed."""
        with self._changed:
            self._is_working = False
            self._changed.notify_all()
            while not (self._is_closed or self._n_steps or self._restart_index is not None):
                if not self.is_playing:
                    self._changed.wait()
                    continue
                gap_s = 0.0 if self._speed is None else self._tracking.gap_s / self._speed
                pause_s = self._began_s + gap_s - time.monotonic()
                if pause_s <= 0.0:
                    break
                self._changed.wait(pause_s)
            self._is_working = not self._is_closed
            return self._is_working

    def _turn(self) -> None:
        """Track the next frame, or the first one after a restart."""
        with self._changed:
            index, self._restart_index = self._restart_index, None
            if index is None:
                self._n_steps = max(self._n_steps - 1, 0)
            self._began_s = time.monotonic()
        if index is not None:
            tracking = Tracking(self._open_source, self.config, index)
            self._tracking.close()
            self._tracking, self.fault = tracking, ""
        elif self.config is not self._tracking.config:
            self._take_configuration(self.config)
        self._tracking.advance()
        if self.is_finished:
            with self._changed:
                self.is_playing, self._n_steps = False, 0

    def _take_configuration(self, config: Config) -> None:
        try:
            self._tracking.reconfigure(config)
        except GvoError as error:
            with self._changed:
                self.fault = str(error)
                if self.config is config:
                    self.config = self._tracking.config

    def _stop(self, fault: str) -> None:
        with self._changed:
            self.fault = fault
            self.is_playing, self._n_steps, self._restart_index = False, 0, None
