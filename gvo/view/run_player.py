"""Plays a finished run: only the frame that is shown moves."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from gvo.types import IntArray


class RunPlayer:
    """Goes through frames by their stamps.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Of the frames, nanoseconds.
    show : callable
        Is told the index of each frame that is to be shown.
    period_s : float
        How often it looks whether the next frame is due.
    """

    def __init__(
        self, stamps_ns: IntArray, show: Callable[[int], None], *, period_s: float = 0.02
    ) -> None:
        self._stamps_ns = stamps_ns
        self._period_s = period_s
        self._show = show
        self._lock = threading.RLock()
        self._index = 0
        self._is_playing = False
        self._speed: float | None = 1.0
        self._ahead_ns = 0.0
        self._is_closing = threading.Event()
        self._is_due = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gvo run player", daemon=True)
        self._thread.start()

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self._stamps_ns)

    @property
    def index(self) -> int:
        """Frame that is shown."""
        return self._index

    @property
    def is_playing(self) -> bool:
        """Whether frames follow by themselves."""
        return self._is_playing

    def play(self) -> None:
        """Go on; from the end, begin again."""
        with self._lock:
            if self._index >= self.n_frames - 1:
                self.seek(0)
            self._ahead_ns = 0.0
            self._is_playing = True
        self._is_due.set()

    def pause(self) -> None:
        """Stay."""
        self._is_playing = False

    def step(self) -> None:
        """Go to the next frame and stay."""
        self.pause()
        self.seek(self._index + 1)

    def seek(self, index: int) -> None:
        """Go to a frame, or the nearest there is."""
        with self._lock:
            self._index = int(np.clip(index, 0, max(0, self.n_frames - 1)))
            self._ahead_ns = 0.0
            self._show(self._index)

    def set_speed(self, factor: float | None) -> None:
        """Play as recorded (1), faster, slower, or frame by frame without waiting (None)."""
        self._speed = factor

    def advance(self, elapsed_s: float) -> None:
        """Let time pass while it plays."""
        with self._lock:
            if not self._is_playing:
                return
            if self._speed is None:
                self.seek(self._index + 1)
            else:
                self._advance_by(1e9 * elapsed_s * self._speed)
            if self._index >= self.n_frames - 1:
                self._is_playing = False

    def _advance_by(self, span_ns: float) -> None:
        ahead_ns = self._ahead_ns + span_ns
        now_ns = int(self._stamps_ns[self._index]) + int(ahead_ns)
        index = int(np.searchsorted(self._stamps_ns, now_ns, side="right")) - 1
        if index > self._index:
            self.seek(index)
            ahead_ns = float(now_ns - int(self._stamps_ns[index]))
        self._ahead_ns = ahead_ns

    def close(self) -> None:
        """End the thread."""
        self._is_closing.set()
        self._is_due.set()
        self._thread.join()

    def _run(self) -> None:
        before = time.monotonic()
        while not self._is_closing.is_set():
            if not self._is_playing:
                self._is_due.wait()
                self._is_due.clear()
                before = time.monotonic()
            elif not self._is_closing.wait(self._period_s):
                now = time.monotonic()
                self.advance(now - before)
                before = now
