"""Read MCAP files without their summary.

References
----------
.. [1] MCAP Format Specification, https://mcap.dev/spec.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias
from zlib import crc32

from gvo.io.bag.recovery.scan import (
    Channel,
    DamageError,
    Entry,
    Losses,
    Scan,
    Window,
    standard_type,
)

MAGIC = b"\x89MCAP0\r\n"

_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _, _CHUNK_INDEX = range(1, 9)
_DATA_END = 0x0F
_RESERVED = 0x10  # the first one that means nothing yet
_PRIVATE = 0x80
_N_FOOTER = 37  # bytes, with the magic at the end

_RecordHead: TypeAlias = tuple[int, int]  # kind, size


class McapScan(Scan):
    """The messages of an MCAP file, read record by record.

    Parameters
    ----------
    path : Path
    """

    tool = "mcap recover"

    def __init__(self, path: Path) -> None:
        self._types: dict[int, str] = {}
        self._data_end: int | None = None
        self._places: list[int] | None = None
        super().__init__(path)

    def _step(self, window: Window, losses: Losses) -> list[Entry]:
        if window.position == 0:
            window.skip(len(MAGIC))
        entries: list[Entry] = []
        start = window.position
        op, size = _read_record(window)
        if op == _CHUNK:
            entries = self._read_any_chunk(window, size, losses)
        elif op == _FOOTER:
            window.position = window.end
        else:
            self._read(op, window.part(size), entries)
            if op == _DATA_END:
                self._data_end = start
        return entries

    def _read_any_chunk(self, window: Window, size: int, losses: Losses) -> list[Entry]:
        start, end = window.position, min(window.position + size, window.end)
        is_whole = start + size == end
        record = Window(window.file, start, end)
        try:
            entries = self._read_content(record, losses, is_whole=is_whole)
        except DamageError as error:
            if not is_whole:
                raise
            window.position = self._find_record(record, start + 1)
            losses.add(start, window.position - start, str(error))
            return []
        window.position = end if is_whole else record.position
        return entries

    def _read_content(self, record: Window, losses: Losses, *, is_whole: bool) -> list[Entry]:
        """Return the messages of a chunk; leave the window at the end of a truncated one."""
        record.skip(16)  # the times of its messages
        limit, crc = record.number(8), record.number(4)
        compression = _text(record)
        n_bytes = record.number(8)
        is_cut = n_bytes > record.rest
        part = Window(record.file, record.position, record.position + min(n_bytes, record.rest))
        if compression:
            entries = self._read_inflated(part, compression, losses, limit=limit, crc=crc)
        else:
            if crc and not is_cut:
                _check(part, crc)
            entries, reason = self._read_chunk(part)
            if reason or is_cut:
                reason = f"a chunk of {n_bytes} bytes is cut" if is_cut else reason
                # The rest of a truncated chunk is read as records outside a chunk.
                losses.add(part.position, part.rest if is_whole else 0, reason)
        record.position = part.position
        return entries

    def _read_inner(self, window: Window, entries: list[Entry]) -> None:
        op, size = _read_record(window)
        self._read(op, window.part(size), entries)

    def _read(self, op: int, part: Window, entries: list[Entry]) -> None:
        if op == _MESSAGE:
            channel_id = part.number(2)
            part.skip(4)  # its number among those of the channel
            log_time_ns = part.number(8)
            part.skip(8)  # when it was published
            entries.append(Entry(log_time_ns, channel_id, part, part.position, part.rest))
        elif op == _SCHEMA:
            schema_id = part.number(2)
            self._types[schema_id] = standard_type(_text(part))
        elif op == _CHANNEL:
            channel_id, schema_id = part.number(2), part.number(2)
            name, encoding = _text(part), _text(part)
            channel = Channel(name, self._types.get(schema_id, ""), is_ros1=encoding == "ros1")
            self._channels.setdefault(channel_id, channel)
        elif op == _CHUNK:
            raise DamageError("a chunk in a chunk")

    def _find_record(self, window: Window, start: int) -> int:
        """Return the next place that the summary names, if it exists: records have no mark."""
        if self._places is None:
            self._places = sorted(_places_of_summary(Window(window.file, 0, self._n_bytes)))
        index = bisect_left(self._places, start)
        return min([*self._places[index : index + 1], window.end])

    def _describe_damage(self) -> str:
        return self._damage_of(self.losses.describe(self._n_bytes, until=self._data_end))


def _read_record(window: Window) -> _RecordHead:
    """Return kind and size of a record; leave the window at its content."""
    op = window.number(1)
    size = window.number(8)
    if not 0 < op < _RESERVED and op < _PRIVATE:
        raise DamageError(f"a record of unknown kind {op}")
    if size > window.rest and op != _CHUNK:
        raise DamageError(f"a record of {size} bytes is cut after {window.rest}")
    return op, size


def _text(window: Window) -> str:
    return window.take(window.number(4)).decode(errors="replace")


def _check(part: Window, crc: int) -> None:
    found = 0
    for block in Window(part.file, part.position, part.end).blocks():
        found = crc32(block, found)
    if found != crc:
        raise DamageError("a chunk whose checksum does not fit")


def _places_of_summary(window: Window) -> Iterator[int]:
    """Yield the places of the chunks, as the summary says, and of the summary."""
    if window.rest < _N_FOOTER:
        return
    try:
        window.skip(window.rest - _N_FOOTER)
        if _read_record(window) != (_FOOTER, _N_FOOTER - 9 - len(MAGIC)):
            return
        start = window.number(8)
        window.position = start
        while start:
            op, size = _read_record(window)
            if op == _FOOTER:
                yield start
                return
            record = window.part(size)
            if op == _CHUNK_INDEX:
                record.skip(16)
                yield record.number(8)
    except DamageError:
        return
