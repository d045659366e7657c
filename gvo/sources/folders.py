"""What the folder sources share: streams of image files, and their size."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.sources.pixels import read_image
from gvo.sources.recording import StampedImage

StampedPath = tuple[int, Path]


def merge_streams(
    first: Sequence[StampedPath],
    second: Sequence[StampedPath],
    load_second: Callable[[Path], NDArray[Any]] = read_image,
) -> Iterator[StampedImage]:
    """Yield the images of both streams in the order of their stamps, not decoded yet.

    Parameters
    ----------
    first, second : sequence of (int, Path)
        Stamps in nanoseconds and files; first are colour or grey images.
    load_second : callable
        Reads a file of the second stream.
    """
    yield from heapq.merge(
        _stream(0, first, read_image),
        _stream(1, second, load_second),
        key=lambda image: image.stamp_ns,
    )


def first_image_size(paths: Sequence[Path], folder: Path) -> tuple[int, int]:
    """Return width and height of the first image that can be read.

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
