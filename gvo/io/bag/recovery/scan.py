"""Reading a file record by record, in any format."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

from gvo.io.bag.recovery.inflate import DamageError, Window, inflate


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
        inflated = inflate(part, compression, limit=limit)
        if inflated.is_cut and part.end < self._n_bytes:
            # Only a chunk at the end of a truncated file may itself be truncated.
            raise DamageError(f"a chunk of {compression} that does not inflate")
        if crc and not inflated.is_cut and crc32(inflated.data) != crc:
            raise DamageError("a chunk whose checksum does not fit")
        n_bytes = len(inflated.data)
        inner = Window(BytesIO(inflated.data), 0, n_bytes)
        entries, reason = self._read_chunk(inner)
        if inflated.is_cut:
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
