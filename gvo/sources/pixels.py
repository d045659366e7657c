"""Encoded image files and depth counts, decoded the same way from folders and from bags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.types import DepthArray, ImageArray

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_JPEG_MAGIC = b"\xff\xd8\xff"
_MAX_PIXELS = 100_000_000
_JPEG_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def read_image(path: Path) -> ImageArray:
    """Read an image file.

    Parameters
    ----------
    path : Path
        PNG, JPEG or whatever else OpenCV decodes.

    Returns
    -------
    ndarray of uint8, shape (height, width) or (height, width, 3)
        Grey, or colour in BGR order; 16 bits are shifted to 8.

    Raises
    ------
    RecordingError
        When the file is missing, empty, truncated or no image.
    """
    return to_8_bit(decode_image(_read_bytes(path), str(path)), str(path))


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
    head = data[:32].tobytes()
    if not head:
        raise RecordingError(f"{where}: the image is empty")
    width, height = _announced_size(data, head)
    if width * height > _MAX_PIXELS:
        raise RecordingError(f"{where}: the image claims {width}x{height} pixels, it is damaged")
    if head.startswith(_JPEG_MAGIC) and b"\xff\xd9" not in data[-1024:].tobytes():
        raise RecordingError(f"{where}: the JPEG image is truncated")
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise RecordingError(f"{where}: the image cannot be decoded") from error
    if pixels is None or pixels.size == 0:
        raise RecordingError(f"{where}: the image cannot be decoded")
    return np.asarray(pixels)


def to_8_bit(pixels: NDArray[Any], where: str) -> ImageArray:
    """Return grey (h, w) or BGR (h, w, 3) pixels of 8 bits; alpha is dropped.

    Parameters
    ----------
    pixels : ndarray of uint8 or uint16, shape (h, w), (h, w, 3) or (h, w, 4)
        Values of 16 bits lose their lower eight.
    where : str
        File or topic, for the message.

    Raises
    ------
    RecordingError
        When the values are of another type.
    """
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.dtype != np.uint8 or (pixels.ndim == 3 and pixels.shape[2] not in (1, 3, 4)):
        raise RecordingError(
            f"{where}: expected grey or colour of 8 or 16 bits, got {pixels.dtype} of shape "
            f"{pixels.shape}"
        )
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        pixels = pixels[:, :, :3]
    return np.ascontiguousarray(pixels)


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
    depth: DepthArray = np.divide(counts, np.float32(scale), dtype=np.float32)
    # One look at each pixel for both: with one added, 65535 becomes 0 and 0 becomes 1.
    depth[counts + np.uint16(1) <= 1] = np.nan
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
        A copy, metres, NaN = unknown.
    """
    depth = np.array(metres, dtype=np.float32)
    depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
    return depth


def _read_bytes(path: Path) -> NDArray[np.uint8]:
    try:
        return np.fromfile(path, dtype=np.uint8)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: the file is missing") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


def _announced_size(data: NDArray[np.uint8], head: bytes) -> tuple[int, int]:
    # Checked before decoding: a damaged header must not make the decoder allocate gigabytes.
    if head.startswith(_PNG_MAGIC):
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    if head.startswith(_JPEG_MAGIC):
        return _jpeg_size(data)
    return 0, 0


def _jpeg_size(data: NDArray[np.uint8]) -> tuple[int, int]:
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        segment = data[position : position + 9].tobytes()
        if segment[1] in _JPEG_FRAME_MARKERS:
            return int.from_bytes(segment[7:9], "big"), int.from_bytes(segment[5:7], "big")
        position += 2 + int.from_bytes(segment[2:4], "big")
    return 0, 0
