"""A VP8 film as FFmpeg writes it to Matroska, made a WebM file of another frame rate.

Both formats are EBML: elements of an id, a size and content, some of which are elements again.
WebM is Matroska with few kinds of elements and its own name. Only the elements before the first
pictures are read, and numbers are replaced in their place: nothing moves.

References
----------
RFC 8794 (EBML) and RFC 9559 (Matroska).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

PERIOD_NS: Final = 10**9
"""Between two frames of the film that is read."""

_DOC_TYPE: Final = 0x4282
_TIMESTAMP_SCALE: Final = 0x2AD7B1
_DURATION: Final = 0x4489
_DEFAULT_DURATION: Final = 0x23E383
_TAG_STRING: Final = 0x4487
_CRC_32: Final = 0xBF
_CLUSTER: Final = 0x1F43B675
_MASTERS: Final = {
    0x1A45DFA3: "EBML",
    0x18538067: "Segment",
    0x1549A966: "Info",
    0x1654AE6B: "Tracks",
    0xAE: "TrackEntry",
    0x1254C367: "Tags",
    0x7373: "Tag",
    0x67C8: "SimpleTag",
}
_HEADER_BYTES: Final = 1 << 16
_MATROSKA = b"\x42\x82\x88matroska"
_WEBM = b"\x42\x82\x84webm\xec\x82\x00\x00"  # with an empty element in the place of what is over
_TAG_DURATION = b"\x45\xa3\x88DURATION"


class _Element(NamedTuple):
    id: int
    start: int
    """Of the content."""
    end: int


def finish_webm(path: Path, period_ns: int) -> None:
    """Give a film of a frame a second another rate, and the name of its format.

    Parameters
    ----------
    path : Path
        A Matroska file of `PERIOD_NS` between frames; changed in its place.
    period_ns : int
        Between two frames, nanoseconds.

    Raises
    ------
    ValueError
        When the file is not as FFmpeg writes it.
    """
    with path.open("r+b") as stream:
        header = bytearray(stream.read(_HEADER_BYTES))
        elements = list(_walk(header, 0, len(header)))
        found = {element.id: element for element in elements}
        if not {_TIMESTAMP_SCALE, _CLUSTER} <= set(found) or _MATROSKA not in header[:64]:
            raise ValueError("its beginning is not that of a Matroska film")
        _rescale(header, found, period_ns)
        for element in elements:
            if element.id == _CRC_32:
                _renew_checksum(header, element, elements)
        header[:64] = header[:64].replace(_MATROSKA, _WEBM)
        stream.seek(0)
        stream.write(header)


def _rescale(header: bytearray, found: dict[int, _Element], period_ns: int) -> None:
    """Change the unit of all stamps, and what is told of the period beside."""
    unit = found[_TIMESTAMP_SCALE]
    old_ns = int.from_bytes(header[unit.start : unit.end])
    new_ns = max(1, round(old_ns * period_ns / PERIOD_NS))
    _replace(header, unit, new_ns)
    if _DEFAULT_DURATION in found:
        _replace(header, found[_DEFAULT_DURATION], period_ns)
    place = found.get(_DURATION)
    text = found.get(_TAG_STRING)
    if place is None or text is None or place.end - place.start != 8:
        return
    total_ns = round(struct.unpack(">d", header[place.start : place.end])[0] * new_ns)
    seconds, nanoseconds = divmod(total_ns, 10**9)
    minutes, seconds = divmod(seconds, 60)
    written = f"{minutes // 60:02d}:{minutes % 60:02d}:{seconds:02d}.{nanoseconds:09d}".encode()
    if _TAG_DURATION in header[: text.start] and len(written) <= text.end - text.start:
        header[text.start : text.end] = written.ljust(text.end - text.start, b"\0")


def _replace(header: bytearray, element: _Element, value: int) -> None:
    n_bytes = element.end - element.start
    if value >= 256**n_bytes:
        raise ValueError(f"{value} does not fit into {n_bytes} bytes")
    header[element.start : element.end] = value.to_bytes(n_bytes)


def _renew_checksum(header: bytearray, checksum: _Element, elements: list[_Element]) -> None:
    """Compute anew the sum over what follows it in the element that it begins."""
    master = min(
        (e for e in elements if e.id in _MASTERS and e.start <= checksum.start < e.end),
        key=lambda e: e.end - e.start,
    )
    value = zlib.crc32(header[checksum.end : master.end])
    header[checksum.start : checksum.end] = value.to_bytes(4, "little")


def _walk(data: bytearray, start: int, end: int) -> Iterator[_Element]:
    """Yield the elements up to the first cluster, those that hold others before these."""
    while start < end - 1:
        id_length = _length(data[start])
        size_at = start + id_length
        size_length = _length(data[size_at])
        content = size_at + size_length
        mask = (1 << 7 * size_length) - 1
        size = int.from_bytes(data[size_at:content]) & mask
        element = _Element(int.from_bytes(data[start:size_at]), content, content + size)
        yield element
        if element.id == _CLUSTER:
            return
        if element.id in _MASTERS:
            yield from _walk(data, content, min(element.end, end))
        start = element.end


def _length(first: int) -> int:
    """Return the bytes of a number that tells its own length by its leading zeros."""
    if first == 0:
        raise ValueError("its beginning is not that of a Matroska film")
    return 9 - first.bit_length()
