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
_PNG_END = b"IEND"
_JPEG_MAGIC = b"\xff\xd8\xff"
_TIFF_MAGICS = {b"II*\0": "<", b"MM\0*": ">"}
_BMP_MAGIC = b"BM"
# Without going back: comments can be split up in more ways than could ever be tried.
_PNM_GAP = rb"(?>(?:\s+#[^\n]*+)*+\s+)"
_PNM = re.compile(rb"P[1-6]" + _PNM_GAP + rb"(\d{1,10}+)" + _PNM_GAP + rb"(\d{1,10}+)\s")
_JPEG_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_BARE_MARKERS = frozenset({0x01, *range(0xD0, 0xD8)})  # no length follows
_TIFF_SIZE_TAGS = (256, 257)
_TIFF_FORMS = {3: "H", 4: "I"}
_N_HEAD = 512
_MAX_PIXELS_PER_BYTE = 2048  # twice what deflate makes of black, four times what JPEG does


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


def check_density(header: ImageHeader, n_bytes: int, where: str) -> None:
    """Refuse an image that claims more pixels than its bytes can hold.

    Parameters
    ----------
    header : ImageHeader
    n_bytes : int
        Of the whole file.
    where : str
        File or topic, for the message.

    Raises
    ------
    RecordingError
        Before memory for these pixels is asked for.
    """
    if header.width * header.height > n_bytes * _MAX_PIXELS_PER_BYTE:
        raise RecordingError(
            f"{where}: the image claims {header.width}x{header.height} pixels in {n_bytes} bytes, "
            "it is damaged"
        )


def is_png(data: NDArray[np.uint8]) -> bool:
    """Tell whether data begin as a PNG does."""
    return data[: len(_PNG_MAGIC)].tobytes() == _PNG_MAGIC


def is_jpeg_complete(data: NDArray[np.uint8]) -> bool:
    """Tell whether a JPEG has its end; cameras fill their buffers up behind it."""
    end = b"\xff\xd9"
    return end in data[-1024:].tobytes() or end in data.tobytes().rstrip(b"\0")[-1024:]


def is_png_complete(data: NDArray[np.uint8]) -> bool:
    """Tell whether the chunks of a PNG end before it does.

    OpenCV asks for the memory of a chunk, up to gigabytes, before it sees that there is no more.
    """
    position = len(_PNG_MAGIC)
    while position < len(data):
        head = data[position : position + 8].tobytes()
        position += 12 + int.from_bytes(head[:4], "big")
        if head[4:] == _PNG_END:
            break
    return position <= len(data)


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


def _tiff_size(data: NDArray[np.uint8], order: str) -> tuple[int, int]:
    """Read width and height from the first directory of a TIFF."""
    sizes = dict.fromkeys(_TIFF_SIZE_TAGS, 0)
    (offset,) = struct.unpack(f"{order}I", data[4:8].tobytes().ljust(4, b"\0"))
    (n_entries,) = struct.unpack(f"{order}H", data[offset : offset + 2].tobytes().ljust(2, b"\0"))
    entries = data[offset + 2 : offset + 2 + 12 * n_entries].tobytes()
    for start in range(0, len(entries) - 11, 12):
        tag, type_, _ = struct.unpack_from(f"{order}HHI", entries, start)
        # of several of one tag the first counts
        if sizes.get(tag) == 0 and type_ in _TIFF_FORMS:
            (sizes[tag],) = struct.unpack_from(f"{order}{_TIFF_FORMS[type_]}", entries, start + 8)
    return sizes[256], sizes[257]
