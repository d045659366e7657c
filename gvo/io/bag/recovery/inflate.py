"""Decompression into bounded memory: a thousand bytes can become gigabytes."""

from __future__ import annotations

import bz2
import sys
from pathlib import Path
from typing import Any

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_INFLATED = 1 << 29
"""Bytes of a chunk; recorders write about one megabyte."""

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # no CDR message begins so
_BLOCK = 1 << 16
_MAX_STEP = 1 << 24
_DECOMPRESSORS: dict[str, Any] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}
_FAULTS = (OSError, RuntimeError, EOFError, ValueError, zstd.ZstdError)


class DamageError(Exception):
    """A part of a file is invalid; the reader skips it."""


def inflate(
    data: bytes, compression: str, *, limit: int = MAX_INFLATED
) -> tuple[bytes, bytes | None]:
    """Decompress the first stream in some data, into at most `limit` bytes.

    Return the content, and what follows the stream: None where it is truncated.
    """
    if compression not in _DECOMPRESSORS:
        raise DamageError(f"a chunk of unknown compression {compression!r}")
    if limit > MAX_INFLATED:
        raise DamageError(f"a chunk that claims {limit} bytes")
    decompressor = _DECOMPRESSORS[compression]()
    parts: list[bytes] = []
    n_left = limit
    while (data or not decompressor.needs_input) and not decompressor.eof:
        parts.append(_feed(decompressor, compression, data, n_left + 1))
        data = b""
        n_left -= len(parts[-1])
        if n_left < 0:
            raise DamageError(f"a chunk of {compression} inflates to more than {limit} bytes")
    rest = bytes(decompressor.unused_data or b"") if decompressor.eof else None
    return b"".join(parts), rest


def inflate_whole(data: bytes, limit: int | None = None, *, compression: str) -> bytes:
    """Decompress one stream or several in a row, as `inflate`; truncated ones are damage."""
    limit = MAX_INFLATED if limit is None else min(limit, MAX_INFLATED)
    content, rest = inflate(data, compression, limit=limit)
    while rest:
        more, rest = inflate(rest, compression, limit=limit - len(content))
        content += more
    if rest is None:
        raise DamageError(f"a chunk of {compression} is cut")
    return content


def inflate_message(data: bytes) -> bytes:
    """Decompress a message that is compressed on its own; return any other unchanged."""
    if not data.startswith(_ZSTD_MAGIC):
        return data
    try:
        content, rest = inflate(data, "zstd")
    except DamageError:
        return data  # the decoder of the message reports it
    return data if rest is None else content


def inflate_file(source: Path, target: Path) -> str:
    """Decompress a Zstandard file as far as possible; return what is wrong, empty if nothing."""
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
    return "" if is_whole else "its zstd stream ends early"


def _feed(decompressor: Any, compression: str, piece: bytes, limit: int) -> bytes:  # noqa: ANN401
    try:
        return bytes(decompressor.decompress(piece, max_length=limit))
    except _FAULTS as error:
        raise DamageError(f"a chunk of {compression} that does not inflate") from error
