"""A binary file of records that grows record by record; one cut short is recognized."""

from __future__ import annotations

import fcntl
import io
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from gvo.errors import RunBusyError
from gvo.io.run_folder.line_file import append_whole

_MAGIC = b"gvo journal 1\n"
# Length and CRC-32 of what follows.
_PREFIX = struct.Struct("<II")
# A record of the front-end takes some kilobytes; what claims more is none.
MAX_RECORD = 1 << 20


def refuse_busy(path: Path) -> None:
    """Refuse a file of records that a process has open.

    Raises
    ------
    RunBusyError
    """
    try:
        with path.open("rb") as file:
            _lock(file, path)
    except OSError:
        return  # none there, or whoever replaces it is told


class RecordFile(AbstractContextManager["RecordFile"]):
    """Records of bytes, each with its length and check sum.

    One process at a time: the file is locked until it is closed.

    Parameters
    ----------
    path : Path
    is_new : bool
        Replace what is there.

    Raises
    ------
    OSError
        When it cannot be opened.
    RunBusyError
        When another process has it.
    """

    def __init__(self, path: Path, *, is_new: bool) -> None:
        self.path = path
        self._file = io.FileIO(path, "wb+" if is_new else "rb+")
        try:
            _lock(self._file, path)
        except RunBusyError:
            self._file.close()
            raise
        if is_new:
            append_whole(self._file, _MAGIC)

    def append(self, payload: bytes) -> int:
        """Append a record; return where it ends.

        Raises
        ------
        OSError
            When it cannot be written; the file is as before.
        ValueError
            When it is larger than `MAX_RECORD`.
        """
        if len(payload) > MAX_RECORD:
            raise ValueError(f"a record holds at most {MAX_RECORD} bytes, got {len(payload)}")
        append_whole(self._file, _PREFIX.pack(len(payload), zlib.crc32(payload)) + payload)
        return self._file.tell()

    def records(self) -> Iterator[tuple[int, bytes]]:
        """Yield where each record ends, and the record, up to the first that is not whole."""
        with self.path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                return
            while True:
                prefix = file.read(_PREFIX.size)
                if len(prefix) < _PREFIX.size:
                    return
                length, check_sum = _PREFIX.unpack(prefix)
                if length > MAX_RECORD:
                    return
                payload = file.read(length)
                if len(payload) < length or zlib.crc32(payload) != check_sum:
                    return
                yield file.tell(), payload

    def cut(self, end: int) -> int:
        """Cut off what follows some records; return how many bytes that were."""
        n_bytes = self._file.seek(0, os.SEEK_END) - end
        if n_bytes > 0:
            self._file.truncate(end)
        return n_bytes

    def sync(self) -> None:
        """Let the disk have what was written: it is there after a power failure too."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file, and let others have it."""
        self._file.close()

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    def remove(self) -> None:
        """Close the file and remove it."""
        self.path.unlink(missing_ok=True)
        self._file.close()


def _lock(file: io.FileIO | io.BufferedReader, path: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RunBusyError(
            f"{path.parent}: another process is writing this run; wait for its end, or end it"
        ) from None
    except OSError:
        return  # a file system without locks
