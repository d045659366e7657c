"""Bags of ROS 2 in SQLite read row by row, around the pages that are missing or damaged."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import apsw

from gvo.io.bag.recovery.inflate import DamageError
from gvo.io.bag.recovery.scan import (
    Channel,
    FoundMessage,
    describe_damage,
    share,
    standard_type,
)

_MAX_ID = 2**62
_N_HEADER = 100  # bytes
# A text that is none comes as the second.
_FAULTS = (apsw.Error, UnicodeDecodeError)
_Row: TypeAlias = tuple[Any, ...]


class SqliteScan:
    """The messages of a database, found by walking over its rows.

    Parameters
    ----------
    path : Path

    Raises
    ------
    DamageError
        When its list of topics cannot be read.
    """

    tool = "sqlite3 FILE .recover"

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lost: dict[int, int | None] = {}
        self._channels: dict[int, Channel] = {}
        self.start_time_ns = 2**63 - 1
        try:
            with self._opened() as database:
                self.counts = self._count(database)
        except _FAULTS as error:
            raise DamageError(str(error)) from error

    @property
    def damage(self) -> str:
        """What cannot be read, in one line; complete when all messages were read."""
        if not self._lost:
            return ""
        n_bytes = announced_size(self._path)
        n_missing = n_bytes - self._path.stat().st_size
        texts = [f"its end is missing, {share(n_missing, n_bytes)}"] if n_missing > 0 else []
        n_known = sum(n for n in self._lost.values() if n is not None)
        texts += [f"{n_known} messages cannot be read"] if n_known else []
        ends = [first for first, n in self._lost.items() if n is None]
        texts += [f"none after message {min(ends) - 1} can be read"] if ends else []
        return describe_damage(self._path, "; ".join(texts), self.tool)

    def messages(self, names: Collection[str]) -> Iterator[FoundMessage]:
        """Yield the messages of some topics in the order in which they were written."""
        try:
            with self._opened() as database:
                columns = "topic_id, timestamp, data"
                for row_id, topic_id, log_time_ns, data in self._rows(database, columns):
                    channel = self._channels.get(topic_id)
                    if channel is None or channel.name not in names:
                        continue
                    if isinstance(log_time_ns, int) and isinstance(data, bytes):
                        yield FoundMessage(channel, log_time_ns, data)
                    else:
                        self._lost[row_id] = 1
        except _FAULTS as error:
            raise DamageError(str(error)) from error

    def _count(self, database: apsw.Connection) -> dict[Channel, int]:
        query = "SELECT id, CAST(name AS BLOB), CAST(type AS BLOB) FROM topics"
        for topic_id, name, type_ in database.execute(query):
            channel = Channel(_text(name), standard_type(_text(type_)), is_ros1=False)
            self._channels[topic_id] = channel
        counts = dict.fromkeys(self._channels.values(), 0)
        for row_id, topic_id, log_time_ns in self._rows(database, "topic_id, timestamp"):
            if topic_id in self._channels and isinstance(log_time_ns, int):
                counts[self._channels[topic_id]] += 1
                self.start_time_ns = min(self.start_time_ns, log_time_ns)
            else:
                self._lost[row_id] = 1
        return counts

    def _opened(self) -> closing[apsw.Connection]:
        location = f"{self._path.resolve().as_uri()}?immutable=1"
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        database = apsw.Connection(location, flags=flags, vfs=_whole_pages().name)
        # Otherwise a file is refused that is shorter than it says.
        database.execute("PRAGMA writable_schema = ON")
        return closing(database)

    def _rows(self, database: apsw.Connection, columns: str) -> Iterator[_Row]:
        """Yield the rows in the order of their ids, and note those that cannot be read."""
        query = f"SELECT id, {columns} FROM messages WHERE id > ? ORDER BY id"  # noqa: S608 - ours
        last = -1
        while True:
            try:
                for row in database.execute(query, (last,)):
                    if not _is_after(row, last):
                        break  # pages of a damaged tree come again and again
                    last = row[0]
                    yield row
                else:
                    return
            except _FAULTS:
                pass
            found = self._skip(database, f"{query} LIMIT 1", last)
            if found is None:
                return
            last = found[0]
            yield found

    def _skip(self, database: apsw.Connection, query: str, last: int) -> _Row | None:
        """Return the first row after another that can be read; note what is between."""
        good, step = last, 1
        while (row := _look(database, query, good)) is None and step < _MAX_ID:
            good, step = last + step, 2 * step
        bad = last
        while row is not None and good - bad > 1:
            middle = (bad + good) // 2
            found = _look(database, query, middle)
            bad, good, row = (middle, good, row) if found is None else (bad, middle, found)
        first = max(last, 0) + 1  # ids are counted from 1
        if row is None:
            self._lost[first] = None
        elif row[0] > first:
            self._lost[first] = row[0] - first
        return row


def announced_size(path: Path) -> int:
    """Return the bytes that a database says it has; 0 where it does not say."""
    with path.open("rb") as file:
        header = file.read(_N_HEADER)
    if header[24:28] != header[92:96]:
        return 0  # written by what did not keep the number up to date
    return _size_of_page(header) * int.from_bytes(header[28:32], "big")


def _text(value: bytes | None) -> str:
    """Return a name that may be damaged."""
    return "" if value is None else value.decode(errors="replace")


def _look(database: apsw.Connection, query: str, after: int) -> _Row | None:
    """Return the row after an id, or nothing where there is none or it cannot be read."""
    try:
        row: _Row | None = database.execute(query, (after,)).fetchone()
    except _FAULTS:
        return None
    return row if row is not None and _is_after(row, after) else None


def _is_after(row: _Row, last: int) -> bool:
    """Tell whether a row is one that was asked for: in a damaged tree others are found."""
    return isinstance(row[0], int) and row[0] > last


class _WholePages(apsw.VFS):
    """Files without the part of a page that a cut leaves: SQLite would fill it with zeros."""

    name = "gvo-whole-pages"

    def __init__(self) -> None:
        super().__init__(self.name, "")

    def xOpen(self, name: str | apsw.URIFilename | None, flags: list[int]) -> apsw.VFSFile:  # noqa: N802
        return _WholePagesFile("", name, flags)


class _WholePagesFile(apsw.VFSFile):
    def xFileSize(self) -> int:  # noqa: N802
        n_bytes = super().xFileSize()
        return n_bytes - n_bytes % _size_of_page(super().xRead(_N_HEADER, 0))


@cache
def _whole_pages() -> _WholePages:
    """Return the one of them, registered for as long as the program runs."""
    return _WholePages()


def _size_of_page(header: bytes) -> int:
    size = int.from_bytes(header[16:18], "big")
    return 65536 if size == 1 else max(size, 1)
