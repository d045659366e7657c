"""Read bags of ROS 1 (format 2.0) without their index.

References
----------
.. [1] ROS wiki, Bags/Format/2.0.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from gvo.io.bag.recovery.scan import (
    MAX_INFLATED,
    Channel,
    DamageError,
    Entry,
    Losses,
    Scan,
    Window,
    share,
    standard_type,
)

MAGIC = b"#ROSBAG V2.0\n"

_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = range(2, 8)
_INDEX_OPS = (_INDEX, _CHUNK_INFO)
_MAX_HEADER = 1 << 16
_CHUNK_MARK = b"\x04\x00\x00\x00op=\x05"
_CHUNK_HEADER = 64  # bytes; maximum distance of the mark from the start of a chunk


class _Record(NamedTuple):
    fields: dict[bytes, bytes]
    size: int

    @property
    def op(self) -> int:
        return self.number(b"op")

    @property
    def compression(self) -> str:
        return self.fields.get(b"compression", b"").decode(errors="replace")

    def number(self, name: bytes) -> int:
        if name not in self.fields:
            raise DamageError(f"a record without {name.decode()}")
        return int.from_bytes(self.fields[name], "little")


class Ros1Scan(Scan):
    """The messages of a ROS 1 bag, read record by record.

    Parameters
    ----------
    path : Path
    """

    tool = "rosbag reindex"

    def __init__(self, path: Path) -> None:
        self._index_position = 0
        self._n_chunks_announced = 0
        self._whole_chunks: dict[int, int] = {}  # start: end
        super().__init__(path)

    def _step(self, window: Window, losses: Losses) -> list[Entry]:
        if window.position == 0:
            window.skip(len(MAGIC))
        entries: list[Entry] = []
        start = window.position
        record = _read_record(window)
        if record.op == _CHUNK and 0 < record.size <= window.rest:
            end = window.position + record.size
            entries = self._read_whole_chunk(window, record, losses)
            self._whole_chunks[start] = end
        elif record.op == _CHUNK:
            entries = self._read_open_chunk(window, record, losses)
        elif record.op == _BAG:
            self._index_position = record.number(b"index_pos")
            self._n_chunks_announced = record.number(b"chunk_count")
            window.skip(record.size)
        else:
            self._read(record, window, entries)
        return entries

    def _read_whole_chunk(self, window: Window, record: _Record, losses: Losses) -> list[Entry]:
        if record.compression != "none":
            part = Window(window.file, window.position, window.position + record.size)
            limit = record.number(b"size")
            entries = self._read_inflated(part, record.compression, losses, limit=limit)
            window.position = part.position
            return entries
        part = window.part(record.size)
        entries, reason = self._read_chunk(part)
        if reason:
            # If the size is wrong, it holds other chunks.
            window.position = self._find_record(part, part.position + 1)
            losses.add(part.position, window.position - part.position, reason)
        return entries

    def _read_open_chunk(self, window: Window, record: _Record, losses: Losses) -> list[Entry]:
        """Read a chunk that was never closed, and has no size, or is truncated."""
        if record.compression == "none":
            if record.size:
                reason = f"a chunk of {record.size} bytes is cut after {window.rest}"
                losses.add(window.position, 0, reason)
            return []  # its records are read as records outside a chunk
        limit = record.number(b"size") or MAX_INFLATED
        return self._read_inflated(window, record.compression, losses, limit=limit)

    def _read_inner(self, window: Window, entries: list[Entry]) -> None:
        self._read(_read_record(window), window, entries)

    def _read(self, record: _Record, window: Window, entries: list[Entry]) -> None:
        size = record.size
        if record.op == _MESSAGE:
            nanoseconds, seconds = divmod(record.number(b"time"), 2**32)
            log_time_ns = seconds * 10**9 + nanoseconds
            channel_id = record.number(b"conn")
            position = window.position
            window.skip(size)
            entries.append(Entry(log_time_ns, channel_id, window, position, size))
        elif record.op == _CONNECTION:
            self._connect(record, window)
        elif record.op in _INDEX_OPS:
            # Other readers use the count; some recorders wrote another size.
            size = 12 * record.number(b"count") if record.op == _INDEX else size
            window.skip(size)
        else:
            raise DamageError(f"a record of unknown kind {record.op}")

    def _connect(self, record: _Record, window: Window) -> None:
        header = _fields_of(window.take(record.size))
        name = record.fields.get(b"topic", b"").decode(errors="replace")
        type_ = header.get(b"type", b"").decode(errors="replace")
        channel = Channel(_clean(name), standard_type(type_), is_ros1=True)
        self._channels.setdefault(record.number(b"conn"), channel)

    def _find_record(self, window: Window, start: int) -> int:
        for mark in window.find(_CHUNK_MARK, start):
            for position in range(mark - 4, max(mark - _CHUNK_HEADER, start) - 1, -1):
                if _is_chunk(Window(window.file, position, window.end)):
                    return position
        return window.end

    def _describe_damage(self) -> str:
        n_whole, n_announced = len(self._whole_chunks), self._n_chunks_announced
        if n_whole >= n_announced > 0:  # the rest is the index
            last = max(self._whole_chunks.values())
            return self._damage_of(self.losses.describe(self._n_bytes, until=last))
        n_missing = self._index_position - self._n_bytes
        missing = (
            f"at least {share(n_missing, self._index_position)} are missing at its end: "
            f"{n_whole} of {n_announced} chunks are whole"
        )
        lost = self.losses.describe(self._n_bytes)
        return self._damage_of(missing if n_missing > 0 else "", lost)


def _read_record(window: Window) -> _Record:
    """Return the header of a record; leave the window at its data."""
    size = window.number(4)
    if size > _MAX_HEADER:
        raise DamageError(f"a record with a header of {size} bytes")
    return _Record(_fields_of(window.take(size)), window.number(4))


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


def _is_chunk(window: Window) -> bool:
    try:
        record = _read_record(window)
        return record.op == _CHUNK and bool(record.compression)
    except DamageError:
        return False


def _clean(name: str) -> str:
    """Return a topic's name without doubled slashes."""
    return "/" * name.startswith("/") + "/".join(part for part in name.split("/") if part)
