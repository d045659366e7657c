"""Pictures as a film or as numbered PNG files."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from gvo.errors import ConfigurationError, RecordingError, write_faults
from gvo.io.images import encode_image
from gvo.io.run_folder.line_file import PartFile
from gvo.types import ImageArray

CODECS: Final = {".webm": "VP80", ".mp4": "mp4v"}
"""By suffix: VP8 plays in browsers, MPEG-4 Part 2 in players."""

_N_PERIODS = 8  # that tell the rate
_FALLBACK_HZ = 10.0
_SLOWEST_HZ, _FASTEST_HZ = 0.1, 240.0


def open_sink(path: Path) -> Film | PngFolder:
    """Open a film or a folder of pictures, by the name of the path.

    Parameters
    ----------
    path : Path
        Ends in `.webm` or `.mp4`: a film. Without a suffix, or an existing folder: a folder of PNG
        files.

    Raises
    ------
    ConfigurationError
        When the path ends otherwise, or there is no encoder.
    RecordingError
        When it exists or cannot be written.
    """
    suffix = path.suffix.lower()
    if not suffix or (path.is_dir() and suffix not in CODECS):
        return PngFolder(path)
    if suffix not in CODECS:
        raise ConfigurationError(
            f"{path}: expected a name ending in .webm (browsers) or .mp4 (players), or of a folder "
            f"for PNG files, got {path.name}"
        )
    with tempfile.TemporaryDirectory(prefix="gvo-film-") as folder:
        if _open_writer(Path(folder) / f"film{suffix}", _FALLBACK_HZ, (64, 64)) is None:
            raise ConfigurationError(
                f"{path}: OpenCV has no encoder for {suffix} here; give the name of a folder for "
                "PNG files"
            )
    return Film(path)


class Film:
    """A film of pictures of one, even size, under another name until it is closed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting: list[ImageArray] = []
        self._stamps_ns: list[int] = []
        self._writer: cv2.VideoWriter | None = None
        self._n = 0
        self._file = PartFile(path)

    def add(self, picture: ImageArray, stamp_ns: int) -> None:
        """Encode one more picture, BGR, taken at a stamp."""
        self._n += 1
        if self._writer is not None:
            self._writer.write(picture)
            return
        self._waiting.append(picture)
        self._stamps_ns.append(stamp_ns)
        if len(self._waiting) > _N_PERIODS:
            self._begin()

    def close(self) -> None:
        """Finish the film and give it its name; without pictures no file is left."""
        with self._file.completed(is_kept=self._n > 0):
            if self._waiting:
                self._begin()
            if self._writer is None:
                return
            self._writer.release()
            n_written = count_pictures(self._file.part)
            if n_written != self._n:
                raise RecordingError(
                    f"{self.path}: was not written whole: {n_written} of {self._n} frames; is its "
                    "disk full?"
                )

    def _begin(self) -> None:
        height, width = self._waiting[0].shape[:2]
        self._writer = _open_writer(self._file.part, rate_of(self._stamps_ns), (width, height))
        if self._writer is None:
            raise RecordingError(f"{self.path}: OpenCV could not open it as a film")
        for picture in self._waiting:
            self._writer.write(picture)
        self._waiting.clear()


def count_pictures(path: Path) -> int:
    """Return the number of encoded pictures in a film."""
    with _quiet_opencv():
        packets = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    n = 0
    while packets.grab():
        n += 1
    return n


class PngFolder:
    """A folder of numbered PNG files, each written as it comes."""

    def __init__(self, path: Path) -> None:
        self.path, self._n = path, 0
        with write_faults(RecordingError, path):
            path.mkdir(parents=True, exist_ok=True)
            is_empty = next(path.iterdir(), None) is None
        if not is_empty:
            raise RecordingError(f"{path}: is not empty; give another folder or empty it")

    def add(self, picture: ImageArray, stamp_ns: int) -> None:
        """Write one more picture, shape (height, width, 3), BGR."""
        with write_faults(RecordingError, self.path):
            (self.path / f"{self._n:06d}.png").write_bytes(encode_image(picture, ".png"))
        self._n += 1

    def close(self) -> None:
        """Remove the folder where it is empty."""
        if self._n == 0:
            with write_faults(RecordingError, self.path):
                self.path.rmdir()


def rate_of(stamps_ns: Sequence[int]) -> float:
    """Return frames per second by the median period of stamps, within what films hold."""
    periods_ns = np.diff(stamps_ns)
    periods_ns = periods_ns[periods_ns > 0]
    if len(periods_ns) == 0:
        return _FALLBACK_HZ
    return float(np.clip(1e9 / np.median(periods_ns), _SLOWEST_HZ, _FASTEST_HZ))


def _open_writer(path: Path, rate_hz: float, size: tuple[int, int]) -> cv2.VideoWriter | None:
    fourcc = cv2.VideoWriter.fourcc(*CODECS[path.suffix.lower()])
    with _quiet_opencv(), _quiet_error_stream():
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, rate_hz, size)
    return writer if writer.isOpened() else None


@contextmanager
def _quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from logging errors that are returned as values."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextmanager
def _quiet_error_stream() -> Iterator[None]:
    """Drop what C code prints: OpenCV complains, past its log, of VP8 in WebM, and writes it."""
    sys.stderr.flush()
    kept, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)
