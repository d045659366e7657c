"""Bounded reading and decompression of files that may be truncated or damaged."""

from __future__ import annotations

import bz2
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of a Zstandard frame, and of no CDR message."""

MAX_INFLATED = 1 << 29
"""Bytes of a chunk; recorders write about one megabyte."""

_BLOCK = 1 << 16
_SEARCH_BLOCK = 1 << 20
_MAX_STEP = 1 << 24
_DECOMPRESSORS: dict[str, Any] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}
_FAULTS = (OSError, RuntimeError, EOFError, ValueError, zstd.ZstdError)


class DamageError(Exception):
    """Invalid data; the reader catches it and skips the record."""


class Window:
    """A part of a file, read from its start; nothing is allocated for bytes that do not exist.

    Parameters
    ----------
    file : BinaryIO
    start, end : int
        Bytes from the start of the file.
    """

    def __init__(self, file: BinaryIO, start: int, end: int) -> None:
        self.file = file
        self.position = start
        self.end = end

    @property
    def rest(self) -> int:
        """The number of remaining bytes."""
        return self.end - self.position

    def take(self, n_bytes: int) -> bytes:
        """Return the next bytes.

        Raises
        ------
        DamageError
            If fewer bytes remain.
        """
        start = self.position
        self.skip(n_bytes)
        self.file.seek(start)
        data = self.file.read(n_bytes)
        if len(data) != n_bytes:
            raise DamageError("the file was shortened while it was read")
        return data

    def skip(self, n_bytes: int) -> None:
        """Skip the next bytes.

        Raises
        ------
        DamageError
            If fewer bytes remain.
        """
        if n_bytes > self.rest:
            raise DamageError(f"a record of {n_bytes} bytes is cut after {self.rest}")
        self.position += n_bytes

    def number(self, n_bytes: int) -> int:
        """Return the next bytes as an unsigned number, little-endian."""
        return int.from_bytes(self.take(n_bytes), "little")

    def part(self, n_bytes: int) -> Window:
        """Return a window on the next bytes, and skip them."""
        start = self.position
        self.skip(n_bytes)
        return Window(self.file, start, self.position)

    def blocks(self, size: int = _SEARCH_BLOCK) -> Iterator[bytes]:
        """Yield the remaining bytes, block by block."""
        while self.rest:
            yield self.take(min(size, self.rest))

    def find(self, pattern: bytes, start: int) -> Iterator[int]:
        """Yield the positions of a pattern from `start` on, whatever the position of the window."""
        search = Window(self.file, start, self.end)
        tail = b""
        for block in search.blocks():
            data = tail + block
            base = search.position - len(data)
            found = data.find(pattern)
            while found >= 0:
                yield base + found
                found = data.find(pattern, found + 1)
            tail = data[len(data) - len(pattern) + 1 :]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inflated:
    """The decompressed content of a part of a file.

    Parameters
    ----------
    data : bytes
        The content, or its start.
    is_cut : bool
        The compressed data are truncated.
    """

    data: bytes
    is_cut: bool


def inflate(window: Window, compression: str, *, limit: int = MAX_INFLATED) -> Inflated:
    """Decompress from a window; skip the compressed bytes.

    Parameters
    ----------
    window : Window
    compression : str
        "bz2", "lz4" or "zstd".
    limit : int
        Maximum number of decompressed bytes.

    Raises
    ------
    DamageError
        If the data are invalid, or exceed the limit.
    """
    if compression not in _DECOMPRESSORS:
        raise DamageError(f"a chunk of unknown compression {compression!r}")
    if limit > MAX_INFLATED:
        raise DamageError(f"a chunk that claims {limit} bytes")
    parts: list[bytes] = []
    n_bytes = 0
    decompressor = _DECOMPRESSORS[compression]()
    while window.rest:
        piece = window.take(min(_BLOCK, window.rest))
        while piece or not decompressor.needs_input:
            parts.append(_feed(decompressor, compression, piece, limit + 1 - n_bytes))
            n_bytes += len(parts[-1])
            if n_bytes > limit:
                raise DamageError(f"a chunk inflates to more than the {limit} bytes it claims")
            piece = b""
            if decompressor.eof:
                window.position -= len(decompressor.unused_data or b"")
                return Inflated(data=b"".join(parts), is_cut=False)
    return Inflated(data=b"".join(parts), is_cut=True)


def inflate_whole(data: bytes, compression: str, *, limit: int | None = None) -> bytes:
    """Decompress complete data, of one stream or of several in a row.

    Parameters
    ----------
    data : bytes
    compression : str
        "bz2", "lz4" or "zstd".
    limit : int, optional
        Maximum number of decompressed bytes, up to `MAX_INFLATED`.

    Raises
    ------
    DamageError
        If the data are invalid or truncated, or exceed the limit.
    """
    parts: list[bytes] = []
    limit = MAX_INFLATED if limit is None else min(limit, MAX_INFLATED)
    n_left = limit
    while data or not parts:
        decompressor = _DECOMPRESSORS[compression]()
        while data or not decompressor.needs_input:
            parts.append(_feed(decompressor, compression, data, n_left + 1))
            n_left -= len(parts[-1])
            if n_left < 0:
                raise DamageError(f"a chunk of {compression} inflates to more than {limit} bytes")
            data = b""
            if decompressor.eof:
                break
        if not decompressor.eof:
            raise DamageError(f"a chunk of {compression} that is cut")
        data = decompressor.unused_data or b""
    return parts[0] if len(parts) == 1 else b"".join(parts)


def inflate_message(data: bytes) -> bytes:
    """Decompress a message that is compressed on its own; return any other unchanged."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    try:
        inflated = inflate(Window(BytesIO(data), 0, len(data)), "zstd")
    except DamageError:
        return data  # the decoder of the message reports it
    return data if inflated.is_cut else inflated.data


def inflate_file(source: Path, target: Path) -> str:
    """Decompress a file of Zstandard frames as far as possible.

    Parameters
    ----------
    source, target : Path

    Returns
    -------
    str
        What is wrong; empty if the file is complete.
    """
    decompressor = zstd.ZstdDecompressor()
    is_whole = False
    with source.open("rb") as packed, target.open("wb") as unpacked:
        while piece := packed.read(_BLOCK):
            while piece or not decompressor.needs_input:
                try:
                    unpacked.write(_feed(decompressor, "zstd", piece, _MAX_STEP))
                except DamageError:
                    return f"it does not inflate after {packed.tell()} bytes"
                is_whole = decompressor.eof
                piece = decompressor.unused_data if is_whole else b""
                if is_whole:
                    decompressor = zstd.ZstdDecompressor()
    return "" if is_whole else "its end is missing"


def _feed(decompressor: Any, compression: str, piece: bytes, limit: int) -> bytes:  # noqa: ANN401
    try:
        return bytes(decompressor.decompress(piece, max_length=limit))
    except _FAULTS as error:
        raise DamageError(f"a chunk of {compression} that does not inflate") from error
