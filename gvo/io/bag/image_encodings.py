"""Encodings of `sensor_msgs/Image`, and the RVL code of depth."""

from __future__ import annotations

import struct
from array import array
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo._text import shortened
from gvo.errors import RecordingError
from gvo.io.images import check_size
from gvo.types import IntArray

if TYPE_CHECKING:
    from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__Image as RawImage

MAX_RVL_PIXELS = 1 << 24
"""More than any depth camera has; to decode a pixel takes a hundred times its memory."""
_SIZE = struct.Struct("<II")
_MAX_NUMBERS_PER_PIXEL = 3  # a run of one value, behind none: two lengths and the value
_MAX_NIBBLES = 64  # of a number; three make a depth
_BLOCK_WORDS = 1 << 18


@dataclass(frozen=True, slots=True)
class Encoding:
    """How pixels are stored.

    Parameters
    ----------
    dtype : str
        Of a value, in numpy's words without the byte order.
    n_channels : int
        Values of a pixel.
    to_bgr : int, optional
        Code for `cv2.cvtColor`; None where the values are grey, BGR or BGRA already.
    rows_per_two : int
        Rows of values for two rows of pixels: 3 where planes of colour follow below.
    """

    dtype: str
    n_channels: int
    to_bgr: int | None = None
    rows_per_two: int = 2


def _of_both_depths(name: str, n_channels: int, to_bgr: int | None) -> dict[str, Encoding]:
    return {
        f"{name}8": Encoding("u1", n_channels, to_bgr),
        f"{name}16": Encoding("u2", n_channels, to_bgr),
    }


# OpenCV names a Bayer pattern by its second row, ROS by its first.
BAYER = (
    _of_both_depths("bayer_rggb", 1, cv2.COLOR_BayerBG2BGR)
    | _of_both_depths("bayer_bggr", 1, cv2.COLOR_BayerRG2BGR)
    | _of_both_depths("bayer_gbrg", 1, cv2.COLOR_BayerGR2BGR)
    | _of_both_depths("bayer_grbg", 1, cv2.COLOR_BayerGB2BGR)
)
"""Mosaics of colour filters."""

IMAGES = {
    **dict.fromkeys(("mono8", "8UC1"), Encoding("u1", 1)),
    **dict.fromkeys(("mono16", "16UC1"), Encoding("u2", 1)),
    **_of_both_depths("bgr", 3, None),
    **_of_both_depths("rgb", 3, cv2.COLOR_RGB2BGR),
    **_of_both_depths("bgra", 4, None),
    **_of_both_depths("rgba", 4, cv2.COLOR_RGBA2BGR),
    # without names the channels are in OpenCV's order
    "8UC3": Encoding("u1", 3),
    "8UC4": Encoding("u1", 4),
    "16UC3": Encoding("u2", 3),
    "16UC4": Encoding("u2", 4),
    **BAYER,
    **dict.fromkeys(("yuv422", "uyvy"), Encoding("u1", 2, cv2.COLOR_YUV2BGR_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), Encoding("u1", 2, cv2.COLOR_YUV2BGR_YUYV)),
    "nv12": Encoding("u1", 1, cv2.COLOR_YUV2BGR_NV12, 3),
    "nv21": Encoding("u1", 1, cv2.COLOR_YUV2BGR_NV21, 3),
}
"""Encodings of grey and colour images."""

DEPTHS = {"16UC1": Encoding("u2", 1), "mono16": Encoding("u2", 1), "32FC1": Encoding("f4", 1)}
"""Encodings of depth."""


def find_encoding(name: str, encodings: dict[str, Encoding], where: str) -> Encoding:
    """Look an encoding up by its name; raise `RecordingError` when it is none of these."""
    if name not in encodings:
        raise RecordingError(
            f"{where}: encoding {shortened(name)} is not supported, expected one of "
            f"{', '.join(encodings)}"
        )
    return encodings[name]


def stored_pixels(image: RawImage, encoding: Encoding, where: str) -> NDArray[Any]:
    """Return the values of an image as stored, without the padding of its rows.

    Returns
    -------
    ndarray, shape (rows, width) or (rows, width, channels)
        In native byte order. A view of the data where nothing has to be moved.

    Raises
    ------
    RecordingError
        When size and data do not belong together; nothing is allocated before.
    """
    dtype = np.dtype(encoding.dtype).newbyteorder(">" if image.is_bigendian else "<")
    height, width = int(image.height), int(image.width)
    step, n_bytes = int(image.step), len(image.data)
    pixel_bytes = encoding.n_channels * dtype.itemsize
    if height <= 0 or width <= 0:
        raise RecordingError(f"{where}: the image has no pixels ({width}x{height})")
    rows, is_odd = divmod(height * encoding.rows_per_two, 2)
    row_bytes = width * pixel_bytes
    step = step or row_bytes  # some drivers leave it 0, and pack the rows
    if is_odd or step < row_bytes or n_bytes != step * rows:
        raise RecordingError(
            f"{where}: a {image.encoding} image of {width}x{height} with rows of {image.step} "
            f"bytes needs {max(step, row_bytes) * rows} bytes, got {n_bytes}"
        )
    shape = (rows, width, encoding.n_channels)
    data = np.ascontiguousarray(image.data).data
    strides = (step, pixel_bytes, dtype.itemsize)
    pixels: NDArray[Any] = np.ndarray(shape, dtype, data, strides=strides)
    if encoding.n_channels == 1:
        pixels = pixels[:, :, 0]
    return np.ascontiguousarray(pixels, dtype=dtype.newbyteorder("="))


def convert_to_bgr(pixels: NDArray[Any], to_bgr: int, what: str) -> NDArray[Any]:
    """Convert stored pixels to BGR by a code of `cv2.cvtColor`; refuse an impossible size."""
    try:
        return np.asarray(cv2.cvtColor(pixels, to_bgr))
    except cv2.error as error:
        height, width = pixels.shape[:2]
        raise RecordingError(f"{what}: {width}x{height} values cannot be converted") from error


def decode_rvl(data: NDArray[np.uint8], where: str) -> NDArray[np.uint16]:
    """Decode an RVL image: width and height as 32-bit integers, then the code.

    Returns
    -------
    ndarray of uint16, shape (height, width)
        Counts, 0 = unknown.

    Raises
    ------
    RecordingError
        When the size is absurd, or the code does not fill it.

    Notes
    -----
    The code is a row of numbers of three bits a nibble, the fourth telling that more follow:
    how many zeros, how many other values, and the differences between these; and again. All the
    numbers are decoded at once, then the runs are followed, and the differences summed at once.

    References
    ----------
    A. D. Wilson, "Fast lossless depth image compression", 2017, doi:10.1145/3132272.3134144
    """
    if len(data) < _SIZE.size:
        raise RecordingError(f"{where}: the RVL image has no size")
    width, height = _SIZE.unpack(data[: _SIZE.size].tobytes())
    check_size(width, height, where, max_pixels=MAX_RVL_PIXELS)
    numbers = _numbers(data[_SIZE.size :], _MAX_NUMBERS_PER_PIXEL * width * height)
    firsts, starts, lengths = _runs(numbers, width * height, where)
    is_known = np.repeat(np.arange(len(lengths)), lengths)
    steps = np.arange(len(is_known)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    zigzag = numbers[firsts[is_known] + steps]
    counts = np.zeros(width * height, dtype=np.uint16)
    # the sum runs on over the zeros
    counts[starts[is_known] + steps] = np.cumsum((zigzag >> 1) ^ -(zigzag & 1)).astype(np.uint16)
    return counts.reshape(height, width)


def _numbers(code: NDArray[np.uint8], n_max: int) -> IntArray:
    """Return the numbers of the code, no more than are needed; one cut off by the end is left out.

    Block by block: all at once would take a hundred times the memory of the code.
    """
    words = np.frombuffer(code[: len(code) // 4 * 4].tobytes(), dtype="<u4")
    rest = np.zeros(0, dtype=np.uint8)
    blocks: list[IntArray] = [np.zeros(0, dtype=np.int64)]
    n_found, start = 0, 0
    while start < len(words) and n_found < n_max and len(rest) <= _MAX_NIBBLES:
        block = words[start : start + _BLOCK_WORDS, np.newaxis]
        nibbles = (block >> np.arange(28, -1, -4, dtype=np.uint32)) & 15
        numbers, rest = _numbers_of(np.concatenate([rest, nibbles.astype(np.uint8).ravel()]))
        blocks.append(numbers)
        n_found += len(numbers)
        start += _BLOCK_WORDS
    return np.concatenate(blocks)


def _numbers_of(nibbles: NDArray[np.uint8]) -> tuple[IntArray, NDArray[np.uint8]]:
    """Return the numbers of nibbles, and the nibbles of the one that goes on."""
    ends = np.flatnonzero(nibbles < 8)
    if len(ends) == 0:
        return np.zeros(0, dtype=np.int64), nibbles
    whole, rest = np.split(nibbles, [ends[-1] + 1])
    begins = np.concatenate([[0], ends[:-1] + 1])
    places = np.arange(len(whole)) - np.repeat(begins, ends + 1 - begins)
    bits = (whole & 7).astype(np.int64) << np.minimum(3 * places, 60)
    return np.asarray(np.add.reduceat(bits, begins), dtype=np.int64), rest


def _runs(numbers: IntArray, n_pixels: int, where: str) -> tuple[IntArray, IntArray, IntArray]:
    """Follow the runs: the first number of each, its first pixel, and its length."""
    runs = array("q")
    view, position, pixel = numbers.data, 0, 0
    while pixel < n_pixels:
        if position + 2 > len(view):
            raise RecordingError(f"{where}: the RVL image is truncated at pixel {pixel}")
        zeros, length = view[position], view[position + 1]
        pixel, position = pixel + zeros, position + 2
        is_sane = zeros >= 0 and length >= 0 and zeros + length > 0
        if not is_sane or pixel + length > n_pixels or position + length > len(view):
            raise RecordingError(f"{where}: the RVL image is damaged at pixel {pixel}")
        runs.extend((position, pixel, length))
        pixel, position = pixel + length, position + length
    firsts, starts, lengths = np.frombuffer(runs, dtype=np.int64).reshape(-1, 3).T
    return firsts, starts, lengths
