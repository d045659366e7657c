"""What all data-set folders have: two lists of image files, and text tables."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from numpy.typing import NDArray

from gvo._text import cut, text_lines
from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.calibration.files import CameraSet
from gvo.io.images import read_image
from gvo.io.recording import RecordingInfo, Sensor, StampedImage, shown
from gvo.trajectory.trajectory import parse_stamp

StampedPath = tuple[int, str]
"""Stamp in nanoseconds, and a file, as text: it takes a third of a Path's memory."""

Load: TypeAlias = Callable[[Path], NDArray[Any]]
"""Reads an image file."""

_MAX_ROWS = 1_000_000  # of images, nine hours at 30 Hz
_MAX_REASON = 300  # characters


class FolderSource:
    """A recording of two lists of image files.

    Parameters
    ----------
    folder : Path
        It names the recording.
    cameras : CameraSet
        Of both streams, or of the colour images.
    streams : mapping of str to sequence of (int, str)
        Two names, and the stamps in nanoseconds and files of each; first the left or colour
        images.
    decisions : sequence of str
        What was chosen beside the streams, a line each.
    config : Config, optional
        Of images with 16 bits.
    load_second : callable, optional
        Reads a file of the second stream; as a colour or grey image when left out.
    """

    def __init__(
        self,
        folder: Path,
        cameras: CameraSet,
        streams: Mapping[str, Sequence[StampedPath]],
        decisions: Sequence[str],
        config: Config | None,
        *,
        load_second: Load | None = None,
    ) -> None:
        self._first, self._second = streams.values()
        sensor: Sensor = "stereo" if len(cameras.calibrations) == 2 else "rgbd"
        n_images = f"({len(self._first)} + {len(self._second)} images)"
        self.info = RecordingInfo(
            name=folder.resolve().name,
            sensor=sensor,
            calibrations=cameras.calibrations,
            n_images=len(self._first),
            decisions=[f"{sensor}: {' + '.join(streams)} {n_images}", *decisions],
            T_body_cam=cameras.T_body_cam,
        )
        self._load = loader(config)
        self._load_second = load_second or self._load

    __repr__ = shown

    def images(self) -> Iterator[StampedImage]:
        """Yield the images of both streams in the order of their stamps, not decoded yet."""
        yield from heapq.merge(
            _stream(0, self._first, self._load),
            _stream(1, self._second, self._load_second),
            key=lambda image: image.stamp_ns,
        )


def loader(config: Config | None) -> Load:
    """Return what loads a grey or colour image, its 16 bits reduced as configured."""
    return partial(read_image, grey_range=(config or Config()).images)


def image_size(rows: Sequence[StampedPath], config: Config | None) -> tuple[int, int]:
    """Return width and height of the first image that can be read."""
    first_fault = ""
    for _, path in rows:
        try:
            height, width = loader(config)(Path(path)).shape[:2]
        except RecordingError as error:
            first_fault = first_fault or str(error)
            continue  # it becomes a faulty frame later
        return width, height
    folder = Path(rows[0][1]).parent
    raise RecordingError(
        f"{folder}: none of its {len(rows)} images can be read; the first: {first_fault}"
    )


def _stream(stream: int, rows: Sequence[StampedPath], load: Load) -> Iterator[StampedImage]:
    for stamp_ns, path in rows:
        yield StampedImage(stream=stream, stamp_ns=stamp_ns, load=partial(load, Path(path)))


def read_stamped_rows(
    path: Path, *, unit_ns: int, n_fields: int = 2, separator: str | None = None
) -> list[tuple[int, str]]:
    """Read a table of stamps, in units of `unit_ns`, each perhaps with a name behind it.

    Stamps become nanoseconds without loss; a missing name is empty.
    """
    rows: list[tuple[int, str]] = []
    for number, line in text_lines(path, RecordingError, max_lines=_MAX_ROWS):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        stamp, *fields = (field.strip() for field in text.split(separator))
        if len(fields) < n_fields - 1:
            raise RecordingError(
                f"{path}, line {number}: expected {n_fields} fields, got {len(fields) + 1}"
            )
        try:
            rows.append((parse_stamp(stamp, unit_ns=unit_ns), fields[0] if fields else ""))
        except ValueError as error:
            reason = cut(str(error), _MAX_REASON)
            raise RecordingError(f"{path}, line {number}: {reason}") from None
    if not rows:
        raise RecordingError(f"{path}: holds no rows")
    return rows
