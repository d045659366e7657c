"""Image files and depth counts, both ways."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import ImagesConfig
from gvo.errors import RecordingError
from gvo.io.png import MAGIC, decode_plain_png, is_png_complete, size_of_png
from gvo.types import DepthArray, ImageArray

MAX_PIXELS = 100_000_000
"""More than any camera has: a damaged header must not make a decoder allocate gigabytes."""

# By their first bytes; OpenCV would decode other formats too, whose decoders are not bounded.
_FORMATS = {
    "PNG": re.compile(re.escape(MAGIC)),
    "JPEG": re.compile(rb"\xff\xd8\xff"),
    "TIFF": re.compile(rb"II\*\0|MM\0\*"),
    "BMP": re.compile(rb"BM"),
    "PNM": re.compile(rb"P[1-6]\s"),
}
_JPEG_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_BARE_MARKERS = frozenset({0x01, *range(0xD0, 0xD8)})  # no length follows
_MAX_PIXELS_PER_BYTE = 2048  # twice what deflate makes of black, four times what JPEG does
_TOO_DARK = 1 << 12
_JPEG_QUALITY = 80  # of 100
_MAX_FILE_BYTES = 1 << 30  # more than all pixels that are allowed need
MILLIMETRES = 1000.0
"""Counts per metre of depth in millimetres: integer depth in messages is so by REP 118."""
# All positive finite numbers: neither zero nor infinity, and no comparison holds for NaN.
_KNOWN_DEPTH_M = (
    float(np.nextafter(np.float32(0), np.float32(1))),
    float(np.finfo(np.float32).max),
)
MAX_COUNT = 65534
"""Largest count: 0 and 65535 are unknown."""
# Counts read as float32 metres and multiplied again miss an integer by its rounding only.
_TOLERANCE = 5e-3


_FULL_RANGE = ImagesConfig()


def read_image(path: Path, grey_range: ImagesConfig = _FULL_RANGE) -> ImageArray:
    """Return the grey (h, w) or BGR (h, w, 3) pixels, 8 bits, of a PNG, JPEG, TIFF, BMP or PNM."""
    return to_8_bit(decode_image(_read_bytes(path), str(path)), str(path), grey_range)


def read_mask(path: Path, width: int, height: int) -> ImageArray:
    """Return a grey image of 8 bits, 0 = not used, which has to have this size."""
    pixels = decode_image(_read_bytes(path), str(path))
    if pixels.ndim == 3 and (pixels == pixels[..., :1]).all():
        pixels = pixels[..., 0]
    if pixels.ndim != 2 or pixels.dtype != np.uint8:
        kind = "colours" if pixels.ndim == 3 else f"{8 * pixels.itemsize} bits"
        raise RecordingError(f"{path}: expected a mask of 8 bits grey, 0 = not used, got {kind}")
    if pixels.shape != (height, width):
        size = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise RecordingError(f"{path}: the mask has {size} pixels, the images {width}x{height}")
    return pixels


def read_depth(path: Path, scale: float) -> DepthArray:
    """Return the metres (h, w), NaN = unknown, of a 16-bit grey image of counts."""
    return depth_from_counts(decode_image(_read_bytes(path), str(path)), scale, str(path))


def _read_bytes(path: Path) -> NDArray[np.uint8]:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise RecordingError(f"{path}: not a file")  # a device may never end
        if status.st_size > _MAX_FILE_BYTES:
            raise RecordingError(
                f"{path}: {status.st_size} bytes are too many for an image, it is damaged"
            )
        # With as few calls as can be: each hands Python's lock over to another thread.
        file = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
        try:
            return np.frombuffer(os.read(file, status.st_size), dtype=np.uint8)
        finally:
            os.close(file)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: the file is missing") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:  # a zero in a name
        raise RecordingError(f"{str(path)!r}: not a valid file name") from error


def decode_image(data: NDArray[np.uint8], where: str) -> NDArray[Any]:
    """Decode an image file held in memory, unchanged in depth and channels."""
    if len(data) == 0:
        raise RecordingError(f"{where}: the image is empty")
    start = data[:16].tobytes()
    kind = next((name for name, magic in _FORMATS.items() if magic.match(start)), "")
    if not kind:
        raise RecordingError(
            f"{where}: the image cannot be decoded: expected PNG, JPEG, TIFF, BMP or PNM, but it "
            f"begins with {start[:8]!r}"
        )
    if kind == "PNG":
        _check_file(kind, size_of_png(data), is_png_complete(data), len(data), where)
    elif kind == "JPEG":
        _check_file(kind, _jpeg_size(data), _is_jpeg_complete(data), len(data), where)
    pixels = decode_plain_png(data) if kind == "PNG" else None
    try:
        if pixels is None:
            pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:  # more than OPENCV_IO_MAX_IMAGE_PIXELS, too
        raise RecordingError(f"{where}: the image cannot be decoded") from error
    if pixels is None or pixels.size == 0:
        raise RecordingError(f"{where}: the image cannot be decoded")
    return np.asarray(pixels)


def to_8_bit(
    pixels: NDArray[Any], where: str, grey_range: ImagesConfig = _FULL_RANGE
) -> ImageArray:
    """Return grey (h, w) or BGR (h, w, 3) pixels of 8 bits; alpha is dropped.

    Cameras of 10, 12 or 14 bits fill the lower bits of 16, thermal ones a part in the middle, and
    no encoding tells. The range is one for the whole recording: a gain chosen for each frame
    would change the brightness of what is tracked.
    """
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    if pixels.dtype not in (np.uint8, np.uint16) or channels not in (1, 3, 4):
        raise RecordingError(
            f"{where}: expected grey or colour of 8 or 16 bits, got {pixels.dtype} of shape "
            f"{pixels.shape}"
        )
    if pixels.dtype == np.uint16:
        _check_brightness(int(pixels.max(initial=0)), grey_range, where)
        pixels = _narrow(pixels, grey_range)
    if pixels.ndim == 3 and channels == 1:
        pixels = pixels[:, :, 0]
    if channels == 4:
        pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGRA2BGR))
    return np.ascontiguousarray(pixels)


def _narrow(values: NDArray[np.uint16], grey_range: ImagesConfig) -> ImageArray:
    """Return values of 8 bits: for the full range the upper eight."""
    if grey_range == _FULL_RANGE:
        return (values >> 8).astype(np.uint8)
    black, white = grey_range.black, grey_range.white
    above = np.clip(values, black, white).astype(np.uint32) - np.uint32(black)
    return (above * 256 // (white + 1 - black)).astype(np.uint8)


def _check_brightness(largest: int, grey_range: ImagesConfig, where: str) -> None:
    if grey_range == _FULL_RANGE and largest < _TOO_DARK:
        n_bits = max(8, largest.bit_length())
        raise RecordingError(
            f"{where}: the 16-bit image is nearly black, its largest value is {largest} of 65535; "
            f"where the camera has {n_bits} bits, set images.white={(1 << n_bits) - 1}"
        )


def depth_from_counts(counts: NDArray[Any], scale: float, where: str) -> DepthArray:
    """Return metres (h, w), NaN = unknown, of 16-bit counts, of which 0 and 65535 are unknown."""
    if counts.dtype != np.uint16 or counts.ndim != 2:
        raise RecordingError(
            f"{where}: expected depth as 16-bit grey, got {counts.dtype} of shape {counts.shape}"
        )
    depth: DepthArray = np.divide(counts, np.float32(scale), dtype=np.float32)
    # One look at each pixel for both: with one added, 65535 becomes 0 and 0 becomes 1.
    np.copyto(depth, np.nan, where=counts + np.uint16(1) <= 1)
    return depth


def depth_from_metres(metres: NDArray[Any]) -> DepthArray:
    """Return metres (h, w) with NaN for what is not positive or not finite; copies if need be."""
    metres = np.asarray(metres, dtype=np.float32)
    # Both leave NaN out. Most drivers mark all that is unknown so: a look is a tenth of a copy.
    lowest, highest = np.fmin.reduce(metres, axis=None), np.fmax.reduce(metres, axis=None)
    if lowest > 0 and highest < np.inf:
        return metres
    depth: DepthArray = np.full(metres.shape, np.nan, dtype=np.float32)
    # OpenCV compares and copies in a third of NumPy's time.
    cv2.copyTo(metres, cv2.inRange(metres, *_KNOWN_DEPTH_M), depth)
    return depth


def is_in_counts(depth: DepthArray, scale: float) -> bool:
    """Tell whether metres were made of so many counts per metre; False if nothing is known."""
    counts = scale * depth[np.isfinite(depth)].astype(np.float64)
    return len(counts) > 0 and bool(np.all(np.abs(counts - np.round(counts)) < _TOLERANCE))


def to_counts(depth: DepthArray, scale: float) -> tuple[NDArray[np.uint16], int]:
    """Return rounded counts, 0 = unknown or too far, and the number of pixels too far."""
    counts = np.round(scale * np.nan_to_num(depth, nan=0.0).astype(np.float64))
    is_far = counts > MAX_COUNT
    counts[is_far] = 0
    return counts.astype(np.uint16), int(np.count_nonzero(is_far))


def exact_counts(depth: DepthArray, scale: float) -> NDArray[np.uint16] | None:
    """Return counts from which the depth comes back bit by bit; None where there are none."""
    counts, _ = to_counts(depth, scale)
    is_exact = np.array_equal(depth_from_counts(counts, scale, "depth"), depth, equal_nan=True)
    return counts if is_exact else None


def encode_image(pixels: NDArray[Any], suffix: Literal[".png", ".tiff", ".jpg"]) -> bytes:
    """Return an image as the bytes of a file: PNG and TIFF without loss, JPEG of quality 80.

    Parameters
    ----------
    pixels : ndarray of uint8, uint16 (PNG) or float32 (TIFF), shape (h, w) or (h, w, 3)
        Grey, or colour in BGR order.
    suffix : {".png", ".tiff", ".jpg"}
        Of the format.

    Raises
    ------
    RecordingError
        When it cannot be one.
    """
    parameters = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if suffix == ".jpg" else []
    is_encoded, data = cv2.imencode(suffix, pixels, parameters)
    if not is_encoded:
        raise RecordingError(
            f"an image of {pixels.dtype} {pixels.shape} cannot be written as {suffix[1:].upper()}"
        )
    return data.tobytes()


def _jpeg_size(data: NDArray[np.uint8]) -> tuple[int, int]:
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        segment = data[position : position + 9].tobytes()
        if segment[1] in _JPEG_FRAME_MARKERS:
            return int.from_bytes(segment[7:9], "big"), int.from_bytes(segment[5:7], "big")
        position += _jpeg_step(segment)
    return 0, 0


def _jpeg_step(segment: bytes) -> int:
    """Return how far it is to what follows, as a decoder goes on."""
    if segment[1] == 0xFF:
        return 1  # a marker may be preceded by any number of fill bytes
    if segment[1] in _JPEG_BARE_MARKERS:
        return 2
    return 2 + int.from_bytes(segment[2:4], "big")


def check_size(width: int, height: int, where: str, *, max_pixels: int = MAX_PIXELS) -> None:
    """Refuse sizes that no image has.

    Parameters
    ----------
    width, height : int
        As announced, pixels.
    where : str
        File or topic, for the message.
    max_pixels : int
        Of an image.

    Raises
    ------
    RecordingError
        When there are no pixels, or more than `max_pixels`.
    """
    if not (width > 0 and height > 0 and width * height <= max_pixels):
        raise RecordingError(f"{where}: the image claims {width}x{height} pixels, it is damaged")


def _check_file(
    kind: str, size: tuple[int, int], is_complete: bool, n_bytes: int, where: str
) -> None:
    """Refuse a file that claims more pixels than its bytes can hold, or that has no end."""
    check_size(*size, where)
    if size[0] * size[1] > n_bytes * _MAX_PIXELS_PER_BYTE:
        raise RecordingError(
            f"{where}: the image claims {size[0]}x{size[1]} pixels in {n_bytes} bytes, "
            "it is damaged"
        )
    if not is_complete:
        raise RecordingError(f"{where}: the {kind} image is truncated or damaged")


def _is_jpeg_complete(data: NDArray[np.uint8]) -> bool:
    """Tell whether a JPEG has its end; cameras fill their buffers up behind it."""
    end = b"\xff\xd9"
    return end in data[-1024:].tobytes() or end in data.tobytes().rstrip(b"\0")[-1024:]
