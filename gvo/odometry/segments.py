"""Segments of a run without measurements between them, until a place is seen again.

While the camera is lost its pose is a guess that nobody should rely on. The frames after that
are a segment of their own, somewhere in the world: where, only a loop to a place of an earlier
segment can tell.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable

from gvo.types import SegmentJoin, Status


class Segments:
    """Which segment a run is in, and which ones are joined."""

    def __init__(self) -> None:
        self._starts_ns: list[int] = []
        self._groups = [0]
        self._is_lost = False

    @property
    def current(self) -> int:
        """The segment of the latest frame."""
        return len(self._starts_ns)

    def segment_of(self, stamp_ns: int) -> int:
        """Return the segment of an earlier frame."""
        return bisect_right(self._starts_ns, stamp_ns)

    def note_frame(self, stamp_ns: int, status: Status) -> None:
        """Add a frame; the first one that is lost begins a segment."""
        if status is Status.LOST and not self._is_lost:
            self._starts_ns.append(stamp_ns)
            self._groups.append(self.current)
        self._is_lost = status is Status.LOST

    def unjoined(self, stamps_ns: Iterable[int]) -> list[int]:
        """Return the keyframes of segments that the current one is not joined to."""
        present = self._groups[self.current]
        return [ns for ns in stamps_ns if self._groups[self.segment_of(ns)] != present]

    def join(self, stamp_ns: int, reference_ns: int) -> SegmentJoin | None:
        """Join the segment of a frame to that of an earlier one, and to all that are joined to it.

        Parameters
        ----------
        stamp_ns, reference_ns : int
            The frame, and the one that it was registered against.

        Returns
        -------
        SegmentJoin or None
            None where they are joined already.
        """
        segment, other = self.segment_of(stamp_ns), self.segment_of(reference_ns)
        present, former = self._groups[segment], self._groups[other]
        if present == former:
            return None
        self._groups = [former if group == present else group for group in self._groups]
        return SegmentJoin(
            segment=segment, to_segment=other, stamp_ns=stamp_ns, reference_ns=reference_ns
        )
