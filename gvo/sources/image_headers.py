"""What the first bytes of an encoded image say: its format and its size."""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvo.errors import RecordingError

MAX_PIXELS = 100_000_000
"""More than any camera has: a damaged header must not make a decoder allocate gigabytes."""

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_JPEG_MAGIC = b"\xff\xd8\xff"
_TIFF_MAGICS = {b"II*\0": "<", b"MM\0*": ">"}
_BMP_MAGIC = b"BM"
_PNM = re.compile(rb"P[1-6](?:\s+#[^\n]*)*\s+(\d{1,10})(?:\s+#[^\n]*)*\s+(\d{1,10})\s")
_JPEG_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_TIFF_SIZE_TAGS = (256, 257)
_TIFF_FORMS = {3: "H", 4: "I"}
_N_HEAD = 512


class ImageHeader(NamedTuple):
    """Format by name, width and height in pixels; 0 where the header does not tell."""

    format: str
    width: int
    height: int


def read_header(data: NDArray[np.uint8]) -> ImageHeader | None:
    """Read the header of an encoded image.

    Parameters
    ----------
    data : ndarray of uint8, shape (n,)
        The whole file.

    Returns
    -------
    ImageHeader or None
        Of PNG, JPEG, TIFF, BMP, PBM, PGM or PPM; None for anything else.
    """
    head = data[:_N_HEAD].tobytes()
    if head.startswith(_PNG_MAGIC):
        size = (int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"))
        return ImageHeader("PNG", *size)
    if head.startswith(_JPEG_MAGIC):
        return ImageHeader("JPEG", *_jpeg_size(data))
    if head[:4] in _TIFF_MAGICS:
        return ImageHeader("TIFF", *_tiff_size(data, _TIFF_MAGICS[head[:4]]))
    if head.startswith(_BMP_MAGIC) and len(head) >= 26:
        width, height = struct.unpack("<ii", head[18:26])
        return ImageHeader("BMP", abs(width), abs(height))
    if match := _PNM.match(head):
        return ImageHeader("PNM", int(match[1]), int(match[2]))
    return None


def check_size(width: int, height: int, where: str) -> None:
    """Refuse sizes that no image has.

    Parameters
    ----------
    width, height : int
        As announced, pixels.
    where : str
        File or topic, for the message.

    Raises
    ------
    RecordingError
        When there are no pixels, or more than `MAX_PIXELS`.
    """
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        raise RecordingError(f"{where}: the image claims {width}x{height} pixels, it is damaged")


def is_png(data: NDArray[np.uint8]) -> bool:
    """Tell whether data begin as a PNG does."""
    return data[: len(_PNG_MAGIC)].tobytes() == _PNG_MAGIC


def is_jpeg_complete(data: NDArray[np.uint8]) -> bool:
    """Tell whether a JPEG has its end; cameras fill their buffers up behind it."""
    end = b"\xff\xd9"
    return end in data[-1024:].tobytes() or end in data.tobytes().rstrip(b"\0")[-1024:]


def _jpeg_size(data: NDArray[np.uint8]) -> tuple[int, int]:
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        segment = data[position : position + 9].tobytes()
        if segment[1] in _JPEG_FRAME_MARKERS:
            return int.from_bytes(segment[7:9], "big"), int.from_bytes(segment[5:7], "big")
        # a marker may be preceded by any number of fill bytes
        is_fill = segment[1] == 0xFF
        position += 1 if is_fill else 2 + int.from_bytes(segment[2:4], "big")
    return 0, 0


def _tiff_size(data: NDArray[np.uint8], order: str) -> tuple[int, int]:
    """Read width and height from the first directory of a TIFF."""
    sizes = dict.fromkeys(_TIFF_SIZE_TAGS, 0)
    (offset,) = struct.unpack(f"{order}I", data[4:8].tobytes().ljust(4, b"\0"))
    (n_entries,) = struct.unpack(f"{order}H", data[offset : offset + 2].tobytes().ljust(2, b"\0"))
    entries = data[offset + 2 : offset + 2 + 12 * n_entries].tobytes()
    for start in range(0, len(entries) - 11, 12):
        tag, type_, _ = struct.unpack_from(f"{order}HHI", entries, start)
        if tag in sizes and type_ in _TIFF_FORMS:
            (sizes[tag],) = struct.unpack_from(f"{order}{_TIFF_FORMS[type_]}", entries, start + 8)
    return sizes[256], sizes[257]
