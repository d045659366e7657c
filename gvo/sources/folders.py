"""What the folder sources share: two streams of image files, and their size."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.sources.pixels import FULL_RANGE, GreyRange, read_image
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
    grey_range : GreyRange
        Of images with 16 bits.
    """

    def __init__(
        self,
        info: RecordingInfo,
        first: Sequence[StampedPath],
        second: Sequence[StampedPath],
        *,
        load_second: Callable[[Path], NDArray[Any]] | None = None,
        grey_range: GreyRange = FULL_RANGE,
    ) -> None:
        self._info = info
        self._first = first
        self._second = second
        self._load = partial(read_image, grey_range=grey_range)
        self._load_second = load_second or self._load

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first image."""
        return self._info

    def images(self) -> Iterator[StampedImage]:
        """Yield the images of both streams in the order of their stamps, not decoded yet."""
        yield from heapq.merge(
            _stream(0, self._first, self._load),
            _stream(1, self._second, self._load_second),
            key=lambda image: image.stamp_ns,
        )


def first_image_size(
    paths: Sequence[Path], folder: Path, grey_range: GreyRange = FULL_RANGE
) -> tuple[int, int]:
    """Return width and height of the first image that can be read.

    Parameters
    ----------
    paths : sequence of Path
        Image files.
    folder : Path
        Where they lie, for the message.
    grey_range : GreyRange
        Of images with 16 bits.

    Returns
    -------
    tuple of two int
        Pixels.

    Raises
    ------
    RecordingError
        When there is none.
    """
    first_fault = ""
    for path in paths:
        try:
            height, width = read_image(path, grey_range).shape[:2]
        except RecordingError as error:
            first_fault = first_fault or str(error)
            continue  # it becomes a faulty frame later
        return width, height
    raise RecordingError(
        f"{folder}: none of its {len(paths)} images can be read; the first: {first_fault}"
    )


def _stream(
    stream: int, rows: Sequence[StampedPath], load: Callable[[Path], NDArray[Any]]
) -> Iterator[StampedImage]:
    for stamp_ns, path in rows:
        yield StampedImage(stream=stream, stamp_ns=stamp_ns, load=partial(load, path))
