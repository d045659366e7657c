"""Bags of ROS 1 (format 2.0) without their index.

References
----------
.. [1] ROS wiki, Bags/Format/2.0.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from gvo.io.bag.recovery.inflate import MAX_INFLATED, DamageError
from gvo.io.bag.recovery.scan import Channel, Losses, Record, Scan, Window, share, standard_type

_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = range(2, 8)
_MAX_HEADER = 1 << 16
_CHUNK_MARK = b"\x04\x00\x00\x00op=\x05"
_CHUNK_HEADER = 64  # bytes; maximum distance of the mark from the start of a chunk
_SEARCH_BLOCK = 1 << 20


class _Head(NamedTuple):
    fields: dict[bytes, bytes]
    size: int

    @property
    def op(self) -> int:
        return self.number(b"op")

    @property
    def compression(self) -> str:
        return self.text(b"compression")

    def number(self, name: bytes) -> int:
        if name not in self.fields:
            raise DamageError(f"a record without {name.decode()}")
        return int.from_bytes(self.fields[name], "little")

    def text(self, name: bytes) -> str:
        return self.fields.get(name, b"").decode(errors="replace")


class Ros1Scan(Scan):
    """The messages of a ROS 1 bag, read record by record."""

    magic = b"#ROSBAG V2.0\n"
    tool = "rosbag reindex"

    def __init__(self, path: Path) -> None:
        self._index_position = 0
        self._n_chunks_announced = 0
        self._whole_chunks: dict[int, int] = {}  # start: end
        super().__init__(path)

    def _step(self, window: Window, losses: Losses) -> list[Record]:
        start = window.position
        head = _read_head(window)
        if head.op == _BAG:
            self._index_position = head.number(b"index_pos")
            self._n_chunks_announced = head.number(b"chunk_count")
        elif head.op == _CHUNK and not 0 < head.size <= window.rest:
            return self._read_open_chunk(window, head, losses)
        elif head.op == _CHUNK:
            end = window.position + head.size
            records = self._read_whole_chunk(window, head, losses)
            self._whole_chunks[start] = end
            return records
        else:
            return self._read(head, window)
        window.skip(head.size)
        return []

    def _read_whole_chunk(self, window: Window, head: _Head, losses: Losses) -> list[Record]:
        start = window.position
        if head.size > MAX_INFLATED:
            raise DamageError(f"a chunk that claims {head.size} bytes")
        content = window.take(head.size)
        if head.compression != "none":
            limit = head.number(b"size")
            return self._read_packed(window, content, head.compression, losses, limit, 0)
        records, reason, n_read = self._read_chunk(content)
        if reason:
            # If the size is wrong, it holds other chunks.
            part = Window(window.file, start, window.position)
            window.position = self._find_next(part, start + n_read + 1)
            losses.add(start + n_read, window.position - start - n_read, reason)
        return records

    def _read_open_chunk(self, window: Window, head: _Head, losses: Losses) -> list[Record]:
        """Read a chunk that was never closed, and has no size, or is truncated."""
        if head.compression == "none":
            if head.size:
                reason = f"a chunk of {head.size} bytes is cut after {window.rest}"
                losses.add(window.position, 0, reason)
            return []  # its records are read as records outside a chunk
        limit = head.number(b"size") or MAX_INFLATED
        packed = window.take(min(window.rest, MAX_INFLATED))
        return self._read_packed(window, packed, head.compression, losses, limit, 0)

    def _read_record(self, window: Window) -> list[Record]:
        return self._read(_read_head(window), window)

    def _read(self, head: _Head, window: Window) -> list[Record]:
        if head.op == _MESSAGE:
            nanoseconds, seconds = divmod(head.number(b"time"), 2**32)
            log_time_ns = seconds * 10**9 + nanoseconds
            return [Record(log_time_ns, head.number(b"conn"), window.take(head.size))]
        if head.op == _CONNECTION:
            header = _Head(_fields_of(window.take(head.size)), 0)
            type_ = standard_type(header.text(b"type"))
            channel = Channel(_clean(head.text(b"topic")), type_, is_ros1=True)
            self._channels.setdefault(head.number(b"conn"), channel)
        elif head.op == _INDEX:
            # Other readers use the count; some recorders wrote another size.
            window.skip(12 * head.number(b"count"))
        elif head.op == _CHUNK_INFO:
            window.skip(head.size)
        else:
            raise DamageError(f"a record of unknown kind {head.op}")
        return []

    def _find_next(self, window: Window, start: int) -> int:
        for mark in _find(_CHUNK_MARK, Window(window.file, start, window.end)):
            for position in range(mark - 4, max(mark - _CHUNK_HEADER, start) - 1, -1):
                if _is_chunk(Window(window.file, position, window.end)):
                    return position
        return window.end

    def _describe(self, losses: Losses) -> str:
        n_whole, n_announced = len(self._whole_chunks), self._n_chunks_announced
        if n_whole >= n_announced > 0:  # the rest is the index
            return losses.describe(self._n_bytes, until=max(self._whole_chunks.values()))
        n_missing = self._index_position - self._n_bytes
        missing = (
            f"at least {share(n_missing, self._index_position)} are missing at its end: "
            f"{n_whole} of {n_announced} chunks are whole"
        )
        said = (missing if n_missing > 0 else "", losses.describe(self._n_bytes))
        return "; ".join(text for text in said if text)


def _read_head(window: Window) -> _Head:
    """Return the header of a record; leave the window at its data."""
    size = window.number(4)
    if size > _MAX_HEADER:
        raise DamageError(f"a record with a header of {size} bytes")
    return _Head(_fields_of(window.take(size)), window.number(4))


def _fields_of(data: bytes) -> dict[bytes, bytes]:
    fields: dict[bytes, bytes] = {}
    position = 0
    while position < len(data):
        end = position + 4 + int.from_bytes(data[position : position + 4], "little")
        name, separator, value = data[position + 4 : end].partition(b"=")
        if end > len(data) or not separator:
            raise DamageError("a record with an invalid header")
        fields[name] = value
        position = end
    return fields


def _find(pattern: bytes, window: Window) -> Iterator[int]:
    """Yield the positions of a pattern."""
    tail = b""
    while window.rest:
        data = tail + window.take(min(_SEARCH_BLOCK, window.rest))
        base = window.position - len(data)
        found = data.find(pattern)
        while found >= 0:
            yield base + found
            found = data.find(pattern, found + 1)
        tail = data[len(data) - len(pattern) + 1 :]


def _is_chunk(window: Window) -> bool:
    try:
        head = _read_head(window)
        return head.op == _CHUNK and bool(head.compression)
    except DamageError:
        return False


def _clean(name: str) -> str:
    """Return a topic's name without doubled slashes."""
    return "/" * name.startswith("/") + "/".join(part for part in name.split("/") if part)
