"""One bag file, read by rosbags; a ROS 1 or MCAP file that rosbags refuses, record by record.

rosbags' readers are used without its `AnyReader`, which parses the definitions of all message
types: one foreign type that it cannot parse would block the camera's topics.
"""

from __future__ import annotations

import os
import struct
from array import array
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TypeAlias
from urllib.parse import quote

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import ReaderError as ReaderError1
from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as ReaderError2
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS, McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.serde import SerdeError

from gvo.errors import RecordingError
from gvo.io.bag.recovery.inflate import DamageError, inflate_message, inflate_whole
from gvo.io.bag.recovery.mcap import McapScan
from gvo.io.bag.recovery.ros1 import Ros1Scan
from gvo.io.bag.recovery.scan import Channel, FoundMessage, Scan, standard_type

_Reader: TypeAlias = Reader1 | Reader2
_NO_SCHEMA = "__schemaless__"  # as rosbags calls the type of a channel whose schema it did not see
_SCANS: dict[str, type[Scan]] = {".bag": Ros1Scan, ".mcap": McapScan}
_MAGICS = {
    ".bag": (Ros1Scan.magic, "a ROS 1 bag"),
    ".mcap": (McapScan.magic, "an MCAP file"),
    ".db3": (b"SQLite format 3\0", "an SQLite database"),
}


def _storage_faults() -> Iterator[type[Exception]]:
    """Yield the errors of the libraries that rosbags may read SQLite and Zstandard with."""
    for module, name in (
        ("apsw", "Error"),
        ("compression.zstd", "ZstdError"),
        ("backports.zstd", "ZstdError"),
    ):
        with suppress(ImportError):
            yield getattr(import_module(module), name)


# The readers check the structure of a file by assertions and by what happens to fail; a damaged
# size ends in a MemoryError.
FAULTS: tuple[type[Exception], ...] = (
    *(ReaderError1, ReaderError2, SerdeError, struct.error),
    *(AssertionError, LookupError, ValueError, TypeError, AttributeError, OverflowError),
    *(EOFError, OSError, RuntimeError, MemoryError),
    *_storage_faults(),
)
"""What rosbags raises where a file or a message is not what it should be."""


DAMAGE: tuple[type[Exception], ...] = (DamageError, *FAULTS)
"""What is raised where a file is damaged."""


class BagFile:
    """A `.bag`, `.mcap` or `.db3` file.

    Attributes
    ----------
    counts : dict of Channel to int
        The number of messages that are announced.
    start_time_ns, end_time_ns : int
        Of the first and last message, by the time of recording.
    note : str
        What was decided, in one line; empty if nothing.

    Raises
    ------
    RecordingError
        When no message of it can be read, with what to do.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.note = ""
        self._scan: Scan | None = None
        self._fault = _unread_log(path)
        try:
            with self._opened() as reader:
                self.counts = _counts(reader)
                self.start_time_ns, self.end_time_ns = reader.start_time, reader.end_time
        except DAMAGE as error:
            self._scan = scan = _scan(path, error)
            self.counts = scan.counts
            self.start_time_ns, self.end_time_ns = scan.start_time_ns, scan.end_time_ns
            if not scan.damage:
                self.note = _describe_missing_index(path, error, scan.tool)

    @property
    def damage(self) -> str:
        """What cannot be read, in one line; complete when all messages were read."""
        lost = "" if self._scan is None else self._scan.damage
        return "; ".join(text for text in (self._fault, lost) if text)

    def messages(self, names: Collection[str]) -> Iterator[FoundMessage]:
        """Yield the messages of some topics, nearly in the order of recording.

        Where rosbags cannot go on, the rest of a ROS 1 or MCAP file is read record by record; of
        a database it is lost, and `damage` says so.
        """
        # Of the messages of one topic and time only their number matters: they come in one order.
        seen: dict[Channel, array[int]] = defaultdict(partial(array, "Q"))
        try:
            if self._scan is None:
                for message in self._indexed(names):
                    seen[message.topic].append(message.log_time_ns % 2**64)
                    yield message
                self._check_number(sum(map(len, seen.values())), names)
                return
        except DAMAGE as error:
            try:
                self._scan = _scan(self.path, error)
            except RecordingError as refusal:
                self._fault = str(refusal)
                return
        try:
            yield from self._unseen(self._scan.messages(names), seen)
        except DAMAGE as error:  # as of a file that is shortened meanwhile
            self._fault = f"{self.path}: cannot be read on ({_one_line(error)})"

    def _unseen(
        self, messages: Iterable[FoundMessage], seen: Mapping[Channel, Iterable[int]]
    ) -> Iterator[FoundMessage]:
        counts = {channel: Counter(log_times) for channel, log_times in seen.items()}
        for message in messages:
            if message.topic not in self.counts:
                self._fault = f"{self.path}: messages of a damaged topic are left out"
                continue
            log_time = message.log_time_ns % 2**64
            if counts.get(message.topic, Counter())[log_time] > 0:
                counts[message.topic][log_time] -= 1
            else:
                yield message

    def _check_number(self, n_messages: int, names: Collection[str]) -> None:
        """Check what rosbags read: it skips some damage silently."""
        n_announced = sum(n for channel, n in self.counts.items() if channel.name in names)
        if n_messages < n_announced:
            raise DamageError(f"{n_messages} of {n_announced} messages were found")

    def _indexed(self, names: Collection[str]) -> Iterator[FoundMessage]:
        with self._opened() as reader:
            connections = [c for c in reader.connections if c.topic in names]
            channels = {c.id: _channel(c, reader) for c in connections}
            is_ros1 = isinstance(reader, Reader1)
            # Without any, rosbags would yield all.
            messages = reader.messages(connections=connections) if connections else ()
            for connection, log_time_ns, data in messages:
                if not isinstance(log_time_ns, int) or not isinstance(data, bytes):
                    raise TypeError("a row of the database is not a message")
                content = data if is_ros1 else inflate_message(data)
                yield FoundMessage(channels[connection.id], log_time_ns, content)

    def _opened(self) -> _Reader:
        if self.path.suffix == ".bag":
            return Reader1(self.path)
        reader = Reader2(self.path)
        if self.path.suffix == ".db3":
            if _announced_size(self.path) > self.path.stat().st_size:
                # SQLite fills the last page with zeros, of which rosbags makes messages.
                raise DamageError("the file is shorter than it says")
            # rosbags makes a URI of the path without quoting it.
            reader.storage = Sqlite3Reader(Path(quote(os.fsencode(self.path))))
        return reader


def _counts(reader: _Reader) -> dict[Channel, int]:
    counts: Counter[Channel] = Counter()
    for connection in reader.connections:
        counts[_channel(connection, reader)] += connection.msgcount
    if isinstance(reader, Reader2) and isinstance(reader.storage, McapReader):
        n_known = sum(n for channel, n in counts.items() if channel.type != _NO_SCHEMA)
        # without statistics and message indexes rosbags counts nothing
        if n_known < (reader.message_count or len(reader.storage.chunks)):
            raise DamageError("its summary lacks channels, schemas or counts")
    return counts


def _channel(connection: Connection, reader: _Reader) -> Channel:
    is_ros1 = isinstance(reader, Reader1)
    return Channel(connection.topic, standard_type(connection.msgtype), is_ros1)


def _scan(path: Path, error: Exception) -> Scan:
    """Read a file without its index; refuse a database, and where no message is found."""
    refusal = _refusal(path)
    if refusal or "encryption" in str(error):
        raise RecordingError(refusal or f"{path}: cannot be read ({_one_line(error)})") from error
    if path.suffix not in _SCANS:
        raise RecordingError(_advise(path, error)) from error
    try:
        scan = _SCANS[path.suffix](path)
    except (OSError, DamageError) as fault:
        raise RecordingError(_advise(path, fault)) from error
    if not any(scan.counts.values()):
        raise RecordingError(scan.damage or _advise(path, error)) from error
    return scan


def _refusal(path: Path) -> str:
    """Return why a file is not a bag; empty if it is one."""
    if not path.is_file():
        return f"{path}: not a file"
    with path.open("rb") as file:
        start = file.read(16)
    if not start:
        return f"{path}: the file is empty"
    if path.suffix == ".bag" and start.startswith(b"#ROS") and not start.startswith(Ros1Scan.magic):
        return f"{path}: the bag is of an older format than 2.0; run `rosbag fix` on a copy"
    magic, kind = _MAGICS.get(path.suffix, (b"", ""))
    return "" if start.startswith(magic) else f"{path}: not {kind}"


def _advise(path: Path, error: Exception) -> str:
    scan = _SCANS.get(path.suffix)
    tool = scan.tool if scan else "sqlite3 FILE .recover"
    return (
        f"{path}: cannot be read ({_one_line(error)}); where it is truncated or damaged, "
        f"try `{tool}` on a copy"
    )


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _describe_missing_index(path: Path, error: Exception, tool: str) -> str:
    return (
        f"bag: {path.name} is read without its index ({_one_line(error).strip(' .')}); "
        f"`{tool}` on a copy writes one"
    )


def _unread_log(path: Path) -> str:
    """Say that a recorder left messages in the log of a database; empty if it did not."""
    log = path.with_name(f"{path.name}-wal")
    if path.suffix != ".db3" or not log.is_file() or not log.stat().st_size:
        return ""
    return (
        f"{path}: the {log.stat().st_size} bytes of {log.name} are not read; "
        f"`sqlite3 FILE 'PRAGMA wal_checkpoint'` on a copy of both writes them into the file"
    )


def _announced_size(path: Path) -> int:
    """Return the size that the header of an SQLite database claims; 0 if it claims none.

    See https://sqlite.org/fileformat.html, section 1.3.
    """
    with path.open("rb") as file:
        header = file.read(100)
    if header[24:28] != header[92:96]:
        return 0  # the number of pages was not kept up to date
    page_size = int.from_bytes(header[16:18], "big")
    return (65536 if page_size == 1 else page_size) * int.from_bytes(header[28:32], "big")


# Let rosbags decompress the chunks of a file into bounded memory: a thousand bytes of a chunk can
# become gigabytes, and it has no limit of its own. It looks the functions up in two tables.
for _name in ("bz2", "lz4"):
    decompressors[_name] = partial(inflate_whole, compression=_name)
for _name in ("lz4", "zstd"):
    DECOMPRESSORS[_name] = partial(inflate_whole, compression=_name)
