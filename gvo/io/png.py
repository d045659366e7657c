"""PNG files: their chunks, and what of them is decoded without OpenCV, in half of the time."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import islice
from typing import Any

import cv2
import numpy as np
from isal import isal_zlib
from isal.igzip_lib import IsalError
from numpy.typing import NDArray

MAGIC = b"\x89PNG\r\n\x1a\n"
_END = b"IEND"
_N_AT_ONCE = 4096  # bytes of which a checksum is made without giving Python's lock away
_HEADER = struct.Struct(">II5B")
_CHANNELS = {0: 1, 2: 3, 6: 4}  # of the types grey, colour, and colour with alpha
_TO_BGR = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
# Chunks that change no pixel, in the order in which they are written.
_PLAIN = re.compile(rb"IHDR(gAMA|cHRM|sRGB|pHYs|tIME|tEXt)*(IDAT)+(tIME|tEXt)*IEND")
_MAX_CHUNKS = 10_000
_MAX_SIDE = 1 << 15  # as libpng, OpenCV has limits of its own
_FIRST_BYTE = 0x78  # of deflate with the largest window
_UNFILTER: ContextVar[Callable[..., bool] | None] = ContextVar("unfilter", default=None)


def is_png(data: NDArray[np.uint8]) -> bool:
    """Tell whether data begin as a PNG does."""
    return data[: len(MAGIC)].tobytes() == MAGIC


def size_of_png(data: NDArray[np.uint8]) -> tuple[int, int]:
    """Return width and height as announced; zero where there is no header."""
    size = data[16:24].tobytes()
    return int.from_bytes(size[:4], "big"), int.from_bytes(size[4:], "big")


def is_png_complete(data: NDArray[np.uint8]) -> bool:
    """Tell whether the chunks of a PNG end before it does, those of its rows with their checksum.

    OpenCV asks for the memory of a chunk, up to gigabytes, before it sees that there is no more.
    """
    return all(
        end <= len(data) and (name != b"IDAT" or _is_sound(data.data[start:end]))
        for name, start, end in _chunks(data)
    )


@contextmanager
def compiled_png() -> Iterator[None]:
    """Decode PNG by kernels in this context, where frames are tracked: others load no kernels."""
    from gvo.kernels.png import unfilter

    token = _UNFILTER.set(unfilter)
    try:
        yield
    finally:
        _UNFILTER.reset(token)


def decode_plain_png(data: NDArray[np.uint8]) -> NDArray[Any] | None:
    """Decode a complete PNG as OpenCV does, in a context of `compiled_png`.

    None is for OpenCV to decode or to refuse: palettes, interlaced rows, less than 8 bits, chunks
    that may change pixels, and whatever is wrong.
    """
    unfilter = _UNFILTER.get()
    stream = _plain_stream(data) if unfilter is not None else None
    if unfilter is None or stream is None:
        return None
    width, height, bits, colour, *_ = _HEADER.unpack_from(data.data, 16)
    n_channels = _CHANNELS[colour]
    n_pixel = n_channels * bits // 8
    filtered = _inflate(stream, (height, width * n_pixel + 1))
    rows = np.empty((height + 1, width * n_pixel), dtype=np.uint8)
    rows[0] = 0
    if filtered is None or not unfilter(filtered, n_pixel, rows):
        return None
    # Both in place: the pages of new arrays cost more than what is done.
    samples = rows[1:] if bits == 8 else rows[1:].view(np.uint16).byteswap(inplace=True)
    if n_channels == 1:
        return samples
    pixels = samples.reshape(height, width, n_channels)
    return np.asarray(cv2.cvtColor(pixels, _TO_BGR[n_channels], dst=pixels))


def _plain_stream(data: NDArray[np.uint8]) -> bytes | None:
    """Return the compressed rows of a PNG that has nothing out of the ordinary."""
    chunks = [*islice(_chunks(data), _MAX_CHUNKS)]
    if not _PLAIN.fullmatch(b"".join(name for name, _, _ in chunks)):
        return None
    width, height, bits, colour, *methods = _HEADER.unpack_from(data.data, 16)
    is_plain = bits in (8, 16) and colour in _CHANNELS and not any(methods)
    if not is_plain or max(width, height) > _MAX_SIDE or chunks[0][2] != 33:
        return None
    if not all(_is_sound(data.data[start:end]) for name, start, end in chunks if name != b"IDAT"):
        return None
    return b"".join(
        data.data[start + 8 : end - 4] for name, start, end in chunks if name == b"IDAT"
    )


def _inflate(stream: bytes, shape: tuple[int, int]) -> NDArray[np.uint8] | None:
    """Inflate so many bytes; None where there are less or more, or their checksum is wrong."""
    inflater = isal_zlib.decompressobj()
    try:
        inflated = inflater.decompress(stream, shape[0] * shape[1])
    except IsalError:  # type: ignore[misc] # a class, its stubs say an instance
        return None
    is_exact = inflater.eof and not inflater.unused_data and len(inflated) == shape[0] * shape[1]
    if not is_exact or stream[0] != _FIRST_BYTE:
        return None
    return np.frombuffer(inflated, dtype=np.uint8).reshape(shape)


def _is_sound(chunk: memoryview) -> bool:
    """Tell whether the checksum of a chunk is that of its name and content."""
    content, check = chunk[4:-4], 0
    for first in range(0, len(content), _N_AT_ONCE):
        check = isal_zlib.crc32(content[first : first + _N_AT_ONCE], check)
    return check == int.from_bytes(chunk[-4:], "big")


def _chunks(data: NDArray[np.uint8]) -> Iterator[tuple[bytes, int, int]]:
    """Yield the name of each chunk, and where it and its checksum begin and end."""
    start, name = len(MAGIC), b""
    while start < len(data) and name != _END:
        head = data.data[start : start + 8].tobytes()
        name, end = head[4:], start + 12 + int.from_bytes(head[:4], "big")
        yield name, start, end
        start = end
