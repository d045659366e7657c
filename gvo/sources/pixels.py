"""Encoded image files and depth counts, decoded the same way from folders and from bags."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.sources.image_headers import (
    check_density,
    check_size,
    is_jpeg_complete,
    is_png_complete,
    read_header,
)
from gvo.types import DepthArray, ImageArray

_TOO_DARK = 1 << 12
_COMPLETE = {"JPEG": is_jpeg_complete, "PNG": is_png_complete}
_MAX_FILE_BYTES = 1 << 30  # more than all pixels that are allowed need


@dataclass(frozen=True, slots=True, kw_only=True)
class GreyRange:
    """Which values of 16-bit images become black and white.

    Cameras of 10, 12 or 14 bits fill the lower bits of 16, thermal ones a part in the middle, and
    no encoding tells. The range is one for the whole recording: a gain chosen for each frame
    would change the brightness of what is tracked.

    Parameters
    ----------
    black : int
        This value and all below become 0.
    white : int
        This value and all above become 255.

    Examples
    --------
    >>> GreyRange(white=4095).narrow(np.array([0, 15, 16, 4095, 9000], np.uint16)).tolist()
    [0, 0, 1, 255, 255]
    """

    black: int = 0
    white: int = 65535

    def __post_init__(self) -> None:
        """Refuse what is no range."""
        if not 0 <= self.black < self.white <= 65535:
            raise ValueError(
                f"expected 0 <= black < white <= 65535, got black={self.black} white={self.white}"
            )

    def narrow(self, values: NDArray[np.uint16]) -> ImageArray:
        """Return values of 8 bits: for the full range the upper eight."""
        if self == FULL_RANGE:
            return (values >> 8).astype(np.uint8)
        above = np.clip(values, self.black, self.white).astype(np.uint32) - np.uint32(self.black)
        return (above * 256 // (self.white + 1 - self.black)).astype(np.uint8)


MILLIMETRES = 1000.0
"""Counts per metre of depth in millimetres: integer depth in messages is so by REP 118."""

# All positive finite numbers: neither zero nor infinity, and no comparison holds for NaN.
_KNOWN_DEPTH_M = (
    float(np.nextafter(np.float32(0), np.float32(1))),
    float(np.finfo(np.float32).max),
)

FULL_RANGE = GreyRange()


def read_image(path: Path, grey_range: GreyRange = FULL_RANGE) -> ImageArray:
    """Read an image file.

    Parameters
    ----------
    path : Path
        PNG, JPEG, TIFF, BMP or PNM.
    grey_range : GreyRange
        Of 16-bit images.

    Returns
    -------
    ndarray of uint8, shape (height, width) or (height, width, 3)
        Grey, or colour in BGR order.

    Raises
    ------
    RecordingError
        When the file is missing, empty, truncated or no image, or nearly black.
    """
    return to_8_bit(decode_image(_read_bytes(path), str(path)), str(path), grey_range)


def read_depth(path: Path, scale: float) -> DepthArray:
    """Read a depth image file.

    Parameters
    ----------
    path : Path
        16-bit grey image.
    scale : float
        Counts per metre.

    Returns
    -------
    ndarray of float32, shape (height, width)
        Metres, NaN = unknown.

    Raises
    ------
    RecordingError
        When the file is missing, empty, truncated or no 16-bit grey image.
    """
    return depth_from_counts(decode_image(_read_bytes(path), str(path)), scale, str(path))


def decode_image(data: NDArray[np.uint8], where: str) -> NDArray[Any]:
    """Decode an image file held in memory, unchanged in depth and channels.

    Parameters
    ----------
    data : ndarray of uint8, shape (n,)
        The whole file.
    where : str
        File or topic, for the message.

    Raises
    ------
    RecordingError
        When it is empty, truncated, of an absurd size or no image.
    """
    if len(data) == 0:
        raise RecordingError(f"{where}: the image is empty")
    header = read_header(data)
    if header is None:
        raise RecordingError(
            f"{where}: the image cannot be decoded: expected PNG, JPEG, TIFF, BMP or PNM, but it "
            f"begins with {data[:8].tobytes()!r}"
        )
    check_size(header.width, header.height, where)
    check_density(header, len(data), where)
    is_complete = _COMPLETE.get(header.format)
    if is_complete is not None and not is_complete(data):
        raise RecordingError(f"{where}: the {header.format} image is truncated")
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise RecordingError(f"{where}: the image cannot be decoded") from error
    if pixels is None or pixels.size == 0:
        raise RecordingError(f"{where}: the image cannot be decoded")
    return np.asarray(pixels)


def to_8_bit(pixels: NDArray[Any], where: str, grey_range: GreyRange = FULL_RANGE) -> ImageArray:
    """Return grey (h, w) or BGR (h, w, 3) pixels of 8 bits; alpha is dropped.

    Parameters
    ----------
    pixels : ndarray of uint8 or uint16, shape (h, w), (h, w, 3) or (h, w, 4)
        Colour in BGR order.
    where : str
        File or topic, for the message.
    grey_range : GreyRange
        Of 16-bit images.

    Raises
    ------
    RecordingError
        When the values are of another type, or those of 16 bits would become nearly black.
    """
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    if pixels.dtype not in (np.uint8, np.uint16) or channels not in (1, 3, 4):
        raise RecordingError(
            f"{where}: expected grey or colour of 8 or 16 bits, got {pixels.dtype} of shape "
            f"{pixels.shape}"
        )
    if pixels.dtype == np.uint16:
        _check_brightness(int(pixels.max(initial=0)), grey_range, where)
        pixels = grey_range.narrow(pixels)
    if pixels.ndim == 3 and channels == 1:
        pixels = pixels[:, :, 0]
    if channels == 4:
        pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGRA2BGR))
    return np.ascontiguousarray(pixels)


def _check_brightness(largest: int, grey_range: GreyRange, where: str) -> None:
    if grey_range == FULL_RANGE and largest < _TOO_DARK:
        n_bits = max(8, largest.bit_length())
        raise RecordingError(
            f"{where}: the 16-bit image is nearly black, its largest value is {largest} of 65535; "
            f"where the camera has {n_bits} bits, set images.white={(1 << n_bits) - 1}"
        )


def depth_from_counts(counts: NDArray[Any], scale: float, where: str) -> DepthArray:
    """Return metres (h, w), NaN = unknown, of depth counts.

    Parameters
    ----------
    counts : ndarray of uint16, shape (h, w)
        Depth; 0 and 65535 mean unknown.
    scale : float
        Counts per metre.
    where : str
        File or topic, for the message.

    Raises
    ------
    RecordingError
        When the counts are no 16-bit grey image.
    """
    if counts.dtype != np.uint16 or counts.ndim != 2:
        raise RecordingError(
            f"{where}: expected depth as 16-bit grey, got {counts.dtype} of shape {counts.shape}"
        )
    depth: DepthArray = counts.astype(np.float32)
    depth /= np.float32(scale)
    # One look at each pixel for both: with one added, 65535 becomes 0 and 0 becomes 1.
    np.copyto(depth, np.nan, where=counts + np.uint16(1) <= 1)
    return depth


def depth_from_metres(metres: NDArray[Any]) -> DepthArray:
    """Return depth where all that is unknown is NaN.

    Parameters
    ----------
    metres : ndarray of float, shape (h, w)
        Zero, negative or not finite: unknown.

    Returns
    -------
    ndarray of float32, shape (h, w)
        Metres, NaN = unknown; the same array where nothing has to be marked.
    """
    metres = np.asarray(metres, dtype=np.float32)
    # Both leave NaN out. Most drivers mark all that is unknown so: a look is a tenth of a copy.
    lowest, highest = np.fmin.reduce(metres, axis=None), np.fmax.reduce(metres, axis=None)
    if lowest > 0 and highest < np.inf:
        return metres
    depth: DepthArray = np.full(metres.shape, np.nan, dtype=np.float32)
    # OpenCV compares and copies in a third of NumPy's time.
    cv2.copyTo(metres, cv2.inRange(metres, *_KNOWN_DEPTH_M), depth)
    return depth


def _read_bytes(path: Path) -> NDArray[np.uint8]:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise RecordingError(f"{path}: is no file")  # a device may never end
        if status.st_size > _MAX_FILE_BYTES:
            raise RecordingError(f"{path}: no image has {status.st_size} bytes, it is damaged")
        return np.fromfile(path, dtype=np.uint8)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: the file is missing") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:  # a zero in a name
        raise RecordingError(f"{str(path)!r}: is no name of a file") from error
