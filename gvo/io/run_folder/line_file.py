"""Text files of whole lines: a group of lines is in the file or it is not."""

from __future__ import annotations

import io
import os
from pathlib import Path


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


class LineFile:
    """A text file that grows by whole lines; one that is there is replaced.

    Parameters
    ----------
    path : Path
    header : str
        Its first line, with the line feed, or nothing.

    Raises
    ------
    OSError
        When it cannot be written.
    """

    def __init__(self, path: Path, header: str) -> None:
        self.path = path
        path.unlink(missing_ok=True)  # a link there may lead out of the folder
        self._file = io.FileIO(path, "wb")
        append_whole(self._file, header.encode())

    def write(self, lines: str) -> None:
        """Append lines.

        Raises
        ------
        OSError
            When they cannot be written; none of them is.
        """
        append_whole(self._file, lines.encode())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


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
