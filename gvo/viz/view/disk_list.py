"""Arrays of frames, kept on disk instead of in memory."""

from __future__ import annotations

import io
import tempfile
import weakref
from collections.abc import Mapping
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray


class DiskList:
    """A list of named arrays in an unnamed temporary file, which is gone with the object."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the object
        weakref.finalize(self, self._file.close)
        self._ends = [0]
        self._lock = Lock()

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._ends) - 1

    def append(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write arrays at the end.

        Raises
        ------
        ValueError
            When an array holds Python objects.
        """
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        with self._lock:
            self._file.seek(self._ends[-1])
            self._file.write(content.getbuffer())
            self._ends.append(self._file.tell())

    def __getitem__(self, index: int) -> dict[str, NDArray[Any]]:
        """Read the arrays of an item.

        Raises
        ------
        IndexError
            When there is none.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{index} is not among {len(self)} items")
        with self._lock:
            start, end = self._ends[index : index + 2]
            self._file.seek(start)
            content = io.BytesIO(self._file.read(end - start))
        with np.load(content, allow_pickle=False) as arrays:
            return dict(arrays)
