"""What the folder sources share: two streams of image files, and their size."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.sources.pixels import read_image
from gvo.sources.recording import RecordingInfo, StampedImage

StampedPath = tuple[int, Path]


class FolderSource:
    """Two lists of image files: what every recording in a folder is.

    Parameters
    ----------
    info : RecordingInfo
        What is known before the first image.
    first, second : sequence of (int, Path)
        Stamps in nanoseconds and files; first are colour or grey images.
    load_second : callable, optional
        Reads a file of the second stream; as a colour or grey image when left out.
    """

    def __init__(
        self,
        info: RecordingInfo,
        first: Sequence[StampedPath],
        second: Sequence[StampedPath],
        load_second: Callable[[Path], NDArray[Any]] = read_image,
    ) -> None:
        self._info = info
        self._first = first
        self._second = second
        self._load_second = load_second

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first image."""
        return self._info

    def images(self) -> Iterator[StampedImage]:
        """Yield the images of both streams in the order of their stamps, not decoded yet."""
        yield from heapq.merge(
            _stream(0, self._first, read_image),
            _stream(1, self._second, self._load_second),
            key=lambda image: image.stamp_ns,
        )


def first_image_size(paths: Sequence[Path], folder: Path) -> tuple[int, int]:
    """Return width and height of the first image that can be read.

    Parameters
    ----------
    paths : sequence of Path
        Image files.
    folder : Path
        Where they lie, for the message.

    Returns
    -------
    tuple of two int
        Pixels.

    Raises
    ------
    RecordingError
        When there is none.
    """
    for path in paths:
        try:
            height, width = read_image(path).shape[:2]
        except RecordingError:
            continue  # it becomes a faulty frame later
        return width, height
    raise RecordingError(f"{folder}: none of its {len(paths)} images can be read")


def _stream(
    stream: int, rows: Sequence[StampedPath], load: Callable[[Path], NDArray[Any]]
) -> Iterator[StampedImage]:
    for stamp_ns, path in rows:
        yield StampedImage(stream=stream, stamp_ns=stamp_ns, load=partial(load, path))
