"""RVL as its paper gives it: one number after the other."""

import struct
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray


def encode_rvl(counts: NDArray[np.uint16]) -> bytes:
    """Return width, height and the code of an image."""
    nibbles = [nibble for number in _numbers(counts.ravel().tolist()) for nibble in _cut(number)]
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        sum(nibble << (28 - 4 * k) for k, nibble in enumerate(nibbles[start : start + 8]))
        for start in range(0, len(nibbles), 8)
    ]
    height, width = counts.shape
    return struct.pack(f"<II{len(words)}I", width, height, *words)


def _numbers(pixels: list[int]) -> Iterator[int]:
    position, previous = 0, 0
    while position < len(pixels):
        start = position
        while position < len(pixels) and pixels[position] == 0:
            position += 1
        yield position - start
        start = position
        while position < len(pixels) and pixels[position] != 0:
            position += 1
        yield position - start
        for value in pixels[start:position]:
            delta = value - previous
            yield 2 * delta if delta >= 0 else -2 * delta - 1
            previous = value


def _cut(number: int) -> Iterator[int]:
    while True:
        nibble, number = number & 7, number >> 3
        if number == 0:
            yield nibble
            return
        yield nibble | 8
