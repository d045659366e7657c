"""A part of a file that is read no further than its end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

_BLOCK = 1 << 20


class DamageError(Exception):
    """A record that is none; caught where the reader steps over it."""


class Window:
    """A part of a file, read from its start.

    What a file claims of itself is checked against what there is before anything is allocated.

    Parameters
    ----------
    file : BinaryIO
    start, end : int
        Bytes from the start of the file.
    """

    def __init__(self, file: BinaryIO, start: int, end: int) -> None:
        self.file = file
        self.position = start
        self.end = end

    @property
    def rest(self) -> int:
        """The number of bytes that are left."""
        return self.end - self.position

    def take(self, n_bytes: int) -> bytes:
        """Return the next bytes.

        Raises
        ------
        DamageError
            When there are fewer.
        """
        start = self.position
        self.skip(n_bytes)
        self.file.seek(start)
        data = self.file.read(n_bytes)
        if len(data) != n_bytes:
            raise DamageError("the file was shortened while it was read")
        return data

    def skip(self, n_bytes: int) -> None:
        """Step over the next bytes.

        Raises
        ------
        DamageError
            When there are fewer.
        """
        if n_bytes > self.rest:
            raise DamageError(f"a record of {n_bytes} bytes is cut after {self.rest}")
        self.position += n_bytes

    def number(self, n_bytes: int) -> int:
        """Return the next bytes as an unsigned number, little-endian."""
        return int.from_bytes(self.take(n_bytes), "little")

    def part(self, n_bytes: int) -> Window:
        """Return a window on the next bytes, and step over them."""
        start = self.position
        self.skip(n_bytes)
        return Window(self.file, start, self.position)

    def blocks(self, size: int = _BLOCK) -> Iterator[bytes]:
        """Yield all that is left, block by block."""
        while self.rest:
            yield self.take(min(size, self.rest))

    def find(self, pattern: bytes, start: int) -> Iterator[int]:
        """Yield the positions of a pattern from a start on; the window's own does not matter."""
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
