"""A run over images as they come: a queue of pairs between receiving and tracking."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from gvo.config import Config
from gvo.errors import GvoError
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.io.recording import Source
from gvo.io.sync import Pair
from gvo.odometry.odometry import Odometry
from gvo.runs.outputs.options import RunOutputs
from gvo.runs.run import RunResult, run_recording
from gvo.types import FaultyFrame, Progress, RgbdFrame, StereoFrame

_Item: TypeAlias = Pair | FaultyFrame
# Frames that are tied to one another before any is dropped, and what waits for them at most.
_N_TIED = 2
_MAX_BEFORE_TIED = 300
_N_WARMING = 3


class LiveOdometry:
    """Odometry over images as they come, with the outputs of a run.

    Pairs are made in a thread that receives, and wait; decoding and odometry take them one by one
    and look at none ahead. Where nothing is dropped the poses are those of `run_recording`, bit
    for bit.

    Parameters
    ----------
    source : Source
        Whose `images` come as they are taken, such as `StandardInput` or `Device`.
    config : Config, optional
    max_waiting : int
        Pairs that wait at most; the oldest is dropped for one more.
    max_lag_s : float, optional
        Pairs that are older than the newest by more are dropped.
    """

    def __init__(
        self,
        source: Source,
        config: Config | None = None,
        *,
        max_waiting: int = 10,
        max_lag_s: float | None = None,
    ) -> None:
        self._source, self._config = source, config or Config()
        self._waiting = WaitingPairs(max_waiting=max_waiting, max_lag_s=max_lag_s)

    @property
    def n_dropped(self) -> int:
        """Frames that were dropped so far."""
        return self._waiting.n_dropped

    def run(
        self,
        out: str | Path,
        *,
        outputs: RunOutputs | None = None,
        force: bool = False,
        on_progress: Callable[[Progress], None] = lambda _: None,
    ) -> RunResult:
        """Track until the images end, or `stop` is called; then write what a run writes.

        Parameters are those of `run_recording`, and so are the errors.
        """
        _warm(self._source.info.camera, self._config)

        def progress(state: Progress) -> None:
            self._waiting.note(state)
            on_progress(state)

        return run_recording(
            self._source,
            out,
            config=self._config,
            outputs=outputs,
            force=force,
            through=self._waiting.through,
            on_progress=progress,
        )

    def stop(self) -> None:
        """Take no more images; what waits is tracked. May be called by another thread."""
        self._waiting.close()


def _warm(camera: StereoCamera | PinholeCamera, config: Config) -> None:
    """Track noise, so that what is loaded and allocated once does not delay the first frames."""
    odometry, rng = Odometry(camera, config), np.random.default_rng(0)
    for stamp_ns in range(_N_WARMING):
        shape = 2, camera.height, camera.width
        first, second = rng.integers(0, 256, shape, dtype=np.uint8)
        odometry.track(
            StereoFrame(stamp_ns=stamp_ns, left=first, right=second)
            if isinstance(camera, StereoCamera)
            else RgbdFrame(stamp_ns=stamp_ns, image=first, depth=1.0 + second.astype(np.float32))
        )


class WaitingPairs:
    """Pairs of images in the order they came; where tracking falls behind, the oldest are dropped.

    A pair that is dropped leaves a faulty frame with the reason, so that nothing is lost without
    a word. Nothing is dropped before two frames are tied: the motion until then is measured by
    nobody else.

    Parameters
    ----------
    max_waiting : int
        Pairs that wait; the oldest is dropped for one more.
    max_lag_s : float or None
        A pair that is so much older than the newest one is dropped; None: as old as may be.

    Attributes
    ----------
    n_dropped : int
    """

    def __init__(self, *, max_waiting: int = 10, max_lag_s: float | None = None) -> None:
        if max_waiting < 1 or (max_lag_s is not None and max_lag_s <= 0.0):
            raise ValueError(
                f"expected max_waiting >= 1 and max_lag_s > 0, got {max_waiting} and {max_lag_s}"
            )
        self._max_waiting, self._max_lag_s = max_waiting, max_lag_s
        self._items: deque[_Item] = deque()
        self._n_pairs = 0
        self._newest_ns: int | None = None
        self._is_tied = self._is_closed = False
        self._fault: GvoError | None = None
        self._changed = threading.Condition()
        self.n_dropped = 0

    def put(self, item: _Item) -> None:
        """Add a pair, or a frame without one; called by the thread that receives."""
        with self._changed:
            self._items.append(item)
            if not isinstance(item, FaultyFrame):
                self._n_pairs += 1
                self._newest_ns = item[0].stamp_ns
                limit = self._max_waiting if self._is_tied else _MAX_BEFORE_TIED
                if self._n_pairs > limit:
                    self._drop_oldest(limit)
            self._changed.notify()

    def close(self, fault: GvoError | None = None) -> None:
        """Take nothing more: what waits is given out, then the fault, if any."""
        with self._changed:
            self._is_closed = True
            self._fault = self._fault or fault
            self._changed.notify()

    def note(self, progress: Progress) -> None:
        """Note how many frames are tracked."""
        self._is_tied = progress.n_tracked >= _N_TIED

    def take(self) -> _Item | None:
        """Return the oldest one, waiting for it; None after the end.

        Raises
        ------
        GvoError
            That ended the stream.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._is_closed)
            if not self._items:
                if self._fault is not None:
                    raise self._fault
                return None
            item = self._items.popleft()
            if isinstance(item, FaultyFrame):
                return item
            self._n_pairs -= 1
            lag_s = 1e-9 * ((self._newest_ns or 0) - item[0].stamp_ns)
            if self._is_tied and self._max_lag_s is not None and lag_s > self._max_lag_s:
                return self._dropped(item, f"{lag_s:.2f} s behind the newest (--max-lag)")
            return item

    def through(self, items: Iterable[_Item]) -> Iterator[_Item]:
        """Receive items in a thread of their own, and yield what is taken here."""
        receiver = threading.Thread(target=self._receive, args=(items,), daemon=True)
        receiver.start()
        while (item := self.take()) is not None:
            yield item

    def _receive(self, items: Iterable[_Item]) -> None:
        try:
            for item in items:
                if self._is_closed:
                    return
                self.put(item)
            self.close()
        except GvoError as error:
            self.close(error)

    def _drop_oldest(self, limit: int) -> None:
        """Replace the oldest pair by a faulty frame; those before it are faulty already."""
        for index, item in enumerate(self._items):
            if not isinstance(item, FaultyFrame):
                self._items[index] = self._dropped(item, f"{limit} pairs wait (--queue)")
                self._n_pairs -= 1
                return

    def _dropped(self, pair: Pair, reason: str) -> FaultyFrame:
        self.n_dropped += 1
        return FaultyFrame(
            stamp_ns=pair[0].stamp_ns, reason=f"dropped, tracking is behind: {reason}"
        )
