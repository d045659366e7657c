"""Reading a file record by record, in any format; what is compressed in it."""

from __future__ import annotations

import bz2
import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

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
        self.file, self.position, self.end = file, start, end

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


def inflate(window: Window, compression: str, *, limit: int = MAX_INFLATED) -> tuple[bytes, bool]:
    """Decompress from a window; skip the compressed bytes.

    Parameters
    ----------
    window : Window
    compression : str
        "bz2", "lz4" or "zstd".
    limit : int
        Maximum number of decompressed bytes.

    Returns
    -------
    bytes
        The content, or its start.
    bool
        Whether the compressed data are truncated.

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
                return b"".join(parts), False
    return b"".join(parts), True


def inflate_whole(data: bytes, limit: int | None = None, *, compression: str) -> bytes:
    """Decompress complete data, of one stream or of several in a row.

    Parameters
    ----------
    data : bytes
    limit : int, optional
        Maximum number of decompressed bytes, up to `MAX_INFLATED`.
    compression : str
        "bz2", "lz4" or "zstd".

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
        content, is_cut = inflate(Window(BytesIO(data), 0, len(data)), "zstd")
    except DamageError:
        return data  # the decoder of the message reports it
    return data if is_cut else content


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


class Channel(NamedTuple):
    """A topic of a file and its serialisation."""

    name: str
    type: str
    is_ros1: bool


class FoundMessage(NamedTuple):
    """A message of a file."""

    channel: Channel
    log_time_ns: int
    data: bytes


class Entry(NamedTuple):
    """The place of a message in a file."""

    log_time_ns: int
    channel_id: int
    window: Window
    position: int
    size: int

    def read(self) -> bytes:
        """Return the message's data."""
        return Window(self.window.file, self.position, self.position + self.size).take(self.size)


class Loss(NamedTuple):
    """A part of a file that could not be read."""

    position: int
    n_bytes: int
    reason: str


class Losses:
    """The parts of a file that could not be read."""

    def __init__(self) -> None:
        self._places: list[Loss] = []

    def add(self, position: int, n_bytes: int, reason: str) -> None:
        """Add a part of the file."""
        self._places.append(Loss(position, n_bytes, reason))

    def describe(self, n_bytes_file: int, *, until: int | None = None) -> str:
        """Return in one line what is lost before a position; empty if nothing."""
        places = [loss for loss in self._places if until is None or loss.position < until]
        if not places:
            return ""
        others = f", and {len(places) - 1} more" if len(places) > 1 else ""
        n_bytes = sum(loss.n_bytes for loss in places)
        is_open = any(loss.position + loss.n_bytes == n_bytes_file for loss in places)
        open_end = ", and what came after it is missing" if is_open else ""
        said = f"{places[0].reason}{others}"
        return f"{share(n_bytes, n_bytes_file)} cannot be read ({said}){open_end}"


class Scan(ABC):
    """The messages of a file, read record by record.

    Parameters
    ----------
    path : Path
    """

    tool = ""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.start_time_ns, self.end_time_ns = 2**63 - 1, 0
        self.losses = Losses()
        self._channels: dict[int, Channel] = {}
        self._n_bytes = path.stat().st_size
        counts: Counter[int] = Counter()
        for batch in self._batches(self.losses):
            counts.update(entry.channel_id for entry in batch)
            log_times_ns = [entry.log_time_ns for entry in batch]
            self.start_time_ns = min(self.start_time_ns, *log_times_ns)
            self.end_time_ns = max(self.end_time_ns, *log_times_ns)
        self.counts = self._name(counts)
        self.damage = self._describe_damage()

    def messages(self, names: Collection[str]) -> Iterator[FoundMessage]:
        """Yield the messages of some topics, in the order of the chunks they are in.

        Messages are sorted by the time of recording within each chunk, which suffices: recorders
        write the chunks nearly in order.
        """
        for batch in self._batches(Losses()):
            for entry in sorted(batch, key=attrgetter("log_time_ns")):
                channel = self._channels.get(entry.channel_id)
                if channel is not None and channel.name in names:
                    yield FoundMessage(channel, entry.log_time_ns, entry.read())

    @abstractmethod
    def _step(self, window: Window, losses: Losses) -> list[Entry]:
        """Read the next record, or a chunk with all its records."""

    @abstractmethod
    def _read_inner(self, window: Window, entries: list[Entry]) -> None:
        """Read the next record of a chunk."""

    @abstractmethod
    def _find_record(self, window: Window, start: int) -> int:
        """Return where to continue after damage: the next chunk, or the end."""

    @abstractmethod
    def _describe_damage(self) -> str:
        """Return what is lost; empty if nothing."""

    def _batches(self, losses: Losses) -> Iterator[list[Entry]]:
        with self.path.open("rb") as file:
            window = Window(file, 0, self._n_bytes)
            while window.rest:
                start = window.position
                try:
                    batch = self._step(window, losses)
                except DamageError as error:
                    window.position = self._find_record(window, start + 1)
                    losses.add(start, window.position - start, str(error))
                    continue
                if batch:
                    yield batch

    def _read_chunk(self, window: Window) -> tuple[list[Entry], str]:
        """Return the messages of a chunk up to its first damage, and the damage."""
        entries: list[Entry] = []
        while window.rest:
            start = window.position
            try:
                self._read_inner(window, entries)
            except DamageError as error:
                window.position = start
                return entries, str(error)
        return entries, ""

    def _read_inflated(
        self, part: Window, compression: str, losses: Losses, *, limit: int, crc: int = 0
    ) -> list[Entry]:
        """Return the messages of a compressed chunk; skip its compressed bytes."""
        start = part.position
        content, is_cut = inflate(part, compression, limit=limit)
        if is_cut and part.end < self._n_bytes:
            # Only a chunk at the end of a truncated file may itself be truncated.
            raise DamageError(f"a chunk of {compression} that does not inflate")
        if crc and not is_cut and crc32(content) != crc:
            raise DamageError("a chunk whose checksum does not fit")
        n_bytes = len(content)
        inner = Window(BytesIO(content), 0, n_bytes)
        entries, reason = self._read_chunk(inner)
        if is_cut:
            reason = f"a chunk is cut after {part.position - start} bytes"
        if reason:
            n_lost = round((part.position - start) * inner.rest / max(n_bytes, 1))
            losses.add(start, n_lost, reason)
        return entries

    def _name(self, counts: Counter[int]) -> dict[Channel, int]:
        named = dict.fromkeys(self._channels.values(), 0)
        for channel_id, count in counts.items():
            if channel_id in self._channels:
                named[self._channels[channel_id]] += count
            else:
                self.losses.add(0, 0, f"{count} messages of an unknown topic")
        return named

    def _damage_of(self, *texts: str) -> str:
        said = "; ".join(text for text in texts if text)
        if not said:
            return ""
        return f"{self.path}: {said}; copy the file anew, or mend a copy by `{self.tool}`"


def share(n_bytes: int, n_bytes_all: int) -> str:
    """Return a number of bytes and its percentage of all, as text."""
    percent = 100 * n_bytes / max(n_bytes_all, 1)
    text = f"{percent:.1f}" if percent >= 0.1 or n_bytes == 0 else "less than 0.1"
    return f"{n_bytes} of {n_bytes_all} bytes ({text} %)"


def standard_type(name: str) -> str:
    """Return a type as `package/msg/Name`: ROS 1 and early ROS 2 bags leave out the middle."""
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest}" if rest and "/" not in rest else name
