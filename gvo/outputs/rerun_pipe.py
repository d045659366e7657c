"""A pipe that ends in a file."""

from __future__ import annotations

import os
from pathlib import Path
from threading import Thread
from typing import Final

_N_BYTES: Final = 2**20


class FilePipe:
    """Takes all that is written to it, and keeps in a file what the disk has room for.

    For writers that cannot bear a write that fails: rerun's waits for ever, now and then, where
    the disk is full.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    OSError
        When it cannot be made.

    Attributes
    ----------
    error : OSError or None
        Why the file could not be written, once it could not.
    """

    def __init__(self, path: Path) -> None:
        self.error: OSError | None = None
        self._file = path.open("wb", buffering=0)
        self._reader, self._writer = os.pipe()
        self._thread = Thread(target=self._copy, name="gvo-file-pipe", daemon=True)
        self._thread.start()

    @property
    def entrance(self) -> Path:
        """What is to be opened for writing, once."""
        return Path(f"/dev/fd/{self._writer}")

    def leave(self) -> None:
        """Leave the entrance to who has opened it: the file ends when they close it."""
        os.close(self._writer)

    def join(self) -> None:
        """Wait for the end of the file."""
        self._thread.join()

    def _copy(self) -> None:
        with self._file, os.fdopen(self._reader, "rb", buffering=0) as pipe:
            while data := pipe.read(_N_BYTES):
                self._keep(data)

    def _keep(self, data: bytes) -> None:
        if self.error is not None:
            return
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            self.error = error
