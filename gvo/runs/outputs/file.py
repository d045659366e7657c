"""What all files have in common that a run writes as it goes."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Self

from gvo.errors import RecordingError
from gvo.types import Estimate, FaultyFrame, Frame, FrameResult, Optimum


class FileOutput:
    """A file of a run, open inside a `with` block; subclasses override what they write.

    It is written under another name in the same folder and takes its own when it is closed, also
    where the run is interrupted. Without a single frame no file is left.

    Raises
    ------
    RecordingError
        By all methods, when the file cannot be written.
    """

    _is_open = True

    def add_frame(self, frame: Frame, result: FrameResult) -> None:
        """Write the result of a frame."""

    def add_faulty(self, frame: FaultyFrame) -> None:
        """Write that a frame has no pose."""

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        """Write smoothed poses that are final, in any order."""

    def add_optimum(self, optimum: Optimum) -> None:
        """Write the global poses, and the loops that count."""

    def close(self) -> None:
        """Complete the file; a second call does nothing."""
        if self._is_open:
            self._is_open = False
            self._complete()

    def discard(self) -> None:
        """Give the file up, and with it its space on the disk."""
        if self._is_open:
            self._is_open = False
            self._discard()

    def _complete(self) -> None:
        """Write the last lines, and give the file its name."""

    def _discard(self) -> None:
        """Remove what was written, or what cannot be: complete it as it is."""
        with suppress(RecordingError):
            self._complete()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
