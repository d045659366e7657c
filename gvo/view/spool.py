"""Values of frames, kept on disk instead of in memory."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Sequence
from threading import Lock
from typing import Any

from gvo.view.packing import Packer


class Spool:
    """A list that grows in an unnamed temporary file; it is gone with the object.

    Parameters
    ----------
    kinds : sequence of type
        Classes of the values, as for `Packer`.
    """

    def __init__(self, kinds: Sequence[type] = ()) -> None:
        self._packer = Packer(kinds)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the object
        weakref.finalize(self, self._file.close)
        self._ends = [0]
        self._lock = Lock()

    def __len__(self) -> int:
        """Return the number of values."""
        return len(self._ends) - 1

    def append(self, value: object) -> None:
        """Write a value at the end.

        Raises
        ------
        ValueError
            When it holds something of another class.
        """
        content = self._packer.pack(value)
        with self._lock:
            self._file.seek(self._ends[-1])
            self._file.write(content)
            self._ends.append(self._ends[-1] + len(content))

    def __getitem__(self, index: int) -> Any:  # noqa: ANN401 - whatever was written
        """Read a value.

        Raises
        ------
        IndexError
            When there is none.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{index} is not among {len(self)} values")
        with self._lock:
            start, end = self._ends[index : index + 2]
            self._file.seek(start)
            content = self._file.read(end - start)
        return self._packer.unpack(content)
