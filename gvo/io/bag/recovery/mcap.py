"""MCAP files without their summary, by the `mcap` package.

Its `StreamReader` stops at the first damage and drops a truncated chunk, and its chunks inflate
without bound: only its records are used.

References
----------
.. [1] MCAP Format Specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, ChunkIndex, Footer, McapRecord, Message, Schema

from gvo.io.bag.recovery.inflate import MAX_INFLATED, DamageError
from gvo.io.bag.recovery.scan import Channel, Losses, Record, Scan, Window, standard_type

_MAGIC = b"\x89MCAP0\r\n"


class _ChannelHead(ChannelRecord):
    """A channel read without its metadata, which nobody needs and which may be damaged."""

    @staticmethod
    def read(stream: ReadDataStream) -> ChannelRecord:
        number, schema = stream.read2(), stream.read2()
        topic, encoding = stream.read_prefixed_string(), stream.read_prefixed_string()
        return ChannelRecord(
            id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=schema
        )


_KINDS: dict[int, Any] = {
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: _ChannelHead,
    Opcode.MESSAGE: Message,
    Opcode.CHUNK_INDEX: ChunkIndex,
}
_RESERVED = range(0x10, 0x80)  # mean nothing yet
_N_FOOTER = 9 + 20 + len(_MAGIC)  # bytes, with the magic at the end


class McapScan(Scan):
    """The messages of an MCAP file, read record by record."""

    magic = _MAGIC
    tool = "mcap recover"

    def __init__(self, path: Path) -> None:
        self._types: dict[int, str] = {}
        self._data_end: int | None = None
        self._places: list[int] | None = None
        super().__init__(path)

    def _step(self, window: Window, losses: Losses) -> list[Record]:
        start = window.position
        op, size = _read_head(window)
        if op == Opcode.CHUNK:
            return self._read_any_chunk(window, size, losses)
        if op == Opcode.DATA_END:
            self._data_end = start
        records = self._take(_read_content(window, op, size))
        if op == Opcode.FOOTER:
            window.position = window.end
        return records

    def _read_record(self, window: Window) -> list[Record]:
        op, size = _read_head(window)
        if op == Opcode.CHUNK:
            raise DamageError("a chunk in a chunk")
        return self._take(_read_content(window, op, size))

    def _take(self, record: McapRecord | None) -> list[Record]:
        if isinstance(record, Message):
            return [Record(record.log_time, record.channel_id, record.data)]
        if isinstance(record, Schema):
            self._types[record.id] = standard_type(record.name)
        elif isinstance(record, ChannelRecord):
            type_ = self._types.get(record.schema_id, "")
            channel = Channel(record.topic, type_, is_ros1=record.message_encoding == "ros1")
            self._channels.setdefault(record.id, channel)
        return []

    def _read_any_chunk(self, window: Window, size: int, losses: Losses) -> list[Record]:
        start = window.position
        if size > window.rest:
            return self._read_cut_chunk(window, losses)
        record = Window(window.file, start, start + size)
        window.skip(size)
        try:
            chunk, _ = _read_chunk_record(record)
            return self._read_messages(window, chunk, losses)
        except DamageError as error:
            # If the size is wrong, it holds other chunks.
            window.position = self._find_next(record, start + 1)
            losses.add(start, window.position - start, str(error))
            return []

    def _read_cut_chunk(self, window: Window, losses: Losses) -> list[Record]:
        """Read a chunk that is truncated, or whose size is wrong."""
        start = window.position
        chunk, n_read = _read_chunk_record(window)
        window.position = start + n_read
        if window.rest or chunk.compression:
            records = self._read_messages(window, chunk, losses)
            window.position = start + n_read
            return records
        # The records of a truncated chunk are read as records outside a chunk.
        window.position -= len(chunk.data)
        losses.add(window.position, 0, f"a chunk is cut after {len(chunk.data)} bytes")
        return []

    def _read_messages(self, window: Window, chunk: Chunk, losses: Losses) -> list[Record]:
        limit, crc = chunk.uncompressed_size, chunk.uncompressed_crc
        return self._read_packed(window, chunk.data, chunk.compression, losses, limit, crc)

    def _find_next(self, window: Window, start: int) -> int:
        """Return where to read on after damage: at the next chunk that the summary names."""
        if self._places is None:
            self._places = sorted(_places_of_summary(window))
        index = bisect_left(self._places, start)
        return min([*self._places[index : index + 1], window.end])

    def _describe(self, losses: Losses) -> str:
        return losses.describe(self._n_bytes, until=self._data_end)


def _read_head(window: Window) -> tuple[int, int]:
    op, size = struct.unpack("<BQ", window.take(9))
    if op == 0 or op in _RESERVED:
        raise DamageError(f"a record of unknown kind {op}")
    return op, size


def _read_content(window: Window, op: int, size: int) -> McapRecord | None:
    if op not in _KINDS:
        window.skip(size)
        return None
    stream = ReadDataStream(BytesIO(window.take(size)))
    sizes = (size,) if op == Opcode.MESSAGE else ()
    record: McapRecord = _parse(_KINDS[op], stream, *sizes)
    return record


def _read_chunk_record(window: Window) -> tuple[Chunk, int]:
    """Return a chunk, and how many bytes of it were read."""
    stream = ReadDataStream(BytesIO(window.take(min(window.rest, MAX_INFLATED))))
    return _parse(Chunk, stream), stream.count


def _parse(kind: Any, stream: ReadDataStream, *size: int) -> Any:  # noqa: ANN401
    try:
        return kind.read(stream, *size)
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise DamageError(f"a malformed {kind.__name__}") from error


def _places_of_summary(whole: Window) -> list[int]:
    """Return the offsets of the chunks, as the summary lists them, and of the summary."""
    places: list[int] = []
    window = Window(whole.file, max(whole.end - _N_FOOTER, 0), whole.end)
    try:
        footer = _read_content(window, *_read_head(window))
        if isinstance(footer, Footer) and footer.summary_start:
            places.append(footer.summary_start)
            window.position = footer.summary_start
            while not isinstance(record := _read_content(window, *_read_head(window)), Footer):
                if isinstance(record, ChunkIndex):
                    places.append(record.chunk_start_offset)
    except DamageError:
        pass
    return places
