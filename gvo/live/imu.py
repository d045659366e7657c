"""The IMU of a running camera: its samples wait for frames, and these a little for samples."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from functools import partial
from typing import Final

from gvo.geometry.imu import ImuSamples
from gvo.io.bag.imu import BagImu, SampleDecoder, StampOf
from gvo.io.bag.reader import BagMessage

_LOGGER = logging.getLogger(__name__)
N_WAITING: Final = 5_000
"""Messages of an IMU that may wait."""
# How long a frame waits for samples.
_PATIENCE_S = 0.02
# Where none came for so long, frames do not wait.
_SILENT_S = 1.0


class ImuQueue:
    """Messages of an IMU as they arrive, handed out as samples in step with the frames.

    Parameters
    ----------
    imu : BagImu
    stamp_of : callable
        Returns the stamp of a message.
    """

    def __init__(self, imu: BagImu, stamp_of: StampOf) -> None:
        self.names, self._name = imu.names, imu.gyro.name
        self._make_decoder = partial(SampleDecoder, imu, stamp_of, 0)
        self._decoder = self._make_decoder()
        self._waiting: deque[BagMessage] = deque(maxlen=N_WAITING)
        self._come = threading.Condition()
        self._last_ns = 0
        self._came_s: float | None = None
        self._is_silent = False

    def put(self, message: BagMessage) -> None:
        """Add a message; where too many wait, the oldest is dropped. Any thread may call it."""
        with self._come:
            self._waiting.append(message)
            self._come.notify()

    def restart(self) -> None:
        """Forget what came before a new run: the stamps may have gone back."""
        self._take(0.0)
        self._decoder, self._last_ns = self._make_decoder(), 0

    def until(self, stamp_ns: int) -> Iterator[ImuSamples]:
        """Yield the samples that came, after waiting shortly for those up to a stamp.

        Parameters
        ----------
        stamp_ns : int
            By the clock of the IMU, nanoseconds.
        """
        now_s = time.monotonic()
        came_s = self._came_s or now_s
        while messages := self._take(now_s + _PATIENCE_S if self._is_due(stamp_ns) else now_s):
            samples = self._decoder.take(messages)
            if len(samples) > 0:
                self._last_ns, came_s = int(samples.stamps_ns[-2:].min()), time.monotonic()
                self._note(is_silent=False)
                yield samples
        self._came_s = came_s
        if time.monotonic() - came_s > _SILENT_S:
            self._note(is_silent=True)

    def _is_due(self, stamp_ns: int) -> bool:
        """Tell whether a frame should wait."""
        return self._last_ns < stamp_ns and not self._is_silent

    def _take(self, end_s: float) -> list[BagMessage]:
        """Return the messages that wait; where none does, wait for one until some time."""
        with self._come:
            self._come.wait_for(lambda: bool(self._waiting), end_s - time.monotonic())
            taken = [*self._waiting]
            self._waiting.clear()
        return taken

    def _note(self, *, is_silent: bool) -> None:
        """Say where samples stop coming, and where they come again."""
        if is_silent != self._is_silent:
            self._is_silent = is_silent
            stopped = f"no samples for {_SILENT_S:g} s: frames do not wait for them any more"
            _LOGGER.warning("%s: %s", self._name, stopped if is_silent else "samples come again")
