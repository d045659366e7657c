"""Text files of whole lines: a group of lines is in the file or it is not."""

from __future__ import annotations

import io
import os
from pathlib import Path

from gvo.errors import ResumeError

_BLOCK = 1 << 16


def append_whole(file: io.FileIO, data: bytes) -> None:
    """Append all of something to an unbuffered file, or nothing of it.

    Raises
    ------
    OSError
        When it cannot be written, as on a full disk; the file is as long as before.
    """
    length = file.seek(0, os.SEEK_END)
    rest = memoryview(data)
    try:
        while rest:
            rest = rest[file.write(rest) :]
    except OSError:
        file.truncate(length)
        raise


def cut_torn_line(path: Path) -> None:
    """Cut off what follows the last line feed of a file: a line that was not finished."""
    with path.open("rb+") as file:
        end = file.seek(0, os.SEEK_END)
        while end > 0:
            start = max(end - _BLOCK, 0)
            file.seek(start)
            found = file.read(end - start).rfind(b"\n")
            if found >= 0:
                end = start + found + 1
                break
            end = start
        file.truncate(end)


class LineFile:
    """A text file that grows by whole lines, each of which begins with a stamp.

    Parameters
    ----------
    path : Path
    header : str
        Its first line, with the line feed, or nothing.
    goes_on : bool
        Keep the lines that are there: as many of those that are written are left out. Else the
        file is replaced.

    Raises
    ------
    OSError
        When it cannot be written.
    ResumeError
        When another header is there.
    """

    def __init__(self, path: Path, header: str, *, goes_on: bool = False) -> None:
        self.path = path
        self._kept: io.BufferedReader | None = None
        goes_on = goes_on and path.exists()
        if goes_on:
            cut_torn_line(path)
        else:
            path.unlink(missing_ok=True)  # a link there may lead out of the folder
        self._file = io.FileIO(path, "ab" if goes_on else "wb")
        if not goes_on or path.stat().st_size == 0:
            append_whole(self._file, header.encode())
            return
        self._kept = path.open("rb")
        found = self._kept.read(len(header.encode()))
        if found != header.encode():
            self.close()
            raise ResumeError(
                f"{path}: does not begin as expected, with {header.strip()!r:.60}; it was changed: "
                "run without --resume"
            )

    def write(self, lines: str) -> None:
        """Append lines, but for those that are there already.

        Raises
        ------
        OSError
            When they cannot be written; none of them is.
        ResumeError
            When the line that is there has another stamp.
        """
        data = lines.encode()
        if self._kept is not None:
            data = self._left_of(data, self._kept)
        if data:
            append_whole(self._file, data)

    def settle(self) -> None:
        """Take that all is repeated that was written before."""

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        if self._kept is not None:
            self._kept.close()

    def _left_of(self, data: bytes, kept: io.BufferedReader) -> bytes:
        """Return the lines that are not there yet."""
        lines = data.splitlines(keepends=True)
        for index, line in enumerate(lines):
            there = kept.readline()
            if not there:
                kept.close()
                self._kept = None
                return b"".join(lines[index:])
            if first_field(there) != first_field(line):
                raise ResumeError(
                    f"{self.path}: holds {first_field(there).decode(errors='replace')!r:.40} "
                    f"where {first_field(line).decode()} was written; it was changed: run without "
                    "--resume"
                )
        return b""


class RewrittenFile(LineFile):
    """A text file of which some lines stand and others were preliminary.

    While the run is repeated, the lines that it gives are collected beside the file: as they are
    there, where they are. `settle` puts them into its place, and without it nothing changes.

    Parameters
    ----------
    path : Path
    header : str
        Its first line, with the line feed, or nothing.
    """

    def __init__(self, path: Path, header: str) -> None:
        self._there: dict[bytes, bytes] = {}
        self._is_settled = False
        if path.exists():
            lines = path.read_bytes().splitlines(keepends=True)
            self._there = {first_field(line): line for line in lines if line.endswith(b"\n")}
        self._beside = path.with_name(f"{path.name}.resumed")
        super().__init__(self._beside, header)
        self.path = path

    def write(self, lines: str) -> None:
        """Append lines, each as it is there, where it is.

        Raises
        ------
        OSError
            When they cannot be written; none of them is.
        """
        data = lines.encode().splitlines(keepends=True)
        whole = b"".join(self._there.pop(first_field(line), line) for line in data)
        if whole:
            append_whole(self._file, whole)

    def settle(self) -> None:
        """Put what was written into the place of the file."""
        os.fsync(self._file.fileno())
        self._beside.replace(self.path)
        self._is_settled = True
        self._there.clear()  # what is left was preliminary

    def close(self) -> None:
        """Close the file; where it did not settle, leave what was there before."""
        super().close()
        if not self._is_settled:
            self._beside.unlink(missing_ok=True)


def first_field(line: bytes) -> bytes:
    """Return what stands before the first blank or comma of a line."""
    return line.split(b",", 1)[0].split(b" ", 1)[0].rstrip(b"\n")


def replace_text(path: Path, text: str) -> None:
    """Write a text file so that at any moment the one before or the new one is there.

    Raises
    ------
    OSError
        When it cannot be written; the one before stands.
    """
    replace_bytes(path, text.encode())


def replace_bytes(path: Path, data: bytes) -> None:
    """Write a file as `replace_text` does."""
    beside = path.with_name(f"{path.name}.new")
    try:
        with io.FileIO(beside, "wb") as file:
            append_whole(file, data)
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError:
        beside.unlink(missing_ok=True)
        raise
