"""Image folders and text tables."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from gvo._text import cut, read_text
from gvo.errors import RecordingError
from gvo.io.images import FULL_RANGE, GreyRange, read_image
from gvo.io.recording import RecordingInfo, StampedImage
from gvo.trajectory.trajectory import parse_stamp

StampedPath = tuple[int, Path]
_MAX_REASON = 300  # characters
_Row = tuple[int, list[str]]


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


def read_rows(path: Path, *, n_fields: int, separator: str | None = None) -> list[_Row]:
    """Read the rows of a table, without comments and empty lines.

    Parameters
    ----------
    path : Path
        Text file.
    n_fields : int
        Fields a row must hold at least.
    separator : str, optional
        Between the fields; white space when None.

    Returns
    -------
    list of (int, list of str)
        Line number, counted from one, and fields.

    Raises
    ------
    RecordingError
        When the file cannot be read, holds no row, or a row is too short.
    """
    rows = []
    for number, line in enumerate(_read_lines(path), start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        fields = [field.strip() for field in text.split(separator)]
        if len(fields) < n_fields:
            raise RecordingError(
                f"{path}, line {number}: expected {n_fields} fields, got {len(fields)}"
            )
        rows.append((number, fields))
    if not rows:
        raise RecordingError(f"{path}: holds no rows")
    return rows


def read_stamp(text: str, where: str, *, unit_ns: int) -> int:
    """Return the nanoseconds that a field of a table says, without loss.

    Parameters
    ----------
    text : str
        A decimal number.
    where : str
        File and line, for the message.
    unit_ns : int
        Nanoseconds of its unit: 1_000_000_000 for seconds, 1 for nanoseconds.

    Raises
    ------
    RecordingError
        When the text is no number, or out of range.
    """
    try:
        return parse_stamp(text, unit_ns=unit_ns)
    except ValueError as error:
        raise RecordingError(f"{where}: {cut(str(error), _MAX_REASON)}") from None


def _read_lines(path: Path) -> list[str]:
    try:
        return read_text(path, encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: the file is missing") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: is no text file") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
