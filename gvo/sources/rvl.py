"""RVL, a lossless coding of depth images that `compressedDepth` offers beside PNG."""

from __future__ import annotations

import struct
from array import array

import numpy as np
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.sources.image_headers import check_size
from gvo.types import IntArray

MAX_RVL_PIXELS = 1 << 24
"""More than any depth camera has; to decode a pixel takes a hundred times its memory."""

_SIZE = struct.Struct("<II")
_MAX_NUMBERS_PER_PIXEL = 3  # a run of one value, behind none: two lengths and the value
_MAX_NIBBLES = 64  # of a number; three make a depth
_BLOCK_WORDS = 1 << 18


def decode_rvl(data: NDArray[np.uint8], where: str) -> NDArray[np.uint16]:
    """Decode an RVL image with its size before it.

    Parameters
    ----------
    data : ndarray of uint8, shape (n,)
        Width and height as 32-bit integers, then the code.
    where : str
        The topic, for the message.

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
