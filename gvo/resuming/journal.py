"""The journal of a run: what came out of the front-end for each frame, while the run goes on."""

from __future__ import annotations

import json
from array import array
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from gvo.errors import OutputError, ResumeError
from gvo.resuming.record_file import RecordFile
from gvo.resuming.records import FrameRecord, Record, decode, encode


class Journal(AbstractContextManager["Journal"]):
    """A record for each frame, written before the lines of the frame are.

    Parameters
    ----------
    file : RecordFile
        Its first record is the header.
    header : dict
        See `describe_run`.
    start : int
        Where the header ends.

    Attributes
    ----------
    stamps_ns : array of int
        Of the frames that `past` gave, also of faulty ones.
    n_lost : int
        Bytes at the end that were no whole records, known once `past` is through.
    """

    def __init__(self, file: RecordFile, header: dict[str, Any], *, start: int) -> None:
        self.header = header
        self.stamps_ns = array("q")
        self.n_lost = 0
        self._file = file
        self._start = start

    @classmethod
    def create(cls, path: Path, header: dict[str, Any]) -> Journal:
        """Begin a journal; one that is there is replaced.

        Raises
        ------
        OutputError
            When it cannot be written.
        """
        try:
            file = RecordFile(path, is_new=True)
            start = file.append(json.dumps(header).encode())
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
        return cls(file, header, start=start)

    @classmethod
    def open(cls, path: Path) -> Journal | None:
        """Open the journal of an interrupted run.

        Returns
        -------
        Journal or None
            None where there is none, or its header is not whole: nothing had been done.

        Raises
        ------
        ResumeError
            When it cannot be read and written, or another process writes it.
        """
        if not path.exists():
            return None
        try:
            file = RecordFile(path, is_new=False)
            for end, payload in file.records():
                header = _read_header(payload)
                if header is not None:
                    return cls(file, header, start=end)
                break
        except OSError as error:
            raise ResumeError(f"{path}: cannot be opened: {error.strerror}") from error
        file.close()
        return None

    @property
    def path(self) -> Path:
        """The file."""
        return self._file.path

    def past(self) -> Iterator[Record]:
        """Yield the records so far; what follows the last good one is cut off in the end.

        Raises
        ------
        ResumeError
            When it cannot be read or written.
        """
        end, last_ns = self._start, None
        try:
            for end_of_record, payload in self._file.records():
                if end_of_record <= self._start:
                    continue
                record = _decode_after(payload, last_ns)
                if record is None:
                    break
                if isinstance(record, FrameRecord):
                    last_ns = record.stamp_ns
                self.stamps_ns.append(record.stamp_ns)
                end = end_of_record
                yield record
            self.n_lost = self._file.cut(end)
        except OSError as error:
            raise ResumeError(f"{self.path}: {error.strerror}") from error

    def append(self, record: Record) -> None:
        """Write a record.

        Raises
        ------
        OutputError
            When it cannot be written.
        """
        try:
            self._file.append(encode(record))
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from error

    def sync(self) -> None:
        """Let the disk have what was written: it is there after a power failure too.

        Raises
        ------
        OutputError
            When it cannot be written.
        """
        try:
            self._file.sync()
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from error

    def close(self) -> None:
        """Close the file: the run was interrupted."""
        self._file.close()

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    def remove(self) -> None:
        """Remove the file: the run is complete."""
        self._file.remove()


def _read_header(payload: bytes) -> dict[str, Any] | None:
    try:
        header = json.loads(payload.decode())
    except (ValueError, RecursionError):
        return None
    return header if isinstance(header, dict) else None


def _decode_after(payload: bytes, last_ns: int | None) -> Record | None:
    """Read a record; None where it is none that can follow a frame."""
    try:
        record = decode(payload)
    except ValueError:
        return None
    is_frame = isinstance(record, FrameRecord)
    return None if is_frame and last_ns is not None and record.stamp_ns <= last_ns else record
