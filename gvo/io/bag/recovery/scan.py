"""Reading a bag without its index: record by record, over what is damaged."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple
from zlib import crc32

from gvo.io.bag.recovery.inflate import DamageError, inflate


class Channel(NamedTuple):
    """A topic of a file and its serialisation."""

    name: str
    type: str
    is_ros1: bool


class FoundMessage(NamedTuple):
    """A message, serialised."""

    topic: Channel
    log_time_ns: int
    data: bytes


class Record(NamedTuple):
    """A message record; its channel may be described later."""

    log_time_ns: int
    channel_id: int
    data: bytes


class Window:
    """A part of a file, read from its start; no memory is taken for bytes that do not exist."""

    def __init__(self, file: BinaryIO, start: int, end: int) -> None:
        self.file, self.position, self.end = file, start, end

    @property
    def rest(self) -> int:
        """The number of remaining bytes."""
        return self.end - self.position

    def skip(self, n_bytes: int) -> None:
        """Skip the next bytes; fewer are damage."""
        if n_bytes > self.rest:
            raise DamageError(f"a record of {n_bytes} bytes is cut after {self.rest}")
        self.position += n_bytes

    def take(self, n_bytes: int) -> bytes:
        """Return the next bytes; fewer are damage."""
        start = self.position
        self.skip(n_bytes)
        self.file.seek(start)
        data = self.file.read(n_bytes)
        if len(data) != n_bytes:
            raise DamageError("the file was shortened while it was read")
        return data

    def number(self, n_bytes: int) -> int:
        """Return the next bytes as an unsigned number, little-endian."""
        return int.from_bytes(self.take(n_bytes), "little")


class Losses:
    """The parts of a file that could not be read: position, number of bytes, reason."""

    def __init__(self) -> None:
        self._places: list[tuple[int, int, str]] = []

    def add(self, position: int, n_bytes: int, reason: str) -> None:
        """Add a part of the file."""
        self._places.append((position, n_bytes, reason))

    def describe(self, n_bytes_file: int, *, until: int | None = None) -> str:
        """Say in one line what is lost before a position; empty if nothing."""
        places = [place for place in self._places if until is None or place[0] < until]
        if not places:
            return ""
        others = f", and {len(places) - 1} more" if len(places) > 1 else ""
        n_bytes = sum(size for _, size, _ in places)
        is_open = any(position + size == n_bytes_file for position, size, _ in places)
        open_end = ", and what came after it is missing" if is_open else ""
        return f"{share(n_bytes, n_bytes_file)} cannot be read ({places[0][2]}{others}){open_end}"


class Scan(ABC):
    """The messages of a file, read record by record.

    Attributes
    ----------
    counts : dict of Channel to int
        The number of messages found.
    start_time_ns, end_time_ns : int
        Of the first and last message, by the time of recording.
    damage : str
        What cannot be read, in one line; empty if nothing.
    """

    magic = b""
    tool = ""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.start_time_ns, self.end_time_ns = 2**63 - 1, 0
        self._channels: dict[int, Channel] = {}
        self._n_bytes = path.stat().st_size
        losses = Losses()
        counts: Counter[int] = Counter()
        for batch in self._batches(losses):
            counts.update(record.channel_id for record in batch)
            log_times_ns = [record.log_time_ns for record in batch]
            self.start_time_ns = min(self.start_time_ns, *log_times_ns)
            self.end_time_ns = max(self.end_time_ns, *log_times_ns)
        self.counts = dict.fromkeys(self._channels.values(), 0)
        for channel_id, count in counts.items():
            if channel_id in self._channels:
                self.counts[self._channels[channel_id]] += count
            else:
                losses.add(0, 0, f"{count} messages of an unknown topic")
        said = self._describe(losses)
        mend = f"copy the file anew, or mend a copy by `{self.tool}`"
        self.damage = f"{path}: {said}; {mend}" if said else ""

    def messages(self, names: Collection[str]) -> Iterator[FoundMessage]:
        """Yield the messages of some topics, in the order of the chunks they are in.

        Messages are sorted by the time of recording within each chunk, which suffices: recorders
        write the chunks nearly in order.
        """
        for batch in self._batches(Losses()):
            for record in sorted(batch, key=lambda record: record.log_time_ns):
                channel = self._channels.get(record.channel_id)
                if channel is not None and channel.name in names:
                    yield FoundMessage(channel, record.log_time_ns, record.data)

    @abstractmethod
    def _step(self, window: Window, losses: Losses) -> list[Record]:
        """Read the next record, or a chunk with all its records."""

    @abstractmethod
    def _read_record(self, window: Window) -> list[Record]:
        """Read the next record of a chunk."""

    @abstractmethod
    def _find_next(self, window: Window, start: int) -> int:
        """Return where to continue after damage: the next chunk, or the end."""

    @abstractmethod
    def _describe(self, losses: Losses) -> str:
        """Say what is lost; empty if nothing."""

    def _batches(self, losses: Losses) -> Iterator[list[Record]]:
        with self.path.open("rb") as file:
            window = Window(file, min(len(self.magic), self._n_bytes), self._n_bytes)
            while window.rest:
                start = window.position
                try:
                    batch = self._step(window, losses)
                except DamageError as error:
                    window.position = self._find_next(window, start + 1)
                    losses.add(start, window.position - start, str(error))
                    continue
                if batch:
                    yield batch

    def _read_chunk(self, content: bytes) -> tuple[list[Record], str, int]:
        """Return the messages of a chunk up to its first damage, the damage, and where it is."""
        window = Window(BytesIO(content), 0, len(content))
        records: list[Record] = []
        start = 0
        try:
            while window.rest:
                start = window.position
                records += self._read_record(window)
        except DamageError as error:
            return records, str(error), start
        return records, "", window.end

    def _read_packed(
        self, window: Window, packed: bytes, compression: str, losses: Losses, limit: int, crc: int
    ) -> list[Record]:
        """Return the messages of a chunk that ends at the window's position."""
        content, behind = (
            inflate(packed, compression, limit=limit) if compression else (packed, b"")
        )
        is_cut = behind is None
        if is_cut and window.rest:
            # Only a chunk at the end of a truncated file may itself be truncated.
            raise DamageError(f"a chunk of {compression} that does not inflate")
        if crc and not is_cut and crc32(content) != crc:
            raise DamageError("a chunk whose checksum does not fit")
        records, reason, n_read = self._read_chunk(content)
        if is_cut:
            reason = f"a chunk is cut after {len(packed)} bytes"
        if reason:
            n_lost = round(len(packed) * (len(content) - n_read) / max(len(content), 1))
            losses.add(window.position - len(packed), n_lost, reason)
        window.position -= len(behind or b"")
        return records


def share(n_bytes: int, n_bytes_all: int) -> str:
    """Return a number of bytes and its percentage of all, as text."""
    percent = 100 * n_bytes / max(n_bytes_all, 1)
    text = f"{percent:.1f}" if percent >= 0.1 or n_bytes == 0 else "less than 0.1"
    return f"{n_bytes} of {n_bytes_all} bytes ({text} %)"


def standard_type(name: str) -> str:
    """Return a type as `package/msg/Name`: ROS 1 and early ROS 2 bags leave out the middle."""
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest}" if rest and "/" not in rest else name
