"""A run as a film: matches, depth, status and rate of each frame."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeAlias

from gvo.geometry.camera import PinholeCamera
from gvo.runs.outputs.file import FileOutput
from gvo.types import FaultyFrame, Frame, FrameResult, Loop
from gvo.viz.overlay import MIN_WIDTH_PX, Layout, compose_faulty, compose_overlay
from gvo.viz.video import open_sink

_MAX_WIDTH_PX: Final = 960
_MAX_PIXELS: Final = 300_000  # of which each costs, at every frame

_SHOWN_NS: Final = 1_000_000_000  # how long a loop is

_N_WAITING = 4  # frames; each holds its images
_Item: TypeAlias = tuple[Frame, FrameResult] | FaultyFrame


class RunOverlay(FileOutput):
    """A film of a run, see `FileOutput`: one picture per frame, also of faulty ones.

    It plays as fast as it was recorded, by the median of the first eight periods. A thread draws
    and encodes; the run waits for it only where it is four frames behind.

    Parameters
    ----------
    path : Path
        `.webm`: VP8, for browsers; `.mp4`: MPEG-4, for players; without a suffix: a folder of
        PNG files.
    camera : StereoCamera or PinholeCamera
        Of the recording.

    Raises
    ------
    ConfigurationError
        When the path ends otherwise, or there is no encoder.
    RecordingError
        When the path exists or cannot be written; so do all methods.
    """

    def __init__(self, path: str | Path, camera: PinholeCamera) -> None:
        self._camera = camera
        self._max_width = film_width(camera)
        self._sink = open_sink(Path(path))
        self._n = 0
        self._loops: tuple[Loop, ...] = ()
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="overlay")
        self._waiting: deque[Future[None]] = deque()

    def add_frame(self, frame: Frame, result: FrameResult) -> None:
        """Take a frame and its result."""
        self._put((frame, result))

    def add_faulty(self, frame: FaultyFrame) -> None:
        """Take a frame without a pose; its picture says why."""
        self._put(frame)

    def _complete(self) -> None:
        """Write what waits and finish the film."""
        try:
            while self._waiting:
                self._waiting.popleft().result()
        finally:
            self._worker.shutdown(cancel_futures=True)
            self._sink.close()

    def _put(self, item: _Item) -> None:
        if len(self._waiting) == _N_WAITING:
            self._waiting.popleft().result()
        self._waiting.append(self._worker.submit(self._write, item, self._n))
        self._n += 1

    def _write(self, item: _Item, index: int) -> None:
        width = self._max_width
        if isinstance(item, FaultyFrame):
            picture = compose_faulty(item, self._camera, index=index, max_width=width)
            self._sink.add(picture, item.stamp_ns)
            return
        frame, result = item
        self._loops = result.loops or self._loops
        if self._loops and result.stamp_ns - self._loops[-1].stamp_ns <= _SHOWN_NS:
            result = replace(result, loops=self._loops)
        picture = compose_overlay(frame, result, self._camera, index=index, max_width=width)
        self._sink.add(picture, frame.stamp_ns)


def film_width(camera: PinholeCamera) -> int:
    """Return the most pixels in a row of a film that is encoded quickly."""
    for width in range(_MAX_WIDTH_PX, MIN_WIDTH_PX, -16):
        columns, rows = Layout.of(camera, width).size
        if columns * rows <= _MAX_PIXELS:
            return width
    return MIN_WIDTH_PX
